"""Other libraries' integrators as rivals: a class for each library, in its fastest form.

A library is imported when its rival is first built; if it is missing, this raises an error. All but MuJoCo
are given the `Equation` of the problems, written once on generic numbers; MuJoCo has its own equations, made
from the scene's parameters.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, ClassVar

import numpy as np

from lag_envs.report.arithmetic import Arithmetic
from lag_envs.report.equations import Array, Equation, Problems
from lag_envs.report.rivals import Rival
from lag_envs.report.timing import Sample, blocks, unblocked
from lag_envs.scenes import PivotedBar
from lag_envs.scenes.base import Scene
from lag_envs.stepping.compiling import compile_lines, record_block
from lag_envs.stepping.elementary import ElementaryTrace

TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
SUBSTEPS = (1, 4, 16, 64)


class LibraryRival(Rival):
    """A rival from another library."""

    #: The methods to measure, each with tolerances or, if its steps are fixed, with substeps per control
    #: step.
    settings: ClassVar[dict[str, Sequence[float]]]
    #: Whether it is slow to compile or to run, and so is measured on typical variants only.
    slow: ClassVar[bool] = False
    #: The kind of scenes that it can step.
    scenes: ClassVar[type[Scene]] = Scene

    def __init__(self, method: str, setting: float) -> None:
        super().__init__(method, setting)
        self.fixed = self.fixed or method.endswith(", fixed")


# --- SciPy ---


class SciPy(LibraryRival):
    """SciPy's solvers with a compiled right-hand side.

    dopri5, dop853 and lsoda are those of `scipy.integrate.ode`, whose loops are compiled and take a tenth of
    the time of `solve_ivp`. A batch is one system of all states, so the states share their steps; for lsoda
    its matrix is banded. Radau is `solve_ivp`'s and has no batch.
    """

    family = "scipy"
    settings: ClassVar = {
        "dopri5": TOLERANCES, "dop853": TOLERANCES, "lsoda": TOLERANCES, "Radau": TOLERANCES[::2],
    }  # fmt: skip
    shared = True

    def __init__(self, method: str, setting: float) -> None:
        super().__init__(method, setting)
        self.batched = method != "Radau"

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile the right-hand side."""
        equation, count, span = problems.equation, len(problems), dt * steps
        size = equation.size
        start = np.ascontiguousarray(problems.y[:size].T)  # state by state, so that the matrix is banded
        parameters = [tuple(row) for row in problems.p.T.tolist()]
        ends = np.empty_like(start)
        solve = self._solver(equation, count if together else 1, together)

        def run() -> None:
            if together:
                ends[:] = solve(start.ravel(), span, problems.p).reshape(start.shape)
            else:
                for j, p in enumerate(parameters):
                    ends[j] = solve(start[j], span, p)

        return Sample(run, count * steps, ends=lambda: problems.states(ends.T, span))

    def _solver(self, equation: Equation, count: int, together: bool) -> Callable:
        """Return ``solve(y, span, p)``, which gives NaN if the solver gives up."""
        from scipy.integrate import ode, solve_ivp

        rate = _rate_of_many(equation) if together else _rate(equation)
        lost = np.full(count * equation.size, np.nan)
        if self.method == "Radau":
            tolerance = {"rtol": self.setting, "atol": self.setting}

            def radau(y: Array, span: float, p: Any) -> Array:
                end = solve_ivp(rate, (0.0, span), y, "Radau", args=(p,), **tolerance)
                return end.y[:, -1] if end.success else lost

            return radau
        more = {"lband": equation.size - 1, "uband": equation.size - 1} if self.method == "lsoda" else {}
        solver = ode(rate).set_integrator(
            self.method, rtol=self.setting, atol=self.setting, nsteps=100_000_000, **more
        )

        def solve(y: Array, span: float, p: Any) -> Array:
            solver.set_initial_value(y, 0.0).set_f_params(p)
            end = solver.integrate(span)
            return end if solver.successful() else lost

        return solve


def rate_lines(equation: Equation) -> tuple[list[str], list]:
    """Return the lines of the rate of y0, y1, ... with p0, p1, ... at the time t, and its values."""
    trace = ElementaryTrace()
    names = [f"y{i}" for i in range(equation.size)], [f"p{i}" for i in range(equation.parameters)]
    (t,), y, p = trace.inputs("t"), trace.inputs(*names[0]), trace.inputs(*names[1])
    found = equation.rate(t, y, p, Arithmetic(trace))
    return record_block(trace, {f"d{i}": value for i, value in enumerate(found)})


