"""Environments on tensors: equal to the environments, and with gradients."""

import copy
import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from covering import slow
from gymnasium.error import ResetNeeded

import lag_envs
from lag_envs.envs.model import Model
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pivoted_bar
from lag_envs.tasks.cart_pole import CartPoleContinuous, CartPoleExact

torch = pytest.importorskip("torch")

from lag_envs.torch import Step, TorchVectorEnv  # noqa: E402

KICKED = [name for name, kind in TASKS.items() if kind.draws and not kind.imperfections]


class Braked(pivoted_bar.SwingUp):
    """Kicks that depend on the state."""

    id, draws = "Braked-v0", 1

    def kick(self, after, draws, xp):
        return {"theta_dot": -0.1 * after.theta_dot * draws[0]}


#: One with a closed form, and one of the general series.
IDS = ["PivotedBar-v0", slow(CartPoleContinuous.id)]


@pytest.fixture(scope="module")
def step():
    return Step(IDS[0])


def near(n, seed=0):
    rng = np.random.default_rng(seed)
    states = np.array([0.0, 0.0, np.pi, 0.0]) + rng.uniform(-0.5, 0.5, (n, 4))
    return (torch.tensor(x, requires_grad=True) for x in (states, rng.uniform(-0.9, 0.9, (n, 1))))


@pytest.mark.parametrize("env_id", IDS)
def test_gradcheck(env_id, step):
    step = step if env_id == IDS[0] else Step(env_id)
    assert torch.autograd.gradcheck(lambda *given: step(*given)[:3], tuple(near(2)), rtol=1e-5)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, for jacfwd
