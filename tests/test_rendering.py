"""Pictures: to scale, complete, the same for everyone, and without a display."""

import base64
import gc
import io
import math
import os
import re
import shutil
import subprocess
import sys
import time
import warnings
from itertools import pairwise
from pathlib import Path
from typing import get_args

import gymnasium as gym
import numpy as np
import pytest
from covering import covering, slow
from rollouts import SINGLE

import lag_envs
from lag_envs.envs import raster, rendering
from lag_envs.mechanics.algebra import FormulaError
from lag_envs.scenes.picture import Picture, left_out_rates
from lag_envs.scenes.shapes import (
    Arrow,
    Circle,
    Frame,
    Line,
    Polygon,
    Pose,
    Role,
    Ruler,
    Window,
    beginning,
    placed,
    round_length,
    ticks,
)
from lag_envs.tasks import Task, cylinder_in_cylinder, incline, pivoted_bar

pygame = pytest.importorskip("pygame")

IDS = list(lag_envs.TASKS)


TASKS = {env_id: kind() for env_id, kind in lag_envs.TASKS.items()}
TASKS |= {"quasi-static": incline.Tilt(control="tilt")}
UNLIMITED = {
    pivoted_bar.SwingUpFree.id,
    incline.Brake.id,
    cylinder_in_cylinder.Damping.id,
    *(i for i, t in TASKS.items() if type(t).guard is Task.guard and type(t).terminated is Task.terminated),
}
BLUE = [(0x56, 0xB4, 0xE9), (0x0B, 0x5F, 0x9C)]


def picture(env_id, state=None, action=0.5, **options):
    env = gym.make(env_id, render_mode="rgb_array", **options)
    env.reset(seed=1, options=None if state is None else {"state": state})
    env.step(np.array([action], dtype=np.float32))
    frame = env.render()
    env.close()
    return frame


def moment(task, share=0.5, **changes):
    state = [c + h for c, h in zip(task.centre, task.half_widths, strict=True)]
    return Frame(state, share * task.limit_control, share, task.target_range and 0.1)._replace(**changes)


def blue(frame):
    """Return height and width of the area with the colours of a body."""
    rows, columns = np.nonzero(np.any([np.all(frame == colour, axis=-1) for colour in BLUE], axis=0))
    return np.ptp(rows) + 1, np.ptp(columns) + 1


def length(points):
    return sum(math.dist(a, b) for a, b in pairwise(points))


# --- pictures -----------------------------------------------------------------------------------------------


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


# --- windows ------------------------------------------------------------------------------------------------


@pytest.fixture
def window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


@pytest.mark.parametrize("env_id", covering())
def test_window_opens_closes_and_opens_again(window, env_id):
    env = gym.make(env_id, render_mode="human")
    for _ in range(2):
        env.reset(seed=1)
        env.step(env.action_space.sample())
        assert env.render() is None
        assert pygame.display.get_surface().get_size() == (600, 400)
        env.close()
        assert not pygame.display.get_init()


def test_window_shows_what_rgb_array_returns(window):
    env = gym.make(incline.Tilt.id, render_mode="human")
    env.reset(seed=1)
    env.step(np.array([0.5], dtype=np.float32))
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, picture(incline.Tilt.id))
    env.close()


def test_window_keeps_the_pace_of_the_control_interval(window):
    env = gym.make(cylinder_in_cylinder.Tilt.id, render_mode="human")
    env.reset(seed=1)
    start = time.perf_counter()
    for _ in range(6):
        env.step(env.action_space.sample())
    assert time.perf_counter() - start > 0.9 * 6 * 0.05
    env.close()


def test_environments_share_the_window(window):
    envs = [gym.make(env_id, render_mode="human") for env_id in IDS[:3]]
    for env in envs:
        env.reset(seed=1)
    for env in envs:
        env.step(env.action_space.sample())
    assert pygame.display.get_surface().get_size() == (2 * 600, 2 * 400)
    envs[1].close()
    envs[0].render()
    assert pygame.display.get_surface().get_size() == (2 * 600, 400)
    envs[0].close()
    envs[2].close()
    assert not pygame.display.get_init()


