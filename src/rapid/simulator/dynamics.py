# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""How the vehicles move in a frame and what happens when they touch.

The rules are highway-env's (``vehicle/kinematics.py``, ``vehicle/objects.py``, ``utils.are_polygons_intersecting``).
"""

import math

import numpy as np

from rapid.road import CAR_WIDTH, LANE_WIDTH
from rapid.simulator.behavior import HALF_LENGTH, ROAD_LENGTH, wrap_angle
from rapid.simulator.compile import dot, kernel
from rapid.simulator.state import (
    ACCELERATION,
    COS,
    CRASHED,
    HEADING,
    LANE,
    ORDER,
    PUSH_X,
    PUSH_Y,
    PUSHED,
    RANK,
    SIN,
    SPEED,
    STEERING,
    TIMER,
    VX,
    VY,
    X,
    Y,
)

TOP_SPEED = 40.0
HALF_WIDTH = CAR_WIDTH / 2
DIAGONAL = math.sqrt(29.0)
CANDIDATES = 64
"""Pairs of vehicles close enough to be examined that a frame keeps; beyond that, all pairs are examined."""


@kernel
def _lane_distance(x, y, heading, lane):
    beyond = max(x - ROAD_LENGTH, 0.0)
    return abs(y - LANE_WIDTH * lane) + beyond + max(0.0 - x, 0.0) + abs(wrap_angle(heading))


@kernel
def closest_lane(x, y, heading, lane, lanes):
    """Return the lane nearest to a vehicle that was on `lane`; of two equally near ones the left one."""
    if abs(y - LANE_WIDTH * lane) < 0.499 * LANE_WIDTH:
        return lane
    left = min(max(math.floor(y / LANE_WIDTH), 0), lanes - 1)
    right = min(left + 1, lanes - 1)
    return right if _lane_distance(x, y, heading, right) < _lane_distance(x, y, heading, left) else left


@kernel
def move(cars, tags, settings):
    """Advance every vehicle by one frame with its command; crashed ones brake to a halt."""
    dt = settings.dt
    for i in range(cars.shape[1]):
        cars[TIMER, i] += dt
        speed = cars[SPEED, i]
        steering = cars[STEERING, i]
        acceleration = cars[ACCELERATION, i]
        if tags[CRASHED, i]:
            steering = 0.0
            acceleration = -speed
        if speed > TOP_SPEED:
            acceleration = min(acceleration, TOP_SPEED - speed)
        elif speed < -TOP_SPEED:
            acceleration = max(acceleration, -TOP_SPEED - speed)
        slip = 0.0
        if steering == 0.0:
            cars[X, i] += speed * cars[COS, i] * dt
            cars[Y, i] += speed * cars[SIN, i] * dt
        else:
            slip = math.atan(0.5 * math.tan(steering))
            cars[X, i] += speed * math.cos(cars[HEADING, i] + slip) * dt
            cars[Y, i] += speed * math.sin(cars[HEADING, i] + slip) * dt
        if tags[PUSHED, i]:
            cars[X, i] += cars[PUSH_X, i]
            cars[Y, i] += cars[PUSH_Y, i]
            tags[CRASHED, i] = 1
            tags[PUSHED, i] = 0
        if slip != 0.0:
            cars[HEADING, i] += speed * math.sin(slip) / HALF_LENGTH * dt
            cars[COS, i] = math.cos(cars[HEADING, i])
            cars[SIN, i] = math.sin(cars[HEADING, i])
        speed += acceleration * dt
        cars[SPEED, i] = speed
        cars[VX, i] = speed * cars[COS, i]
        cars[VY, i] = speed * cars[SIN, i]
        tags[LANE, i] = closest_lane(cars[X, i], cars[Y, i], cars[HEADING, i], tags[LANE, i], settings.lanes)


@kernel
def sort_by_x(cars, tags):
    """Restore the order by x, ties by list order; vehicles rarely overtake, so insertion sort is linear here."""
    order, ranks = tags[ORDER], tags[RANK]
    for rank in range(1, len(order)):
        i = order[rank]
        x = cars[X, i]
        place = rank
        while place > 0:
            j = order[place - 1]
            if cars[X, j] < x or (cars[X, j] == x and j < i):
                break
            order[place] = j
            ranks[j] = place
            place -= 1
        if place < rank:
            order[place] = i
            ranks[i] = place


@kernel
def corner(cars, i, k):
    """Return a corner of vehicle `i`: k = 0 to 3 goes rear left, rear right, front right, front left."""
    along = HALF_LENGTH if k >= 2 else -HALF_LENGTH
    across = HALF_WIDTH if k in (1, 2) else -HALF_WIDTH
    cos, sin = cars[COS, i], cars[SIN, i]
    return cos * along - sin * across + cars[X, i], sin * along + cos * across + cars[Y, i]


@kernel
def normal(cars, i, side):
    """Return the unit normal of a side of vehicle `i`, from its corners as highway-env computes it."""
    x_1, y_1 = corner(cars, i, side)
    x_2, y_2 = corner(cars, i, (side + 1) % 4)
    x, y = y_1 - y_2, x_2 - x_1
    length = math.sqrt(dot(x, y, x, y))
    return x / length, y / length


@kernel
def span(cars, i, axis_x, axis_y):
    """Return the interval that the rectangle of vehicle `i` covers along an axis."""
    low, high = math.inf, -math.inf
    for k in range(4):
        x, y = corner(cars, i, k)
        place = dot(x, y, axis_x, axis_y)
        low, high = min(low, place), max(high, place)
    return low, high


@kernel
def _centre(cars, i):
    x, y = 0.0, 0.0
    for k in range(4):
        corner_x, corner_y = corner(cars, i, k)
        x += corner_x
        y += corner_y
    return x / 4, y / 4


@kernel
def interval_distance(low_a, high_a, low_b, high_b):
    """Return how far two intervals are apart, negative where they overlap."""
    return low_b - high_a if low_a < low_b else low_a - high_b


@kernel
def _contact(cars, i, j, dt):
    """Separating-axis test of two vehicles, as they are and as their velocities displace them within the frame.

    Returns:
        Whether they intersect, whether they will, and the translation that would part them.
    """
    intersect, will_intersect = True, True
    least, push_x, push_y = math.inf, 0.0, 0.0
    drift_x, drift_y = cars[VX, i] * dt - cars[VX, j] * dt, cars[VY, i] * dt - cars[VY, j] * dt
    x_i, y_i = _centre(cars, i)
    x_j, y_j = _centre(cars, j)
    for edge in range(8):
        axis_x, axis_y = normal(cars, i if edge < 4 else j, edge % 4)
        low_i, high_i = span(cars, i, axis_x, axis_y)
        low_j, high_j = span(cars, j, axis_x, axis_y)
        if interval_distance(low_i, high_i, low_j, high_j) > 0:
            intersect = False
        drift = dot(axis_x, axis_y, drift_x, drift_y)
        if drift < 0:
            low_i += drift
        else:
            high_i += drift
        distance = interval_distance(low_i, high_i, low_j, high_j)
        if distance > 0:
            will_intersect = False
        if not intersect and not will_intersect:
            return False, False, 0.0, 0.0
        if abs(distance) < least:
            least = abs(distance)
            sign = 1.0 if dot(x_i - x_j, y_i - y_j, axis_x, axis_y) > 0 else -1.0
            push_x, push_y = sign * axis_x, sign * axis_y
    return intersect, will_intersect, least * push_x, least * push_y


@kernel
def _may_touch(cars, i, j, dt):
    """Whether two vehicles need the exact test: a cheap bound that errs on the side of yes."""
    apart_x, apart_y = cars[X, j] - cars[X, i], cars[Y, j] - cars[Y, i]
    if cars[SIN, i] == 0.0 and cars[SIN, j] == 0.0 and abs(apart_y) > 2 * HALF_WIDTH + 1e-6:
        return False  # side by side on straight courses: the usual case
    if math.sqrt(dot(apart_x, apart_y, apart_x, apart_y)) > DIAGONAL + cars[SPEED, i] * dt:
        return False
    drift_x, drift_y = (cars[VX, i] - cars[VX, j]) * dt, (cars[VY, i] - cars[VY, j]) * dt
    cos, sin = cars[COS, i], cars[SIN, i]
    turn_cos = abs(cos * cars[COS, j] + sin * cars[SIN, j])
    turn_sin = abs(cos * cars[SIN, j] - sin * cars[COS, j])
    # Apart along one axis of vehicle i, even with the displacement, means apart for the exact test as well.
    across = abs(cos * apart_y - sin * apart_x) - abs(cos * drift_y - sin * drift_x)
    if across > 1e-6 + HALF_WIDTH + HALF_LENGTH * turn_sin + HALF_WIDTH * turn_cos:
        return False
    along = abs(cos * apart_x + sin * apart_y) - abs(cos * drift_x + sin * drift_y)
    return along <= 1e-6 + HALF_LENGTH + HALF_LENGTH * turn_cos + HALF_WIDTH * turn_sin


@kernel
def _collide(cars, tags, i, j, dt):
    """Apply what the contact of `i` and a later listed `j` means; a push takes effect in the next frame."""
    intersect, will_intersect, push_x, push_y = _contact(cars, i, j, dt)
    if will_intersect:
        cars[PUSH_X, i], cars[PUSH_Y, i] = push_x / 2, push_y / 2
        cars[PUSH_X, j], cars[PUSH_Y, j] = -push_x / 2, -push_y / 2
        tags[PUSHED, i] = 1
        tags[PUSHED, j] = 1
    if intersect:
        tags[CRASHED, i] = 1
        tags[CRASHED, j] = 1


@kernel
def collide(cars, tags, settings):
    """Find and apply all collisions of this frame, pair by pair in list order: later pushes replace earlier ones."""
    dt = settings.dt
    vehicles = cars.shape[1]
    if not settings.all_collide:
        for j in range(1, vehicles):
            if _may_touch(cars, 0, j, dt):
                _collide(cars, tags, 0, j, dt)
        return
    reach = 0.0
    for i in range(vehicles):
        reach = max(reach, cars[SPEED, i])
    reach = DIAGONAL + reach * dt
    order = tags[ORDER]
    pairs = np.empty(CANDIDATES, np.int64)
    found = 0
    for rank in range(vehicles - 1):
        a = order[rank]
        for other in range(rank + 1, vehicles):
            b = order[other]
            if cars[X, b] - cars[X, a] > reach:
                break
            i, j = min(a, b), max(a, b)
            if _may_touch(cars, i, j, dt):
                if found < CANDIDATES:
                    pairs[found] = i * vehicles + j
                found += 1
    if found > CANDIDATES:
        for i in range(vehicles):
            for j in range(i + 1, vehicles):
                if _may_touch(cars, i, j, dt):
                    _collide(cars, tags, i, j, dt)
    else:
        pairs[:found].sort()
        for k in range(found):
            _collide(cars, tags, pairs[k] // vehicles, pairs[k] % vehicles, dt)
