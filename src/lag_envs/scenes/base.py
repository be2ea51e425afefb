"""The contract of a scene: it states its energies, and everything else follows from them."""

from __future__ import annotations

import copyreg
import dataclasses
import inspect
import math
import sys
import weakref
from abc import ABCMeta
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.mechanics import motion, recording
from lag_envs.mechanics.algebra import Atom, FormulaError, evaluate
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.evaluation import Carrying, Dual, Lanes, Numeric, OfLanes, Point
from lag_envs.mechanics.layout import Layout, check_name, make_layout, units
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import TWIN, Values
from lag_envs.scenes import picture
from lag_envs.scenes.checks import SMALLEST, StepRefused, check_number, check_step, real_array, shown
from lag_envs.scenes.shapes import Window
from lag_envs.stepping.pendulum import MAX_SUBSTEPS

if TYPE_CHECKING:
    import sympy

    from lag_envs.stepping.general import SeriesStepper, StepBound
    from lag_envs.stepping.normal_forms import NormalForm

Array = NDArray[np.float64]

#: Class attributes that are mappings, and those that are names in order.
MAPPINGS = ("coordinates", "prescribed", "controls", "modes", "reactions", "ratios")
SEQUENCES = ("state", "left_out")

#: Where a task notes the order of the series that it chose for its scene.
ORDER = "_order_of_task"

#: What a scene may define; all other public names of `Scene` are its calls.
DEFINED = (*MAPPINGS, *SEQUENCES, "rests", *recording.ARGUMENTS, "bodies", "indicators", "window", "check")


def parameter(
    default: float | Callable[[Any], float | None] | None,
    unit: str,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    usable: tuple[float, float] = (-math.inf, math.inf),
    optional: bool = False,
    endless: bool = False,
) -> Any:
    """Declare a physical parameter.

    Parameters
    ----------
    default : float, None, or function of the scene
        Its value unless another is given. A function takes it from the other parameters:
        ``lambda bar: bar.mass * bar.com_distance**2 / 3``.
    unit : str
        Its unit, for tables and errors.
    above, least, below, most : float, optional
        The range that it must lie in: above, at least, below, at most.
    usable : (float, float)
        The range in which an environment can be used, whatever its other parameters, see `Task.usable`; a
        scene alone may be stepped beyond it.
    optional : bool
        Whether None may be given; a default of None says so too.
    endless : bool
        Whether infinity may be given.
    """
    made = callable(default)
    return dataclasses.field(
        default=None if made else default,
        metadata={
            "unit": unit,
            "above": above,
            "least": least,
            "below": below,
            "most": most,
            "made": default if made else None,
            "optional": optional or (default is None),
            "endless": endless,
            "usable": usable,
        },
    )


# A class that goes to another process by value before it is used takes its fields along, and in them this
# mark, which is known by its identity: as a copy it would be taken for a default.
copyreg.pickle(type(dataclasses.MISSING), lambda mark: "MISSING")

#: Where a motion is singular, or a number too large, that state's results are not finite, and no others'.
_QUIET = np.errstate(all="ignore")

#: What was derived of scenes whose formulas passed the door: by class, and by `Scene._structure`.
_admitted: weakref.WeakKeyDictionary[type, dict[tuple, tuple[Layout, Mechanics]]] = (
    weakref.WeakKeyDictionary()
)


def is_own(kind: type) -> bool:
    """Tell whether a class is the package's: then nothing but its structure decides what formulas give.

    A formula of somebody else may use what is defined outside, and see it changed.
    """
    return kind.__module__.startswith("lag_envs.")


class SceneType(ABCMeta):
    """The type of scenes: a class is made a frozen dataclass, unless it is one, when it is used first."""

    def __call__(cls, *args: Any, **keywords: Any) -> Any:
        """Return a scene whose parameters and formulas have been checked."""
        complete(cls)
        scene = super().__call__(*args, **keywords)
        scene._admit()
        return scene

    @property
    def __signature__(cls) -> inspect.Signature:
        """The signature of a call, for help."""
        complete(cls)
        signature = inspect.signature(cls.__init__)  # type: ignore[misc]
        return signature.replace(parameters=list(signature.parameters.values())[1:])


def _annotations(cls: type) -> dict[str, Any]:
    """Return the class's own annotations; from Python 3.14 on they may name what is not there yet."""
    if sys.version_info >= (3, 14):
        import annotationlib

        return dict(annotationlib.get_annotations(cls, format=annotationlib.Format.FORWARDREF))
    return dict(inspect.get_annotations(cls))


def _frozen(given: Mapping) -> Mapping:
    """Return a copy of a mapping, and of those in it, that cannot be changed."""
    items = {key: _frozen(value) if isinstance(value, Mapping) else value for key, value in given.items()}
    return MappingProxyType(items)


