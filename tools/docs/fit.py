"""The recording of `docs/fit.md` and the picture of its residuals: ``python -m tools.docs.fit``.

No real recording is available that could be published. This recording is simulated with SciPy's integrator
from the textbook's equation, not with this package. It is then given the flaws of a film: noise, rounding to
tenths of degrees, lost frames.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lag_envs.options import module_parser
from lag_envs.scenes import Pendulum
from lag_envs.scenes.fitting.result import Fit
from lag_envs.store import write_file

ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "examples" / "pendulum.csv"
PICTURE = ROOT / "docs" / "images" / "fit-residuals.png"

#: The rod: mass [kg], length [m], damping [N m s], gravity [m/s²].
ROD = {"mass": 0.12, "length": 0.5, "damping": 0.002, "gravity": 9.81}
FRAMES, RATE = 240, 30
#: Initial angle, and noise [degrees].
RELEASED, NOISE = 70.0, 0.6


def recording() -> str:
    """Return the recording as a table: seconds, and degrees from hanging at rest."""
    from scipy.integrate import solve_ivp

    inertia = ROD["mass"] * ROD["length"] ** 2 / 3.0
    weight = 0.5 * ROD["mass"] * ROD["gravity"] * ROD["length"]

    def rates(t: float, y: Any) -> tuple[float, float]:
        return y[1], -(weight * math.sin(y[0]) + ROD["damping"] * y[1]) / inertia

    times = np.arange(FRAMES) / RATE
    found = solve_ivp(
        rates, times[[0, -1]], [math.radians(RELEASED), 0.0], "DOP853", times, rtol=1e-10, atol=1e-10
    )
    rng = np.random.default_rng(7)
    angles = np.degrees(found.y[0]) + NOISE * rng.standard_normal(FRAMES)
    lost = rng.choice(FRAMES, 6, replace=False)
    rows = [
        f"{t:.4f},{'' if i in lost else f'{a:.1f}'}"
        for i, (t, a) in enumerate(zip(times, angles, strict=True))
    ]
    return "\n".join(["time_s,angle_deg", *rows]) + "\n"


def fitted() -> Fit:
    """Return the page's numbers."""
    angle = np.genfromtxt(RECORDING, delimiter=",", skip_header=1)[:, 1]
    states = np.column_stack([np.pi + np.radians(angle), np.full_like(angle, np.nan)])
    return Pendulum(mass=ROD["mass"]).fit([(states, None, 1.0 / RATE)], ["length", "damping"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the recording, fit it, draw the residuals."""
    module_parser("tools.docs.fit", __doc__, "examples:\n  python -m tools.docs.fit").parse_args(arguments)
    from agents.figures import save

    write_file(RECORDING, recording())
    found = fitted()
    print(found)
    save(found.plot(), PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