def test_environment_goes_on_when_its_window_is_closed(window):
    env = gym.make("PivotedBar-v0", render_mode="human")
    env.reset(seed=1)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    for _ in range(3):
        env.step(env.action_space.sample())
    assert not pygame.display.get_init()
    env.close()
    env.reset(seed=1)
    assert pygame.display.get_surface() is not None
    env.close()


def test_keys_are_left_to_the_program(window):
    env = gym.make("PivotedBar-v0", render_mode="human")
    env.reset(seed=1)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
    env.step(env.action_space.sample())
    assert [event.key for event in pygame.event.get(pygame.KEYDOWN)] == [pygame.K_LEFT]
    env.close()


def test_pygame_may_be_quit_by_others(window):
    env, shown = (gym.make("PivotedBar-v0", render_mode=mode) for mode in ("rgb_array", "human"))
    env.reset(seed=1)
    shown.reset(seed=1)
    before = env.render()
    pygame.quit()
    assert np.array_equal(env.render(), before)
    shown.render()
    assert pygame.display.get_surface() is not None
    env.close()
    shown.close()


def test_missing_display_is_named(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "nothing")
    env = gym.make("PivotedBar-v0", render_mode="human")
    with pytest.raises(gym.error.Error, match="rgb_array"):
        env.reset(seed=1)
    env.close()


# --- the rest -----------------------------------------------------------------------------------------------


def test_missing_pygame_is_named_with_its_remedy(monkeypatch):
    env = gym.make("PivotedBar-v0", render_mode="rgb_array")
    written = gym.make("PivotedBar-v0", render_mode="rgb_array", show_readout=True)
    rendering._pygame.cache_clear()
    monkeypatch.setitem(sys.modules, "pygame", None)
    for without in (env, written):
        without.reset(seed=1)
    assert env.render().std() > 1.0
    remedy = r'pip install "lag-envs\[render\]"'
    with pytest.raises(gym.error.DependencyNotInstalled, match=remedy):
        written.render()
    with pytest.raises(gym.error.DependencyNotInstalled, match=remedy):
        gym.make("PivotedBar-v0", render_mode="human").reset(seed=1)


def test_pygame_is_imported_only_for_windows_and_text():
    code = """
import sys, gymnasium as gym, lag_envs.envs.rendering
env = gym.make("PivotedBar-v0", render_mode="rgb_array")
env.reset(seed=1)
env.step(env.action_space.sample())
env.render()
env.close()
assert "pygame" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_role_has_a_style():
    assert set(rendering.STYLES) == set(get_args(Role))


def test_round_lengths_and_ticks():
    assert [round_length(x) for x in (0.03, 0.1, 0.99, 5.0, 40.0)] == pytest.approx(
        [0.02, 0.1, 0.5, 5.0, 20.0]
    )
    assert ticks(-0.25, 0.2, 0.1) == pytest.approx([-0.2, -0.1, 0.0, 0.1, 0.2])


def test_dashes_cover_the_line():
    dashes = list(rendering._dashes([(0.0, 0.0), (7.0, 0.0), (7.0, 13.0)], 3.0, 2.0))
    assert sum(length(dash) for dash in dashes) == pytest.approx(3.0 * 4)
    assert dashes[0] == [(0.0, 0.0), (3.0, 0.0)]
    assert dashes[1] == [(5.0, 0.0), (7.0, 0.0), (7.0, 1.0)]


def test_numbers_keep_their_width():
    assert [rendering._number(x) for x in (-1.5, 12.345, -419.0)] == ["−1.500", "12.35", "−419.0"]
    assert rendering._number(123456.0) == "1.23e+05"


# --- playing by hand ---


@pytest.mark.parametrize("env_id", SINGLE)
def test_play_takes_every_combination_of_the_keys(env_id, monkeypatch):
    """Gymnasium's play, called without arguments: keys are pressed, then the window is closed."""
    from gymnasium.utils.play import play

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(env_id, render_mode="rgb_array")
    down, up = pygame.KEYDOWN, pygame.KEYUP
    script = [(down, "a"), (down, "d"), (up, "a"), (down, "x"), (up, "d"), (pygame.QUIT, "")]
    rest = env.unwrapped.task.rest_action
    played = []

    def press(before, after, action, reward, terminated, truncated, info):
        played.append(action.tolist())
        kind, key = script[len(played) - 1]
        pygame.event.post(pygame.event.Event(kind, {"key": ord(key)} if key else {}))

    play(env, callback=press, seed=1, fps=1000)
    assert played == [[rest], [-1.0], [rest], [1.0], [1.0], [rest]]
    env.reset(seed=1)
    env.step(np.array([rest], dtype=np.float32))
    assert env.unwrapped.control == 0.0


