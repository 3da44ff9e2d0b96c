# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""What the ego sees and what it is paid."""

import math

import numpy as np

from rapid.road import CAR_LENGTH, LANE_WIDTH, SIGHT
from rapid.simulator.behavior import ROAD_LENGTH, clip, wrap_angle
from rapid.simulator.compile import dot, kernel
from rapid.simulator.state import (
    COS,
    CRASHED,
    HEADING,
    LANE,
    SIN,
    SPEED,
    START_X,
    TARGET_LANE,
    TIME,
    VX,
    VY,
    X,
    Y,
)

# Columns of the info matrix that the step fills.
INFO_SPEED, INFO_LANE, INFO_DISTANCE, INFO_CRASHED, INFO_COLLISION, INFO_RIGHT, INFO_FAST, INFO_ON_ROAD = range(8)
INFO_COLUMNS = 8


@kernel
def _feature(cars, tags, i, feature, absolute):
    """Return one feature of vehicle `i`, coded as its place in ``settings.FEATURES``; relative to the ego if asked."""
    row = -1
    if feature == 0:
        return 1.0
    elif feature == 1:
        row = X
    elif feature == 2:
        row = Y
    elif feature == 3:
        row = VX
    elif feature == 4:
        row = VY
    if row >= 0:
        return cars[row, i] if absolute else cars[row, i] - cars[row, 0]
    if feature == 5:
        return cars[HEADING, i]
    elif feature == 6:
        return cars[COS, i]
    elif feature == 7:
        return cars[SIN, i]
    elif feature == 10:
        return cars[X, i]
    elif feature == 11:
        return cars[Y, i] - LANE_WIDTH * tags[LANE, i]
    elif feature == 12:
        return wrap_angle(cars[HEADING, i])
    return 0.0  # cos_d, sin_d: highway vehicles have no destination


@kernel
def _write_row(cars, tags, i, absolute, settings, row):
    for f in range(len(settings.features)):
        value = _feature(cars, tags, i, settings.features[f], absolute)
        if settings.scaled[f]:
            value = -1.0 + (value - settings.low[f]) * 2.0 / (settings.high[f] - settings.low[f])
            if settings.clip:
                value = clip(value, -1.0, 1.0)
        row[f] = value


@kernel
def observe(cars, tags, world, settings, observation):
    """Write what the ego of one world sees into `observation`, float32 of shape (V, F).

    The ego's row comes first, in absolute numbers, then the nearest vehicles by distance along the road; rows of
    vehicles that do not exist are zero. With a clock the ego's presence is 1 at first and 2 when the time is up.
    """
    room = settings.rows - 1
    seen = np.empty(room, np.int64)
    distances = np.empty(room)
    count = 0
    for j in range(1, cars.shape[1]):
        ahead, aside = cars[X, j] - cars[X, 0], cars[Y, j] - cars[Y, 0]
        if math.sqrt(dot(ahead, aside, ahead, aside)) >= SIGHT:
            continue
        if not settings.see_behind and ahead <= -2 * CAR_LENGTH:
            continue
        distance = abs(ahead)
        if count == room and distance >= distances[room - 1]:
            continue
        place = count if count < room else room - 1
        while place > 0 and distances[place - 1] > distance:
            distances[place] = distances[place - 1]
            seen[place] = seen[place - 1]
            place -= 1
        distances[place] = distance
        seen[place] = j
        count = min(count + 1, room)
    _write_row(cars, tags, 0, True, settings, observation[0])
    if settings.clock >= 0:
        observation[0, settings.clock] += world[TIME] / settings.duration
    for k in range(count):
        _write_row(cars, tags, seen[k], settings.absolute, settings, observation[k + 1])
    observation[count + 1 :] = 0.0


@kernel
def reward(cars, tags, settings, info):
    """Return the reward of the state that one world is in, and write its terms into `info` (INFO_COLUMNS values)."""
    x, y, lane = cars[X, 0], cars[Y, 0], tags[LANE, 0]
    on_road = abs(y - LANE_WIDTH * lane) <= LANE_WIDTH / 2 and -CAR_LENGTH <= x < ROAD_LENGTH + CAR_LENGTH
    forward = cars[SPEED, 0] * cars[COS, 0]
    pace = (forward - settings.reward_low_speed) / (settings.reward_high_speed - settings.reward_low_speed)
    info[INFO_COLLISION] = 1.0 if tags[CRASHED, 0] else 0.0
    info[INFO_RIGHT] = tags[TARGET_LANE, 0] / max(settings.lanes - 1, 1)
    info[INFO_FAST] = clip(pace, 0.0, 1.0)
    info[INFO_ON_ROAD] = 1.0 if on_road else 0.0
    total = (
        settings.collision_reward * info[INFO_COLLISION]
        + settings.right_lane_reward * info[INFO_RIGHT]
        + settings.high_speed_reward * info[INFO_FAST]
        + settings.on_road_reward * info[INFO_ON_ROAD]
    )
    if settings.normalize_reward:
        worst, best = settings.collision_reward, settings.high_speed_reward + settings.right_lane_reward
        total = (total - worst) / (best - worst)
    return total * info[INFO_ON_ROAD]


@kernel
def describe(cars, tags, world, info):
    """Write speed [m/s], lane, distance since reset [m] and whether it crashed into `info`."""
    info[INFO_SPEED] = cars[SPEED, 0]
    info[INFO_LANE] = tags[LANE, 0]
    info[INFO_DISTANCE] = cars[X, 0] - world[START_X]
    info[INFO_CRASHED] = tags[CRASHED, 0]