def test_torch_func(step):
    states, actions = near(3)
    whole = torch.func.vmap(torch.func.jacrev(lambda s, a: step(s, a).states, argnums=(0, 1)))
    by_state, by_action = whole(states, actions)
    assert by_state.shape == (3, 4, 4) and by_action.shape == (3, 4, 1)
    for i in range(3):
        rows = torch.autograd.functional.jacobian(lambda s, a: step(s, a).states, (states[i], actions[i]))
        torch.testing.assert_close(rows[0], by_state[i], rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(rows[1], by_action[i], rtol=1e-14, atol=1e-14)
    # A batch of batches, with one of them shared by all.
    nested = torch.func.vmap(lambda a: step(states, a).rewards)(torch.stack([actions, -actions]))
    torch.testing.assert_close(nested[0], step(states, actions).rewards)
    assert torch.func.vmap(lambda s, a: step(s, a).rewards)(states[:0], actions[:0]).shape == (0,)
    slope = torch.func.grad(lambda s: step(s, actions[0]).rewards)(states[0])
    torch.testing.assert_close(slope, torch.autograd.grad(step(states[0], actions[0]).rewards, states)[0][0])
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        (once,) = torch.autograd.grad(step(states, actions).rewards.sum(), states, create_graph=True)
        once.sum().backward()
    envs = TorchVectorEnv(step.task.id, 3)
    envs.reset(seed=0)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        torch.autograd.grad(envs.step(actions)[1].sum(), actions, create_graph=True)
    for forward in (torch.func.jacfwd, torch.func.hessian):
        with pytest.raises(NotImplementedError, match="no forward mode and no second derivatives"):
            forward(lambda s: step(s, actions[0]).rewards)(states[0])


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, for forward_ad
def test_environments_refuse_what_would_lose_gradients(step):
    """Tangents of forward mode, and transforms of torch.func."""
    envs, (states, actions) = TorchVectorEnv(step.task.id, 2), (x.detach() for x in near(2))
    envs.reset(seed=0)
    before = envs.state.clone()
    with torch.autograd.forward_ad.dual_level():
        for call, given in [(envs.step, actions), (lambda x: envs.reset(options={"state": x}), states)]:
            with pytest.raises(NotImplementedError, match=r"no forward mode .* use jacrev"):
                call(torch.autograd.forward_ad.make_dual(given, torch.ones_like(given)))
        envs.reset(options={"state": before})  # without a tangent
    total = {"grad": lambda a: envs.step(a)[1].sum(), "vmap": lambda a: envs.step(a)[1]}
    for name, rewards in total.items():
        with pytest.raises(NotImplementedError, match=r"inside torch\.func .* use lag_envs\.torch\.Step"):
            getattr(torch.func, name)(rewards)(actions[None] if name == "vmap" else actions)
    assert torch.equal(envs.state, before)
    assert torch.isfinite(envs.step(actions)[1]).all()


def test_a_step_of_a_class(step):
    found = Step(type(step.task), damping=0.1)
    assert found.task.scene.damping == 0.1 and type(found.task) is type(step.task)


def test_negated_views(step):
    """As actions, and as the gradient that torch passes to a step from complex numbers."""
    states, actions = near(2)
    envs = TorchVectorEnv(IDS[0], 2)
    envs.reset(seed=0)
    start = envs.get_state()
    for rewards in (step(states, actions).rewards, envs.step(actions)[1]):
        turned = torch.complex(torch.zeros_like(rewards), rewards).conj().imag
        (slope,) = torch.autograd.grad(turned.sum(), actions, retain_graph=True)
        assert torch.equal(slope, -torch.autograd.grad(rewards.sum(), actions)[0])
    found = step(states, torch._neg_view(actions)).rewards
    assert torch.equal(found, step(states, -actions).rewards)
    envs.set_state(start)
    found = envs.step(torch._neg_view(actions.detach()))[1]
    envs.set_state(start)
    assert torch.equal(found, envs.step(-actions.detach())[1])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies(step, copied):
    """Of what has derivatives compiled, and of states with a history."""
    states, actions = near(2)
    slopes = [torch.autograd.grad(s(states, actions).rewards.sum(), states)[0] for s in (step, copied(step))]
    assert torch.equal(*slopes)
    envs = TorchVectorEnv(IDS[0], 2)
    envs.reset(seed=0)
    envs.step(actions)
    again = copied(envs)
    assert envs.state.requires_grad and not again.state.requires_grad
    assert torch.equal(envs.step(actions)[0], again.step(actions)[0])


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("mode", ["NextStep", slow("SameStep")])
def test_numbers_are_those_of_the_environment(env_id, mode):
    envs = TorchVectorEnv(env_id, 5, autoreset_mode=mode, duration=0.5)
    plain = gym.make_vec(env_id, 5, autoreset_mode=mode, duration=0.5)
    found, expected = envs.reset(seed=3)[0], plain.reset(seed=3)[0]
    np.testing.assert_array_equal(found.numpy(), expected)
    push = torch.zeros(1, requires_grad=True)
    rng = np.random.default_rng(0)
    for i in range(60):
        actions = torch.tensor(rng.uniform(-1.0, 1.0, (5, 1)), dtype=torch.float32) + (push if i > 20 else 0)
        found, expected = envs.step(actions), plain.step(actions.detach().numpy())
        for x, y in zip(found[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(x.detach().numpy(), y)
        np.testing.assert_array_equal(envs.state.detach().numpy(), plain.unwrapped.state)
    (slope,) = torch.autograd.grad(found[1].sum(), push)
    assert torch.isfinite(slope).all() and slope.abs() > 0.0


def test_types_of_results():
    envs = TorchVectorEnv(IDS[0], 3)
    observations, _ = envs.reset(seed=0)
    results = envs.step(torch.zeros(3, 1))
    assert all(not x.requires_grad for x in results[:4])
    assert [x.dtype for x in results[:4]] == [torch.float32, torch.float64, torch.bool, torch.bool]
    assert observations.shape == (3, 5)


@pytest.mark.parametrize("env_id", [pivoted_bar.SwingUp.id, slow(pivoted_bar.Balance.id)])
def test_gradient_of_an_episode(env_id):
    """Through ten steps, kicks included, by differences of the environment itself."""
    envs = TorchVectorEnv(env_id, 3)

    def total(actions):
        envs.reset(seed=1)
        return sum((2.0 * r).sum() + envs.state.sum() for r in (envs.step(a)[1] for a in actions))

    actions = (0.3 * torch.ones(10, 3, 1, dtype=torch.float64)).requires_grad_()
    (slope,) = torch.autograd.grad(total(actions), actions)
    direction = torch.tensor(np.random.default_rng(2).uniform(-1.0, 1.0, actions.shape))
    h = 1e-5
    with torch.no_grad():
        difference = (total(actions + h * direction) - total(actions - h * direction)) / (2.0 * h)
    torch.testing.assert_close((slope * direction).sum(), difference, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("env_id", [KICKED[0], *map(slow, KICKED[1:])])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_kicks_come_from_the_environments_random_numbers(mode, env_id):
    """The gradient of each step is that at the end before the kick, also where episodes end and begin."""
    envs = TorchVectorEnv(env_id, 32, autoreset_mode=mode, max_episode_steps=20)
    envs.reset(seed=0)
    model, made, rng = envs.model, envs.envs, np.random.default_rng(0)
    for _ in range(50):
        ended, clock, states = made.ended, made.clock, envs.state.numpy()
        actions = torch.tensor(rng.uniform(-1.0, 1.0, envs.action_space.shape)).requires_grad_()
        _, rewards, *over, _ = envs.step(actions)
        (slope,) = torch.autograd.grad(rewards.sum(), actions)
        envs.detach()
        went_on = ~(over[0] | over[1]).numpy() if mode == "SameStep" else np.ones(32, bool)
        stepped = np.ones(32, bool) if ended is None else ~ended
        given = states, actions.detach().numpy()[:, 0]
        ends, _, _ = model(*given)
        kicked = (ends + model.kicks(*clock))[stepped & went_on]
        np.testing.assert_allclose(made.state[stepped & went_on], kicked, rtol=1e-12, atol=1e-12)
        expected = model.vjp(*given, ends=ends, by_rewards=1.0).actions
        np.testing.assert_allclose(slope[stepped, 0].numpy(), expected[stepped], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_no_gradient_through_an_end(mode):
    envs = TorchVectorEnv(IDS[0], 2, autoreset_mode=mode, max_episode_steps=3)
    envs.reset(seed=0)
    actions = torch.full((6, 2, 1), 0.5, requires_grad=True)
    rewards = [envs.step(a)[1].sum() for a in actions]
    (slope,) = torch.autograd.grad(rewards[5], actions, retain_graph=True)
    # With NextStep the fourth step is a restart, which takes no action.
    assert (slope[:3] == 0.0).all() and (slope[4:] != 0.0).all()
    assert (slope[3] == 0.0).all() == (mode == "NextStep")
    (slope,) = torch.autograd.grad(rewards[2], actions)  # the last step's own reward
    assert (slope[:3] != 0.0).all()


def test_inference_mode():
    envs, plain = (TorchVectorEnv(IDS[0], 2) for _ in range(2))
    for each in (envs, plain):
        each.reset(seed=0)
    with torch.inference_mode():
        envs.step(torch.zeros(2, 1))
        envs.reset(seed=1)
        found = envs.step(torch.full((2, 1), 0.3))
    plain.reset(seed=1)
    assert all(
        torch.equal(a, b) for a, b in zip(found[:4], plain.step(torch.full((2, 1), 0.3))[:4], strict=True)
    )
    action = torch.full((2, 1), 0.3, requires_grad=True)
    assert envs.step(action)[1].requires_grad


def test_masks_that_leave_no_environment_may_come_first():
    whole = np.array([True, True])
    envs, others = TorchVectorEnv(IDS[0], 2), TorchVectorEnv(IDS[0], 2)
    envs.reset(seed=0, options={"reset_mask": whole})
    others.set_state(envs.get_state(), mask=whole)
    assert torch.equal(envs.state, others.state)


@pytest.mark.parametrize(
    "env_id", [pivoted_bar.SwingUp.id, slow(pivoted_bar.SwingUpFree.id), slow(CartPoleContinuous.id)]
)
def test_a_loss_that_is_not_a_number_has_no_gradient(env_id):
    """Also where a guard chooses between two controls, and where the motion is the general series."""
    envs = TorchVectorEnv(env_id, 2)
    envs.reset(seed=0)
    actions = torch.full((2, 1), 0.3, requires_grad=True)
    (envs.step(actions)[1] * torch.tensor([math.nan, 1.0])).sum().backward()
    assert actions.grad[0].isnan() and actions.grad[1].isfinite()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("seed", [math.nan, math.inf, 1e308])
def test_a_gradient_that_is_not_finite_stays_in_its_row(env_id, step, seed):
    step = step if env_id == IDS[0] else Step(env_id)
    given = tuple(near(2))
    plain = torch.autograd.grad(step(*given).states.sum(), given)
    found = torch.autograd.grad((step(*given).states * torch.tensor([[1.0], [seed]])).sum(), given)
    for by, expected in zip(found, plain, strict=True):
        torch.testing.assert_close(by[0], expected[0], rtol=1e-14, atol=1e-14)
        assert not by[1].isfinite().all()


def test_targets_may_be_tensors():
    envs = TorchVectorEnv(incline.Tilt.id, 2)
    for target in (torch.tensor([0.1, 0.2], requires_grad=True), torch.tensor(0.1)):
        envs.reset(options={"target": {"target": target}})
        np.testing.assert_array_equal(envs.envs.target, target.expand(2).detach().to(torch.float64))


def test_detach_cuts_gradients():
    envs = TorchVectorEnv(IDS[0], 2)
    envs.reset(seed=0)
    first, second = (torch.full((2, 1), 0.5, requires_grad=True) for _ in range(2))
    envs.step(first)
    envs.detach()
    reward = envs.step(second)[1].sum()
    assert torch.autograd.grad(reward, first, allow_unused=True, retain_graph=True) == (None,)
    assert torch.autograd.grad(reward, second)[0].abs().min() > 0.0


def test_gradient_by_the_start():
    envs = TorchVectorEnv(IDS[0], 2)
    start = torch.tensor([[0.0, 0.0, 3.0, 0.1]] * 2, dtype=torch.float64, requires_grad=True)
    envs.reset(seed=0, options={"state": start})
    (slope,) = torch.autograd.grad(envs.step(torch.zeros(2, 1))[1].sum(), start)
    found = Model(TASKS[IDS[0]]()).vjp(start.detach().numpy(), [0.0, 0.0], by_rewards=1.0)
    np.testing.assert_allclose(slope.numpy(), found.states, rtol=1e-14)
    with pytest.raises(ValueError, match=r"result of other operations: give state.detach\(\)"):
        envs.reset(options={"state": 2.0 * start})


@pytest.mark.parametrize(
    "way", ["set_state", "masked", "envs.set_state", "envs.reset", "envs.step", "in place"]
)
@pytest.mark.parametrize("history", [False, True])
def test_gradients_are_those_at_the_environments_state(way, history):
    envs, start = TorchVectorEnv(IDS[0], 2), np.array([[0.0, 0.0, 3.0, 0.1], [0.0, 0.0, 0.1, 0.0]])
    envs.reset(options={"state": start})
    snapshot, push = envs.get_state(), torch.full((2, 1), 0.3, requires_grad=True)
    for _ in range(10):
        envs.step(push if history else push.detach())
    own = way in ("set_state", "masked")
    if own:
        envs.set_state(snapshot, torch.tensor([True, way == "set_state"]))
    elif way == "envs.set_state":
        envs.envs.set_state(snapshot)
    elif way == "envs.reset":
        envs.envs.reset(options={"state": start})
    elif way == "envs.step":
        envs.envs.step(np.zeros((2, 1), np.float32))
    else:
        envs.state.detach().mul_(2.0)
    if history and not own:
        with pytest.raises(RuntimeError, match=r"call detach\(\) to continue"):
            envs.step(push)
        envs.detach()
    now = envs.envs.state
    np.testing.assert_array_equal(envs.state.detach().numpy(), now)
    action = torch.full((2, 1), 0.5, requires_grad=True)
    reward = envs.step(action)[1]
    slope, before = torch.autograd.grad(reward.sum(), (action, push), allow_unused=True)
    expected = Model(TASKS[IDS[0]]()).vjp(now, [0.5, 0.5], by_rewards=1.0).actions
    np.testing.assert_allclose(slope[:, 0].numpy(), expected, rtol=1e-6)
    # What was set has no history, and the rest of a batch keeps its own.
    assert (before is None) == (not own or not history)
    assert before is None or (before.tolist()[0] == [0.0] and (before[1] != 0.0) == (way == "masked"))


def test_states_cannot_be_assigned():
    envs = TorchVectorEnv(IDS[0], 2)
    with pytest.raises(AttributeError, match=r"call reset\(options=\{'state': ...\}\), or set_state"):
        envs.state = torch.zeros(2, 4)


@pytest.mark.parametrize("state", [[0.0, 0.0, np.pi, 0.0], [0.0, 0.0, 0.0, 0.0], [0.2, 0.5, 1.0, -2.0]])
def test_float32_at_ordinary_states(step, state):
    """Upright, hanging at rest: nothing is NaN, and all is near the float64 gradient."""
    slopes = {}
    for kind in (torch.float32, torch.float64):
        given = [torch.tensor(x, dtype=kind, requires_grad=True) for x in (state, [0.0])]
        found = step(*given)
        assert found.states.dtype == found.rewards.dtype == kind
        total = found.states.sum() + found.rewards + found.observations.sum()
        slopes[kind] = torch.autograd.grad(total, given)
    for narrow, wide in zip(*slopes.values(), strict=True):
        torch.testing.assert_close(narrow.double(), wide, rtol=1e-5, atol=1e-5)


def test_gradients_where_a_distance_is_zero():
    """At rest at the goal, the tip of a cone: float32 and float64 agree, and nothing is NaN."""
    given = [torch.zeros(n, requires_grad=True) for n in (2, 1)]
    step = Step(cylinder_in_cylinder.Damping.id)
    found = step(*given)
    (by_state,) = torch.autograd.grad(found.states.sum(), given[:1], retain_graph=True)
    (slope,) = torch.autograd.grad(found.rewards, given[:1])
    A, _ = step.task.scene.jacobian([0.0, 0.0], 1.2, step.task.dt)
    np.testing.assert_allclose(by_state.numpy(), A.sum(axis=0), rtol=1e-6)
    assert found.rewards == 1.0 and slope.tolist() == [0.0, 0.0]


def test_errors(step):
    states, actions = (x.detach() for x in near(2))
    with pytest.raises(TypeError, match=r"states must be a tensor, got ndarray; torch\.as_tensor"):
        step(states.numpy(), actions)
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 1\), got \(2,\)"):
        step(states, actions[:, 0])
    with pytest.raises(ValueError, match=r"actions must have shape \(1,\), got \(5, 1\)"):
        step(torch.zeros(4), torch.zeros(5, 1))
    with pytest.raises(ValueError, match=r"states must have shape \(..., 4\), got \(2, 3\)"):
        step(states[:, :3], actions)
    with pytest.raises(TypeError, match=r"states must be float32 or float64, got torch\.int64"):
        step(states.long(), actions)
    with pytest.raises(ValueError, match="states must be on the CPU, got a tensor on meta"):
        step(states.to("meta"), actions)
    with pytest.raises(TypeError, match=r"states must be dense, .* torch\.sparse_coo; call \.to_dense\(\)"):
        step(states.to_sparse(), actions)
    bar = step.task.scene
    for given, reason in [
        (states.to_sparse(), r"Use Tensor\.to_dense\(\) first"),
        (states.clone().requires_grad_(), r"Use tensor\.detach\(\)\.numpy\(\) instead"),
    ]:
        with pytest.raises(ValueError, match=rf"(?s)state must be real numbers, got tensor.*{reason}"):
            bar.vjp(given, actions, 0.02, states)
        with pytest.raises(ValueError, match=rf"(?s)cotangent must be real numbers, got tensor.*{reason}"):
            bar.vjp(states, actions, 0.02, given)
    with pytest.raises(ValueError, match=r"states must be finite, got .* in row 1"):
        step(states * torch.tensor([[1.0], [float("nan")]]), actions)
    with pytest.raises(ValueError, match="list of actions to choose from"):
        TorchVectorEnv(CartPoleExact.id, 2)
    with pytest.raises(ValueError, match="imperfect sensors, imperfect actuators or hidden parameters"):
        TorchVectorEnv(IDS[0], 2, action_delay=0.02)
    with pytest.raises(ValueError, match="the kick of Braked-v0 depends on the state"):
        TorchVectorEnv(lag_envs.register(Braked), 2)
    with pytest.raises(ValueError, match="give one value for all"):
        TorchVectorEnv(IDS[0], 2, damping=[0.0, 0.1])
    with pytest.raises(ValueError, match="not an environment of this package"):
        TorchVectorEnv("Pendulum-v1", 2)
    with pytest.raises(ValueError, match="Pendulum-v1 has no derivatives: it is not an environment"):
        Step("Pendulum-v1")
    with pytest.raises(ValueError, match="options go with an id"):
        Step(step.task, damping=0.1)
    with pytest.raises(ValueError, match="or as the class itself, its parameters as keywords, got <"):
        TorchVectorEnv(step.task, 2)
    envs = TorchVectorEnv(IDS[0], 2)
    with pytest.raises(TypeError, match=r"options must be a dict or None, got \[1\]"):
        envs.reset(options=[1])
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        _ = envs.state
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 1\), got \(3, 1\)"):
        envs.step(torch.zeros(3, 1))
