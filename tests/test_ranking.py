"""Ranks of the leaderboard: scores without luck, their intervals, places and the other columns."""

import itertools
import time

import numpy as np
import pytest

from lag_envs.controllers import make_controller
from lag_envs.evaluation.rollout import play
from lag_envs.evaluation.statistics import RESAMPLES, THRESHOLDS, ends, iqm
from lag_envs.leaderboard.combined import AgentIdentity, AgentScore, combined
from lag_envs.leaderboard.protocol import ReferenceController, reference
from lag_envs.leaderboard.ranking import (
    Scores,
    columns,
    compare,
    corrected,
    policy_error,
    ranked,
    redrawn,
    scored,
)
from lag_envs.scores import known_returns, score
from lag_envs.tasks import TASKS, incline

ENV = incline.Brake.id
KNOWN = known_returns(ENV)


def returns(scores):
    """Return the returns that have these scores."""
    return (KNOWN.random + np.asarray(scores) * (KNOWN.best - KNOWN.random)).tolist()


def table(scores):
    """Return a row's scores, from those of each policy and episode."""
    return Scores(np.atleast_2d(np.asarray(scores, np.float64)))


def board(**rows):
    """Return the places of rows."""
    scores = {id: row if isinstance(row, Scores) else table(row) for id, row in rows.items()}
    return ranked(scores, {id: redrawn(id, each) for id, each in scores.items()})


