"""Classical controllers, and trivial agents, all with Stable-Baselines3's `predict`.

Every agent takes one observation or a batch, and returns the state to pass to the next call::

    action, state = agent.predict(observation, state, episode_start)

`Task.controllers` lists the controllers of a task; `make_controller` makes one::

    agent = make_controller("PivotedBar-v0", "energy shaping + LQR")
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from lag_envs.controllers.basic import Constant, Random, do_nothing
from lag_envs.controllers.cylinder_in_cylinder import BrakingLine, EnergyPump, ShellPD, TiltLQR, plan_pumping
from lag_envs.controllers.ilqr import ILQR
from lag_envs.controllers.incline import SwitchingLine, TiltCascade, TiltPD, optimal_return
from lag_envs.controllers.linear import BalanceLQR
from lag_envs.controllers.pd import PD
from lag_envs.controllers.pivoted_bar import EnergyShapingLQR, lqr, plan_swing_up
from lag_envs.controllers.tracking import Tracking
from lag_envs.errors import hint
from lag_envs.tasks import TASKS, resolve
from lag_envs.tasks.record import Controller
from lag_envs.tasks.registration import make_task

__all__ = [
    "ILQR",
    "KNOW_NOTHING",
    "PD",
    "BalanceLQR",
    "BrakingLine",
    "Constant",
    "EnergyPump",
    "EnergyShapingLQR",
    "Random",
    "ShellPD",
    "SwitchingLine",
    "TiltCascade",
    "TiltLQR",
    "TiltPD",
    "Tracking",
    "build",
    "controllers",
    "do_nothing",
    "lqr",
    "make_controller",
    "optimal_return",
    "plan",
    "plan_pumping",
    "plan_swing_up",
]

#: Agents for every task.
KNOW_NOTHING = {
    "zero": Controller("lag_envs.controllers.basic:do_nothing"),
    "random": Controller("lag_envs.controllers.basic:at_random"),
}


def controllers(task: Any) -> dict[str, Controller]:
    """Return the controllers of a task or a task's class, by name."""
    return KNOW_NOTHING | dict(task.controllers)


def build(task: Any, name: str, *, real_time: bool = False, **numbers: Any) -> Any:
    """Return a task's controller of this name.

    Parameters
    ----------
    task : Task
        The task, ``env.unwrapped.task``.
    name : str
        Name of the controller.
    real_time : bool
        Whether the controller has to keep pace with a clock. If its planning takes longer than a step, it
        then plans some steps ahead, in a separate process: see `ahead` of `lag_envs.controllers.mpc.MPC`.
    **numbers
        Keywords that override those in the task's record.
    """
    found = controllers(task)
    if not isinstance(name, str):
        raise TypeError(f"a controller's name is needed, got {name!r}; available: {', '.join(found)}")
    if name not in found:
        raise ValueError(f"{task.id or type(task).__name__} has no controller {name!r}; {hint(name, found)}")
    made = found[name]
    hurry = {**made.real_time, "background": True} if real_time and made.real_time else {}
    return resolve(made.place)(task, **{**made.numbers, **hurry, **numbers})


def plan(task: Any, *, guess: str) -> ILQR:
    """Return an iLQR whose initial guess is another of the task's controllers."""
    return ILQR(task, [build(task, guess)])


def make_controller(env_id: str, name: str, **env_options: Any) -> Any:
    """Return a controller for an environment.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    name : str
        Name of the controller: "zero", "random" or one of the task's own.
    **env_options
        Parameters of the environment, such as `mass` or `dt`, that differ from the defaults.

    Raises
    ------
    ValueError
        For an unknown id or name; the message suggests similar ones.
    TypeError
        For an id or name that is not a string. To pass a task, use `build`.
    """
    if not isinstance(env_id, str):
        raise TypeError(
            f"an environment's id is needed, such as 'PivotedBar-v0', got {env_id!r}; "
            "lag_envs.controllers.build takes a task"
        )
    if env_id not in gym.registry and ":" not in env_id:
        raise ValueError(f"there is no environment {env_id!r}; {hint(env_id, TASKS)}")
    return build(make_task(env_id, **env_options), name)
