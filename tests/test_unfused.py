"""The unfused step: against the fused one, and against its other implementations."""

import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from covering import covering, slow
from driven import Six, at_random, by_agent
from own_tasks import TASKS as OWN

import lag_envs
from lag_envs.envs.unfused import Unfused
from lag_envs.mechanics.recording import parameter_values
from lag_envs.scenes import StepRefused
from lag_envs.scenes.shapes import Circle
from lag_envs.stepping.compiling import absent_from
from lag_envs.stepping.general import stepper_of
from lag_envs.stepping.script import LARGEST, Script
from lag_envs.tasks import TASKS, cylinder_in_cylinder, pivoted_bar

REGISTERED = sorted(TASKS)


def made(task):
    lag_envs.register(task)
    return gym.make(task.id).unwrapped


@pytest.mark.parametrize("id", covering())
def test_unfused_is_the_environments_step_to_rounding(id):
    """Synchronised before each step, at most 1e-15 times size times condition."""
    check_against_fused(gym.make(id).unwrapped, range(2))


@pytest.mark.parametrize(
    "task",
    [OWN[0], *(slow(task) for task in OWN[1:])],
    ids=lambda task: task.__name__,
)
def test_unfused_is_the_step_of_users_tasks_too(task):
    check_against_fused(made(task), range(2))


@pytest.mark.slow
@pytest.mark.parametrize("id", REGISTERED)
def test_unfused_is_the_environments_step_in_a_hundred_episodes(id):
    check_against_fused(gym.make(id).unwrapped, range(100))


