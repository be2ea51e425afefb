"""The derived equations are Lagrange's: checked against SymPy's derivatives in 40 digits, at random."""

import dataclasses
import functools
from types import SimpleNamespace

import contract_scenes
import mpmath
import numpy as np
import pytest
import sympy
from covering import every, slow

from lag_envs.mechanics.algebra import evaluate
from lag_envs.mechanics.equations import place, velocity
from lag_envs.mechanics.recording import control, parameter, parameter_names
from lag_envs.scenes import SCENES, symbolic
from lag_envs.scenes.cart_pole import CartPole
from lag_envs.scenes.chain import Chain
from lag_envs.scenes.derivation import form_of
from lag_envs.scenes.pivoted_bar import PivotedBar
from lag_envs.stepping.general import series_code_of


def variants(scene):
    """Return the keywords with which a scene has different equations."""
    if scene is Chain:
        return [{"bars": n} for n in (1, 2, 3)]
    if scene is PivotedBar:
        return [{}, {"track": None}]
    return [{"control": mode} for mode in getattr(scene, "modes", ())] or [{}]


PACKAGE = [(scene, keywords) for scene in SCENES for keywords in variants(scene)]
CASES = [*PACKAGE, *((scene, {}) for scene in contract_scenes.ALL)]
SLOW = [(Chain, {"bars": n}) for n in (4, 5, 6)]
IDS = ["-".join([s.__name__, *(f"{v}" for v in k.values())]) for s, k in [*CASES, *SLOW]]
scenes = pytest.mark.parametrize(
    "case",
    [*every(2, [(case,) for case in CASES]), *(slow(case) for case in SLOW)],
    ids=IDS,
)


def complete(case):
    """Return a scene with no parameter zero, so that all its terms are present."""
    scene, keywords = case
    made = scene(**keywords)
    zero = [f.name for f in dataclasses.fields(made) if "unit" in f.metadata and getattr(made, f.name) == 0.0]
    return scene(**keywords, **dict.fromkeys(zero, 0.3))


class Lagrange:
    """Lagrange's equations of one scene by SymPy, as functions of mpmath's numbers.

    Attributes
    ----------
    prescribed : tuple of str
        The coordinates that are not free.
    """

    def __init__(self, scene):
        self.scene, self.prescribed = scene, tuple(scene.prescribed)
        self.coordinates = (*scene.coordinates, *self.prescribed)
        self.parameters = tuple(parameter_names(scene))
        of = {name: sympy.Function(name, real=True)(symbolic.t) for name in self.coordinates}
        q, v, self.a = ({name: sympy.Symbol(f"{k}_{name}") for name in self.coordinates} for k in "qva")
        u = {name: sympy.Symbol(f"u_{name}") for name in scene.control_names}
        replaced = {sympy.Function(name, real=True)(symbolic.t): symbol for name, symbol in u.items()}
        for name, q_t in of.items():
            rates = q_t.diff(symbolic.t), q_t.diff(symbolic.t, 2)
            replaced |= {q_t: q[name], rates[0]: v[name], rates[1]: self.a[name]}
        twin = symbolic.symbolic(scene)
        self.inputs = [*q.values(), *v.values(), *self.a.values(), *u.values()]
        self.inputs += [getattr(twin, name) for name in self.parameters]
        self.terms, self.mass = {}, {}
        for name in self.coordinates:
            equation = symbolic.euler_lagrange(scene, name).xreplace(replaced)
            self.terms[name] = [self._function(term) for term in sympy.Add.make_args(equation)]
            self.mass[name] = {other: self._function(equation.diff(a)) for other, a in self.a.items()}
        self.rests = {name: self._function(sympy.sympify(value)) for name, value in twin.rests().items()}

    def _function(self, expression):
        return sympy.lambdify(self.inputs, expression, modules="mpmath")

    def point(self, generator):
        """Return random numbers for places, velocities, accelerations, controls and parameters.

        Accelerations of free coordinates are 0.
        """
        real = lambda: mpmath.mpf(generator.uniform(-1.5, 1.5))  # noqa: E731
        p = {name: mpmath.mpf(generator.uniform(0.3, 1.5)) for name in self.parameters}
        u = {name: real() for name in self.scene.control_names}
        q, v = ({name: real() for name in self.coordinates} for _ in range(2))
        a = dict.fromkeys(self.coordinates, mpmath.mpf(0))
        for name in self.prescribed:
            if name + "_ddot" in u:
                a[name] = u[name + "_ddot"]
            elif name + "_dot" in u:
                v[name] = u[name + "_dot"]
            else:
                v[name] = mpmath.mpf(0)
                still = [mpmath.mpf(0)] * (len(self.inputs) - len(p))
                at_rest = self.rests.get(name, lambda *numbers: mpmath.mpf(0))
                q[name] = u[name] if name in u else at_rest(*still, *p.values())
        return SimpleNamespace(q=q, v=v, a=a, u=u, p=p)

    def numbers(self, point):
        return [x for part in (point.q, point.v, point.a, point.u, point.p) for x in part.values()]

    def residual(self, coordinate, point):
        """Return the residual of Lagrange's equation for a coordinate, and the largest of its terms."""
        terms = [f(*self.numbers(point)) for f in self.terms[coordinate]]
        return mpmath.fsum(terms), max([*map(abs, terms), mpmath.mpf("1e-3")])


