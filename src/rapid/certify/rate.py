"""Rates and returns that are proven: for how many decisions no attack within a radius changes anything, and what an
episode earns at least whatever the attack.

An attack may show the agent anything within the radius (L-infinity, in features scaled to +-1) of the truth; it leaves
presence alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.agents.q_agent import QAgent
from rapid.agents.saved import moved_on, remembers
from rapid.certify.bounds import ROUNDING, Bounds
from rapid.data.batch import with_rows
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.evaluation.statistics import Estimate, estimate
from rapid.networks.encoding import feature_scale
from rapid.safety import Box, IntervalFilter, margins, read_box
from rapid.scenarios import get_scenario, seeing
from rapid.seeding import numpy_stream
from rapid.simulator import make_vec
from rapid.simulator.state import State
from rapid.simulator.step import CONTINUE, allocate_outputs, step_worlds

MARGIN = 0.01
"""Metres by which the filter's room must differ from 0 to count: it is computed in single precision too."""


class Reach:
    """Which actions an agent may be brought to take by an attack within a radius: at least those that can be.

    Raises:
        RapidError: the agent has no network, or the radius makes no sense.
    """

    def __init__(self, agent: Any, radius: float) -> None:
        if not isinstance(agent, QAgent):
            raise RapidError(
                f"'{getattr(agent, 'name', type(agent).__name__)}' has no network whose bounds could be computed. "
                "Give the directory of a saved agent, or shield:BOX: before it."
            )
        self._bounds, self._network = Bounds(agent.network), agent.network
        self._size_F = feature_scale(agent.network.lanes) * read_radius(radius)
        self._size_F[0] = 0
        along, across, speed = (float(self._size_F[feature]) for feature in (1, 2, 3))
        self._box = Box(along, across, speed)

    @torch.no_grad()
    def actions(self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
        """Return the actions (B, A) that may be taken, at least one for each true observation (B, V, F).

        A memory is that of the agent's own actions, so its state (B, S) is known, whatever the attack shows.
        """
        seen_BVF = with_rows(torch.from_numpy(np.ascontiguousarray(obs_BVF, np.float32)), self._network.config.vehicles)
        state = seen_BVF.new_zeros(len(seen_BVF), 0) if state_BS is None else torch.from_numpy(state_BS)
        shield, lanes = self._network.config.shield, self._network.lanes
        if not shield:
            return (~self._beaten(seen_BVF, state).any(1)).numpy()
        box, exact_BVF = read_box(shield, lanes), seen_BVF.double()
        wide = Box(*(filters + ball for filters, ball in zip(box, self._box, strict=True)))
        tight = Box(*(filters - ball for filters, ball in zip(box, self._box, strict=True)))
        surely_BA = margins(torch, exact_BVF, lanes, wide) > MARGIN
        may_BA = margins(torch, exact_BVF, lanes, tight) >= -MARGIN
        # Where the filter leaves one action, what the network prefers does not matter.
        rows_R = (may_BA.sum(1) > 1).nonzero().squeeze(1)
        if len(rows_R):
            beaten_RAA = self._beaten(seen_BVF[rows_R], state[rows_R])
            may_BA[rows_R] &= ~(beaten_RAA & surely_BA[rows_R, :, None]).any(1)
        return may_BA.numpy()

    def _beaten(self, seen_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return where action i surely surpasses action j (B, A, A)."""
        return self._bounds.differences(seen_BVF - self._size_F, seen_BVF + self._size_F, state_BS) > ROUNDING


def read_radius(radius: float) -> float:
    """Return a radius.

    Raises:
        RapidError: it is no number from 0 to below one half.
    """
    if not 0 <= radius < 0.5:
        raise RapidError(
            f"Nothing can be certified within a radius of {radius}: expected a number from 0 to below 0.5, in features "
            "scaled to +-1, such as 0.0005."
        )
    return float(radius)


@dataclass(frozen=True)
class DecisionRates:
    """What is proven of decisions on the way that the agent drives without attack."""

    radius: float
    decisions: int
    unchanged: Estimate
    """Share in which no attack within the radius changes the action."""
    safe: Estimate
    """Share in which every action that an attack may bring about passes the filter on the truth: braking afterwards
    avoids a crash, as far as :mod:`rapid.safety` assumes rightly."""
    reachable: float
    """Actions that may be brought about, on average."""


def decisions_of(agent: QAgent, scenario: str, seeds: Sequence[int], count: int, seed: int = 0) -> tuple[Any, ...]:
    """Return `count` observations (N, V, F) that the agent decides on, drawn by chance, and their spawn seeds (N,).

    And what it remembers there (N, S), or None without memory.
    """
    env: Any = make_vec(scenario, len(seeds), config=seeing(agent.vehicles), autoreset=False)
    obs_WVF, _ = env.reset(seed=list(seeds))
    state_WS = agent.start(len(seeds)) if remembers(agent) else None
    alive_W, met, spawns, states = np.ones(len(seeds), np.bool_), list[Any](), list[Any](), list[Any]()
    while alive_W.any():
        met.append(obs_WVF[alive_W])
        spawns.append(np.asarray(seeds)[alive_W])
        action_W = agent.act(obs_WVF, state_WS)
        if state_WS is not None:
            states.append(state_WS[alive_W])
            state_WS = moved_on(agent, obs_WVF, state_WS, action_W)
        obs_WVF, _, terminated_W, truncated_W, _ = env.step(action_W)
        alive_W &= ~(terminated_W | truncated_W)
    env.close()
    obs_NVF, spawn_N = np.concatenate(met), np.concatenate(spawns)
    drawn = numpy_stream(seed, "certify").permutation(len(obs_NVF))[:count]
    return obs_NVF[drawn], spawn_N[drawn], np.concatenate(states)[drawn] if states else None


def decision_rates(
    agent: QAgent,
    scenario: str,
    seeds: Sequence[int],
    radii: Sequence[float],
    count: int,
    progress: Callable[[float], None] | None = None,
) -> list[DecisionRates]:
    """Return what is proven of `count` decisions of the agent, for each radius.

    Raises:
        RapidError: an agent or a radius that :class:`Reach` refuses, or nothing to decide.
    """
    if count < 1 or not len(seeds):
        raise RapidError("There are no decisions to certify. Ask for at least one decision and one spawn.")
    reaches = [Reach(agent, radius) for radius in radii]
    obs_NVF, spawn_N, state_NS = decisions_of(agent, scenario, seeds, count)
    passes_NA = IntervalFilter(get_scenario(scenario).lanes, "0").passes(obs_NVF)
    found: list[DecisionRates] = []
    for radius, reach in zip(radii, reaches, strict=True):
        parts: list[NDArray[np.bool_]] = []
        for first in range(0, len(obs_NVF), 8):
            some = slice(first, first + 8)
            parts.append(reach.actions(obs_NVF[some], None if state_NS is None else state_NS[some]))
            if progress is not None:
                progress(len(parts[-1]))
        may_NA = np.concatenate(parts)
        spawns = [int(spawn) for spawn in spawn_N]
        found.append(
            DecisionRates(
                radius,
                len(obs_NVF),
                estimate((may_NA.sum(1) == 1).astype(float), spawns),
                estimate((~may_NA | passes_NA).all(1).astype(float), spawns),
                float(may_NA.sum(1).mean()),
            )
        )
    return found


@dataclass(frozen=True)
class CertifiedReturn:
    """What an episode earns at least, whatever an attack within the radius does at any of its steps."""

    seed: int
    clean: float
    """What it earns without attack."""
    least: float
    """The proven lower bound."""
    complete: bool
    """Whether the tree of reachable actions was followed to the end; if not, what is left is counted as nothing."""
    crash_free: bool
    """Whether it is proven that no attack brings about a crash."""


def check_reward(scenario: str) -> None:
    """Check that what lies beyond a tree can be counted as nothing.

    Raises:
        RapidError: the reward can be negative.
    """
    if get_scenario(scenario).reward != "normalized":
        raise RapidError(
            "A certified return needs a reward that is never negative, so that what lies beyond the tree counts as "
            "nothing. Choose a scenario without :progress."
        )


def certified_return(agent: QAgent, scenario: str, seed: int, radius: float, width: int = 256) -> CertifiedReturn:
    """Follow every action that an attack may bring about, step by step, in copies of the true world (CROP's tree).

    Worlds that have come to the same state are one from then on, with the lesser return, and who has earned as much as
    an episode that has ended is not followed. No other state is left out: where more than `width` differ, the bound is
    what has been earned by then, for the least that may be left is nothing.

    Raises:
        RapidError: an agent or a radius that :class:`Reach` refuses, or a reward that can be negative.
    """
    reach = Reach(agent, radius)
    check_reward(scenario)
    clean = float(run_episodes(agent, scenario, [seed]).return_E[0])
    env: Any = make_vec(scenario, 1, config=seeing(agent.vehicles), autoreset=False)
    obs_WVF, _ = env.reset(seed=[seed])
    settings, state = env.settings, env.state.copy()
    env.close()
    memory_WS = agent.start(1) if remembers(agent) else None
    earned_W, ended, crashed = np.zeros(1), list[float](), False
    while 0 < len(earned_W) <= width:
        may_WA = reach.actions(obs_WVF, memory_WS)
        # What it does without attack is among them, whatever rounding does to the bounds.
        may_WA[np.arange(len(may_WA)), agent.act(obs_WVF, memory_WS)] = True
        worlds, actions = np.nonzero(may_WA)
        if memory_WS is not None:
            memory_WS = moved_on(agent, obs_WVF[worlds], memory_WS[worlds], actions)
        state, out = state.take(worlds), allocate_outputs(len(worlds), settings)
        step_worlds(state, actions, settings, CONTINUE, out)
        earned_W, over_W = earned_W[worlds] + out.rewards, out.terminated | out.truncated
        ended += earned_W[over_W].tolist()
        crashed |= bool(out.terminated.any())
        # A world that has earned as much as one that has ended cannot lower the bound any more.
        kept = np.flatnonzero(~over_W & (earned_W < min(ended, default=np.inf)))
        known_WS = np.zeros((len(over_W), 0), np.float32) if memory_WS is None else memory_WS
        kept = kept[_distinct(state.take(kept), known_WS[kept], earned_W[kept])]
        state, earned_W, obs_WVF = state.take(kept), earned_W[kept], out.observations[kept]
        memory_WS = None if memory_WS is None else memory_WS[kept]
    complete = not len(earned_W)
    return CertifiedReturn(seed, clean, min([*ended, *earned_W.tolist()]), complete, complete and not crashed)


def _distinct(state: State, known_WS: NDArray[np.float32], earned_W: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return of worlds in the same state, and of which the same is remembered, the one that has earned least, each."""
    least: dict[bytes, int] = {}
    for world in range(len(earned_W)):
        parts = (state.cars[world], state.tags[world], state.world[world], known_WS[world])
        key = b"".join(part.tobytes() for part in parts)
        if key not in least or earned_W[world] < earned_W[least[key]]:
            least[key] = world
    return np.array(sorted(least.values()), np.int64)
