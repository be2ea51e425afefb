"""The contract of a scene: it states its energies, and everything else follows from them."""

from __future__ import annotations

import dataclasses
import inspect
from abc import ABCMeta
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, dataclass_transform, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lag_envs.errors import hint
from lag_envs.mechanics import motion, recording
from lag_envs.mechanics.algebra import Atom, FormulaError
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.evaluation import (
    DualArray,
    DualArrayFunctions,
    LaneArray,
    LaneArrayFunctions,
    MotionPoint,
    Numeric,
    exactly,
)
from lag_envs.mechanics.motion import Mechanics
from lag_envs.mechanics.recording import TWIN, Values, parameter_values
from lag_envs.scenes import picture, steps
from lag_envs.scenes.checks import check_both
from lag_envs.scenes.declaring import ORDER, complete, declare_scene
from lag_envs.scenes.derivation import layout_of, undefined
from lag_envs.scenes.door import admit, check_class
from lag_envs.scenes.parameters import parameter as parameter
from lag_envs.scenes.shapes import Window

if TYPE_CHECKING:
    import sympy

    from lag_envs.scenes.fitting.result import Fit
    from lag_envs.stepping.general import StepBound

Array = NDArray[np.float64]

#: If the motion is singular or a number is too large, only the results of that state are not finite.
_QUIET = np.errstate(all="ignore")


