"""The general series: its certificate against exact tails, its bits in every form, its errors."""

from __future__ import annotations

import ctypes
import math
import re
import threading
import time
import types
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

import flint
import numpy as np
import pytest
from contract_scenes import Bead, ElasticPendulum, Trolley
from covering import every, slow
from llvmlite import binding, ir
from mpmath import mp, mpf
from plain_target import FLOATS, Plain, advance_in_python, in_python
from series_systems import POINTS, SYSTEMS, System

from lag_envs.mechanics.recording import parameter_values
from lag_envs.report.oracle import oracle_of
from lag_envs.scenes import Chain, StepRefused
from lag_envs.scenes.base import Scene, parameter
from lag_envs.stepping import compiling, driver, general, machine
from lag_envs.stepping.certificate import SMALLEST_SIZE, Certificate
from lag_envs.stepping.compiling import BLOCK, absent_from, compile_python
from lag_envs.stepping.driver import compile_advance, compile_advance_block
from lag_envs.stepping.general import SeriesStepper
from lag_envs.stepping.lowering import ELAPSED
from lag_envs.stepping.machine import LaneLayout, compile_attempt
from lag_envs.stepping.series import (
    LARGEST_ORDER,
    TOLERANCE,
    TRIES,
    Series,
)

NAMES = [system.name for system in SYSTEMS]


# --- exact series -------------------------------------------------------------------------------------------


def _tanh(x):
    e = (2 * x).exp()
    return (e - 1) / (e + 1)


#: Functions of series in 40 digits and more.
EXACT = types.SimpleNamespace(
    tanh=_tanh,
    **{name: getattr(flint.arb_series, name) for name in ("sin", "cos", "sqrt", "exp", "log", "atan")},
)


def taylor(system, state, control, h, end):
    """Return exact coefficients of places and velocities, time in steps of h, by the oracle."""
    flint.ctx.prec, flint.ctx.cap = 160, end + 1
    found = oracle_of(system.scene).coefficients(state, control, h, end + 1, 45)
    return [
        [flint.arb_series([flint.arb(c) for c in of[n]]) for n in system.scene.coordinates] for of in found
    ]


def sums(series, first):
    """Return the sums of absolute coefficients from an order on."""
    return [sum(float(c.abs_upper()) for c in x.coeffs()[first:]) for x in series]


# --- tested series ------------------------------------------------------------------------------------------


@cache
def stepper(scene: Scene, fused: bool = True):
    """Return the scene's stepper, its constants and its code."""
    found = SeriesStepper(scene.mechanics)
    constants = found.constants(parameter_values(scene))
    return found, constants, found.code(absent_from(constants), fused)


def record_of(system, fused=True):
    return stepper(system.scene, fused)[2].record


def inputs(system, state, control):
    """Return the inputs of the series by name, places and velocities."""
    found, constants, code = stepper(system.scene)
    given = constants | found.prepare(FLOATS, state, control, constants)
    q, v = ([given[f"{x}{i}"] for i in range(code.record.size)] for x in "qv")
    return {name: given[name] for name in code.record.given}, q, v


def _run(rows, order, tolerance):
    return attempt(rows, 0, order, tolerance)  # noqa: F821


@cache
def compiled(record, lanes=1, fused=True):
    return compile_python("run", _run, compile_attempt(record, lanes, fused, bounds=lanes == 1))


def attempts(system, cases, order, tolerance):
    """Return for each case (state, control, h) the certified length, 0 if none, and bounds on the tails."""
    record = record_of(system)
    layout, n = LaneLayout(record), record.size
    run, results = compiled(record), []
    for state, control, h in cases:
        rows = np.zeros(layout.rows)
        given, q, v = inputs(system, state, control)
        for name, row in layout.inputs.items():
            rows[row] = given[name]
        rows[layout.q : layout.q + n], rows[layout.v : layout.v + n] = q, v
        rows[layout.left] = rows[layout.wish] = rows[layout.span] = h
        run(rows, order, tolerance)
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