def one_rate_lines(equation: Equation) -> list[str]:
    """Return the lines that write the rate of a state y with parameters p at the time t into out."""
    lines, values = rate_lines(equation)
    return [
        *(f"y{i} = y[{i}]" for i in range(equation.size)),
        *(f"p{i} = p[{i}]" for i in range(equation.parameters)),
        *lines,
        *(f"out[{i}] = {value}" for i, value in enumerate(values)),
    ]


@cache
def _rate(equation: Equation) -> Callable:
    """Compile ``rate(t, y, p)`` of one state; the parameters are a tuple."""
    lines = [f"out = np.empty({equation.size})", *one_rate_lines(equation), "return out"]
    return compile_lines("rate", "t, y, p", lines)


@cache
def _rate_of_many(equation: Equation) -> Callable:
    """Compile ``rate(t, y, p)`` of many states, one after the other in y; p has a row for each parameter."""
    lines, values = rate_lines(equation)
    size = equation.size
    source = [
        "out = np.empty(y.size)",
        "for j in range(p.shape[1]):",
        *(f"    y{i} = y[{size} * j + {i}]" for i in range(size)),
        *(f"    p{i} = p[{i}, j]" for i in range(equation.parameters)),
        *(f"    {line}" for line in lines),
        *(f"    out[{size} * j + {i}] = {value}" for i, value in enumerate(values)),
        "return out",
    ]
    return compile_lines("rate", "t, y, p", source)


# --- heyoka ---


class Heyoka(LibraryRival):
    """heyoka's adaptive Taylor series, of an order chosen from the tolerance, with fast_math.

    For one step per control, heyoka's compiled step is called from a compiled loop, so that no call from
    Python counts; longer times take one call of `propagate_until`. A batch goes in blocks of twice the width
    that heyoka recommends, or of that width ("narrow"), the fastest of those tried.
    """

    family = "heyoka"
    NARROW = "Taylor, narrow"
    settings: ClassVar = {"Taylor": (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)}
    changing = True

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile the integrator, and find its step function."""
        import heyoka

        width = heyoka.recommended_simd_size() * (1 if self.method == self.NARROW else 2) if together else 1
        integrator = self.integrator(problems.equation, width)
        size, count, span = problems.equation.size, len(problems), dt * steps
        start, p = blocks(problems.y[:size], width), blocks(problems.p, width)
        rows = start.copy()
        step = _compiled_step(integrator) if steps == 1 else None
        if step is not None:
            loop, work = _loop(), np.empty((3, width))

            def run() -> None:
                loop(step, rows, p, work, span, changes)

        else:

            def run() -> None:
                for change in range(changes):
                    for i, block in enumerate(rows):
                        self._propagate(integrator, block, p[(i + change) % len(p)], span)

        return Sample(
            run,
            count * steps * changes,
            lambda: np.copyto(rows, start),
            lambda: problems.states(unblocked(rows, count), span),
        )

    @staticmethod
    def _propagate(integrator: Any, block: Array, numbers: Array, span: float) -> None:
        if block.shape[-1] == 1:
            integrator.time = 0.0
            integrator.state[:], integrator.pars[: len(numbers)] = block[:, 0], numbers[:, 0]
        else:
            integrator.set_time(0.0)
            integrator.state[:], integrator.pars[: len(numbers)] = block, numbers
        integrator.propagate_until(span)
        block[:] = integrator.state.reshape(block.shape)

    def integrator(self, equation: Equation, width: int) -> Any:
        """Compile heyoka's integrator for vectors of this width."""
        import heyoka

        names = heyoka.make_vars(*(f"y{i}" for i in range(equation.size)))
        p = [heyoka.par[i] for i in range(equation.parameters)]
        rates = equation.rate(heyoka.time, names, p, heyoka)
        system = list(zip(names, (heyoka.expression(rate) for rate in rates), strict=True))
        options = {"tol": self.setting, "fast_math": True}
        if width == 1:
            pars = np.zeros(equation.parameters)
            return heyoka.taylor_adaptive(system, np.zeros(equation.size), pars=pars, **options)
        pars = np.zeros((equation.parameters, width))
        return heyoka.taylor_adaptive_batch(system, np.zeros((equation.size, width)), pars=pars, **options)


#: Keeps the machine code of heyoka's steps loaded.
_engines: list[Any] = []


