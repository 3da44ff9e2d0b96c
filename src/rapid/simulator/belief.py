# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""Planners that do not know everything: how much of the perfect planner's lead is knowledge that no policy has.

The planner of :mod:`rapid.simulator.search` knows which speed every driver wants, when each next thinks of changing
lane, and the cars that no observation shows. Here all that is drawn at random, several times over, and the plan taken
is the one that does best in the mean of these worlds; its first action is driven, then everything is drawn anew (open-
loop feedback control: Bertsekas, "Dynamic Programming and Optimal Control"). A plan does not foresee that more will be
known when its second action is due, and the search is short, so this too is a reference and no bound.
"""

import math
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.agents.watchable import Watchable
from rapid.errors import RapidError
from rapid.scenarios import FEATURES, NUM_FEATURES, NUM_VEHICLES, Scenario, get_scenario
from rapid.simulator.compile import kernel
from rapid.simulator.drawn import Worlds, from_observation, within_reach
from rapid.simulator.observation import INFO_COLUMNS
from rapid.simulator.reconstruct import closeness
from rapid.simulator.search import compiled_worlds, have_ended, tries_of
from rapid.simulator.search_kernels import distinct, select
from rapid.simulator.settings import Settings, read_settings
from rapid.simulator.spawn import TRAFFIC_START_SPEED, nearest_speed_index
from rapid.simulator.state import (
    CAR_ROWS,
    EXPONENT,
    RANK,
    SPEED,
    TAG_ROWS,
    TARGET_LANE,
    TARGET_SPEED,
    TIMER,
    WORLD_ENTRIES,
    X,
)
from rapid.simulator.step import step_world

DRAWS = 6
"""Worlds drawn per decision; 16 were measured to gain nothing."""
WIDTH = 6
"""Sequences of actions kept per decision of a plan."""
DEPTH = 8
"""Decisions that a plan looks ahead; with 12 the planner drove slower and earned less."""
CRASH = 20.0
"""What a crash costs beside its own reward: about what the rest of an episode pays."""
FRAMES = 5
"""Frames per decision where worlds are drawn around an observation. The simulator's own 15 take three times as long
and pay only where the state is exact."""
CLOSENESS = 0.5
"""What the closest distance costs the planner that has an observation alone, in rewards per second."""
EXPONENTS = (3.5, 4.5)
"""Between which highway-env draws the exponent of its driver model."""


@kernel
def search_belief(cars, tags, world, tries, settings, width, depth, caution, crash, found):
    """Write for every action what the best plan that begins with it earns in the mean of K worlds into `found`.

    A beam search for each action over sequences of actions. A node holds a copy of every world that has not crashed.

    Args:
        cars: float64 (K, CAR_ROWS, N), the worlds drawn, with the next two; left as they are.
        tags: see `cars`.
        world: see `cars`.
        tries: int64, indices into ``settings.actions``.
        settings: the configuration.
        width: nodes kept per decision.
        depth: decisions to look ahead.
        caution: what the closest distance costs a second.
        crash: what a crash costs beside its own reward.
        found: float64 (actions,), overwritten.
    """
    draws, vehicles, speeds = cars.shape[0], cars.shape[2], len(settings.target_speeds)
    places = width * len(tries)
    all_cars = np.empty((2, places, draws, CAR_ROWS, vehicles))
    all_tags = np.empty((2, places, draws, TAG_ROWS, vehicles), np.int64)
    all_world = np.empty((2, places, draws, WORLD_ENTRIES))
    all_values, crashed = np.empty((2, places)), np.zeros((2, places, draws), np.bool_)
    kinds, alive = np.empty(places, np.int64), np.empty(places, np.bool_)
    beam, different = np.zeros(width, np.int64), np.empty(len(tries), np.int64)
    counts, info = np.empty(settings.lanes * vehicles * speeds, np.int64), np.empty(INFO_COLUMNS)
    for action in range(len(found)):
        all_cars[1, 0], all_tags[1, 0], all_world[1, 0] = cars, tags, world
        all_values[1, 0], crashed[1, 0] = 0.0, False
        kept, beam[0], best = 1, 0, -np.inf
        for t in range(depth):
            now, then = (t + 1) % 2, t % 2
            node = 0
            for parent in beam[:kept]:
                first = 0
                while crashed[now, parent, first]:
                    first += 1
                count, different[0] = 1, action
                if t > 0:
                    # Every world of a node has been commanded the same.
                    count = distinct(
                        all_cars[now, parent, first],
                        all_tags[now, parent, first],
                        all_world[now, parent, first],
                        tries,
                        settings,
                        different,
                    )
                for k in range(count):
                    value, first = all_values[now, parent], -1
                    for draw in range(draws):
                        crashed[then, node, draw] = crashed[now, parent, draw]
                        if crashed[now, parent, draw]:
                            continue
                        own_cars, own_tags = all_cars[then, node, draw], all_tags[then, node, draw]
                        own_world = all_world[then, node, draw]
                        own_cars[:], own_tags[:] = all_cars[now, parent, draw], all_tags[now, parent, draw]
                        own_world[:] = all_world[now, parent, draw]
                        meta = settings.actions[different[k]]
                        earned, ended, _ = step_world(own_cars, own_tags, own_world, meta, settings, info)
                        if caution > 0:
                            earned -= caution * closeness(own_cars, own_tags)
                        if ended:
                            crashed[then, node, draw] = True
                            earned -= crash
                        elif first < 0:
                            first = draw
                        value += earned / draws
                    all_values[then, node], alive[node], kinds[node] = value, first >= 0, 0
                    if alive[node]:
                        # As in `search_world`: alike are nodes with the same lane, cars behind and speed.
                        own_cars, own_tags = all_cars[then, node, first], all_tags[then, node, first]
                        kinds[node] = own_tags[TARGET_LANE, 0] * vehicles + own_tags[RANK, 0]
                        kinds[node] = kinds[node] * speeds + nearest_speed_index(
                            own_cars[SPEED, 0], settings.target_speeds
                        )
                    if not alive[node] or t == depth - 1:
                        best = max(best, value)
                    node += 1
            kept = select(all_values[then, :node], kinds[:node], alive[:node], counts, beam)
            if kept == 0:
                break
        found[action] = best


class ObservationPlanner(Watchable):
    """Drives by the observation alone, by plans that do well in the mean of worlds drawn at random around it.

    A yardstick for policies, which see the same: it has the simulator as its model, and takes some hundredths of a
    second per decision. What is drawn depends on the observation and the seed alone, so an episode is the same however
    many are driven beside it.

    Args:
        scenario: the road and the reward.
        draws: worlds drawn per decision.
        width: sequences of actions kept per decision of a plan.
        depth: decisions to look ahead.
        seed: what is drawn.

    Raises:
        RapidError: a number is below 1.
    """

    name = "planner-observation"
    kind = "planner"

    def __init__(
        self, scenario: str | Scenario, draws: int = DRAWS, width: int = WIDTH, depth: int = DEPTH, seed: int = 0
    ) -> None:
        named = get_scenario(scenario) if isinstance(scenario, str) else scenario
        settings = read_settings(named.config(), named.dynamics)
        self._settings = _endless(settings, FRAMES)
        self._effort, self._seed = _effort(draws, width, depth), seed

    def act(self, obs_BVF: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return one action for each observation (presence, x, y, vx, vy; the ego first; m, m/s).

        A perturbed one is read as it comes, as :func:`rapid.teacher.scene.read_scenes` does.

        Raises:
            RapidError: the array has the wrong shape or holds a number that is not finite.
        """
        seen_BVF = np.ascontiguousarray(obs_BVF, np.float32)
        if seen_BVF.ndim != 3 or seen_BVF.shape[1:] != (NUM_VEHICLES, NUM_FEATURES):
            raise RapidError(
                f"{self.name} reads observations of shape (worlds, {NUM_VEHICLES}, {NUM_FEATURES}) with the features "
                f"{', '.join(FEATURES)}, not {seen_BVF.shape}. Add the missing axis, or check the "
                "observation's settings."
            )
        if not np.isfinite(seen_BVF).all():
            world, row, feature = np.argwhere(~np.isfinite(seen_BVF))[0]
            raise RapidError(
                f"Observation {world} has {seen_BVF[world, row, feature]} as {FEATURES[feature]} of row {row}, "
                "which is not finite: check the attack or the environment that made it."
            )
        actions = np.zeros(len(obs_BVF), np.int64)
        for i, obs_VF in enumerate(seen_BVF):
            rng = np.random.default_rng((self._seed, zlib.crc32(obs_VF.tobytes())))
            worlds = from_observation(obs_VF.astype(np.float64), self._settings, self._effort.draws, rng)
            actions[i] = _decide(worlds, self._settings, self._effort, CLOSENESS, rng)
        return actions


