"""Learners by gradients and by a controller; `test_ppo` has the tests of all our learners."""

import copy

import numpy as np
import pytest
import torch
from covering import slow
from trainings import OTHERS

from agents import cloning, shac, train
from agents.learners import zoo_hyperparameters
from agents.run import UserError, fresh_seeds
from lag_envs.evaluation.rollout import play
from lag_envs.scores import score
from lag_envs.tasks import cart_pole, pivoted_bar

FREE, TRACK = pivoted_bar.SwingUpFree.id, pivoted_bar.SwingUp.id


@pytest.mark.parametrize(("env_id", "share"), [(FREE, 0.5), (TRACK, 0.01)])
def test_gradients_are_slopes_of_what_is_earned(env_id, share):
    """Against differences of one action: through policy, guard, critic, and ends of episodes."""
    steps, n, gamma, first = 12, 4, 0.97, 3
    settings = zoo_hyperparameters("shac", env_id) | {
        "n_envs": n, "n_steps": steps, "critic": [8], "gamma": gamma, "episode_share": share,
        "max_slope": 1e9,
    }  # fmt: skip
    learner = shac.Learner(env_id, shac.Settings.of(settings), 0, 1000)
    start, act = copy.deepcopy(learner.state()), learner.policy.outputs

    def earned(push):
        learner.restore(copy.deepcopy(start))
        acted = iter(range(steps))
        learner.policy.outputs = lambda seen: (None, act(seen)[1] + np.float32(push * (next(acted) == first)))
        w = learner.collect()
        total, alive = np.zeros(n), np.ones(n, bool)
        values = learner.critic(torch.from_numpy(w.seen)).detach().numpy()[..., 0]
        for k, t in enumerate(range(first, steps)):
            total += alive * gamma**k * settings["reward_scale"] * w.rewards[t]
            ends = alive & (w.over[t] | (t == steps - 1))
            total += ends * gamma ** (k + 1) * values[t]
            alive &= ~w.over[t]
        return w, total

    w, _ = earned(0.0)
    assert w.over.any() == (share < 0.5)
    slopes = (earned(0.01)[1] - earned(-0.01)[1]) / 0.02
    np.testing.assert_allclose(learner.gradients(w)[first, :, 0], slopes, rtol=0.02, atol=1e-5)


@pytest.mark.parametrize(
    ("env_id", "changes", "least"),
    [
        # In about a second of training; back-propagation through time without bounds stays below .6.
        (FREE, {"n_timesteps": 4e5}, 0.9),
        # For ten seconds: a policy that drifts reaches the track's end, drops the bar, and stays below .9.
        slow(TRACK, {}, 0.97),
    ],
)
def test_it_swings_the_bar_up(env_id, changes, least):
    hyper = zoo_hyperparameters("shac", env_id) | changes
    learner = shac.Learner(env_id, shac.Settings.of(hyper), 300, int(hyper["n_timesteps"]))
    while learner.trained < learner.steps:
        learner.iterate()
    assert score(env_id, play(env_id, learner.policy, fresh_seeds(100)).mean()) > least


@pytest.mark.parametrize(
    ("algo", "env_id", "changes", "message"),
    [
        ("shac", FREE, {"gamma": 1.5}, "gamma: Input should be less than or equal to 1, got 1.5"),
        ("shac", FREE, {"gama": 0.9}, "settings of shac: gama is an unknown key"),
        ("shac", FREE, {"start_ranges": {}}, "random_starts=0.5 needs start_ranges, got none"),
        ("shac", FREE, {"start_ranges": {"phi": 1.0}}, "has no state 'phi'; it has theta, theta_dot"),
        ("shac", TRACK, {"start_ranges": {"s": 1.0}}, "start_ranges reach beyond what .* accepts: .*s=-1 m"),
        ("shac", cart_pole.CartPoleExact.id, {}, "shac needs gradients: CartPoleExact-v0 has a list"),
        ("shac", pivoted_bar.SwingUpUnknown.id, {}, "needs gradients: PivotedBarUnknown-v0 has imperfect"),
        ("cloning", cart_pole.CartPoleExact.id, {}, "has discrete ones; try fast_ppo"),
        ("cloning", FREE, {"controller": "LQG"}, "no controller 'LQG'"),
        ("cloning", FREE, {"batch_size": 0}, "settings of cloning: batch_size: "),
        ("shac", FREE, {"reward_scale": 0}, "settings of shac: reward_scale: "),
    ],
)  # fmt: skip
def test_mistakes_are_named(algo, env_id, changes, message):
    module = {"shac": shac, "cloning": cloning}[algo]
    with pytest.raises(UserError, match=message):
        module.Learner(env_id, module.Settings.of(zoo_hyperparameters(algo, env_id) | changes), 0, 1000)


@pytest.mark.slow
def test_commands_know_them(tmp_path, capsys):
    given = [FREE, "--algo", *OTHERS, "--steps", "6400", "--output", str(tmp_path)]
    assert train.main([*given, "--jobs", "1"]) == 0
    output = capsys.readouterr().out
    assert all(f"{FREE}, {algo}, " in output for algo in OTHERS)
