"""Numbers about many episodes, with intervals that say what they are intervals over.

The unit is the training seed: two trainings differ more than two drives of one policy. Where there are several, seeds
are resampled and spawns too; where there is one, the interval covers the traffic only and says so.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from rapid.seeding import numpy_stream

Statistic = Literal["mean", "iqm"]
LEVEL = 0.95
RESAMPLES = 2_000
ENOUGH_SEEDS = 5
"""Training seeds below which nothing is said about a training method, only about the policies at hand."""
LARGE = 5_000
"""Episodes from which on an interval is the normal one: what BCa corrects falls with their number, and its work grows
with the square."""
_BLOCK = 1 << 22
"""Numbers held at once while resampling."""


@dataclass(frozen=True)
class Estimate:
    """A statistic of episodes and its interval."""

    value: float
    low: float
    """Lower end of the 95 % interval; NaN where the episodes are too few for one."""
    high: float
    episodes: int
    spawns: int
    """Different spawn seeds."""
    training_seeds: int
    """Different trainings; 0 for what was never trained."""

    @property
    def unit(self) -> str:
        """What the interval is over, in words."""
        spawns = f"{self.spawns} spawn{'' if self.spawns == 1 else 's'}"
        if self.training_seeds == 0:
            return spawns
        if self.training_seeds == 1:
            return f"{spawns}, one training"
        return f"{self.training_seeds} trainings × {spawns}"


def iqm(values: NDArray[np.floating], axis: int = -1) -> NDArray[np.float64]:
    """Return the interquartile mean: the mean of the middle half along `axis` (a quarter is cut off, rounded down)."""
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis), np.float64)


def _statistic(name: Statistic, values: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    return iqm(values, axis) if name == "iqm" else np.mean(values, axis=axis)


def estimate(
    values: Sequence[float] | NDArray[np.float64],
    spawns: Sequence[int],
    training_seeds: Sequence[int | None] | None = None,
    statistic: Statistic = "mean",
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Return a statistic of one number per episode with its 95 % interval; episodes with NaN are left out.

    With two or more training seeds the interval is a hierarchical bootstrap: seeds are drawn with replacement, then
    spawns. If every training met the same spawns, one draw of spawns holds for all seeds drawn, because the traffic is
    shared; else each seed draws from its own. Otherwise it is SciPy's BCa bootstrap over the episodes, and of `LARGE`
    or more the normal interval.
    A share of yes and no that is all one or all the other gets Wilson's interval: resampling it would claim certainty.
    """
    numbers = np.asarray(values, np.float64)
    keep = ~np.isnan(numbers)
    kept = numbers[keep]
    spawn_N = np.asarray(spawns, np.int64)[keep]
    labels = [None] * len(numbers) if training_seeds is None else list(training_seeds)
    seed_N = [label for label, k in zip(labels, keep, strict=True) if k]
    trained = sorted({label for label in seed_N if label is not None})
    counts = (len(kept), len(set(spawn_N.tolist())), len(trained))
    if len(kept) == 0:
        return Estimate(math.nan, math.nan, math.nan, *counts)
    value = float(_statistic(statistic, kept))
    generator = numpy_stream(seed, "bootstrap")
    if np.ptp(kept) == 0:
        low, high = _constant_interval(float(kept[0]), counts[1])
    elif len(trained) >= 2:
        places = {one: place for place, one in enumerate(trained)}
        place_N = np.array([places.get(label, -1) if label is not None else -1 for label in seed_N])
        groups = [_by_spawn(kept, spawn_N, place_N == place) for place in range(len(trained))]
        draws = _hierarchical(groups, statistic, resamples, generator)
        low, high = _percentiles(draws)
    else:
        low, high = _bootstrap(kept, statistic, resamples, generator)
    return Estimate(value, low, high, *counts)


