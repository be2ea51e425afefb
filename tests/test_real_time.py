"""Plans made ahead of what is done, in a process of their own."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from covering import every

from agents import real_time, report
from lag_envs.controllers import build, controllers
from lag_envs.controllers.basic import ObservationDecoder
from lag_envs.controllers.mpc import MPC, without_kicks
from lag_envs.envs.model import Model
from lag_envs.tasks import TASKS, chain, pivoted_bar
from lag_envs.tasks.cart_pole import CartPoleSwingUp
from lag_envs.tasks.registration import make_task
from lag_envs.workers import Elsewhere

HURRIED = [
    (env_id, name)
    for env_id, task in TASKS.items()
    for name, one in controllers(task).items()
    if one.real_time
]


def quick(**numbers):
    """Return a cheap planner, and a model of its task without kicks."""
    task = pivoted_bar.Balance()
    return MPC(task, **{"horizon": 12, "iterations": 1, "guesses": 2, "budget": 300} | numbers), Model(
        without_kicks(task)
    )


def walk(agent, model, states, steps, restart=None):
    """Return actions, states and the last memory; all episodes but the first may restart once."""
    read, memory, taken, seen = ObservationDecoder(model.task), None, [], []
    for k in range(steps):
        start = np.full(len(states), k == 0)
        if k == restart:
            states, start = np.concatenate([states[:1], -states[1:]]), np.arange(len(states)) > 0
        actions, memory = agent.predict(read.expected(states)[0].astype(np.float32), memory, start)
        taken.append(actions)
        seen.append(states)
        states = model(states, actions[:, 0])[0]
    return np.array(taken), np.array(seen), memory


STARTS = np.array([[0.0, 0.1, math.pi + 0.05, 0.0], [0.02, 0.0, math.pi - 0.04, 0.1]])


def test_a_plan_made_ahead_begins_where_the_episode_then_is():
    agent, model = quick(ahead=3, every=2)
    # After two steps a renewal begins, and three steps later it is followed.
    for calls, steps_of_plan in ((5, 5), (6, 1)):
        _, seen, memory = walk(agent, model, STARTS, calls)
        assert (memory.step == steps_of_plan).all()
        assert np.abs(memory.states[:, 0] - seen[calls - steps_of_plan]).max() < 1e-5


def test_plans_of_another_process_are_the_same():
    agents = [quick(ahead=2, background=background)[0] for background in (False, True)]
    model = quick()[1]
    here, there = (walk(agent, model, STARTS, 9, restart=4)[0] for agent in agents)
    assert (here == there).all()
    assert not (here == walk(quick()[0], model, STARTS, 9, restart=4)[0]).all()


@pytest.mark.slow
def test_each_episode_waits_for_its_own_plan():
    """The other one restarts while its next plan is in the making."""
    task = chain.SwingUp()
    starts = np.array([task.centre, np.add(task.centre, 0.02)])
    together, alone = (
        walk(build(task, "MPC", ahead=3), Model(task), starts[:n], 8, restart=2)[0] for n in (2, 1)
    )
    assert (together[:, :1] == alone).all()


@pytest.mark.parametrize(("env_id", "name"), every(6, HURRIED))
def test_records_tell_how_to_plan_in_real_time(env_id, name):
    task = make_task(env_id)
    agent = build(task, name, real_time=True, background=False)
    agent = getattr(agent, "controller", agent)
    assert agent.ahead == controllers(task)[name].real_time["ahead"]
    assert agent.every + agent.ahead * agent.finer <= agent.over


def test_controllers_that_do_not_plan_are_the_same_in_real_time():
    task = make_task("PivotedBar-v0")
    assert vars(build(task, "zero", real_time=True)) == vars(build(task, "zero"))


def test_mistakes():
    task = chain.Balance()
    with pytest.raises(ValueError, match="ahead must be a whole number of at least 0, got -1"):
        MPC(task, ahead=-1)
    with pytest.raises(ValueError, match="background=True needs `ahead`"):
        MPC(task, background=True)


class Fails:
    """Something whose process dies."""

    def leave(self):
        import os

        os._exit(3)

    def double(self, x):
        return 2 * x


def test_an_object_elsewhere():
    there = Elsewhere(Fails())
    assert there.call("double", 4).result() == 8
    with pytest.raises(AttributeError, match="halve"):
        there.call("halve", 4).result()
    with pytest.raises(RuntimeError, match="terminated abruptly"):
        there.call("leave").result()


def test_a_process_needs_a_file_that_can_be_imported(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("from lag_envs.workers import Elsewhere\nElsewhere(1)\n")
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert ended.returncode == 1 and "no process could be started: save the script" in ended.stderr


@pytest.mark.slow
def test_calls_by_the_clock(tmp_path, capsys, monkeypatch):
    output, env_id = tmp_path / "found.json", CartPoleSwingUp.id
    assert real_time.main([env_id, "--clocked", "1", "--episodes", "2", "--output", str(output)]) == 0
    assert f"{env_id} MPC: interval 20 ms, median" in capsys.readouterr().out
    row = json.loads(output.read_text())["envs"][env_id]["MPC"]
    assert row["allowed"] == 0.04 and row["calls"] == 500 and 0.0 < row["median"] <= row["longest"]
    monkeypatch.setattr(report, "REAL_TIME", output)
    (text,) = report._real_time(env_id)
    assert "exceeded the interval of 20 ms" in text and "are made 40 ms ahead" in text
    assert report._real_time(pivoted_bar.Balance.id) == []


def test_numbers_of_episodes_are_checked(capsys):
    for option, least in (("--clocked", 1), ("--episodes", 2)):
        assert real_time.main([option, "0"]) == 2
        assert f"{option} must lie between {least} and 2147483647, got 0" in capsys.readouterr().err
