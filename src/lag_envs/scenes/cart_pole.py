r"""A pole hinged on a cart that a force pushes.

::

            \  2l       theta   0 is upright, positive to the right
             \
        ______\_____
       |______O_____|   x ->    force
         o        o

The pole is uniform, of mass m and length 2l; the cart has the mass M::

    T = (M + m) x'²/2 + m l x' theta' cos(theta) + (4/3) m l² theta'²/2,   V = m g l cos(theta)

This is the model of Barto, Sutton and Anderson (1983), and that of Gymnasium's `CartPole-v1`, with the cart's
friction viscous instead of Coulomb's.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from lag_envs.scenes.base import Scene, parameter
from lag_envs.scenes.shapes import Arrow, Bodies, Circle, Line, Polygon


@dataclasses.dataclass(frozen=True, kw_only=True)
class CartPole(Scene):
    """A pole hinged on a cart; the control is the force on the cart.

    Parameters
    ----------
    cart_mass : float [kg]
        Mass M of the cart.
    pole_mass : float [kg]
        Mass m of the pole.
    half_length : float [m]
        Half of the pole's length, l: distance from the hinge to the centre of mass.
    gravity : float [m/s²]
        Field g, downward.
    friction : float [N s/m]
        Coefficient b of the cart's friction -bx'.

    Notes
    -----
    State (x, x_dot, theta, theta_dot). The zero of the potential energy lies at the hinge.

    Examples
    --------
    >>> {name: value.round(3).item() for name, value in CartPole().acceleration([0, 0, 0, 0], 10.0).items()}
    {'x': 9.756, 'theta': -14.634}
    """

    cart_mass: float = parameter(1.0, "kg", above=0.0)
    pole_mass: float = parameter(0.1, "kg", above=0.0)
    half_length: float = parameter(0.5, "m", above=0.0)
    gravity: float = parameter(9.8, "m/s²", least=0.0)
    friction: float = parameter(0.0, "N s/m", least=0.0)

    coordinates = {"x": "m", "theta": "rad"}
    controls = {"force": "N"}

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return T [J]."""
        along = v.x + self.half_length * v.theta * xp.cos(q.theta)
        up = -self.half_length * v.theta * xp.sin(q.theta)
        turning = self.pole_mass * self.half_length**2 / 3 * v.theta**2
        return 0.5 * self.cart_mass * v.x**2 + 0.5 * self.pole_mass * (along**2 + up**2) + 0.5 * turning

    def potential(self, q: Any, xp: Any) -> Any:
        """Return V [J]."""
        return self.pole_mass * self.gravity * self.half_length * xp.cos(q.theta)

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return half of the power lost to friction [W]."""
        return 0.5 * self.friction * v.x**2

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return the force on the cart [N]."""
        return {"x": u.force}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return the poses of cart and pole."""
        return {"cart": (q.x, 0.0, 0.0), "pole": (q.x, 0.0, -q.theta)}

    def bodies(self) -> Bodies:
        """Return the rail, the cart, the upright pole, and an arrow for the force."""
        size, long = 0.2 * self.half_length, 2.0 * self.half_length
        wide = 0.3 * size
        return {
            "rail": [Line([(-40.0 * size, -size), (40.0 * size, -size)], "ground")],
            "cart": [
                Polygon([(-2 * size, -size), (2 * size, -size), (2 * size, size), (-2 * size, size)], "frame")
            ],
            "pole": [
                Polygon([(-wide, -wide), (wide, -wide), (wide, long), (-wide, long)]),
                Circle((0.0, 0.0), 0.5 * wide, "hole"),
            ],
            "push": [Arrow([(0.0, 2.0 * size), (0.0, 6.0 * size)])],
        }

    def indicators(self, now: Any, xp: Any) -> dict[str, Any]:
        """Return the poses of the rail, which is drawn without ends, and of the arrow."""
        return {"rail": (now.q.x, 0.0), "push": (now.q.x, 0.0, -0.5 * math.pi, now.share.force)}
