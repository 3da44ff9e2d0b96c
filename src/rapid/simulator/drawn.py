"""Worlds drawn around what is known of one: that which an observation shows, or which cars are where."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.road import LANE_WIDTH, SIGHT
from rapid.simulator.reconstruct import LATERAL_TIME, reconstruct
from rapid.simulator.settings import Settings
from rapid.simulator.spawn import TRAFFIC_START_SPEED
from rapid.simulator.state import CAR_ROWS, ORDER, RANK, TAG_ROWS, WORLD_ENTRIES, X

Worlds = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]
"""Cars (K, CAR_ROWS, N), tags (K, TAG_ROWS, N) and the rest (K, WORLD_ENTRIES) of K worlds."""

REACH = (-60.0, 200.0)
"""Metres from the ego, behind and ahead, beyond which cars are left out to save time; few could matter in the
seconds that a plan looks ahead."""
UNSEEN = 12
"""Cars drawn ahead of the farthest one seen, where the observation has no room for more."""

_GAPS = (0.9, 1.1)
"""Between which the gaps of unseen traffic lie, in mean gaps: as it is spawned."""
_ROOM = 10.0
"""Metres from one car's centre to the next on a lane of unseen traffic, at least."""


def within_reach(cars: NDArray[np.float64], tags: NDArray[np.int64], world: NDArray[np.float64], draws: int) -> Worlds:
    """Return copies of one world, as many as are drawn, without the cars out of `REACH`."""
    ahead = cars[X] - cars[X, 0]
    near = np.flatnonzero((ahead >= REACH[0]) & (ahead <= REACH[1]))
    own_cars, own_tags = cars[:, near], tags[:, near]
    own_tags[ORDER] = np.argsort(own_cars[X], kind="stable")
    own_tags[RANK, own_tags[ORDER]] = np.arange(len(near))
    return tuple(np.repeat(part[None], draws, 0) for part in (own_cars, own_tags, world))  # type: ignore[return-value]


def from_observation(obs_VF: NDArray[np.float64], settings: Settings, draws: int, rng: np.random.Generator) -> Worlds:
    """Return worlds as one observation shows them; traffic beyond what it has room for is drawn in each."""
    rows_VF = obs_VF[_believed(obs_VF)]
    seen_V5 = np.empty((len(rows_VF), 5))
    seen_V5[:, 0] = rows_VF[:, 1] - rows_VF[0, 1]
    seen_V5[:, 1:4] = rows_VF[:, 2:5]
    aimed_V = np.rint((rows_VF[:, 2] + LATERAL_TIME * rows_VF[:, 4]) / LANE_WIDTH)
    seen_V5[:, 4] = aimed_V.clip(0, settings.lanes - 1)
    unseen = UNSEEN if len(rows_VF) == len(obs_VF) else 0
    vehicles = len(seen_V5) + unseen
    cars, tags = np.zeros((draws, CAR_ROWS, vehicles)), np.zeros((draws, TAG_ROWS, vehicles), np.int64)
    world = np.zeros((draws, WORLD_ENTRIES))
    for k in range(draws):
        rows = np.concatenate([seen_V5, _unseen(seen_V5[1:], unseen, settings, rng)])
        reconstruct(rows, settings, cars[k], tags[k], world[k])
    return cars, tags, world


def _believed(obs_VF: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which rows count as cars, the ego always: those present, and no farther off than cars are shown."""
    believed_V = (obs_VF[:, 0] >= 0.5) & (np.abs(obs_VF[:, 1] - obs_VF[0, 1]) <= SIGHT)
    believed_V[0] = True
    return believed_V


def _unseen(seen_V5: NDArray[np.float64], count: int, settings: Settings, rng: np.random.Generator) -> Any:
    """Return traffic beyond the cars seen, as dense as it is spawned and as fast as that seen ahead.

    Each next car takes a lane at random of those where there is room behind it.
    """
    rows = np.zeros((count, 5))
    if count:
        farthest = np.abs(seen_V5[:, 0]).max()
        ahead = seen_V5[seen_V5[:, 0] > 0] if (seen_V5[:, 0] > 0).any() else seen_V5
        mean, spread = ahead[:, 2].mean(), max(ahead[:, 2].std(), 1.0)
        gap = settings.traffic_spacing * (12.0 + sum(TRAFFIC_START_SPEED) / 2) * settings.spacing_factor
        rows[:, 0] = farthest + np.cumsum(gap * rng.uniform(*_GAPS, count)) - gap * rng.random()
        last = np.full(settings.lanes, -np.inf)
        for row in seen_V5:
            last[int(row[4])] = max(last[int(row[4])], row[0])
        for row in rows:
            free = np.flatnonzero(last <= row[0] - _ROOM)
            lane = rng.choice(free) if len(free) else np.argmin(last)
            row[0] = max(row[0], last[lane] + _ROOM)
            row[4], last[lane] = lane, row[0]
        rows[:, 1] = LANE_WIDTH * rows[:, 4]
        rows[:, 2] = rng.normal(mean, spread, count).clip(5.0, TRAFFIC_START_SPEED[1])
    return rows
