"""Random problems on the three scenes with dedicated flows, and the accuracy required of a step there.

The exact ends are those of the report, from the oracle; ``test_oracle.py`` shows why they are right.
"""

from collections.abc import Callable
from fractions import Fraction
from math import hypot, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
import sympy
from mpmath import matrix, mp, mpf
from mpmath.libmp import to_rational

from lag_envs import scenes
from lag_envs.mechanics.recording import parameter_names
from lag_envs.report import reference
from lag_envs.report.cases import Case
from lag_envs.report.extremes import amplification
from lag_envs.report.oracle import Oracle, agreed
from lag_envs.report.stepped import Stepped

EPS = 2.0**-53


def scene_of(name, params):
    """Return the scene; `params` are the keywords of its constructor."""
    return getattr(scenes, name)(**params)


def flow(scene_name, params, state, control, dt, dps=40):
    """Return the state after one step with the control held, with dps - 10 digits at least."""
    return reference.exact_flow(scene_of(scene_name, params), state, control, dt, max(25, dps - 10))


def agreed_end(oracle, state, controls, dt, digits=30):
    """Return the oracle's own end state, with no closed form, as two of its computations agree on it."""
    return agreed(lambda working: oracle.once(state, controls, dt, working), digits)


def linear(gamma, delta, slope, x, v, dt):
    """Return (x, v) after dt under x'' = -gamma x' + delta + slope t.

    Written with phi_k(-z) = sum_j (-z)^j / (j + k)! = 1F1(1; k + 1; -z) / k!, which has no singular case at
    z = gamma dt = 0.
    """

    def phi(k):
        return mp.hyp1f1(1, k + 1, -gamma * dt) / mp.factorial(k)

    lag = delta - gamma * v
    return (
        x + v * dt + lag * dt**2 * phi(2) + slope * dt**3 * phi(3),
        v + lag * dt * phi(1) + slope * dt**2 * phi(2),
    )


def moving_plane(k, beta, gravity, radius, tilt_rate, state, dt):
    """Return (x, w, phi) after dt on a plane that turns at constant tilt_rate.

    x' = w - R phi', w' = k (g sin(phi) + x phi'^2) - beta x' is linear in (x, w, sin, cos, 1).
    """
    x, w, phi = state
    cos, sin = mp.cos_sin(phi)
    turn = tilt_rate
    rows = [
        [0, 1, 0, 0, -radius * turn],
        [k * turn**2, -beta, k * gravity, 0, beta * radius * turn],
        [0, 0, 0, turn, 0],
        [0, 0, -turn, 0, 0],
        [0, 0, 0, 0, 0],
    ]
    end = mp.expm(mp.matrix(rows) * dt) * mp.matrix([x, w, sin, cos, 1])
    return end[0], end[1], phi + turn * dt


def _moving(scene, state, control):
    """Return place and velocity of the free coordinate, and the coefficients of its flow."""
    (q, v, *_), coefficients = Stepped(scene).at([float(x) for x in state], float(control))
    return float(q), float(v), coefficients


def scales(scene_name, params, state, control, dt):
    """Return the size to which "accurate to 1e-12" is relative, for each state entry.

    Angles max(1, abs(theta), abs(theta') dt), their rates max(1, abs(theta'), sqrt(alpha^2 + beta^2)^(1/2)),
    lengths and all others likewise with the step's own displacement.

    Returns
    -------
    list of float
    """
    return [max(1.0, x) for x in _sizes(scene_name, params, state, control, dt)]


def _sizes(scene_name, params, state, control, dt):
    scene, state, push = scene_of(scene_name, params), [abs(float(x)) for x in state], abs(float(control))
    if scene_name == "Incline":
        x, v, *tilt = state
        gain = scene.gravity * dt
        return [max(x, v * dt, gain * dt), max(v, gain), *(max(phi, push * dt) for phi in tilt)]
    c = _moving(scene, state, control)[2]
    place = 2 if len(state) == 4 else 0
    theta, rate = state[place : place + 2]
    out = [max(theta, rate * dt), max(rate, sqrt(hypot(c.alpha, c.beta)))]
    if place:
        s, v = state[:2]
        return [max(s, v * dt, push * dt**2), max(v, push * dt), *out]
    return out + [max(w, push * dt) for w in state[2:]]