def complete(cls: type) -> None:
    """Make the class a frozen dataclass, unless a decorator has."""
    if cls is Scene:
        raise FormulaError(
            "Scene is the base of scenes; derive a class with coordinates, kinetic and potential"
        )
    if "__dataclass_fields__" not in vars(cls):
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Scene(metaclass=SceneType):
    """A mechanical scene: parameters and energies, from which all else is derived. Immutable.

    A subclass declares its parameters with `parameter`, its coordinates and controls with their units, and
    writes its energies::

        class Pendulum(Scene):
            mass: float = parameter(1.0, "kg", above=0.0)
            length: float = parameter(1.0, "m", above=0.0)

            coordinates = {"theta": "rad"}
            controls = {"torque": "N m"}

            def kinetic(self, q, v, xp):
                return 0.5 * self.mass * (self.length * v.theta) ** 2

            def potential(self, q, xp):
                return -9.81 * self.mass * self.length * xp.cos(q.theta)

            def applied(self, q, v, u, xp):
                return {"theta": u.torque}

    Formulas use ``+ - * /``, whole powers and functions of ``xp``: sin, cos, tan, atan, tanh, sqrt, exp, log.
    They are run on recorded numbers, so they cannot branch on them. Fields that are no `parameter`, such as a
    number of bars, are structural: they may branch and count, and another value compiles anew.

    Attributes
    ----------
    coordinates : mapping from str to str
        Free coordinates and their units, in order.
    prescribed : mapping from str to str
        Coordinates that are moved from outside.
    controls : mapping from str to str
        Controls and their units. ``s_ddot``, ``s_dot`` or ``s`` sets the acceleration, the rate or the place
        of a prescribed coordinate ``s``; any other acts in `applied` or `dissipation`.
    modes : mapping from str to mapping
        In place of `controls`: several sets of them, chosen by the keyword ``control``.
    reactions : mapping from str to str
        Names of forces and the prescribed coordinate that each moves or holds.
    ratios : mapping from str to pair of str
        Names of ratios |F|/N and the reactions F and N.
    state : tuple of str
        Another order of the state.
    left_out : tuple of str
        What the state leaves out.
    """

    coordinates: ClassVar[Any] = MappingProxyType({})
    prescribed: ClassVar[Any] = MappingProxyType({})
    controls: ClassVar[Any] = MappingProxyType({})
    modes: ClassVar[Any] = MappingProxyType({})
    reactions: ClassVar[Any] = MappingProxyType({})
    ratios: ClassVar[Any] = MappingProxyType({})
    state: ClassVar[Any] = ()
    left_out: ClassVar[Any] = ()

    # --- what a scene defines ------------------------------------------------------------------------------

    def kinetic(self, q: Any, v: Any, xp: Any) -> Any:
        """Return the kinetic energy T [J]."""
        raise FormulaError("it is not defined; write kinetic(self, q, v, xp)")

    def potential(self, q: Any, xp: Any) -> Any:
        """Return the potential energy V [J]."""
        raise FormulaError("it is not defined; write potential(self, q, xp)")

    def dissipation(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return Rayleigh's function D [W]: drag is -∂D/∂v."""
        return 0.0

    def applied(self, q: Any, v: Any, u: Any, xp: Any) -> Any:
        """Return generalised forces by coordinate [N or N m]."""
        return {}

    def rests(self) -> Any:
        """Return where prescribed coordinates rest that no control moves; by default at 0."""
        return {}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return place and angle of each body, (x, y, angle) [m, m, rad]."""
        return {}

    def bodies(self) -> Any:
        """Return shapes by frame, from back to front: a body's own, an indicator's, or the fixed "ground"."""
        return {}

    def indicators(self, now: Any, xp: Any) -> Any:
        """Return where frames are that show more than bodies, such as a control's arrow.

        Parameters
        ----------
        now : picture.Now
            ``q``, ``state``, ``share`` and ``target``, each by name.
        xp : namespace
            As in formulas, with `where`, `abs`, `minimum` and `maximum`.

        Returns
        -------
        mapping
            By frame (x, y), (x, y, angle) or (x, y, angle, part), see `shapes.Pose`.
        """
        return {}

    def window(self) -> Window:
        """Return the part of the plane to look at: around the first body, as far as the others reach."""
        return picture.window(self)

    def check(self) -> None:
        """Raise ValueError where parameters, each in its range, do not fit together."""

    # --- how a class is made -------------------------------------------------------------------------------

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for parent in cls.__mro__[1:]:
            if isinstance(parent, SceneType) and parent is not Scene:
                complete(parent)
        own, annotations = vars(cls), _annotations(cls)
        faults = []
        for name in (*MAPPINGS, *SEQUENCES):
            kind = str(annotations.get(name, "ClassVar")).removeprefix("typing.")
            if kind.startswith("ClassVar"):
                continue
            # A dataclass would take it for a field; what is wrong is said when the class is used.
            if isinstance(own.get(name), dataclasses.Field):
                faults.append(f"{name} is part of every scene; give the parameter another name")
                delattr(cls, name)
            else:
                faults.append(f"{name} has an annotation; write {name} = ... without one")
            del annotations[name]
        if isinstance(own.get("modes"), Mapping) and own["modes"] and "control" not in annotations:
            annotations["control"] = "str"
            if "control" not in own:
                cls.control = next(iter(own["modes"]))  # type: ignore[attr-defined]
        if annotations != _annotations(cls):
            cls.__annotations__ = annotations
        for name in MAPPINGS:
            if isinstance(own.get(name), Mapping):
                setattr(cls, name, _frozen(own[name]))
        for name in SEQUENCES:
            if isinstance(own.get(name), list):
                setattr(cls, name, tuple(own[name]))
        cls._faults = tuple(faults)

    _faults: ClassVar[tuple[str, ...]] = ()

    def _admit(self) -> None:
        """Check parameters and, for the first scene of its kind, names and formulas."""
        _check_class(type(self))
        if self.modes:
            mode = self.control  # type: ignore[attr-defined]
            if not isinstance(mode, str) or mode not in self.modes:
                raise ValueError(f"control must be one of {', '.join(self.modes)}, got {shown(mode)}")
        fields = {f.name: f for f in dataclasses.fields(self) if "unit" in f.metadata}  # type: ignore[arg-type]
        made = [f for f in fields.values() if f.metadata["made"] and getattr(self, f.name) is None]
        for field in (*(f for f in fields.values() if f not in made), *made):
            value = getattr(self, field.name)
            if field in made:  # where it is out of range, those that it is made from are
                value = field.metadata["made"](self)
                value = None if value is None else check_number(field.name, value)
            elif value is not None or not field.metadata["optional"]:
                value = _check_range(field, value)
            object.__setattr__(self, field.name, value)
        self.check()
        try:
            key = self._structure
            known = _admitted.setdefault(type(self), {}).get(key)
        except TypeError as error:
            raise FormulaError(
                f"{type(self).__name__}: {error}; structural fields must be hashable"
            ) from error
        if known is not None and is_own(type(self)):
            vars(self)["_cached_layout"], vars(self)["_cached_mechanics"] = known
        elif known is None:
            _check_names(self)
            recording.check_again(self, self._layout, recording.record(self, self._layout))
            _check_motion(self, self.mechanics)
            _check_bodies(self)
            _admitted[type(self)][key] = self._layout, self.mechanics

    def _numbers(self) -> tuple[str, ...]:
        """Return the names of the parameters that have a value."""
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        return tuple(f.name for f in fields if "unit" in f.metadata and getattr(self, f.name) is not None)

    @property
    def _structure(self) -> tuple:
        """All that decides which code steps the scene; scenes that agree in it differ in numbers only."""
        cls, numbers = type(self), self._numbers()
        # By identity: a formula that calls super() would keep its own class alive.
        formulas = tuple(id(getattr(cls, name)) for name in ("rests", *recording.ARGUMENTS))
        fields = dataclasses.fields(self)  # type: ignore[arg-type]
        plain = tuple((f.name, getattr(self, f.name)) for f in fields if "unit" not in f.metadata)
        zero = tuple(name for name in numbers if getattr(self, name) == 0.0)
        return formulas, plain, numbers, zero

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> NoReturn:
        raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")

    def __reduce__(self) -> tuple:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        others = {n: value for n, value in vars(self).items() if not n.startswith("_") or n == ORDER}
        return _restore, (type(self), others | fields)

    # --- what follows: names -------------------------------------------------------------------------------

    @property
    def _layout(self) -> Layout:
        """Names of coordinates, controls and state."""
        found = vars(self).get("_cached_layout")
        if found is None:
            # Properties may branch and count on structural fields, not on parameters.
            copy, declared = recording.symbolic_twin(self), {}
            for name in (*MAPPINGS, *SEQUENCES):
                with recording.formula(self, name):
                    declared[name] = getattr(copy, name)
            controls, absent = _controls(self, declared.pop("modes"), declared.pop("controls"))
            found = make_layout(type(self).__name__, controls=controls, absent=absent, **declared)
            vars(self)["_cached_layout"] = found
        return found

    @property
    def mechanics(self) -> Mechanics:
        """The derived equations, as expressions."""
        if TWIN in vars(self):
            raise FormulaError(
                "a formula calls what is derived from it; it may use parameters and other formulas"
            )
        found = vars(self).get("_cached_mechanics")
        if found is None:
            found = motion.derive_motion(self, self._layout, recording.record(self, self._layout))
            vars(self)["_cached_mechanics"] = found
        return found

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries, in order."""
        return tuple(entry.name for entry in self._layout.state)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Their units."""
        return tuple(entry.unit for entry in self._layout.state)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls, in order."""
        return self._layout.controls

    @property
    def control_units(self) -> tuple[str, ...]:
        """Their units."""
        return self._layout.control_units

    # --- what follows: numbers -----------------------------------------------------------------------------

    def _check_state(self, state: ArrayLike) -> Array:
        """Return the state as a float64 array of shape (n_state,), or raise a ValueError."""
        array = self._check_states(state)
        if array.ndim != 1:
            raise ValueError(
                f"state must be ({', '.join(self.state_names)}), got shape {array.shape}: {shown(state)}"
            )
        return array

    def _check_states(self, states: ArrayLike) -> Array:
        """Return states as a float64 array of shape (..., n_state), or raise a ValueError."""
        array, names = real_array("state", states), self.state_names
        if array.shape[-1:] != (len(names),):
            raise ValueError(f"state must be ({', '.join(names)}), got shape {array.shape}: {shown(states)}")
        bad = ~np.isfinite(array)
        if bad.any():
            row = array[tuple(np.argwhere(bad)[0][:-1])]
            raise ValueError(f"state must be finite, got {dict(zip(names, row.tolist(), strict=True))}")
        return array

    def _check_controls(self, control: ArrayLike, ndim: int) -> Array:
        """Return controls as a float64 array of shape (..., n_controls), or raise a ValueError.

        A single control may stand without its axis; `ndim` is that of the states, by which this is told.
        """
        array, names = real_array("the control", control), self.control_names
        bad = ~np.isfinite(array)
        if bad.any():
            raise ValueError(
                f"the control must be finite, got {array[bad].flat[0]} at {np.argwhere(bad)[0].tolist()}"
            )
        if array.ndim == 0 and (len(names) == 1 or array == 0.0):
            return np.full(len(names), float(array))
        if len(names) == 1 and not (array.shape[-1] == 1 and array.ndim >= ndim):
            return array[..., None]
        if array.shape[-1:] != (len(names),):
            wanted = f"({', '.join(names)})" if names else "left out, since the scene has none"
            raise ValueError(f"the control must be {wanted}, got an array of shape {array.shape}")
        return array

    def _check_both(self, state: ArrayLike, control: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
        """Return states and controls with their last axes, and the shape of what follows from both."""
        states = self._check_states(state)
        controls = self._check_controls(control, states.ndim)
        try:
            return states, controls, np.broadcast_shapes(states.shape[:-1], controls.shape[:-1])
        except ValueError:
            raise ValueError(
                f"states of shape {states.shape} and controls of shape {controls.shape} do not fit together"
            ) from None

    def _point(self, state: ArrayLike, control: ArrayLike) -> tuple[Point, tuple[int, ...]]:
        """Return the motion at states under controls, and the shape of its numbers."""
        states, controls, shape = self._check_both(state, control)
        y, u = (list(np.moveaxis(array, -1, 0)) for array in (states, controls))
        return Point(self.mechanics, self._symbols(), y, u, Numeric), shape

    def _symbols(self) -> dict[Atom, float]:
        """Return the parameters' values by symbol."""
        return {recording.parameter(name): np.float64(getattr(self, name)) for name in self._numbers()}

    @_QUIET
    def acceleration(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the accelerations of the free coordinates, by name.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The controls that are held; a single one may stand without its axis.
        """
        point, shape = self._point(state, control)
        return {name: _shaped(point.acceleration[name], shape) for name in self._layout.free}

    @_QUIET
    def mass_matrix(self, state: ArrayLike, control: ArrayLike = 0.0) -> Array:
        """Return the mass matrix of the free coordinates, shape (..., n, n)."""
        point, shape = self._point(state, control)
        n = len(self._layout.free)
        return np.stack([_shaped(x, shape) for x in point.mass], axis=-1).reshape(*shape, n, n)

    @_QUIET
    def energy(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return kinetic, potential and total energy [J].

        Where the kinetic energy has terms T₁ or T₀ of first or no degree in the velocities, also ``jacobi``,
        Jacobi's integral T₂ - T₀ + V: that is what `power` changes.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The controls that are held; they matter where a velocity depends on them.
        """
        point, shape = self._point(state, control)
        names = self._layout.names
        q = Values("coordinate", {name: Lanes(point.values[place(name)]) for name in names})
        v = Values("velocity of a coordinate", {name: Lanes(point.values[velocity(name)]) for name in names})
        given = self.kinetic(q, v, OfLanes), self.potential(q, OfLanes)
        kinetic, potential = (x.value if isinstance(x, Lanes) else x for x in given)
        energies = {"kinetic": kinetic, "potential": potential, "total": kinetic + potential}
        if self.mechanics.gyroscopic is not None:
            linear, rest = point.of(self.mechanics.gyroscopic)
            energies["jacobi"] = kinetic - linear - 2.0 * rest + potential
        return {name: _shaped(value, shape) for name, value in energies.items()}

    @_QUIET
    def forces(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the forces [N] and torques [N m] that move or hold prescribed coordinates, and ratios.

        Those of `reactions` have the names that it gives; what moves another coordinate s is ``drive_s``. A
        ratio |F|/N is infinite where N is not above 1e-12 of the weight: the contact carries nothing, or
        pulls.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The controls that are held.
        """
        point, shape = self._point(state, control)
        layout = self._layout
        named = dict(layout.reactions)
        for p in layout.at("acceleration", "rate"):
            if p.name not in named.values():
                named[f"drive_{p.name}"] = p.name
        forces = {k: _shaped(f, shape) for k, f in zip(named, point.force(list(named.values())), strict=True)}
        for name, friction, normal in layout.ratios:
            least = _shaped(1e-12 * point.weight(named[normal]), shape)
            out = np.full(shape, np.inf)
            carries = forces[normal] > least
            forces[name] = np.divide(np.abs(forces[friction]), forces[normal], out=out, where=carries)[()]
        return forces

    @_QUIET
    def power(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the powers of ``drive`` and ``applied`` forces and that lost to ``drag`` [W].

        Energy changes by drive + applied - drag. What drives a coordinate whose rate the state leaves out is
        the inertial force of its frame.
        """
        point, shape = self._point(state, control)
        return {name: _shaped(value, shape) for name, value in point.power().items()}

    @_QUIET
    def linearise(self, state: ArrayLike, control: ArrayLike = 0.0) -> tuple[Array, Array]:
        """Return the derivatives of the state's rate of change by state and control, (A, B).

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The controls that are held.

        Returns
        -------
        A : ndarray, shape (..., n_state, n_state)
            ∂(d state/dt)/∂state, exact.
        B : ndarray, shape (..., n_state, n_controls)
            ∂(d state/dt)/∂control.
        """
        states, controls, shape = self._check_both(state, control)
        n = states.shape[-1]
        unit = np.eye(n + controls.shape[-1])
        numbers = [Dual(states[..., i], unit[i]) for i in range(n)]
        numbers += [Dual(controls[..., i], unit[n + i]) for i in range(controls.shape[-1])]
        point = Point(self.mechanics, self._symbols(), numbers[:n], numbers[n:], Carrying)
        slopes = [rate.slope if isinstance(rate, Dual) else np.zeros(len(unit)) for rate in point.rates()]
        both = np.stack([np.broadcast_to(slope, (*shape, len(unit))) for slope in slopes], axis=-2)
        return both[..., :n].copy(), both[..., n:].copy()

    # --- what follows: steps -------------------------------------------------------------------------------

    @property
    def _stepper(self) -> SeriesStepper:
        from lag_envs.stepping.general import stepper_of

        return stepper_of(self.mechanics)

    @property
    def _form(self) -> NormalForm | None:
        """The equation of motion where it has an exact flow of its own, else None."""
        from lag_envs.stepping.normal_forms import normal_form

        return normal_form(self.mechanics)

    def _constants(self) -> dict[str, float]:
        """Return the numbers that a step needs, made from the parameters."""
        found = vars(self).get("_cached_constants")
        if found is None:
            source = self._form or self._stepper
            found = source.constants({name: getattr(self, name) for name in self._numbers()})
            for name, value in found.items():
                if not math.isfinite(value):
                    raise ValueError(
                        f"these parameters make a coefficient of the motion, {name}, {value}: {self}"
                    )
            vars(self)["_cached_constants"] = found
        return found

    def _order(self, dt: float) -> int:
        """Return the order of the series for a control step; 0 for a closed form."""
        from lag_envs.stepping.general import usual_order

        if self._form:
            return self._form.order(dt)
        return vars(self).get(ORDER) or usual_order(dt)

    def _limit(self, dt: float) -> float:
        """Return what a step takes besides dt: the largest x of one series, or the order of the series."""
        return self._form.largest_x(dt) if self._form else float(self._order(dt))

    def _code(self, dt: float) -> Any:
        """Return the code of a control step."""
        absent = frozenset(name for name, value in self._constants().items() if value == 0.0)
        return self._form.stepper(dt, absent) if self._form else self._stepper.code(absent)

    def simulate(self, state: ArrayLike, controls: ArrayLike | int, dt: float) -> Array:
        """Step the equations of motion with each control held for one step.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            Start, in the order of `state_names`.
        controls : array_like, shape (T,) or (T, n_controls); int for a scene without controls
            One set of controls per step, neither clipped nor guarded; or the number of steps.
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
            Where a step cannot be certified within the cap on substeps, or has no finite result. Its
            attribute `trajectory` holds the rows before that.
        """
        start, dt = self._check_state(state), check_step(dt)
        given = self._check_sequence(controls)
        trajectory = np.empty((len(given) + 1, len(start)))
        trajectory[0] = start
        code, constants = self._code(dt), self._constants()
        numbers = [constants[name.removeprefix("k_")] for name in code.constants]
        row = code.simulation(trajectory, given, dt, self._limit(dt), *numbers)
        if not row and not np.isfinite(trajectory[-1]).all():
            row = int(np.argmin(np.isfinite(trajectory).all(axis=1)))
        if row:
            raise self._refusal(
                trajectory[row - 1], given[row - 1], dt, trajectory[:row], f"step {row - 1} of {len(given)}"
            )
        return trajectory

    def _check_sequence(self, controls: ArrayLike | int) -> Array:
        """Return controls as an array of shape (T, n_controls), or raise a ValueError."""
        n = len(self.control_names)
        if n == 0:
            if isinstance(controls, bool) or not isinstance(controls, int | np.integer) or controls < 0:
                raise ValueError(
                    "this scene has no control: give the number of steps in place of controls, "
                    f"got {controls!r:.60}"
                )
            return np.empty((int(controls), 0))
        array = real_array("controls", controls)
        if array.ndim == 1 and n == 1:
            array = array[:, None]
        if array.ndim != 2 or array.shape[1] != n:
            wanted = "(T,)" if n == 1 else f"(T, {n}), in each row {', '.join(self.control_names)}"
            raise ValueError(f"controls must have shape {wanted}, got {array.shape}")
        bad = ~np.isfinite(array)
        if bad.any():
            raise ValueError(
                f"controls must be finite, got {array[bad][0]} in row {int(np.argwhere(bad)[0, 0])}"
            )
        return array

    def step_bound(self, state: ArrayLike, control: ArrayLike = 0.0, dt: float = 0.02) -> StepBound:
        """Return how a control step is divided, and what its series leave out at most.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            Where the step begins.
        control : array_like, shape (n_controls,) or ()
            The controls that are held.
        dt : float
            Length of the step [s].

        Returns
        -------
        StepBound
            Substeps, order, and for each entry of the state a proved bound on the truncation error, summed
            over the substeps; rounding, and the growth of earlier substeps' errors along the motion, come on
            top. The bound of a pendulum is proved before the step, for plain substeps; where heavy damping
            makes it follow the slow manifold instead, accuracy is tested, not proved. Linear motion is
            stepped to rounding: in closed form, or by a series whose rest is below it.

        Raises
        ------
        ValueError, StepRefused
            As `simulate` does.
        """
        from lag_envs.stepping.general import StepBound

        start, dt = self._check_state(state), check_step(dt)
        held = self._check_controls(control, 1).reshape(-1)
        if self._form:
            return self._form.step_bound(start, list(held), dt, self._constants())
        code, constants = self._code(dt), self._constants()
        numbers = [constants[name.removeprefix("k_")] for name in code.constants]
        order = self._order(dt)
        status, bounds = code.bounded(start.tolist(), held.tolist(), dt, order, numbers)
        if status < 0:
            raise self._refusal(start, held, dt, None, "the step")
        of = {("place", name): bounds[0][i] for i, name in enumerate(self._layout.free)}
        of |= {("velocity", name): bounds[1][i] for i, name in enumerate(self._layout.free)}
        by_state = {e.name: float(of.get((e.kind, e.coordinate), 0.0)) for e in self._layout.state}
        return StepBound(status, order, by_state, "proved with the step")

    truncation_bound = step_bound

    def jacobian(self, state: ArrayLike, control: ArrayLike = 0.0, dt: float = 0.02) -> tuple[Array, Array]:
        """Return the derivatives of the state after a control step by the state before it and by controls.

        The derivatives go through the same series and substeps as the step itself.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            Where the step begins.
        control : array_like, shape (..., n_controls), or (...) for one control
            The controls that are held.
        dt : float
            Length of the step [s].

        Returns
        -------
        A : ndarray, shape (..., n_state, n_state)
            By the state.
        B : ndarray, shape (..., n_state, n_controls)
            By the controls.

        Raises
        ------
        ValueError, StepRefused
            As `simulate` does.
        """
        from lag_envs.stepping.general import usual_order

        states, controls, shape = self._check_both(state, control)
        dt = check_step(dt)
        n, m = states.shape[-1], controls.shape[-1]
        count = math.prod(shape)
        states = np.broadcast_to(states, (*shape, n)).reshape(count, n)
        controls = np.broadcast_to(controls, (*shape, m)).reshape(count, m)
        parameters = {name: getattr(self, name) for name in self._numbers()}
        found, refused = self._stepper.jacobian(
            states, controls, parameters, dt, self._order(dt) or usual_order(dt)
        )
        if refused:
            i = refused - 1
            raise self._refusal(states[i], controls[i], dt, None, f"the step of row {i}")
        found = found.reshape(*shape, n, n + m)
        return found[..., :n], found[..., n:]

    def _refusal(
        self, state: Array, control: ArrayLike, dt: float, trajectory: Array | None, where: str
    ) -> StepRefused:
        """Return the error for a step that was refused."""
        start = ", ".join(f"{n}={v:g}" for n, v in zip(self.state_names, state, strict=True))
        held = zip(self.control_names, np.atleast_1d(np.asarray(control, dtype=np.float64)), strict=True)
        why = "it could not be certified within the largest number of substeps"
        if self._form is not None:
            why = f"it would need more than {MAX_SUBSTEPS:,} substeps"
        error = StepRefused(
            f"{where} was refused: from ({start}) with "
            f"{', '.join(f'{n}={v:g}' for n, v in held) or 'no control'} and dt={dt:g} s {why}, or has no "
            "finite result; take a smaller dt or milder parameters"
        )
        error.trajectory = None if trajectory is None else trajectory.copy()
        return error

    def lagrangian(self) -> sympy.Expr:
        """Return the Lagrangian T - V as a SymPy expression, with functions of time and parameters."""
        from lag_envs.lagrange import lagrangian

        return lagrangian(self)

    @staticmethod
    def from_sympy(
        name: str,
        kinetic: Any,
        potential: Any,
        *,
        coordinates: Mapping,
        controls: Any = (),
        prescribed: Any = (),
        dissipation: Any = 0,
        applied: Any = None,
        parameters: Any = (),
    ) -> Scene:
        """Return a scene of SymPy expressions.

        Parameters
        ----------
        name : str
            Name of its class.
        kinetic, potential, dissipation : SymPy expression
            The energies [J], and Rayleigh's function [W].
        coordinates, prescribed, controls : dict from symbol to str
            Free and prescribed coordinates and controls with their units. The velocity of a function of time
            is its derivative, ``theta.diff(t)``, that of a plain symbol ``theta`` the symbol ``theta_dot``.
        applied : dict from symbol to expression, optional
            Generalised forces by coordinate.
        parameters : dict from symbol to float
            The other symbols with their numbers.

        Returns
        -------
        Scene
            A scene with these numbers. Called with keywords it gives one with others: ``scene(m=2.0)``.

        Examples
        --------
        >>> import sympy
        >>> theta, theta_dot, m, l, tau = sympy.symbols("theta theta_dot m l tau")
        >>> pendulum = Scene.from_sympy(
        ...     "Pendulum", m * l**2 * theta_dot**2 / 2, -9.81 * m * l * sympy.cos(theta),
        ...     coordinates={theta: "rad"}, controls={tau: "N m"}, applied={theta: tau}, parameters={m: 1.0,
        ... l: 2.0}, )
        >>> pendulum.acceleration([0.0, 0.0], 1.0)["theta"].item(), pendulum(m=0.5).m
        (0.25, 0.5)
        """
        from lag_envs.lagrange import from_sympy

        return from_sympy(
            name,
            kinetic,
            potential,
            coordinates=coordinates,
            controls=controls,
            prescribed=prescribed,
            dissipation=dissipation,
            applied=applied,
            parameters=parameters,
        )

    def energy_balance(
        self, state: ArrayLike, control: ArrayLike, dt: float, *, nodes: int = 16
    ) -> dict[str, float]:
        """Compare a step's change of energy with the work done on it [J].

        Work and loss are integrated by Gauss-Legendre quadrature on the exact flow within the step.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            Start.
        control : float or array_like, shape (n_controls,)
            The controls that are held.
        dt : float
            Length of the step [s].
        nodes : int, default 16
            Nodes of the quadrature.

        Returns
        -------
        dict
            ``change`` of energy, or of Jacobi's integral where `energy` has it; ``work`` of drive and applied
            forces, ``loss`` to drag, and ``residual`` = change - work + loss.
        """
        dt = check_step(dt)
        controls = self._check_controls(control, 1)
        points, weights = np.polynomial.legendre.leggauss(nodes)
        times = 0.5 * dt * (points + 1.0)
        held: Any = controls[None] if self.control_names else 1
        states = np.array([self.simulate(state, held, t)[1] for t in [*times, dt]])
        power = self.power(states[:-1], controls)
        work, loss = (
            float(np.sum(0.5 * dt * weights * value))
            for value in (power["drive"] + power["applied"], power["drag"])
        )
        name = "total" if self.mechanics.gyroscopic is None else "jacobi"
        change = float(self.energy(states[-1], controls)[name] - self.energy(state, controls)[name])
        return {"change": change, "work": work, "loss": loss, "residual": change - work + loss}


def _shaped(value: Any, shape: tuple[int, ...]) -> Any:
    """Return a float64 array of a shape, or a number where the shape is empty."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), shape).copy()[()]


def _restore(cls: type[Scene], state: dict[str, Any]) -> Scene:
    """Return a scene from a pickle, perhaps the first of its class in this process."""
    complete(cls)
    scene = object.__new__(cls)
    for name, value in state.items():
        object.__setattr__(scene, name, value)
    scene._admit()
    return scene


def _controls(scene: Scene, modes: Any, controls: Any) -> tuple[Any, tuple[str, ...]]:
    """Return the mode's controls, and the names of all modes' controls."""
    of = type(scene).__name__
    if not isinstance(modes, Mapping):
        raise FormulaError(f"{of}.modes must map names to controls, got {modes!r:.80}")
    if not modes:
        return controls, ()
    if controls:
        raise FormulaError(f"{of} has controls and modes; put the controls into the modes")
    every: dict[str, str] = {}
    for mode, given in modes.items():
        every |= units(f"{of}.modes[{mode!r}]", given)
    return modes[scene.control], tuple(every)  # type: ignore[attr-defined]


def _check_class(cls: type[Scene]) -> None:
    """Raise a FormulaError for what can be seen of a class without running its formulas."""
    of = cls.__name__
    for c in cls.__mro__[: cls.__mro__.index(Scene)]:
        if "drive" in vars(c) and "pack" in vars(c) and "unpack" in vars(c):
            raise FormulaError(
                f"{of} is written for lag_envs 0.1, with drive, unpack and pack; write kinetic, potential, "
                "dissipation and applied, from which these follow (see CHANGELOG.md)"
            )
        if "shapes" in vars(c):
            raise FormulaError(f"{of}.shapes: {picture.INSTEAD_OF_SHAPES}")
    faults = [fault for c in cls.__mro__ for fault in vars(c).get("_faults", ())]
    if faults:
        raise FormulaError(f"{of}.{faults[0]}")
    if not cls.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise FormulaError(
            f"{of} is no frozen dataclass; write @dataclasses.dataclass(frozen=True, kw_only=True)"
        )


def _check_names(scene: Scene) -> None:
    """Raise a FormulaError where a name is taken."""
    cls, of = type(scene), type(scene).__name__
    public = {name for name in dir(Scene) if not name.startswith("_")}
    for c in cls.__mro__[: cls.__mro__.index(Scene)]:
        for name in (*_annotations(c), *vars(c)):
            if name in public and name not in DEFINED:
                raise FormulaError(f"{of}.{name} hides what every scene has under this name; choose another")
    layout = scene._layout
    derived = [name + ending for name in layout.names for ending in ("", "_dot", "_ddot")]
    taken = {
        **dict.fromkeys(DEFINED, "part of every scene"),
        **dict.fromkeys((e.name for e in layout.state), "an entry of the state"),
        **dict.fromkeys(derived, "a coordinate or its derivative"),
        **dict.fromkeys((*layout.controls, *layout.absent), "a control"),
    }
    for field in dataclasses.fields(scene):  # type: ignore[arg-type]
        check_name(of, field.name)
        if field.name in taken:
            raise FormulaError(
                f"{of}: the field {field.name!r} has the name of {taken[field.name]}; choose another"
            )
    others = set(layout.controls) - {p.control for p in layout.prescribed}
    for name in sorted(others & {e.name for e in layout.state}):
        raise FormulaError(
            f"{of}: the control {name!r} has the name of an entry of the state; choose another"
        )


def _check_bodies(scene: Scene) -> None:
    """Raise a FormulaError where a body has no place, or a force no equation."""
    of, found = type(scene).__name__, scene.mechanics
    with recording.formula(scene, "bodies"):
        bodies = scene.bodies()
    if not isinstance(bodies, Mapping):
        raise FormulaError(f"{of}.bodies must return shapes by body, got {bodies!r:.60}")
    known = [picture.GROUND, *found.record.poses, *picture.indicated(scene, picture.at_rest(scene))]
    for body, shapes in bodies.items():
        if body not in known:
            raise picture.no_place(scene, "bodies", body, known)
        picture.check_shapes(scene, body, shapes)
    try:
        found.full  # noqa: B018
    except FormulaError as error:
        raise FormulaError(f"{of}.{error}") from error


def _check_motion(scene: Scene, found: Mechanics) -> None:
    """Raise a FormulaError where the mass matrix cannot be inverted, wherever one looks."""
    n = len(found.free)
    values = {recording.parameter(name): np.float64(getattr(scene, name)) for name in scene._numbers()}
    generator = np.random.default_rng(11)
    symbols = sorted({s for e in found.entries() for s in e.symbols()} - set(values), key=lambda s: s.text)
    seen = []
    with np.errstate(all="ignore"):
        for low, high in ((0.1, 1.5), (-3.0, 3.0), (0.01, 0.1), (1.0, 10.0)) * 4:
            at = values | {symbol: generator.uniform(low, high) for symbol in symbols}
            matrix = np.array([float(x) for x in evaluate(found.entries(), at, Numeric)]).reshape(n, n)
            if not np.isfinite(matrix).all():
                continue
            size = np.sqrt(np.abs(np.diag(matrix)))
            if not (size > 0.0).all():
                seen.append(0.0)
                continue
            seen.append(float(np.linalg.eigvalsh(matrix / np.outer(size, size))[0]))
    if seen and max(seen) < 1e-13:
        what = "singular" if max(seen) > -1e-13 else "not positive"
        raise FormulaError(
            f"{type(scene).__name__}.kinetic gives a mass matrix of {', '.join(found.free)} that is {what}; "
            "every motion of the free coordinates needs a positive kinetic energy"
        )


def _check_range(field: dataclasses.Field, value: Any) -> float:
    unit = field.metadata["unit"]
    number = check_number(field.name, value, unit, endless=field.metadata["endless"])
    above, least, below, most = (field.metadata[key] for key in ("above", "least", "below", "most"))
    for rule, limit, broken in (
        ("above", above, above is not None and not number > above),
        ("at least", least, least is not None and not number >= least),
        ("below", below, below is not None and not number < below),
        ("at most", most, most is not None and not number <= most),
        ("at least", SMALLEST, above == 0.0 and number < SMALLEST),
        ("at most", 1.0 / SMALLEST, math.isfinite(number) and number > 1.0 / SMALLEST),
    ):
        if broken:
            raise ValueError(
                f"{field.name} must be {rule} {limit:g} {unit}, got {number:g} {unit}".replace("  ", " ")
            )
    return number
