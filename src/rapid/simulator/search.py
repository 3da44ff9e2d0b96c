# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""Search with a perfect model: the planner that tables show as a reference, and crashes that nobody could avoid.

Nothing is drawn at random while a world drives, so a copy of it shows exactly what a plan will bring. One beam search
therefore looks at the whole rest of an episode and the plan is then followed; it beats looking ahead a few seconds at
every decision, and costs a thirtieth of it. A beam search is no upper bound: it may throw the best plan away.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.agents.watchable import Watchable
from rapid.errors import RapidError
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.simulator.behavior import command_ego
from rapid.simulator.compile import kernel
from rapid.simulator.observation import INFO_COLUMNS
from rapid.simulator.settings import Settings
from rapid.simulator.spawn import nearest_speed_index
from rapid.simulator.state import (
    CRASHED,
    RANK,
    SPEED,
    SPEED_INDEX,
    TARGET_LANE,
    TARGET_SPEED,
    TERMINATED,
    TIME,
    TRUNCATED,
    State,
)
from rapid.simulator.step import FREEZE, allocate_outputs, step_world, step_worlds

WIDTH = 48
"""Worlds that the beam keeps per decision."""
MAX_DEPTH = 60
"""Decisions that the planner looks ahead at most; of a plan that does not reach the episode's end, half is followed."""

_TRY = (IDLE, SLOWER, LANE_LEFT, LANE_RIGHT, FASTER)
"""The order in which actions are tried. Of several that command the same the first stands for all, so IDLE is first."""


class Plans(NamedTuple):
    """The best plans found for M worlds."""

    actions: NDArray[np.int64]
    """(M, T); beyond a plan's length 0."""
    lengths: NDArray[np.int64]
    """(M,): decisions until the episode or the look-ahead ends."""
    returns: NDArray[np.float64]
    """(M,): sum of the rewards along the plan, not discounted."""


@kernel
def _commanded(cars, tags, world, action, settings):
    """Return the target lane and speed that a meta-action would set; all that it does to a world."""
    lane, speed, index = tags[TARGET_LANE, 0], cars[TARGET_SPEED, 0], world[SPEED_INDEX]
    command_ego(cars, tags, world, action, settings)
    commanded = tags[TARGET_LANE, 0], cars[TARGET_SPEED, 0]
    tags[TARGET_LANE, 0], cars[TARGET_SPEED, 0], world[SPEED_INDEX] = lane, speed, index
    return commanded


@kernel
def distinct(cars, tags, world, tries, settings, found):
    """Write those of the actions `tries` that command different things into `found` and return how many they are."""
    lanes = np.empty(len(tries), np.int64)
    speeds = np.empty(len(tries))
    count = 0
    for action in tries:
        lane, speed = _commanded(cars, tags, world, settings.actions[action], settings)
        known = False
        for k in range(count):
            known = known or (lanes[k] == lane and speeds[k] == speed)
        if not known:
            lanes[count], speeds[count], found[count] = lane, speed, action
            count += 1
    return count


@kernel
def select(returns, kinds, alive, counts, beam):
    """Write the nodes to go on from into `beam` and return how many they are.

    If they are too many: the best of each kind, then the next best of each kind, then the next two, and so on, the
    higher return first. Without kinds, the beam fills with one car's ways through one gap.
    """
    best_first = np.argsort(-returns, kind="mergesort")  # stable, so that ties are broken alike everywhere
    chosen = np.zeros(len(returns), np.bool_)
    room = min(len(beam), alive.sum())
    quota = 1 if alive.sum() > room else len(returns)
    counts[:] = 0
    kept = 0
    while kept < room:
        for node in best_first:
            if kept < room and alive[node] and not chosen[node] and counts[kinds[node]] < quota:
                chosen[node] = True
                counts[kinds[node]] += 1
                beam[kept] = node
                kept += 1
        quota *= 2
    return kept


