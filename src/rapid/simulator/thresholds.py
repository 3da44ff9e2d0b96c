"""How close a step's decisions were to going the other way; for judging a difference between two simulators."""

import math

import numpy as np
from numpy.typing import NDArray

from rapid.road import LANE_WIDTH
from rapid.simulator.behavior import (
    LANE_CHANGE_DELAY,
    MAX_BRAKING_IMPOSED,
    MIN_GAIN,
    act,
    braking,
    command_ego,
    desired_gap,
    free_acceleration,
    reachable,
    vehicle_ahead,
    vehicle_behind,
)
from rapid.simulator.dynamics import DIAGONAL, collide, interval_distance, move, normal, sort_by_x, span
from rapid.simulator.settings import Settings
from rapid.simulator.state import (
    CRASHED,
    EXPONENT,
    LANE,
    SPEED,
    TARGET_LANE,
    TIME,
    TIMER,
    VX,
    VY,
    Snapshot,
    X,
    Y,
)


def nearest_threshold(before: Snapshot, action: int, settings: Settings, vehicles: list[int]) -> float:
    """Return the smallest distance to a threshold among the decisions that some vehicles met within one step.

    Args:
        before: the world before the step.
        action: the meta-action of the ego.
        settings: the configuration.
        vehicles: those whose decisions count.

    Returns:
        The distance in the unit of the quantity that is compared: m/s² for the incentives of a lane change, s for its
        timer, m for gaps, lane borders and contacts, steps of the target speed for the ego's; infinity if nothing
        was decided.
    """
    cars, tags, world = before.cars.copy(), before.tags.copy(), before.world.copy()
    speeds = settings.target_speeds
    place = (cars[SPEED, 0] - speeds[0]) / (speeds[-1] - speeds[0]) * (len(speeds) - 1)
    nearest = abs(abs(place - math.floor(place)) - 0.5) if 0 in vehicles else math.inf
    command_ego(cars, tags, world, action, settings)
    for _ in range(settings.frames):
        for i in vehicles:
            nearest = min([nearest, *_margins_of_act(cars, tags, i, settings)])
        act(cars, tags, settings)
        move(cars, tags, settings)
        sort_by_x(cars, tags)
        for i in vehicles:
            between_lanes = abs(abs(cars[Y, i] - LANE_WIDTH * tags[LANE, i]) - LANE_WIDTH / 2)
            nearest = min(nearest, between_lanes)
            for j in range(cars.shape[1]):
                if j != i and abs(cars[X, j] - cars[X, i]) < 4 * LANE_WIDTH:
                    first, second = min(i, j), max(i, j)
                    nearest = min(
                        nearest, *(abs(margin) for margin in _margins_of_contact(cars, first, second, settings.dt))
                    )
        collide(cars, tags, settings)
    if 0 in vehicles:
        nearest = min(nearest, abs(world[TIME] + settings.decision_time - settings.duration))
    return float(nearest)


def _margins_of_contact(cars: NDArray[np.float64], i: int, j: int, dt: float) -> tuple[float, float, float]:
    """Return how far vehicles `i` < `j` are from being examined, from touching, and from being about to touch [m]."""
    apart = math.hypot(cars[X, j] - cars[X, i], cars[Y, j] - cars[Y, i])
    drift_x, drift_y = (cars[VX, i] - cars[VX, j]) * dt, (cars[VY, i] - cars[VY, j]) * dt
    touching = moving = -math.inf
    for body in (i, j):
        for side in range(4):
            axis_x, axis_y = normal(cars, body, side)
            low, high = span(cars, i, axis_x, axis_y)
            others = span(cars, j, axis_x, axis_y)
            touching = max(touching, interval_distance(low, high, *others))
            drift = axis_x * drift_x + axis_y * drift_y
            moving = max(moving, interval_distance(low + min(drift, 0.0), high + max(drift, 0.0), *others))
    return apart - DIAGONAL - float(cars[SPEED, i]) * dt, touching, moving


def _margins_of_act(cars: NDArray[np.float64], tags: NDArray[np.int64], i: int, settings: Settings) -> list[float]:
    if i == 0 or tags[CRASHED, i]:
        return []
    lane, target = int(tags[LANE, i]), int(tags[TARGET_LANE, i])
    if lane != target:
        return [
            margin
            for j in range(cars.shape[1])
            if j != i and tags[TARGET_LANE, j] == target and tags[LANE, j] != target
            for margin in (
                abs(cars[X, j] - cars[X, i]),
                abs(cars[X, j] - cars[X, i] - desired_gap(cars, i, j)),
            )
        ]
    margins = [abs(cars[TIMER, i] - LANE_CHANGE_DELAY)]
    if cars[TIMER, i] > LANE_CHANGE_DELAY:
        free = free_acceleration(cars, i, cars[EXPONENT, i])
        here = free - braking(cars, i, vehicle_ahead(cars, tags, i, lane))
        for side in (lane - 1, lane + 1):
            if not 0 <= side < settings.lanes or not reachable(cars, i, side):
                continue
            behind = vehicle_behind(cars, tags, i, side)
            if behind >= 0:
                imposed = free_acceleration(cars, behind, cars[EXPONENT, i]) - braking(cars, behind, i)
                margins.append(abs(imposed + MAX_BRAKING_IMPOSED))
            there = free - braking(cars, i, vehicle_ahead(cars, tags, i, side))
            margins.append(abs(there - here - MIN_GAIN))
    return margins
