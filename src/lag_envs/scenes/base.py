"""What every scene offers, and the checks on its parameters."""

from __future__ import annotations

import dataclasses
import math
import numbers
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.scenes.shapes import Moment, Shape, Window
from lag_envs.stepping import pendulum
from lag_envs.stepping.flows import Flow, Stepper

if TYPE_CHECKING:
    import sympy

Array = NDArray[np.float64]

#: Masses and lengths below this, and any parameter above its inverse, are refused: a product of five must not
#: vanish or overflow.
SMALLEST = 1e-60


class StepRefused(ArithmeticError):
    """A step that cannot be taken to full accuracy, or that has no finite result.

    Attributes
    ----------
    trajectory : array of shape (steps + 1, n_state), or None
        What `Scene.simulate` had computed before the step.
    results : tuple, or None
        What a vector environment's step would have returned for the others.
    """

    trajectory: Array | None = None
    results: tuple | None = None


class Motion(NamedTuple):
    """Coordinates of the Lagrangian, velocities and accelerations, each a namespace by coordinate name."""

    q: SimpleNamespace
    v: SimpleNamespace
    a: SimpleNamespace


def parameter(
    default: float | None,
    unit: str,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    usable: tuple[float, float] = (-math.inf, math.inf),
) -> Any:
    """Declare a physical parameter: default, unit, and the range that it must lie in.

    In the narrower range `usable` an environment can be used, whatever its other parameters, see
    `Task.usable`; a scene alone may be stepped beyond it.
    """
    limits = {"above": above, "least": least, "below": below, "most": most}
    return dataclasses.field(default=default, metadata={"unit": unit, "usable": usable} | limits)


