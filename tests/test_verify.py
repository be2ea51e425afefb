"""Verification: recomputed scores, reproducible bits, and the numbers that the board shows."""

import argparse
import gzip
import json
from functools import partial
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from rollouts import one_by_one
from small_submissions import ENV, HUGE, NET, built_in, learned, linear, network

from lag_envs import cli
from lag_envs.errors import UserError
from lag_envs.evaluation.conditions import disturbances
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.results import apart, checked_result, code_digest, compare_results, unpacked
from lag_envs.leaderboard.submission import Refused
from lag_envs.leaderboard.verify import declare_verify, record_again, run_verify, verify
from lag_envs.scores import known_returns
from lag_envs.tasks import TASKS

#: Beyond the mark the plane is tilted back; near it, against the speed.
GAINS = {"gain": np.array([-63.0, -55.5, -43.4, 63.0]), "offset": np.zeros(1)}
ABOUT = {"name": "x", "authors": ["A"], "license": "MIT"}


def feedback(folder):
    return linear(folder, arrays={0: GAINS})


@pytest.fixture(scope="module")
def submission(tmp_path_factory):
    return feedback(tmp_path_factory.mktemp("verify") / "linear")


@pytest.fixture(scope="module")
def result(submission):
    return verify(submission, "nonce", 6)


# --- seeds --------------------------------------------------------------------------------------------------


def test_seeds_follow_from_bytes_and_nonce():
    first = protocol.first_seed("a", "b", 0)
    assert first == protocol.first_seed("a", "b", 0)
    others = [protocol.first_seed(*given) for given in (("b", "b", 0), ("a", "c", 0), ("a", "b", 1))]
    assert len({first, *others}) == 4
    assert all(2**40 <= seed < 2**63 for seed in (first, *others))


# --- measurements -------------------------------------------------------------------------------------------


def test_result_is_of_json_types_and_complete(result, submission):
    again = json.loads(json.dumps(result, allow_nan=False))
    assert again == result
    assert checked_result(result) is result
    assert (result["env"], result["nonce"], result["build"]) == (ENV, "nonce", code_digest())
    assert result["digest"] == submission.digest and result["episodes"] == 6
    (policy,) = result["policies"]
    assert policy["seed"] == 0 and len(policy["trajectory"]) == 64
    assert {len(policy[name]) for name in ("returns", "success", "settle", "effort")} == {6}
    assert set(result["robustness"]) == {condition.name for condition in disturbances(ENV)}
    assert all(len(means) == 1 for means in result["robustness"].values())
    assert len(result["often"]) == 1


def test_numbers_are_those_of_single_episodes(result, submission):
    """Returns, success, time and effort, computed differently from the single environment."""
    agent = submission.policies[0][1].agent()
    policy, env = result["policies"][0], gym.make(ENV)
    first = protocol.first_seed(submission.digest, "nonce", 0)
    for i in range(6):
        observation, _ = env.reset(seed=first + i)
        total, efforts, near, over = 0.0, [], [], False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(agent.predict(observation)[0])
            total += reward
            efforts.append((env.unwrapped.control / 0.3) ** 2)
            near.append(abs(env.unwrapped.state[0] - env.unwrapped.target) <= 0.05)
            over = terminated or truncated
        assert policy["returns"][i] == total
        assert policy["effort"][i] == pytest.approx(np.mean(efforts), rel=1e-12)
        outside = np.flatnonzero(~np.array(near))
        settled = (outside[-1] + 1 if len(outside) else 0) * 0.05
        success = not terminated and settled <= 9.0
        assert policy["success"][i] == success
        assert policy["settle"][i] == (
            pytest.approx(settled + 0.05 * bool(len(outside))) if success else None
        )
    assert any(policy["success"])


def test_same_bits_again_and_others_with_another_nonce(result, submission):
    again, other = verify(submission, "nonce", 6), verify(submission, "other", 6)
    for name in ("policies", "robustness", "often"):
        assert again[name] == result[name]
        assert other[name] != result[name]