def checked(system, case, order, tolerance, h, bounds):
    """Compare a certified step with its exact series."""
    state, control, _ = case
    q, v = taylor(system, state, control, h, order + 18)
    after = [bound * h / (order + 2) for bound in bounds]
    found = sums(v, order + 1)
    ratios = [t / b for t, b in zip(found + sums(q, order + 2), bounds + after, strict=True)]
    allowed = [tolerance * size for size in sizes(system, state, v)]
    return Judged(max(ratios), max(t / a for t, a in zip(found, allowed, strict=True)))


def draw(system, generator, order, tolerance):
    """Return a case (state, control, h) with h about the longest step that is certified as a whole."""
    state, control = system.draw(generator, 10.0 ** generator.uniform(-2.0, 0.2))
    h = 1e-4
    while h < 10.0 and attempts(system, [(state, control, h)], order, tolerance)[0][0] == h:
        h *= 1.5
    return state, control, h * 10.0 ** generator.uniform(-0.3, 0.3)


def certified(system, generator, order, tolerance, count):
    """Return `count` certified steps, judged."""
    found = []
    while len(found) < count:
        case = draw(system, generator, order, tolerance)
        ((h, bounds),) = attempts(system, [case], order, tolerance)
        if h > 0.0:
            found.append(checked(system, case, order, tolerance, h, bounds))
    return found


#: Orders and tolerances; loose ones come close to the radius of convergence.
SETTINGS = ((3, 1e-3), (6, 1e-5), (9, TOLERANCE), (10, 1e-9), (16, TOLERANCE))


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
    series = Series(record_of(system))
    given, q, v = inputs(system, *case[:2])
    done, h, *_, bounds = series.attempt(target(series.slots), given, q, v, case[2], order, tolerance)
    return (h if done else 0.0), bounds


def exact_nodes(record, scalars, q, v, h, order):
    """Return the exact series of all nodes of a record, up to an order."""
    flint.ctx.cap, values = order, []

    def weight(w):
        return flint.arb(scalars[w] if isinstance(w, str) else w)

    for node in record.nodes:
        args = [values[a] for a in node.args if a < len(values)]  # for a function, the first one counts
        match node.op:
            case "place":
                value = q[node.index]
            case "velocity":
                value = v[node.index]
            case "polynomial":
                value = flint.arb_series([weight(w) * flint.arb(h) ** k for k, w in enumerate(node.weights)])
            case "sum":
                total = sum(weight(w) * x for w, x in zip(node.weights[:-1], args, strict=True))
                value = total + weight(node.weights[-1])
            case "product":
                value = args[0] * args[1]
            case "reciprocal":
                value = 1 / args[0]
            case function:
                value = getattr(EXACT, function)(args[0])
        values.append(value)
    return values


@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_every_rule_bounds_its_tail(system):
    generator, order, tolerance, found = np.random.default_rng(15), 8, 1e-7, []
    record = record_of(system)
    series = Series(record)
    while len(found) < 8:
        state, control, h = draw(system, generator, order, tolerance)
        t, (given, q, v) = Plain(series.slots), inputs(system, state, control)
        given[ELAPSED] = 0.0
        certificate = Certificate(series, t, series.expand(t, given, q, v, h, order), h, order, tolerance)
        if certificate.check()[0]:
            exact = taylor(system, state, control, h, order + 18)
            nodes = exact_nodes(record, t.scalars(record, given), *exact, h, order + 18)
            found.append([(tail, sums([nodes[n]], order)[0]) for n, tail in certificate._tails.items()])
    assert all(true <= bound for tails in found for bound, true in tails)


def test_tails_cut_one_order_later_than_sums_are_found_out():
    # A certificate for the order N + 1, used for sums up to N, leaves v_{N+1} unbounded.
    system, generator, order = SYSTEMS[2], np.random.default_rng(6), 8
    found = []
    for _ in range(12):
        case = draw(system, generator, order + 1, 1e-9)
        h, bounds = plain_attempt(system, case, order + 1, 1e-9)
        if h > 0.0:
            found.append(checked(system, case, order, 1e-9, h, bounds).excess)
    assert max(found) > 1.0


class Vanishing(Scene):
    """A mass (1 - x) that is pushed to move at a constant speed, until it vanishes."""

    coordinates = {"x": "m"}

    def kinetic(self, q, v, xp):
        return 0.5 * (1 - q.x) * v.x**2

    def potential(self, q, xp):
        return 0.0

    def applied(self, q, v, u, xp):
        return {"x": -0.5 * v.x**2}


