"""The general series: its certificate against exact tails, its bits in every form, its errors."""

from __future__ import annotations

import math
import re
import types
from functools import cache
from typing import NamedTuple

import flint
import numpy as np
import pytest
from llvmlite import binding, ir
from series_systems import SYSTEMS, System, acceleration

from lag_envs.scenes.base import Scene
from lag_envs.stepping import driver, machine
from lag_envs.stepping.compiling import compile_python
from lag_envs.stepping.driver import compile_advance, compile_advance_block
from lag_envs.stepping.general import SeriesStepper
from lag_envs.stepping.machine import BLOCK, Layout, compile_attempt
from lag_envs.stepping.series import LARGEST_ORDER, SMALLEST_ORDER, TOLERANCE, Lane, Plain, Series

NAMES = [system.name for system in SYSTEMS]
FLOATS = types.SimpleNamespace(
    number=float,
    **{name: getattr(math, name) for name in ("sin", "cos", "sqrt", "exp", "log", "atan", "tanh")},
)


# --- exact series -------------------------------------------------------------------------------------------


def _tanh(x):
    e = (2 * x).exp()
    return (e - 1) / (e + 1)


#: Functions of series in 40 digits and more.
EXACT = types.SimpleNamespace(
    number=lambda x: flint.arb_series([flint.arb(x)]),
    tanh=_tanh,
    **{name: getattr(flint.arb_series, name) for name in ("sin", "cos", "sqrt", "exp", "log", "atan")},
)


def taylor(system, state, control, h, end):
    """Return exact coefficients of places and velocities, time in steps of h, by Picard's iteration.

    Each iteration makes one more coefficient exact: nothing is shared with the recurrences under test.
    """
    flint.ctx.prec = 160
    first = 2 * system.driven
    h, u = flint.arb(h), [flint.arb(x) for x in control]
    q0, v0 = ([flint.arb(x) for x in state[first + i :: 2]] for i in (0, 1))
    q, v = ([flint.arb_series([x]) for x in values] for values in (q0, v0))
    for known in range(1, end + 1):
        flint.ctx.cap = known
        s = (
            flint.arb_series([flint.arb(state[0]), h * flint.arb(state[1]), h * h * u[0] / 2])
            if first
            else None
        )
        rates = acceleration(system, q, v, u, s, u[0] if first else None, EXACT)
        flint.ctx.cap = known + 1
        q = [(x * h).integral() + c for x, c in zip(v, q0, strict=True)]
        v = [(flint.arb_series(x) * h).integral() + c for x, c in zip(rates, v0, strict=True)]
    return q, v


def sums(series, first):
    """Return the sums of absolute coefficients from an order on."""
    return [sum(abs(float(c)) for c in x.coeffs()[first:]) for x in series]


# --- what is tested -----------------------------------------------------------------------------------------


@cache
def stepper(system: System):
    """Return the system's stepper, its constants and its code."""
    found = SeriesStepper(system.scene.mechanics)
    numbers = {name: getattr(system.scene, name) for name in system.scene._numbers()}
    constants = found.constants(numbers)
    return found, constants, found.code(frozenset(name for name, value in constants.items() if value == 0.0))


def inputs(system, state, control):
    """Return the inputs of the series by name, places and velocities."""
    found, constants, code = stepper(system)
    given = constants | found.prepare(FLOATS, state, control, constants)
    n = code.record.size
    return {name: given[name] for name in code.record.given}, *(
        [given[f"{x}{i}"] for i in range(n)] for x in "qv"
    )


def _run(rows, dt, order, tolerance):
    return attempt(rows, 0, dt, order, tolerance)  # noqa: F821


@cache
def compiled(record, lanes=1, fused=True):
    return compile_python("run", _run, compile_attempt(record, lanes, fused))