def conditioning(scene_name, params, state, control, dt, include_params=False):
    """Return by how much one rounding of the initial state is amplified in the final state.

    Parameters
    ----------
    scene_name, params, state, control, dt
        As for `flow`.
    include_params : bool
        Also count one rounding of every parameter and of the control.

    Returns
    -------
    list of float
        As `extremes.amplification`: a stable computation is off by a small multiple of 2**-53 times that.
    """
    digits, scene = 45, scene_of(scene_name, params)
    total = amplification(Case(scene, tuple(state), control), dt)
    if not include_params:
        return total
    base = reference.once(Oracle(scene), state, control, dt, digits)

    def count(*moved):
        ends = [reference.once(oracle, state, push, dt, digits) for oracle, push in moved]
        for i, centre in enumerate(base):
            total[i] += float(max(abs(end[i] - centre) for end in ends) / EPS)

    with mp.workdps(digits + 30):
        for name in parameter_names(scene):
            value = getattr(scene, name)
            if value and value != inf:
                factors = (1 + Fraction(EPS), 1 - Fraction(EPS))
                count(*((Oracle(scene, {name: Fraction(value) * f}), control) for f in factors))
        if control:
            count(*((Oracle(scene), control * (1 + sign * mpf(EPS))) for sign in (1, -1)))
    return total


# --- random cases ------------------------------------------------------------------------------

VARIANTS = (
    ("PivotedBar", None),
    ("Incline", "damping"),
    ("Incline", "tilt"),
    ("Incline", "tilt_rate"),
    ("CylinderInCylinder", "damping"),
    ("CylinderInCylinder", "tilt"),
)
GRAVITY = 9.81


class _Draw:
    """Uniform and log-uniform Python floats from a Generator."""

    def __init__(self, rng):
        self.rng = rng

    def within(self, *size):
        """Return one uniform float in [-x, x] for every x."""
        values = [float(self.rng.uniform(-x, x)) for x in size]
        return values if len(values) > 1 else values[0]

    def between(self, low, high):
        return float(self.rng.uniform(low, high))

    def log(self, low, high):
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def choice(self, *options):
        return options[self.rng.integers(len(options))]


def random_cases(kind, n, seed):
    """Return random one-step problems for every scene and kind of control in turn.

    Parameters
    ----------
    kind : {'task', 'damped', 'stiff', 'extreme'}
        'task': parameters, ranges and control intervals of the eight environments;
        'damped': any body, gamma dt log-uniform in [1e-3, 30], strong drive;
        'stiff': gamma dt log-uniform in [1e-2, 1e6], with drive;
        'extreme': dt log-uniform in [1e-6, 1], half the cases undamped, one thing extreme: no or
        100-fold gravity, point mass, hoop, r near 0 or R, L = 1e-8, drive 1e6, theta' = 1e4,
        theta = pi, energy of the separatrix times 1 +- 1e-15, and similar ones for the incline.
        There dt is halved until the body turns, in theta and in phase, by less than 200 rad, or
        1e5 rad if the solution is an elliptic function.
    n : int
    seed : int

    Returns
    -------
    list of dict
        Keys scene, params (the constructor's keywords, including ``'control'`` if the scene
        has a choice, and ``'track': inf`` for the bar), control_kind, state, control, dt, label.
    """
    draw = _Draw(np.random.default_rng(seed))
    make = {"task": _task_case, "damped": _body_case, "stiff": _body_case, "extreme": _extreme_case}
    return [make[kind](kind, *VARIANTS[i % len(VARIANTS)], draw) for i in range(n)]


