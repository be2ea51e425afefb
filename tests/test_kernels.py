"""The step for GPUs, compiled for the processor: against the unfused step, the environments, and itself."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from compiled import needs_compiler, on_processor
from covering import PERFECT, covering, engine, slow
from driven import at_random
from gymnasium.error import ResetNeeded
from own_tasks import TASKS as OWN

import lag_envs.torch
from lag_envs import cli, nvrtc
from lag_envs.benchmark import device as benchmark_device
from lag_envs.benchmark import gpu
from lag_envs.device import DeviceEnvs
from lag_envs.envs.kernels import APART, kernels_of
from lag_envs.envs.unfused import Unfused
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.stepping.driver import LARGEST_COUNT
from lag_envs.tasks import TASKS, cart_pole, chain, pivoted_bar
from lag_envs.torch import TorchVectorEnv

pytestmark = needs_compiler
BAR, FREE, CHOICES = pivoted_bar.SwingUp, pivoted_bar.SwingUpFree, cart_pole.CartPoleExact
MODES = ("NextStep", "SameStep", "Disabled")
LEARNED = [kind for kind in OWN if kind().formulas.draws or kind().formulas.choices]
OTHERS = [kind for kind in OWN if kind not in LEARNED]


def actions_of(task, given):
    """Return a batch's actions as tensors, from one for each environment."""
    rows = np.array([np.atleast_1d(action) for action in given])
    rows = rows.reshape(len(given), *([] if len(task.formulas.choices) == 1 else [-1]))
    return torch.from_numpy(rows.astype(np.int64 if task.formulas.choices else np.float64))


def bits(numbers):
    return [float(x).hex() for x in numbers]


def check_bits(kind, steps, seeds=(3, 2**64 - 1)):
    """Step a batch and `Unfused` in parallel, to the ends of their first episodes."""
    envs = on_processor(kind, len(seeds))
    ones = {i: Unfused(envs.task) for i in range(len(seeds))}
    choose = [at_random(envs.task, i) for i in ones]
    observations = envs.reset(seed=list(seeds))
    for i, one in ones.items():
        assert np.array_equal(observations[i], np.array(one.reset(seeds[i]), np.float32))
    every = list(ones.values())
    for n in range(steps):
        given = [act(one, n) for act, one in zip(choose, every, strict=True)]
        observations, rewards, terminated, truncated, infos = envs.step(actions_of(envs.task, given))
        for i, one in list(ones.items()):
            seen, reward, *ended = one.step(given[i])
            assert bits(envs.state[i]) == bits(one.state)
            assert bits(envs.target[i]) == bits(one.target)
            assert bits(envs.control[i]) == bits(one.control)
            assert bits([rewards[i]]) == bits([reward])
            assert np.array_equal(observations[i], np.array(seen, np.float32))
            assert [bool(terminated[i]), bool(truncated[i])] == ended
            assert not infos["refused"][i]
            if any(ended):
                del ones[i]
        if not ones:
            break


@pytest.mark.parametrize("id", covering(PERFECT, engine))
def test_it_has_the_bits_of_the_unfused_step(id):
    check_bits(TASKS[id], 100)


@pytest.mark.parametrize(
    "kind",
    [*LEARNED, *(slow(kind) for kind in OTHERS)],
    ids=lambda k: k.__name__,
)
def test_it_has_the_bits_of_the_unfused_step_on_users_tasks_too(kind):
    """Kicks, choices, two controls, targets, ranges, a last reward, nothing that acts."""
    check_bits(kind, 100)


