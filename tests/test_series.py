"""The general series: its certificate against exact tails, its bits in every form, its errors."""

from __future__ import annotations

import math
import types
from functools import cache

import flint
import numpy as np
import pytest
from series_systems import SYSTEMS, System, acceleration

from lag_envs.stepping.compiling import compile_python
from lag_envs.stepping.general import SeriesStepper
from lag_envs.stepping.machine import Layout, compile_attempt

NAMES = [system.name for system in SYSTEMS]
FLOATS = types.SimpleNamespace(
    number=float,
    **{name: getattr(math, name) for name in ("sin", "cos", "sqrt", "exp", "log", "atan", "tanh")},
)
LANES = 8


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


def excess(system, case, order, h, bounds):
    """Return the ratio of the worst true tail to its bound; NaN where the step has no length."""
    state, control, _ = case
    q, v = taylor(system, state, control, h, order + 18)
    after = [bound * h / (order + 2) for bound in bounds]
    ratios = [t / b for t, b in zip(sums(v, order + 1), bounds, strict=True)]
    return max(ratios + [t / b for t, b in zip(sums(q, order + 2), after, strict=True)])


def draw(system, generator, count):
    """Return cases whose certified steps are mostly limited by the tolerance."""
    cases = []
    for _ in range(count):
        state, control = system.draw(generator, 10.0 ** generator.uniform(-2.0, 0.2))
        cases.append((state, control, 10.0 ** generator.uniform(-2.5, 0.0)))
    return cases


@pytest.mark.parametrize("system", SYSTEMS, ids=NAMES)
def test_certificate_holds(system):
    generator = np.random.default_rng(5)
    worst, certified, near = 0.0, 0, 0
    for order, tolerance, count in ((6, 1e-5, 16), (8, 1e-14, 16), (10, 1e-9, 16), (16, 1e-14, 16)):
        cases = draw(system, generator, count)
        for case, (h, bounds) in zip(cases, attempts(system, cases, order, tolerance), strict=True):
            if h == 0:
                continue
            certified += 1
            ratio = excess(system, case, order, h, bounds)
            near += ratio > 0.01
            worst = max(worst, ratio)
            pass
    print(worst, certified, near)
    assert worst < 1
