"""PPO in one file, for every kind of action; and that all our learners repeat and resume bit for bit."""

import json
import re
from copy import deepcopy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from covering import slow
from trainings import OTHERS, go, here, kill_and_interrupt, short_evaluations

import lag_envs
from agents import learners, ppo, race, submit, train, tune
from agents.learners import load_policy, zoo_hyperparameters
from agents.policy import Policy
from agents.run import CHECKPOINT, MODEL, RESULT, Run, UserError, fresh_seeds
from lag_envs import TASKS, watch
from lag_envs.evaluation.rollout import play
from lag_envs.leaderboard.export import ExportError, arrays_of, export, exported, find
from lag_envs.leaderboard.policies import architecture
from lag_envs.leaderboard.submission import load
from lag_envs.scenes import Scene
from lag_envs.scores import score
from lag_envs.tasks import Task, arm, cart_pole, pendulum, pivoted_bar

ROOT = Path(__file__).parents[1]
ENV = pivoted_bar.SwingUpFree.id
#: For trainings that take a fraction of a second.
SHORT = {"n_envs": 8, "n_steps": 16, "n_epochs": 2, "batch_size": 64}


class Puck(Scene):
    """A point mass on a table, pushed along both of its sides."""

    coordinates = {"x": "m", "y": "m"}
    controls = {"along": "N", "across": "N"}

    def kinetic(self, q, v, xp):
        return 0.5 * (v.x**2 + v.y**2)

    def potential(self, q, xp):
        return 0.0

    def applied(self, q, v, u, xp):
        return {"x": u.along, "y": u.across}


class Centre(Task):
    """Bring the puck to the middle."""

    id = "OwnCentre-v0"
    scene = Puck
    interval, steps = 0.1, 30
    action = {"along": 2.0, "across": 2.0}
    start = {"x": 1.0, "y": 1.0}

    def observe(self, after, target, xp):
        return {name: after[name] for name in self.scene.state_names}

    def reward(self, before, after, control, target, dt, xp):
        return xp.exp(-(after.x**2) - after.y**2)


class Jerky(Centre):
    """The same with a few pushes to choose from, more of them to one side."""

    id = "OwnJerky-v0"
    action = {"along": [-1.0, 0.0, 1.0], "across": [-1.0, 1.0]}


class Row(Centre):
    """The same on a line."""

    id = "OwnRow-v0"
    action = {"along": [-1.0, 0.0, 1.0]}
    start = {"x": 1.0}


short = short_evaluations(20)


@pytest.fixture
def own():
    """Register the tasks of this file."""
    for task in (Centre, Jerky, Row):
        lag_envs.register(task)


def make_run(folder, env_id=ENV, seed=3, steps=768, algo=ppo.NAME, **more):
    hyper = zoo_hyperparameters(algo, env_id) | OTHERS.get(algo, SHORT) | more
    return Run(Path(folder), env_id, algo, seed, steps, hyper)


def learnt(run):
    """Return all results of a finished run, without times."""
    result = json.loads(run.path(RESULT).read_text())
    with np.load(run.path(MODEL)) as found:
        weights = {name: found[name].tobytes() for name in found}
    return (
        weights,
        result["evaluation"]["returns"],
        [(s, r) for s, _, r in result["curve"]],
        result["trained"],
    )


# --- runs ---


@pytest.mark.parametrize(
    ("algo", "more"), [(ppo.NAME, {}), slow(ppo.NAME, {"frames": 3}), *(slow(name, {}) for name in OTHERS)]
)
def test_a_seed_decides_everything_with_interruptions_or_without(algo, more, tmp_path):
    def made(name, seed=3):
        return make_run(tmp_path / name, seed=seed, algo=algo, **more)

    whole, again, other = made("a"), made("b"), made("c", seed=4)
    assert go(whole) and go(again) and go(other)
    assert learnt(whole) == learnt(again) != learnt(other)
    cut, before = made("d"), 0
    for until in (384, 640):  # in the middle of episodes, each time a step behind the last checkpoint
        assert not go(cut, until)
        cut = made("d")
        assert cut.load_checkpoint() is not None and before < cut.trained <= until
        before = cut.trained
    torch.manual_seed(0)
    assert go(cut) and not cut.path(CHECKPOINT).exists()
    assert learnt(cut) == learnt(whole)
    assert cut.seconds > 0.0
    assert play(ENV, load_policy(whole.folder), fresh_seeds(20)).tolist() == learnt(whole)[1]