def test_where_the_mass_vanishes_within_the_step_only_less_will_do():
    class Lenient(Plain):
        def less(self, a, b):
            return bool(a <= b)

    system = System("vanishing mass", Vanishing(), lambda *_: ([[1.0]], [0.0]), (1.0,), (1.0,))
    case = ([0.0, 1.0], [], 1.0)  # at its end the mass is 0, and any acceleration solves the equation
    assert record_of(system).force == (-1,)
    assert plain_attempt(system, case, 8, 1e-20)[0] < 1.0
    assert plain_attempt(system, case, 8, 1e-20, Lenient)[0] == 1.0
    assert plain_attempt(system, ([0.0, 1.0], [], 0.9), 8, 1e-20)[0] == 0.9


#: States at rest under forces that balance, up to roundings.
AT_REST = {
    "cart-pole": [0.5, 0.0, math.pi, 0.0],
    "acrobot": [0.0] * 4,
    "double pendulum": [0.1, 0.0, math.pi, 0.0, 0.0, 0.0],
    "triple pendulum": [0.1] + [0.0] * 7,
    "rotary pendulum": [1.0, 0.0, math.pi, 0.0],
    "elastic pendulum": [0.1, 0.0, 0.1, 0.0, -0.4 - 0.3 * 9.81 / 40.0, 0.0],
    "turning frame": [0.0] * 4,
    "lattice": [0.0] * 4,
}


@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_rest_at_an_equilibrium_is_certified_in_one_step(system):
    control = [0.0] * len(system.push)
    assert attempts(system, [(AT_REST[system.name], control, 0.02)], 16, TOLERANCE)[0][0] == 0.02


def count_operations(system, order):
    """Return the number of sums, products and quotients of an attempt that is certified as a whole."""
    counts = Counter()

    def counting(slots):
        target = Plain(slots)
        for name in ("add", "sub", "mul", "div", "fma"):

            def counted(*numbers, name=name):
                counts[name] += 1
                return getattr(Plain, name)(target, *numbers)

            setattr(target, name, counted)
        return target

    state, control = system.draw(np.random.default_rng(1))
    assert plain_attempt(system, (state, control, 1e-3), order, TOLERANCE, counting)[0] == 1e-3
    return counts.total()


def test_operations_grow_no_faster_than_the_cube_of_the_number_of_links():
    chains = [System(f"{n} bars", Chain(bars=n), None, (1.0,) * n, (1.0,) * n, (1.0,)) for n in range(1, 7)]
    counts = [count_operations(chain, 16) / (n + 1) ** 3 for n, chain in enumerate(chains)]
    assert counts == sorted(counts, reverse=True)


# --- bits ---------------------------------------------------------------------------------------------------


def rows_of(system, cases):
    """Return a block of rows: for each case inputs, places and velocities."""
    record = record_of(system)
    layout, n = LaneLayout(record), record.size
    rows = np.zeros((2 * layout.bounds + 1, BLOCK))
    for lane, (state, control) in enumerate(cases):
        given, q, v = inputs(system, state, control)
        for name, row in layout.inputs.items():
            rows[row, lane] = given[name]
        rows[layout.q : layout.q + n, lane], rows[layout.v : layout.v + n, lane] = q, v
    return rows


def block_steps(system, cases, dt, order, fused=True, **options):
    """Return places, velocities and the status of each lane after a control step of a block."""
    record = record_of(system, fused)
    layout, rows = LaneLayout(record), rows_of(system, cases)
    rows[layout.span] = dt
    advance = compile_advance_block(record, fused=fused, **options)
    refused = advance(rows.reshape(-1), 0, len(cases), order)
    assert refused == (rows[layout.status, : len(cases)] < 0).sum()
    return rows[layout.q : layout.status + 1, : len(cases)].T


def single_steps(system, cases, dt, order, fused=True, **options):
    """Return the same from the function for a single lane."""
    record = record_of(system, fused)
    layout, rows = LaneLayout(record), rows_of(system, cases)
    advance, results = compile_advance(record, fused=fused, **options), []
    for lane in range(len(cases)):
        one = np.zeros(layout.rows)
        one[: layout.status] = rows[: layout.status, lane]
        status = advance(one, dt, order)
        results.append([*one[layout.q : layout.status], status])
    return np.array(results)