def paired_difference(
    ours: Sequence[float] | NDArray[np.float64],
    our_spawns: Sequence[int],
    theirs: Sequence[float] | NDArray[np.float64],
    their_spawns: Sequence[int],
    our_seeds: Sequence[int | None] | None = None,
    their_seeds: Sequence[int | None] | None = None,
    same_seeds: bool = False,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Return the mean of ours - theirs over the spawns that both drove, with its 95 % interval.

    Both sides of a difference meet the same draw of spawns. Trainings are drawn for each side by itself, or, with
    `same_seeds`, together: then seed 3 of ours is compared with seed 3 of theirs (before and after adaptation, say).
    """
    left, right = _matrix(ours, our_spawns, our_seeds), _matrix(theirs, their_spawns, their_seeds)
    spawns = sorted(left.keys() & right.keys())
    trainings = max(_trainings(our_seeds), _trainings(their_seeds))
    if not spawns:
        return Estimate(math.nan, math.nan, math.nan, 0, 0, trainings)
    names_a = sorted({name for spawn in spawns for name in left[spawn]})
    names_b = sorted({name for spawn in spawns for name in right[spawn]})
    if same_seeds:
        names_a = names_b = [name for name in names_a if name in names_b]
        trainings = len(names_a)
        if not names_a:
            return Estimate(math.nan, math.nan, math.nan, 0, len(spawns), 0)
    a_SE = np.array([[left[spawn].get(name, math.nan) for spawn in spawns] for name in names_a])
    b_SE = np.array([[right[spawn].get(name, math.nan) for spawn in spawns] for name in names_b])
    whole = ~(np.isnan(a_SE).any(0) | np.isnan(b_SE).any(0))
    a_SE, b_SE = a_SE[:, whole], b_SE[:, whole]
    count = a_SE.shape[1]
    if count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, 0, trainings)
    episodes = count * len(names_a)
    value = float(a_SE.mean() - b_SE.mean())
    if count < 2:
        return Estimate(value, math.nan, math.nan, episodes, count, trainings)
    generator = numpy_stream(seed, "bootstrap/paired")
    draws: list[NDArray[np.float64]] = []
    block = max(1, _BLOCK // (count * max(len(a_SE), len(b_SE))))
    for first in range(0, resamples, block):
        size = min(block, resamples - first)
        spawn_RE = generator.integers(count, size=(size, 1, count))
        row_RS = generator.integers(len(a_SE), size=(size, len(a_SE), 1))
        other_RS = row_RS if same_seeds else generator.integers(len(b_SE), size=(size, len(b_SE), 1))
        draws.append(a_SE[row_RS, spawn_RE].mean((1, 2)) - b_SE[other_RS, spawn_RE].mean((1, 2)))
    low, high = _percentiles(np.concatenate(draws))
    return Estimate(value, low, high, episodes, count, trainings)


def _percentiles(draws: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def _constant_interval(value: float, count: int) -> tuple[float, float]:
    """Return the interval of `count` equal numbers."""
    if value in (0.0, 1.0):
        return _share_interval(round(value * count), count)
    return (value, value) if count > 1 else (math.nan, math.nan)


def _share_interval(yes: int, count: int) -> tuple[float, float]:
    """Return Wilson's interval of a share."""
    interval = stats.binomtest(yes, count).proportion_ci(LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def _bootstrap(
    values: NDArray[np.float64], statistic: Statistic, resamples: int, generator: np.random.Generator
) -> tuple[float, float]:
    """Return SciPy's bootstrap interval; BCa, or percentiles where its correction does not exist."""

    def of(sample: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        return _statistic(statistic, sample, axis)

    if len(values) < 2:
        return math.nan, math.nan
    if len(values) >= LARGE:
        return _normal_interval(values, statistic)
    # BCa corrects by the spread of leave-one-out values; an IQM of half-constant data has none.
    spread = np.ptp([float(of(np.delete(values, i))) for i in range(min(len(values), 64))])
    result = stats.bootstrap(
        (values,),
        of,
        n_resamples=resamples,
        batch=max(1, _BLOCK // len(values)),
        vectorized=True,
        confidence_level=LEVEL,
        method="BCa" if spread > 0 else "percentile",
        rng=generator,
    )
    low, high = float(result.confidence_interval.low), float(result.confidence_interval.high)
    if math.isnan(low) or math.isnan(high):
        return _percentiles(np.asarray(result.bootstrap_distribution))
    return low, high


def _normal_interval(values: NDArray[np.float64], statistic: Statistic) -> tuple[float, float]:
    """Return the statistic with 1.96 standard errors to either side; of an IQM, that of a trimmed mean.

    What a trimmed mean varies by is the spread of the values drawn in to the ends of the middle half (Tukey and
    McLaughlin, 1963). A share of yes and no gets Wilson's interval, which stays between 0 and 1.
    """
    if statistic == "mean" and np.isin(values, (0.0, 1.0)).all():
        return _share_interval(round(float(values.sum())), len(values))
    kept = 1.0
    spread = values
    if statistic == "iqm":
        low, high = np.quantile(values, (0.25, 0.75))
        spread, kept = np.clip(values, low, high), 0.5
    error = float(spread.std(ddof=1)) / (kept * math.sqrt(len(values)))
    reach = float(stats.norm.ppf((1 + LEVEL) / 2)) * error
    value = float(_statistic(statistic, values))
    return value - reach, value + reach


def _by_spawn(values: NDArray[np.float64], spawns: NDArray[np.int64], chosen: NDArray[np.bool_]) -> dict[int, float]:
    """Return one number per spawn of one training; a spawn driven twice counts with its mean."""
    found: dict[int, list[float]] = {}
    for spawn, value in zip(spawns[chosen].tolist(), values[chosen].tolist(), strict=True):
        found.setdefault(spawn, []).append(value)
    return {spawn: sum(of) / len(of) for spawn, of in found.items()}


def _hierarchical(
    groups: Sequence[dict[int, float]], statistic: Statistic, resamples: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Return the statistic of each resample: trainings drawn with replacement, then spawns."""
    crossed = all(group.keys() == groups[0].keys() for group in groups)
    lengths = np.array([len(group) for group in groups])
    longest = int(lengths.max())
    value_SE = np.full((len(groups), longest), np.nan)
    for row, group in enumerate(groups):
        value_SE[row, : len(group)] = [group[spawn] for spawn in sorted(group)]
    count = len(groups)
    draws: list[NDArray[np.float64]] = []
    block = max(1, _BLOCK // (count * longest))
    for first in range(0, resamples, block):
        size = min(block, resamples - first)
        row_RS = generator.integers(count, size=(size, count))
        if crossed:
            column = generator.integers(longest, size=(size, 1, longest))
            if statistic == "mean":
                # The mean over trainings first: the same number, from fewer reads.
                draws.append(np.take_along_axis(value_SE[row_RS].mean(1), column[:, 0], 1).mean(1))
                continue
            draws.append(_statistic(statistic, value_SE[row_RS[..., None], column].reshape(size, -1)))
            continue
        # Each training drawn counts with as many draws as it has spawns, so resamples differ in size.
        for rows in row_RS:
            parts = [value_SE[row, generator.integers(lengths[row], size=lengths[row])] for row in rows]
            draws.append(np.atleast_1d(_statistic(statistic, np.concatenate(parts))))
    return np.concatenate(draws)


def _matrix(
    values: Sequence[float] | NDArray[np.float64], spawns: Sequence[int], seeds: Sequence[int | None] | None
) -> dict[int, dict[int, float]]:
    """Return values[spawn][training]; what was never trained is training -1."""
    found: dict[int, dict[int, float]] = {}
    labels = [None] * len(spawns) if seeds is None else seeds
    for value, spawn, label in zip(values, spawns, labels, strict=True):
        if not math.isnan(value):
            found.setdefault(int(spawn), {})[-1 if label is None else label] = float(value)
    return found


def _trainings(seeds: Sequence[int | None] | None) -> int:
    return len({seed for seed in seeds or () if seed is not None})
