"""Gymnasium environments whose dynamics are derived from a Lagrangian and stepped to near machine precision.

Importing the package registers its environments; ``gym.make("PivotedBar-v0")`` and its siblings then work.
"""

from gymnasium.envs.registration import register

from lag_envs.tasks import TASKS

__version__ = "0.1.0"
__all__ = ["TASKS", "__version__"]

for _id, (_task, _fixed) in TASKS.items():
    register(
        _id,
        entry_point="lag_envs.envs.single:LagrangianEnv",
        vector_entry_point="lag_envs.envs.vector:LagrangianVectorEnv",
        order_enforce=False,  # the environment itself refuses a step before its reset
        kwargs={"task": _task, **_fixed},
    )
