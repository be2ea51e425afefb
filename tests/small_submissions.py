"""Submissions of a few numbers, which tests write and spoil."""

from itertools import pairwise

import numpy as np

from lag_envs.leaderboard.submission import write
from lag_envs.tasks import incline

ENV = incline.Tilt.id
ABOUT = {"env": ENV, "name": "An agent", "authors": ["A. Nobody"], "license": "MIT"}
TRAINING = {"env_steps": 1000, "seconds": 2.5, "hardware": "abacus"}
NET = {"architecture": "mlp", "hidden": [3], "activation": "tanh", "squash": "clip"}
#: A network for ReLU whose numbers overflow.
HUGE = {"weight_0": np.full((3, 4), 1e308), "weight_1": np.array([[1e308, -1e308, 0.0]])}
HUGE |= {"bias_0": np.zeros(3), "bias_1": np.zeros(1)}
LINEAR = {"gain": np.array([-1.0, -1.0, -3.0, 1.0]), "offset": np.zeros(1)}
FEEDBACK = {"architecture": "linear"}
GRID = {"axis_0": np.array([-1.0, 1.0]), "axis_1": np.array([0.0, 1.0, 2.0]), "table": np.zeros((2, 3))}
TABLE = {"architecture": "table", "kind": "action", "axes": ["x", "w"]}


def net(seed, widths=(4, 3, 1)):
    rng = np.random.default_rng(seed)
    arrays = {}
    for k, (columns, rows) in enumerate(pairwise(widths)):
        arrays[f"weight_{k}"] = rng.normal(size=(rows, columns)).astype(np.float32)
        arrays[f"bias_{k}"] = rng.normal(size=rows).astype(np.float32)
    return arrays


def learned(folder, **changed):
    arrays = {seed: net(seed) for seed in range(5)}
    given = ABOUT | {"policy": NET, "training": TRAINING, "arrays": arrays}
    return write(folder, **(given | changed))


def linear(folder, **changed):
    given = ABOUT | {"policy": {"architecture": "linear"}, "arrays": {0: LINEAR}}
    return write(folder, **(given | changed))


def network(folder, policy, arrays, **changed):
    """Write five networks, of which the first has these arrays, and the others do nearly the same."""
    last = max(name for name in arrays if name.startswith("bias_"))
    others = {seed: arrays | {last: arrays[last] + np.float32(1e-3 * seed)} for seed in range(5)}
    return learned(folder, policy=policy, arrays=others, **changed)


def built_in(folder, **policy):
    table = {"architecture": "controller", "name": "PD"} | policy
    return write(folder, policy=table, **ABOUT)