def attempts(system, cases, order, tolerance):
    """Return for each case (state, control, h) the certified length, 0 if none, and bounds on the tails."""
    record = stepper(system)[2].record
    layout, n = Layout(record), record.size
    run, results = compiled(record), []
    for state, control, h in cases:
        rows = np.zeros(layout.rows)
        given, q, v = inputs(system, state, control)
        for name, row in layout.inputs.items():
            rows[row] = given[name]
        rows[layout.q : layout.q + n], rows[layout.v : layout.v + n] = q, v
        rows[layout.left] = rows[layout.wish] = h
        run(rows, h, order, tolerance)
        results.append((h - rows[layout.left], rows[layout.bounds + n : layout.bounds + 2 * n].tolist()))
    return results


def sizes(system, state, v):
    """Return the size of each velocity: that of the largest, measured by the mass matrix's diagonal."""
    first = 2 * system.driven
    q = state[first::2]
    mass, _ = system.motion(q, state[first + 1 :: 2], [0.0, 0.0], 0.3, 0.0, FLOATS)
    roots = [math.sqrt(float(mass[i][i])) for i in range(len(q))]
    largest = max(root * norm for root, norm in zip(roots, sums(v, 0), strict=True))
    return [largest / root for root in roots]


class Judged(NamedTuple):
    """A certified step: the worst ratio of a true tail to its bound, and of one to the tolerance."""

    excess: float
    nearness: float


def judge(system, case, order, tolerance, h, bounds):
    """Hold a certified step against its exact series."""
    state, control, _ = case
    q, v = taylor(system, state, control, h, order + 18)
    after = [bound * h / (order + 2) for bound in bounds]
    found = sums(v, order + 1)
    ratios = [t / b for t, b in zip(found + sums(q, order + 2), bounds + after, strict=True)]
    allowed = [tolerance * size for size in sizes(system, state, v)]
    return Judged(max(ratios), max(t / a for t, a in zip(found, allowed, strict=True)))


def draw(system, generator, count):
    """Return cases whose certified steps are mostly limited by the tolerance."""
    cases = []
    for _ in range(count):
        state, control = system.draw(generator, 10.0 ** generator.uniform(-2.0, 0.2))
        cases.append((state, control, 10.0 ** generator.uniform(-2.5, -0.5)))
    return cases


def certified(system, generator, order, tolerance, count):
    """Return `count` certified steps, judged."""
    found = []
    while len(found) < count:
        cases = draw(system, generator, count - len(found))
        for case, (h, bounds) in zip(cases, attempts(system, cases, order, tolerance), strict=True):
            if h > 0.0:
                found.append(judge(system, case, order, tolerance, h, bounds))
    return found


#: Orders and tolerances; loose ones come close to the radius of convergence.
SETTINGS = ((6, 1e-5), (9, TOLERANCE), (10, 1e-9), (16, TOLERANCE))


# --- the certificate ----------------------------------------------------------------------------------------


def check_certificate(system, count):
    generator, found = np.random.default_rng(5), []
    for order, tolerance in SETTINGS:
        found += certified(system, generator, order, tolerance, count)
    assert max(step.excess for step in found) < 1.0
    near = np.mean([0.01 < step.nearness for step in found])
    assert near > 0.3, f"{near:.0%} of the steps are within a factor of 100 of the tolerance"


@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_certificate_bounds_the_tail(system):
    check_certificate(system, 16)


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_certificate_bounds_the_tail_of_ten_thousand(system):
    check_certificate(system, 313)


def plain_attempt(system, case, order, tolerance, target=Plain):
    """Return the length that `Series.attempt` certifies in Python, 0 if none, and its bounds."""
    series = Series(stepper(system)[2].record)
    given, q, v = inputs(system, *case[:2])
    done, h, *_, bounds = series.attempt(target(series.slots), given, q, v, case[2], order, tolerance)
    return (h if done else 0.0), bounds


def test_tails_cut_one_order_later_than_sums_are_found_out():
    # A certificate for the order N + 1, taken for that of sums up to N, leaves v_{N+1} unbounded.
    system, generator, order = SYSTEMS[2], np.random.default_rng(6), 8
    found = []
    for case in draw(system, generator, 12):
        h, bounds = plain_attempt(system, case, order + 1, 1e-9)
        if h > 0.0:
            found.append(judge(system, case, order, 1e-9, h, bounds).excess)
    assert max(found) > 1.0


