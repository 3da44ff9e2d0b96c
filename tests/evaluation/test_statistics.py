"""Statistics: known values, coverage, and what the intervals are over."""

import math
import time

import numpy as np
import pytest
from scipy import stats

from rapid.evaluation import statistics
from rapid.evaluation.statistics import estimate, iqm, paired_difference


def crossed(rng: np.random.Generator, seeds: int, spawns: int, seed_sd: float, spawn_sd: float, noise: float):
    """Draw seeds x spawns results whose true mean is 0."""
    table = (
        rng.normal(0, seed_sd, (seeds, 1))
        + rng.normal(0, spawn_sd, (1, spawns))
        + rng.normal(0, noise, (seeds, spawns))
    )
    return table.ravel(), list(range(spawns)) * seeds, np.repeat(np.arange(seeds), spawns).tolist()


def test_iqm_is_the_mean_of_the_middle_half() -> None:
    assert iqm(np.array([0.0, 1, 2, 3, 4, 5, 6, 1000])) == 3.5
    assert iqm(np.arange(8.0).reshape(2, 4)).tolist() == [1.5, 5.5]


def test_same_seed_same_interval_and_unit_named() -> None:
    values = np.random.default_rng(0).normal(size=40)
    first, again = estimate(values, range(40)), estimate(values, range(40))
    assert first == again
    assert first != estimate(values, range(40), seed=1)
    assert first.low < first.value < first.high
    assert first.unit == "40 spawns"
    assert estimate(values, range(40), [7] * 40).unit == "40 spawns, one training"
    assert estimate(values, [*range(20)] * 2, [1] * 20 + [2] * 20).unit == "2 trainings × 20 spawns"


def test_one_training_agrees_with_the_normal_interval() -> None:
    values = np.random.default_rng(1).normal(5, 2, 400)
    of = estimate(values, range(400))
    half = 1.96 * values.std(ddof=1) / 20
    assert of.low == pytest.approx(values.mean() - half, abs=0.06)
    assert of.high == pytest.approx(values.mean() + half, abs=0.06)


def test_seeds_that_differ_widen_the_interval() -> None:
    values, spawns, seeds = crossed(np.random.default_rng(2), 5, 100, seed_sd=3, spawn_sd=1, noise=1)
    whole = estimate(values, spawns, seeds)
    blind = estimate(values, range(500))
    assert whole.high - whole.low > 4 * (blind.high - blind.low)
    assert (whole.training_seeds, whole.spawns, whole.episodes) == (5, 100, 500)


def test_shared_traffic_is_resampled_together() -> None:
    """With no difference between seeds, ten seeds on the same spawns know no more about traffic than one."""
    values, spawns, seeds = crossed(np.random.default_rng(3), 10, 50, seed_sd=0, spawn_sd=2, noise=0.01)
    of = estimate(values, spawns, seeds)
    one = estimate(values[:50], range(50))
    assert of.high - of.low == pytest.approx(one.high - one.low, rel=0.15)


def test_coverage_of_the_hierarchical_interval() -> None:
    rng = np.random.default_rng(4)
    hits = 0
    for _ in range(100):
        of = estimate(*crossed(rng, 8, 30, seed_sd=1, spawn_sd=1, noise=1), resamples=300)
        hits += of.low <= 0 <= of.high
    assert hits >= 85  # few seeds make a percentile bootstrap a little narrow


def test_ragged_spawns_are_drawn_within_each_seed() -> None:
    of = estimate([1.0, 2, 3, 10, 11], [1, 2, 3, 1, 9], [0, 0, 0, 1, 1])
    assert of.value == pytest.approx(5.4)
    assert of.low < 3
    assert of.high > 9


def test_never_crashed_is_not_certainty() -> None:
    of = estimate([0.0] * 20, range(20))
    wilson = stats.binomtest(0, 20).proportion_ci(method="wilson")
    assert (of.value, of.low, of.high) == (0, pytest.approx(wilson.low), pytest.approx(wilson.high))
    assert estimate([1.0] * 20, range(20)).low < 0.9


def test_missing_numbers_are_left_out_and_too_few_have_no_interval() -> None:
    of = estimate([1.0, math.nan, 3.0], [1, 2, 3])
    assert (of.value, of.episodes, of.spawns) == (2, 2, 2)
    single = estimate([4.5], [1])
    assert single.value == 4.5
    assert math.isnan(single.low)
    assert math.isnan(estimate([math.nan], [1]).value)
    assert math.isnan(estimate([], []).value)


def test_iqm_of_mostly_equal_values_has_an_interval() -> None:
    of = estimate([20.0] * 30 + [3.0, 25.0], range(32), statistic="iqm")
    assert of.value == 20
    assert of.low <= 20 <= of.high


def test_pairing_removes_what_the_traffic_shares() -> None:
    rng = np.random.default_rng(5)
    traffic = rng.normal(0, 5, 60)
    ours, theirs = traffic + 1 + rng.normal(0, 0.3, 60), traffic + rng.normal(0, 0.3, 60)
    order = rng.permutation(60)
    of = paired_difference(ours, range(60), theirs[order], order.tolist())
    assert 0.8 < of.low < of.value < of.high < 1.2
    assert of.spawns == 60


def test_pairs_use_common_spawns_only() -> None:
    of = paired_difference([1.0, 2, 3], [1, 2, 3], [0.0, 0], [2, 3])
    assert (of.value, of.spawns) == (2.5, 2)
    assert math.isnan(paired_difference([1.0], [1], [1.0], [2]).value)


def test_paired_trainings_cancel() -> None:
    values, spawns, seeds = crossed(np.random.default_rng(6), 5, 40, seed_sd=3, spawn_sd=1, noise=0.1)
    together = paired_difference(values + 1, spawns, values, spawns, seeds, seeds, same_seeds=True)
    apart = paired_difference(values + 1, spawns, values, spawns, seeds, seeds)
    assert (together.low, together.high) == (pytest.approx(1), pytest.approx(1))
    assert apart.low < 0
    assert together.unit == "5 trainings × 40 spawns"


@pytest.mark.parametrize("statistic", ["mean", "iqm"])
@pytest.mark.parametrize("kind", ["return", "share", "skewed"])
def test_with_many_episodes_the_normal_interval_is_the_bootstraps(statistic, kind, monkeypatch):
    rng = np.random.default_rng(0)
    values = {
        "return": rng.normal(20, 3, 5_000),
        "share": (rng.random(5_000) < 0.4).astype(float),
        "skewed": rng.exponential(2, 5_000),
    }[kind]
    if (statistic, kind) == ("iqm", "share"):
        pytest.skip("the middle half of a share is a constant")
    large = estimate(values, range(5_000), statistic=statistic)
    monkeypatch.setattr(statistics, "LARGE", 10_000)
    small = estimate(values, range(5_000), statistic=statistic, resamples=500)
    width = small.high - small.low
    assert large.value == small.value
    assert large.low == pytest.approx(small.low, abs=0.1 * width)
    assert large.high == pytest.approx(small.high, abs=0.1 * width)


@pytest.mark.parametrize("trainings", [1, 5])
def test_the_work_grows_with_the_episodes_not_with_their_square(trainings):
    def seconds(count: int) -> float:
        values = np.random.default_rng(0).normal(20, 3, count)
        start = time.process_time()
        spawns = [episode // trainings for episode in range(count)]
        estimate(values, spawns, [episode % trainings for episode in range(count)], resamples=100)
        return time.process_time() - start

    seconds(1_000)
    # Twenty times the episodes: their square would take 400 times as long. Noise of a busy machine is far from that.
    assert seconds(200_000) < 200 * seconds(10_000)
