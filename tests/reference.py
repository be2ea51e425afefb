"""The three scenes in high precision, as an oracle that shares no formula of theirs with the package.

The equations are those of the lecture, typed in again, from the exact values of the float64 inputs; they
are solved by `lag_envs.report.reference`, whose methods stepping does not use, twice with different digits,
orders and step sizes. ``test_reference.py`` holds those methods against each other and closed forms.
"""

from math import inf, pi, sqrt

import numpy as np
from mpmath import mp, mpf

from lag_envs.report.reference import Pendulum, Unresolved, linear, pendulum

EPS = 2.0**-53


# --- scenes ------------------------------------------------------------------------------------


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


def _bar_field(q, u):
    moment = q["mass"] * q["com_distance"]
    inertia = moment * q["com_distance"] + q["inertia"]
    return Pendulum(
        moment * q["gravity"] / inertia,
        moment * u / inertia,
        q["damping"] / inertia,
        mpf(0),
        mpf(0),
    )


def _shell_field(q, control, state):
    arm = q["shell_radius"] - q["radius"]
    kappa = q["inertia"] / (q["mass"] * q["radius"] ** 2)
    k = 1 / (1 + kappa)
    per_drag = k / (q["mass"] * arm**2)
    alpha = k * q["gravity"] / arm
    if q["control"] == "damping":
        return Pendulum(alpha, mpf(0), (q["damping"] + control) * per_drag, mpf(0), mpf(0))
    beta = q["damping"] * per_drag
    drive = k * kappa * q["shell_radius"] / arm * control + beta * state[2]
    return Pendulum(alpha, mpf(0), beta, drive, beta * control)


def _bar(q, state, u, dt, digits):
    *track, theta, rate = state
    if track:
        s, v = track
        track = [s + v * dt + u * dt**2 / 2, v + u * dt]
    return [*track, *pendulum(_bar_field(q, u), theta, rate, dt, digits)]


def _incline(q, state, control, dt, digits):
    k = 1 / (1 + q["inertia"] / (q["mass"] * q["radius"] ** 2))
    drag, tilt = q["damping"], q.get("tilt")
    if q["control"] == "damping":
        drag = drag + control
    elif q["control"] == "tilt":
        tilt = control
    beta = drag * k / q["mass"]
    if q["control"] == "tilt_rate":
        return list(moving_plane(k, beta, q["gravity"], q["radius"], control, state, dt))
    return list(linear(beta, k * q["gravity"] * mp.sin(tilt), mpf(0), *state, dt))


def _shell(q, state, control, dt, digits):
    theta, rate, *spin = state
    end = pendulum(_shell_field(q, control, state), theta, rate, dt, digits)
    return [*end, *(value + control * dt for value in spin)]


_SCENES = {"PivotedBar": _bar, "Incline": _incline, "CylinderInCylinder": _shell}
_CONTROL = {"Incline": "damping", "CylinderInCylinder": "tilt"}


def _exact(scene_name, params, state, control, dt):
    """Return the inputs as exact mpf, inertia and control kind filled in."""
    control_kind = params.get("control") or _CONTROL.get(scene_name)
    skip = ("control", "track")
    q = {k: _number(v) for k, v in params.items() if k not in skip and v is not None}
    if "inertia" not in q:
        bar = scene_name == "PivotedBar"
        q["inertia"] = q["mass"] * (q["com_distance"] ** 2 / 3 if bar else q["radius"] ** 2 / 2)
    q.setdefault("damping", mpf(0))
    q.setdefault("gravity", mpf(9.81))
    if scene_name == "Incline" and control_kind == "damping":
        q.setdefault("tilt", mpf(0.26))
    q["control"] = control_kind
    return q, [_number(x) for x in state], _number(control), _number(dt)


def _number(x):
    return x if isinstance(x, mpf) else mpf(float(x))


