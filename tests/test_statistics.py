"""Statistics of returns: by hand, against rliable, and the coverage of intervals."""

import warnings
from functools import partial

import numpy as np
import pytest

from lag_envs.evaluation.statistics import (
    RESAMPLES,
    THRESHOLDS,
    ends,
    estimate,
    improvement,
    interval,
    iqm,
    luck_of,
    mean_and_error,
    median_time,
    optimality_gap,
    pooled_iqm,
    profile,
    redraw,
    rounded_data,
    wilson,
    without_luck,
)
from lag_envs.scores import known_returns, normalised


def rliable(part):
    """Return a part of rliable; only its metrics can be imported beside every pandas."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return pytest.importorskip(f"rliable.{part}")
        except TypeError as error:
            pytest.skip(f"rliable.{part} does not import here: {error}")


# --- by hand ---


def test_scale_is_that_of_the_scores():
    known = known_returns("PivotedBar-v0")
    middle = 0.5 * (known.random + known.best)
    assert normalised(known, [known.random, known.best]).tolist() == [0.0, 1.0]
    assert normalised(known, [[middle]]) == pytest.approx(np.array([[0.5]]))


def test_interquartile_mean():
    assert iqm([0.0, 1.0, 2.0, 3.0, 100.0]) == 2.0  # five seeds: the middle three
    assert iqm([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 70.0]) == np.mean([2.0, 3.0, 4.0, 5.0])
    assert iqm([3.0]) == 3.0 and iqm([0.0, 6.0, 3.0]) == 3.0  # too few to leave any out
    assert pooled_iqm([0.0, 5.0], [1.0, 3.0]) == 2.0
    np.testing.assert_array_equal(iqm([[0.0, 1.0, 2.0, 90.0], [4.0, 4.0, 4.0, 4.0]]), [1.5, 4.0])


def test_optimality_gap_profile_and_times():
    assert optimality_gap([0.5, 1.5, 0.9]) == pytest.approx(0.2)
    shares = dict(zip(THRESHOLDS.round(3).tolist(), profile([[0.0, 0.5], [0.5, 1.0]]), strict=True))
    # Above, not at: a score of 0.5 is not above 0.5.
    found = [shares[at] for at in (-0.025, 0.0, 0.475, 0.5, 1.0)]
    assert found == [1.0, 0.75, 0.75, 0.25, 0.0]
    assert median_time([3.0, None, 1.0]) == 3.0 and median_time([None, 1.0]) is None
    assert wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)  # as in any table
    assert wilson(10, 10) == pytest.approx((10 / (10 + 1.959964**2), 1.0))


def test_probability_of_improvement():
    assert improvement([1.0, 3.0], [0.0, 1.0]) == 0.875  # three pairs of four, and a tie
    assert improvement([1.0], [1.0, 2.0]) == 0.25 and improvement([2.0], [2.0]) == 0.5
    assert improvement([[1.0, 2.0], [0.0, 0.0]], [[0.0, 1.5], [1.0, 1.0]]).tolist() == [0.75, 0.0]


def test_estimate():
    single = estimate([[1.0, 3.0, 1.0, 3.0]])
    error = np.sqrt(4.0 / 3.0) / 2.0
    assert single["value"] == single["mean"] == 2.0 and single["error"] == pytest.approx(error)
    assert single["high"] - 2.0 == pytest.approx(1.96 * error) == 2.0 - single["low"]
    several = estimate([[0.0, 2.0], [2.0, 4.0], [8.0, 8.0]])
    assert several["each"] == [1.0, 3.0, 8.0] and several["mean"] == several["value"] == 4.0
    assert several["error"] == pytest.approx(np.std([1.0, 3.0, 8.0], ddof=1) / np.sqrt(3.0))
    assert several["low"] == 1.0 and several["high"] == 8.0
    assert estimate([[5.0]])["error"] == 0.0


def test_numbers_are_rounded_wherever_they_stand():
    assert rounded_data({"a": [1.23456789, (2, None)], "b": True}) == {"a": [1.23457, [2, None]], "b": True}


# --- luck ---


def test_luck_is_taken_out():
    """The part that is correlated with another agent's luck is found, and the rest is left alone."""
    rng = np.random.default_rng(0)
    luck = rng.normal(3.0, 50.0, 20_000)
    found = luck_of([400.0 + 0.5 * luck[:99], -7.0 + 0.5 * luck[1:100]], [luck[:99], luck[1:100]], 3.0)
    assert found == pytest.approx((0.5, 0.0), abs=1e-9)
    assert luck_of([[1.0, 2.0, 4.0]], [[3.0, 3.0, 3.0]], 3.0) == (0.0, 0.0)
    mean, error = mean_and_error(luck)
    assert without_luck(400.0 + 2.0 * luck[:100], luck) == pytest.approx((400.0 + 2.0 * mean, 2.0 * error))
    own = rng.normal(30.0, 1.0, 1000)
    found = without_luck(own, luck)
    assert found == pytest.approx(mean_and_error(own), abs=0.1)
    assert without_luck(own, None) == mean_and_error(own)