def _case(scene, kind, params, state, control, dt, label):
    if kind:
        params = {**params, "control": kind}
    else:
        params = {**params, "track": inf}
    return {
        "scene": scene,
        "params": params,
        "control_kind": kind,
        "state": [float(x) for x in state],
        "control": float(control),
        "dt": dt,
        "label": label,
    }


def _task_case(label, scene, kind, draw):
    if scene == "PivotedBar":
        params = {"mass": 0.2, "com_distance": 0.3, "inertia": 0.006, "damping": 0.001}
        state, control, dt = draw.within(0.5, 2, 4, 15), draw.within(5), 0.02
    elif scene == "Incline":
        params = {"mass": 1.0, "radius": 0.05, "inertia": 0.00125, "damping": 0.03}
        if kind == "damping":
            params |= {"damping": 0.0, "tilt": pi / 12}
            state, control, dt = draw.within(3, 3), draw.between(0, 6), 0.02
        elif kind == "tilt":
            state, control, dt = draw.within(0.5, 1), draw.within(0.1), 0.05
        else:
            state, control, dt = draw.within(0.5, 1, 0.1), draw.within(0.3), 0.05
    else:
        params = {"mass": 1.0, "shell_radius": 0.5, "radius": 0.1, "inertia": 0.005}
        if kind == "damping":
            params["damping"] = 0.0
            state, control, dt = draw.within(1.3, 5), draw.between(0, 2.4), 0.02
        else:
            params["damping"] = draw.choice(0.24, 0.024)
            state, control, dt = draw.within(1.3, 5, 6), draw.within(15), 0.05
    return _case(scene, kind, {**params, "gravity": GRAVITY}, state, control, dt, label)


def _inertia_of_drag(scene, params):
    """Return the generalised inertia that turns a drag coefficient into a rate [1/s]."""
    mass, inertia = params["mass"], params["inertia"]
    if scene == "PivotedBar":
        return mass * params["com_distance"] ** 2 + inertia
    rolling = mass + inertia / params["radius"] ** 2
    if scene == "Incline":
        return rolling
    return rolling * (params["shell_radius"] - params["radius"]) ** 2


def _body_case(label, scene, kind, draw, edit=None):
    """Return a case with a random body, changed as `edit` says."""
    dt = draw.log(1e-6, 1) if edit else draw.log(1e-3, 0.1)
    if label == "extreme":
        damping_dt = draw.choice(0.0, draw.log(1e-3, 100))
    else:
        damping_dt = draw.log(1e-2, 1e6) if label == "stiff" else draw.log(1e-3, 30)
    mass = draw.log(0.05, 5)
    if scene == "PivotedBar":
        length = draw.log(0.05, 1)
        params = {"mass": mass, "com_distance": length, "inertia": mass * length**2 / 3}
        state, drive = draw.within(0.5, 2, 4, 20), draw.within(50)
    else:
        radius = draw.log(0.02, 0.3)
        params = {
            "mass": mass,
            "radius": radius,
            "inertia": mass * radius**2 * draw.between(0.3, 1),
        }
        if scene == "Incline":
            state = draw.within(1, 3)
            drive = draw.within(1.5)
            if kind == "tilt_rate":
                state, drive = draw.within(1, 3, 1.5), draw.within(5)
            elif kind == "damping":
                params["tilt"] = drive
        else:
            params["shell_radius"] = radius * draw.between(1.5, 6)
            state, drive = draw.within(4, 10), draw.within(50)
            if kind == "tilt":
                state += [draw.within(6)]
    params["gravity"] = GRAVITY
    if edit:
        params |= edit.params(params)
        for place, value in edit.state(params).items():
            state[place] = value
        drive = drive if edit.drive is None else edit.drive
    drag = damping_dt / dt * _inertia_of_drag(scene, params)
    control = drive
    params["damping"] = drag
    if kind == "damping":
        share = draw.choice(0.0, 0.5, 1.0)
        params["damping"], control = share * drag, (1 - share) * drag
    return _case(scene, kind, params, state, control, dt, label)


