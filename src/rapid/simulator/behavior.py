# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""What the vehicles decide in a frame: the ego's controller, IDM along the lane, MOBIL across lanes.

The rules and constants are highway-env's (``vehicle/controller.py``, ``vehicle/behavior.py``, ``road/road.py``).
Positions are fixed while vehicles act, so neighbours are found through the order by x, which the move phase keeps.
"""

import math

import numpy as np

from rapid.road import CAR_LENGTH, LANE_WIDTH
from rapid.scenarios import FASTER, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.simulator.compile import dot, kernel
from rapid.simulator.spawn import nearest_speed_index
from rapid.simulator.state import (
    ACCELERATION,
    AHEAD,
    AHEAD_LEFT,
    AHEAD_RIGHT,
    COS,
    CRASHED,
    EXPONENT,
    HEADING,
    LANE,
    ORDER,
    RANK,
    SIN,
    SPEED,
    SPEED_INDEX,
    STEERING,
    TARGET_LANE,
    TARGET_SPEED,
    TIMER,
    VX,
    VY,
    X,
    Y,
)

ROAD_LENGTH = 10_000.0
SPEED_LIMIT = 30.0
HALF_LENGTH = CAR_LENGTH / 2

SPEED_GAIN = 1 / 0.6
LATERAL_GAIN = 1 / 0.6
HEADING_GAIN = 1 / 0.2
MAX_HEADING = math.pi / 4
MAX_STEERING = math.pi / 3

MAX_ACCELERATION = 6.0
COMFORT_ACCELERATION = 3.0
GAP_WANTED = 10.0
TIME_WANTED = 1.5
TWICE_ROOT = 2 * math.sqrt(15.0)
LANE_CHANGE_DELAY = 1.0
MIN_GAIN = 0.2
MAX_BRAKING_IMPOSED = 2.0
REACH = 3.0
"""A vehicle belongs to every lane whose centre is at most this far [m]."""


@kernel
def not_zero(value):
    """Return `value`, or a hundredth of its sign where it is smaller than that."""
    if abs(value) > 0.01:
        return value
    return 0.01 if value >= 0 else -0.01


@kernel
def wrap_angle(angle):
    """Return `angle` in [-pi, pi)."""
    turned = angle + math.pi
    if not 0.0 <= turned < 2 * math.pi:
        turned %= 2 * math.pi
    return turned - math.pi


@kernel
def clip(value, low, high):
    """Return `value` limited to [low, high]."""
    return min(max(value, low), high)


@kernel
def on_lane(cars, j, lane):
    """Whether neighbours searching `lane` see vehicle `j`."""
    x = cars[X, j]
    return abs(cars[Y, j] - LANE_WIDTH * lane) <= REACH and -CAR_LENGTH <= x < ROAD_LENGTH + CAR_LENGTH


@kernel
def reachable(cars, i, lane):
    """Whether vehicle `i` is close enough to change to `lane`."""
    x = cars[X, i]
    return abs(cars[Y, i] - LANE_WIDTH * lane) <= 2 * LANE_WIDTH and 0.0 <= x < ROAD_LENGTH + CAR_LENGTH


@kernel
def _first_at(cars, tags, i):
    """Return the lowest rank among the vehicles that are exactly as far along the road as `i`."""
    rank = tags[RANK, i]
    while rank > 0 and cars[X, tags[ORDER, rank - 1]] == cars[X, i]:
        rank -= 1
    return rank


@kernel
def vehicle_ahead(cars, tags, i, lane):
    """Return the vehicle next ahead of `i` on `lane` (of several equally far ones the last listed), or -1."""
    found = -1
    for rank in range(_first_at(cars, tags, i), cars.shape[1]):
        j = tags[ORDER, rank]
        if found >= 0 and cars[X, j] > cars[X, found]:
            break
        if j != i and on_lane(cars, j, lane):
            found = j
    return found


@kernel
def _see(cars, i, lane, nearest):
    """Note vehicle `i` as the nearest on `lane` so far, coming from the front; of level ones the last listed counts."""
    if on_lane(cars, i, lane) and (nearest[lane] < 0 or cars[X, nearest[lane]] != cars[X, i]):
        nearest[lane] = i


@kernel
def look_ahead(cars, tags, settings):
    """Find for every vehicle the one next ahead on its lane and on the lanes beside it, in one pass from the front."""
    order, lanes = tags[ORDER], tags[LANE]
    nearest = np.full(settings.lanes, -1, np.int64)
    last = len(order) - 1
    for rank in range(last, -1, -1):
        i = order[rank]
        lane, x = lanes[i], cars[X, i]
        if (rank > 0 and cars[X, order[rank - 1]] == x) or (rank < last and cars[X, order[rank + 1]] == x):
            # Level with another vehicle: the pass would miss that each of them is ahead of the other.
            tags[AHEAD, i] = vehicle_ahead(cars, tags, i, lane)
            tags[AHEAD_LEFT, i] = vehicle_ahead(cars, tags, i, lane - 1)
            tags[AHEAD_RIGHT, i] = vehicle_ahead(cars, tags, i, lane + 1)
        else:
            tags[AHEAD, i] = nearest[lane]
            tags[AHEAD_LEFT, i] = nearest[lane - 1] if lane > 0 else -1
            tags[AHEAD_RIGHT, i] = nearest[lane + 1] if lane + 1 < settings.lanes else -1
        # A vehicle is seen from its own lane and, between two lanes, from the other one as well.
        y = cars[Y, i] - LANE_WIDTH * lane
        _see(cars, i, lane, nearest)
        if y <= REACH - LANE_WIDTH and lane > 0:
            _see(cars, i, lane - 1, nearest)
        elif y >= LANE_WIDTH - REACH and lane + 1 < settings.lanes:
            _see(cars, i, lane + 1, nearest)


@kernel
def _ahead_on(cars, tags, i, lane):
    """Return the vehicle next ahead of `i` on `lane`, looked up where :func:`look_ahead` found it."""
    side = lane - tags[LANE, i]
    if side == 0:
        return tags[AHEAD, i]
    if side == -1:
        return tags[AHEAD_LEFT, i]
    if side == 1:
        return tags[AHEAD_RIGHT, i]
    return vehicle_ahead(cars, tags, i, lane)


@kernel
def vehicle_behind(cars, tags, i, lane):
    """Return the vehicle next behind `i` on `lane` (of several equally far ones the first listed), or -1."""
    found = -1
    for rank in range(_first_at(cars, tags, i) - 1, -1, -1):
        j = tags[ORDER, rank]
        if found >= 0 and cars[X, j] < cars[X, found]:
            break
        if on_lane(cars, j, lane):
            found = j
    return found


@kernel
def free_acceleration(cars, i, exponent):
    """Return IDM's acceleration of vehicle `i` on an empty road, judged with an exponent that may be another's."""
    wanted = abs(not_zero(clip(cars[TARGET_SPEED, i], 0.0, SPEED_LIMIT)))
    return COMFORT_ACCELERATION * (1.0 - (max(cars[SPEED, i], 0.0) / wanted) ** exponent)


@kernel
def desired_gap(cars, i, front):
    """Return the distance that vehicle `i` wants to `front`, between their centres."""
    closing = dot(cars[VX, i] - cars[VX, front], cars[VY, i] - cars[VY, front], cars[COS, i], cars[SIN, i])
    speed = cars[SPEED, i]
    return GAP_WANTED + speed * TIME_WANTED + speed * closing / TWICE_ROOT


@kernel
def braking(cars, i, front):
    """Return IDM's deceleration of vehicle `i` because of `front`; 0 where there is none."""
    if front < 0:
        return 0.0
    ratio = desired_gap(cars, i, front) / not_zero(cars[X, front] - cars[X, i])
    return COMFORT_ACCELERATION * (ratio * ratio)


