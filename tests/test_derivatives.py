"""Derivatives with respect to parameters, and backwards, against differences in 40-digit arithmetic."""

import math
import zlib
from types import SimpleNamespace

import mpmath
import numpy as np
import own_tasks
import pytest
from contract_scenes import Crane, Functions, RotatingFrame, Top
from covering import covering, slow, way
from reference import exact_step

from lag_envs.envs.model import Model
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.mechanics import recording
from lag_envs.mechanics.algebra import evaluate
from lag_envs.mechanics.evaluation import RATES, Numeric
from lag_envs.mechanics.recording import parameter_names, parameter_values
from lag_envs.scenes import Acrobot, CartPole, Incline, Pendulum, PivotedBar, Scene, parameter
from lag_envs.scenes.checks import StepRefused
from lag_envs.scenes.declaring import ORDER
from lag_envs.scenes.derivation import form_of
from lag_envs.stepping import driver
from lag_envs.stepping.normal_forms import lifted
from lag_envs.stepping.tangent import SeriesTangent
from lag_envs.tasks import TASKS, cylinder_in_cylinder


def seeded(name):
    return np.random.default_rng(zlib.crc32(name.encode()))


def finite(scene):
    """Return the names of the parameters that are not infinite."""
    return [name for name in parameter_names(scene) if math.isfinite(getattr(scene, name))]


def directional(scene, state, control, dt, names, direction):
    """Return the derivative of a step along a direction of state, controls and parameters, exactly."""
    n, m, h = len(state), len(control), mpmath.mpf(10) ** -12
    ends = []
    for side in (h, -h):
        values = [mpmath.mpf(x) for x in (*state, *control, *(getattr(scene, p) for p in names))]
        y = [x + side * d for x, d in zip(values, map(mpmath.mpf, direction), strict=True)]
        ends.append(exact_step(scene, y[:n], y[n : n + m], dt, dict(zip(names, y[n + m :], strict=True))))
    return np.array([float(x) for x in (ends[0] - ends[1]) / (2 * h)])


def check_directions(scene, state, control, dt, directions):
    """Compare the Jacobian along directions, which broadcast to rows of all entries."""
    names = finite(scene)
    found = np.concatenate(scene.jacobian(state, control, dt, parameters=names), axis=-1)
    with mpmath.workdps(40):
        for direction in np.broadcast_to(directions, (len(directions), found.shape[-1])):
            expected = directional(scene, state, control, dt, names, direction)
            size = np.maximum(np.abs(found) @ np.abs(direction), 1e-300)
            assert (np.abs(found @ direction - expected) <= 1e-10 * size).all(), direction


@pytest.mark.parametrize("env_id", covering(of=way))
def test_jacobian_by_all_parameters(env_id):
    """Along a random direction, so that two exact steps are enough; over the task's own control interval."""
    task, rng = TASKS[env_id](), seeded(env_id)
    scene = task.scene
    state = rng.uniform(-2.0, 2.0, len(scene.state_names))
    control = rng.uniform(0.0, 2.0, len(scene.control_names))
    width = len(state) + len(control) + len(finite(scene))
    check_directions(scene, state, control, task.dt, rng.uniform(-1.0, 1.0, (1, width)))


#: Parameters that are 0: their terms leave no code in the step, or they are arguments of a function.
ZERO = {
    "damping": (PivotedBar(damping=0.0), [0.1, 0.2, 2.0, -3.0], [1.0], "damping"),
    "friction": (CartPole(friction=0.0), [0.1, 0.2, 2.0, -3.0], [1.0], "friction"),
    "tilt": (Incline(control="damping", tilt=0.0), [0.1, 0.2], [0.1], "tilt"),
    "a series that the step lacks": (Acrobot(), [0.5, 1.0, -1.0, 2.0], [0.3], "dry_friction"),
}


@pytest.mark.parametrize("case", [name if name == "tilt" else slow(name) for name in ZERO])
def test_parameters_that_are_zero(case):
    scene, state, control, name = ZERO[case]
    assert getattr(scene, name) == 0.0
    ahead = len(state) + len(control) + finite(scene).index(name)
    direction = np.zeros((1, len(state) + len(control) + len(finite(scene))))
    direction[0, ahead] = 1.0
    check_directions(scene, state, control, 0.02, direction)
    alone = scene.jacobian(state, control, 0.02, parameters=[name])[2]
    assert np.abs(alone).max() > 1e-4