@pytest.mark.parametrize("mode", [MODES[0], *map(slow, MODES[1:])])
@pytest.mark.parametrize("kind", [CHOICES, *map(slow, LEARNED[:1])], ids=lambda kind: kind.__name__)
def test_episodes_are_those_of_the_environments(kind, mode):
    """Over ends and starts, in each mode, to rounding: the environments' own step is fused."""
    n, options = 6, {"max_episode_steps": 15, "autoreset_mode": mode}
    on_kernel, batch = on_processor(kind, n, **options), LagrangianVectorEnv(kind, n, **options)
    first, (other, _) = on_kernel.reset(seed=11), batch.reset(seed=11)
    assert np.allclose(first, other, rtol=1e-6, atol=1e-7)
    rng, ends = np.random.default_rng(0), 0
    for _ in range(60):
        batch.action_space.seed(int(rng.integers(2**31)))
        given = batch.action_space.sample()
        found = on_kernel.step(actions_of(on_kernel.task, given))
        expected = batch.step(given)
        over = expected[2] | expected[3]
        ends += over.sum()
        assert np.allclose(found[0], expected[0], rtol=1e-5, atol=1e-6)
        assert np.allclose(found[1], expected[1], rtol=1e-9, atol=1e-9)
        assert np.array_equal(found[2], expected[2]) and np.array_equal(found[3], expected[3])
        assert np.allclose(on_kernel.state, batch.state, rtol=1e-9, atol=1e-9)
        if mode == "SameStep" and over.any():
            assert np.array_equal(found[4]["_final_obs"], over)
            last = np.stack(expected[4]["final_obs"][over])
            assert np.allclose(found[4]["final_obs"][over], last, rtol=1e-5, atol=1e-6)
        if mode == "Disabled" and over.any():
            with pytest.raises(ResetNeeded, match=r"reset their environments with options\['reset_mask'\]"):
                on_kernel.step(actions_of(on_kernel.task, given))
            again = on_kernel.reset(options={"reset_mask": torch.from_numpy(over)})
            assert np.allclose(again, batch.reset(options={"reset_mask": over})[0], rtol=1e-5, atol=1e-6)
    assert ends > 2 * n


@pytest.mark.slow
@pytest.mark.parametrize("id", PERFECT)
def test_single_precision_is_the_step_to_its_rounding(id):
    """From the same states, at most 32 half units times size times condition."""
    n = 4
    double = on_processor(id, n, autoreset_mode="SameStep")
    single = on_processor(id, n, dtype=torch.float32, autoreset_mode="SameStep")
    assert torch.allclose(double.reset(seed=5), single.reset(seed=5), rtol=1e-6, atol=1e-6)
    task, scene = double.task, double.task.scene
    known, choose = Unfused(task), [at_random(task, i) for i in range(n)]
    known.reset(0)
    steps = []
    for i in range(100):
        # Both start from states that single precision can represent.
        single.rows.copy_(double.rows)
        double.rows.copy_(single.rows)
        before = double.state.numpy().copy()
        given = actions_of(task, [act(known, i) for act in choose])
        _, rewards, *over, _ = double.step(given)
        _, found, *ended, infos = single.step(given)
        assert not infos["refused"].any()
        assert all(torch.equal(a, b) for a, b in zip(over, ended, strict=True))
        # A reward may be a difference of values of a hundred, each with its rounding.
        assert torch.allclose(found.double(), rewards, rtol=1e-4, atol=100 * 16 * 2.0**-24)
        for j in torch.nonzero(~(over[0] | over[1]))[:, 0].tolist():
            by_state, by_control = scene.jacobian(before[j], double.control[j].numpy(), task.dt)
            # A guard that stops at an edge amplifies a rounding, which is not the motion's fault.
            moved = by_control @ (single.control[j].double() - double.control[j]).numpy()
            steps.append(
                (before[j], double.state[j].numpy().copy(), single.state[j].numpy().copy(), moved, by_state)
            )
    starts, ends, own, moved = (np.array(x) for x in list(zip(*steps, strict=True))[:4])
    sizes = np.maximum(np.abs(starts).max(axis=0), np.abs(ends).max(axis=0))
    error = np.max(np.abs(own - ends - moved) / sizes, axis=1)
    condition = [max(1.0, np.linalg.norm(j / sizes[:, None] * sizes, np.inf)) for *_, j in steps]
    assert np.max(error / condition) <= 32 * 2.0**-24


