"""Policies that act alike, however they are disguised, and those that do not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_submissions import (
    ABOUT,
    FEEDBACK,
    GRID,
    HUGE,
    LINEAR,
    NET,
    TABLE,
    TRAINING,
    built_in,
    learned,
    linear,
    net,
)

from lag_envs.leaderboard import alike
from lag_envs.leaderboard.alike import Likeness, check_twins
from lag_envs.leaderboard.board import Board, others
from lag_envs.leaderboard.pending import Neighbours, finish
from lag_envs.leaderboard.ranking import policy_error
from lag_envs.leaderboard.standings import board_data
from lag_envs.leaderboard.submission import Refused, load, write
from lag_envs.tasks import incline

ROOT = Path(__file__).parents[1]
BOARD = Board(ROOT / "leaderboard")


# --- disguises of a copy ------------------------------------------------------------------------------------


def layers(arrays):
    return range(sum(name.startswith("weight_") for name in arrays))


def noisy(arrays, rng, size, relative=False):
    """Change every number of a network except its observation statistics."""
    return {
        name: array if name.startswith("obs_") else array + size * rng.normal(size=array.shape)
        * (np.abs(array) if relative else 1.0)
        for name, array in arrays.items()
    }  # fmt: skip


def permuted(arrays, rng):
    """Permute the hidden units."""
    found = dict(arrays)
    for k in [*layers(arrays)][:-1]:
        order = rng.permutation(len(found[f"bias_{k}"]))
        found[f"weight_{k}"], found[f"bias_{k}"] = found[f"weight_{k}"][order], found[f"bias_{k}"][order]
        found[f"weight_{k + 1}"] = found[f"weight_{k + 1}"][:, order]
    return found


def rescaled(arrays, rng):
    """Scale the outputs of hidden units with ReLU, and undo it in the next layer."""
    found = dict(arrays)
    for k in [*layers(arrays)][:-1]:
        factor = np.exp(rng.normal(size=len(found[f"bias_{k}"])))
        found[f"weight_{k}"] = found[f"weight_{k}"] * factor[:, None]
        found[f"bias_{k}"] = found[f"bias_{k}"] * factor
        found[f"weight_{k + 1}"] = found[f"weight_{k + 1}"] / factor
    return found


def mirrored(arrays, rng):
    """Change the signs of hidden units with tanh."""
    found = dict(arrays)
    for k in [*layers(arrays)][:-1]:
        sign = rng.choice([-1.0, 1.0], len(found[f"bias_{k}"]))
        found[f"weight_{k}"], found[f"bias_{k}"] = (
            found[f"weight_{k}"] * sign[:, None],
            found[f"bias_{k}"] * sign,
        )
        found[f"weight_{k + 1}"] = found[f"weight_{k + 1}"] * sign
    return found


def an_ulp(arrays, rng):
    """Change one number by as little as possible."""
    found = {name: array.astype(np.float32) for name, array in arrays.items()}
    found["weight_0"][0, 0] = np.nextafter(found["weight_0"][0, 0], np.float32(np.inf))
    return found


CHANGES = {
    "an ulp": an_ulp,
    "noise of 1e-6": lambda arrays, rng: noisy(arrays, rng, 1e-6),
    "noise of 1e-5": lambda arrays, rng: noisy(arrays, rng, 1e-5),
    "noise of 1e-4": lambda arrays, rng: noisy(arrays, rng, 1e-4),
    "relative noise of 1e-4": lambda arrays, rng: noisy(arrays, rng, 1e-4, relative=True),
    "permuted": permuted,
    "permuted, with noise": lambda arrays, rng: noisy(permuted(arrays, rng), rng, 1e-5),
}


def changes_of(submission):
    activation = submission.architecture.activation
    more = {"relu": {"rescaled": rescaled}, "tanh": {"mirrored": mirrored}}
    return CHANGES | more.get(activation, {})


def table_of(submission):
    """Return the table [policy] of a network."""
    about = submission.architecture
    hidden = [len(submission.policies[0][1].arrays[f"bias_{k}"]) for k in range(about.layers - 1)]
    table = {"architecture": "mlp", "hidden": hidden, "activation": about.activation}
    table |= {"bins": about.bins} if about.bins else {"squash": about.squash}
    table |= {"mean_limit": about.mean_limit} if about.mean_limit else {}
    if about.normalise:
        table["normalise"] = about.normalise.model_dump()
    return table


def changed(submission, change, folder):
    """Write a submission in which every policy was changed."""
    rng = np.random.default_rng(0)
    arrays = {s: change(policy.arrays, rng) for s, policy in submission.policies}
    given = ABOUT | {"env": submission.env, "policy": table_of(submission), "training": TRAINING}
    return write(folder, **given, arrays=arrays)


# --- our own ------------------------------------------------------------------------------------------------


def own_entries():
    """Return the ids of learners' submissions on the repository's board."""
    return sorted(entry.id for entry in BOARD.read().all if entry.kind == "learned" and entry.protocol == 1)


def error_of(id):
    """Return the standard error of a policy's mean return on the repository's board."""
    state = BOARD.read()
    entry = state.boards[1][id]
    reference = state.protocols[1].references.get(entry.env)
    return policy_error(reference, BOARD.result(entry)["policies"])


QUICK = f"{incline.Brake.id}-ppo"


@pytest.mark.parametrize(
    "id", [pytest.param(i, marks=[] if i.startswith(QUICK) else pytest.mark.slow) for i in own_entries()]
)
def test_a_changed_copy_of_a_learner_is_found(id, tmp_path):
    """Those that are most sensitive to noise are among the quick ones."""
    first = load(BOARD.submission(id))
    likeness, error = Likeness(first.env, "a nonce"), error_of(id)
    for name, change in changes_of(first).items():
        copy = changed(first, change, tmp_path / name)
        assert copy.digest != first.digest
        found = likeness(copy, first, error)
        assert found.closeness < 0.75, (name, found)
    # A visibly changed one counts as different.
    far = likeness(changed(first, lambda a, rng: noisy(a, rng, 0.2), tmp_path / "far"), first, error)
    assert far.closeness > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("env", sorted({entry.env for entry in BOARD.read().all}))
@pytest.mark.parametrize("nonce", ["one", "another"])
def test_own_entries_are_all_different(env, nonce):
    """And not just barely."""
    state = BOARD.read()
    neighbours = Neighbours(BOARD)
    for a in state.boards[1].values():
        if a.env == env:
            result = BOARD.result(a) | {"nonce": nonce}
            for b in others(state, a):
                if b.line < a.line:
                    assert neighbours.alike(a, result, b) is None, (a.id, b.id)


def test_trainings_are_different_though_all_else_is_the_same():
    """The closest two policies of our own are among these."""
    submission = load(BOARD.submission(next(i for i in own_entries() if i.startswith(QUICK[0]))))
    check_twins(submission, "a nonce")
    tracks = Likeness(submission.env, "a nonce").tracks(submission)
    error = error_of(next(i for i in own_entries() if i.startswith(QUICK[0])))
    found = [alike.distance(a, b, error) for i, a in enumerate(tracks) for b in tracks[:i]]
    assert min(distance.closeness for distance in found) > 1.2


# --- by hand ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_at_least_half_of_the_policies(tmp_path):
    first = learned(tmp_path / "first")
    likeness = Likeness(first.env, "n")
    for copied, near in ((2, False), (3, True), (5, True)):
        arrays = {s: noisy(net(s), np.random.default_rng(s), 1e-6) for s in range(copied)}
        # The others do nearly nothing, which the first ones don't.
        arrays |= {s: noisy(net(s), np.random.default_rng(s), 0.0) | {"weight_1": np.zeros((1, 3)),
                   "bias_1": np.full(1, 0.1 * s)} for s in range(copied, 5)}  # fmt: skip
        newer = learned(tmp_path / f"{copied}", arrays=arrays)
        assert (likeness(newer, first, 1e-9).closeness < 1.0) == near
    more = learned(tmp_path / "more", arrays={s: net(s) for s in range(10)})  # half of them are new
    assert likeness(more, first, 1e-9).closeness < 1.0
    assert likeness(first, more, 1e-9).closeness < 1.0


@pytest.mark.slow
def test_other_architectures_may_act_alike(tmp_path):
    """Only the actions count."""
    plain = linear(tmp_path / "linear", arrays={0: LINEAR | {"gain": np.array([-0.5, -0.2, -0.3, 0.4])}})
    arrays = {"weight_0": np.array([[-0.5, -0.2, -0.3, 0.4]]), "bias_0": np.zeros(1)}
    nets = {s: arrays | {"bias_0": np.full(1, 3e-3 * s)} for s in range(5)}
    network = learned(tmp_path / "net", policy=NET | {"hidden": []}, arrays=nets)
    likeness = Likeness(plain.env, "n")
    assert likeness(network, plain, 1e-9).actions == pytest.approx(0.006, rel=0.01)  # the middle one
    assert likeness(plain, network, 1e-9).actions < 1e-7  # the nearest
    assert likeness(built_in(tmp_path / "pd"), plain, 1e-9).closeness > 1.0


def test_agents_with_a_memory(tmp_path):
    axes = {"axes": ["x", "time"]}
    times = GRID | {
        "axis_1": np.array([0.0, 5.0, 10.0]),
        "table": np.array([[0.3, 0.0, -0.3], [-0.3, 0.0, 0.3]]),
    }
    first = linear(tmp_path / "first", policy=TABLE | axes, arrays={0: times})
    copy = linear(
        tmp_path / "copy", policy=TABLE | axes, arrays={0: times | {"table": times["table"] + 1e-5}}
    )
    later = linear(
        tmp_path / "later", policy=TABLE | axes, arrays={0: times | {"axis_1": times["axis_1"] + 2.0}}
    )
    likeness = Likeness(first.env, "n")
    assert likeness(copy, first, 1e-9).actions == pytest.approx(1e-5, rel=0.01)
    assert likeness(later, first, 1e-9).actions > 0.01


def test_returns_count_too(tmp_path):
    """Actions differ, but it makes no difference."""
    first = linear(tmp_path / "first")
    other = linear(tmp_path / "other", arrays={0: LINEAR | {"offset": np.full(1, 0.02)}})
    likeness = Likeness(first.env, "n")
    found = likeness(other, first, 1e-6)
    assert found.actions > alike.ACTIONS and found.closeness > 1.0
    assert likeness(other, first, 1e6).closeness < 1.0


def test_equal_returns_tell_nothing_where_all_are_equal(monkeypatch, tmp_path):
    """As those of two policies that both hold a pole for the whole episode, each in its own way."""
    first = linear(tmp_path / "first")
    other = linear(tmp_path / "other", arrays={0: LINEAR | {"offset": np.full(1, 0.02)}})
    same = linear(tmp_path / "same", arrays={0: LINEAR | {"offset": np.full(1, 1e-6)}})
    plain = alike.track
    monkeypatch.setattr(alike, "track", lambda *given: replace(plain(*given), returns=np.full(16, 500.0)))
    likeness = Likeness(first.env, "n")
    assert likeness(other, first, 1e6).closeness > 1.0
    assert likeness(same, first, 1e6).closeness < 1.0


def test_a_policy_that_fails_acts_like_no_other(tmp_path):
    arrays = {s: HUGE | {"bias_1": np.full(1, float(s))} for s in range(5)}
    failing = learned(tmp_path / "failing", policy=NET | {"activation": "relu"}, arrays=arrays)
    first = learned(tmp_path / "first")
    assert Likeness(first.env, "n")(failing, first, 1.0) == alike.FAR
    assert Likeness(first.env, "n")(first, failing, 1.0) == alike.FAR


@pytest.mark.parametrize("size", [1e-6, 1e-5, 1e-4])
def test_five_trainings_are_five(tmp_path, size):
    rng = np.random.default_rng(0)
    submission = learned(tmp_path / "a", arrays={s: noisy(net(0), rng, size) for s in range(5)})
    with pytest.raises(
        Refused, match=r"seeds 0 and 1 act the same: their actions differ by .*its own training"
    ):
        check_twins(submission, "n")
    feedbacks = {s: noisy(LINEAR, rng, size) for s in range(5)}
    with pytest.raises(Refused, match="act the same"):
        check_twins(learned(tmp_path / "b", policy=FEEDBACK, arrays=feedbacks), "n")
    check_twins(learned(tmp_path / "c"), "n")
    check_twins(linear(tmp_path / "d"), "n")


def test_on_a_board(tmp_path):
    """From adding to the ranking, with real submissions."""
    board = Board(tmp_path / "board")
    policy = {"architecture": "linear"}
    gains = {"A": 1.0, "B": 1.0 + 1e-6, "C": 0.5}
    for name, factor in gains.items():
        about = ABOUT | {"env": incline.Brake.id, "name": name, "authors": [name]}
        arrays = {"gain": factor * np.array([-1.0, 2.0]), "offset": np.full(1, -0.4)}
        board.add(write(tmp_path / name, **about, policy=policy, arrays={0: arrays}))
    board.publish("n")
    assert finish(board) == 0
    found = next(e for e in board_data(board)["environments"] if e["id"] == incline.Brake.id)
    rows = {row["name"]: row for row in found["rows"]}
    assert rows["B"]["rank"] is None and rows["B"]["alike"]["name"] == "A"
    assert {rows["A"]["rank"], rows["C"]["rank"]} == {1, 2}
    assert board.read().entry(rows["B"]["id"]).alike[0].actions < 1e-5