WAY = known_returns(ENV).best - known_returns(ENV).random


def test_results_are_compared(result):
    other = json.loads(json.dumps(result))
    assert compare_results(result, other, WAY) == (True, True, 0.0, [])
    with pytest.raises(ValueError, match="differ in nonce: 'nonce' and 'x'"):
        compare_results(result, other | {"nonce": "x"}, WAY)
    with pytest.raises(ValueError, match="differ in their conditions"):
        compare_results(result, other | {"robustness": {}}, WAY)


@pytest.mark.parametrize("changed", [{"build": "0" * 64}, {"versions": {}}, {"machine": {}}, {"build": None}])
def test_bits_count_on_the_same_build_only(result, changed):
    other = json.loads(json.dumps(result))
    other["policies"][0]["trajectory"] = "0" * 64
    other["policies"][0]["returns"] = [r + 4e-4 * WAY for r in other["policies"][0]["returns"]]
    found = compare_results(result, other, WAY)
    assert not found.same and found.build and found.far == ["the bits, though both are of the same build"]
    found = compare_results(result, other | changed, WAY)
    assert not found.same and not found.build and found.far == []
    assert found.difference == pytest.approx(4e-4)


def spoil(result, name, value, episode=None):
    """Return a result of another build with one thing changed."""
    other = json.loads(json.dumps(result)) | {"build": None}
    if episode is None:
        other[name] = value
    else:
        other["policies"][0][name][episode] = value
    return other


@pytest.mark.parametrize(
    ("name", "value", "episode", "told"),
    [
        ("returns", 1e3, 2, "mean returns by"),
        ("returns", -50.0, 3, "the returns of 16.7%"),
        ("success", None, 1, "the successes of 16.7%"),
        ("settle", 123.0, 0, "the times of 16.7%"),
        ("effort", 0.9, 5, "the efforts of 16.7%"),
        ("reference", 1.0, 4, "the reference's returns of 16.7%"),
        ("often", [0.0], None, "the means under acting often"),
    ],
)
def test_whatever_is_another_is_found_on_any_build(result, name, value, episode, told):
    if value is None:
        value = not result["policies"][0][name][episode]
    other = spoil(result, name, value, episode)
    assert any(what.startswith(told) for what in compare_results(result, other, WAY).far)


def test_a_condition_that_is_another_is_found(result):
    name = next(iter(result["robustness"]))
    other = spoil(result, "robustness", result["robustness"] | {name: [0.0]})
    assert compare_results(result, other, WAY).far == [f"the means under {name}"]


def test_one_episode_of_many_may_go_another_way(result):
    """As may happen if rounding decides; but not for two, and not so that it shows in the score."""
    many = json.loads(json.dumps(result)) | {"episodes": 1000, "build": None}
    for name in ("returns", "success", "settle", "effort", "reference"):
        many["policies"][0][name] = (many["policies"][0][name] * 200)[:1000]
    other = json.loads(json.dumps(many))
    for i in range(10):
        other["policies"][0]["returns"][i] += (-1) ** i * 0.5 * WAY
    assert compare_results(many, other, WAY).far == []
    other["policies"][0]["returns"][10:12] = [r + 0.1 * WAY for r in other["policies"][0]["returns"][10:12]]
    assert compare_results(many, other, WAY).far == ["the returns of 1.2% of the episodes of seed 0"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda r: r.update(extra=1),
        lambda r: r.pop("often"),
        lambda r: r.update(episodes="6"),
        lambda r: r.update(episodes=7),
        lambda r: r.update(policies=[]),
        lambda r: r["policies"][0]["returns"].pop(),
        lambda r: r["policies"][0]["returns"].__setitem__(0, None),
        lambda r: r["policies"][0]["success"].__setitem__(0, 1),
        lambda r: r["policies"][0].update(trajectory="x"),
        lambda r: r["robustness"].update(more=[]),
        lambda r: r.update(replays=[{}]),
        lambda r: r.update(digest="<b>"),
        lambda r: r.update(seconds=float("nan")),
    ],
)
def test_results_have_a_schema(result, spoil):
    other = json.loads(json.dumps(result))
    spoil(other)
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        checked_result(other)