def test_a_checkpoint_that_does_not_fit_is_told_in_a_line(tmp_path):
    other = make_learner(pivoted_bar.SwingUp.id)
    make_run(tmp_path).save_checkpoint({"learner": other.state()})
    with pytest.raises(UserError, match=r"cannot be resumed \(.*\); --new starts over"):
        go(make_run(tmp_path))


@pytest.mark.parametrize(
    ("task", "frames"), [(TASKS[ENV], 1), (TASKS[ENV], 3), (Centre, 1), (Jerky, 1), (Row, 3)]
)
def test_the_policy_that_was_written_is_the_one_that_was_evaluated(task, frames, own, tmp_path):
    run = make_run(tmp_path, task.id, frames=frames)
    go(run)
    result = json.loads(run.path(RESULT).read_text())
    policies = [load_policy(tmp_path), watch.load_agent(task.id, task(), str(tmp_path))[1]]
    if task.id in TASKS:
        policies.append(exported(find([tmp_path])[0], task.id).agent)
    for policy in policies:
        assert play(task.id, policy, fresh_seeds(20)).tolist() == result["evaluation"]["returns"]
    with pytest.raises(UserError, match=f"is an agent of {task.id}, not of Other-v0"):
        watch.load_agent("Other-v0", Centre(), str(tmp_path))
    other = {Centre: TASKS[ENV], Jerky: Row, Row: Jerky}.get(task, Centre)
    with pytest.raises(UserError, match=f"do not fit {other.id}, which asks for"):
        watch.load_agent(other.id, other(), str(run.path(MODEL)))
    assert result["versions"]["torch"] and result["hyperparameters"] == run.hyperparameters


@pytest.mark.parametrize(
    ("env_id", "space"),
    [
        slow(Centre.id, gym.spaces.Box(-1.0, 1.0, (2,), np.float32)),
        (Jerky.id, gym.spaces.MultiDiscrete([3, 2])),
        slow(Row.id, gym.spaces.Discrete(3)),
    ],
)
def test_it_learns_with_any_actions(env_id, space, own, tmp_path):
    """A second of training achieves more than half of the distance from idling to the best."""
    assert gym.make_vec(env_id, 2).single_action_space == space
    settings = {"n_envs": 16, "n_steps": 32, "batch_size": 128, "n_epochs": 5, "episode_share": 1.0}
    run = make_run(tmp_path, env_id, steps=6_000, **settings)
    learner = ppo.Learner(env_id, ppo.Settings.of(run.hyperparameters), 0, run.steps)
    before = play(env_id, learner.policy, fresh_seeds(100)).mean()
    while learner.trained < run.steps:
        learner.iterate()
    after = play(env_id, learner.policy, fresh_seeds(100)).mean()
    assert after > before + 0.5 * (Centre.steps - before), (before, after)


@pytest.mark.slow
def test_it_swings_the_bar_up(tmp_path, monkeypatch):
    """Seeds not used for tuning; some get stuck where the bar passes the top slowly again and again."""
    monkeypatch.setattr(learners, "EPISODES", 100)
    env_id = pivoted_bar.SwingUp.id
    scores = []
    for seed in range(300, 305):
        hyper = zoo_hyperparameters(ppo.NAME, env_id)
        run = Run(tmp_path / str(seed), env_id, ppo.NAME, seed, int(hyper["n_timesteps"]), hyper)
        go(run)
        scores.append(score(env_id, json.loads(run.path(RESULT).read_text())["mean_return"]))
    assert np.median(scores) > 0.97, scores


# --- parts ---


def make_learner(env_id=ENV, **more):
    settings = ppo.Settings.of(zoo_hyperparameters(ppo.NAME, env_id) | SHORT | more)
    return ppo.Learner(env_id, settings, 0, 10_000)