class Vanishing(Scene):
    """A mass (1 - x) that is pushed so that it moves at a constant speed, until it is no more."""

    coordinates = {"x": "m"}

    def kinetic(self, q, v, xp):
        return 0.5 * (1 - q.x) * v.x**2

    def applied(self, q, v, u, xp):
        return {"x": -0.5 * v.x**2}


def test_where_the_mass_vanishes_within_the_step_only_less_will_do():
    class Lenient(Plain):
        def less(self, a, b):
            return bool(a <= b)

    system = System(Vanishing(), lambda *_: ([[1.0]], [0.0]), (1.0,), (1.0,))
    case = ([0.0, 1.0], [], 1.0)  # at its end the mass is 0, and any acceleration solves the equation
    assert stepper(system)[2].record.force == (-1,)
    assert plain_attempt(system, case, 8, 1e-20)[0] < 1.0
    assert plain_attempt(system, case, 8, 1e-20, Lenient)[0] == 1.0
    assert plain_attempt(system, ([0.0, 1.0], [], 0.9), 8, 1e-20)[0] == 0.9


#: Equilibria: states at rest under forces that balance, by name of the system.
AT_REST = {
    "CartPole": ([0.5, 0.0, 0.0, 0.0], [0.0]),
    "Acrobot": ([0.0] * 4, [0.0]),
    "DoublePendulum": ([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0]),
    "TriplePendulum": ([0.1] + [0.0] * 7, [0.0]),
    "RotaryPendulum": ([1.0, 0.0, 0.0, 0.0], [0.0]),
    "TurningFrame": ([0.0] * 4, [0.0, 0.0]),
}


@pytest.mark.parametrize("system", [s for s in SYSTEMS if s.name in AT_REST], ids=lambda system: system.name)
def test_rest_at_an_equilibrium_is_certified_in_one_step(system):
    state, control = AT_REST[system.name]
    assert attempts(system, [(state, control, 0.05)], 16, TOLERANCE)[0][0] == 0.05


# --- bits ---------------------------------------------------------------------------------------------------


def rows_of(system, cases):
    """Return a block of rows: for each case inputs, places and velocities."""
    record = stepper(system)[2].record
    layout, n = Layout(record), record.size
    rows = np.zeros((2 * layout.bounds + 1, BLOCK))
    for lane, (state, control) in enumerate(cases):
        given, q, v = inputs(system, state, control)
        for name, row in layout.inputs.items():
            rows[row, lane] = given[name]
        rows[layout.q : layout.q + n, lane], rows[layout.v : layout.v + n, lane] = q, v
    return rows


def block_steps(system, cases, dt, order, **options):
    """Return places, velocities and the status of each lane after a control step of a block."""
    record = stepper(system)[2].record
    layout, rows = Layout(record), rows_of(system, cases)
    refused = compile_advance_block(record, **options)(rows.reshape(-1), 0, len(cases), dt, order)
    assert refused == (rows[layout.status, : len(cases)] < 0).sum()
    return rows[layout.q : layout.status + 1, : len(cases)].T


def single_steps(system, cases, dt, order, **options):
    """Return the same from the function for a single lane."""
    record = stepper(system)[2].record
    layout, rows = Layout(record), rows_of(system, cases)
    advance, results = compile_advance(record, **options), []
    for lane in range(len(cases)):
        one = np.zeros(layout.rows)
        one[: layout.status] = rows[: layout.status, lane]
        status = advance(one, dt, order)
        results.append([*one[layout.q : layout.status], status])
    return np.array(results)


