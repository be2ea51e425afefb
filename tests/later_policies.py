"""Policies of schema 2 of every kind, and tasks for them."""

import numpy as np
from own_tasks import Switched

from lag_envs.leaderboard.policies import architecture
from lag_envs.scenes import TwoLinkArm
from lag_envs.tasks import Task, incline
from lag_envs.tasks.record import Goal

GOAL = Goal("success: always; there is no time", hold=None, terminated=None)
NET = {"architecture": "mlp", "hidden": [3], "squash": "clip"}
PLAN = {"architecture": "plan"}
UNIT = {"architecture": "gru", "memory": 5, "squash": "tanh"}


class OneOfThree(Switched):
    """One list of actions."""

    id = "OneOfThree-v0"
    goal = GOAL


class Arm(Task):
    """Two controls in ranges."""

    id = "ArmWithGoal-v0"
    scene = TwoLinkArm
    interval, steps = 0.02, 40
    action = {"shoulder": 5.0, "elbow": 2.0}
    start = {"theta_1": 0.5, "theta_2": 0.5}
    goal = GOAL

    def observe(self, after, target, xp):
        one, two = after.theta_1, after.theta_2
        angles = {"cos_1": xp.cos(one), "sin_1": xp.sin(one), "cos_2": xp.cos(two), "sin_2": xp.sin(two)}
        return angles | {name: after[name] for name in ("theta_1_dot", "theta_2_dot")}

    def reward(self, before, after, control, target, dt, xp):
        return xp.cos(after.theta_1) - 1e-3 * control.shoulder**2


class TwoLists(Arm):
    """Two lists of actions."""

    id = "TwoLists-v0"
    action = {"shoulder": [-5.0, 0.0, 5.0], "elbow": [-2.0, 2.0]}


OWN = (OneOfThree, Arm, TwoLists)

LISTED, RANGES, LISTS = (kind.id for kind in OWN)


def numbers(env, policy, seed=0):
    """Return arrays of the right shapes, of plans of nine steps."""
    rng = np.random.default_rng(seed)
    lengths = {"steps": 9, "steps + 1": 10}
    shapes = architecture(env, policy).arrays.items()
    drawn = {name: rng.uniform(-1.0, 1.0, [lengths.get(n, n) for n in shape]) for name, shape in shapes}
    return drawn | ({"obs_var": np.abs(drawn["obs_var"])} if "obs_var" in drawn else {})


EVERY = [
    (incline.Tilt.id, NET | {"frames": 3, "normalise": {}}),
    (incline.Tilt.id, UNIT | {"hidden": [4], "normalise": {"clip": 0.5}}),
    (incline.Tilt.id, {"architecture": "gru", "memory": 5, "bins": 7}),
    (incline.Tilt.id, {"architecture": "plan"}),
    (LISTED, {"architecture": "mlp", "hidden": [4]}),
    (LISTED, {"architecture": "linear"}),
    (LISTED, {"architecture": "gru", "memory": 3}),
    (RANGES, UNIT),
    (RANGES, {"architecture": "plan"}),
    (LISTS, {"architecture": "mlp", "hidden": [], "frames": 2, "padding": "first"}),
    (LISTS, {"architecture": "linear"}),
]  # fmt: skip
