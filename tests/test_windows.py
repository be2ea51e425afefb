"""Windows: opened, shared, closed, in real time, and driven by keys."""

import gc
import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from covering import covering
from pictures import IDS, picture
from rollouts import SINGLE

from lag_envs.envs import rendering, screen
from lag_envs.tasks import cylinder_in_cylinder, incline

pygame = pytest.importorskip("pygame")


@pytest.fixture
def window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


# --- windows ---


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


def test_window_keeps_the_pace_of_the_control_interval(window, monkeypatch):
    """By a clock that only waiting advances, so that a busy machine changes nothing."""
    now = [100.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0], sleep=lambda s: now.__setitem__(0, now[0] + s))
    monkeypatch.setattr(rendering, "time", clock)
    env = gym.make(cylinder_in_cylinder.Tilt.id, render_mode="human")
    env.reset(seed=1)
    start = now[0]
    for _ in range(6):
        env.step(env.action_space.sample())
    env.close()
    assert now[0] - start == pytest.approx(6 * 0.05)


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


def test_a_window_that_nobody_sees_is_not_opened(monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    monkeypatch.setattr(pygame.display, "init", lambda: None)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    with pytest.raises(gym.error.Error, match="no display was found; `lag-envs watch ID --video FILE`"):
        screen.check_display()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    screen.check_display()


def test_missing_pygame_is_named_with_its_remedy(monkeypatch):
    env = gym.make("PivotedBar-v0", render_mode="rgb_array")
    written = gym.make("PivotedBar-v0", render_mode="rgb_array", show_readout=True)
    screen.load_pygame.cache_clear()
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


# --- speed and real time ---


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
    gc.freeze()  # what other tests left need not be searched
    env = gym.make("PivotedBar-v0", render_mode="human")
    env.reset(seed=1)
    assert pygame.display.get_init()
    del env
    gc.collect()
    assert not pygame.display.get_init()
    code = "import gymnasium as gym, lag_envs; gym.make('PivotedBar-v0', render_mode='human').reset(seed=1)"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