def simulate(scene, start, controls, dt, order, fused=True):
    """Return a trajectory, from compiled code or its replacement; as objects."""
    _, constants, code = stepper(scene, fused)
    given = [constants[name.removeprefix("k_")] for name in code.constants]
    trajectory = np.zeros((len(controls) + 1, len(start)))
    trajectory[0] = start
    run = code.compile_simulate()
    if isinstance(run, types.FunctionType):  # plain Python, which is to get Python's own numbers
        trajectory, controls = trajectory.astype(object), np.array(controls, dtype=object)
    assert not run(trajectory, np.asarray(controls), dt, order, *given)
    return trajectory


#: Scenes with states and controls that take several substeps; the last holds two rates.
WITH_SUBSTEPS = [(system.scene, *system.draw(np.random.default_rng(7))) for system in SYSTEMS]
WITH_SUBSTEPS.append((Trolley(), [0.2, 0.1, 1.0, 9.0, -0.5, -8.0], [0.7, 0.2, 0.3]))


@pytest.mark.parametrize(
    ("scene", "state", "control"),
    every(2, WITH_SUBSTEPS),
    ids=[*NAMES, "Trolley"],
)
def test_unfused_bits_are_those_of_plain_numbers(scene, state, control, monkeypatch):
    assert len(state) == len(scene.state_names)
    compiled = simulate(scene, state, [control] * 3, 0.04, 10, fused=False)
    monkeypatch.setattr(compiling, "compile_function", in_python)
    monkeypatch.setattr(driver, "compile_advance", advance_in_python)
    python = simulate(scene, state, [control] * 3, 0.04, 10, fused=False)
    np.testing.assert_array_equal(compiled, python.astype(float))
    assert all(type(x) is float for x in python.flat)


@pytest.mark.parametrize("system", SYSTEMS[:4], ids=NAMES[:4])
def test_bits_do_not_depend_on_how_many_products_are_summed_side_by_side(system):
    case = (*system.draw(np.random.default_rng(9)), 0.02)
    narrow = type("Narrow", (Plain,), {"group": 2})
    assert plain_attempt(system, case, 16, 1e-12, narrow) == plain_attempt(system, case, 16, 1e-12)


@pytest.mark.parametrize(
    ("system", "width", "fused"),
    [slow(SYSTEMS[1], 4, True), (SYSTEMS[1], 16, True), slow(SYSTEMS[3], 8, False)],
    ids=["4", "16", "8 unfused"],
)
def test_bits_depend_neither_on_the_width_nor_on_the_neighbours(system, width, fused):
    generator = np.random.default_rng(8)
    cases = [system.draw(generator, 10.0 ** generator.uniform(-2, 0.3)) for _ in range(41)]
    alone = single_steps(system, cases, 0.02, 16, fused)
    assert len(set(alone[:, -1])) > 1, "all took as many substeps"
    order = generator.permutation(len(cases))
    shuffled = block_steps(system, [cases[i] for i in order], 0.02, 16, fused, width=width)
    np.testing.assert_array_equal(shuffled, alone[order])
    for lane in (0, 20, 40):
        state, control = cases[lane]
        end = simulate(system.scene, state, [control], 0.02, 16, fused)[1, 2 * system.driven :]
        np.testing.assert_array_equal([*end[::2], *end[1::2]], alone[lane, :-1])


LOW_ORDERS = [(3, 1e-3), slow(4, 1e-3), (5, 1e-3), *(slow(order, 1e-3) for order in (6, 7, 10))]


@pytest.mark.parametrize(("order", "tolerance"), [*LOW_ORDERS, slow(8, TOLERANCE), slow(12, TOLERANCE)])
@pytest.mark.parametrize("system", every(4, SYSTEMS), ids=NAMES)
def test_code_for_a_fixed_order_gives_the_same_bits(system, order, tolerance):
    generator = np.random.default_rng(10)
    cases = [system.draw(generator, 10.0 ** generator.uniform(-2, 0.3)) for _ in range(20)]
    loops = single_steps(system, cases, 0.02, order, tolerance=tolerance)
    fixed = {"tolerance": tolerance, "fixed_order": order}
    np.testing.assert_array_equal(single_steps(system, cases, 0.02, order, **fixed), loops)
    np.testing.assert_array_equal(block_steps(system, cases, 0.02, order, **fixed), loops)