def shown(value: Any) -> str:
    """Return a value as an error shows it, long ones cut short."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:150]}... ({len(text)} characters)"


def check_number(name: str, value: Any, unit: str = "", *, endless: bool = False) -> float:
    """Return the value as a finite float, infinity too where it may be `endless`; else raise a ValueError."""
    if type(value) is np.ndarray and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, numbers.Real):
        raise ValueError(f"{name} must be a real number, got {shown(value)}")
    try:
        number = float(value)
    except OverflowError:  # an integer may be too large
        number = math.nan
    if not math.isfinite(number) and not (endless and value == math.inf):
        raise ValueError(f"{name} must be finite, got {value!s:.40}{unit and ' ' + unit}")
    return number


def real_array(name: str, values: ArrayLike) -> Array:
    """Return values as a new float64 array, or raise a ValueError that names them."""
    try:
        array = np.array(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} must be real numbers, got {shown(values)}") from error
    if array.dtype.kind not in "fiu" or is_masked(values):
        raise ValueError(f"{name} must be real numbers, got {shown(values)}")
    return array.astype(np.float64)


def is_masked(values: Any) -> bool:
    """Tell whether values are or hold a masked array, whose masked numbers NumPy would take for valid."""
    if isinstance(values, list | tuple):
        return any(map(is_masked, values))
    return isinstance(values, np.ndarray) and hasattr(values, "mask")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scene(ABC):
    """A mechanical scene: parameters, energies, equation of motion, forces. Immutable.

    A subclass is a frozen dataclass whose fields are declared with `parameter`. It defines the energies,
    which are the source of truth, and the equation of motion in its flow's normal form, which tests derive
    from them. Formulas use only ``+ - * /`` and functions of the namespace `xp`, so that floats, arrays,
    SymPy symbols and recording numbers can pass through them. Rewards, Gymnasium and windows have no place
    here.
    """

    # --- what a scene defines ------------------------------------------------------------------------------

    @property
    @abstractmethod
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries, in order."""

    @property
    @abstractmethod
    def state_units(self) -> tuple[str, ...]:
        """Their units."""

    @property
    @abstractmethod
    def control_unit(self) -> str:
        """What the control is, and its unit."""

    @property
    @abstractmethod
    def coordinates(self) -> tuple[str, ...]:
        """Coordinates of the Lagrangian: the free one, then the one that is moved from outside, if any."""

    @property
    @abstractmethod
    def flow(self) -> Flow:
        """The exact flow that steps the scene."""

    @property
    @abstractmethod
    def angle(self) -> int | None:
        """Index of the state whose cosine and sine travel along, or None."""

    @abstractmethod
    def constants(self) -> dict[str, Any]:
        """Return the few numbers that the formulas need, made from the parameters once.

        One that is zero is left out of the compiled step together with every term that it multiplies.
        """

    @abstractmethod
    def drive(self, y: Sequence, u: Any, k: Any, xp: Any) -> tuple:
        """Return the flow's coefficients while the control u is held, from lifted state and constants."""

    @abstractmethod
    def unpack(self, y: Sequence, u: Any, k: Any) -> Sequence:
        """Return the flow's variables."""

    @abstractmethod
    def pack(self, moved: Sequence, y: Sequence, u: Any, dt: Any, k: Any) -> Sequence:
        """Return the lifted state at the step's end, from the moved variables."""

    @abstractmethod
    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return the kinetic energy [J]."""

    @abstractmethod
    def potential(self, q: Any, xp: Any) -> Any:
        """Return the potential energy [J]."""

    @abstractmethod
    def dissipation(self, v: Any, u: Any) -> Any:
        """Return Rayleigh's function, half of the power lost to drag [W]."""

    @abstractmethod
    def motion(self, state: ArrayLike, control: ArrayLike) -> Motion:
        """Return coordinates, velocities and accelerations under a control."""

    @abstractmethod
    def reactions(self, m: Motion, u: Any) -> dict[str, Any]:
        """Return the reaction forces of a motion."""

    @abstractmethod
    def drive_power(self, m: Motion, u: Any) -> Any:
        """Return the power that moving the support, plane or shell feeds in [W]."""

    @abstractmethod
    def shapes(self, now: Moment) -> list[Shape]:
        """Return what is to be seen, from back to front."""

    @abstractmethod
    def window(self, now: Moment) -> Window:
        """Return the part of the plane to look at."""

    def turning(self, state: Sequence[float]) -> float:
        """Return the rate of a coordinate that the picture shows and the state leaves out."""
        return 0.0

    def check(self) -> None:
        """Raise ValueError where parameters, each in its range, do not fit together."""

    # --- what follows --------------------------------------------------------------------------------------

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if "unit" in field.metadata:
                value = getattr(self, field.name)
                if value is not None or field.default is not None:
                    object.__setattr__(self, field.name, _check_range(field, value))
        self.check()
        for name, value in self.constants().items():
            if not math.isfinite(value):
                raise ValueError(f"these parameters make {name} {value}: {self}")

    @property
    def width(self) -> int:
        """Number of entries of the lifted state: the state, then cosine and sine of its angle, if any."""
        return len(self.state_names) + (2 if self.angle is not None else 0)

    def lift(self, state: ArrayLike) -> tuple:
        """Return the state's entries followed by cosine and sine of its angle, if it has one."""
        array = np.asarray(state, dtype=np.float64)
        if array.shape[-1:] != (len(self.state_names),):
            raise ValueError(
                f"state must be ({', '.join(self.state_names)}), got an array of shape {array.shape}"
            )
        y = tuple(np.moveaxis(array, -1, 0))
        return y if self.angle is None else (*y, np.cos(y[self.angle]), np.sin(y[self.angle]))

    def check_state(self, state: ArrayLike) -> Array:
        """Return the state as a float64 array of shape (n_state,), or raise a ValueError."""
        array = real_array("state", state)
        if array.shape != (len(self.state_names),):
            raise ValueError(
                f"state must be ({', '.join(self.state_names)}), got shape {array.shape}: {shown(state)}"
            )
        if not np.isfinite(array).all():
            raise ValueError(
                f"state must be finite, got {dict(zip(self.state_names, array.tolist(), strict=True))}"
            )
        return array

    def check_control(self, control: ArrayLike) -> Array:
        """Return controls as a float64 array, or raise a ValueError."""
        array = real_array("the control", control)
        bad = ~np.isfinite(array)
        if bad.any():
            raise ValueError(
                f"the control must be finite, got {array[bad].flat[0]} at {np.argwhere(bad)[0].tolist()}"
            )
        return array

    def simulate(self, state: ArrayLike, controls: ArrayLike, dt: float) -> Array:
        """Step the equation of motion with each control held for one step.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            Start, in the order of `state_names`.
        controls : array_like, shape (T,)
            One control per step; neither clipped nor guarded.
        dt : float
            Length of a step [s].

        Returns
        -------
        ndarray of float64, shape (T + 1, n_state)
            The states, ``[0]`` being the start.

        Raises
        ------
        ValueError
            For a state, control or step that is not finite or has the wrong shape, or a step not above 0.
        StepRefused
            Where a step would need more than a million substeps or has no finite result. Its attribute
            `trajectory` holds the rows before that.
        """
        controls = self.check_control(controls)
        if controls.ndim != 1:
            raise ValueError(
                f"controls must have shape (T,), got shape {controls.shape}: {shown(controls.tolist())}"
            )
        dt = check_step(dt)
        trajectory = np.empty((len(controls) + 1, len(self.state_names)))
        trajectory[0] = self.check_state(state)
        x = self.largest_x(dt)
        row = self._simulate(
            trajectory, controls, dt, x, *(v for v in map(float, self.constants().values()) if v != 0.0)
        )
        if not row and not np.isfinite(trajectory[-1]).all():
            row = int(np.argmin(np.isfinite(trajectory).all(axis=1)))
        if row:
            raise self.refusal(
                trajectory[row - 1],
                controls[row - 1],
                dt,
                trajectory[:row],
                f"step {row - 1} of {len(controls)}",
            )
        return trajectory

    @cached_property
    def _simulate(self) -> Callable:
        return self.stepper().compile_simulate()

    def stepper(self) -> Stepper:
        """Return the code of one control step; constants that are zero leave none."""
        return Stepper(self, frozenset(name for name, value in self.constants().items() if value == 0.0))

    @property
    def order(self) -> int:
        """Order of the flow's series; 0 for a closed form."""
        return self.flow.order

    def largest_x(self, dt: float) -> float:
        """Return the bound's x up to which one step of length dt is certified."""
        return pendulum.largest_x(dt, self.order or pendulum.ORDER, self.flow.tolerance)

    def refusal(
        self, state: Array, control: float, dt: float, trajectory: Array | None, where: str
    ) -> StepRefused:
        """Return the error for a step that was refused."""
        start = ", ".join(f"{n}={v:g}" for n, v in zip(self.state_names, state, strict=True))
        error = StepRefused(
            f"{where} was refused: from ({start}) with control {control:g} and dt={dt:g} s it would need "
            f"more than {pendulum.MAX_SUBSTEPS:,} substeps, or has no finite result; "
            "take a smaller dt or milder parameters"
        )
        error.trajectory = None if trajectory is None else trajectory.copy()
        return error

    def energy(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return kinetic, potential and total energy [J].

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (...), optional
            The control that is held; it matters where a velocity depends on it.
        """
        m = self.motion(state, control)
        kinetic, potential = self.kinetic(m.q, m.v, np), self.potential(m.q, np)
        return {"kinetic": kinetic, "potential": potential, "total": kinetic + potential}

    def forces(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the reaction forces [N], torques [N m] and needed friction, by name.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (...), optional
            The control that is held.
        """
        return self.reactions(self.motion(state, control), np.asarray(control, dtype=np.float64))

    def power(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the power of the drive and that lost to drag [W]; energy changes by their difference."""
        m = self.motion(state, control)
        u = np.asarray(control, dtype=np.float64)
        return {"drive": self.drive_power(m, u), "drag": 2.0 * self.dissipation(m.v, u)}

    def energy_balance(
        self, state: ArrayLike, control: float, dt: float, *, nodes: int = 16
    ) -> dict[str, float]:
        """Compare a step's change of energy with the work done on it [J].

        Work and loss are integrated by Gauss-Legendre quadrature on the exact flow within the step.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            Start.
        control : float
            The control that is held.
        dt : float
            Length of the step [s].
        nodes : int, default 16
            Nodes of the quadrature.

        Returns
        -------
        dict
            ``change`` of energy, ``work`` of the drive, ``loss`` to drag, and ``residual`` = change - work +
            loss.
        """
        dt = check_step(dt)
        points, weights = np.polynomial.legendre.leggauss(nodes)
        times = 0.5 * dt * (points + 1.0)
        states = np.array([self.simulate(state, [control], t)[1] for t in [*times, dt]])
        power = self.power(states[:-1], control)
        work, loss = (float(np.sum(0.5 * dt * weights * power[name])) for name in ("drive", "drag"))
        before, after = self.energy(state, control)["total"], self.energy(states[-1], control)["total"]
        change = float(after - before)
        return {"change": change, "work": work, "loss": loss, "residual": change - work + loss}

    def truncation_bound(self, state: ArrayLike, control: float, dt: float) -> pendulum.Bound | None:
        """Return what is known of a step before it is taken: substeps, and bounds on what they leave out.

        The bounds are proved for plain substeps; where heavy damping makes the step jump along the slow
        manifold instead, accuracy is tested, not proved. None for a scene that is stepped in closed form or
        by a series summed to rounding. See `pendulum.truncation_bound`.
        """
        if self.flow.coefficients is not pendulum.Drive:
            return None
        omega, drive = self._pendulum(state, control)
        return pendulum.truncation_bound(omega, drive, check_step(dt), self.order, self.flow.tolerance)

    def certified_speed(self, state: ArrayLike, control: float, dt: float) -> float | None:
        """Return the |θ'| up to which one series per step is certified, if the rest is as given [rad/s].

        Up to it, and not beyond, `truncation_bound` reports one substep, which leaves out at most 1e-12
        rad/s. It is below 0 where drive, drag or field are too strong for one series at any speed, and None
        for a scene that is not stepped by one.
        """
        if self.flow.coefficients is not pendulum.Drive:
            return None
        _, drive = self._pendulum(state, control)
        return pendulum.certified_speed(drive, check_step(dt), self.order, self.flow.tolerance)

    def _pendulum(self, state: ArrayLike, control: float) -> tuple[float, pendulum.Drive]:
        """Return θ' and the coefficients of the normal form."""
        y, u = self.lift(self.check_state(state)), check_number("control", control)
        k = SimpleNamespace(**self.constants())
        drive = pendulum.Drive(*map(float, self.drive(y, u, k, math)))
        return float(self.unpack(y, u, k)[1]), drive

    def lagrangian(self) -> sympy.Expr:
        """Return the Lagrangian T - V as a SymPy expression, with functions of time and parameters."""
        from lag_envs.lagrange import lagrangian

        return lagrangian(self)


def _check_range(field: dataclasses.Field, value: Any) -> float:
    unit = field.metadata["unit"]
    number = check_number(field.name, value, unit)
    above, least, below, most = (field.metadata[key] for key in ("above", "least", "below", "most"))
    for rule, limit, broken in (
        ("above", above, above is not None and not number > above),
        ("at least", least, least is not None and not number >= least),
        ("below", below, below is not None and not number < below),
        ("at most", most, most is not None and not number <= most),
        ("at least", SMALLEST, above == 0.0 and number < SMALLEST),
        ("at most", 1.0 / SMALLEST, number > 1.0 / SMALLEST),
    ):
        if broken:
            raise ValueError(
                f"{field.name} must be {rule} {limit:g} {unit}, got {number:g} {unit}".replace("  ", " ")
            )
    return number


def check_step(dt: Any) -> float:
    """Return the step as float, or raise a ValueError."""
    dt = check_number("dt", dt, "s")
    if not dt >= sys.float_info.min:  # what lies between has no inverse
        raise ValueError(f"dt must be above 0 s, got {dt:g} s")
    return dt


#: A normal force of this share of the weight is a rounding of zero, as on a vertical plane.
NO_LOAD = 1e-12


def friction_ratio(friction: Any, normal: Any, weight: float) -> Any:
    """Return |F|/N; infinite where the contact pulls, or carries nothing but a rounding of the weight."""
    friction, normal = np.broadcast_arrays(np.abs(friction), normal)
    out = np.full(normal.shape, np.inf)
    return np.divide(friction, normal, out=out, where=normal > NO_LOAD * weight)[()]
