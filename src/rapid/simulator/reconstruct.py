# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""A world as an observation shows it, and how close the ego is to others: what searches start from that see little."""

import math

import numpy as np

from rapid.road import CAR_LENGTH, LANE_WIDTH
from rapid.simulator.compile import kernel
from rapid.simulator.dynamics import sort_by_x
from rapid.simulator.spawn import nearest_speed_index
from rapid.simulator.state import (
    COS,
    EXPONENT,
    HEADING,
    LANE,
    ORDER,
    RANK,
    SIN,
    SPEED,
    SPEED_INDEX,
    START_X,
    TARGET_LANE,
    TARGET_SPEED,
    TIMER,
    VX,
    VY,
    X,
    Y,
)

STANDSTILL_GAP, GAP_TIME, BRAKING = 3.0, 0.5, 3.0
"""Distance that counts as close: metres, plus seconds of speed, plus what closing in takes to brake away at m/s²."""
LATERAL_TIME = 0.6
"""Seconds over which a lateral offset is steered away (``ControlledVehicle.TAU_PURSUIT`` and its lateral gain). A
lateral velocity so tells the lane aimed at."""
_CRUISE = (22.5, 24.0)
"""Speeds that traffic is taken to want where nothing is drawn, m/s: it is spawned at 21 to 24."""
_MOST_SPEED = 40.0
"""m/s; highway-env lets no car drive faster."""
_ORIGIN = 1_000.0
"""Where the ego is put on the simulator's road, m, with room behind."""


@kernel
def reconstruct(rows, settings, cars, tags, world):
    """Fill a world from what can be seen; what cannot has the simulator's default.

    Args:
        rows: float64 (N, 5), the ego first: metres ahead of the ego, y, vx, vy, and the lane aimed at.
        settings: the configuration.
        cars: float64 (CAR_ROWS, N), zeros, overwritten; the next two likewise.
        tags: int64 (TAG_ROWS, N).
        world: float64 (WORLD_ENTRIES,).
    """
    for i in range(len(rows)):
        # A perturbed observation may say anything; no car is far beside the road, drives backwards, or is that fast.
        x, y = rows[i, 0], min(max(rows[i, 1], -LANE_WIDTH), settings.lanes * LANE_WIDTH)
        forward, aside = min(max(rows[i, 2], 0.0), _MOST_SPEED), min(max(rows[i, 3], -_MOST_SPEED), _MOST_SPEED)
        speed = math.sqrt(forward * forward + aside * aside)
        heading = math.atan2(aside, forward) if speed > 0.1 else 0.0
        heading = min(max(heading, -math.pi / 4), math.pi / 4)
        cars[X, i], cars[Y, i], cars[HEADING, i], cars[SPEED, i] = _ORIGIN + x, y, heading, speed
        cars[COS, i], cars[SIN, i] = math.cos(heading), math.sin(heading)
        cars[VX, i], cars[VY, i] = speed * cars[COS, i], speed * cars[SIN, i]
        cars[TARGET_SPEED, i] = min(max(speed, _CRUISE[0]), _CRUISE[1])
        cars[TIMER, i], cars[EXPONENT, i] = 0.5, 4.0
        tags[LANE, i] = int(min(max(np.rint(y / LANE_WIDTH), 0), settings.lanes - 1))
        tags[TARGET_LANE, i] = int(rows[i, 4])
        tags[ORDER, i] = tags[RANK, i] = i
    index = nearest_speed_index(cars[SPEED, 0], settings.target_speeds)
    world[SPEED_INDEX] = index
    cars[TARGET_SPEED, 0] = settings.target_speeds[index]
    world[START_X] = cars[X, 0]
    sort_by_x(cars, tags)


@kernel
def closeness(cars, tags):
    """Return how much too close the ego is to a car on its lane or the one it heads for: 0 not at all, 1 touching."""
    worst = 0.0
    for j in range(1, cars.shape[1]):
        beside = abs(cars[Y, j] - cars[Y, 0]) < 3.0 or abs(cars[Y, j] - LANE_WIDTH * tags[TARGET_LANE, 0]) < 3.0
        if not beside and tags[TARGET_LANE, j] != tags[TARGET_LANE, 0]:
            continue
        front, rear = (j, 0) if cars[X, j] >= cars[X, 0] else (0, j)
        closing = max(cars[SPEED, rear] - cars[SPEED, front], 0.0)
        wanted = STANDSTILL_GAP + GAP_TIME * cars[SPEED, rear] + closing * closing / (2 * BRAKING)
        gap = cars[X, front] - cars[X, rear] - CAR_LENGTH
        worst = max(worst, (wanted - gap) / wanted)
    return min(worst, 1.0)