def policies(*means, episodes=4):
    """Return scores of policies with these means."""
    return [[mean - 0.01, mean + 0.01] * (episodes // 2) for mean in means]


# --- samples ---


def test_intervals_of_two_policies():
    """Two seeds a < b give means a, b and their middle with 1/4, 1/4, 1/2, so the interval is [a, b]."""
    drawn = redrawn("any", table(policies(0.2, 0.4)))
    assert drawn.shape == (RESAMPLES, 2)
    assert ends(iqm(drawn)) == pytest.approx((0.2, 0.4))
    share = np.mean(np.isclose(iqm(drawn), 0.3))
    assert share == pytest.approx(0.5, abs=0.05)
    # Against one that lies in between, all of 0, 1/2 and 1 can occur.
    same = table(policies(0.3, 0.3))
    chance = compare(table(policies(0.2, 0.4)), same, drawn, redrawn("other", same))
    assert chance == (0.5, 0.0, 1.0) and chance.undecided


def test_a_single_policy_is_drawn_anew_by_episodes():
    scores = np.random.default_rng(0).normal(0.8, 0.3, (1, 1000))
    drawn = redrawn("single", table(scores))
    assert drawn.shape == (RESAMPLES, 1)
    low, high = ends(iqm(drawn))
    error = 1.96 * scores.std() / np.sqrt(1000)
    assert (low, high) == pytest.approx((scores.mean() - error, scores.mean() + error), abs=0.15 * error)


# --- ranks ---


def test_clearly_different_rows_have_ranks_of_their_own():
    places = board(
        c=policies(0.1, 0.11, 0.12, 0.13, 0.14),
        a=policies(0.9, 0.91, 0.92, 0.93, 0.94),
        b=policies(0.5, 0.51, 0.52, 0.53, 0.54),
    )
    assert [(p.id, p.rank) for p in places] == [("a", 1), ("b", 2), ("c", 3)]
    assert places[0].above is None
    assert places[1].above == (1.0, 1.0, 1.0)  # each policy of the one above is better than each of this


def test_rows_that_cannot_be_told_apart_share_a_rank_and_the_next_one_counts_them():
    places = board(
        a=policies(0.5, 0.6, 0.7, 0.8, 0.9),
        b=policies(0.48, 0.58, 0.68, 0.78, 0.88),
        c=policies(0.1, 0.1, 0.1, 0.1, 0.1),
    )
    assert [(p.id, p.rank) for p in places] == [("a", 1), ("b", 1), ("c", 3)]
    # 15 of 25 pairs: each policy of a beats those of b at and below its place.
    assert places[1].above.value == pytest.approx(15 / 25) and places[1].above.undecided


def test_none_of_those_that_share_a_rank_is_clearly_better():
    rng = np.random.default_rng(1)
    rows = {f"row{i}": rng.normal(rng.uniform(0, 1), 0.2, (rng.choice([1, 5, 10]), 50)) for i in range(30)}
    places = board(**rows)
    assert sorted(p.id for p in places) == sorted(rows)
    values = [float(iqm(rows[p.id].mean(axis=1))) for p in places]
    assert values == sorted(values, reverse=True)
    drawn = {id: redrawn(id, table(row)) for id, row in rows.items()}

    def undecided(a, b):
        return compare(table(rows[a.id]), table(rows[b.id]), drawn[a.id], drawn[b.id]).undecided

    for number, place in enumerate(places, 1):
        before = [p for p in places[: number - 1] if p.rank == places[number - 2].rank]
        shares = bool(before) and all(undecided(p, place) for p in before)
        assert place.rank == (before[-1].rank if shares else number)
    # Some row shares no rank with the row above, though neither of the two is clearly better.
    assert any(b.rank > a.rank and undecided(a, b) for a, b in itertools.pairwise(places))
    assert 1 < len({p.rank for p in places}) < len(places)


def test_equal_rows_share_a_rank():
    same = np.random.default_rng(2).normal(size=(1, 100))
    assert [p.rank for p in board(a=same, b=same)] == [1, 1]
    assert [p.rank for p in board(a=[[1.0, 1.0]], b=[[1.0, 1.0]])] == [1, 1]


def test_two_controllers_are_told_apart_by_their_episodes():
    rng = np.random.default_rng(3)
    close, far = rng.normal(0.8, 0.3, (1, 1000)), rng.normal(0.7, 0.3, (1, 1000))
    assert [p.rank for p in board(a=close, b=far)] == [1, 2]
    assert [p.rank for p in board(a=close, b=rng.normal(0.8, 0.3, (1, 1000)))] == [1, 1]


def test_numbers_are_the_same_each_time_and_whoever_else_is_there():
    rng = np.random.default_rng(4)
    a, b, c = (rng.normal(m, 0.3, (5, 20)) for m in (0.6, 0.55, 0.5))
    first, second = board(a=a, b=b), board(a=a, b=b, c=c)
    assert first == second[:2]
    np.testing.assert_array_equal(redrawn("a", table(a)), redrawn("a", table(a)))
    assert (redrawn("a", table(a)) != redrawn("b", table(a))).any()


def test_columns_of_a_row():
    rng = np.random.default_rng(5)
    scores = rng.normal(0.8, 0.1, (5, 40))
    results = [
        {
            "seed": seed, "returns": returns(row), "success": [True] * 30 + [False] * 10,
            "settle": [2.0] * 30 + [None] * 10, "effort": [0.25] * 40, "trajectory": "",
        }
        for seed, row in enumerate(scores)
    ]  # fmt: skip
    result = {
        "policies": results,
        "robustness": {"mass +20 %": returns(np.arange(5.0)), "late": [None] * 5},
        "often": returns([0.5] * 5),
    }
    row = columns(ENV, result, 10, KNOWN, table(scores))
    assert row["score"] == pytest.approx(np.sort(scores.mean(axis=1))[1:-1].mean())
    assert row["return"] == pytest.approx(np.mean(returns(scores)))
    assert row["gap"] == pytest.approx(1.0 - scores.mean())
    assert row["success"]["rate"] == 0.75 and row["success"]["low"] < 0.75 < row["success"]["high"]
    assert (row["settle"], row["effort"]) == (2.0, 0.25)
    moved = scores.mean(axis=1) - scores[:, :10].mean(axis=1)
    assert row["robustness"] == {"mass +20 %": pytest.approx(iqm(np.arange(5.0) + moved))}
    assert row["often"] == pytest.approx(iqm(0.5 + moved))
    assert len(row["profile"]) == len(THRESHOLDS)
    # Unmeasured columns are None, as for an agent that cannot act more often.
    never = [policy | {"settle": [None] * 40} for policy in results]
    row = columns(ENV, result | {"policies": never, "often": [None] * 5}, 10, KNOWN, table(scores))
    assert row["settle"] is row["often"] is None


def test_success_is_left_out_where_the_protocol_cannot_count_it():
    policy = {"returns": returns([1.0] * 40), "success": [False] * 40}
    policy |= {"settle": [None] * 40, "effort": [0.0] * 40}
    result = {"policies": [policy], "robustness": {}, "often": [None]}
    for env_id, task in TASKS.items():
        if task.goal:
            row = columns(env_id, result, 10, KNOWN, table([1.0] * 40))
            assert (row["success"] is not None) == task.goal.counted


# --- luck ---


MEAN = ReferenceController("LQR", 452.7, 0.139, 524_288)


def test_luck_is_taken_out():
    luck = np.random.default_rng(0).normal(3.0, 50.0, (2, 4000))

    def policies(returns):
        return [{"returns": r, "reference": MEAN.mean + x} for r, x in zip(returns, luck, strict=True)]

    # One that is half as lucky as the reference, and one that is uncorrelated with it.
    half = policies(400.0 + 0.5 * luck)
    np.testing.assert_allclose(corrected(MEAN, half), 400.0, rtol=1e-12)
    assert policy_error(MEAN, half) == pytest.approx(0.5 * MEAN.error)
    other = np.random.default_rng(1).normal(30.0, 1.0, luck.shape)
    np.testing.assert_allclose(corrected(MEAN, policies(other)).mean(axis=1), other.mean(axis=1), atol=0.1)
    # Without a reference, without its recording, or if it is constant, returns stay.
    assert corrected(MEAN, [{"returns": [1.0, 2.0]}]).tolist() == [[1.0, 2.0]]
    assert corrected(MEAN, [{"returns": [1.0, 2.0], "reference": None}]).tolist() == [[1.0, 2.0]]
    assert corrected(None, policies(other)).tolist() == other.tolist()
    still = [{"returns": [1.0, 2.0], "reference": [MEAN.mean, MEAN.mean]}]
    assert corrected(MEAN, still).tolist() == [[1.0, 2.0]]
    # One episode shows no spread.
    assert policy_error(MEAN, [{"returns": [1.0], "reference": [2.0]}]) is None


class Range:
    random, best = 0.0, 452.7


def test_the_reference_has_its_own_mean_and_the_error_of_that():
    """It corrects itself: its own episodes cancel out, so its interval is that of the others."""
    own = np.random.default_rng(0).normal(440.0, 100.0, 1000)
    scores = scored(Range, MEAN, [{"returns": own, "reference": own}])
    assert scores.own and scores.table.mean() == pytest.approx(MEAN.mean / 452.7)
    low, high = ends(iqm(redrawn("reference", scores)))
    assert (high - low) / 2 == pytest.approx(1.96 * MEAN.error / 452.7, rel=0.05)
    assert (high + low) / 2 == pytest.approx(MEAN.mean / 452.7, abs=2e-5)
    assert not scored(Range, None, [{"returns": own, "reference": own}]).own
    assert not scored(Range, MEAN, [{"returns": own + 0.1 * np.arange(1000), "reference": own}]).own


@pytest.mark.parametrize("policies", [1, 5])
@pytest.mark.parametrize("part", [0.0, 0.5, 1.0, 2.0])
def test_every_interval_holds_the_error_of_the_references_mean(part, policies):
    """In proportion to the row's correction by the reference, for any row."""
    rng = np.random.default_rng(2)
    luck = rng.normal(0.0, 50.0, (policies, 1000))
    noise = rng.normal(0.0, 3.0, (policies, 1000))
    rows = [
        {"returns": 300.0 + part * x + e, "reference": MEAN.mean + x}
        for x, e in zip(luck, noise, strict=True)
    ]
    scores = scored(Range, MEAN, rows)
    assert scores.error == pytest.approx(abs(part) * MEAN.error / 452.7, abs=0.02 * MEAN.error / 452.7)
    alone = scored(Range, MEAN._replace(error=0.0), rows)
    wide, narrow = (np.subtract(*ends(iqm(redrawn("a", each)))) for each in (scores, alone))
    assert wide**2 == pytest.approx(narrow**2 + (2 * 1.96 * scores.error) ** 2, rel=0.15)


def test_the_references_error_moves_all_rows_together():
    """It does not separate two rows with equal corrections; it counts against a row without any."""
    luck = np.random.default_rng(3).normal(0.0, 50.0, 1000)
    far = MEAN._replace(error=5.0)

    def row(mean, part):
        return scored(Range, far, [{"returns": mean + part * luck, "reference": MEAN.mean + luck}])

    assert [p.rank for p in board(a=row(301.0, 1.0), b=row(300.0, 1.0))] == [1, 2]
    assert [p.rank for p in board(a=row(301.0, 1.0), b=row(300.0, 0.0))] == [1, 1]


def test_intervals_of_corrected_rows_cover_the_truth():
    """Over many boards with known truths: of the reference, of one like it, and of a learner."""
    rng, error, inside = np.random.default_rng(4), 4.0, {"reference": 0, "like": 0, "learner": 0}
    rounds = 120
    for k in range(rounds):
        measured = ReferenceController("x", 400.0 + error * rng.normal(), error, 1)  # the truth is 400
        seeds = rng.normal(300.0, 2.0, 10)

        def play(part, means, k=k, measured=measured):
            rows = []
            for mean in means:
                luck = rng.normal(0.0, 60.0, 400)
                rows.append({"returns": mean + part * luck + rng.normal(0.0, 5.0, 400) * (mean < 400.0),
                             "reference": 400.0 + luck})  # fmt: skip
            return ends(iqm(redrawn(f"{k} {part}", scored(Range, measured, rows))))

        for name, found, truth in (
            ("reference", play(1.0, [400.0]), 400.0),
            ("like", play(0.9, [380.0]), 380.0),
            ("learner", play(0.7, seeds), 300.0),
        ):
            inside[name] += found[0] <= truth / 452.7 <= found[1]
    assert all(0.88 <= count / rounds for count in inside.values()), inside


REFERENCES = list(filter(reference, TASKS))


@pytest.mark.parametrize("env_id", REFERENCES)
def test_references_are_controllers_that_are_known_and_help(env_id):
    name, mean, error, episodes = reference(env_id)
    known = known_returns(env_id)
    assert 0.9 < score(env_id, mean) <= 1.003 and episodes >= 65_536
    if known.policy == name:
        assert known.best == pytest.approx(mean, abs=5.0 * error)


@pytest.mark.parametrize(
    "env_id", [pytest.param(i, marks=[] if i == ENV else pytest.mark.slow) for i in REFERENCES]
)
def test_means_of_references_are_those_of_the_controllers(env_id):
    """Not another controller's, and not another's error."""
    name, mean, error, episodes = reference(env_id)
    few = play(env_id, make_controller(env_id, name), range(10**10, 10**10 + 500))
    assert abs(few.mean() - mean) <= 5.0 * few.std() / len(few) ** 0.5
    # A variance has its own error, which is large if a few episodes are far off.
    squares = (few - few.mean()) ** 2
    assert error**2 * episodes == pytest.approx(squares.mean(), abs=5.0 * squares.std() / len(few) ** 0.5)


# --- all boards together ---


def test_combined_scores_by_hand():
    """Clipped to [0, 1], a missing board counts 0, and boards without agents do not count."""
    alice, bob = AgentIdentity("A", ("Alice",)), AgentIdentity("A", ("Bob",))
    steady = np.linspace(0.0, 1.0, 1001)
    boards = {
        "one": {
            alice: AgentScore(1.2, np.full(1001, 1.2), "learned"),
            bob: AgentScore(0.5, steady, "controller"),
        },
        "two": {alice: AgentScore(-3.0, np.full(1001, -3.0), "learned")},
        "three": {bob: AgentScore(0.9, np.full(1001, 0.9), "learned")},
        "none": {},
        "four": {alice: AgentScore(0.95, np.full(1001, 0.95), "learned")},
    }
    first, second = combined(boards)
    assert (first["name"], first["authors"], first["kind"]) == ("A", ["Alice"], "learned")
    assert first["score"] == pytest.approx((1.0 + 0.0 + 0.95) / 4) and first["interval"] == pytest.approx(
        [1.95 / 4, 1.95 / 4]
    )
    assert (first["boards"], first["of"], first["there"]) == (3, 4, pytest.approx(0.65))
    assert first["profile"] == [[0.5, 0.5], [0.9, 0.5], [0.99, 0.25]]
    assert second["score"] == pytest.approx(1.4 / 4) and second["kind"] == "several"
    assert second["interval"] == pytest.approx([0.925 / 4, 1.875 / 4], abs=1e-3)
    assert second["profile"] == [[0.5, 0.5], [0.9, 0.25], [0.99, 0.0]]
    assert combined({"one": {}}) == []


def test_a_full_board_is_ranked_in_seconds():
    rng = np.random.default_rng(9)
    rows = {f"row{i}": rng.normal(i / 60, 0.3, (5 if i % 3 else 1, 1000)) for i in range(60)}
    started = time.perf_counter()
    assert len(board(**rows)) == 60
    assert time.perf_counter() - started < 20.0  # a second or two on an idle machine
