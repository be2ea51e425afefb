"""Pictures of environments: what is shown, where, and how fast."""

import math
import time

import gymnasium as gym
import numpy as np
import pytest
from contract_scenes import Along
from covering import covering, slow
from own_tasks import Crane, Deliver
from pictures import IDS, TASKS, length, moment, picture, shown
from rollouts import SINGLE

import lag_envs
from lag_envs.envs import painting, readout, rendering
from lag_envs.envs.readout import STRIP_PAPER
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes.picture import Picture, left_out_rates
from lag_envs.scenes.shapes import Arrow, Circle, Frame, Line, Polygon, Pose, Ruler, Window, beginning, placed
from lag_envs.scores import known_returns, score
from lag_envs.tasks import Task, cylinder_in_cylinder, incline, pivoted_bar

pygame = pytest.importorskip("pygame")
UNLIMITED = {
    pivoted_bar.SwingUpFree.id,
    incline.Brake.id,
    cylinder_in_cylinder.Damping.id,
    *(i for i, t in TASKS.items() if type(t).guard is Task.guard and type(t).terminated is Task.terminated),
}
BLUE = [(0x56, 0xB4, 0xE9), (0x0B, 0x5F, 0x9C)]


def blue(frame):
    """Return height and width of the area with the colours of a body."""
    rows, columns = np.nonzero(np.any([np.all(frame == colour, axis=-1) for colour in BLUE], axis=0))
    return np.ptp(rows) + 1, np.ptp(columns) + 1


# --- pictures ---