# --- optional displays ---


def shown(env_id, steps=5, **look):
    env = gym.make(env_id, render_mode="rgb_array", **look)
    env.reset(seed=1)
    for _ in range(steps):
        env.step(np.full(env.action_space.shape, 0.5).astype(env.action_space.dtype))
        frame = env.render()
    env.close()
    return frame


def colours(frame, *wanted):
    return [int(np.all(frame == rendering._rgb(colour), axis=-1).sum()) for colour in wanted]


@pytest.mark.parametrize("env_id", covering())
def test_nothing_more_is_shown_unless_it_is_asked_for(env_id):
    plain = shown(env_id)
    assert max(colours(plain, rendering.FORCE.edge, rendering.STRIP_PAPER)) < 20
    assert np.array_equal(plain, shown(env_id, show_arrows=False, show_trail=0.0, show_readout=False))
    arrows, readout = shown(env_id, show_arrows=True), shown(env_id, show_readout=True)
    unseen = not any(isinstance(s, Arrow) for s in TASKS[env_id].shapes(moment(TASKS[env_id])))
    forces = TASKS[env_id].scene.forces(TASKS[env_id].centre)
    assert (colours(arrows, rendering.FORCE.edge)[0] > 20) == bool(forces or unseen)
    assert colours(readout, rendering.STRIP_PAPER)[0] > 0.6 * 600 * 48
    assert not np.array_equal(plain[:352], readout[:352])  # there is less room
    assert not np.array_equal(plain, shown(env_id, show_trail=1.0))


def test_forces_are_to_scale_and_point_where_they_push():
    from lag_envs.envs.forces import LONG, Forces

    task = TASKS[pivoted_bar.SwingUpFree.id]
    picture = Picture(task)
    now = Frame([0.0, 0.0], [0.0], [0.0])
    (up,) = (arrow for arrow, control in Forces(task, picture).arrows(now, picture.poses(now)) if not control)
    (x0, y0), (x1, y1) = up.points
    window = picture.view.top - picture.view.bottom
    weight, usual = 0.2 * 9.81, Forces(task, picture)._usual["support_vertical"]
    assert (x0, y0, x1) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert y1 == pytest.approx(LONG * window * weight / usual, rel=1e-6) and usual >= weight


def test_controls_without_an_arrow_of_their_own_get_one():
    from lag_envs.envs.forces import Forces
    from lag_envs.scenes import Scene
    from lag_envs.tasks import Task

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

    class Drive(Task):
        scene = Cart
        action = {"push": 2.0, "twist": 1.0, "brake": (0.0, 4.0)}

        def observe(self, after, target, xp):
            return {"x": after.x}

        def reward(self, before, after, control, target, dt, xp):
            return 0.0

    task = Drive()
    picture = Picture(task)

    def arrows(control, state):
        now = Frame(state, control, task.share(control))
        return [arrow.points for arrow, _ in Forces(task, picture).arrows(now, picture.poses(now))]

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
    seen = []
    monkeypatch.setattr(rendering, "write_readout", lambda image, rows, scale: seen.append(rows))
    env = gym.make("PivotedBar-v0", render_mode="rgb_array", show_readout=True)
    env.reset(seed=1)
    total = 0.0
    for _ in range(3):
        total += env.step(np.ones(1, np.float32))[1]
        env.render()
    (first, second) = seen[-1]
    assert [(r.name, r.unit) for r in first] == [
        ("time", "s"),
        ("return", ""),
        ("score", ""),
        ("s_ddot", "m/s²"),
    ]
    assert [r.name for r in second] == ["s", "s_dot", "theta", "theta_dot"]
    from lag_envs.scores import score

    assert [r.value for r in first[:3]] == pytest.approx([0.06, total, score("PivotedBar-v0", total)])
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