def _once(scene_name, params, state, control, dt, digits):
    with mp.workdps(digits + 30):
        q, state, control, dt = _exact(scene_name, params, state, control, dt)
        return _SCENES[scene_name](q, state, control, dt, digits)


def flow(scene_name, params, state, control, dt, dps=40):
    """Return the state after one step with the control held, in high precision.

    Parameters
    ----------
    scene_name : {'PivotedBar', 'Incline', 'CylinderInCylinder'}
    params : dict
        The keywords of the scene's constructor in SI units, the control kind under ``'control'``
        ('damping', 'tilt', 'tilt_rate'; 'damping', 'tilt'); ``'track'`` is ignored, missing
        inertia is that of the uniform body. Floats are taken as the exact numbers they are.
    state : sequence of float
        (s, s', theta, theta') or (theta, theta'); (x, x') or (x, w, phi); (theta, theta') or
        (theta, theta', psi').
    control : float
        s'' [m/s^2]; c [N s/m], phi [rad] or phi' [rad/s]; c [N m s] or psi'' [rad/s^2].
    dt : float [s]
    dps : int
        Decimal digits aimed at.

    Returns
    -------
    list of mpf
        The state in the same order. Two computations with different digits, orders and steps
        agree to 10**-max(25, dps - 10) times max(1, abs(entry)).

    Raises
    ------
    Unresolved
        If they do not, even with four times the digits, or if the case needs too many steps.

    Examples
    --------
    >>> bar = {"mass": 1.0, "com_distance": 1.0, "inertia": 0.0, "damping": 0.0, "gravity": 0.0}
    >>> [float(x) for x in flow("PivotedBar", bar, (0, 1, 2, 3), 0.0, 0.5)]
    [0.5, 1.0, 3.5, 3.0]
    """
    target = mpf(10) ** -max(25, dps - 10)
    digits = dps + 12
    while digits <= 4 * dps + 12:
        coarse = _once(scene_name, params, state, control, dt, digits)
        fine = _once(scene_name, params, state, control, dt, digits + 9)
        error = max(abs(a - b) / max(1, abs(b)) for a, b in zip(coarse, fine, strict=True))
        if error <= target:
            return fine
        digits = 2 * digits
    raise Unresolved(f"two precisions differ by {mp.nstr(error, 3)}")


def scales(scene_name, params, state, control, dt):
    """Return the size of each state entry that "accurate to 1e-12" is relative to.

    Angles max(1, abs(theta), abs(theta') dt), their rates max(1, abs(theta'), sqrt(alpha^2 +
    beta^2)^(1/2)), lengths and all else alike with the step's own displacement.

    Returns
    -------
    list of float
    """
    rough = _sizes(scene_name, params, state, control, dt)
    return [max(1.0, float(x)) for x in rough]


def _sizes(scene_name, params, state, control, dt):
    q, state, control, dt = _exact(scene_name, params, state, control, dt)
    if scene_name == "Incline":
        x, v, *tilt = state
        gain = q["gravity"] * dt
        out = [max(abs(x), abs(v) * dt, gain * dt), max(abs(v), gain)]
        return out + [max(abs(phi), abs(control) * dt) for phi in tilt]
    if scene_name == "PivotedBar":
        *track, theta, rate = state
        p = _bar_field(q, control)
        spin = []
    else:
        theta, rate, *spin = state
        p = _shell_field(q, control, state)
        track = []
    out = [abs(theta), abs(rate)]
    out = [max(out[0], out[1] * dt), max(out[1], mp.sqrt(mp.hypot(p.alpha, p.beta)))]
    if track:
        s, v = map(abs, track)
        u = abs(control)
        out = [max(s, v * dt, u * dt**2), max(v, u * dt), *out]
    return out + [max(abs(w), abs(control) * dt) for w in spin]