def python_steps(system, cases, dt, order):
    """Return the same from Python's floats: the driver's own code on `Plain`."""
    record = stepper(system)[2].record
    series, layout, n = Series(record), Layout(record), record.size

    def attempt(rows, at, dt, order, tolerance):
        given = {name: rows[row] for name, row in layout.inputs.items()}
        q, v = (list(rows[first : first + n]) for first in (layout.q, layout.v))
        lane = Lane(q, v, *rows[layout.status : layout.bounds])
        after, bounds = series.substep(Plain(series.slots), given, lane, dt, order, tolerance)
        rows[layout.q : layout.bounds] = [*after.q, *after.v, after.status, after.left, after.wish]
        for row, bound in enumerate(bounds, layout.bounds):
            rows[row] += bound
        return not after.left > 0.0

    names = driver._numbers(record, TOLERANCE) | {"attempt": attempt, "np": np}
    advance = types.FunctionType(driver._advance.__code__, names)
    rows, results = rows_of(system, cases), []
    for lane in range(len(cases)):
        one = [0.0] * layout.rows
        one[: layout.status] = rows[: layout.status, lane].tolist()
        status = advance(one, dt, order)
        results.append([*one[layout.q : layout.status], status])
    return np.array(results)


@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_unfused_bits_are_those_of_plain_numbers(system):
    # The records' own scalars have to be unfused too: `SeriesStepper.code(absent, fused=False)`.
    generator = np.random.default_rng(7)
    cases = [system.draw(generator) for _ in range(3)]
    python = python_steps(system, cases, 0.03, 10)
    np.testing.assert_array_equal(single_steps(system, cases, 0.03, 10, fused=False), python)
    np.testing.assert_array_equal(block_steps(system, cases, 0.03, 10, fused=False, width=8), python)


@pytest.mark.parametrize("system", SYSTEMS[1:4:2], ids=NAMES[1:4:2])
@pytest.mark.parametrize("width", (4, 16))
def test_bits_depend_neither_on_the_width_nor_on_the_neighbours(system, width):
    generator = np.random.default_rng(8)
    cases = [system.draw(generator, 10.0 ** generator.uniform(-2, 0.3)) for _ in range(41)]
    alone = single_steps(system, cases, 0.02, 16)
    assert len(set(alone[:, -1])) > 1, "all took as many substeps"
    np.testing.assert_array_equal(block_steps(system, cases, 0.02, 16, width=width), alone)
    order = generator.permutation(len(cases))
    shuffled = block_steps(system, [cases[i] for i in order], 0.02, 16)
    np.testing.assert_array_equal(shuffled, alone[order])


def test_one_lane_in_trouble_leaves_the_others_alone():
    system, generator = SYSTEMS[2], np.random.default_rng(9)
    cases = [system.draw(generator) for _ in range(20)]
    alone = single_steps(system, cases, 0.02, 16)
    for lane, x in zip((3, 7, 11, 12), (math.nan, math.inf, 1e200, -1e308), strict=True):
        cases[lane] = ([*cases[lane][0][:3], x, *cases[lane][0][4:]], cases[lane][1])
    found = block_steps(system, cases, 0.02, 16)
    well = np.ones(20, bool)
    well[[3, 7, 11, 12]] = False
    np.testing.assert_array_equal(found[well], alone[well])
    assert (found[~well, -1] < 0).all()


# --- errors -------------------------------------------------------------------------------------------------


def exact_step(system, state, control, dt):
    """Return a control step in 40 digits, by series of parts so short that their tails do not count."""
    first, parts = 2 * system.driven, 1
    while True:
        at, h = list(state), flint.arb(dt) / parts
        for _ in range(parts):
            q, v = taylor(system, at, control, h, 30)
            if max(abs(float(x.coeffs()[-1])) / sum(abs(float(c)) for c in x.coeffs()) for x in v) > 1e-27:
                break
            ends = [sum(x.coeffs()) for pair in zip(q, v, strict=True) for x in pair]
            moved = []
            if first:
                u = flint.arb(control[0])
                moved = [at[0] + h * at[1] + h * h * u / 2, at[1] + h * u]
            at = [*moved, *ends]
        else:
            return at
        parts *= 2