@functools.cache
def _oracle(scene):
    return Lagrange(scene)


def symbols(point):
    values = {place(name): x for name, x in point.q.items()} | {
        velocity(name): x for name, x in point.v.items()
    }
    values |= {control(name): x for name, x in point.u.items()}
    return values | {parameter(name): x for name, x in point.p.items()}


def solved(mechanics, values):
    n = len(mechanics.free)
    mass = mpmath.matrix(n, n)
    for i in range(n):
        for j in range(n):
            mass[i, j] = evaluate([mechanics.entry(i, j)], values, mpmath)[0]
    right = mpmath.matrix(evaluate(mechanics.force, values, mpmath))
    return list(mpmath.lu_solve(mass, right))


@scenes
def test_accelerations_and_forces_solve_lagranges_equations(case):
    scene = complete(case)
    oracle, mechanics = _oracle(scene), scene.mechanics
    generator = np.random.default_rng(3)
    with mpmath.workdps(40):
        for _ in range(5):
            point = oracle.point(generator)
            values = symbols(point)
            point.a |= dict(zip(mechanics.free, solved(mechanics, values), strict=True))
            for name in mechanics.free:
                residual, size = oracle.residual(name, point)
                assert abs(residual) < 1e-25 * size
            full = mechanics.full
            for m, name in enumerate(oracle.prescribed, start=len(mechanics.free)):
                entries = [full.entry(m, j) for j in range(len(full.coordinates))]
                numbers = evaluate([*entries, full.force[m]], values, mpmath)
                force = (
                    mpmath.fsum(g * point.a[c] for g, c in zip(numbers, full.coordinates, strict=False))
                    - numbers[-1]
                )
                expected, size = oracle.residual(name, point)
                assert abs(force - expected) < 1e-25 * size


@scenes
def test_energy_changes_by_what_power_says(case):
    """dE/dt along the motion, by differences, is drive + applied - drag as `power` gives them."""
    scene = complete(case)
    generator = np.random.default_rng(4)
    states = generator.uniform(0.1, 1.0, (4, len(scene.state_names)))
    controls = generator.uniform(-1.0, 1.0, (4, len(scene.control_names)))
    name = "jacobi" if "jacobi" in scene.energy(states, controls) else "total"
    rates = rate(scene, states, controls)
    step = 1e-5
    ahead, behind = (scene.energy(states + sign * step * rates, controls)[name] for sign in (1.0, -1.0))
    power = scene.power(states, controls)
    expected = power["drive"] + power["applied"] - power["drag"]
    np.testing.assert_allclose((ahead - behind) / (2 * step), expected, rtol=1e-6, atol=1e-6)


