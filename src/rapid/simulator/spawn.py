# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""The traffic at reset, draw for draw as highway-env creates it."""

import math

import numpy as np

from rapid.road import LANE_WIDTH, START_SPEED
from rapid.simulator.compile import kernel
from rapid.simulator.state import (
    ACCELERATION,
    COS,
    CRASHED,
    EXPONENT,
    HEADING,
    LANE,
    ORDER,
    PUSH_X,
    PUSH_Y,
    PUSHED,
    RANK,
    SIN,
    SPEED,
    SPEED_INDEX,
    START_X,
    STEERING,
    TARGET_LANE,
    TARGET_SPEED,
    TERMINATED,
    TIME,
    TIMER,
    TRUNCATED,
    VX,
    VY,
    X,
    Y,
)
from rapid.simulator.stream import integer_below, uniform

TRAFFIC_START_SPEED = (0.7 * 30.0, 0.8 * 30.0)


@kernel
def nearest_speed_index(speed, target_speeds):
    """Return the index of the target speed nearest to `speed`, as if the list were evenly spaced."""
    last = len(target_speeds) - 1
    place = np.rint((speed - target_speeds[0]) / (target_speeds[last] - target_speeds[0]) * last)
    return int(min(max(place, 0.0), float(last)))


@kernel
def spawn_world(cars, tags, world, stream, settings):
    """Fill one world with new traffic drawn from its stream.

    The vehicles are placed one ahead of the other, so the ego, created first, is the rearmost.
    """
    x = 0.0
    for i in range(cars.shape[1]):
        if i == 0 and settings.initial_lane >= 0:
            lane = settings.initial_lane
        else:
            lane = integer_below(stream, settings.lanes)
        speed = START_SPEED if i == 0 else uniform(stream, TRAFFIC_START_SPEED[0], TRAFFIC_START_SPEED[1])
        spacing = settings.ego_spacing if i == 0 else settings.traffic_spacing
        gap = spacing * (12.0 + speed) * settings.spacing_factor
        if i == 0:
            x = 3.0 * gap
        x += gap * uniform(stream, 0.9, 1.1)
        y = LANE_WIDTH * lane
        cars[X, i] = x
        cars[Y, i] = y
        cars[HEADING, i] = 0.0
        cars[SPEED, i] = speed
        cars[COS, i] = 1.0
        cars[SIN, i] = 0.0
        cars[VX, i] = speed
        cars[VY, i] = 0.0
        cars[TARGET_SPEED, i] = speed
        cars[TIMER, i] = ((x + y) * math.pi) % 1.0
        cars[EXPONENT, i] = 4.0 if i == 0 else uniform(stream, 3.5, 4.5)
        cars[STEERING, i] = 0.0
        cars[ACCELERATION, i] = 0.0
        cars[PUSH_X, i] = 0.0
        cars[PUSH_Y, i] = 0.0
        tags[LANE, i] = lane
        tags[TARGET_LANE, i] = lane
        tags[CRASHED, i] = 0
        tags[PUSHED, i] = 0
        tags[ORDER, i] = i
        tags[RANK, i] = i
    index = nearest_speed_index(START_SPEED, settings.target_speeds)
    cars[TARGET_SPEED, 0] = settings.target_speeds[index]
    world[TIME] = 0.0
    world[START_X] = cars[X, 0]
    world[SPEED_INDEX] = index
    world[TERMINATED] = 0.0
    world[TRUNCATED] = 0.0