def conditioning(scene_name, params, state, control, dt, include_params=False):
    """Return how strongly one rounding of the initial state shows in the final state.

    Entry j of the state is moved up and down by 2**-53 times max(abs(entry), floor), where the
    floor is 1 rad for angles (cos and sin are stored to absolute precision),
    sqrt(hypot(alpha, beta)) for their rates, and 0 for the rest. The moves are of finite size: next
    to the unstable equilibrium they count whole turns, where a derivative would say too much or too
    little.

    Parameters
    ----------
    scene_name, params, state, control, dt
        As for `flow`.
    include_params : bool
        Count also one rounding of every parameter and of the control.

    Returns
    -------
    list of float
        For each entry i of the final state, the sum over j of max abs(change of i) / 2**-53; a
        stable computation is off by a small multiple of 2**-53 times that.
    """
    digits = 45
    params = dict(params)
    state = [_number(x) for x in state]
    floors = {
        "PivotedBar": (0, 0, 1, 1)[-len(state) :],
        "Incline": (0, 0, 1),
        "CylinderInCylinder": (1, 1, 0),
    }[scene_name]
    sizes = _sizes(scene_name, params, state, control, dt)
    rate_floor = {"PivotedBar": len(state) - 1, "CylinderInCylinder": 1}.get(scene_name)
    base = _once(scene_name, params, state, control, dt, digits)
    total = [mpf(0)] * len(state)

    def count(*moved):
        ends = [_once(scene_name, *move, dt, digits) for move in moved]
        for i, centre in enumerate(base):
            total[i] += max(abs(end[i] - centre) for end in ends) / EPS

    with mp.workdps(digits + 30):
        for j, value in enumerate(state):
            size = abs(value)
            if floors[j]:
                size = max(size, sizes[j] if j == rate_floor else 1)
            if size:
                moved = [[*state[:j], value + sign * EPS * size, *state[j + 1 :]] for sign in (1, -1)]
                count(*((params, y, control) for y in moved))
        if include_params:
            for name, value in params.items():
                if isinstance(value, float) and value and value != inf:
                    factors = (1 + mpf(EPS), 1 - mpf(EPS))
                    count(*(({**params, name: value * f}, state, control) for f in factors))
            if control:
                count(*((params, state, control * (1 + sign * mpf(EPS))) for sign in (1, -1)))
    return [float(x) for x in total]


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


def random_cases(kind, n, seed, variants=VARIANTS):
    """Return random one-step problems for every scene and kind of control in turn.

    Parameters
    ----------
    kind : {'task', 'damped', 'stiff', 'extreme'}
        'task': parameters, ranges and control intervals of the eight environments;
        'damped': any body, gamma dt log-uniform in [1e-3, 30], strong drive;
        'stiff': gamma dt log-uniform in [1e-2, 1e6], with drive;
        'extreme': dt log-uniform in [1e-6, 1], half the cases undamped, one thing extreme: no or
        100-fold gravity, point mass, hoop, r near 0 or R, L = 1e-8, drive 1e6, theta' = 1e4,
        theta = pi, energy of the separatrix times 1 +- 1e-15, and their like for the incline.
        There dt is halved until the body turns, in theta and in phase, by less than 200 rad, or
        1e5 rad where the solution is an elliptic function.
    n : int
    seed : int
    variants : sequence of (scene name, control kind)

    Returns
    -------
    list of dict
        Keys scene, params (the constructor's keywords, ``'control'`` among them where the scene
        has a choice, ``'track': inf`` for the bar), control_kind, state, control, dt, label.
    """
    draw = _Draw(np.random.default_rng(seed))
    make = {"task": _task_case, "damped": _body_case, "stiff": _body_case, "extreme": _extreme_case}
    return [make[kind](kind, *variants[i % len(variants)], draw) for i in range(n)]


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
    """Return a case with a random body; edit may change params, state and drive beforehand."""
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
        state, drive = edit(params, state, drive)
    drag = damping_dt / dt * _inertia_of_drag(scene, params)
    control = drive
    params["damping"] = drag
    if kind == "damping":
        share = draw.choice(0.0, 0.5, 1.0)
        params["damping"], control = share * drag, (1 - share) * drag
    return _case(scene, kind, params, state, control, dt, label)


