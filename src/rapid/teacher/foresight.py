# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""How well one can drive on after each action: a search a few seconds ahead in the compiled simulator.

The simulator is started from the observation, not from the world: what cannot be seen has its documented default (the
time of the next thought of a lane change, the exponent of the driver model) or is feared (traffic just beyond the
farthest car seen, as slow as the slowest on its lane). Without that fear a car that needs 80 m to brake drives at
25 m/s into traffic of which it sees 40 m. The others follow and overtake by their own rules, lane changes included.

For every action a beam search then looks for the best way on: the longest without a crash and, of those, the one with
the highest sum of rewards less a penalty for driving close. The facts tell what was found, not what to do.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rapid.road import LANE_WIDTH
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, NUM_VEHICLES, SLOWER, Scenario
from rapid.simulator.compile import kernel
from rapid.simulator.configuration import merge_config
from rapid.simulator.observation import INFO_COLUMNS
from rapid.simulator.reconstruct import BRAKING, GAP_TIME, STANDSTILL_GAP, closeness, reconstruct
from rapid.simulator.search_kernels import distinct, select
from rapid.simulator.settings import Settings, read_settings
from rapid.simulator.spawn import nearest_speed_index
from rapid.simulator.state import CAR_ROWS, RANK, SPEED, TAG_ROWS, TARGET_LANE, WORLD_ENTRIES, X
from rapid.simulator.step import step_world
from rapid.teacher.scene import Scene

DEPTH = 6
"""Decisions, and so seconds, looked ahead, the action included."""
WIDTH = 6
"""Worlds kept per decision; more were measured to gain nothing."""
FRAMES = 5
"""Frames per decision; the simulator's own 15 gain nothing and take three times as long."""
BEYOND = 8.0
"""Metres behind the farthest car seen at which unseen traffic is feared."""
CLOSENESS = 3.0
"""What the closest distance costs, in rewards per second; the reward itself is at most 1."""
CAUTION = (DEPTH, WIDTH, FRAMES, BEYOND, CLOSENESS, STANDSTILL_GAP, GAP_TIME, BRAKING)
"""Everything above, which shapes the facts and so the prompts."""

_TRIES = np.array([IDLE, SLOWER, LANE_LEFT, LANE_RIGHT, FASTER])
"""Order of trying; of actions that command the same the first stands for all."""


class WayOn(NamedTuple):
    """The best way on that was found after an action."""

    seconds: float
    """Seconds without a crash; `DEPTH` if none was foreseen."""
    distance: float
    """Metres driven on it."""
    value: float
    """Rewards on it, less the penalty for driving close. Comparable where `seconds` is the same."""


@lru_cache(2048)
def look_ahead(scene: Scene) -> tuple[WayOn, ...]:
    """Return the best way on after each of the five actions.

    The last scenes are remembered: those who judge a choice ask again for what the chooser was told.
    """
    rows = [(0.0, scene.side, scene.speed, scene.drift, scene.lane)]
    rows += [(car.ahead, car.side, car.speed, car.drift, car.toward) for car in scene.cars]
    if len(scene.cars) >= NUM_VEHICLES - 1:
        rows += _feared(scene)
    found_A3 = np.zeros((NUM_ACTIONS, 3))
    _search(np.array(rows), _settings(scene.lanes), _TRIES, WIDTH, DEPTH, found_A3)
    return tuple(WayOn(*row) for row in found_A3.tolist())


def _feared(scene: Scene) -> list[tuple[float, float, float, float, int]]:
    """Return a car on each lane just beyond those seen: the observation had no room for more."""
    ahead = max(abs(car.ahead) for car in scene.cars) + BEYOND
    mean = sum(car.speed for car in scene.cars) / len(scene.cars)
    feared: list[tuple[float, float, float, float, int]] = []
    for lane in range(scene.lanes):
        speed = min((car.speed for car in scene.cars if lane in car.lanes), default=mean)
        feared.append((ahead, LANE_WIDTH * lane, speed, 0.0, lane))
    return feared


