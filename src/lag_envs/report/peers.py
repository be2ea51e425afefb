"""Other libraries' integrators on our scenes, one class each; all have the interface of `Peer`.

A library is imported when its class is made; where it is missing, that raises. Right-hand sides are the
stepping's own formulas with the scene's own coefficients, run on the library's numbers. MuJoCo alone has its
own equations; its model is made from the scene's parameters.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lag_envs.report.cases import Case
from lag_envs.scenes import PivotedBar
from lag_envs.stepping import pendulum, slope

Array = NDArray[np.float64]
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)


def acceleration(kind: type, p: Sequence, q: Any, v: Any, t: Any, xp: Any) -> Any:
    """Return q'' from a flow's coefficients and, behind them in `p`, the plane's angle at t = 0."""
    coefficients = kind(*p[:-1])
    if kind is pendulum.Drive:
        return pendulum.acceleration(v, xp.cos(q), xp.sin(q), coefficients) + coefficients.ramp * t
    if kind is slope.Pull:
        return slope.sliding(v, coefficients) + 0.0 * q
    return slope.rolling(q, v, xp.sin(p[-1] + coefficients.rate * t), coefficients)


class Peer(ABC):
    """Some problems on one kind of scene, stepped by another library.

    Parameters
    ----------
    cases : sequence of Case
        The problems; each control is held.
    setting : tuple
        One of `settings`.
    """

    #: Name of the package.
    package: ClassVar[str]
    #: What is measured: method, and tolerance or number of substeps.
    settings: ClassVar[Sequence[tuple[str, float]]]
    #: Whether many states go into one call.
    batched: ClassVar[bool] = False
    #: Whether the second part of a setting is a number of substeps.
    fixed: ClassVar[bool] = False

    def __init__(self, cases: Sequence[Case], setting: tuple[str, float]) -> None:
        self.cases = cases
        self.setting = setting
        self.kind = cases[0].scene.flow.coefficients
        constants = [case.scene.constants() for case in cases]
        self._k = SimpleNamespace(**{name: np.array([k[name] for k in constants]) for name in constants[0]})
        self._u = np.array([case.control for case in cases])
        self.seconds = 0.0  #: spent in the library's own calls
        self.prepare()

    @abstractmethod
    def prepare(self) -> None:
        """Import the library and compile what can be compiled before the first call."""

    @abstractmethod
    def solve(self, q: Array, v: Array, p: Array, dt: float) -> tuple[Any, Any]:
        """Return (q, q') after some time; a column of `p` has the coefficients of one problem."""

    def timed(self, function: Callable, *args: Any, **options: Any) -> Any:
        """Call the library; what lies around the call, such as setting up its arguments, does not count."""
        before = time.perf_counter()
        result = function(*args, **options)
        self.seconds += time.perf_counter() - before
        return result

    def move(self, states: Array, dt: float, steps: int) -> Array:
        """Return the states, one per line, after control steps each of which is a new call."""
        scene, u = self.cases[0].scene, self._u
        for _ in range(steps):
            y = scene.lift(states)
            coefficients = scene.drive(y, u, self._k, np)
            variables = scene.unpack(y, u, self._k)
            angle = states[:, scene.angle] if scene.angle is not None else 0.0
            p = np.array([np.broadcast_to(x, u.shape) for x in (*coefficients, angle)], dtype=np.float64)
            q, v = (np.array(x, dtype=np.float64) for x in variables[:2])
            moved = [*(np.asarray(x, dtype=np.float64) for x in self.solve(q, v, p, dt)), *variables[2:]]
            states = np.stack(scene.pack(moved, y, u, dt, self._k)[: states.shape[1]], axis=1)
        return states


class SciPy(Peer):
    """`scipy.integrate.solve_ivp`, one state after the other."""

    package = "scipy"
    settings = tuple((m, tol) for m in ("RK45", "DOP853", "Radau", "LSODA") for tol in TOLERANCES)

    def prepare(self) -> None:
        """Import it."""
        from scipy.integrate import solve_ivp

        self._solve_ivp = solve_ivp

    def solve(self, q: Array, v: Array, p: Array, dt: float) -> tuple[Any, Any]:
        """Call it once per state."""
        method, tolerance = self.setting
        ends = []
        for q0, v0, *numbers in zip(q.tolist(), v.tolist(), *p.tolist(), strict=True):

            def rate(t: float, y: Any, numbers: Sequence = numbers) -> tuple:
                q, v = y.tolist()
                return v, acceleration(self.kind, numbers, q, v, t, math)

            end = self.timed(
                self._solve_ivp, rate, (0.0, dt), (q0, v0), method, rtol=tolerance, atol=tolerance
            )
            ends.append(end.y[:, -1] if end.success else (np.nan, np.nan))
        return tuple(np.array(ends).T)


class Heyoka(Peer):
    """heyoka's adaptive Taylor series, of an order chosen from the tolerance; a block of states at once."""

    package = "heyoka"
    WIDTH = 64  #: of a batch: more than a vector's, so that the calls from Python weigh less
    settings = tuple(("Taylor", tol) for tol in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15))
    batched = True

    def prepare(self) -> None:
        """Compile the integrator."""
        import heyoka

        q, v = heyoka.make_vars("q", "v")
        p = [heyoka.par[i] for i in range(len(self.kind._fields) + 1)]
        pushed = acceleration(self.kind, p, q, v, heyoka.time, heyoka)
        system = [(q, v), (v, pushed)]
        self._width = self.WIDTH if len(self.cases) > 1 else 1
        if self._width == 1:
            self._integrator = heyoka.taylor_adaptive(system, [0.0, 0.0], tol=self.setting[1])
        else:
            start = np.zeros((2, self._width))
            self._integrator = heyoka.taylor_adaptive_batch(system, start, tol=self.setting[1])

    def solve(self, q: Array, v: Array, p: Array, dt: float) -> tuple[Any, Any]:
        """Set states and parameters, and propagate."""
        integrator, width = self._integrator, self._width
        if width == 1:
            state, pars = integrator.state, integrator.pars
            for j in range(len(q)):
                integrator.time = 0.0
                state[0], state[1] = q[j], v[j]
                pars[:] = p[: len(pars), j]
                self.timed(integrator.propagate_until, dt)
                q[j], v[j] = state
            return q, v
        count = len(q)
        full = -(-count // width) * width
        filled = [np.concatenate([x, np.repeat(x[..., :1], full - count, -1)], -1) for x in (q, v, p)]
        for j in range(0, full, width):
            part = slice(j, j + width)
            integrator.set_time(0.0)
            integrator.state[0], integrator.state[1] = filled[0][part], filled[1][part]
            integrator.pars[:] = filled[2][: len(integrator.pars), part]
            self.timed(integrator.propagate_until, dt)
            filled[0][part], filled[1][part] = integrator.state
        return filled[0][:count], filled[1][:count]


class Diffrax(Peer):
    """diffrax: adaptive Runge-Kutta methods, compiled by XLA, mapped over the states; each its own steps."""

    package = "diffrax"
    settings = tuple((m, tol) for m in ("Tsit5", "Dopri8") for tol in TOLERANCES)
    batched = True
    _compiled: ClassVar[dict[tuple, Callable]] = {}

    def prepare(self) -> None:
        """Compile; the tolerance is an argument, so that one compilation does for all."""
        import diffrax
        import jax
        import jax.numpy as jnp

        jax.config.update("jax_enable_x64", True)
        key = (self.kind, self.setting[0])
        if key not in self._compiled:
            kind, method = self.kind, getattr(diffrax, self.setting[0])()

            def rate(t: Any, y: Any, p: Any) -> Any:
                return y[1], acceleration(kind, p, y[0], y[1], t, jnp)

            def one(q: Any, v: Any, p: Any, time: Any, tolerance: Any) -> Any:
                end = diffrax.diffeqsolve(
                    diffrax.ODETerm(rate), method, 0.0, time, None, (q, v), p,
                    stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
                    saveat=diffrax.SaveAt(t1=True), max_steps=10_000_000, throw=False,
                )  # fmt: skip
                return end.ys[0][0], end.ys[1][0]

            self._compiled[key] = jax.jit(jax.vmap(one, (0, 0, 1, None, None)))
        self._run = self._compiled[key]
        self._ready = jax.block_until_ready

    def solve(self, q: Array, v: Array, p: Array, dt: float) -> tuple[Any, Any]:
        """Solve all at once."""
        return self.timed(lambda: self._ready(self._run(q, v, p, dt, self.setting[1])))


class Torchdiffeq(Peer):
    """torchdiffeq: adaptive Runge-Kutta methods on tensors; all states of a batch share their steps."""

    package = "torchdiffeq"
    settings = tuple((m, tol) for m in ("dopri5", "dopri8") for tol in TOLERANCES)
    batched = True

    def prepare(self) -> None:
        """Import it."""
        import torch
        from torchdiffeq import odeint

        self._torch, self._odeint = torch, odeint

    def solve(self, q: Array, v: Array, p: Array, dt: float) -> tuple[Any, Any]:
        """Solve all at once."""
        torch = self._torch
        method, tolerance = self.setting
        numbers = torch.from_numpy(p)

        def rate(t: Any, y: Any) -> Any:
            return torch.stack((y[1], acceleration(self.kind, numbers, y[0], y[1], t, torch)))

        with torch.no_grad():
            start = torch.from_numpy(np.stack((q, v)))
            times = torch.tensor([0.0, dt], dtype=torch.float64)
            path = self.timed(self._odeint, rate, start, times, rtol=tolerance, atol=tolerance, method=method)
            return tuple(path[-1].numpy())


class MuJoCo(Peer):
    """MuJoCo's own dynamics of a bar on a hinge, in the support's frame: its acceleration tilts gravity."""

    package = "mujoco"
    settings = tuple((m, n) for m in ("Euler", "implicit", "RK4") for n in (1, 4, 16, 64))
    fixed = True
    MODEL = """
    <mujoco>
      <option gravity="0 0 0" integrator="{integrator}"/>
      <worldbody><body>
        <joint type="hinge" axis="0 -1 0" damping="{scene.damping!r}"/>
        <inertial pos="0 0 -{scene.com_distance!r}" mass="{scene.mass!r}"
                  diaginertia="{scene.inertia!r} {scene.inertia!r} {scene.inertia!r}"/>
      </body></worldbody>
    </mujoco>
    """

    def prepare(self) -> None:
        """Make a model of every scene."""
        if not all(isinstance(case.scene, PivotedBar) for case in self.cases):
            raise ValueError("modelled in MuJoCo is PivotedBar only")
        import mujoco

        self._step = mujoco.mj_step
        self._models = []
        for scene, _, control in self.cases:
            model = mujoco.MjModel.from_xml_string(self.MODEL.format(scene=scene, integrator=self.setting[0]))
            model.opt.gravity[:] = (-control, 0.0, -scene.gravity)  # type: ignore[attr-defined]
            self._models.append((model, mujoco.MjData(model)))

    def solve(self, q: Array, v: Array, p: Array, dt: float) -> tuple[Any, Any]:
        """MuJoCo has its own equations, so `move` does without."""
        raise NotImplementedError

    def move(self, states: Array, dt: float, steps: int) -> Array:
        """Return the states after some control steps, in one call per state."""
        n = int(self.setting[1])
        ends = np.empty_like(states)
        for (model, data), state, end in zip(self._models, states, ends, strict=True):
            model.opt.timestep = dt / n
            data.qpos[0], data.qvel[0] = state
            self.timed(self._step, model, data, n * steps)
            end[:] = data.qpos[0], data.qvel[0]
        return ends


PEERS: dict[str, type[Peer]] = {peer.package: peer for peer in (SciPy, Heyoka, Diffrax, Torchdiffeq, MuJoCo)}