# --- polygons ---


def test_a_polygon_covers_its_area():
    """The sum over the pixels is the area, exactly except for the rounding to bytes."""
    rng, room = np.random.default_rng(1), np.zeros((60, 92))
    for _ in range(200):
        angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9))
        points = np.stack([45 + 40 * np.cos(angles), 30 + 25 * np.sin(angles)], axis=1)
        image = np.zeros((60, 90, 3), np.uint8)
        colour, at = np.array([[255.0, 255.0, 255.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
        raster.fill(image, points, np.array([9]), np.array([0]), at, colour, room)
        (x, y), edge = points.T, (image > 0) & (image < 255)
        area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
        assert image[:, :, 0].sum() / 255.0 == pytest.approx(area, abs=0.3)
        assert edge[:, :, 0].sum() < 500 and not room.any()


def test_polygons_are_cut_off_at_the_edges_and_blended():
    room, image = np.zeros((4, 6)), np.full((4, 4, 3), 200, np.uint8)
    points = np.array([(-1e9, -1e9), (1e9, -1e9), (1e9, 1.5), (-1e9, 1.5)])
    at, colour = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), np.array([[0.0, 100.0, 200.0, 0.5]])
    raster.fill(image, points, np.array([4]), np.array([0]), at, colour, room)
    assert image[:, 2].tolist() == [[100, 150, 200], [150, 175, 200], [200, 200, 200], [200, 200, 200]]
    assert not room.any()
    # Beside the image, and without an extent.
    raster.fill(image, points - (0.0, 1e3), np.array([4]), np.array([0]), at, colour, room)
    raster.fill(image, 0.0 * points + 2.0, np.array([4]), np.array([0]), at, colour, room)
    assert image[2:].min() == 200


def test_png_can_be_read(tmp_path):
    frame = shown("PivotedBar-v0")
    (tmp_path / "a.png").write_bytes(raster.png(frame))
    read = pygame.surfarray.array3d(pygame.image.load(tmp_path / "a.png")).swapaxes(0, 1)
    assert np.array_equal(read, frame)


# --- compared with the page ---


def test_colours_and_widths_are_those_of_the_page():
    """`site.js` paints the same shapes in a browser; its style sheet has the colours of light and dark."""
    site = Path(rendering.__file__).parents[1] / "leaderboard" / "site" / "static"
    css = (site / "site.css").read_text(encoding="utf-8").partition("@media")[0]
    colour = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", css))
    roles = re.search(r"ink\.roles = \{(.*?)\n    \};", (site / "site.js").read_text(encoding="utf-8"), re.S)
    found = {}
    for role, given in re.findall(r"(\w+): \[(.*)\],", roles[1]):
        fill, edge, width, *dash = re.findall(r'get\("([\w-]+)"\)|null|([\d.]+)', given)
        numbers = [float(x[1]) for x in (width, *dash)]
        fills = colour[fill[0]] if fill[0] else None
        found[role] = rendering.Style(fills, colour[edge[0]], numbers[0], tuple(numbers[1:]) or None)
    assert found == rendering.STYLES


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


def test_windows_keep_real_time(window, monkeypatch):
    """Also if an interval is no whole number of milliseconds, or shorter than a screen's."""

    class Clock:
        """A clock that other programs do not disturb: reading it takes 0.2 ms."""

        now, pictures = 0.0, 0

        def perf_counter(self):
            self.now += 2e-4
            return self.now

        def sleep(self, seconds):
            assert seconds >= 0.0
            self.now, self.pictures = self.now + seconds, self.pictures + 1

    for dt, steps, pictures in ((0.0333, 30, 30), (0.001, 1000, 59)):
        monkeypatch.setattr(rendering, "time", clock := Clock())
        env = gym.make("PivotedBar-v0", render_mode="human", dt=dt)
        env.reset(seed=1)
        start, shown = clock.now, clock.pictures
        for _ in range(steps):
            env.step(np.zeros(1, np.float32))
        assert clock.now - start == pytest.approx(steps * dt, abs=0.017)
        assert clock.pictures - shown == pytest.approx(pictures, abs=1)
        clock.now += 5.0  # the caller was busy: lost time is not caught up with
        start = clock.now
        for _ in range(steps):
            env.step(np.zeros(1, np.float32))
        assert clock.now - start == pytest.approx(steps * dt, abs=dt + 0.017)
        env.close()


def test_a_window_that_was_left_open_is_closed(window):
    env = gym.make("PivotedBar-v0", render_mode="human")
    env.reset(seed=1)
    assert pygame.display.get_init()
    del env
    gc.collect()
    assert not pygame.display.get_init()
    code = "import gymnasium as gym, lag_envs; gym.make('PivotedBar-v0', render_mode='human').reset(seed=1)"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def page():
    """The page's painter in a browser, on an empty page."""
    site = Path(rendering.__file__).parents[1] / "leaderboard" / "site" / "static"
    chromium = shutil.which(os.environ.get("CHROMIUM", "chromium"))
    if chromium is None:
        missing = "THERE IS NO CHROMIUM, SO PICTURES WERE NOT HELD AGAINST THE PAGE'S: install chromium"
        warnings.warn(missing, stacklevel=1)
        pytest.skip(missing)
    playwright = pytest.importorskip("playwright.sync_api")
    script, count = re.subn(
        r"\n  // --- replays -",
        "\n  window.painter = { paint, placed, windowOf, readColours };\n  // --- replays -",
        (site / "site.js").read_text(encoding="utf-8"),
    )
    assert count == 1
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium)
        page = browser.new_page(viewport={"width": 700, "height": 500})
        page.set_content(
            f"<style>{(site / 'site.css').read_text(encoding='utf-8')}</style>"
            "<canvas width=600 height=400></canvas>"
        )
        page.evaluate("text => { try { (0, eval)(text); } catch { /* there is no board */ } }", script)
        yield page
        browser.close()


PAINT = """([picture, poses, margin]) => {
  const { paint, placed, windowOf, readColours } = window.painter;
  readColours();
  const pen = document.querySelector("canvas").getContext("2d");
  pen.fillStyle = "#ffffff";
  pen.fillRect(0, 0, 600, 400);
  const box = { x: margin, y: margin, width: 600 - 2 * margin, height: 400 - 2 * margin };
  const view = windowOf(picture, poses);
  paint(pen, box, view, placed(picture, poses, view));
  return document.querySelector("canvas").toDataURL();
}"""


@pytest.mark.filterwarnings("default:THERE IS NO CHROMIUM")
@pytest.mark.parametrize("env_id", covering())
def test_pictures_are_those_of_the_page(env_id, page):
    """Both painters, given the same shapes and poses; only roundings at edges differ."""
    from lag_envs.leaderboard.site import scenery

    task = TASKS[env_id]
    now, picture = moment(task), Picture(task)
    by_page = page.evaluate(PAINT, [scenery.picture_data(picture), picture.poses(now), rendering.MARGIN])
    png = io.BytesIO(base64.b64decode(by_page.partition(",")[2]))
    by_page = pygame.surfarray.array3d(pygame.image.load(png, "a.png")).swapaxes(0, 1).astype(np.float64)
    apart = np.abs(by_page - rendering.paint(task, now)).max(axis=2)
    assert apart.mean() < 0.4 and np.mean(apart > 64) < 0.001, (apart.mean(), np.mean(apart > 64))