class _Edit(NamedTuple):
    """What is extreme in a case: parameters and entries of the state, from the parameters, and the drive."""

    params: Callable = lambda p: {}
    state: Callable = lambda p: {}
    drive: float | None = None


def _extreme_case(label, scene, kind, draw):
    def with_radius(p, radius):
        return {"radius": radius, "inertia": p["mass"] * radius**2 / 2}

    def upright(p):
        return {angle: sign * pi}

    def separatrix(p):
        if scene == "PivotedBar":
            alpha = p["mass"] * p["com_distance"] * GRAVITY / _inertia_of_drag(scene, p)
        else:
            kappa = p["inertia"] / (p["mass"] * p["radius"] ** 2)
            alpha = GRAVITY / (p["shell_radius"] - p["radius"]) / (1 + kappa)
        return {angle: 0.0, angle + 1: sign * 2 * sqrt(alpha) * (1 + draw.choice(-1, 1) * 1e-15)}

    sign = draw.choice(-1.0, 1.0)
    angle = 2 if scene == "PivotedBar" else 0
    edits = {
        "no gravity": _Edit(lambda p: {"gravity": 0.0}),
        "strong gravity": _Edit(lambda p: {"gravity": 1e3}),
    }
    if scene == "Incline":
        edits |= {
            "fast": _Edit(state=lambda p: {1: sign * 1e4}),
            "tiny radius": _Edit(lambda p: with_radius(p, 1e-8)),
        }
        if kind == "tilt_rate":
            tilt_rates = 0.0, 1e-300, 1e-12, 1e-6, 100.0
            edits["tilt rate"] = _Edit(drive=sign * draw.choice(*tilt_rates))
    else:
        edits |= {
            "fast": _Edit(state=lambda p: {angle + 1: sign * 1e4}),
            "upright": _Edit(state=upright),
            "separatrix": _Edit(state=separatrix, drive=0.0),
        }
        if kind != "damping":
            edits["strong drive"] = _Edit(drive=sign * 1e6)
    edits["point mass"] = _Edit(lambda p: {"inertia": 0.0})
    if scene == "PivotedBar":
        edits["short bar"] = _Edit(lambda p: {"com_distance": 1e-8, "inertia": p["mass"] * 1e-16 / 3})
        edits["upright, no drive"] = _Edit(state=upright, drive=0.0)
    else:
        edits["hoop"] = _Edit(lambda p: {"inertia": p["mass"] * p["radius"] ** 2})
    if scene == "CylinderInCylinder":
        edits["r near 0"] = _Edit(lambda p: with_radius(p, 1e-6 * p["shell_radius"]))
        edits["r near R"] = _Edit(lambda p: with_radius(p, (1 - 1e-6) * p["shell_radius"]))
    name = draw.choice(*edits)
    case = _body_case(label, scene, kind, draw, edits[name])
    case["label"] = name
    while scene != "Incline" and _turning(case) > 1:
        case["dt"] /= 2
    return case


def _turning(case):
    """Return roughly how far the case turns, in units of the largest turn worth computing."""
    scene, state, dt = scene_of(case["scene"], case["params"]), case["state"], case["dt"]
    _, v, c = _moving(scene, state, case["control"])
    push = abs(c.delta) + abs(c.ramp) * dt
    limit = 200 if c.gamma or push else 1e5
    return dt * (abs(v) + sqrt(hypot(c.alpha, c.beta)) + push * dt / 2) / limit


def exact_step(scene, state, control, dt, moved=None):
    """Return the state after a step in 36 digits, by the report's oracle, which shares no code with the step.

    Parameters in `moved` have other values than the scene's, as numbers of mpmath.
    """
    exact = {name: sympy.Rational(*to_rational(value._mpf_)) for name, value in (moved or {}).items()}
    return matrix(Oracle(scene, exact).once(state, control, dt, 36))