def test_a_result_is_not_unpacked_for_ever(monkeypatch):
    monkeypatch.setattr("lag_envs.leaderboard.results.UNPACKED", 1000)
    with pytest.raises(ValueError, match="it unpacks to more than 1,000 bytes"):
        unpacked(gzip.compress(b" " * 1000 + b"{}"))
    for content in (b"", b"PK", gzip.compress(b"{}")[:-4], gzip.compress(b"{}")[:12] + b"\xff" * 9):
        with pytest.raises(ValueError, match=r"it cannot be unpacked|Expecting value"):
            unpacked(content)


@pytest.mark.parametrize("make", [learned, partial(built_in, name="random"), partial(built_in, name="PD")])
def test_replays_are_of_the_verified_episodes(tmp_path, make):
    """To the bit, even if a policy draws its actions for all episodes together."""
    made = make(tmp_path / "a")
    few = verify(made, "n", 5)
    for policy in (0, len(made.policies) - 1):
        told, episodes = record_again(made, few, policy, [3, 0])
        verified = few["policies"][policy]
        for name in ("returns", "success", "settle", "effort", "reference"):
            assert told[name] == [verified[name][3], verified[name][0]]
        for i, found in zip((3, 0), episodes, strict=True):
            seed = protocol.first_seed(made.digest, "n", policy) + i
            assert found["return"] == verified["returns"][i]
            assert found["seed"] == policy and found["reset_seed"] == seed and found["dt"] == 0.05
            steps = len(found["actions"])
            assert len(found["states"]) == steps + 1 == len(found["rewards"]) + 1
            assert sum(found["rewards"]) == pytest.approx(found["return"], abs=1e-4)
            assert abs(found["target"]) <= 0.3
            json.dumps(found, allow_nan=False)


def test_disturbances_and_acting_often_are_what_they_say(result, submission):
    agent = submission.policies[0][1].agent()
    first = protocol.first_seed(submission.digest, "nonce", 0)
    for options, found in (
        ({"mass": 1.2}, result["robustness"]["mass +20 %"]),
        ({"gravity": 0.8 * 9.81}, result["robustness"]["gravity -20 %"]),
        ({"dt": 0.005}, result["often"]),
    ):
        returns = one_by_one(ENV, agent, range(first, first + 6), **options)
        assert found == [pytest.approx(returns.mean(), rel=1e-12)]


def test_progress_reaches_its_end(submission):
    calls = []
    verify(submission, "", 1, lambda done, work: calls.append((done, work)))
    done, work = zip(*calls, strict=True)
    assert len(set(work)) == 1 and done[-1] == work[0]
    assert all(b >= a for a, b in pairwise(done))


def test_every_board_has_a_goal():
    assert protocol.boards() == [env for env, task in TASKS.items() if task.goal]
    for env in protocol.boards():
        task = TASKS[env]()
        states = np.array([task.centre, np.array(task.centre) + 0.9 * np.array(task.half_widths)])
        inside = task.goal_holds(states)
        assert inside.shape == (2,) and inside.dtype == np.bool_


# --- policies that misbehave --------------------------------------------------------------------------------


def test_network_that_overflows_is_refused(tmp_path):
    made = network(tmp_path / "a", NET | {"activation": "relu"}, HUGE)
    reason = r"policy of seed \d: it returned an action that is not a finite number"
    with pytest.raises(Refused, match=reason):
        verify(made, "", 2)