class SceneType(ABCMeta):
    """The type of scenes; on first use it makes a class a frozen dataclass, unless it already is one."""

    def __call__(cls, *args: Any, **keywords: Any) -> Any:
        """Return a scene with checked parameters and formulas."""
        complete(cls)
        check_class(cls, Scene)
        try:
            scene = super().__call__(*args, **keywords)
        except TypeError as error:
            fields = [field.name for field in dataclasses.fields(cls) if field.init]  # type: ignore[arg-type]
            unknown = [name for name in keywords if name not in fields]
            if not (unknown or args):
                raise
            remedy = hint(unknown[0], fields) if unknown else f"give {', '.join(fields)} by name"
            raise TypeError(f"{error}; {remedy}") from None
        except dataclasses.FrozenInstanceError as error:
            raise FormulaError(
                f"{cls.__name__}: {error}, because scenes never change; declare the numbers of a class "
                "instead of setting them, as in `mass: float = parameter(1.0, 'kg')`; to compute a number "
                "from other parameters, give a function of the scene in place of 1.0"
            ) from error
        admit(scene, Scene)
        return scene

    @property
    def __signature__(cls) -> inspect.Signature:
        """The signature of a call, for help."""
        complete(cls)
        signature = inspect.signature(cls.__init__)  # type: ignore[misc]
        return signature.replace(parameters=list(signature.parameters.values())[1:])


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Scene(metaclass=SceneType):
    """A mechanical scene: parameters and energies, from which everything else is derived. Immutable.

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

    The entries of ``q``, ``v`` and ``u`` can be accessed by name, by index and in order. The order of ``q``
    and ``v`` differs from that of the state: the free coordinates come first, then the prescribed ones, both
    in the order in which they are declared.

    Formulas use ``+ - * /``, whole powers and functions of ``xp``: sin, cos, tan, atan, tanh, sqrt, exp, log.
    Formulas are run on recorded numbers, so they cannot branch on these numbers. Fields that are not a
    `parameter`, such as a number of bars, are structural: formulas may branch on them, and a new value needs
    a new compilation.

    Attributes
    ----------
    coordinates : mapping from str to str
        Free coordinates and their units, in order.
    prescribed : mapping from str to str
        Coordinates that are moved from outside.
    controls : mapping from str to str
        Controls and their units. ``s_ddot``, ``s_dot`` or ``s`` sets the acceleration, the rate or the place
        of a prescribed coordinate ``s``; any other control acts in `applied` or `dissipation`.
    modes : mapping from str to mapping
        In place of `controls`: several sets of controls, chosen by the keyword ``control``.
    reactions : mapping from str to str
        Names of forces, and the prescribed coordinate that each force moves or holds.
    ratios : mapping from str to pair of str
        Names of ratios |F|/N and the reactions F and N.
    state : tuple of str
        Another order of the state.
    left_out : tuple of str
        Entries that the state leaves out.
    """

    coordinates: ClassVar[Any] = MappingProxyType({})
    prescribed: ClassVar[Any] = MappingProxyType({})
    controls: ClassVar[Any] = MappingProxyType({})
    modes: ClassVar[Any] = MappingProxyType({})
    reactions: ClassVar[Any] = MappingProxyType({})
    ratios: ClassVar[Any] = MappingProxyType({})
    state: ClassVar[Any] = ()
    left_out: ClassVar[Any] = ()

    # --- defined by a scene --------------------------------------------------------------------------------

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
        """Return the resting places of prescribed coordinates without a control; by default 0."""
        return {}

    def poses(self, q: Any, xp: Any) -> Any:
        """Return place and angle of each body, (x, y, angle) [m, m, rad]."""
        return {}

    def bodies(self) -> Any:
        """Return shapes by frame (a body, an indicator, or the fixed "ground"), from back to front."""
        return {}

    def indicators(self, now: Any, xp: Any) -> Any:
        """Return poses of frames that show more than bodies, such as a control's arrow.

        Parameters
        ----------
        now : picture.Now
            ``q``, ``state``, ``share`` and ``target``, each by name.
        xp : namespace
            As in formulas, with `where`, `abs`, `minimum` and `maximum`.

        Returns
        -------
        mapping
            For each frame (x, y), (x, y, angle) or (x, y, angle, part); see `shapes.Pose`.
        """
        return {}

    def window(self) -> Window:
        """Return the visible part of the plane: around the first body, as far as the other bodies reach."""
        return picture.window(self)

    def check(self) -> None:
        """Raise ValueError if parameters that lie in their ranges do not fit together."""

    # --- how a class is made -------------------------------------------------------------------------------

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        declare_scene(cls, SceneType)

    _faults: ClassVar[tuple[str, ...]] = ()

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> NoReturn:
        raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")

    def __reduce__(self) -> tuple:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        others = {n: value for n, value in vars(self).items() if not n.startswith("_") or n == ORDER}
        return _restore, (type(self), others | fields)

    # --- derived: names ------------------------------------------------------------------------------------

    @property
    def mechanics(self) -> Mechanics:
        """The derived equations, as expressions."""
        if TWIN in vars(self):
            raise FormulaError(
                "a formula calls something that is derived from the formula; formulas may use only "
                "parameters and other formulas; in a task, self.scene.kinetic and self.scene.potential "
                "give the energy"
            )
        found = vars(self).get("_cached_mechanics")
        if found is None:
            layout = layout_of(self)
            found = motion.derive_motion(self, layout, recording.record_scene(self, layout))
            vars(self)["_cached_mechanics"] = found
        return found

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries, in order."""
        return tuple(entry.name for entry in layout_of(self).state)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Units of the state's entries."""
        return tuple(entry.unit for entry in layout_of(self).state)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls, in order."""
        return layout_of(self).controls

    @property
    def control_units(self) -> tuple[str, ...]:
        """Units of the controls."""
        return layout_of(self).control_units

    # --- derived: numbers ----------------------------------------------------------------------------------

    def _point(self, state: ArrayLike, control: ArrayLike) -> tuple[MotionPoint, tuple[int, ...]]:
        """Return the motion at states under controls, and the shape of its numbers."""
        mechanics = self.mechanics
        states, controls, shape = check_both(self, state, control)
        y, u = (list(np.moveaxis(array, -1, 0)) for array in (states, controls))
        try:
            return MotionPoint(mechanics, self._symbols(), y, u, Numeric), shape
        except ArithmeticError as error:  # from parameters alone: with arrays there are infinities
            raise ValueError(undefined(self)) from error

    def _symbols(self) -> dict[Atom, Any]:
        """Return the parameters' values by symbol."""
        return exactly(parameter_values(self))

    @_QUIET
    def acceleration(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the accelerations of the free coordinates, by name; not finite where the motion is singular.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The held controls; a single control may be given without its axis.
        """
        point, shape = self._point(state, control)
        return {name: _shaped(point.acceleration[name], shape) for name in layout_of(self).free}

    @_QUIET
    def mass_matrix(self, state: ArrayLike, control: ArrayLike = 0.0) -> Array:
        """Return the mass matrix of the free coordinates, shape (..., n, n)."""
        point, shape = self._point(state, control)
        n = len(layout_of(self).free)
        return np.stack([_shaped(x, shape) for x in point.mass], axis=-1).reshape(*shape, n, n)

    @_QUIET
    def energy(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return kinetic, potential and total energy [J].

        If the kinetic energy has terms T₁ or T₀, of degree one or zero in the velocities, there is also
        ``jacobi``, Jacobi's integral T₂ - T₀ + V, whose rate of change is given by `power`.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The held controls, 0 by default; they matter where a control sets a coordinate's rate.
        """
        point, shape = self._point(state, control)
        names = layout_of(self).names
        q = Values("coordinate", {name: LaneArray(point.values[place(name)]) for name in names})
        v = Values(
            "velocity of a coordinate", {name: LaneArray(point.values[velocity(name)]) for name in names}
        )
        try:
            given = self.kinetic(q, v, LaneArrayFunctions), self.potential(q, LaneArrayFunctions)
        except ArithmeticError as error:
            raise ValueError(f"the energy is undefined with these parameters, {error}: {self}") from error
        kinetic, potential = (x.value if isinstance(x, LaneArray) else x for x in given)
        energies = {"kinetic": kinetic, "potential": potential, "total": kinetic + potential}
        if self.mechanics.gyroscopic is not None:
            linear, rest = point.of(self.mechanics.gyroscopic)
            energies["jacobi"] = kinetic - linear - 2.0 * rest + potential
        return {name: _shaped(value, shape) for name, value in energies.items()}

    @_QUIET
    def forces(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the forces [N] and torques [N m] that move or hold prescribed coordinates, and ratios.

        The forces in `reactions` have the names given there. The force on any other coordinate s whose
        acceleration or rate is a control is ``drive_s``. For a coordinate at rest, or held at a place by a
        control, only forces named in `reactions` are returned. A ratio |F|/N is infinite if N is at most
        1e-12 of the weight: the contact carries no load, or pulls.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The held controls, 0 by default; they matter in every driven scene.
        """
        point, shape = self._point(state, control)
        layout = layout_of(self)
        named = dict(layout.forces)
        forces = {k: _shaped(f, shape) for k, f in zip(named, point.force(list(named.values())), strict=True)}
        for name, friction, normal in layout.ratios:
            least = _shaped(1e-12 * point.weight(named[normal]), shape)
            out = np.full(shape, np.inf)
            carries = forces[normal] > least
            forces[name] = np.divide(np.abs(forces[friction]), forces[normal], out=out, where=carries)[()]
        return forces

    @_QUIET
    def power(self, state: ArrayLike, control: ArrayLike = 0.0) -> dict[str, Any]:
        """Return the powers of ``drive`` and ``applied`` forces, and the power lost to ``drag`` [W].

        Energy changes by drive + applied - drag. If the state leaves out the rate of a coordinate, the drive
        of this coordinate is the inertial force of its frame.
        """
        point, shape = self._point(state, control)
        return {name: _shaped(value, shape) for name, value in point.power().items()}

    @_QUIET
    def linearise(self, state: ArrayLike, control: ArrayLike = 0.0) -> tuple[Array, Array]:
        """Return the Jacobian matrices of the state's rate of change, (A, B).

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            One state or many.
        control : array_like, shape (..., n_controls), optional
            The held controls.

        Returns
        -------
        A : ndarray, shape (..., n_state, n_state)
            ∂(d state/dt)/∂state, exact; not finite, without an error, where the motion is singular.
        B : ndarray, shape (..., n_state, n_controls)
            ∂(d state/dt)/∂control.
        """
        states, controls, shape = check_both(self, state, control)
        n = states.shape[-1]
        unit = np.eye(n + controls.shape[-1])
        numbers = [DualArray(states[..., i], unit[i]) for i in range(n)]
        numbers += [DualArray(controls[..., i], unit[n + i]) for i in range(controls.shape[-1])]
        point = MotionPoint(self.mechanics, self._symbols(), numbers[:n], numbers[n:], DualArrayFunctions)
        slopes = [
            rate.slope if isinstance(rate, DualArray) else np.zeros(len(unit)) for rate in point.rates()
        ]
        both = np.stack([np.broadcast_to(slope, (*shape, len(unit))) for slope in slopes], axis=-2)
        return both[..., :n].copy(), both[..., n:].copy()

    # --- derived: steps ------------------------------------------------------------------------------------

    def simulate(
        self,
        state: ArrayLike,
        controls: ArrayLike | int,
        dt: float,
        *,
        lag: float | Mapping[str, float] | None = None,
        applied: ArrayLike | None = None,
    ) -> Array:
        """Step the equations of motion, with each control held for one step or lagging behind.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            The start, in the order of `state_names`.
        controls : array_like, shape (T,) or (T, n_controls); int for a scene without controls
            One set of controls per step, neither clipped nor guarded; or the number of steps.
        dt : float
            Length of a step [s].
        lag : float or mapping from str to float, optional
            Time constant τ of the actuators [s], or a mapping from names of controls to time constants: the
            applied control u follows the given control w by u' = (w - u)/τ. 0 means no lag; other values must
            be at least 1e-6 dt. Every scene is then stepped by the general series, even one with a closed
            form.
        applied : array_like, shape (n_controls,) or (), optional
            Lagged controls at the start; by default they are 0.

        Returns
        -------
        ndarray of float64, shape (T + 1, n_state)
            The states; the first is the start.

        Raises
        ------
        ValueError
            For a state, control, step or lag that is not finite or has the wrong shape, a step not above 0,
            or a lag that is too short or has an unknown name.
        StepRefused
            If a step cannot be certified within the cap on substeps, or has no finite result. Its attribute
            `trajectory` holds the rows before that step.
        """
        return steps.simulate(self, state, controls, dt, lag, applied)

    def step_bound(
        self,
        state: ArrayLike,
        control: ArrayLike = 0.0,
        dt: float = 0.02,
        *,
        lag: float | Mapping[str, float] | None = None,
        applied: ArrayLike | None = None,
    ) -> StepBound:
        """Return how a control step is divided, and bounds on its truncation error.

        Parameters
        ----------
        state : array_like, shape (n_state,)
            Start of the step.
        control : array_like, shape (n_controls,) or ()
            The held controls.
        dt : float
            Length of the step [s].
        lag, applied
            As for `simulate`; a lagged step uses the general series.

        Returns
        -------
        StepBound
            The number of substeps, the order, and for each entry of the state a proved bound on the
            truncation error, summed over the substeps. Rounding, and the growth of earlier substeps' errors
            along the motion, are not included. Where a rate is held, the bound of w follows from those of
            place and velocity to first order. The bound of a pendulum is proved before the step, for plain
            substeps; if heavy damping makes the step follow the slow manifold instead, accuracy is tested,
            not proved. A mass with linear drag and the turning slope are stepped to rounding: in closed form,
            or by a series whose remainder is below rounding.

        Raises
        ------
        ValueError, StepRefused
            As `simulate` does.
        """
        return steps.step_bound(self, state, control, dt, lag, applied)

    truncation_bound = step_bound  # its name in 0.1

    @overload
    def jacobian(
        self, state: ArrayLike, control: ArrayLike = 0.0, dt: float = 0.02, *, parameters: None = None
    ) -> tuple[Array, Array]: ...

    @overload
    def jacobian(
        self, state: ArrayLike, control: ArrayLike = 0.0, dt: float = 0.02, *, parameters: Sequence[str]
    ) -> tuple[Array, Array, Array]: ...

    def jacobian(
        self,
        state: ArrayLike,
        control: ArrayLike = 0.0,
        dt: float = 0.02,
        *,
        parameters: Sequence[str] | None = None,
    ) -> tuple[Array, ...]:
        """Return the derivatives of the state after a control step with respect to state and controls.

        The derivatives come from the step's own series. Where they need shorter substeps, the step is divided
        further.

        Parameters
        ----------
        state : array_like, shape (..., n_state)
            Start of the step.
        control : array_like, shape (..., n_controls), or (...) for one control
            The held controls.
        dt : float
            Length of the step [s].
        parameters : sequence of str, optional
            Names of parameters with respect to which derivatives are wanted too. All other parameters are
            held, even those whose default is computed from the named ones.

        Returns
        -------
        A : ndarray, shape (..., n_state, n_state)
            With respect to the state before the step.
        B : ndarray, shape (..., n_state, n_controls)
            With respect to the controls.
        P : ndarray, shape (..., n_state, n_parameters)
            With respect to the parameters, per unit of each; only if `parameters` is given.

        Raises
        ------
        ValueError, StepRefused
            As `simulate` does; StepRefused also if only the derivatives cannot be found, ValueError also for
            a parameter that the scene lacks, or in which the motion is not differentiable, as may happen at
            0.

        Examples
        --------
        >>> from lag_envs.scenes import PivotedBar
        >>> A, B, P = PivotedBar().jacobian([0.0, 0.0, 3.0, 0.1], 2.0, parameters=["damping", "mass"])
        >>> A.shape, B.shape, P.shape
        ((4, 4), (4, 1), (4, 2))
        """
        return steps.jacobian(self, state, control, dt, parameters)

    def vjp(
        self,
        state: ArrayLike,
        control: ArrayLike,
        dt: float,
        cotangent: ArrayLike,
        *,
        parameters: Sequence[str] | None = None,
    ) -> tuple[Array, ...]:
        """Pull a gradient back through a control step (vector-Jacobian product).

        This is reverse mode: for each row it returns the product of `cotangent` with each result of
        `jacobian`, but computes it faster.

        Parameters
        ----------
        state, control, dt, parameters
            As for `jacobian`.
        cotangent : array_like, shape (..., n_state)
            A gradient with respect to the state after the step.

        Returns
        -------
        state : ndarray, shape (..., n_state)
            The gradient with respect to the state before the step.
        control : ndarray, shape (..., n_controls)
            The gradient with respect to the controls.
        parameters : ndarray, shape (..., n_parameters)
            The gradient with respect to the parameters; only if `parameters` is given.

        Raises
        ------
        ValueError, StepRefused
            As `jacobian` does; ValueError also for a cotangent of another shape or too large.

        Examples
        --------
        >>> from lag_envs.scenes import PivotedBar
        >>> by_state, by_control = PivotedBar().vjp([0.0, 0.0, 3.0, 0.1], 2.0, 0.02, [0.0, 0.0, 1.0, 0.0])
        >>> by_state.shape, by_control.shape
        ((4,), (1,))
        """
        return steps.vjp(self, state, control, dt, cotangent, parameters)

    def fit(
        self,
        recordings: Sequence[tuple[ArrayLike, ArrayLike | int | None, float]],
        free: Sequence[str],
        *,
        noise: Mapping[str, float] | None = None,
        level: float = 0.95,
    ) -> Fit:
        """Fit parameters to recordings of the motion.

        The fit minimises the squared differences between measurements and simulation, of all recordings
        together: this gives the most likely parameters if the noise is normal and independent. The start of
        each recording is unknown too. The search is by multiple shooting with exact derivatives: it cuts
        recordings into short pieces, so that it converges from poor initial parameters and along chaotic
        motions, and then closes the gaps between the pieces.

        Parameters
        ----------
        recordings : sequence of (states, controls, dt)
            ``states``, shape (N, n_state), at equal intervals ``dt`` [s]; NaN where nothing was measured,
            for single samples or a whole column. Angles measured within one turn may jump by 2π.
            ``controls``, shape (N - 1,) or (N - 1, n_controls), each held from one sample to the next; a
            further one for the last sample is allowed and ignored. None if all controls are 0, or the scene
            has none.
        free : sequence of str
            The parameters to find. The search begins with the scene's values. Other parameters are held,
            except those whose value is a default computed from other parameters: they keep following these.
        noise : mapping from str to float, optional
            Standard deviation of the measurements of each state, as in ``{"theta": 0.01}``. By default it is
            estimated for each state.
        level : float, default 0.95
            Level of the confidence intervals.

        Returns
        -------
        fitting.result.Fit
            Estimates, standard errors, intervals, the fitted scene, residuals. It prints as a table, and
            `plot` draws the residuals.

        Warns
        -----
        FitWarning
            If the data determine a parameter poorly or can hardly tell two apart, if residuals are larger
            than the noise or not independent, or if units look wrong. `Fit.warnings` has the texts.

        Raises
        ------
        ValueError
            For data that do not determine the parameters, which the error then names; for parameters that
            grow without bound because the model is wrong; for a parameter that the scene lacks; for
            recordings of a wrong shape, with too few values, or with controls that are not finite.
        StepRefused
            If the motion cannot be simulated with the initial parameters. A coordinate that was not measured
            is first guessed to be 0; the error then names it.
        """
        from lag_envs.scenes.fitting.fit import fit

        return fit(self, recordings, free, noise, level)

    def _repr_html_(self) -> str:
        """Return the HTML of a notebook: parameters, state, controls, equations."""
        from lag_envs.scenes.html import scene_html

        return scene_html(self)

    def lagrangian(self) -> sympy.Expr:
        """Return the Lagrangian T - V as a SymPy expression, with functions of time and parameters."""
        from lag_envs.scenes.symbolic import lagrangian

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
        """Return a scene made from SymPy expressions.

        Parameters
        ----------
        name : str
            Name of the scene's class.
        kinetic, potential, dissipation : SymPy expression
            The energies [J], and Rayleigh's function [W].
        coordinates, prescribed, controls : dict from symbol to str
            Free and prescribed coordinates and controls with their units. The velocity of a function of time
            is its derivative, ``theta.diff(t)``; that of a plain symbol ``theta`` is ``theta_dot``. A string
            stands for the symbol of that name.
        applied : dict from symbol to expression, optional
            Generalised forces by coordinate.
        parameters : dict from symbol to float
            All other symbols with their values.

        Returns
        -------
        Scene
            A scene with these values. Call it to change some of them: ``scene(m=2.0)``.

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
        from lag_envs.scenes.symbolic import from_sympy

        return from_sympy(
            Scene,
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
            The held controls.
        dt : float
            Length of the step [s].
        nodes : int, default 16
            Nodes of the quadrature.

        Returns
        -------
        dict
            ``change`` of energy, or of Jacobi's integral if `energy` has it; ``work`` of drive and applied
            forces, ``loss`` to drag, and ``residual`` = change - work + loss.
        """
        return steps.energy_balance(self, state, control, dt, nodes)


def _shaped(value: Any, shape: tuple[int, ...]) -> Any:
    """Return a float64 array of a shape, or a number if the shape is empty."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), shape).copy()[()]


def _restore(cls: type[Scene], state: dict[str, Any]) -> Scene:
    """Return a scene from a pickle; it may be the first of its class in this process."""
    complete(cls)
    check_class(cls, Scene)
    scene = object.__new__(cls)
    for name, value in state.items():
        object.__setattr__(scene, name, value)
    admit(scene, Scene)
    return scene