class Polar(Scene):
    """A ball on a spring in polar coordinates: at r = 0 the mass matrix is singular."""

    coordinates = {"r": "m", "phi": "rad"}

    def kinetic(self, q, v, xp):
        return 0.5 * (v.r**2 + (q.r * v.phi) ** 2)

    def potential(self, q, xp):
        return 2.0 * q.r**2


class Sled(Bead):
    """Sliding with a drag that is far too heavy for a series."""

    drag: float = parameter(1e9, "N s/m", least=0.0)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.drag * v.x**2


POLAR = System("polar", Polar(), None, (1.0, 3.1), (1.0, 6.0), (), (1.5, 0.0))


@pytest.mark.parametrize(
    ("system", "trouble"),
    [
        (SYSTEMS[1], {3: {1: math.nan}, 7: {1: math.inf}, 11: {1: 1e200}, 12: {3: -1e308}, 13: {0: 1e300}}),
        (POLAR, {2: {0: 0.0}, 3: {0: 1e-300}, 9: {0: 1e200}, 17: {0: 0.1, 1: -100.0, 3: 0.0}}),
    ],
    ids=["Acrobot", "Polar"],
)
def test_trouble_in_one_lane_leaves_the_others_alone(system, trouble):
    generator = np.random.default_rng(9)
    cases = [system.draw(generator) for _ in range(20)]
    alone = single_steps(system, cases, 0.02, 16)
    for lane, changes in trouble.items():
        state = [changes.get(i, x) for i, x in enumerate(cases[lane][0])]
        cases[lane] = state, cases[lane][1]
    found = block_steps(system, cases, 0.02, 16, width=16)
    well = np.array([lane not in trouble for lane in range(20)])
    np.testing.assert_array_equal(found[well], alone[well])
    assert (found[~well, -1] < 0).all()


@pytest.mark.parametrize(
    ("scene", "state"),
    [
        (Polar(), [0.0, 0.1, 0.0, 1.0]),  # singular from the start
        (Polar(), [0.1, -100.0, 0.0, 0.0]),  # in mid-step
        (Sled(), [0.0, 1.0]),  # more substeps than are allowed
    ],
)
def test_step_that_cannot_be_certified_is_refused(scene, state):
    _, constants, code = stepper(scene)
    given = [constants[name.removeprefix("k_")] for name in code.constants]
    trajectory = np.full((3, len(state)), 7.0)
    trajectory[0] = state
    assert code.simulation(trajectory, np.zeros((2, 0)), 0.02, 16, *given) == 1
    np.testing.assert_array_equal(trajectory, [state] + [[7.0] * len(state)] * 2)


class Spring(Scene):
    """A spring with drag, linear; and if `beside`, a pendulum that it does not touch."""

    stiffness: float = parameter(1e4, "N/m", above=0.0)
    drag: float = parameter(0.0, "N s/m", least=0.0)
    beside: float = parameter(0.0, "kg m²", least=0.0)
    coordinates = {"x": "m", "phi": "rad"}

    def kinetic(self, q, v, xp):
        return 0.5 * (v.x**2 + v.phi**2)

    def potential(self, q, xp):
        return 0.5 * self.stiffness * q.x**2 - self.beside * xp.cos(q.phi)

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.drag * v.x**2