@pytest.mark.parametrize("env_id", covering())
def test_frames_are_pictures_that_follow_the_state(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    assert first.shape == (400, 600, 3) and first.dtype == np.uint8
    kept = first.copy()
    assert np.array_equal(env.render(), first)
    env.step(env.action_space.sample())
    second = env.render()
    assert not np.array_equal(second, first)
    assert np.array_equal(first, kept) and not np.shares_memory(first, second)
    assert len(np.unique(second.reshape(-1, 3), axis=0)) > 50
    assert not pygame.display.get_init()
    env.close()
    env.reset(seed=1)
    assert np.array_equal(env.render(), kept)
    env.close()


def test_cylinders_are_drawn_to_scale():
    # The window on the shell is 2.56 R = 1.28 m high, in 384 pixels; that on the plank 1.25 m wide, in 584.
    for frame, radius, scale in [
        (picture(cylinder_in_cylinder.Tilt.id), 0.1, 384 / 1.28),
        (picture(cylinder_in_cylinder.Damping.id, action=-1.0, radius=0.2), 0.2, 384 / 1.28),
        (picture(incline.Tilt.id), 0.05, 584 / 1.25),
    ]:
        assert blue(frame) == pytest.approx((2 * radius * scale,) * 2, abs=4)


def test_bar_is_drawn_to_scale():
    # 1.08 reaches to either side, a reach is the bar's 0.6 m; half a thickness extends above the pivot.
    height, width = blue(picture(pivoted_bar.SwingUpFree.id, [0.0, 0.0], 0.0))
    assert height == pytest.approx(0.6 * 1.035 * 384 / (2 * 1.08 * 0.6), abs=4)
    assert width == pytest.approx(0.07 * 384 / (2 * 1.08), abs=4)


@pytest.mark.parametrize("name", [*SINGLE, "quasi-static"])
def test_arrow_is_in_proportion_to_the_control(name):
    task = TASKS[name]
    arrows = {}
    for share in (0.0, 0.25, 0.5, 1.0):
        (arrows[share],) = (s for s in task.shapes(moment(task, share)) if isinstance(s, Arrow))
    full = length(arrows[1.0].points)
    assert full > 0.0
    for share, arrow in arrows.items():
        assert length(arrow.points) == pytest.approx(share * full, rel=1e-2, abs=1e-12)


@pytest.mark.parametrize("name", [*SINGLE, "quasi-static"])
def test_every_task_shows_its_target_or_limits(name):
    task = TASKS[name]
    roles = {getattr(shape, "role", None) for shape in task.shapes(moment(task))}
    assert {"body", "action", "target"} <= roles
    assert ("limit" in roles) == (name not in UNLIMITED)


def test_target_is_where_it_was_set():
    task = TASKS[cylinder_in_cylinder.Tilt.id]
    (mark,) = (s for s in task.shapes(moment(task, target=0.3)) if s.role == "target")
    assert mark.centre == pytest.approx((0.4 * math.sin(0.3), -0.4 * math.cos(0.3)))
    assert mark.radius == 0.1
    task = TASKS[incline.Tilt.id]
    (mark,) = (s for s in task.shapes(moment(task, target=0.3, state=[0.0, 0.0, 0.0])) if s.role == "target")
    assert mark == Circle((0.3, 0.05), 0.05, "target")


def test_a_window_holds_what_starts_reach():
    class Shown(Crane):
        def bodies(self):
            return {"trolley": [Circle((0.0, 0.0), 0.1, "body")], "load": [Circle((0.0, 0.0), 0.1, "body")]}

        def poses(self, q, xp):
            load = (q.x + q.rope * xp.sin(q.swing), -q.rope * xp.cos(q.swing), q.swing)
            return {"trolley": (q.x, 0.0, 0.0), "load": load}

    class Hoist(Deliver):
        scene = Shown

    view = Hoist().window()  # ropes are 1.2 m long at most
    assert view.frame == "trolley" and 1.2 < view.right < 1.6
    assert Shown().window().right < 0.3  # a scene knows no starts


def test_a_task_adds_shapes_where_frames_are():
    class Marked(pivoted_bar.SwingUp):
        def bodies(self):
            return {**super().bodies(), "hat": [Circle((0.0, 0.0), 0.1, "target")]}

    with pytest.raises(FormulaError, match=r"Marked\.bodies has 'hat', which has no place in .*indicators"):
        Marked().shapes(Frame([0.0] * 4))

    class Wide(pivoted_bar.SwingUp):
        def window(self):
            return Window(0.0, 0.0, 1.0, 1.0, "hat")

    with pytest.raises(FormulaError, match=r"Wide\.window has 'hat'"):
        Wide().shapes(Frame([0.0] * 4))
    for methods, message in (
        ({"window": lambda self: (0.0, 1.0)}, r"window must return Window\(left, .*, got \(0.0, 1.0\)"),
        (
            {"bodies": lambda self: {"bar": [Circle((0.0, 0.0), math.nan)]}},
            "numbers must be finite, got Circle",
        ),
        (
            {"indicators": lambda self, now, xp: {"hat": (now.target, 0.0)}},
            "'hat': take numbers by their names",
        ),
    ):
        with pytest.raises(FormulaError, match=message):
            type("Wrong", (pivoted_bar.SwingUp,), methods)().shapes(Frame([0.0] * 4))

    class Old(pivoted_bar.SwingUp):
        def shapes(self, now):
            return []

    with pytest.raises(FormulaError, match=r"Old\.shapes: .* indicators\(self, now, xp\)"):
        Old()


def test_poses_of_an_episode_are_those_of_its_moments():
    for task in TASKS.values():
        rng, picture = np.random.default_rng(1), Picture(task)
        states = task.centre + rng.uniform(-1, 1, (6, len(task.centre))) * task.half_widths
        controls = task.wanted(rng.uniform(-1, 1, (5, task.formulas.actions)))
        poses = picture.episode(states, controls, 0.2, task.dt)
        target = 0.2 if task.formulas.targets else None
        turned = np.zeros(len(left_out_rates(task.scene, states[0])))
        rates = [np.array(left_out_rates(task.scene, state)) for state in states]
        for i, state in enumerate(states):
            control = controls[i - 1] if i else np.zeros(len(controls[0]))
            turned = turned + (0.5 * task.dt * (rates[i - 1] + rates[i]) if i else 0.0)
            now = Frame(state.tolist(), control, task.share(control), target, turned)
            np.testing.assert_allclose(poses[i], picture.poses(now), atol=1e-14)


def test_a_pose_moves_turns_mirrors_and_shortens():
    view, bent = Window(-1.0, -1.0, 1.0, 1.0), Line([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
    (moved,) = placed(bent, Pose(1.0, 2.0, math.pi / 2, -0.75), view)
    assert np.asarray(moved.points) == pytest.approx(np.array([(1.0, 2.0), (1.0, 3.0), (1.5, 3.0)]))
    assert beginning(bent.points, 0.0) == [(0.0, 0.0), (0.0, 0.0)]
    ticks = placed(Ruler(0.5, 0.1), Pose(100.0, 0.0, 0.0), view.moved(50.1, 0.0))
    assert len(ticks) == 16 and all(tick.points[0][0] % 0.5 == 0.0 for tick in ticks)
    assert min(tick.points[0][0] for tick in ticks) == 46.5


def turn(shapes):
    """Return place and angle of a rolling cylinder."""
    centre = next(s.centre for s in shapes if isinstance(s, Circle) and s.role == "body")
    x, y = next(s.points[1] for s in shapes if isinstance(s, Polygon) and s.role == "mark")
    return centre, math.atan2(y - centre[1], x - centre[0])


def turned(task, before, after):
    angles = [turn(task.shapes(now))[1] for now in (before, after)]
    return math.remainder(angles[1] - angles[0], 2.0 * math.pi)


def test_cylinders_roll_without_slipping():
    # On the incline at x'/R + phi' clockwise; in the shell at (R psi' - a theta')/r counter-clockwise.
    task = TASKS[incline.Tilt.id]
    before, after = Frame([0.1, 0.0, 0.01]), Frame([0.12, 0.0, 0.03])
    assert turned(task, before, after) == pytest.approx(-(0.02 / 0.05 + 0.02))
    task = TASKS[cylinder_in_cylinder.Pump.id]
    before, after = Frame([0.1, 0.0, 0.0], turned=0.3), Frame([0.2, 0.0, 0.0], turned=0.4)
    assert turned(task, before, after) == pytest.approx((0.5 * 0.1 - 0.4 * 0.1) / 0.1)
    task = TASKS[incline.Brake.id]
    (x0, y0), _ = turn(task.shapes(Frame([-1.0, 0.0])))
    (x1, y1), _ = turn(task.shapes(Frame([-0.9, 0.0])))
    assert (x1 - x0, y1 - y0) == pytest.approx((0.1 * math.cos(math.pi / 12), -0.1 * math.sin(math.pi / 12)))


def test_shell_turns_by_the_integral_of_its_rate():
    env = gym.make(cylinder_in_cylinder.Tilt.id, render_mode="rgb_array", damping=0.0).unwrapped
    env.reset(seed=1)
    env.render()
    for _ in range(5):
        env.step(np.array([0.1], dtype=np.float32))
        env.render()
        env.render()
    # psi'' = 1.5 rad/s² for 0.25 s.
    assert env._viewer._turned == pytest.approx(0.5 * 1.5 * 0.25**2)


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("PivotedBar-v0", {"track": math.inf}),
        ("PivotedBar-v0", {"inertia": 0.0}),
        ("PivotedBar-v0", {"com_distance": 1e-8}),
        ("PivotedBar-v0", {"com_distance": 1e3}),
        (incline.Tilt.id, {"control": "tilt"}),
        (incline.Tilt.id, {"inertia": 0.0025}),
        (incline.Tilt.id, {"radius": 1e-9}),
        (incline.Brake.id, {"tilt": 0.0}),
        (incline.Brake.id, {"tilt": 1.5}),
        (incline.Brake.id, {"tilt": math.pi / 2}),
        (incline.Brake.id, {"radius": 1e6}),
        (incline.Brake.id, {"radius": 1e-9}),
        (cylinder_in_cylinder.Tilt.id, {"radius": 0.4999}),
        (cylinder_in_cylinder.Tilt.id, {"shell_radius": 1e6, "radius": 1e-6}),
    ],
)
def test_unusual_parameters_are_drawn_too(env_id, options):
    task = lag_envs.TASKS[env_id](**options)
    start = time.process_time()
    frame = rendering.paint(task, moment(task))
    assert time.process_time() - start < 0.5
    assert frame.std() > 0.0


@pytest.mark.parametrize("tilt", [0.5, 0.8, math.pi / 2])
def test_a_steep_plane_has_its_ground_too(tilt):
    frame = picture(incline.Brake.id, tilt=tilt)
    assert np.all(frame == (0xE9, 0xE7, 0xE1), axis=-1).mean() > 0.15


def test_far_away_start_stays_in_the_picture():
    assert min(blue(picture(incline.Brake.id, [-500.0, 1.0]))) > 10


def test_tubes_are_drawn_hollow():
    solid = picture(cylinder_in_cylinder.Tilt.id)
    tube = picture(cylinder_in_cylinder.Tilt.id, inertia=0.009)
    assert np.all(solid == BLUE[1], axis=-1).sum() > 2 * np.all(tube == BLUE[1], axis=-1).sum()


def test_vector_environment_draws_each_of_its_environments():
    envs = gym.make_vec(
        cylinder_in_cylinder.Tilt.id, num_envs=3, render_mode="rgb_array", radius=[0.05, 0.1, 0.2]
    )
    envs.reset(seed=1)
    envs.step(envs.action_space.sample())
    frames = envs.render()
    assert len(frames) == 3
    assert [blue(frame)[1] for frame in frames] == pytest.approx([30, 60, 120], abs=4)
    envs.close()


@pytest.mark.parametrize("env_id", [IDS[0], *map(slow, IDS[1:])])
def test_record_video_without_a_warning(env_id, tmp_path):
    pytest.importorskip("moviepy")
    env = gym.wrappers.RecordVideo(
        gym.make(env_id, render_mode="rgb_array"), str(tmp_path / "videos"), disable_logger=True
    )
    env.reset(seed=1)
    for _ in range(5):
        env.step(env.action_space.sample())
    env.close()
    (video,) = tmp_path.glob("videos/*.mp4")
    assert video.stat().st_size > 1000


def colours(frame, *wanted):
    return [int(np.all(frame == painting.rgb(colour), axis=-1).sum()) for colour in wanted]


# --- optional displays ---


@pytest.mark.parametrize("env_id", covering())
def test_nothing_more_is_shown_unless_it_is_asked_for(env_id):
    plain = shown(env_id)
    assert max(colours(plain, painting.FORCE.edge, STRIP_PAPER)) < 20
    assert np.array_equal(plain, shown(env_id, show_arrows=False, show_trail=0.0, show_readout=False))
    arrows, readout = shown(env_id, show_arrows=True), shown(env_id, show_readout=True)
    unseen = not any(isinstance(s, Arrow) for s in TASKS[env_id].shapes(moment(TASKS[env_id])))
    forces = TASKS[env_id].scene.forces(TASKS[env_id].centre)
    assert (colours(arrows, painting.FORCE.edge)[0] > 20) == bool(forces or unseen)
    assert colours(readout, STRIP_PAPER)[0] > 0.6 * 600 * 48
    assert not np.array_equal(plain[:352], readout[:352])  # there is less room
    assert not np.array_equal(plain, shown(env_id, show_trail=1.0))


def test_forces_are_to_scale_and_point_where_they_push():
    from lag_envs.envs.forces import LONG, Forces

    task = TASKS[pivoted_bar.SwingUpFree.id]
    picture = Picture(task)
    now = Frame([0.0, 0.0], [0.0], [0.0])
    (up,) = (arrow for arrow, control in Forces(task, picture).arrows(now) if not control)
    (x0, y0), (x1, y1) = up.points
    window = picture.view.top - picture.view.bottom
    weight, usual = 0.2 * 9.81, Forces(task, picture)._usual["support_vertical"]
    assert (x0, y0, x1) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert y1 == pytest.approx(LONG * window * weight / usual, rel=1e-6) and usual >= weight


def test_controls_without_an_arrow_of_their_own_get_one():
    from lag_envs.envs.forces import Forces
    from lag_envs.scenes import Scene

    class Cart(Scene):
        coordinates = {"x": "m", "angle": "rad"}
        controls = {"push": "N", "twist": "N m", "brake": "N s/m"}

        def kinetic(self, q, v, xp):
            return 0.5 * v.x**2 + 0.5 * v.angle**2

        def potential(self, q, xp):
            return 0.0

        def dissipation(self, q, v, u, xp):
            return 0.5 * u.brake * v.x**2

        def applied(self, q, v, u, xp):
            return {"x": u.push, "angle": u.twist}

        def poses(self, q, xp):
            return {"cart": (q.x, 0.0, 0.0), "wheel": (0.0, 1.0, q.angle)}

        def bodies(self):
            return {"cart": [Circle((0.0, 0.0), 0.1)], "wheel": [Circle((0.0, 0.0), 0.1)]}

    class Drive(Along):
        scene = Cart
        action = {"push": 2.0, "twist": 1.0, "brake": (0.0, 4.0)}

    task = Drive()
    picture = Picture(task)

    def arrows(control, state):
        now = Frame(state, control, task.share(control))
        return [arrow.points for arrow, _ in Forces(task, picture).arrows(now)]

    (pushed,) = arrows([1.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0])
    assert pushed[0] == pytest.approx((0.5, 0.0)) and pushed[1][0] > 0.6
    (twisted,) = arrows([0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 0.0])
    assert len(twisted) > 10 and math.dist(twisted[0], (0.0, 1.0)) == pytest.approx(
        math.dist(twisted[5], (0.0, 1.0))
    )
    (held,) = arrows([0.0, 0.0, 4.0], [0.0, 1.0, 0.0, 0.0])
    assert held[1][0] < -0.1  # a brake pushes back
    assert arrows([0.0, 0.0, 4.0], [0.0, 0.0, 0.0, 0.0]) == []


def test_a_trail_is_of_the_seconds_that_are_asked_for_and_of_one_episode():
    env = gym.make("PivotedBar-v0", render_mode="rgb_array", show_trail=0.1).unwrapped
    env.reset(seed=1)
    for _ in range(20):
        env.step(np.ones(1, np.float32))
        env.render()
        env.render()
    assert len(env._viewer._trail) == 6  # 0.1 s are five steps
    env.reset(seed=1)
    env.render()
    assert len(env._viewer._trail) == 1
    for _ in range(2):  # also if pictures are taken late
        env.reset()
        for _ in range(30):
            env.step(np.ones(1, np.float32))
        env.render()
        assert len(env._viewer._trail) == 1
    # A bar's tip, a cylinder's axis.
    assert rendering.tips(env._viewer._picture)[env._viewer._picture.frames.index("bar")] == pytest.approx(
        (0.0, -0.621), abs=0.03
    )
    rolling = Picture(TASKS[incline.Tilt.id])
    assert rendering.tips(rolling)[rolling.frames.index("cylinder")] == (0.0, 0.0)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"show_arrows": 1}, "show_arrows must be True or False, got 1"),
        ({"show_readout": "no"}, "show_readout must be True or False, got 'no'"),
        ({"show_trail": True}, "show_trail must be a real number, got True"),
        ({"show_trail": -1.0}, "show_trail must lie between 0 and 60 s, got -1.0"),
        ({"show_trail": math.inf}, "show_trail must be finite"),
    ],
)
def test_what_cannot_be_shown_is_refused(option, message):
    with pytest.raises(ValueError, match=message):
        gym.make("PivotedBar-v0", **option)
    with pytest.raises(ValueError, match=message):
        gym.make_vec("PivotedBar-v0", 2, **option)
    for tiles in (0, 2.0, True):
        with pytest.raises(ValueError, match="show_tiles must be a whole number of at least 1"):
            gym.make_vec("PivotedBar-v0", 2, show_tiles=tiles)


