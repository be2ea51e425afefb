"""The result of a fit: numbers, a table, a picture."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.scenes.fitting.recordings import Recording
from lag_envs.tables import aligned

if TYPE_CHECKING:
    from lag_envs.scenes.base import Scene

Array = NDArray[np.float64]


class FitWarning(UserWarning):
    """The data determine a parameter poorly, or the model does not follow them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """The result of `Scene.fit`.

    Attributes
    ----------
    scene : Scene
        The scene with the estimates.
    estimates : dict of str to float
        The free parameters.
    errors : dict of str to float
        Their standard errors.
    intervals : dict of str to (float, float)
        Their confidence intervals. The interval of a parameter that must be above 0 is symmetric in its
        logarithm.
    level : float
        The level of the intervals.
    correlation : ndarray, shape (p, p)
        Correlations of the estimates, in the order of `estimates`.
    noise : dict of str to float
        Standard deviation of the measurements of each state that was measured.
    recordings : list of Recording
        The data, with angles unwrapped.
    simulated : list of ndarray, shape (N, n_state)
        The fitted motion of each recording; its first row is the estimated start.
    warnings : tuple of str
        The texts of the warnings.
    """

    scene: Scene
    estimates: dict[str, float]
    errors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    level: float
    correlation: Array
    noise: dict[str, float]
    recordings: list[Recording]
    simulated: list[Array]
    warnings: tuple[str, ...] = ()

    @property
    def residuals(self) -> list[Array]:
        """Measured minus simulated states, NaN where nothing was measured."""
        return [r.states - x for r, x in zip(self.recordings, self.simulated, strict=True)]

    def __str__(self) -> str:
        units = {f.name: f.metadata.get("unit", "") for f in dataclasses.fields(self.scene)}  # type: ignore[arg-type]
        rows = [("parameter", "estimate", "std. error", f"{100 * self.level:g} % interval", "unit")]
        for name, value in self.estimates.items():
            error = self.errors[name]
            # The value is rounded like the error, which has two significant digits.
            digits = max(
                2, 2 + math.floor(math.log10(max(abs(value), error))) - math.floor(math.log10(error))
            )
            low, high = (f"{x:.{digits}g}" for x in self.intervals[name])
            rows.append((name, f"{value:.{digits}g}", f"{error:.2g}", f"{low} to {high}", units[name]))
        state = dict(zip(self.scene.state_names, self.scene.state_units, strict=True))
        noise = ", ".join(f"{name} {value:.3g} {state[name]}" for name, value in self.noise.items())
        count = sum(int(r.measured.sum()) for r in self.recordings)
        counted = f"{len(self.recordings)} recording{'s' * (len(self.recordings) > 1)}"
        one = f"{type(self.scene).__name__}: {counted}, {count} values; noise {noise}"
        return "\n".join([one, *aligned(rows), *(f"! {text}" for text in self.warnings)])

    def plot(self) -> Any:
        """Return a Matplotlib figure: data and model of each measured state, residuals, their histogram."""
        from matplotlib.figure import Figure

        names = list(self.noise)
        figure = Figure(figsize=(10.0, 0.4 + 2.0 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), 3, squeeze=False, width_ratios=(3, 3, 1), sharex="col")
        for row, name in zip(axes, names, strict=True):
            self._plot_state(row, name)
        for ax, label in zip(axes[-1], ("time [s]", "time [s]", "residual / noise"), strict=True):
            ax.set_xlabel(label)
        return figure

    def _plot_state(self, axes: Any, name: str) -> None:
        i, sigma = self.scene.state_names.index(name), self.noise[name]
        unit = self.scene.state_units[i]
        data, rest, counts = axes
        for recording, motion, residual in zip(self.recordings, self.simulated, self.residuals, strict=True):
            times = recording.dt * np.arange(len(motion))
            data.plot(times, recording.states[:, i], ".", ms=3, color="0.6")
            data.plot(times, motion[:, i], lw=1.0)
            rest.plot(times, residual[:, i], ".", ms=3)
        data.set_ylabel(f"{name} [{unit}]")
        rest.set_ylabel(f"residual [{unit}]")
        rest.axhspan(-2.0 * sigma, 2.0 * sigma, color="0.9", zorder=0)
        rest.axhline(0.0, color="0.5", lw=0.8, zorder=1)
        scaled = np.concatenate([r[:, i] for r in self.residuals]) / sigma
        counts.hist(scaled[np.isfinite(scaled)], bins=20, density=True, color="0.7")
        grid = np.linspace(-4.0, 4.0, 81)
        counts.plot(grid, np.exp(-0.5 * grid**2) / math.sqrt(2.0 * math.pi), color="k", lw=1.0)