@pytest.mark.parametrize("beside", [0.0, slow(1.0)])
@pytest.mark.parametrize(
    ("stiffness", "drag", "dt"),
    [
        (1e4, 0.0, 0.02), (1e5, 4.0, 0.02), (1e6, 0.0, 0.02), (6e6, 4.0, 0.02), (4e7, 0.0, 0.02),
        (1e4, 0.0, 0.1), (1e2, 1e3, 0.02), (1e2, 1e4, 0.02), (1e2, 1e5, 0.02), (1e6, 2e3, 0.02),
    ],
)  # fmt: skip
def test_stiff_linear_motion_is_accurate(stiffness, drag, dt, beside):
    """Its series converges for any step, but the terms of a long one are many orders above the motion."""
    scene = Spring(stiffness=stiffness, drag=drag, beside=beside)
    with mp.workdps(80):
        flow = mp.expm(mp.matrix([[0, 1], [-mpf(stiffness), -mpf(drag)]]) * mpf(dt))
        wanted = np.array((flow * mp.matrix([1.0, 0.3])).tolist(), float)[:, 0]
        slopes = np.array(flow.tolist(), float)
    scale = np.array([1.0, math.sqrt(stiffness)])
    after = scene.simulate([1.0, 0.3, 0.5, -1.0], 1, dt)[1]
    assert (np.abs(after[:2] - wanted) < 1e-12 * scale).all()
    found = scene.jacobian([1.0, 0.3, 0.5, -1.0], [], dt)[0][:2, :2]
    assert (np.abs(found - slopes) < 4e-12 * scale[:, None] / scale).all()
    bound = scene.step_bound([1.0, 0.3, 0.5, -1.0], [], dt)
    assert bound.bounds["x"] < 2e-12 and bound.bounds["x_dot"] < 2e-12 * scale[1]


class Sliding(Scene):
    """A force tanh(x), and x moves evenly: the gain of speed has a closed form."""

    mass: float = parameter(1e-6, "kg", above=0.0)
    force: float = parameter(1000.0, "N", above=0.0)
    coordinates = {"x": "m", "y": "m"}

    def kinetic(self, q, v, xp):
        return (self.mass * v.x**2 + v.y**2) / 2

    def potential(self, q, xp):
        return 0.0

    def applied(self, q, v, u, xp):
        return {"y": self.force * xp.tanh(q.x)}


@pytest.mark.parametrize("x", [12.0, 16.0, 18.5, 19.3, 25.0, -19.3, 300.0])
def test_tanh_that_rounds_to_one_keeps_its_digits(x):
    """Its slope must not come from 1 - tanh², which has none left: the step would be certified, and wrong."""
    scene, dt = Sliding(), 0.02
    rate = -math.copysign(8.0, x) / dt
    after = scene.simulate([x, rate, 0.0, 0.0], 1, dt)[1]
    end, start = abs(x) - 8.0, abs(x)
    logarithm = -8.0 + math.log1p(math.exp(-2.0 * end)) - math.log1p(math.exp(-2.0 * start))
    error = abs(after[3] - scene.force * logarithm / rate)
    assert error < 1e-14 * abs(after[3])
    wanted = scene.force * math.sinh(8.0) / (math.cosh(start) * math.cosh(end)) / abs(rate)
    assert scene.jacobian([x, rate, 0.0, 0.0], [], dt)[0][3, 0] == pytest.approx(wanted, rel=1e-12)


class Ledge(Bead):
    """A ledge, steep at 0 and nearly level elsewhere."""

    height: float = parameter(1000.0, "J")

    def potential(self, q, xp):
        return self.height * xp.tanh(q.x)


@pytest.mark.slow
@pytest.mark.parametrize("x", [9.0, -16.0, 25.0])
def test_force_of_a_tanh_keeps_its_digits(x):
    """h - h tanh² would have none left."""
    force, dt = -1000.0 / math.cosh(x) ** 2, 0.02
    after = Ledge().simulate([x, 0.0], 1, dt)[1]
    assert after[1] == pytest.approx(force * dt, rel=1e-9)  # it hardly moves
    slope = Ledge().jacobian([x, 0.0], [], dt, parameters=["height"])[2]
    assert slope[1, 0] == pytest.approx(force * dt / 1000.0, rel=1e-9)


def test_refusal_of_a_scene_brings_what_went_before():
    with pytest.raises(StepRefused, match="step 2 of 4") as refusal:
        Polar().simulate([0.5, -10.0, 0.0, 0.0], 4, 0.02)
    assert refusal.value.trajectory.shape == (3, 4)


@pytest.mark.parametrize(
    ("scene", "state", "most"),
    [
        (Trolley(), [0.1, 0.2, 0.7, 1.0, -0.4, 2.0], 1.01),
        (ElasticPendulum(), [0.0, 0.5, 0.1, -0.3, 0.2], 1.0),  # v and w differ by a constant
    ],
)
def test_bound_of_what_carries_a_held_rate(scene, state, most):
    bound = scene.step_bound(state, [1.0, 0.5, 0.1][: len(scene.control_names)], 0.02)
    assert bound.substeps == 1
    for name in scene.coordinates:
        velocity = bound.bounds[name] * (bound.order + 2) / 0.02
        assert velocity * (1.0 - 1e-12) < bound.bounds[f"w_{name}"] < velocity * (most + 1e-12)


