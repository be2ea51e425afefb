"""Physics: parameters, energies, equations of motion and forces of the scenes.

To add a scene, write one file like these and add its class to `SCENES`.
"""

from lag_envs.scenes.base import Motion, Scene, StepRefused
from lag_envs.scenes.cylinder_in_cylinder import CylinderInCylinder
from lag_envs.scenes.incline import Incline
from lag_envs.scenes.pivoted_bar import PivotedBar

SCENES: tuple[type[Scene], ...] = (PivotedBar, Incline, CylinderInCylinder)

__all__ = ["SCENES", "CylinderInCylinder", "Incline", "Motion", "PivotedBar", "Scene", "StepRefused"]
