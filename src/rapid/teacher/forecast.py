"""A look a few seconds ahead, for every action: others follow their own model, the ego acts, then holds or brakes.

The roll-out knows what the observation says and nothing else. Each other car keeps its distance by the intelligent
driver model with the simulator's default parameters, finishes the lane change that its lateral velocity shows, and
wants to drive as fast as cars here do. The ego tracks its target speed and lane as the simulator's own controller does.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.road import CAR_LENGTH, CAR_WIDTH, LANE_WIDTH
from rapid.scenarios import NUM_ACTIONS
from rapid.simulator.compile import kernel
from rapid.teacher.scene import LATERAL_TIME, Scene

HORIZON = 4.0
"""Seconds looked ahead."""
STEP = 0.2
"""Seconds of one step of the roll-out."""
CRUISE = 22.5
"""Mean speed at which the simulator spawns traffic, and which a slower driver is taken to want, m/s."""
NO_CAR = 99.0
"""The gap given when no car comes near, m."""


class Forecast(NamedTuple):
    """What would happen after an action, with the ego holding its lane and speed afterwards or braking."""

    hold_gap: float
    """Smallest gap, bumper to bumper, to a car in its way if it holds speed, m; at most `NO_CAR`, 0 in a crash."""
    hold_crash: float
    """Seconds until the crash if it holds speed; infinite without one."""
    brake_gap: float
    """The same gap if it brakes from the next decision on, m."""
    brake_crash: float
    """The same time if it brakes from the next decision on."""


def forecast(scene: Scene) -> tuple[Forecast, ...]:
    """Return the forecast of each of the five actions."""
    cars = np.array([(c.ahead, c.side, c.speed, c.drift, c.toward) for c in scene.cars]).reshape(-1, 5)
    lanes = np.array([scene.lane_after(action) for action in range(NUM_ACTIONS)], dtype=np.float64)
    speeds = np.array([scene.speed_after(action) for action in range(NUM_ACTIONS)])
    result_A4 = _roll_out(cars, scene.speed, scene.side, lanes, speeds)
    return tuple(Forecast(*row) for row in result_A4.tolist())


@kernel
def _idm(
    i: int,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    v: NDArray[np.float64],
    aim: NDArray[np.float64],
    want: float,
) -> float:  # pragma: no cover - compiled
    """Intelligent driver model with highway-env's defaults, towards the nearest car ahead on the lane aimed at."""
    nearest, front = np.inf, -1
    for j in range(x.size):
        distance = x[j] - x[i]
        if 0.0 <= distance < nearest and j != i and abs(y[j] - LANE_WIDTH * aim[i]) <= 3.0:
            nearest, front = distance, j
    free = max(v[i], 0.0) / want
    free *= free
    acceleration = 3.0 * (1.0 - free * free)
    if front >= 0:
        wanted = 10.0 + 1.5 * v[i] + v[i] * (v[i] - v[front]) / (2.0 * np.sqrt(15.0))
        ratio = wanted / max(nearest, 0.01)
        acceleration -= 3.0 * ratio * ratio
    return min(max(acceleration, -6.0), 6.0)


@kernel
def _follow(
    cars_V5: NDArray[np.float64], speed: float, side: float, lane: float, target: float, braking: bool
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Roll one action out; row 0 of the state is the ego."""
    count = cars_V5.shape[0] + 1
    x, y, v, aim = np.zeros(count), np.empty(count), np.empty(count), np.empty(count)
    x[1:], y[1:], v[1:], aim[1:] = cars_V5[:, 0], cars_V5[:, 1], cars_V5[:, 2], cars_V5[:, 4]
    y[0], v[0], aim[0] = side, speed, lane
    want = np.maximum(v, CRUISE)
    acceleration = np.empty(count)
    smallest = NO_CAR
    steps, decision = round(HORIZON / STEP), round(1.0 / STEP)
    for step in range(steps):
        if braking and step > 0 and step % decision == 0:
            # One SLOWER per decision, each stepping down from the speed reached.
            target = max(4.0 * np.round(v[0] / 4.0) - 4.0, 0.0)
        acceleration[0] = (target - v[0]) / 0.6
        for i in range(1, count):
            acceleration[i] = _idm(i, x, y, v, aim, want[i])
        for i in range(count):
            # A car cannot slide sideways: the simulator bounds its heading by 45 degrees.
            bound = 0.7 * abs(v[i])
            y[i] += min(max((LANE_WIDTH * aim[i] - y[i]) / LATERAL_TIME, -bound), bound) * STEP
            x[i] += v[i] * STEP
            v[i] = max(v[i] + acceleration[i] * STEP, 0.0)
        for i in range(1, count):
            if abs(y[i] - y[0]) < CAR_WIDTH:
                gap = abs(x[i] - x[0]) - CAR_LENGTH
                if gap <= 0.0:
                    return 0.0, (step + 1) * STEP
                smallest = min(smallest, gap)
    return smallest, np.inf


@kernel
def _roll_out(
    cars_V5: NDArray[np.float64],
    speed: float,
    side: float,
    lanes_A: NDArray[np.float64],
    speeds_A: NDArray[np.float64],
) -> NDArray[np.float64]:  # pragma: no cover - compiled
    result_A4 = np.empty((lanes_A.size, 4))
    for action in range(lanes_A.size):
        for braking in range(2):
            gap, crash = _follow(cars_V5, speed, side, lanes_A[action], speeds_A[action], braking == 1)
            result_A4[action, 2 * braking] = gap
            result_A4[action, 2 * braking + 1] = crash
    return result_A4