def test_threads_share_a_scene_and_run_side_by_side():
    scene = Chain(bars=2, gravity=0.0, damping=0.01)  # used nowhere else: both threads find nothing compiled
    controls = np.random.default_rng(10).uniform(-5.0, 5.0, 200_000)
    starts = [[0.0, 0.0, 1.0, 2.0, -1.0, x] for x in (3.0, -4.0)]
    found, turns = {}, 0

    def work(i):
        found[i] = scene.simulate(starts[i], controls, 0.02)

    threads = [threading.Thread(target=work, args=[i]) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    thread = threading.Thread(target=work, args=[2])
    starts.append(starts[0])
    thread.start()
    while thread.is_alive():  # a kernel that kept the interpreter's lock would leave one turn or two
        time.sleep(1e-3)
        turns += 1
    assert turns > 10
    for i, start in enumerate(starts):
        np.testing.assert_array_equal(found[i], scene.simulate(start, controls, 0.02))


# --- errors -------------------------------------------------------------------------------------------------


def exact_step(system, state, control, dt):
    """Return a control step in 40 digits."""
    return [flint.arb(x) for x in oracle_of(system.scene).once(state, control, dt, 40)]


def exact_slopes(system, state, control, dt):
    """Return the derivatives of `exact_step` by states and controls, by differences in 60 digits."""
    with flint.ctx.workdps(60):
        little, n = flint.arb(1e-15), len(state)
        exact, columns = exact_step(system, state, control, dt), []
        for j in range(n + len(control)):
            given = [*state, *control]
            given[j] += little
            moved = exact_step(system, given[:n], given[n:], dt)
            columns.append([float((a - b) / little) for a, b in zip(moved, exact, strict=True)])
    return np.array(columns).T


def step_error(system, state, control, dt, order):
    """Return the worst error of a control step, relative to condition times size."""
    end = simulate(system.scene, state, [control], dt, order)[1]
    exact = exact_step(system, state, control, dt)
    first, n = 2 * system.driven, len(state)
    errors = np.array([float(z - flint.arb(x)) for x, z in zip(end, exact, strict=True)])
    _, v = taylor(system, state, control, dt, 8)
    scale = np.ones(n)
    scale[first + 1 :: 2] = sizes(system, state, v)
    scale[first::2] = np.maximum(np.maximum(1.0, np.abs(state[first::2])), scale[first + 1 :: 2] * dt)
    slopes = exact_slopes(system, state, control, dt)[:, :n] * scale / scale[:, None]
    return np.max(np.abs(errors) / scale) / max(1.0, np.linalg.norm(slopes, 2))


@pytest.mark.parametrize("system", every(2, SYSTEMS), ids=NAMES)
def test_error_of_a_control_step(system):
    generator = np.random.default_rng(11)
    assert max(step_error(system, *system.draw(generator), 0.02, 16) for _ in range(2)) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
@pytest.mark.parametrize(("dt", "order"), [(0.02, 12), (0.05, 20)])
def test_error_of_many_control_steps(system, dt, order):
    generator = np.random.default_rng(12)
    assert max(step_error(system, *system.draw(generator), dt, order) for _ in range(20)) < 1e-12


@pytest.mark.parametrize("order", range(4, LARGEST_ORDER + 1))
def test_every_order(order):
    system = SYSTEMS[2]
    case = system.draw(np.random.default_rng(13), 0.3)
    best = single_steps(system, [case], 0.02, 20)
    found = single_steps(system, [case], 0.02, order)
    # Low orders take hundreds of substeps.
    np.testing.assert_allclose(found[:, :-1], best[:, :-1], rtol=1e-13 + 1e-14 * found[0, -1])


@pytest.mark.parametrize("start", [[0.0, 0.0, 2.0, 0.0, 2.5, 0.0], [0.0, 0.0, 3.0, 5.0, -2.0, -9.0]])
def test_undamped_pendulum_keeps_its_energy_for_a_thousand_seconds(start):
    scene = Chain(**POINTS | {"damping": 0.0})
    trajectory = simulate(scene, start, np.zeros((50_000, 1)), 0.02, 16)
    energy = scene.energy(trajectory[::100])["total"]
    scale = 4 * scene.mass * scene.gravity * scene.length
    assert np.max(np.abs(energy - energy[0])) < 1e-9 * max(scale, energy[0])


# --- code for other processors ------------------------------------------------------------------------------


def attempt_for(target, machine_code, fused, lanes):
    """Return the module of an attempt for another processor, and its assembly."""
    record = record_of(SYSTEMS[1], fused)  # sine, cosine, arc tangent, reciprocal
    module = ir.Module()
    module.triple = target
    double, whole = ir.DoubleType(), ir.IntType(64)
    kind = ir.FunctionType(whole, [double.as_pointer(), whole, double])
    machine._write(module, "attempt", kind, record, lanes, fused, bounds=lanes == 1)
    parsed = binding.parse_assembly(str(module))
    return parsed, machine_code.emit_assembly(parsed)


@pytest.mark.parametrize("lanes", [slow(1), 8])
@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize(
    ("target", "features"),
    [
        ("x86_64-unknown-linux-gnu", ""),
        ("x86_64-unknown-linux-gnu", "+avx512f,+avx512dq,+fma"),
        ("x86_64-pc-windows-msvc", "+avx2,+fma"),
        ("aarch64-apple-darwin", "+neon"),
    ],
)
def test_code_for_every_processor(target, features, fused, lanes):
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    found = binding.Target.from_triple(target)
    machine_code = found.create_target_machine(features=features, opt=2, codemodel="small")
    _, assembly = attempt_for(target, machine_code, fused, lanes)
    calls = set(re.findall(r"^\s+(?:callq?|bl)\s+([\w*%]+)", assembly, re.MULTILINE))
    if fused and not features:  # a processor without fused instructions calls the C library
        assert calls == {"fma"}
    else:
        assert calls <= ({"__chkstk"} if "windows" in target else set())  # touches a large stack's pages
    fuses = re.search(r"^\s+v?fn?m(la|ls|add|sub)\d*[sp]?d?\b", assembly, re.MULTILINE)
    assert bool(fuses) == bool(fused and features)


def test_bits_do_not_depend_on_fused_instructions():
    system, order = SYSTEMS[1], 12
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    triple = binding.get_process_triple()
    machine_code = binding.Target.from_triple(triple).create_target_machine(opt=2, jit=True)
    module, assembly = attempt_for(triple, machine_code, True, 1)
    assert "x86_64" not in triple or not re.search(r"^\s+vfn?m", assembly, re.MULTILINE)
    engine = binding.create_mcjit_compiler(module, machine_code)
    engine.finalize_object()
    kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64, ctypes.c_double)
    attempt = kind(engine.get_function_address("attempt"))
    layout, rows = LaneLayout(record_of(system)), rows_of(system, [system.draw(np.random.default_rng(14))])
    results = []
    for run in (attempt, compiled(record_of(system))):
        one = np.zeros(layout.rows)
        one[: layout.status] = rows[: layout.status, 0]
        one[layout.left] = one[layout.wish] = one[layout.span] = 0.02
        given = one.ctypes.data if run is attempt else one
        run(given, order, TOLERANCE)
        results.append(one)
    assert results[0][layout.left] < 0.02
    np.testing.assert_array_equal(*results)


def test_numbers_in_the_documentation():
    path = Path(__file__).parents[1] / "docs" / "engine.md"
    text = " ".join(path.read_text(encoding="utf-8").replace("$", "").split())
    orders = [general.usual_order(dt) for dt in (0.03, 0.1, 0.2)]
    said = [
        f"N is {orders[0]} up to dt = 0.03 s, {orders[1]} up to 0.1 s, else {orders[2]}",
        f"E_v is {TOLERANCE:.0e} of the size of each velocity",
        f"counts as at least {SMALLEST_SIZE:.0e}",
        f"up to {TRIES} shorter ones",
        f"refused after {driver.LARGEST_COUNT:,} attempts",
        f"would be shorter than {driver.SMALLEST_PART:.0e} of the control step".replace("e-0", "e-"),
    ]
    assert [words for words in said if words not in text] == []