def rate(scene, states, controls):
    """Return d(state)/dt by solving for accelerations; that of w by differences along the motion."""
    from lag_envs.mechanics.evaluation import MotionPoint, Numeric

    columns = [np.moveaxis(a, -1, 0) for a in (states, controls)]
    point = MotionPoint(scene.mechanics, scene._symbols(), *columns, Numeric)
    return np.stack([np.broadcast_to(r, states.shape[:-1]) for r in point.rates()], axis=-1)


@scenes
def test_linearisation_is_the_derivative(case):
    scene = complete(case)
    generator = np.random.default_rng(5)
    state = generator.uniform(0.2, 1.0, len(scene.state_names))
    held = generator.uniform(-1.0, 1.0, len(scene.control_names))
    both, step = np.concatenate([state, held]), 1e-5
    n = len(state)
    A, B = scene.linearise(state, held)
    for k in range(len(both)):
        numbers = []
        for h in (-2, -1, 1, 2):
            moved = both.copy()
            moved[k] += h * step
            numbers.append(rate(scene, moved[None, :n], moved[None, n:])[0])
        far, near = numbers[3] - numbers[0], numbers[2] - numbers[1]
        slope = (8 * near - far) / (12 * step)
        mine = A[:, k] if k < n else B[:, k - n]
        np.testing.assert_allclose(mine, slope, rtol=1e-7, atol=1e-7 * max(1.0, np.abs(slope).max()))


def test_linearisation_has_floats_where_numbers_are_large():
    class Stiff(contract_scenes.ChargedParticle):
        def potential(self, q, xp):
            return 1.327e20 * (q.x**2 + q.y**2)

    A, B = Stiff().linearise([1.0, 0.0, 0.0, 0.0])
    assert A.dtype == B.dtype == np.float64 and A[1, 0] == -2 * 1.327e20


def test_held_rate_carries_what_stays_continuous():
    """M (w - v) = Σ G ṡ, and w' by differences of w along the motion with these accelerations."""
    scene = contract_scenes.Trolley()
    assert scene.state_names == ("s", "h", "alpha", "w_alpha", "beta", "w_beta")
    generator = np.random.default_rng(6)
    with mpmath.workdps(40):
        for _ in range(3):
            oracle = _oracle(scene)
            point = oracle.point(generator)
            point.p = {name: mpmath.mpf(getattr(scene, name)) for name in point.p}
            values = symbols(point)
            a = solved(scene.mechanics, values)

            def carried(t, oracle=oracle, point=point, a=a):
                """Return w at the time t along the parabola of the motion."""
                q, v = dict(point.q), dict(point.v)
                for name, x in zip(("alpha", "beta"), a, strict=True):
                    q[name], v[name] = q[name] + t * v[name] + t * t * x / 2, v[name] + t * x
                for name in ("s", "h"):
                    q[name] = q[name] + t * v[name]
                numbers = oracle.numbers(SimpleNamespace(q=q, v=v, a=point.a, u=point.u, p=point.p))
                free = "alpha", "beta"
                mass = mpmath.matrix([[oracle.mass[i][j](*numbers) for j in free] for i in free])
                drive = mpmath.matrix([sum(oracle.mass[i][c](*numbers) * v[c] for c in "sh") for i in free])
                shift = mpmath.lu_solve(mass, drive)
                return [v["alpha"] + shift[0], v["beta"] + shift[1]]

            w = [float(x) for x in carried(mpmath.mpf(0))]
            state = [
                float(point.q["s"]),
                float(point.q["h"]),
                float(point.q["alpha"]),
                w[0],
                float(point.q["beta"]),
                w[1],
            ]
            held = [float(point.u[name]) for name in scene.control_names]
            found = rate(scene, np.array([state]), np.array([held]))[0]
            step = mpmath.mpf("1e-12")
            ahead, behind = carried(step), carried(-step)
            expected = [float((x - y) / (2 * step)) for x, y in zip(ahead, behind, strict=True)]
            np.testing.assert_allclose(found[[3, 5]], expected, rtol=1e-9)
            np.testing.assert_allclose(
                found[[2, 4]], [float(point.v[c]) for c in ("alpha", "beta")], rtol=1e-12
            )


STEPPED = [(CartPole, {}), (contract_scenes.RotatingFrame, {}), (contract_scenes.ElasticPendulum, {})]