@pytest.mark.parametrize("td_lambda", [None, 0.95])
def test_advantages_are_sums_of_later_surprises(td_lambda):
    """Against the definition, with episodes that are terminated, truncated and cut by the roll-out."""
    learner = make_learner(n_steps=6, n_envs=2, batch_size=4, gamma=0.9, gae_lambda=0.8, td_lambda=td_lambda)
    rng = np.random.default_rng(0)
    shape, wide = (6, 2), learner.observation.shape[1]
    over, terminated = np.zeros(shape, bool), np.zeros(shape, bool)
    over[2, 0] = over[3, 1] = terminated[3, 1] = True
    draw = lambda *size: rng.normal(size=size).astype(np.float32)  # noqa: E731
    found = ppo.Experience(
        draw(7, 2, wide), draw(*shape, 1), draw(*shape), terminated, over, draw(*shape, wide)
    )
    advantages, targets = learner.advantages(found)

    def value(observation):
        return learner.critic(torch.from_numpy(observation)).item()

    def total(t, i, decay):
        total, weight = 0.0, 1.0
        for k in range(t, 6):
            after = found.final[k, i] if over[k, i] else found.observations[k + 1, i]
            rest = 0.0 if terminated[k, i] else 0.9 * value(after)
            total += weight * (found.rewards[k, i] + rest - value(found.observations[k, i]))
            weight *= 0.9 * decay
            if over[k, i]:
                break
        return total

    for i in range(2):
        for t in range(6):
            assert advantages[t, i] == pytest.approx(total(t, i, 0.8), abs=1e-5)
            expected = total(t, i, td_lambda or 0.8) + value(found.observations[t, i])
            assert targets[t, i] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("mean", "limit_coef", "moves"), [(3.0, 1.0, -1), (-3.0, 1.0, 1), (3.0, 0.0, 0), (0.9, 1.0, 0)]
)
def test_means_beyond_the_limits_cost_something(mean, limit_coef, moves):
    """Where nothing else is to be learned, means beyond the limits move back, and others stay."""
    learner = make_learner(n_steps=4, n_envs=2, batch_size=8, n_epochs=1, limit_coef=limit_coef)
    last = learner.actor[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(mean)
    found = learner.collect()
    nothing = np.zeros_like(found.rewards)
    learner.update(found, nothing, nothing)
    assert np.sign(last.bias.item() - np.float32(mean)) == moves


def test_rollouts_are_what_happened():
    learner = make_learner(episode_share=0.02)  # episodes of ten steps
    first = learner.observation.copy()
    found = learner.collect()
    assert np.array_equal(found.observations[0], first)
    assert np.array_equal(found.observations[-1], learner.observation)
    assert found.over.sum() in range(8, 17) and not found.terminated.any()
    assert (found.final[found.over] != 0.0).any(axis=1).all() and not found.final[~found.over].any()
    # The final observation ends the old episode, the next one begins the new.
    t, i = np.argwhere(found.over[:-1])[0]
    assert not np.array_equal(found.final[t, i], found.observations[t + 1, i])
    assert len({tuple(np.flatnonzero(row)) for row in found.over}) > 2  # staggered


def test_a_reward_that_is_no_number_is_named(monkeypatch):
    learner = make_learner()
    step = learner.envs.step

    def undefined(actions):
        observation, reward, *rest = step(actions)
        return observation, np.where(np.arange(8) == 3, np.nan, reward), *rest

    monkeypatch.setattr(learner.envs, "step", undefined)
    with pytest.raises(UserError, match=f"the reward of {ENV} is nan; it must be a finite number"):
        learner.iterate()


def test_frames_are_the_last_observations_of_an_episode(monkeypatch):
    learner, stepped = make_learner(episode_share=0.02, frames=3), []
    wide, step = learner.observation.shape[1] // 3, learner.envs.step

    def noted(actions):
        result = step(actions)
        stepped.append(deepcopy(result))
        return result

    monkeypatch.setattr(learner.envs, "step", noted)
    seen = [[row[-wide:]] for row in learner.observation]

    def last(observations):
        return np.concatenate([*[np.zeros(wide)] * 3, *observations])[-3 * wide :]

    ended = 0
    for _ in range(2):
        stepped.clear()
        found = learner.collect()
        for t, (observation, _, terminated, truncated, infos) in enumerate(stepped):
            for i in range(8):
                assert np.array_equal(found.observations[t, i], last(seen[i]))
                if terminated[i] or truncated[i]:
                    ended += 1
                    assert np.array_equal(found.final[t, i], last([*seen[i], infos["final_obs"][i]]))
                    seen[i] = []
                seen[i].append(observation[i])
    assert np.array_equal(learner.observation, [last(rows) for rows in seen]) and ended > 16


@pytest.mark.parametrize("by_state", [True, False])
def test_noise_has_the_probability_that_is_told(by_state):
    learner = make_learner(state_noise=by_state, noise_steps=3)
    head, rng = learner.head, np.random.default_rng(0)
    hidden, means = (x.repeat(50_000, axis=0) for x in learner.policy.outputs(learner.observation[:1]))
    actions = head.sample(rng, 0, hidden, means)
    log_prob, entropy = (
        x.detach().double() for x in head.log_prob(*map(torch.from_numpy, (hidden, means, actions)))
    )
    # Up to a constant, the entropy is the mean of -log p, and both are those of a normal distribution.
    spread, mean = float(actions.std()), float(means[0, 0])
    normal = torch.distributions.Normal(mean, spread).log_prob(torch.from_numpy(actions[:, 0]))
    constant = 0.5 * np.log(2.0 * np.pi)
    assert abs(entropy[0].item() - np.log(spread)) < 0.02
    np.testing.assert_allclose(log_prob - constant, normal, atol=0.1)
    # Held for three steps, then drawn again.
    held = [head.sample(rng, t, hidden[:5], means[:5]) for t in range(6)]
    assert all(np.array_equal(held[t], held[0]) for t in (1, 2)) and not np.array_equal(held[3], held[2])


def test_choices_have_the_probability_that_is_told(own):
    learner = make_learner(Jerky.id)
    logits = np.array([[0.5, -1.0, 0.2, 1.5, 0.3]], np.float32)
    actions = learner.head.sample(np.random.default_rng(0), 0, logits, logits.repeat(100_000, axis=0))
    both, counts = np.unique(actions, axis=0, return_counts=True)
    assert len(both) == 6
    given = torch.from_numpy(logits.repeat(6, axis=0))
    log_prob, entropy = learner.head.log_prob(given, given, torch.from_numpy(both))
    np.testing.assert_allclose(log_prob.exp(), counts / 100_000, atol=0.006)
    np.testing.assert_allclose(entropy[0], -(log_prob.exp() * log_prob).sum(), rtol=1e-5)


def test_the_network_that_acts_is_the_one_that_learns():
    learner = make_learner()
    learner.iterate()
    seen = learner.observation
    by_torch = learner.actor(torch.from_numpy(seen)).detach().numpy()
    np.testing.assert_allclose(learner.policy.outputs(seen)[1], by_torch, atol=1e-5)


# --- the command, and its results ---


def test_command_trains_tells_two_clocks_and_keeps_what_is_finished(tmp_path, capsys):
    given = [ENV, "--output", str(tmp_path), "--steps", "256", "--seeds", "2", "--gamma", "0.9"]
    for name, value in SHORT.items():
        given += ["--" + name.replace("_", "-"), str(value)]
    assert ppo.main(given) == 0
    output = capsys.readouterr().out
    assert "256 steps" in output and ", score " in output and "with imports, compiling" in output
    result = json.loads((tmp_path / ENV / ppo.NAME / "seed1" / RESULT).read_text())
    assert result["hyperparameters"]["gamma"] == 0.9 and result["trained"] == 256
    assert ppo.main(given) == 0
    output = capsys.readouterr().out
    assert " steps, " not in output and output.count("finished before\n") == 2
    assert ppo.main([ENV, "--output", str(tmp_path), "--steps", "256"]) == 2
    assert "other hyperparameters (" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["PivotedBra-v0"], "did you mean PivotedBar-v0"),
        ([ENV, "--gamma", "1.5"], "gamma: Input should be less than or equal to 1, got 1.5"),
        ([ENV, "--frames", "0"], "frames: Input should be greater than or equal to 1, got 0"),
        (
            [ENV, "--n-envs", "100000000"],
            "n_envs: Input should be less than or equal to 100000, got 100000000",
        ),
        ([ENV, "--frames", "100"], "frames: Input should be less than or equal to 64, got 100"),
        ([ENV, "--actor", "2000"], "actor.0: Input should be less than or equal to 1024, got 2000"),
        ([ENV, "--actor", *["8"] * 9], "actor: List should have at most 8 items"),
        ([ENV, "--actor", "0"], "actor.0: Input should be greater than 0, got 0"),
        ([ENV, "--batch-size", "1000"], "batch_size must divide n_envs * n_steps = 6144, got 1000\n"),
    ],
)
def test_mistakes_are_named(given, message, tmp_path, capsys):
    assert ppo.main([*given, "--output", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_help_names_the_values_of_a_switch():
    assert "--state-noise yes|no" in ppo.parser().format_help()


def test_settings_of_another_kind_are_refused():
    good = zoo_hyperparameters(ppo.NAME, ENV)
    for changes, message in (
        ({"gama": 0.9}, "gama is an unknown key; did you mean gamma"),
        ({"state_noise": 1}, "state_noise: Input should be a valid boolean, got 1"),
        ({"n_steps": 2.5}, "n_steps: Input should be a valid integer, got 2.5"),
        ({"actor": 32}, "actor: Input should be a valid list, got 32"),
        ({"reward_scale": 0}, "reward_scale: Input should be greater than 0, got 0"),
        ({"clip_range": 0}, "clip_range: Input should be greater than 0, got 0"),
        ({"gamma": "x"}, "gamma: Input should be a valid number, got 'x'"),
    ):
        with pytest.raises(UserError, match=message):
            ppo.Settings.of(good | changes)
    del good["gamma"]
    with pytest.raises(UserError, match="settings of fast_ppo: gamma is missing"):
        ppo.Settings.of(good)


def test_without_an_end_or_a_control_there_is_nothing_to_learn():
    settings = ppo.Settings.of(zoo_hyperparameters(ppo.NAME, ENV) | SHORT)
    lag_envs.register(pivoted_bar.SwingUpFree, id="OwnEndless-v0", duration=float("inf"))
    with pytest.raises(UserError, match="have no end; give it a duration"):
        ppo.Learner("OwnEndless-v0", settings, 0, 100)


@pytest.mark.parametrize("frames", [1, slow(3)])
def test_five_seeds_are_a_submission(frames, tmp_path):
    for seed in range(5):
        go(make_run(tmp_path / "runs" / ENV / ppo.NAME / f"seed{seed}", seed=seed, frames=frames))
    made = submit.submit_learned(ENV, tmp_path / "runs" / ENV / ppo.NAME, tmp_path / "out")
    assert made.name == "fast PPO" and len(load(tmp_path / "out").policies) == 5
    seen = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)
    loaded = load_policy(tmp_path / "runs" / ENV / ppo.NAME / "seed2")
    submitted = dict(load(tmp_path / "out").policies)[2].agent()
    np.testing.assert_array_equal(loaded.predict(seen)[0], submitted.predict(seen)[0])
    # A file alone does not tell how long it was trained.
    file = tmp_path / "runs" / ENV / ppo.NAME / "seed2" / MODEL
    with pytest.raises(ExportError, match="not known how long it was trained; give --env-steps"):
        export(find([file]), tmp_path / "other", authors=["A"], license="MIT", env=ENV, seconds=1.0)


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("task", [pendulum.PendulumExact, cart_pole.CartPoleExact, arm.Reach])
def test_networks_of_any_actions_act_as_on_the_leaderboard(task, frames, tmp_path):
    """Actions beyond 1, actions from a list, two actions."""
    rng, formulas, wide = np.random.default_rng(0), task().formulas, len(task().observation)
    outputs, file = sum(formulas.choices) or formulas.actions, tmp_path / MODEL
    draw = lambda *size: rng.normal(size=size).astype(np.float32)  # noqa: E731
    layers = [(draw(8, frames * wide), draw(8)), (draw(outputs, 8), draw(outputs))]
    Policy(layers, formulas.choices, formulas.largest, frames).save(file)
    table, arrays = arrays_of(file)
    submitted, policy = architecture(task.id, table).agent(arrays), Policy.load(file)
    states = [None] * 4
    for _ in range(6):  # some episodes begin anew
        seen, start = draw(200, wide), rng.random(200) < 0.2
        loaded, states[0] = policy.predict(seen, states[0], start)
        expected, states[1] = submitted.predict(seen, states[1], start)
        np.testing.assert_array_equal(loaded, expected)
        assert np.ptp(loaded) >= formulas.largest
        # To the bit, however many act together.
        some, states[2] = policy.predict(seen[:7], states[2], start[:7])
        np.testing.assert_array_equal(loaded[:7], some)
        one, states[3] = policy.predict(seen[0], states[3], start[:1])
        np.testing.assert_array_equal(loaded[0], one)


def test_settings_are_tried_and_kept(tmp_path, monkeypatch, capsys):
    file = tmp_path / "tuning.json"
    monkeypatch.setattr(tune, "zoo_hyperparameters", lambda *_: zoo_hyperparameters(ppo.NAME, ENV) | SHORT)
    monkeypatch.setattr(tune, "CHOICES", {"gamma": (0.9, 0.95), "ent_coef": (0.1, 0.2), "critic": ([8], [9])})
    monkeypatch.setattr(tune.workers, "processes", here)
    given = [ENV, "--settings", "2", "--seeds", "1", "--steps", "256", "--episodes", "2"]
    given += ["--output", str(file)]
    assert tune.main(given) == 0
    first = json.loads(file.read_text())["settings"]
    assert [s["number"] for s in first] == [0, 1] and first[0]["changed"] == {} != first[1]["changed"]
    # More of them, or of seeds: earlier results are kept.
    given[2], given[4] = "3", "2"
    assert tune.main(given) == 0
    output = capsys.readouterr().out
    assert output.count("setting 0, seed 500: ") == 1 and output.count("setting 0, seed 501: ") == 1
    second = json.loads(file.read_text())["settings"]
    assert [[r["seed"] for r in s["runs"]] for s in second] == [[500, 501]] * 3
    assert [s["runs"][0] for s in second[:2]] == [s["runs"][0] for s in first]
    best = max(second, key=lambda s: sum(r["return"] for r in s["runs"]))
    assert output.splitlines()[-5].split()[0] == str(best["number"])  # the row below the head
    given[6] = "512"
    assert (
        tune.main(given) == 2
        and "belongs to a search with steps 256; choose another" in capsys.readouterr().err
    )
    file.write_text("{}")
    assert tune.main(given) == 2 and "cannot be read" in capsys.readouterr().err


def test_every_setting_that_may_be_drawn_is_one():
    for number in range(200):
        ppo.Settings.of(zoo_hyperparameters(ppo.NAME, ENV) | tune.drawn_changes(number))
    assert tune.drawn_changes(1) == tune.drawn_changes(1) != tune.drawn_changes(2)


@pytest.mark.parametrize("names", [("fast_ppo",), slow(("fast_ppo", "ppo"))])
def test_race_tells_when_levels_are_reached(names, tmp_path, monkeypatch, capsys):
    file, picture = tmp_path / "race.jsonl", tmp_path / "race.png"

    def short(name, env):
        return zoo_hyperparameters(name, env) | SHORT | ({"n_steps": 8} if name == "ppo" else {})

    monkeypatch.setattr(race, "zoo_hyperparameters", short)
    monkeypatch.setattr(race, "EPISODES", 2)
    monkeypatch.setattr(race, "LEVELS", (-9.0, 9.0))
    monkeypatch.setattr(race.workers, "processes", here)
    given = [ENV, "--seeds", "1", "--steps", "256", "--output", str(file), "--learners", *names]
    drawn = ["--picture", str(picture)] if len(names) > 1 else []
    assert race.main([*given, *drawn]) == 0
    output = capsys.readouterr().out
    assert len(re.findall(r"PPO, seed 0: -9 in \d\.\d s, 9 never", output)) == len(names)
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert [row["algo"] for row in rows] == list(names)
    for row in rows:
        steps, seconds, processor, _ = zip(*row["curve"], strict=True)
        assert steps[0] == 0 and steps[-1] >= 256
        assert sorted(seconds) == list(seconds) and sorted(processor) == list(processor)
        assert seconds[-1] == pytest.approx(row["seconds"], abs=1e-3) and seconds[-1] < row["process_seconds"]
        assert "cores" in row["machine"] and row["versions"]["torch"]
    assert not drawn or picture.read_bytes().startswith(b"\x89PNG")
    assert race.main(given) == 0 and file.read_text().splitlines() == [
        json.dumps(row) for row in rows
    ]  # kept
    assert race.main(["PivotedBra-v0"]) == 2 and race.main([ENV, "--seeds", "0"]) == 2


@pytest.mark.slow
# Other tests load JAX, which warns about any fork in this process; Ray's forks only start programs.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_seeds_over_a_ray_cluster_are_the_same(tmp_path):
    given = [ENV, "--algo", ppo.NAME, "--steps", "12288", "--seeds", "2", "--output"]
    runs = [Run(tmp_path / n / ENV / ppo.NAME / "seed1", "", "", 0, 0, {}) for n in ("ray", "here")]
    assert train.main([*given, str(tmp_path / "ray"), "--ray", "local"]) == 0
    assert ppo.main([ENV, *given[3:], str(tmp_path / "here")]) == 0
    assert learnt(runs[0])[0] == learnt(runs[1])[0]


@pytest.mark.slow
def test_killed_and_interrupted_runs_go_on(tmp_path):
    output = kill_and_interrupt("agents.ppo", ENV, "--steps", "200000", "--output", str(tmp_path))
    assert f"agents.ppo {ENV}" in output
    assert train.main([ENV, "--algo", ppo.NAME, "--steps", "200000", "--output", str(tmp_path)]) == 0