def _extreme_case(label, scene, kind, draw):
    def set_params(**changes):
        return lambda params, state, drive: params.update(changes) or (state, drive)

    def set_inertia(kappa):
        def edit(params, state, drive):
            params["inertia"] = kappa * params["mass"] * params["radius"] ** 2
            return state, drive

        return edit

    def set_radius(of):
        def edit(params, state, drive):
            params["radius"] = of(params)
            params["inertia"] = params["mass"] * params["radius"] ** 2 / 2
            return state, drive

        return edit

    def set_state(place, value):
        def edit(params, state, drive):
            state[place] = value
            return state, drive

        return edit

    def set_drive(value):
        return lambda params, state, drive: (state, value)

    def short_bar(params, state, drive):
        params |= {"com_distance": 1e-8, "inertia": params["mass"] * 1e-16 / 3}
        return state, drive

    def separatrix(params, state, drive):
        if scene == "PivotedBar":
            arm = params["com_distance"]
            alpha = params["mass"] * arm * GRAVITY / _inertia_of_drag(scene, params)
        else:
            arm = params["shell_radius"] - params["radius"]
            kappa = params["inertia"] / (params["mass"] * params["radius"] ** 2)
            alpha = GRAVITY / arm / (1 + kappa)
        state[angle : angle + 2] = 0.0, sign * 2 * sqrt(alpha) * (1 + draw.choice(-1, 1) * 1e-15)
        return state, 0.0

    sign = draw.choice(-1.0, 1.0)
    angle = 2 if scene == "PivotedBar" else 0
    edits = {"no gravity": set_params(gravity=0.0), "strong gravity": set_params(gravity=1e3)}
    if scene == "Incline":
        edits |= {"fast": set_state(1, sign * 1e4), "tiny radius": set_radius(lambda p: 1e-8)}
        if kind == "tilt_rate":
            tilt_rates = 0.0, 1e-300, 1e-12, 1e-6, 100.0
            edits["tilt rate"] = set_drive(sign * draw.choice(*tilt_rates))
    else:
        edits |= {
            "fast": set_state(angle + 1, sign * 1e4),
            "upright": set_state(angle, sign * pi),
            "separatrix": separatrix,
        }
        if kind != "damping":
            edits["strong drive"] = set_drive(sign * 1e6)
    if scene == "PivotedBar":
        edits |= {"point mass": set_params(inertia=0.0), "short bar": short_bar}
        edits["upright, no drive"] = lambda p, state, drive: set_state(2, sign * pi)(p, state, 0.0)
    else:
        edits |= {"point mass": set_inertia(0.0), "hoop": set_inertia(1.0)}
    if scene == "CylinderInCylinder":
        edits["r near 0"] = set_radius(lambda p: 1e-6 * p["shell_radius"])
        edits["r near R"] = set_radius(lambda p: (1 - 1e-6) * p["shell_radius"])
    name = draw.choice(*edits)
    case = _body_case(label, scene, kind, draw, edits[name])
    case["label"] = name
    while scene != "Incline" and _turning(case) > 1:
        case["dt"] /= 2
    return case


def _turning(case):
    """Return about how far the case turns, in units of what is worth computing."""
    q, state, control, dt = _exact(*(case[k] for k in ("scene", "params", "state", "control", "dt")))
    bar = case["scene"] == "PivotedBar"
    p = _bar_field(q, control) if bar else _shell_field(q, control, state)
    rate = state[3 if bar else 1]
    push = abs(p.delta) + abs(p.slope) * dt
    limit = 200 if p.gamma or push else 1e5
    return dt * (abs(rate) + mp.sqrt(mp.hypot(p.alpha, p.beta)) + push * dt / 2) / limit