@kernel
def steer_towards(cars, i, lane):
    """Return the steering angle [rad] with which vehicle `i` heads for the centre of `lane`.

    The tangents could be simplified away, but not without rounding otherwise than highway-env does; and a vehicle that
    is almost standing amplifies a rounding error a hundredfold per frame.
    """
    lateral = cars[Y, i] - LANE_WIDTH * lane
    heading = cars[HEADING, i]
    if lateral == 0.0 and heading == 0.0:
        return 0.0
    speed = not_zero(cars[SPEED, i])
    wanted = clip(math.asin(clip(-LATERAL_GAIN * lateral / speed, -1.0, 1.0)), -MAX_HEADING, MAX_HEADING)
    turn = HEADING_GAIN * wrap_angle(wanted - heading)
    slip = math.asin(clip(HALF_LENGTH / speed * turn, -1.0, 1.0))
    return clip(math.atan(2.0 * math.tan(slip)), -MAX_STEERING, MAX_STEERING)


@kernel
def command_ego(cars, tags, world, action, settings):
    """Take over a meta-action (an index of ``rapid.scenarios.ACTIONS``): a new target lane or target speed."""
    if action in (FASTER, SLOWER):
        index = nearest_speed_index(cars[SPEED, 0], settings.target_speeds) + (1 if action == FASTER else -1)
        index = min(max(index, 0), len(settings.target_speeds) - 1)
        world[SPEED_INDEX] = index
        cars[TARGET_SPEED, 0] = settings.target_speeds[index]
    elif action in (LANE_LEFT, LANE_RIGHT):
        lane = tags[TARGET_LANE, 0] + (1 if action == LANE_RIGHT else -1)
        lane = min(max(lane, 0), settings.lanes - 1)
        if reachable(cars, 0, lane):
            tags[TARGET_LANE, 0] = lane