@lru_cache
def _settings(lanes: int) -> Settings:
    """Return the simulator's settings for looking ahead on a road with `lanes` lanes; nothing ends an episode."""
    scenario = Scenario(lanes, density=1.0)
    settings = read_settings(merge_config({}, scenario.config()), scenario.dynamics)
    return settings._replace(duration=math.inf, frames=FRAMES, dt=1 / FRAMES)


@kernel
def _step(cars, tags, world, action, settings, info):
    """Drive a world through a decision; return what it earned and whether it ended."""
    earned, terminated, _ = step_world(cars, tags, world, settings.actions[action], settings, info)
    return earned - CLOSENESS * closeness(cars, tags), terminated


@kernel
def _search(rows, settings, tries, width, depth, found):
    """Write for every action the seconds, metres and value of its best way on into `found` (actions, 3).

    A beam search for each action, over two generations of copies of the world. See `search_world` in
    :mod:`rapid.simulator.search`, which reads back the plan as well and needs no caution: it knows the world.
    """
    vehicles, speeds, places = len(rows), len(settings.target_speeds), width * len(tries)
    start_cars, start_tags = np.zeros((CAR_ROWS, vehicles)), np.zeros((TAG_ROWS, vehicles), np.int64)
    start_world = np.zeros(WORLD_ENTRIES)
    reconstruct(rows, settings, start_cars, start_tags, start_world)
    all_cars = np.empty((2, places, CAR_ROWS, vehicles))
    all_tags = np.empty((2, places, TAG_ROWS, vehicles), np.int64)
    all_world = np.empty((2, places, WORLD_ENTRIES))
    all_values = np.empty((2, places))
    kinds, alive = np.empty(places, np.int64), np.empty(places, np.bool_)
    beam, different = np.zeros(width, np.int64), np.empty(len(tries), np.int64)
    counts, info = np.empty(settings.lanes * vehicles * speeds, np.int64), np.empty(INFO_COLUMNS)
    for action in range(len(tries)):
        all_cars[0, 0], all_tags[0, 0], all_world[0, 0] = start_cars, start_tags, start_world
        value, ended = _step(all_cars[0, 0], all_tags[0, 0], all_world[0, 0], action, settings, info)
        all_values[0, 0] = value
        found[action, 0] = 0.0 if ended else 1.0
        found[action, 1], found[action, 2] = all_cars[0, 0, X, 0] - start_cars[X, 0], value
        kept, beam[0] = 0 if ended else 1, 0
        for t in range(1, depth):
            if kept == 0:
                break
            now, then = (t - 1) % 2, t % 2
            node = 0
            for parent in beam[:kept]:
                old_cars, old_tags, old_world = all_cars[now, parent], all_tags[now, parent], all_world[now, parent]
                for k in range(distinct(old_cars, old_tags, old_world, tries, settings, different)):
                    cars, tags, world = all_cars[then, node], all_tags[then, node], all_world[then, node]
                    cars[:], tags[:], world[:] = old_cars, old_tags, old_world
                    earned, ended = _step(cars, tags, world, different[k], settings, info)
                    value = all_values[now, parent] + earned
                    all_values[then, node], alive[node] = value, not ended
                    # As in `search_world`: alike are worlds with the same lane, cars behind and speed.
                    kinds[node] = tags[TARGET_LANE, 0] * vehicles + tags[RANK, 0]
                    kinds[node] = kinds[node] * speeds + nearest_speed_index(cars[SPEED, 0], settings.target_speeds)
                    if not ended and (found[action, 0] < t + 1 or value > found[action, 2]):
                        found[action, 0], found[action, 2] = t + 1, value
                        found[action, 1] = cars[X, 0] - start_cars[X, 0]
                    node += 1
            kept = select(all_values[then, :node], kinds[:node], alive[:node], counts, beam)
