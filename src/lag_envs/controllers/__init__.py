"""Classical controllers, and agents that know nothing, all with Stable-Baselines3's `predict`.

Every agent takes one observation or a batch, and hands back what it has to remember until the next call::

    action, state = agent.predict(observation, state, episode_start)

``CONTROLLERS`` lists them for each environment; `make_controller` makes one::

    agent = make_controller("PivotedBar-v0", "energy shaping + LQR")
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lag_envs.controllers.basic import Constant, Random, do_nothing
from lag_envs.controllers.cylinder_in_cylinder import BrakingLine, EnergyPump, TiltLQR, plan_pumping
from lag_envs.controllers.ilqr import ILQR
from lag_envs.controllers.incline import SwitchingLine, TiltCascade, optimal_return
from lag_envs.controllers.pd import PD
from lag_envs.controllers.pivoted_bar import BalanceLQR, EnergyShapingLQR, lqr, plan_swing_up
from lag_envs.errors import hint
from lag_envs.tasks import TASKS, load_task

__all__ = [
    "CONTROLLERS",
    "ILQR",
    "PD",
    "BalanceLQR",
    "BrakingLine",
    "Constant",
    "EnergyPump",
    "EnergyShapingLQR",
    "Random",
    "SwitchingLine",
    "TiltCascade",
    "TiltLQR",
    "do_nothing",
    "lqr",
    "make_controller",
    "optimal_return",
    "plan_pumping",
    "plan_swing_up",
]

_KNOW_NOTHING: dict[str, Callable[[Any], Any]] = {"zero": do_nothing, "random": lambda task: Random(0)}
_SWING_UP: dict[str, Callable[[Any], Any]] = {
    **_KNOW_NOTHING,
    "energy shaping + LQR": EnergyShapingLQR,
    "iLQR": plan_swing_up,
}

#: How each controller of each environment is made from the task. The best constant brakes were found by
#: ``python -m agents.tune``.
CONTROLLERS: dict[str, dict[str, Callable[[Any], Any]]] = {
    "PivotedBar-v0": _SWING_UP,
    "PivotedBarFree-v0": _SWING_UP,
    "PivotedBarBalance-v0": {**_KNOW_NOTHING, "LQR": BalanceLQR},
    "InclineTilt-v0": {
        **_KNOW_NOTHING,
        "PD": PD,
        "cascade": TiltCascade,
        "iLQR": lambda task: ILQR(task, [TiltCascade(task)]),
    },
    "InclineBrake-v0": {
        **_KNOW_NOTHING,
        "full damping": lambda task: Constant(1.0),
        "best constant": lambda task: Constant(0.42),
        "switching line": SwitchingLine,
    },
    "CylinderInCylinderTilt-v0": {
        **_KNOW_NOTHING,
        "PD": PD,
        "LQR": TiltLQR,
        "iLQR": lambda task: ILQR(task, [TiltLQR(task)]),
    },
    "CylinderInCylinderPump-v0": {
        **_KNOW_NOTHING,
        "energy pump": EnergyPump,
        "iLQR": plan_pumping,
    },
    "CylinderInCylinderDamping-v0": {
        **_KNOW_NOTHING,
        "full damping": lambda task: Constant(1.0),
        "best constant": lambda task: Constant(0.38),
        "switching line": BrakingLine,
    },
}


def make_controller(env_id: str, name: str, **env_options: Any) -> Any:
    """Return a controller for an environment.

    Parameters
    ----------
    env_id : str
        Id of the environment.
    name : str
        Name of the controller, one of ``CONTROLLERS[env_id]``.
    **env_options
        Parameters of the environment, such as `mass` or `dt`, that differ from its own.

    Raises
    ------
    ValueError
        For an unknown id or name; it tells close ones.
    """
    check_id(env_id)
    makers = CONTROLLERS[env_id]
    if name not in makers:
        raise ValueError(f"{env_id} has no controller {name!r}; {hint(name, makers)}")
    place, fixed = TASKS[env_id]
    return makers[name](load_task(place)(**fixed | env_options))


def check_id(env_id: str) -> None:
    """Raise ValueError for an environment that there is not."""
    if env_id not in CONTROLLERS:
        raise ValueError(f"there is no environment {env_id!r}; {hint(env_id, CONTROLLERS)}")