def _compiled_step(integrator: Any) -> int | None:
    """Return the address of heyoka's compiled step, or None if it cannot be loaded.

    The step is heyoka's own object code, as its integrator runs it: ``step(state, pars, time, h,
    coefficients)``, where `h` is the longest allowed step on entry, and the step taken on return.
    """
    from importlib.metadata import files

    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for file in files("heyoka") or ():  # its vector functions are in separate libraries
        if file.name.startswith(("libsleef", "libheyoka")):
            llvm.load_library_permanently(str(file.locate()))
    try:
        machine = llvm.Target.from_default_triple().create_target_machine()
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(integrator.llvm_state.object_code))
        engine.finalize_object()
        address = engine.get_function_address("step")
    except (AttributeError, RuntimeError):
        return None
    _engines.append(engine)
    return address or None


@cache
def _loop() -> Callable:
    """Compile ``loop(step, rows, p, work, span, changes)``: block by block, steps until the time is up."""
    import numba
    from llvmlite import ir
    from numba.extending import intrinsic

    @intrinsic
    def call(typingctx, step, state, pars, time, h):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
            pointer = ir.DoubleType().as_pointer()
            kind = ir.FunctionType(ir.VoidType(), [pointer] * 5)
            numbers = [builder.inttoptr(arg, pointer) for arg in args[1:]]
            builder.call(builder.inttoptr(args[0], kind.as_pointer()), [*numbers, ir.Constant(pointer, None)])
            return context.get_dummy_value()

        return numba.types.void(*[numba.types.uintp] * 5), codegen

    @numba.njit
    def loop(step, rows, p, work, span, changes):  # type: ignore[no-untyped-def]
        time, h, left = work
        y, pars = rows.ctypes.data, p.ctypes.data
        for block in range(rows.shape[0]):
            for change in range(changes):
                line = (block + change) % p.shape[0]
                time[:] = 0.0
                left[:] = span
                going = True
                while going:
                    h[:] = left
                    call(
                        step, y + block * rows.strides[0], pars + line * p.strides[0],
                        time.ctypes.data, h.ctypes.data,
                    )  # fmt: skip
                    going = False
                    for i in range(len(left)):
                        time[i] += h[i]
                        left[i] -= h[i]
                        going |= left[i] != 0.0

    return loop


# --- diffrax ---


class Diffrax(LibraryRival):
    """diffrax in one call compiled by XLA: a loop over single states, or a map over a batch.

    diffrax's controller chooses each state's steps, or all steps have the same length ("fixed").
    """

    family, slow = "diffrax", True
    settings: ClassVar = {
        "Tsit5": TOLERANCES[::2], "Dopri8": TOLERANCES[::2], "Tsit5, fixed": (1, 4, 16),
        "Dopri8, fixed": (1, 2, 4),
    }  # fmt: skip

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Compile."""
        solve = _diffrax(problems.equation, self.method.partition(",")[0], self.fixed, together)
        import jax

        span, size, count = dt * steps, problems.equation.size, len(problems)
        # XLA compiles again for every shape, which takes seconds, so few shapes are used.
        shape = next((n for n in ((128, 1024) if together else (64,)) if n >= count), count)
        y, p = (
            jax.numpy.asarray(blocks(x, shape).swapaxes(1, 2)[0]) for x in (problems.y[:size], problems.p)
        )
        setting = span / self.substeps(steps) if self.fixed else self.setting
        found: list[Any] = []

        def run() -> None:
            found[:] = [jax.block_until_ready(solve(y, p, count, span, setting))]

        return Sample(run, count * steps, ends=lambda: problems.states(np.asarray(found[0])[:count].T, span))


@cache
def _diffrax(equation: Equation, method: str, fixed: bool, together: bool) -> Callable:
    """Compile ``solve(y, p, count, span, setting)``, whose setting is the tolerance or the step."""
    # Read when JAX starts: one core, like all others.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def rate(t: Any, y: Any, p: Any) -> Any:
        return equation.rate(t, y, p, jnp)

    def one(y: Any, p: Any, span: Any, setting: Any) -> Any:
        controller = (
            diffrax.ConstantStepSize() if fixed else diffrax.PIDController(rtol=setting, atol=setting)
        )
        end = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), getattr(diffrax, method)(), 0.0, span, setting if fixed else None,
            tuple(y[i] for i in range(equation.size)), tuple(p[i] for i in range(equation.parameters)),
            stepsize_controller=controller, saveat=diffrax.SaveAt(t1=True), max_steps=10_000_000,
            adjoint=diffrax.ForwardMode(), throw=False,
        )  # fmt: skip
        return jnp.stack([value[0] for value in end.ys])

    def several(y: Any, p: Any, count: Any, span: Any, setting: Any) -> Any:
        if together:
            return jax.vmap(one, (0, 0, None, None))(y, p, span, setting)
        return jax.lax.fori_loop(0, count, lambda j, out: out.at[j].set(one(y[j], p[j], span, setting)), y)

    return jax.jit(several)


# --- torchdiffeq ---


class Torchdiffeq(LibraryRival):
    """torchdiffeq on tensors of all states, which share their steps; the loop over steps is in Python."""

    family, slow = "torchdiffeq", True
    settings: ClassVar = {
        "dopri5": TOLERANCES[::2], "dopri8": TOLERANCES[::2], "rk4, fixed": SUBSTEPS[:3],
    }  # fmt: skip
    shared = True  # a batch is one tensor

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Import it."""
        import torch
        from torchdiffeq import odeint

        equation, span, count = problems.equation, dt * steps, len(problems)
        starts = torch.from_numpy(problems.y[: equation.size].copy())
        numbers = torch.from_numpy(problems.p)
        times = torch.tensor([0.0, span], dtype=torch.float64)
        options: dict[str, Any] = {"rtol": self.setting, "atol": self.setting, "method": self.method}
        # A step has to end at the end time, as interpolation is of lower order than the steps.
        options["options"] = {"step_t": times[1:], "first_step": dt}
        if self.fixed:
            step = span / self.substeps(steps)
            options = {"method": self.method.partition(",")[0], "options": {"step_size": step}}
        groups = [slice(None)] if together else [slice(j, j + 1) for j in range(count)]
        ends = np.empty((equation.size, count))

        def run() -> None:
            with torch.no_grad():
                for group in groups:
                    p = numbers[:, group]

                    def rate(t: Any, y: Any, p: Any = p) -> Any:
                        return torch.stack(equation.rate(t, y, p, torch))

                    ends[:, group] = odeint(rate, starts[:, group], times, **options)[-1].numpy()

        return Sample(run, count * steps, ends=lambda: problems.states(ends, span))