@kernel
def search_world(cars, tags, world, tries, settings, width, depth, plan):
    """Find a sequence of actions with a high sum of rewards for one world by beam search, leaving the world as it is.

    Every node is a copy of the world, two generations of them at a time: the beam's nodes are places in one array, and
    their successors are written to the other. What was taken where is kept for all generations to read the plan back.

    Args:
        cars: the world to start from, with the next two.
        tags: see `cars`.
        world: see `cars`.
        tries: int64, indices into ``settings.actions``; of equal plans the one that comes earlier here is taken.
        settings: the configuration.
        width: nodes kept per decision.
        depth: decisions to look ahead.
        plan: int64 (depth,), overwritten up to the plan's length.

    Returns:
        the return of the plan and its length.
    """
    places = width * len(tries)
    all_cars = np.empty((2, places, cars.shape[0], cars.shape[1]))
    all_tags = np.empty((2, places, tags.shape[0], tags.shape[1]), np.int64)
    all_world = np.empty((2, places, world.shape[0]))
    all_returns = np.zeros((2, places))
    parents = np.empty((depth, places), np.int64)
    taken = np.empty((depth, places), np.int64)
    kinds = np.empty(places, np.int64)
    alive = np.empty(places, np.bool_)
    beam = np.zeros(width, np.int64)
    found = np.empty(len(tries), np.int64)
    vehicles, speeds = cars.shape[1], len(settings.target_speeds)
    counts = np.empty(settings.lanes * vehicles * speeds, np.int64)
    info = np.empty(INFO_COLUMNS)

    all_cars[0, 0], all_tags[0, 0], all_world[0, 0] = cars, tags, world
    kept = 1
    best, best_length, best_node = -np.inf, 0, 0
    for t in range(depth):
        now, then = t % 2, (t + 1) % 2
        node = 0
        for parent in beam[:kept]:
            old_cars, old_tags, old_world = all_cars[now, parent], all_tags[now, parent], all_world[now, parent]
            for k in range(distinct(old_cars, old_tags, old_world, tries, settings, found)):
                new_cars, new_tags, new_world = all_cars[then, node], all_tags[then, node], all_world[then, node]
                new_cars[:], new_tags[:], new_world[:] = old_cars, old_tags, old_world
                action = settings.actions[found[k]]
                earned, terminated, truncated = step_world(new_cars, new_tags, new_world, action, settings, info)
                total = all_returns[now, parent] + earned
                all_returns[then, node] = total
                parents[t, node], taken[t, node] = parent, found[k]
                alive[node] = not (terminated or truncated)
                # Nodes are alike if the ego heads for the same lane, has as many vehicles behind it and is as fast.
                kinds[node] = new_tags[TARGET_LANE, 0] * vehicles + new_tags[RANK, 0]
                kinds[node] = kinds[node] * speeds + nearest_speed_index(new_cars[SPEED, 0], settings.target_speeds)
                if (not alive[node] or t == depth - 1) and total > best:
                    best, best_length, best_node = total, t + 1, node
                node += 1
        kept = select(all_returns[then, :node], kinds[:node], alive[:node], counts, beam)
        if kept == 0:
            break
    node = best_node
    for t in range(best_length - 1, -1, -1):
        plan[t] = taken[t, node]
        node = parents[t, node]
    return best, best_length


@kernel
def can_avoid_crash(cars, tags, world, tries, settings, depth):
    """Whether some sequence of `depth` actions keeps one world from crashing: depth first, up to the first that does.

    The arguments are those of :func:`search_world`.
    """
    if tags[CRASHED, 0]:
        return False
    if world[TERMINATED] != 0.0 or world[TRUNCATED] != 0.0:
        return True
    all_cars = np.empty((depth + 1, cars.shape[0], cars.shape[1]))
    all_tags = np.empty((depth + 1, tags.shape[0], tags.shape[1]), np.int64)
    all_world = np.empty((depth + 1, world.shape[0]))
    found = np.empty((depth, len(tries)), np.int64)
    left = np.zeros(depth, np.int64)
    info = np.empty(INFO_COLUMNS)
    all_cars[0], all_tags[0], all_world[0] = cars, tags, world
    left[0] = distinct(all_cars[0], all_tags[0], all_world[0], tries, settings, found[0])
    t = 0
    while t >= 0:
        if left[t] == 0:
            t -= 1
            continue
        left[t] -= 1
        action = settings.actions[found[t, left[t]]]
        new_cars, new_tags, new_world = all_cars[t + 1], all_tags[t + 1], all_world[t + 1]
        new_cars[:], new_tags[:], new_world[:] = all_cars[t], all_tags[t], all_world[t]
        _, terminated, truncated = step_world(new_cars, new_tags, new_world, action, settings, info)
        if new_tags[CRASHED, 0]:
            continue
        t += 1
        if t == depth or terminated or truncated:
            return True
        left[t] = distinct(new_cars, new_tags, new_world, tries, settings, found[t])
    return False