def test_controller_that_fails_on_the_way_is_refused(tmp_path, monkeypatch):
    made = built_in(tmp_path / "a")

    def predict(*args, **kwargs):
        raise ZeroDivisionError("\x1b[31mno")

    monkeypatch.setattr("lag_envs.controllers.PD.predict", predict)
    with pytest.raises(Refused, match="it fails with 'ZeroDivisionError") as caught:
        verify(made, "", 2)
    assert str(caught.value).isprintable()


def test_random_controller_draws_the_same_numbers_again(tmp_path):
    made = built_in(tmp_path / "a", name="random")
    assert verify(made, "", 2)["policies"] == verify(made, "", 2)["policies"]


@pytest.mark.slow
def test_planner_can_be_verified_but_not_act_often(tmp_path):
    result = verify(built_in(tmp_path / "a", name="iLQR"), "", 2)
    assert result["often"] == [None] and min(result["policies"][0]["returns"]) > 150.0


@pytest.mark.parametrize("episodes", [0, -1, 100_001])
def test_number_of_episodes_is_checked(submission, episodes):
    with pytest.raises(ValueError, match="episodes must lie between"):
        verify(submission, "", episodes)


# --- the command --------------------------------------------------------------------------------------------


def command(*arguments):
    parser = argparse.ArgumentParser()
    declare_verify(parser)
    return run_verify(parser.parse_args([str(a) for a in arguments]))


@pytest.mark.parametrize("end", [KeyboardInterrupt, MemoryError])
def test_what_ends_the_command_leaves_the_results_so_far(end, tmp_path, capsys, monkeypatch):
    def some(folders, args):
        yield folders[1], {"refused": "why"}
        raise end

    monkeypatch.setattr("lag_envs.leaderboard.verify._results", some)
    with pytest.raises(end):
        command("a b", "c", "d", "--json", tmp_path / "out.json")
    assert json.loads((tmp_path / "out.json").read_text()) == [{"folder": "c", "refused": "why"}]
    told = capsys.readouterr()
    assert told.out == "c: refused: why\n"
    left = "interrupted; left to verify, with another --json: 'a b' d\n"
    assert told.err == (left if end is KeyboardInterrupt else "")


def test_command_tells_results_and_refusals(tmp_path, capsys, result):
    feedback(tmp_path / "good")
    feedback(tmp_path / "bad")
    (tmp_path / "bad" / "run.py").write_text("")
    out = tmp_path / "out.json"
    folders = [tmp_path / "good", tmp_path / "bad"]
    assert command(*folders, "--nonce", "nonce", "--episodes", 6, "--json", out) == 1
    text = capsys.readouterr().out
    assert "worst disturbance" in text and "acting ten times as often" in text
    assert "bad: refused: unknown file 'run.py'" in text
    good, bad = json.loads(out.read_text())
    assert good["policies"] == result["policies"] and good["folder"] == str(folders[0])
    assert bad == {"folder": str(folders[1]), "refused": bad["refused"]}

    again = [folders[0], "--nonce", "nonce", "--episodes", 6, "--against", out]
    assert command(*again) == 0
    assert "the same, to the bit" in capsys.readouterr().out
    good["policies"][0]["trajectory"] = "0" * 64
    good["policies"][0]["returns"] = [r + 0.1 for r in good["policies"][0]["returns"]]
    out.write_text(json.dumps([good]))
    assert command(*again) == 1
    assert "differs too much in the bits, though both are of the same build" in capsys.readouterr().out
    good["build"] = None
    out.write_text(json.dumps([good]))
    assert command(*again) == 0
    assert "scores differ by" in capsys.readouterr().out
    good["policies"][0]["returns"][0] += 100.0
    out.write_text(json.dumps([good]))
    assert command(*again) == 1
    assert "differs too much in mean returns by" in capsys.readouterr().out


