"""Crashes: what was hit, and how often each agent crashes under each attack."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.recording import Recording
from rapid.road import CAR_LENGTH, CAR_WIDTH

Hit = Literal["ahead", "beside", "behind"]
"""Where the car was that the ego touched."""
HITS: tuple[Hit, ...] = get_args(Hit)
_MOMENTS = np.linspace(0, 1, 61)
"""Of the second in which they touched, at which both are placed on a straight way between its ends."""
_SLOWED = np.linspace(0.3, 1, 8)
"""Who crashes brakes hard, so that a car goes on by a part of its speed only."""


@dataclass(frozen=True)
class Crashes:
    """How one agent crashes under one attack."""

    episodes: int
    crashes: int
    second: float
    """Median time of the crash, in decisions, which are seconds; NaN without one."""
    hit: str
    """What was hit most often; empty if nothing is known of it."""
    hits: int
    """Crashes of that kind,"""
    known: int
    """of those of which it is known."""

    @property
    def share(self) -> float:
        """Crashes of all episodes."""
        return self.crashes / self.episodes


def hit_of(before_VF: NDArray[np.floating], after_VF: NDArray[np.floating]) -> Hit | Literal[""]:
    """Return what the ego hit, from the observations before and after its last decision; empty if nobody is in view.

    The car is the one that is nearest in the end. That it is `beside` means that the sides touched first, by what two
    moments a second apart can tell.
    """
    before, after = np.asarray(before_VF, np.float64), np.asarray(after_VF, np.float64)
    cars, earlier = (scene[1:][scene[1:, 0] > 0.5] for scene in (before, after)[::-1])
    if not len(cars) or not len(earlier):
        return ""
    size = np.array([CAR_LENGTH, CAR_WIDTH])
    apart = np.abs((cars[:, 1:3] - after[0, 1:3]) / size).max(1)
    car = cars[apart.argmin(), 1:3]
    expected = earlier[:, None, 1:3] + _SLOWED[:, None] * earlier[:, None, 3:5]
    same = earlier[np.hypot(*np.moveaxis(expected - car, -1, 0)).min(1).argmin(), 1:3]
    first, last = (same - before[0, 1:3]) / size, (car - after[0, 1:3]) / size
    way = first + _MOMENTS[:, None] * (last - first)
    reach = np.abs(way).max(1)
    touched = reach <= 1
    along, across = way[touched.argmax() if touched.any() else reach.argmin()]
    if abs(across) > abs(along):
        return "beside"
    return "ahead" if along > 0 else "behind"


def hit_in(recording: Recording) -> Hit | Literal[""]:
    """Return what was hit in the end of a recorded episode; empty if it did not crash."""
    return hit_of(*recording.obs_TVF[-2:]) if recording.crashed and len(recording.action_T) else ""


def crashes_by(rows: Sequence[EpisodeRow], recordings: Sequence[Recording] = ()) -> dict[tuple[str, str, str], Crashes]:
    """Return how each agent crashes, by scenario, attack and agent.

    Rows of earlier versions do not tell what was hit; of those it is told from the crashes among `recordings`.
    """
    found: dict[tuple[str, str, str], list[EpisodeRow]] = {}
    for row in rows:
        found.setdefault((row.scenario, row.attack, row.agent), []).append(row)
    kept: dict[tuple[str, str, str], list[str]] = {}
    for each in recordings:
        if hit := hit_in(each):
            kept.setdefault((each.scenario, each.attack, each.agent), []).append(hit)
    return {key: _crashes(own, kept.get(key, [])) for key, own in found.items()}


def _crashes(rows: Sequence[EpisodeRow], kept: Sequence[str]) -> Crashes:
    crashed = [row for row in rows if row.crashed]
    hits = [row.hit for row in crashed if row.hit] or (kept if crashed else [])
    hit, most = Counter(hits).most_common(1)[0] if hits else ("", 0)
    second = float(np.median([row.length for row in crashed])) if crashed else float("nan")
    return Crashes(len(rows), len(crashed), second, hit, most, len(hits))