@kernel
def unavoidable_worlds(state, tries, settings, depth, doomed):
    """Overwrite `doomed`, bool (B,): whether every sequence of `depth` actions crashes the world."""
    for i in range(len(doomed)):
        doomed[i] = not can_avoid_crash(state.cars[i], state.tags[i], state.world[i], tries, settings, depth)


def plan(
    env: Any,
    worlds: Sequence[int] | None = None,
    width: int = WIDTH,
    depth: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Plans:
    """Return the best plan that a beam search finds for each world, without touching the worlds.

    Args:
        env: a compiled environment, of one world or of many.
        worlds: which; None for all.
        width: worlds that the beam keeps per decision. With 5 to the power of `depth` nothing is left out.
        depth: decisions to look ahead; None for the rest of the episode, at most :data:`MAX_DEPTH`.
        progress: called with 1 after each world.

    Raises:
        RapidError: the environment is not compiled or has not begun, or a number is out of range.
    """
    state, settings = compiled_worlds(env)
    if width < 1 or (depth is not None and depth < 1):
        raise RapidError(f"The planner's width and depth must be at least 1; got {width} and {depth}.")
    chosen = list(range(len(state.world))) if worlds is None else list(worlds)
    if any(not 0 <= i < len(state.world) for i in chosen):
        raise RapidError(f"There are worlds 0 to {len(state.world) - 1}; a plan was asked for {chosen}.")
    depths = [_decisions_left(state, settings, i) if depth is None else depth for i in chosen]
    found = Plans(
        np.zeros((len(chosen), max(depths, default=0)), np.int64),
        np.zeros(len(chosen), np.int64),
        np.zeros(len(chosen)),
    )
    tries = tries_of(settings)
    for row, i in enumerate(chosen):  # one call each: a search takes long enough to be interrupted and to be watched
        world = state.cars[i], state.tags[i], state.world[i]
        found.returns[row], found.lengths[row] = search_world(
            *world, tries, settings, width, depths[row], found.actions[row]
        )
        if progress is not None:
            progress(1)
    return found


def unavoidable(env: Any, depth: int) -> NDArray[np.bool_]:
    """Return for each world whether it crashes within `depth` decisions whatever the ego does, by exhaustive search.

    The worlds are left as they are. At most 5 to the power of `depth` plans are driven, but one that gets through ends
    the search; a world at the end of its time is safe.

    Args:
        env: a compiled environment, of one world or of many.
        depth: decisions to look ahead.

    Raises:
        RapidError: the environment is not compiled or has not begun, or the depth is not at least 1.
    """
    state, settings = compiled_worlds(env)
    if depth < 1:
        raise RapidError(f"The depth of the search must be at least 1 decision; got {depth}.")
    doomed = np.zeros(len(state.world), np.bool_)
    # Taken from the end: braking is tried first, then the lanes.
    tries = np.array([i for meta in (FASTER, IDLE, LANE_RIGHT, LANE_LEFT, SLOWER) for i in _index(settings, meta)])
    unavoidable_worlds(state, tries, settings, depth, doomed)
    return doomed


class PlannerAgent(Watchable):
    """Drives with perfect knowledge: it reads the simulator's true state and plans with the simulator itself.

    A reference for tables, neither a bound nor a policy: no observation enters. Give it to
    :func:`rapid.evaluation.rollouts.run_episodes`, or call :meth:`bind`.

    Args:
        width: worlds that the beam keeps per decision.
        depth: decisions to look ahead; None for the rest of the episode.
        progress: called with 1 for every plan made. Nearly all are made at the first decision of an episode.
    """

    def __init__(
        self,
        width: int = WIDTH,
        depth: int | None = None,
        progress: Callable[[int], None] | None = None,
        name: str = "planner",
    ) -> None:
        self.name, self.width, self.depth, self.progress = name, width, depth, progress

    def bind(self, env: Any) -> "BoundPlanner":
        """Return the planner of these worlds.

        Raises:
            RapidError: they are not of the compiled simulator.
        """
        compiled_worlds(env, begun=False)
        return BoundPlanner(self, env)


class BoundPlanner:
    """The planner of one environment's worlds. It plans anew where a world is not as its plan foresaw."""

    def __init__(self, agent: PlannerAgent, env: Any) -> None:
        self.name = agent.name
        self._agent, self._env = agent, env
        state, self._settings = compiled_worlds(env, begun=False)
        worlds = len(state.world)
        self._plans: list[NDArray[np.int64]] = [np.zeros(0, np.int64)] * worlds
        self._foreseen: State | None = None

    def act(self, obs_BVF: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return one action for each world of the environment, IDLE where the episode has ended.

        The observations are not read.
        """
        state, settings = compiled_worlds(self._env)
        ended = have_ended(state)
        as_foreseen = np.zeros(len(ended), np.bool_)
        if self._foreseen is not None:
            parts = zip(self._foreseen[:3], state[:3], strict=True)
            as_foreseen = np.logical_and.reduce([(a == b).reshape(len(ended), -1).all(1) for a, b in parts])
        has_plan = np.array([len(actions) > 0 for actions in self._plans])
        needed = np.flatnonzero(~ended & ~(as_foreseen & has_plan))
        if len(needed):
            found = plan(self._env, needed.tolist(), self._agent.width, self._agent.depth, self._agent.progress)
            for row, i in enumerate(needed):
                length = int(found.lengths[row])
                # Where the look-ahead was too short for the episode, the plan's last actions head for the unseen.
                whole = length < found.actions.shape[1]
                self._plans[i] = found.actions[row, : length if whole else max(length // 2, 1)]
        actions = np.full(len(ended), (_index(settings, IDLE) or [0])[0], np.int64)
        for i in np.flatnonzero(~ended):
            actions[i], self._plans[i] = self._plans[i][0], self._plans[i][1:]
        self._foreseen = state.copy()
        step_worlds(self._foreseen, actions, settings, FREEZE, allocate_outputs(len(ended), settings))
        return actions


def compiled_worlds(env: Any, begun: bool = True) -> tuple[State, Settings]:
    """Return the worlds and the configuration of a compiled environment, wrapped or not."""
    from rapid.simulator.env import CompiledHighwayEnv
    from rapid.simulator.vector_env import CompiledVectorEnv

    inner = getattr(env, "unwrapped", env)
    if not isinstance(inner, CompiledHighwayEnv | CompiledVectorEnv):
        raise RapidError(
            f"The planner needs the compiled simulator, whose worlds it can copy; got {type(inner).__name__}. Make the "
            'environment with simulator="compiled".'
        )
    if begun:
        inner._require_reset()
    return inner.state, inner.settings


def have_ended(state: State) -> NDArray[np.bool_]:
    """Return which worlds' episodes are over, (B,)."""
    return (state.world[:, TERMINATED] != 0) | (state.world[:, TRUNCATED] != 0)


def _decisions_left(state: State, settings: Settings, index: int) -> int:
    left = (settings.duration - state.world[index, TIME]) / settings.decision_time
    # One more than needed, because the clock adds up rounded numbers; a plan ends with its episode anyway.
    return MAX_DEPTH if left >= MAX_DEPTH - 1 else max(math.ceil(left) + 1, 1)


def _index(settings: Settings, meta: int) -> list[int]:
    """Return the place of a meta-action among the actions, in a list that is empty if it is not among them."""
    return np.flatnonzero(settings.actions == meta).tolist()


def tries_of(settings: Settings) -> NDArray[np.int64]:
    """Return the actions of a configuration in the order in which they are tried."""
    return np.array([i for meta in _TRY for i in _index(settings, meta)], np.int64)
