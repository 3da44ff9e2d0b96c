"""What a teacher knows: the observation that the student will see, read as lanes, cars and gaps; nothing else.

The observation says neither where a car is heading nor which speed the ego aims at, but both follow from how cars are
steered: a lane change closes a gap to the lane's middle at a rate proportional to it, so the lateral velocity tells the
lane aimed at; and FASTER and SLOWER step from the target speed nearest to the current one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.road import LANE_WIDTH, SIGHT
from rapid.scenarios import (
    FASTER,
    FEATURES,
    IDLE,
    LANE_LEFT,
    LANE_RIGHT,
    NUM_FEATURES,
    SLOWER,
    TARGET_SPEEDS,
)
from rapid.simulator.reconstruct import LATERAL_TIME


@dataclass(frozen=True)
class Car:
    """Another vehicle. Its name is its rank by distance, so the same state gives the same names."""

    name: str
    ahead: float
    """Metres from the ego's centre to this car's centre along the road; negative is behind."""
    lane: int
    """Nearest lane; 0 is the leftmost."""
    toward: int
    """Lane that it is steering to; the same as `lane` unless it is changing."""
    speed: float
    """Along the road, m/s."""
    side: float
    """Lateral position y, m."""
    drift: float
    """Lateral velocity, m/s."""

    @property
    def lanes(self) -> tuple[int, ...]:
        """The lanes that the car takes up: both while it is changing."""
        return (self.lane,) if self.lane == self.toward else (self.lane, self.toward)


@dataclass(frozen=True)
class Scene:
    """One world, as the ego sees it."""

    lanes: int
    lane: int
    """The ego's lane; 0 is the leftmost."""
    speed: float
    """Along the road, m/s."""
    side: float
    """Lateral position y, m."""
    drift: float
    """Lateral velocity, m/s."""
    cars: tuple[Car, ...]
    """The others, nearest first."""

    @property
    def gear(self) -> int:
        """Index of the target speed nearest to the current one, from which FASTER and SLOWER step."""
        spacing = TARGET_SPEEDS[1] - TARGET_SPEEDS[0]
        return int(np.clip(round(self.speed / spacing), 0, len(TARGET_SPEEDS) - 1))

    def available(self) -> tuple[int, ...]:
        """Return the actions that change something here, and IDLE, in the order of their index."""
        possible = {
            LANE_LEFT: self.lane > 0,
            IDLE: True,
            LANE_RIGHT: self.lane < self.lanes - 1,
            FASTER: self.gear < len(TARGET_SPEEDS) - 1,
            SLOWER: self.gear > 0,
        }
        return tuple(action for action, can in possible.items() if can)

    def lane_after(self, action: int) -> int:
        """Return the lane that the ego is in, or heads for, after an action."""
        step = {LANE_LEFT: -1, LANE_RIGHT: 1}.get(action, 0)
        return min(max(self.lane + step, 0), self.lanes - 1)

    def speed_after(self, action: int) -> float:
        """Return the target speed after an action, m/s."""
        step = {FASTER: 1, SLOWER: -1}.get(action, 0)
        return TARGET_SPEEDS[min(max(self.gear + step, 0), len(TARGET_SPEEDS) - 1)]

    def lead(self, lane: int) -> Car | None:
        """Return the nearest car at or ahead of the ego's centre on a lane."""
        return next((car for car in self.cars if car.ahead >= 0 and lane in car.lanes), None)

    def rear(self, lane: int) -> Car | None:
        """Return the nearest car behind the ego's centre on a lane."""
        return next((car for car in self.cars if car.ahead < 0 and lane in car.lanes), None)


def read_scenes(obs_BVF: NDArray[np.float32], lanes: int) -> list[Scene]:
    """Read observations (rows presence, x, y, vx, vy; the ego first; m, m/s) of a road with `lanes` lanes.

    A perturbed observation is read as it comes: a row counts as a car if its presence is at least one half, and a
    car off the road counts to the nearest lane.

    Raises:
        RapidError: the array has the wrong shape or holds a number that is not finite.
    """
    seen_BVF = np.asarray(obs_BVF, dtype=np.float64)
    if seen_BVF.ndim != 3 or seen_BVF.shape[1] < 1 or seen_BVF.shape[2] != NUM_FEATURES:
        raise RapidError(
            f"A teacher reads observations of shape (worlds, vehicles, {NUM_FEATURES}) with the features "
            f"{', '.join(FEATURES)}, not {seen_BVF.shape}. Add the missing axis, or check the observation's settings."
        )
    finite_B = np.isfinite(seen_BVF).all(axis=(1, 2))
    if not finite_B.all():
        world, row, feature = np.argwhere(~np.isfinite(seen_BVF))[0]
        raise RapidError(
            f"Observation {world} has {seen_BVF[world, row, feature]} as {FEATURES[feature]} of row {row}. "
            "Every entry must be a finite number: check the attack or the environment that made it."
        )
    return [_read_scene(obs_VF, lanes) for obs_VF in seen_BVF]


def _read_scene(obs_VF: NDArray[np.float64], lanes: int) -> Scene:
    rows: Sequence[Sequence[float]] = obs_VF.tolist()
    _, x, y, speed, drift = rows[0]
    seen: list[tuple[float, float, float, float, float, float]] = []
    for presence, car_x, car_y, car_speed, car_drift in rows[1:]:
        ahead = car_x - x
        if presence >= 0.5 and abs(ahead) <= SIGHT:
            # Sorting on everything makes the names independent of the order of the rows.
            seen.append((abs(ahead), car_y, ahead, car_speed, car_drift, presence))
    cars = tuple(
        Car(f"car {rank}", ahead, _nearest(side, lanes), _toward(side, drift, lanes), speed, side, drift)
        for rank, (_, side, ahead, speed, drift, _) in enumerate(sorted(seen), 1)
    )
    return Scene(lanes, _toward(y, drift, lanes), speed, y, drift, cars)


def _nearest(side: float, lanes: int) -> int:
    return int(min(max(round(side / LANE_WIDTH), 0), lanes - 1))


def _toward(side: float, drift: float, lanes: int) -> int:
    """Return the lane that a car is steering to: its lateral velocity is its offset from there over `LATERAL_TIME`."""
    return _nearest(side + LATERAL_TIME * drift, lanes)