def test_command_compares_only_what_can_be_compared(tmp_path, capsys, monkeypatch, submission, result):
    """Whatever cannot be is told before anything is computed."""
    monkeypatch.setattr("lag_envs.leaderboard.verify.verify", None)
    before = tmp_path / "before.json"
    given = [submission.folder, "--nonce", "nonce", "--episodes", 6, "--against", before]

    def known(**changed):
        before.write_text(json.dumps([result | changed]))

    known(digest="0" * 64)
    assert command(*given) == 1
    assert f"{before} has no result of it (digest {submission.digest})" in capsys.readouterr().err
    known()
    with pytest.raises(UserError, match="with --episodes 6, not 7; only the same episodes"):
        command(*given, "--episodes", 7)
    with pytest.raises(UserError, match="with --nonce 'nonce', not 'x'"):
        command(*given, "--nonce", "x")
    known(robustness={})
    with pytest.raises(UserError, match="under other conditions"):
        command(*given)


@pytest.mark.parametrize(
    "content", ["", "{}", "[1]", '[{"digest": 1}]', '[{"digest": "x", "policies": 5}]', "[" * 10**5]
)
def test_command_refuses_what_are_no_results(tmp_path, content):
    (tmp_path / "before.json").write_text(content)
    with pytest.raises(UserError, match=r"before\.json cannot be read"):
        command(tmp_path, "--against", tmp_path / "before.json")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--episodes", 0], "--episodes must lie"),
        (["--jobs", 0], "--jobs must be at least 1"),
    ],
)
def test_command_refuses(tmp_path, arguments, reason):
    with pytest.raises(UserError, match=reason):
        command(tmp_path, *arguments)


def test_command_refuses_a_file_that_cannot_be_written(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command(tmp_path, "--json", tmp_path)
    assert f"argument --json: {tmp_path} is a folder" in capsys.readouterr().err


@pytest.mark.slow
def test_processes_give_the_same(tmp_path, result):
    for name in ("a", "b"):
        feedback(tmp_path / name)
    out = tmp_path / "out.json"
    assert command(tmp_path / "a", tmp_path / "b", "--jobs", 2, "--nonce", "nonce", "--episodes", 6,
                   "--json", out) == 0  # fmt: skip
    assert [r["policies"] for r in json.loads(out.read_text())] == [result["policies"]] * 2


def test_command_of_the_package(tmp_path, capsys):
    feedback(tmp_path / "a")
    assert cli.main(["verify", str(tmp_path / "a"), "--episodes", "1"]) == 0
    assert "1 episodes each" in capsys.readouterr().out


def test_verification_has_a_limit_of_time(submission, monkeypatch):
    monkeypatch.setattr(protocol, "CPU_SECONDS", 0.0)
    with pytest.raises(Refused, match="takes more than 0 s of CPU time"):
        verify(submission, "n", 5)


def test_names_of_folders_do_nothing_to_a_terminal(tmp_path, capsys):
    folder = tmp_path / "evil\x1b[2J"
    folder.mkdir()
    assert command(folder) == 1
    out = capsys.readouterr().out
    assert "\x1b" not in out and "evil\\x1b[2J: refused: " in out


def test_another_plan_as_good_is_no_difference():
    """For a planner, the means of efforts and times count; for others, each episode's."""
    n = 1000
    kept = {
        "returns": [100.0] * n, "reference": None, "success": [True] * n,
        "settle": [2.0, None] * (n // 2), "effort": [0.1, 0.3] * (n // 2),
    }  # fmt: skip
    other = kept | {"effort": [0.3, 0.1] * (n // 2), "settle": [2.2, None, 1.8, None] * (n // 4)}
    assert set(apart(kept, other, 100.0, plans=True).values()) == {0.0}
    assert apart(kept, other, 100.0)["efforts"] == 1.0
    assert apart(kept, other, 100.0)["times"] == 0.5
    worse = kept | {"effort": [0.2, 0.4] * (n // 2), "settle": [2.2, None] * (n // 2)}
    found = apart(kept, worse, 100.0, plans=True)
    assert (found["efforts"], found["times"], found["returns"]) == (1.0, 1.0, 0.0)