def test_readout_counts_the_episode(monkeypatch):
    """Before the end, a random policy's return counts in proportion to the time that has passed."""
    seen = []
    monkeypatch.setattr(readout.Readout, "write", lambda self, image, groups, scale: seen.append(groups))
    made = {"render_mode": "rgb_array", "show_readout": True}
    env = gym.make("PivotedBar-v0", **made)
    envs = gym.make_vec("PivotedBar-v0", 1, **made)
    cut = gym.make_vec("PivotedBar-v0", 1, max_episode_steps=3, **made)
    for one in (env, envs, cut):
        one.reset(seed=1)
    total, last = 0.0, int(TASKS["PivotedBar-v0"].limit)
    for n in range(1, last + 1):
        total += env.step(np.ones(1, np.float32))[1]
        for batch in (envs, cut):
            batch.step(np.ones((1, 1), np.float32))
        if n in (3, last - 1, last):
            for one in (env, envs, cut):
                one.render()
            assert all(groups[0][2].name == "s_ddot" for groups in seen)
            known = known_returns("PivotedBar-v0")
            so_far = (total - n / last * known.random) / (known.best - known.random)
            assert [groups[0][3].value for groups in seen[-3:-1]] == pytest.approx([so_far, so_far])
            if n == 3:  # cut short by then
                assert seen[-1][0][3].value == pytest.approx(so_far)
    assert so_far == pytest.approx(score("PivotedBar-v0", total))
    (first, second) = seen[-3]
    assert [(r.name, r.unit) for r in first] == [
        ("time", "s"),
        ("return", ""),
        ("s_ddot", "m/s²"),
        ("score", ""),
    ]
    assert [r.name for r in second] == ["s", "s_dot", "theta", "theta_dot"]
    assert [r.value for r in first[:2]] == pytest.approx([0.02 * last, total])
    other = gym.make("PivotedBar-v0", render_mode="rgb_array", show_readout=True, mass=0.3)
    other.reset(seed=1)
    other.render()
    assert [r.name for r in seen[-1][0]] == ["time", "return", "s_ddot"]  # no score for another task
    envs = gym.make_vec("PivotedBar-v0", 2, render_mode="rgb_array", show_readout=True, duration=0.06)
    envs.reset(seed=1)
    steps = []
    for _ in range(5):
        envs.step(np.ones((2, 1), np.float32))
        envs.render()
        steps.append([round(r.value / 0.02) for rows in seen[-2:] for r in rows[0][:1]])
    assert steps == [[1, 1], [2, 2], [3, 3], [0, 0], [1, 1]]


@pytest.mark.parametrize(
    ("tiles", "shape"), [(1, (400, 600)), (4, (800, 1200)), (5, (532, 1200)), (99, (798, 1200))]
)
def test_vector_environment_renders_a_grid(tiles, shape):
    envs = gym.make_vec("PivotedBar-v0", 9, render_mode="rgb_array", show_tiles=tiles)
    envs.reset(seed=1)
    frame = envs.render()
    assert frame.shape == (*shape, 3) and frame.dtype == np.uint8
    kept = frame.copy()
    envs.step(envs.action_space.sample())
    assert not np.array_equal(envs.render(), kept) and np.array_equal(frame, kept)
    envs.close()


# --- speed and real time ---


@pytest.mark.parametrize("env_id", covering())
def test_pictures_are_quick(env_id):
    """At least 300 steps with a picture per second of processor time, in the best of a few samples."""
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=1)
    env.render()

    def seconds():
        start = time.process_time()
        for _ in range(20):
            if any(env.step(env.action_space.sample())[2:4]):
                env.reset()
            env.render()
        return time.process_time() - start

    assert min(seconds() for _ in range(5)) < 20 / 300