class CarsPlanner(Watchable):
    """Knows where every near car is, how fast, and which lane it heads for; what its driver wants is drawn.

    Near is within :data:`rapid.simulator.drawn.REACH`. It stands between :class:`ObservationPlanner` and the planner
    of :mod:`rapid.simulator.search`, but does not differ from them in knowledge alone: closeness costs it nothing, and
    it does not look to the end. See the former for the arguments and what is raised. Give it to
    :func:`rapid.evaluation.rollouts.run_episodes`, or call :meth:`bind`.
    """

    name = "planner-cars"
    kind = "planner"

    def __init__(self, draws: int = DRAWS, width: int = WIDTH, depth: int = DEPTH, seed: int = 0) -> None:
        self.effort, self.seed = _effort(draws, width, depth), seed

    def bind(self, env: Any) -> "BoundCarsPlanner":
        """Return the planner of these worlds.

        Raises:
            RapidError: they are not of the compiled simulator.
        """
        return BoundCarsPlanner(self, env)


class BoundCarsPlanner:
    """The planner of one environment's worlds."""

    def __init__(self, agent: CarsPlanner, env: Any) -> None:
        self.name = agent.name
        self._agent, self._env = agent, env
        settings = compiled_worlds(env, begun=False)[1]
        self._settings = _endless(settings, settings.frames)

    def act(self, obs_BVF: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return one action for each world of the environment, 0 where the episode has ended.

        The observations are not read.
        """
        state, effort = compiled_worlds(self._env)[0], self._agent.effort
        actions = np.zeros(len(state.world), np.int64)
        for i in np.flatnonzero(~have_ended(state)):
            rng = np.random.default_rng((self._agent.seed, zlib.crc32(state.cars[i, X].tobytes())))
            worlds = within_reach(state.cars[i], state.tags[i], state.world[i], effort.draws)
            actions[i] = _decide(worlds, self._settings, effort, 0.0, rng)
        return actions


class _Effort(NamedTuple):
    draws: int
    width: int
    depth: int


def _effort(draws: int, width: int, depth: int) -> _Effort:
    if min(draws, width, depth) < 1:
        raise RapidError(f"A planner's draws, width and depth must be at least 1; got {draws}, {width}, {depth}.")
    return _Effort(draws, width, depth)


def _endless(settings: Settings, frames: int) -> Settings:
    """Return the settings with other frames per decision and no time limit: no plan foresees the end of an episode."""
    return settings._replace(duration=math.inf, frames=frames, dt=settings.decision_time / max(frames, 1))


def _decide(worlds: Worlds, settings: Settings, effort: _Effort, caution: float, rng: np.random.Generator) -> int:
    """Return the first action of the best plan, after drawing what every other driver wants in each of the worlds."""
    cars, tags, world = worlds
    others = effort.draws, cars.shape[2] - 1
    cars[:, TIMER, 1:] = rng.random(others)
    cars[:, EXPONENT, 1:] = rng.uniform(*EXPONENTS, others)
    cars[:, TARGET_SPEED, 1:] = rng.uniform(*TRAFFIC_START_SPEED, others)
    tries, values = tries_of(settings), np.empty(len(settings.actions))
    search_belief(cars, tags, world, tries, settings, effort.width, effort.depth, caution, CRASH, values)
    return int(tries[np.argmax(values[tries])])