@kernel
def _lane_change_pays(cars, tags, i, lane, free, ahead):
    """Whether MOBIL lets vehicle `i` change to `lane`; its follower there is judged with the exponent of `i`."""
    there = free - braking(cars, i, _ahead_on(cars, tags, i, lane))
    here = free - braking(cars, i, ahead)
    if there - here < MIN_GAIN:
        return False
    behind = vehicle_behind(cars, tags, i, lane)
    if behind < 0:
        return True
    imposed = free_acceleration(cars, behind, cars[EXPONENT, i]) - braking(cars, behind, i)
    return imposed >= -MAX_BRAKING_IMPOSED


@kernel
def _give_way(cars, tags, i):
    """Call off the lane change of vehicle `i` if another one close ahead is changing to the same lane."""
    target = tags[TARGET_LANE, i]
    for j in range(cars.shape[1]):
        if j != i and tags[TARGET_LANE, j] == target and tags[LANE, j] != target:
            distance = cars[X, j] - cars[X, i]
            if 0.0 < distance < desired_gap(cars, i, j):
                tags[TARGET_LANE, i] = tags[LANE, i]
                return


@kernel
def act(cars, tags, settings):
    """Let every vehicle choose its command for this frame, in list order: lane choices are seen by those after."""
    look_ahead(cars, tags, settings)
    cars[ACCELERATION, 0] = SPEED_GAIN * (cars[TARGET_SPEED, 0] - cars[SPEED, 0])
    cars[STEERING, 0] = steer_towards(cars, 0, tags[TARGET_LANE, 0])
    for i in range(1, cars.shape[1]):
        if tags[CRASHED, i]:
            continue
        lane = tags[LANE, i]
        free = free_acceleration(cars, i, cars[EXPONENT, i])
        ahead = tags[AHEAD, i]
        if tags[TARGET_LANE, i] != lane:
            _give_way(cars, tags, i)
        elif cars[TIMER, i] > LANE_CHANGE_DELAY:
            cars[TIMER, i] = 0.0
            if abs(cars[SPEED, i]) >= 1.0:
                for side in (lane - 1, lane + 1):
                    if (
                        0 <= side < settings.lanes
                        and reachable(cars, i, side)
                        and _lane_change_pays(cars, tags, i, side, free, ahead)
                    ):
                        tags[TARGET_LANE, i] = side
        target = tags[TARGET_LANE, i]
        cars[STEERING, i] = steer_towards(cars, i, target)
        acceleration = free - braking(cars, i, ahead)
        if target != lane:
            acceleration = min(acceleration, free - braking(cars, i, _ahead_on(cars, tags, i, target)))
        cars[ACCELERATION, i] = clip(acceleration, -MAX_ACCELERATION, MAX_ACCELERATION)
