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
from rapid.simulator.search_kernels import search_world, unavoidable_worlds
from rapid.simulator.settings import Settings
from rapid.simulator.state import TERMINATED, TIME, TRUNCATED, State
from rapid.simulator.step import FREEZE, allocate_outputs, step_worlds

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
        inner._require_reset()  # pyright: ignore[reportPrivateUsage]
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