# --- MuJoCo ---

#: The bar in the frame of its support, whose acceleration tilts gravity. Contacts and constraints, of which
#: there are none, are switched off.
BAR = """
<mujoco>
  <option gravity="{minus_control!r} 0 {minus_gravity!r}" integrator="{integrator}" timestep="{step!r}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody><body>
    <joint type="hinge" axis="0 -1 0" damping="{scene.damping!r}"/>
    <inertial pos="0 0 -{scene.com_distance!r}" mass="{scene.mass!r}"
              diaginertia="{scene.inertia!r} {scene.inertia!r} {scene.inertia!r}"/>
  </body></worldbody>
</mujoco>
"""


class MuJoCo(LibraryRival):
    """MuJoCo's own dynamics in its compiled rollouts, one state after the other; it has no batch."""

    family = "mujoco"
    settings: ClassVar = {"Euler": SUBSTEPS, "implicitfast": SUBSTEPS, "RK4": SUBSTEPS}
    fixed, batched = True, False  # a rollout takes one state after the other
    scenes = PivotedBar  # whose model is `BAR`

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Make a model of every problem."""
        scene = problems.cases[0].scene
        if not isinstance(scene, self.scenes):
            raise ValueError(f"there is no MuJoCo model of {type(scene).__name__}")
        import mujoco
        from mujoco.rollout import rollout

        n = self.substeps(steps)
        models = [
            mujoco.MjModel.from_xml_string(
                BAR.format(
                    scene=scene, minus_control=-control, minus_gravity=-scene.gravity,  # type: ignore[attr-defined]
                    integrator=self.method, step=dt * steps / n,
                )
            )
            for scene, _, control in problems.cases
        ]  # fmt: skip
        data = mujoco.MjData(models[0])
        start = np.array([(0.0, *case.state) for case in problems.cases])
        # A long rollout would store every step, although only its end is needed.
        chunk = min(n, 1000)
        path = np.empty((len(models), chunk, start.shape[1]))
        ends = start.copy()

        def run() -> None:
            ends[:] = start
            for begin in range(0, n, chunk):
                count = min(chunk, n - begin)
                out = path[:, :count] if count == chunk else np.empty((len(models), count, start.shape[1]))
                rollout(models, data, ends, nstep=count, state=out, skip_checks=False)
                ends[:] = out[:, -1]

        return Sample(run, len(models) * steps, ends=lambda: ends[:, 1:].copy())


PEERS: dict[str, type[LibraryRival]] = {
    peer.family: peer for peer in (SciPy, Heyoka, Diffrax, Torchdiffeq, MuJoCo)
}
