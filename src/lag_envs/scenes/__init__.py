"""Physics: parameters and energies of the scenes, and what follows from them.

`Scene` is the base class for your own scenes: a scene states its energies, and everything else follows.
"""

from lag_envs.scenes.acrobot import Acrobot
from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.cart_pole import CartPole
from lag_envs.scenes.chain import Chain
from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.cylinder_in_cylinder import CylinderInCylinder
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pendulum import Pendulum
from lag_envs.scenes.pivoted_bar import PivotedBar
from lag_envs.scenes.rotary_pendulum import RotaryPendulum
from lag_envs.scenes.two_link_arm import TwoLinkArm

#: The package's scenes.
SCENES: tuple[type[Scene], ...] = (
    PivotedBar,
    Incline,
    CylinderInCylinder,
    CartPole,
    Acrobot,
    Chain,
    RotaryPendulum,
    TwoLinkArm,
    Pendulum,
)

__all__ = [
    "SCENES",
    "Acrobot",
    "CartPole",
    "Chain",
    "CylinderInCylinder",
    "Incline",
    "Pendulum",
    "PivotedBar",
    "RotaryPendulum",
    "Scene",
    "StepRefused",
    "TwoLinkArm",
    "parameter",
]
