"""Gymnasium environments whose dynamics are derived from a Lagrangian and stepped to near machine precision.

Importing the package registers its environments, so that ``gym.make("PivotedBar-v0")`` works, for example.
"""

from lag_envs.tasks import TASKS
from lag_envs.tasks.registration import register

__version__ = "0.2.0"
__all__ = ["TASKS", "__version__", "register"]

for _id, _place in TASKS.data.items():
    register(_place, id=_id)