@pytest.mark.slow
def test_rows_and_columns_by_parameters():
    bar = PivotedBar()
    states = np.array([[0.1, 0.2, 2.0, -3.0], [0.0, 0.0, 1.0, 9.0]])
    a, b, p = bar.jacobian(states, [1.0, -2.0], parameters=["track", "mass", "damping"])
    assert p.shape == (2, 4, 3)
    np.testing.assert_array_equal(p[..., 0], 0.0)  # the track's length does not move the bar
    for x, y in zip((a, b), bar.jacobian(states, [1.0, -2.0]), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(bar.jacobian(states[1], -2.0, parameters=("damping",))[2], p[1, :, 2:])
    assert bar.jacobian(states, 0.0, parameters=())[2].shape == (2, 4, 0)


class Spring(Scene):
    """A spring whose softness is in a denominator."""

    softness: float = parameter(0.5, "m/N", least=0.0)
    mass: float = parameter(1.0, "kg", above=0.0)
    reach: float = parameter(math.inf, "m", above=0.0, endless=True)

    coordinates = {"x": "m"}

    def kinetic(self, q, v, xp):
        return 0.5 * self.mass * v.x**2

    def potential(self, q, xp):
        return 0.5 * q.x**2 / self.softness


def test_what_has_no_derivative():
    with pytest.raises(ValueError, match="PivotedBar has no parameter 'lenght', only mass, com_distance"):
        PivotedBar().jacobian([0.0] * 4, parameters=["lenght"])
    with pytest.raises(ValueError, match=r"sequence of names, such as \['mass'\]"):
        PivotedBar().jacobian([0.0] * 4, parameters="mass")
    with pytest.raises(ValueError, match="'mass' is named twice"):
        PivotedBar().jacobian([0.0] * 4, parameters=["mass", "mass"])
    with pytest.raises(ValueError, match="reach=inf is infinite, and has no derivatives"):
        Spring().jacobian([1.0, 0.0], parameters=["reach"])
    a, _, p = Spring().jacobian([1.0, 0.0], parameters=["mass", "softness"])
    assert a.shape == (2, 2) and np.isfinite(p).all()


SCENES = {env_id: kind().scene for env_id, kind in TASKS.items()}
SCENES |= {type(scene).__name__: scene for scene in (Functions(), Top(), Crane(), RotatingFrame())}


@pytest.mark.parametrize("name", [name if name == "Functions" else slow(name) for name in SCENES])
def test_vjp_is_the_jacobian_transposed(name):
    """At rest, at moderate and at high speeds, where the step is divided."""
    scene, rng = SCENES[name], seeded(name)
    n, names = len(scene.state_names), finite(scene)
    states = rng.uniform(-1.0, 1.0, (3, 4, n)) * np.array([0.0, 2.0, 20.0])[:, None, None]
    if name not in TASKS:
        states = 1.0 + 0.03 * states  # the ropes and angles of some are singular at 0
    controls = rng.uniform(0.0, 2.0, (3, 4, len(scene.control_names)))
    seeds = rng.uniform(-1.0, 1.0, states.shape)
    jacobian = scene.jacobian(states, controls, 0.02, parameters=names)
    found = scene.vjp(states, controls, 0.02, seeds, parameters=names)
    for x, matrix in zip(found, jacobian, strict=True):
        expected = np.einsum("...i,...ij->...j", seeds, matrix)
        size = np.einsum("...i,...ij->...j", np.abs(seeds), np.abs(matrix))
        np.testing.assert_array_less(np.abs(x - expected), 1e-12 * size + 1e-15)


def test_vjp_with_an_odd_order():
    """The first order is computed alone; of order 7, most steps are divided."""
    scene, rng = CartPole(), np.random.default_rng(0)
    states, seeds = rng.uniform(-1.0, 1.0, (2, 9, 4))
    expected = scene.vjp(states, 1.0, 0.02, seeds)
    for order in (7, 11):
        chosen = CartPole()
        vars(chosen)[ORDER] = order
        for x, exact in zip(chosen.vjp(states, 1.0, 0.02, seeds), expected, strict=True):
            np.testing.assert_allclose(x, exact, rtol=0.0, atol=1e-12)


class Twins(Scene):
    """Two equal pendulums; a motor between them turns them against each other."""

    length: float = parameter(0.5, "m", above=0.0)
    damping: float = parameter(0.1, "N m s", least=0.0)

    coordinates = {"a": "rad", "b": "rad"}
    controls = {"motor": "N m"}

    def kinetic(self, q, v, xp):
        return 0.5 * self.length**2 * (v.a**2 + v.b**2)

    def potential(self, q, xp):
        return -9.81 * self.length * (xp.cos(q.a) + xp.cos(q.b))

    def dissipation(self, q, v, u, xp):
        return 0.5 * self.damping * (v.a**2 + v.b**2)

    def applied(self, q, v, u, xp):
        return {"a": -u.motor, "b": u.motor}


@pytest.fixture
def rounds(monkeypatch):
    """Return a list of how many rows go backwards together, round by round."""
    found, compile_vjp_all = [], driver.compile_vjp_all.__wrapped__

    def counting(*args):
        vjp = compile_vjp_all(*args)

        def vjp_all(given, *rest):
            found.append(given.shape[1])
            vjp(given, *rest)

        return vjp_all

    monkeypatch.setattr(driver, "compile_vjp_all", counting)
    return found


@pytest.mark.slow
def test_a_gradient_that_cancels_does_not_divide_the_step(rounds):
    """The motor turns both alike, so the sum does not depend on it; what is left out is small beside each."""
    states, seeds = np.tile([0.7, 1.0], (40, 2)), np.tile([1.0, 0.5], (40, 2))
    _, by_motor = Twins().vjp(states, 0.0, 0.05, seeds)
    assert rounds == [40] and np.abs(by_motor).max() < 1e-17


def test_rows_that_reverse_mode_gives_up(rounds, monkeypatch):
    """They go through forward mode, all at once."""
    scene, rng = Twins(), np.random.default_rng(0)
    states, seeds = rng.uniform(-1.0, 1.0, (2, 9, 4))
    states[2::3, 1] = 80.0  # these need many substeps
    ways = np.concatenate(scene.jacobian(states, 0.3, 0.05), axis=-1)
    forwards, jacobian = [], SeriesTangent.jacobian

    def spy(self, states, *rest):
        forwards.append(len(states))
        return jacobian(self, states, *rest)

    monkeypatch.setattr(SeriesTangent, "jacobian", spy)
    monkeypatch.setattr(driver, "LARGEST_COUNT", 1)
    found = np.concatenate(scene.vjp(states, 0.3, 0.05, seeds), axis=-1)
    assert rounds[0] == 9 and forwards == [3]
    np.testing.assert_allclose(found, np.einsum("ni,nij->nj", seeds, ways), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_an_angle_that_no_formula_needs_may_be_large():
    """That of a top about the vertical; refused is an angle of which sine and cosine are needed."""
    far, seeds = 1e9, np.array([0.0, 1.0, 0.3, -0.2, 0.1, 0.5])
    state = dict.fromkeys(Top().state_names, 0.4)
    near, away = (Top().vjp([*(state | {"phi": phi}).values()], 0.1, 0.02, seeds)[0] for phi in (0.0, far))
    np.testing.assert_array_equal(near, away)
    for scene in (Top(), PivotedBar(), CartPole()):
        state = np.where(np.array(scene.state_names) == "theta", far, 0.0)
        with pytest.raises(StepRefused, match="theta"):
            scene.vjp(state, 0.0, 0.02, np.ones(len(state)))


@pytest.mark.parametrize("name", RATES)
def test_slopes_of_functions_have_all_digits(name):
    """Also where tanh is nearly 1."""
    for x in (1e-9, 0.3, 3.0, 15.0, 25.0):
        with mpmath.workdps(40):
            exact = float(mpmath.sech(x) ** 2 if name == "tanh" else mpmath.diff(getattr(mpmath, name), x))
        value = getattr(Numeric, name)(np.float64(x))
        assert RATES[name](x, value, Numeric) == pytest.approx(exact, rel=1e-14, abs=0.0)


# --- whole steps --------------------------------------------------------------------------------------------

#: Tasks whose actions are ranges.
SMOOTH = [env_id for env_id, kind in TASKS.items() if not kind().formulas.choices]
#: The quick ones: a flow, and one whose reward uses the flow's coefficients, which depend on parameters.
QUICK = [SMOOTH[0], cylinder_in_cylinder.Pump.id]


class Exactly:
    """Functions of formulas on mpmath's numbers."""

    pi = math.pi
    where = staticmethod(lambda condition, a, b: a if condition else b)
    minimum, maximum, abs = min, max, abs

    def __getattr__(self, name):
        return getattr(mpmath, name)


def exact_results(task, state, action, target, parameters):
    """Return state, observation and reward after a step, in mpmath's arithmetic."""
    xp, f, scene, form = Exactly(), task.formulas, task.scene, form_of(task.scene)
    constants = f.constants() | {f"self_{name}": value for name, value in parameters.items()}
    if form:  # formulas may use its constants, which depend on the parameters
        values = parameter_values(scene) | parameters
        given = {recording.parameter(name): mpmath.mpf(value) for name, value in values.items()}
        inertia, *numbers = evaluate([form.inertia, *form.expressions.values()], given, xp)
        constants |= {name: x / inertia for name, x in zip(form.expressions, numbers, strict=True)}
    k = SimpleNamespace(**{name: mpmath.mpf(value) for name, value in constants.items()})
    top = f.largest
    u = f.control(xp, [min(max(a, -top), top) for a in action], lifted(form, state, mpmath), target, k)
    end = list(exact_step(scene, state, u, task.dt, parameters))
    reward, ended = f.outcome(xp, lifted(form, state, mpmath), lifted(form, end, mpmath), u, target, k)
    if ended and f.has_last:
        reward = f.last(xp, lifted(form, state, mpmath), lifted(form, end, mpmath), u, target, k)
    return [*end, *f.observe(xp, lifted(form, end, mpmath), target, k), reward]


def starts(task, rng, n):
    """Return states of episodes, the last ones where guards begin to act, and actions."""
    model = Model(task)
    centre = np.array([task.formulas.starts[name][0] for name in task.scene.state_names])
    states = np.tile(centre, (n, 1)) + 0.2 * rng.uniform(-1.0, 1.0, (n, len(centre)))
    given = {"targets": rng.uniform(-0.1, 0.1, (n, task.formulas.targets))} if task.formulas.targets else {}
    if task.fixed_target is not None:
        given = {}
    if given and task.formulas.targets == 1:
        given["targets"] = given["targets"][:, 0]
    actions = rng.uniform(-1.0, 1.0, (n, task.formulas.actions)) * task.formulas.largest
    for i in range(n):  # one way all the time, for longer and longer
        for _ in range(12 * i):
            row = {name: values[i : i + 1] for name, values in given.items()}
            push = np.sign(actions[i : i + 1]) * task.formulas.largest
            after, _, ended = model(states[i : i + 1], push if push.shape[1] > 1 else push[:, 0], **row)
            if ended[0]:
                break
            states[i] = after[0]
    # A guard leads exactly to the edge where it begins to act: there, two derivatives meet.
    return model, states + 1e-3 * rng.uniform(-1.0, 1.0, states.shape), actions, given


@pytest.mark.parametrize("env_id", [x if x in QUICK else slow(x) for x in SMOOTH])
def test_whole_step(env_id):
    """Along a random direction of state, actions and parameters, at starts and where guards and clips act.

    `test_last_rewards` begins with the general series.
    """
    task, rng, n = TASKS[env_id](), seeded(env_id), 3
    scene, names = task.scene, finite(task.scene)
    model, states, actions, given = starts(task, rng, n)
    width = len(scene.state_names)
    many = (states, actions if actions.shape[1] > 1 else actions[:, 0])
    seeds = rng.uniform(-1.0, 1.0, (n, width + len(task.formulas.observation) + 1))
    found = model.vjp(
        *many,
        **given,
        by_states=seeds[:, :width],
        by_observations=seeds[:, width:-1],
        by_rewards=seeds[:, -1],
        parameters=names,
    )
    target = np.zeros(0) if task.fixed_target is None else np.atleast_1d(task.fixed_target)
    for i in range(n):
        goal = np.atleast_1d(given["targets"][i]) if given else target
        check_row(task, found, i, states[i], actions[i], goal, names, seeds[i], rng)


def check_row(task, found, i, state, action, target, names, seeds, rng):
    """Compare row i of gradients of a whole step along a random direction of all arguments."""
    slopes = np.concatenate([found.states[i], np.atleast_1d(found.actions[i]), found.parameters[i]])
    direction, width = rng.uniform(-1.0, 1.0, len(slopes)), len(state)
    with mpmath.workdps(40):
        h, ends = mpmath.mpf(10) ** -12, []
        values = [*state, *action, *(getattr(task.scene, name) for name in names)]
        for side in (h, -h):
            x = [mpmath.mpf(v) + side * mpmath.mpf(d) for v, d in zip(values, direction, strict=True)]
            y, a = x[:width], x[width : width + len(action)]
            p = dict(zip(names, x[width + len(a) :], strict=True))
            results = exact_results(task, y, a, [mpmath.mpf(g) for g in target], p)
            ends.append(sum(mpmath.mpf(s) * r for s, r in zip(seeds, results, strict=True)))
        expected = float((ends[0] - ends[1]) / (2 * h))
    assert abs(slopes @ direction - expected) <= 1e-10 * max(1.0, np.abs(slopes * direction).sum())


#: Those of them that reward a last step otherwise, those with the general series first.
LAST = sorted(
    (x for x in SMOOTH if TASKS[x]().formulas.has_last), key=lambda x: form_of(TASKS[x]().scene) is not None
)


@pytest.mark.parametrize("with_parameters", [False, slow(True)])
@pytest.mark.parametrize("env_id", [LAST[0], *map(slow, LAST[1:])])
def test_last_rewards(env_id, with_parameters):
    """The last reward of an episode is differentiated where one ends, beside others that go on."""
    envs, rng = LagrangianVectorEnv(TASKS[env_id], 64), seeded(env_id)
    task, names = envs.task, finite(envs.task.scene) if with_parameters else ()
    envs.reset(seed=0)
    ended = np.zeros(64, bool)
    while not ended.any():
        states, actions = envs.state, rng.uniform(-1.0, 1.0, envs.action_space.shape).astype(np.float32)
        _, _, ended, _, _ = envs.step(actions)
    width = states.shape[1]
    seeds = rng.uniform(-1.0, 1.0, (64, width + len(task.formulas.observation) + 1))
    found = Model(task).vjp(
        states,
        actions[:, 0],
        by_states=seeds[:, :width],
        by_observations=seeds[:, width:-1],
        by_rewards=seeds[:, -1],
        parameters=names,
    )
    for i in (np.flatnonzero(ended)[0], np.flatnonzero(~ended)[0]):
        check_row(task, found, i, states[i], actions[i].astype(float), (), names, seeds[i], rng)


class Geared(own_tasks.Task):
    """Limits of actions, and an attribute, that are computed from parameters."""

    scene = Pendulum
    start = {"theta": 0.2}
    action = property(lambda self: {"torque": math.sqrt(8.0 * self.scene.gravity)})
    largest_action = property(lambda self: 3.0 * self.scene.length)

    def check(self):
        self.weight = self.scene.mass**2

    def observe(self, after, target, xp):
        return {"theta": after.theta}

    def reward(self, before, after, control, target, dt, xp):
        return -self.weight * after.theta**2 - 0.01 * control.torque**2


def test_numbers_that_follow_from_a_parameter_outside_of_formulas():
    """A gradient would lack what they contribute; other parameters have theirs."""
    model, given = Model(Geared()), ([[0.1, -0.2]], [0.4])
    found = model.vjp(*given, by_rewards=1.0, parameters=["damping"]).parameters
    values = 1e-3 * np.arange(5)
    rewards = [Model(Geared(damping=value))(*given)[1][0] for value in values]
    np.testing.assert_allclose(found, np.dot([-25.0, 48.0, -36.0, 16.0, -3.0], rewards) / 12e-3, rtol=1e-8)
    limits = "the limits of its actions"
    for name, kept in {"mass": r"self\.weight", "gravity": limits, "length": limits}.items():
        with pytest.raises(ValueError, match=rf"Geared computes {kept} from {name} .* or leave {name} out"):
            model.vjp(*given, by_rewards=1.0, parameters=["damping", name])


def test_what_is_clipped_has_no_gradient():
    model = Model(TASKS["PivotedBar-v0"]())
    states, actions = [[0.0, 0.0, 3.0, 0.0]] * 4, [-1.5, -0.99, 0.99, 1.5]
    found = model.vjp(states, actions, by_states=[[0.0, 1.0, 0.0, 1.0]] * 4)
    np.testing.assert_array_equal(found.actions[[0, 3]], 0.0)
    assert (np.abs(found.actions[[1, 2]]) > 0.1).all()


def test_kicks_are_constants():
    task = next(kind() for kind in TASKS.values() if kind.scene is PivotedBar and kind.draws)
    model, states, actions, _ = starts(task, seeded("kicks"), 2)
    ends, _, _ = model(states, actions[:, 0])
    seeds = np.ones((2, len(task.formulas.observation)))
    kicks = np.array([[0.0, 0.0, 0.3, 0.0], [0.0, 0.0, 0.0, 0.7]])
    found = model.vjp(states, actions[:, 0], by_observations=seeds, ends=ends, kicks=kicks)
    # The observation of the kicked state, moved with the state before the kick.
    h = 1e-6
    for j in range(4):
        sides = states + h * np.eye(4)[j], states - h * np.eye(4)[j]
        above, below = (model.observe(model(side, actions[:, 0])[0] + kicks) for side in sides)
        np.testing.assert_allclose(found.states[:, j], (above - below).sum(axis=1) / (2 * h), atol=1e-7)


def test_choices_have_no_gradient():
    task = next(task for task in (kind() for kind in TASKS.values()) if task.formulas.choices)
    with pytest.raises(ValueError, match="list of actions to choose from"):
        Model(task).vjp([[0.0] * 4], [1])


@pytest.mark.slow
def test_task_without_actions():
    task = own_tasks.Drift()  # rewards theta's change
    given = {"by_states": [[1.0, 0.0]], "by_rewards": 1.0, "parameters": ["length"]}
    found = Model(task).vjp([[1.0, 0.5]], np.empty((1, 0)), **given)
    A, _, P = task.scene.jacobian([1.0, 0.5], [], task.dt, parameters=["length"])
    np.testing.assert_allclose(found.states[0], 2.0 * A[0] - [1.0, 0.0], rtol=1e-12)
    np.testing.assert_allclose(found.parameters[0], 2.0 * P[0], rtol=1e-12)
    assert found.actions.shape == (1, 0)


def test_shapes_of_gradients():
    model, bar = Model(TASKS["PivotedBar-v0"]()), PivotedBar()
    with pytest.raises(ValueError, match=r"by_states must be one number or have shape \(2, 4\), got \(4,\)"):
        model.vjp(np.zeros((2, 4)), [0.0, 0.0], by_states=np.ones(4))
    with pytest.raises(ValueError, match=r"cotangent must have the shape .* \(2, 4\), got \(4,\)"):
        bar.vjp(np.zeros((2, 4)), 0.0, 0.02, np.ones(4))
    with pytest.raises(ValueError, match="cotangent must be finite, got nan"):
        bar.vjp(np.zeros(4), 0.0, 0.02, [0.0, math.nan, 0.0, 0.0])
    for scene in (bar, CartPole()):
        for state, control in (((0, 4), (0, 1)), ((0, 4), 0), (4, (0, 1))):
            A, B = scene.jacobian(np.zeros(state), np.zeros(control), 0.02)
            assert A.shape == (0, 4, 4) and B.shape == (0, 4, 1)
        with pytest.raises(ValueError, match=rf"the control must be \({scene.control_names[0]}\), 1 in all"):
            scene.jacobian(np.zeros(4), [], 0.02)
        with pytest.raises(ValueError, match=r"the control must be finite, got inf$"):
            scene.jacobian(np.zeros(4), np.inf, 0.02)
    # The step is taken, only the gradient overflows.
    large = [[0.0] * 4, [1e308] * 4]
    with pytest.raises(ValueError, match=r"the gradient of row 1 .* \[1e\+308, .*\] is too large; scale it"):
        bar.vjp([[0.0, 0.0, 3.0, 0.1]] * 2, 0.1, 0.02, large)