def step_error(system, state, control, dt, order):
    """Return the worst error of a control step, as a part of condition times size."""
    found, constants, code = stepper(system)
    given = [constants[name.removeprefix("k_")] for name in code.constants]
    trajectory = np.array([state, state])
    assert not code.compile_simulate()(trajectory, np.array([control]), dt, order, *given)
    exact = exact_step(system, state, control, dt)
    first, n = 2 * system.driven, len(state)
    errors = np.array([float(z - flint.arb(x)) for x, z in zip(trajectory[1], exact, strict=True)])
    _, v = taylor(system, state, control, dt, 8)
    scale = np.ones(n)
    scale[first + 1 :: 2] = sizes(system, state, v)
    scale[first::2] = np.maximum(np.maximum(1.0, np.abs(state[first::2])), scale[first + 1 :: 2] * dt)
    derivatives, refused = found.jacobian(
        np.array([state]), np.array([control]), vars(system.scene), dt, order
    )
    assert not refused
    condition = np.linalg.norm(derivatives[0, :, :n] * scale / scale[:, None], 2)
    return np.max(np.abs(errors) / scale) / max(1.0, condition)


@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_error_of_a_control_step(system):
    generator = np.random.default_rng(11)
    assert max(step_error(system, *system.draw(generator), 0.02, 16) for _ in range(2)) < 1e-12


@pytest.mark.parametrize("order", range(SMALLEST_ORDER, LARGEST_ORDER + 1))
def test_every_order(order):
    system = SYSTEMS[2]
    case = system.draw(np.random.default_rng(13), 0.3)
    best = single_steps(system, [case], 0.02, 20)
    np.testing.assert_allclose(single_steps(system, [case], 0.02, order)[:, :-1], best[:, :-1], rtol=2e-13)


@pytest.mark.slow
def test_undamped_pendulum_keeps_its_energy_for_a_thousand_seconds():
    scene = type(SYSTEMS[2].scene)(friction=0.0)
    system = System(scene, SYSTEMS[2].motion, (3.0, 3.0), (1.0, 1.0), (1.0,))
    _, constants, code = stepper(system)
    simulate = code.compile_simulate()
    given = [constants[name.removeprefix("k_")] for name in code.constants]
    scale = 4 * scene.mass * scene.gravity * scene.length
    for start in ([0.0, 0.0, 2.0, 0.0, 2.5, 0.0], [0.0, 0.0, 3.0, 5.0, -2.0, -9.0]):
        trajectory = np.zeros((50_001, 6))
        trajectory[0] = start
        assert not simulate(trajectory, np.zeros((50_000, 1)), 0.02, 16, *given)
        energy = scene.energy(trajectory[::500])["total"]
        assert np.max(np.abs(energy - energy[0])) < 1e-9 * max(scale, energy[0])


# --- code for other processors ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("target", "features"),
    [
        ("x86_64-unknown-linux-gnu", ""),
        ("x86_64-pc-windows-msvc", "+avx2,+fma"),
        ("x86_64-unknown-linux-gnu", "+avx512f,+avx512dq,+fma"),
        ("aarch64-apple-darwin", "+neon"),
    ],
)
def test_code_for_every_processor_calls_nothing_and_fuses_only_where_asked(target, features):
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    found = binding.Target.from_triple(target).create_target_machine(features=features, opt=2)
    for fused in (False, True) if features else (False,):  # without features: a processor without fma
        record = stepper(SYSTEMS[1])[0].code(fused=fused).record  # sine, cosine, arc tangent, reciprocal
        for lanes in (1, 8):
            module = ir.Module()
            module.triple = target
            double, whole = ir.DoubleType(), ir.IntType(64)
            kind = ir.FunctionType(whole, [double.as_pointer(), double, whole, double])
            machine._write(module, "attempt", kind, record, lanes, fused)
            assembly = found.emit_assembly(binding.parse_assembly(str(module)))
            calls = set(re.findall(r"^\s+(?:callq?|bl)\s+(\S+)", assembly, re.MULTILINE))
            assert calls <= ({"__chkstk"} if "windows" in target else set())  # it touches the stack's pages
            assert fused == bool(re.search(r"^\s+v?fn?m(la|ls|add|sub)", assembly, re.MULTILINE))