@pytest.mark.parametrize("case", [*STEPPED, *(slow(case) for case in CASES if case not in STEPPED)])
def test_energy_balance_of_a_step(case):
    """The change of energy over a step by the general series is the work done in it, by quadrature."""
    scene = complete(case)
    generator = np.random.default_rng(7)
    state = generator.uniform(0.1, 1.0, len(scene.state_names))
    held = generator.uniform(-1.0, 1.0, len(scene.control_names))
    balance = scene.energy_balance(state, held, 0.02)
    size = max(1.0, *(abs(balance[name]) for name in ("change", "work", "loss")))
    assert abs(balance["residual"]) < 1e-12 * size


FORMS = {
    "PivotedBar": "Coefficients",
    "Incline-damping": "FixedSlope",
    "Incline-tilt": "FixedSlope",
    "Incline-tilt_rate": "TurningSlope",
    "CylinderInCylinder-damping": "Coefficients",
    "CylinderInCylinder-tilt": "Coefficients",
    "Chain-1": "Coefficients",
    "Pendulum": "Coefficients",
}


@pytest.mark.parametrize("case", PACKAGE, ids=IDS[: len(PACKAGE)])
def test_normal_form_is_the_derived_equation(case):
    """The exact flows step Lagrange's equation, and so does the general series."""
    scene = complete(case)
    form, mechanics = form_of(scene), scene.mechanics
    key = "-".join([type(scene).__name__, *(str(v) for v in case[1].values() if v is not None)])
    assert (form and form.kind.__name__) == FORMS.get(key)
    if form is None:
        return
    oracle, generator = _oracle(scene), np.random.default_rng(6)
    free = mechanics.free[0]
    with mpmath.workdps(40):
        for _ in range(5):
            point = oracle.point(generator)
            values = symbols(point)
            inertia, *numbers = evaluate([form.inertia, *form.expressions.values()], values, mpmath)
            names = dict(zip(form.expressions, (x / inertia for x in numbers), strict=True))
            k = type("Constants", (), names)
            rates = {p.name: point.u[p.control] for p in form.layout.at("rate")}
            y = []
            for entry in form.layout.state:
                if entry.kind == "momentum":
                    y.append(point.v[free] + k.shift * next(iter(rates.values())))
                else:
                    y.append((point.q if entry.kind == "place" else point.v)[entry.coordinate])
            if form.angle is not None:
                y += [mpmath.cos(y[form.angle]), mpmath.sin(y[form.angle])]
            u = [point.u[name] for name in form.layout.controls]
            c = form.coefficients_at(y, u, k, mpmath)
            q, v, *pair = form.unpack(y, u, k)
            assert abs(v - point.v[free]) < 1e-30 and q == point.q[free]
            if form.kind.__name__ == "Coefficients":
                found = c.delta - c.alpha * pair[1] - c.beta * pair[0] - c.gamma * v
            elif form.kind.__name__ == "TurningSlope":
                found = c.gravity * pair[1] + c.centrifugal * c.rate**2 * q - c.damping_rate * v
            else:
                found = c.acceleration - c.damping_rate * v
            point.a |= {free: found}
            residual, size = oracle.residual(free, point)
            assert abs(residual) < 1e-25 * size


@pytest.mark.parametrize("case", every(2, [(case,) for case in PACKAGE]), ids=IDS[: len(PACKAGE)])
def test_exact_flow_and_general_series_agree(case):
    """Each is the other's oracle, over steps in which the controls change."""
    scene = complete(case)
    if form_of(scene) is None:
        return
    generator = np.random.default_rng(7)
    code, numbers = series_code_of(scene)
    for dt in (0.005, 0.02, 0.05):
        state = generator.uniform(-2.0, 2.0, len(scene.state_names))
        given = generator.uniform(0.0, 2.0, (40, len(scene.control_names)))
        by_flow = scene.simulate(state, given, dt)
        by_series = by_flow.copy()
        assert code.simulation(by_series, given, dt, 20.0, *numbers) == 0
        np.testing.assert_allclose(by_flow, by_series, rtol=0.0, atol=1e-11 * np.abs(by_flow).max())
