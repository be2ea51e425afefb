"""Methods at their settings as points: errors and times, to be compared and drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from lag_envs.report.runner import Row

#: The name of the shipped stepping among the methods.
LAG_ENVS = "lag_envs"
#: Half a unit in the last place of 1.
ROUNDING = 2.0**-53
#: Errors at which times are compared.
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)
MODES = {"single": "alone", "batch": "in a batch"}
HORIZONS = ("one step", "10 s", "1,000 s")
LIBRARIES = {
    "scipy": "SciPy",
    "heyoka": "heyoka",
    "diffrax": "diffrax",
    "torchdiffeq": "torchdiffeq",
    "mujoco": "MuJoCo",
    "pinocchio": "Pinocchio",
}


class WorkPrecisionPoint(NamedTuple):
    """One method at one setting, in one form: its errors and its time."""

    variant: str
    horizon: str
    mode: str
    family: str
    method: str
    setting: float  #: substeps per control step, or a library's tolerance
    error: float | None
    median: float | None
    errors: Sequence[float | None]
    ns: float

    @property
    def own(self) -> bool:
        """Whether it is the shipped method."""
        return self.family == LAG_ENVS

    @property
    def diverged(self) -> int:
        """Number of lost members."""
        return sum(error is None for error in self.errors)

    @property
    def worst(self) -> float:
        """The largest error, infinite if a member is lost."""
        return max((math.inf if error is None else error for error in self.errors), default=math.inf)

    @property
    def name(self) -> str:
        """The method, with its library."""
        return f"{LIBRARIES.get(self.family, '')} {self.method}".strip()

    @property
    def label(self) -> str:
        """The method and its setting in words."""
        if self.own and self.setting == 1:
            return self.method
        if self.family in ("lag_envs", "compiled", "mujoco") or self.method.endswith("fixed"):
            if self.setting < 1.0:
                return f"{self.name}, a step for {1.0 / self.setting:g}"
            return f"{self.name}, {self.setting:g} substep{'s' if self.setting > 1 else ''}"
        return f"{self.name}, {self.setting:g}"


def gathered(rows: Sequence[Row]) -> list[WorkPrecisionPoint]:
    """Return the points, with all times converted to the same speed of the machine.

    Each job timed lag_envs in turn with its own samples, as a clock. Times are multiplied by the ratio of the
    clock in our own job to that job's clock. A method without a batch has the same times in a batch as alone.
    """
    measured = [r for r in rows if r["kind"] == "point" and "problem" not in r]
    clocks = {
        (r["variant"], r["horizon"], r["mode"]): r["clock"] for r in measured if r["family"] == "lag_envs"
    }
    found = []
    for row in measured:
        key = row["variant"], row["horizon"], row["mode"]
        point = WorkPrecisionPoint(
            *key, row["family"], row["method"], row["setting"], row["error"], row["median"], row["errors"],
            row["ns"] * clocks.get(key, row["clock"]) / row["clock"],
        )  # fmt: skip
        found.append(point)
    alone = {(r["family"], r["method"]) for r in measured if not r["batched"]}
    return found + [p._replace(mode="batch") for p in found if (p.family, p.method) in alone]