def check_against_fused(env, seeds):
    unfused, task = Unfused(env.task), env.task
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        first = unfused.reset(seed)
        assert np.allclose(unfused.state, env.state, rtol=1e-15, atol=1e-16)
        assert np.allclose(observation, first, rtol=1e-6, atol=1e-7)
        if unfused.program.drawn:  # the script rounds results of drawn parameters differently
            synchronise_constants(unfused, env.drawn_task)
        steps, over = [], [False]
        act = by_agent(env.task) if seed % 2 else at_random(env.task, seed)
        for i in range(int(task.limit)):
            action = act(unfused, i)
            before, target = env.state, env.target
            unfused.state = before
            # The fused step carries the angle's cosine and sine along; they belong to exactly this angle now.
            lifted = slice(len(before), len(env._program.y))
            env._rows[lifted] = unfused.numbers[lifted]
            unfused.target = [] if target is None else np.atleast_1d(target)
            observation, reward, *over, _ = env.step(action)
            seen, own, *ended = unfused.step(action)
            assert over == ended
            row = (reward, own, observation, seen, before, env.state, unfused.state)
            steps.append([np.atleast_1d(x) for x in (*row, env.control, unfused.control)])
            if any(over):
                break
        assert any(over)
        columns = (np.array(column) for column in zip(*steps, strict=True))
        rewards, own_rewards, seen, own_seen, starts, ends, own, controls, own_controls = columns
        np.testing.assert_allclose(own_rewards, rewards, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(own_seen, seen, rtol=1e-6, atol=1e-6)
        by_states, by_controls = env.drawn_task.scene.jacobian(starts, controls, env.task.dt)
        # A guard that stops at an edge amplifies a rounding, which is not the motion's fault.
        moved = np.einsum("nij,nj->ni", by_controls, own_controls - controls)
        assert np.abs(moved).max(initial=0.0) <= 1e-10
        sizes = np.maximum(np.abs(starts).max(axis=0), np.abs(ends).max(axis=0))
        sizes[sizes == 0.0] = 1.0
        error = np.max(np.abs(own - ends - moved) / sizes, axis=1)
        condition = np.linalg.norm(by_states / sizes[:, None] * sizes, np.inf, axis=(1, 2))
        assert np.max(error / np.maximum(1.0, condition)) <= 1e-15


def synchronise_constants(unfused, task):
    """Give the script the constants of a task; they equal its own to 1e-14."""
    exact = task.formulas.constants()
    for i, name in enumerate([*unfused.program.given, *unfused.program.derived]):
        if name in exact:
            assert unfused.constants[i] == pytest.approx(exact[name], rel=1e-14), name
            unfused.constants[i] = exact[name]


@pytest.mark.parametrize("task", [*OWN, slow(Six)], ids=lambda task: task.__name__)
def test_motion_has_the_bits_of_the_compiled_unfused_step(task):
    outer = made(task)
    scene = outer.scene
    stepper = stepper_of(scene.mechanics)
    constants = stepper.constants(parameter_values(scene))
    code = stepper.code(absent_from(constants), fused=False)
    advance = code.compile()
    numbers = [constants[name.removeprefix("k_")] for name in code.constants]
    env = Unfused(task())
    order = float(env.program._order)
    env.reset(3)
    task = env.task
    act = at_random(task, 4)
    for i in range(20):
        before = env.state
        env.step(act(env, i))
        if task.draws:
            continue  # the state is the one after the kick
        *after, status = advance(np.zeros(code.scratch), *before, *env.control, task.dt, order, *numbers)
        assert status > 0 and [float(x).hex() for x in after] == [x.hex() for x in env.state]


def test_constants_are_those_of_the_scene():
    for id in REGISTERED:
        env = Unfused(TASKS[id]())
        found = dict(zip([*env.program.given, *env.program.derived], env.constants, strict=True))
        for name, value in env.program.task.formulas.constants().items():
            if name in found:
                assert found[name] == pytest.approx(value, rel=1e-14), name


def test_the_start_follows_parameters():
    longer = pivoted_bar.SwingUp(track=0.7)
    changed, own = Unfused(pivoted_bar.SwingUp()), Unfused(longer)
    changed.set_parameter("track", 0.7)
    assert changed.reset(3) == own.reset(3)
    assert changed.state == own.state != Unfused(pivoted_bar.SwingUp()).state


def test_a_step_that_is_refused_changes_nothing():
    env = Unfused(TASKS[pivoted_bar.SwingUpFree.id](damping=0.0))
    env.reset(1)
    env.state = [0.0, 1e9]
    with pytest.raises(StepRefused):
        env.step([0.0])
    assert env.state == [0.0, 1e9] and env.steps == 0


def test_seeds_of_any_size():
    for seed in (0, 2**53 + 1, 2**63 + 5, 2**64 - 1, 2**70):
        env = gym.make(cylinder_in_cylinder.Tilt.id).unwrapped
        unfused = Unfused(env.task)
        env.reset(seed=seed)
        unfused.reset(seed)
        assert np.allclose(unfused.state, env.state, rtol=1e-15)
        assert np.allclose(unfused.target, env.target, rtol=1e-15)


def test_long_functions_are_cut():
    program = Unfused(Six()).program
    lengths = [len(part.split("\n")) for part in program.javascript.split("\nfunction ")]
    assert len(lengths) > 12 and max(lengths) < 2 * LARGEST
    assert "function move_1(f, a, k)" in program.javascript


def test_names_do_not_meet_when_changed_at_once():
    script = Script()
    with pytest.raises(AssertionError, match="would be overwritten"):
        script.loop(0, 3, [1.0, 2.0], lambda k, carried: carried[::-1])


class Odd(OWN[2]):
    """The place of its arrow is computed by more than arithmetic on the state."""

    id = "OwnOdd-v0"

    def bodies(self):
        return {"arrow": [Circle((0.0, 0.0), 1.0)]}

    def indicators(self, now, xp):
        return {"arrow": (float(now.q.theta), 0.0)}


def test_a_picture_that_cannot_be_printed_is_left_out():
    env = Unfused(Odd())
    env.reset(1)
    env.step([])
    assert env.poses() == [] and env.program.frames == []


@pytest.mark.slow
def test_scripts_do_not_depend_on_the_process():
    code = "from lag_envs.envs.scripted import UnfusedProgram as U; from lag_envs.tasks import TASKS as T;"
    code += "print(*(U(T[id]()).digest for id in sorted(T) if not T[id].imperfections))"
    seen = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed}, stdout=-1, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(seen) == 1
