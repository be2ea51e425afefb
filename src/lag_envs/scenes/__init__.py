"""Physics: parameters and energies of the scenes, and what follows from them.

`Scene` is what a scene of one's own derives from: it states its energies, and everything else follows. The
first three scenes have hand-made flows (`lag_envs.scenes.base`).
"""

from lag_envs.scenes.acrobot import Acrobot
from lag_envs.scenes.base import Motion, StepRefused
from lag_envs.scenes.base import Scene as FlowScene
from lag_envs.scenes.cart_pole import CartPole
from lag_envs.scenes.chain import Chain
from lag_envs.scenes.contract import Scene, parameter
from lag_envs.scenes.cylinder_in_cylinder import CylinderInCylinder
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pivoted_bar import PivotedBar
from lag_envs.scenes.rotary_pendulum import RotaryPendulum
from lag_envs.scenes.two_link_arm import TwoLinkArm

#: Scenes with hand-made flows.
SCENES: tuple[type[FlowScene], ...] = (PivotedBar, Incline, CylinderInCylinder)
#: Scenes that are nothing but their energies.
GENERAL_SCENES: tuple[type[Scene], ...] = (CartPole, Acrobot, Chain, RotaryPendulum, TwoLinkArm)

__all__ = [
    "GENERAL_SCENES",
    "SCENES",
    "Acrobot",
    "CartPole",
    "Chain",
    "CylinderInCylinder",
    "FlowScene",
    "Incline",
    "Motion",
    "PivotedBar",
    "RotaryPendulum",
    "Scene",
    "StepRefused",
    "TwoLinkArm",
    "parameter",
]