def test_what_cannot_be_stepped_is_cut_off():
    """The state is kept, others continue, and the next episode begins as after any other end."""
    envs = on_processor(FREE, 4, damping=0.0)
    envs.reset(seed=1)
    envs.rows[1, 1] = 1e9  # too fast for any number of substeps
    before = envs.state.clone()
    actions = torch.tensor([[0.5], [0.5], [float("nan")], [float("inf")]])
    _, rewards, terminated, truncated, infos = envs.step(actions)
    assert infos["refused"].tolist() == truncated.tolist() == [False, True, True, True]
    assert not terminated.any() and rewards[1:].tolist() == [0.0, 0.0, 0.0] != rewards[:1].tolist()
    assert torch.equal(envs.state[1:], before[1:]) and not torch.equal(envs.state[0], before[0])
    *_, truncated, infos = envs.step(torch.zeros(4, 1))
    assert not truncated.any() and not infos["refused"].any()
    assert (envs.state[1:].abs() < 10.0).all()
    choices = on_processor(CHOICES, 3)
    choices.reset(seed=1)
    assert choices.step(torch.tensor([1, 2, -1]))[4]["refused"].tolist() == [False, True, True]


def test_starts_may_be_given():
    envs = on_processor(BAR, 3)
    envs.reset(seed=1)
    mask, states = torch.tensor([True, False, True]), torch.arange(12.0).reshape(3, 4) / 100
    kept = envs.state[1].clone()
    seen = envs.reset(options={"state": states, "reset_mask": mask})
    assert torch.equal(envs.state[mask], states[mask].double()) and torch.equal(envs.state[1], kept)
    env = LagrangianVectorEnv(BAR, 3)
    env.reset(seed=1)
    given = {"state": states.double().numpy(), "reset_mask": mask.numpy()}
    assert np.allclose(seen, env.reset(options=given)[0], rtol=1e-6)
    # Seeds are used for the environments that are reset.
    envs.reset(seed=8, options={"reset_mask": mask})
    fresh = on_processor(BAR, 3)
    fresh.reset(seed=8)
    assert torch.equal(envs.state[mask], fresh.state[mask]) and torch.equal(envs.state[1], kept)
    for options, message in (
        ({"state": states[:2]}, r"options\['state'\] must have shape \(3, 4\), got \(2, 4\)"),
        ({"state": states * torch.nan}, "environment 0: .*must be finite"),
        ({"target": torch.zeros(3)}, "environment 0: this task has no target"),
        ({"reset_mask": torch.zeros(3)}, r"options\['reset_mask'\] must be 3 of torch.bool"),
        ({"reset_mask": torch.zeros(3, dtype=torch.bool)}, "must select at least one"),
        ({"mask": 1}, "unknown reset option 'mask'"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.reset(options=options)


def test_bad_input():
    with pytest.raises(ResetNeeded, match="no episode has begun"):
        on_processor(BAR, 2).step(torch.zeros(2, 1))
    with pytest.raises(ResetNeeded, match="the first reset must reset every environment"):
        on_processor(BAR, 2).reset(options={"reset_mask": torch.tensor([True, False])})
    imperfect = next(id for id, kind in TASKS.items() if kind.imperfections)
    for make, message in (
        (lambda: on_processor(imperfect, 2), f"{imperfect} cannot be on a GPU: .* take an id without them"),
        (lambda: on_processor(BAR.id, 2, action_delay=0.02), "leave these keywords out"),
        (lambda: on_processor(BAR, 2, damping=[0.0, 0.1]), "give damping one value"),
        (lambda: on_processor("Pendulum-v1", 2), "not an environment of this package"),
        (lambda: on_processor(BAR, 2, diagnostics=True), "neither render_mode nor diagnostics"),
        (lambda: on_processor(BAR, 0), "num_envs must be a whole number of at least 1"),
        (lambda: on_processor(BAR, 2, dtype=torch.float16), "dtype must be torch.float32 or torch.float64"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    envs = on_processor(BAR, 2)
    envs.reset(seed=0)
    for actions, kind, message in (
        (np.zeros((2, 1)), TypeError, "actions must be a tensor, got ndarray"),
        (torch.zeros(3, 1), ValueError, r"actions must have shape \(2, 1\), got \(3, 1\)"),
        (torch.zeros(2, 1, device="meta"), ValueError, "actions must be on cpu, got a tensor on meta"),
        (torch.zeros(2, 1, dtype=torch.int64), TypeError, "actions must be real numbers, got torch.int64"),
    ):
        with pytest.raises(kind, match=message):
            envs.step(actions)


def test_the_vector_environment_hands_over(monkeypatch):
    """`TorchVectorEnv` on a device that is not the CPU; here the processor takes its place."""
    monkeypatch.setattr(
        lag_envs.torch, "DeviceEnvs", type("Processor", (DeviceEnvs,), {"__init__": _on_processor})
    )
    envs = TorchVectorEnv(BAR.id, 3, device="cuda", dtype=torch.float32, autoreset_mode="SameStep")
    observations, infos = envs.reset(seed=2)
    assert observations.shape == envs.observation_space.shape == (3, 5) and infos == {}
    before = envs.state.clone()
    observations, rewards, *_, infos = envs.step(torch.ones(3, 1))
    assert rewards.dtype == envs.state.dtype == torch.float32
    assert not torch.equal(before, envs.state) and infos["final_obs"].shape == (3, 5)
    push = torch.ones(3, 1, requires_grad=True)
    with pytest.raises(ValueError, match=r"a GPU's step has no gradients: give actions\.detach\(\)"):
        envs.step(push)
    with torch.no_grad():
        envs.step(push)
    envs.close()


def _on_processor(self, task, num_envs, device, dtype, **options):
    assert str(device) == "cuda"
    made = on_processor(task, num_envs, dtype=dtype, **options)
    self.__dict__ = made.__dict__


def test_text_does_not_depend_on_numbers():
    """Another parameter needs no compiling, unless it is zero."""
    a, b, c = (kernels_of(BAR(damping=x)).source for x in (0.1, 0.2, 0.0))
    assert a == b != c


def test_loops_are_unrolled_where_registers_hold_the_coefficients():
    """The loop over substeps never is."""
    long = chain.SwingUpTriple()
    for task, single, unrolled in ((BAR(), False, True), (long, False, False), (long, True, True)):
        source = kernels_of(task, single).source
        assert ('#define UNROLL _Pragma("unroll")' in source) == unrolled
        loops = [line.strip() for line in source.splitlines() if "for (int k" in line]
        assert sum(line.startswith("UNROLL for") for line in loops) >= len(loops) - 2 > 5
        assert f" < {LARGEST_COUNT};" in loops[0] and loops[0].startswith("for")


@pytest.mark.gpu
def test_nvrtc_compiles_it():
    pytest.importorskip("cuda.bindings.nvrtc")
    try:
        nvrtc.version()
    except RuntimeError as error:
        pytest.skip(str(error))
    for single in (False, True):
        code = nvrtc.compiled(kernels_of(CHOICES(), single).source, "sm_90", () if single else APART[:1])
        assert code[:4] == b"\x7fELF" and b"begin" in code and b"step" in code
    with pytest.raises(RuntimeError, match=r"NVRTC cannot compile the step: environment\.cu\(1\): error"):
        nvrtc.compiled("extern int f(", "sm_90")


def test_the_benchmark_measures_both_precisions(monkeypatch):
    """Here on the processor: its numbers say nothing about a GPU."""
    monkeypatch.setattr(benchmark_device, "DeviceEnvs", _on_any)
    monkeypatch.setattr(benchmark_device, "COPIED", 2**20)
    report = benchmark_device.measured([CHOICES.id, BAR.id], [3, 7], torch.device("cpu"), 1e-3, 3)
    assert report["complete"]
    assert [(r["id"], r["precision"], r["num_envs"]) for r in report["rows"]] == [
        (id, precision, n)
        for id in (CHOICES.id, BAR.id)
        for precision in ("float32", "float64")
        for n in (3, 7)
    ]
    assert report["bandwidth"] > 0.0
    numbers = ("steps", "share", "replayed", "replayed_share")
    assert all(r[name] > 0.0 for r in report["rows"] for name in numbers)
    assert not any("gymnax" in r for r in report["rows"])  # which is measured on a GPU only
    # State, its cosine and sine, control there and back, action, reward; two observations, age, four flags.
    assert benchmark_device.traffic(on_processor(BAR, 1)) == 8 * (2 * 7 + 1 + 1) + 2 * 4 * 5 + 2 * 4 + 4


def test_what_fails_and_what_is_interrupted_leaves_the_rest(monkeypatch):
    made = iter([on_processor, ValueError("no room"), on_processor, KeyboardInterrupt()])

    def make(*given):
        if isinstance(found := next(made), BaseException):
            raise found
        envs = found(given[0], given[1], dtype=given[3], autoreset_mode="SameStep")
        envs.reset(seed=0)
        return envs

    monkeypatch.setattr(benchmark_device, "_under_way", make)
    monkeypatch.setattr(benchmark_device, "COPIED", 2**20)
    report = benchmark_device.measured([CHOICES.id], [3, 4], torch.device("cpu"), 1e-3, 3)
    assert [r.get("problem") for r in report["rows"]] == [None, "failed: ValueError: no room", None]
    assert not report["complete"]
    lines = gpu.console_lines(report | {"date": "2020-02-20", "versions": {"torch": "2"}})
    assert "no room" in lines[4] and lines[-1].startswith("interrupted")


def test_its_results_can_be_read(tmp_path):
    rows = [
        {
            **{"id": BAR.id, "precision": p, "num_envs": n, "steps": s * n, "replayed": 2 * s * n},
            **{"share": 0.25, "replayed_share": 0.5},
        }
        for p, s in (("float32", 3e4), ("float64", 1e4))
        for n in (4, 2**20)
    ]
    rows[1]["gymnax"] = 3e10
    versions = {"torch": "2", "gymnax": "1.0", "jax": "0.11"}
    report = {
        "date": "2020-02-20", "gpu": "G", "versions": versions, "bandwidth": 3e12, "rows": rows,
        "settings": {"sizes": [4, 2**20], "rounds": 9, "seconds": 0.05}, "complete": True,
    }  # fmt: skip
    lines = gpu.console_lines(report)
    assert "G, bandwidth 3.00 TB/s" in lines[0] and len(lines) == 3 + len(rows) + 3
    assert lines[-1].split() == [BAR.id, "1,048,576", "62.9", "G", "30.0", "G", "2.1"]
    found = f"{BAR.id} float32 1,048,576 31.5 G 25 % 62.9 G 50 %"
    assert " ".join(lines[4].split()) == found
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "speed.md"
    page.write_text("above <!-- gpu:begin --><!-- gpu:end --> below")
    gpu.take_over(report, tmp_path)
    assert json.loads((tmp_path / "docs" / "gpu.json").read_text()) == report
    text = page.read_text()
    assert "float32, 4 at once" in text and text.startswith("above") and text.endswith("below")
    assert f"| {BAR.id} | 120 k | 240 k | 62.9 G | 50 % | 21.0 G | 50 % |" in text
    assert "1.0 (JAX 0.11)" in text and f"| {BAR.id} | 1,048,576 | 62.9 G | 30.0 G | 2.1 |" in text
    rows[0] = {"id": BAR.id, "precision": "float32", "num_envs": 4, "problem": "failed"}
    assert f"| {BAR.id} | failed |  | 62.9 G | 50 % |" in gpu.gpu_markdown(report)


def _on_any(task, num_envs, device, dtype, **options):
    return on_processor(task, num_envs, dtype=dtype, **options)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu(capsys):
    with pytest.raises(ValueError, match=r"this machine has no device 'cuda': .* or leave device out"):
        TorchVectorEnv(BAR.id, 2, device="cuda")
    for device in ("meta", "gpu", torch.device("mps")):
        with pytest.raises(ValueError, match=f"device must be 'cpu' or 'cuda', got '{device}'"):
            TorchVectorEnv(BAR.id, 2, device=device)
    for device in ("cpu:0", torch.device("cpu", 0)):
        assert TorchVectorEnv(BAR.id, 2, device=device).device.type == "cpu"
    with pytest.raises(ValueError, match=r"on the CPU dtype must be torch\.float64, got torch\.float32"):
        TorchVectorEnv(BAR.id, 2, dtype=torch.float32)
    for given, message in (
        (["--device", "cuda"], "--device: this machine has no device 'cuda'"),
        (["--device", "cpu"], "--device must be cuda or cuda:N, got 'cpu'; leave it out for the processor"),
        (["--device", "cuda:x"], "--device: device must be 'cpu' or 'cuda', got 'cuda:x'"),
        (["--device", "cuda", "--cold"], "--device cannot be combined with --cold"),
        (["--device", "cuda", "--quick", "--checkout", "."], "leave out IDs, --quick, --sizes"),
        (["--device", "cuda", "--sizes", "1", "--checkout", "."], "leave out IDs, --quick, --sizes"),
    ):
        assert cli.main(["bench", *given]) == 2
        assert message in capsys.readouterr().err


def on_gpu(test):
    """Mark a test that needs a GPU."""
    return pytest.mark.gpu(pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")(test))


def sampled(envs, task, count):
    """Return random actions of a batch, on the CPU."""
    envs.action_space.seed(0)
    return [actions_of(task, envs.action_space.sample()) for _ in range(count)]


@on_gpu
@pytest.mark.parametrize("kind", [*covering(PERFECT, engine), *map(slow, OWN)], ids=str)
@pytest.mark.parametrize("mode", MODES[:2])
def test_a_gpu_has_the_same_bits(kind, mode):
    there = TorchVectorEnv(kind, 1000, device="cuda", autoreset_mode=mode)
    here = on_processor(kind, 1000, autoreset_mode=mode)
    assert torch.equal(there.reset(seed=1)[0].cpu(), here.reset(seed=1))
    for actions in sampled(there, here.task, 100):
        found, expected = there.step(actions.cuda()), here.step(actions)
        assert all(torch.equal(a.cpu(), b) for a, b in zip(found[:4], expected[:4], strict=True))
        assert found[4].keys() == expected[4].keys()
        assert all(torch.equal(found[4][name].cpu(), expected[4][name]) for name in expected[4])
        assert torch.equal(there.state.cpu(), here.state)


@on_gpu
@pytest.mark.parametrize("id", covering(PERFECT, engine))
def test_a_gpus_single_precision_is_the_processors_to_rounding(id):
    """Its sines and products differ in the last bit. Each step starts from the same numbers."""
    there = TorchVectorEnv(id, 1000, device="cuda", dtype=torch.float32, autoreset_mode="SameStep")
    here = on_processor(id, 1000, dtype=torch.float32, autoreset_mode="SameStep")
    assert torch.allclose(there.reset(seed=1)[0].cpu(), here.reset(seed=1), rtol=1e-6, atol=1e-6)
    for actions in sampled(there, here.task, 100):
        here.rows.copy_(there.envs.rows)
        found, expected = there.step(actions.cuda()), here.step(actions)
        assert not found[4]["refused"].any()
        assert (found[2].cpu() == expected[2]).float().mean() > 0.99  # some states are at the edge
        same = found[2].cpu() == expected[2]
        off = (there.state.cpu() - here.state).abs() / here.state.abs().amax(dim=0).clamp(min=1.0)
        assert off[same].median() < 1e-6 and off[same].max() < 1e-3


@on_gpu
def test_a_gpus_steps_may_be_recorded_in_a_graph_and_run_in_any_stream_and_thread():
    envs = TorchVectorEnv(BAR.id, 1000, device="cuda", autoreset_mode="SameStep")
    other = TorchVectorEnv(BAR.id, 1000, device="cuda", autoreset_mode="SameStep")
    actions = torch.rand(1000, 1, dtype=torch.float64, device="cuda") * 2 - 1
    for one in (envs, other):
        one.reset(seed=1)
        one.step(actions)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        recorded = envs.step(actions)
    side = torch.cuda.Stream()

    def step_aside():  # a thread has its own current stream
        with torch.cuda.stream(side):
            return other.step(actions)

    with ThreadPoolExecutor(1) as pool:
        for _ in range(30):
            graph.replay()
            torch.cuda.synchronize()
            found = pool.submit(step_aside).result()
            side.synchronize()
            assert all(torch.equal(a, b) for a, b in zip(found[:4], recorded[:4], strict=True))
    assert torch.equal(envs.state, other.state)