def test_few_lucky_episodes_prove_nothing():
    """An agent that nearly always does the same, and seldom fails, tells nothing until it has failed."""
    rng = np.random.default_rng(1)
    failing = rng.random(10_000) < 0.01
    luck = np.where(failing, 100.0, rng.normal(490.0, 0.2, failing.size))
    returns = np.where(failing, 50.0, rng.normal(310.0, 140.0, failing.size))
    truth = returns.mean()
    for n in (2, 3, 5, 10, 20, 50):
        starts = range(0, 2000, n)
        found = np.array([without_luck(returns[i : i + n], np.roll(luck, -i)) for i in starts])
        plain = np.array([returns[i : i + n].mean() for i in starts])
        assert np.sqrt(np.mean((found[:, 0] - truth) ** 2)) < 1.05 * np.sqrt(np.mean((plain - truth) ** 2))


# --- intervals ---


def test_intervals_resample_each_stratum():
    # Two elements: their mean takes the lower, the upper or the middle with 1/4, 1/4, 1/2.
    assert interval(iqm, [0.0, 1.0]) == [0.0, 1.0]
    drawn = redraw(np.random.default_rng(0), [0.0, 1.0])
    assert drawn.shape == (RESAMPLES, 2) and ends(iqm(drawn)) == (0.0, 1.0)
    assert np.mean(iqm(drawn) == 0.5) == pytest.approx(0.5, abs=0.05)
    assert interval(iqm, [3.0, 3.0, 3.0]) == [3.0, 3.0]
    assert interval(iqm, [3.0]) is None and interval(pooled_iqm, [1.0, 2.0], [3.0]) is None
    # As in rliable: rows of a matrix (runs, tasks) are resampled independently for each column.
    rng = np.random.default_rng(1)
    scores = rng.normal([0.0, 1.0, 5.0], size=(8, 3))
    drawn = [pooled_iqm(*(column[rng.integers(8, size=8)] for column in scores.T)) for _ in range(1500)]
    expected = np.quantile(drawn, [0.025, 0.975])
    np.testing.assert_allclose(interval(pooled_iqm, *scores.T), expected, atol=0.1)
    assert interval(pooled_iqm, *scores.T) == interval(pooled_iqm, *scores.T)  # same numbers each time


def test_intervals_are_those_of_scipy():
    from scipy.stats import bootstrap

    rng = np.random.default_rng(3)
    x, y = rng.normal(size=10), rng.normal(0.3, size=7)
    for statistic, strata in ((iqm, [x]), (pooled_iqm, [x, y]), (partial(improvement, y=y), [x])):
        found = bootstrap(
            strata, lambda *s, axis, f=statistic: f(*s), n_resamples=RESAMPLES, method="percentile", axis=-1,
            vectorized=True, rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
        assert interval(statistic, *strata) == pytest.approx([*found], rel=1e-12)


def test_intervals_cover_as_often_as_they_say():
    rng = np.random.default_rng(2)
    found = [interval(iqm, sample) for sample in rng.normal(size=(80, 20))]
    assert 0.85 <= np.mean([low < 0.0 < high for low, high in found]) <= 1.0


# --- against rliable ---


def test_point_estimates_are_those_of_rliable():
    metrics = rliable("metrics")
    rng = np.random.default_rng(6)
    for n, m in ((5, 5), (10, 7), (20, 1)):
        x, y = rng.normal(0.9, 0.2, n), rng.normal(0.8, 0.2, m)
        assert iqm(x) == pytest.approx(metrics.aggregate_iqm(x[:, None]), rel=1e-12)
        assert optimality_gap(x) == pytest.approx(metrics.aggregate_optimality_gap(x[:, None]), rel=1e-12)
        expected = metrics.probability_of_improvement(x[:, None], y[:, None])
        assert improvement(x, y) == pytest.approx(expected, rel=1e-12)
    scores = rng.normal(size=(10, 3))
    assert pooled_iqm(*scores.T) == pytest.approx(metrics.aggregate_iqm(scores), rel=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning")  # of arch, which rliable calls
def test_intervals_and_profile_are_those_of_rliable():
    library, metrics = rliable("library"), rliable("metrics")
    rng = np.random.default_rng(7)
    x, y = rng.normal(0.9, 0.1, 10), rng.normal(0.85, 0.1, 8)
    state = np.random.RandomState(0)

    def by_rliable(data, statistic):
        found = library.get_interval_estimates({"a": data}, statistic, reps=2000, random_state=state)
        return found[1]["a"].ravel()

    assert interval(iqm, x) == pytest.approx(by_rliable(x[:, None], metrics.aggregate_iqm), abs=0.01)
    expected = by_rliable((x[:, None], y[:, None]), metrics.probability_of_improvement)
    assert interval(improvement, x, y) == pytest.approx(expected, abs=0.04)
    shares, _ = library.create_performance_profile({"a": x[:, None]}, THRESHOLDS, reps=2)
    np.testing.assert_allclose(profile(x), shares["a"])
