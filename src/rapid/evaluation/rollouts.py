"""Driving: an agent over many spawn seeds side by side, clean or with its observations attacked.

The agent sees what the attack leaves of the observation; everything measured comes from the true one.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

import rapid
from rapid.errors import RapidError
from rapid.evaluation.agents import Driver, driver_for, kind_of
from rapid.evaluation.metrics import EpisodeRow, Kind, time_to_collision
from rapid.evaluation.recording import Recording
from rapid.scenarios import ACTIONS, IDLE, NUM_ACTIONS, get_scenario
from rapid.seeding import torch_stream
from rapid.simulator import Simulator

NO_ATTACK = "none"
MAX_WORLDS = 256
"""Worlds that are stepped at once; more seeds are driven in turns."""


class AttackLike(Protocol):
    """What an attack must be (see `rapid.attacks`)."""

    @property
    def needs_gradient(self) -> bool:
        """Whether the agent's network is differentiated."""
        ...

    def __call__(self, network: Any, obs_BVF: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Return what the agent sees instead."""
        ...


@dataclass(frozen=True)
class Episodes:
    """E finished episodes of one agent, in the order of their spawn seeds."""

    scenario: str
    agent: str
    attack: str
    seed_E: NDArray[np.int64]
    return_E: NDArray[np.float64]
    length_E: NDArray[np.int64]
    crashed_E: NDArray[np.bool_]
    speed_E: NDArray[np.float64]
    """Mean speed, m/s."""
    distance_E: NDArray[np.float64]
    lane_changes_E: NDArray[np.int64]
    min_ttc_E: NDArray[np.float64]
    """Least time to collision, seconds; NaN where the ego never came nearer to a leading vehicle."""
    counts_EA: NDArray[np.int64]
    """How often each action was taken."""
    decision_seconds: float
    """Wall time of the agent, all decisions together."""
    kind: Kind = "learned"
    has_network: bool = False
    gradient_attack: bool = False
    recordings: list[Recording] = field(default_factory=list[Recording])

    def __len__(self) -> int:
        return len(self.seed_E)

    def rows(self, training_seed: int | None = None, commit: str = "") -> list[EpisodeRow]:
        """Return one row per episode."""
        per_decision = 1e3 * self.decision_seconds / max(int(self.length_E.sum()), 1)
        return [
            EpisodeRow(
                scenario=self.scenario,
                agent=self.agent,
                seed=int(self.seed_E[i]),
                attack=self.attack,
                episode_return=float(self.return_E[i]),
                length=int(self.length_E[i]),
                crashed=bool(self.crashed_E[i]),
                mean_speed=float(self.speed_E[i]),
                distance=float(self.distance_E[i]),
                lane_changes=int(self.lane_changes_E[i]),
                min_ttc=float(self.min_ttc_E[i]),
                shares=tuple(float(share) for share in self.counts_EA[i] / max(int(self.length_E[i]), 1)),
                decision_ms=per_decision,
                training_seed=training_seed,
                commit=commit,
                kind=self.kind,
                has_network=self.has_network,
                gradient_attack=self.gradient_attack,
            )
            for i in range(len(self))
        ]


def is_applicable(agent: Any, attack: AttackLike | str | None) -> bool:
    """Whether the attack can be made on the agent: a gradient attack needs the agent's network."""
    resolved = _resolve(attack, lanes=1)[1]
    return resolved is None or not resolved.needs_gradient or _network(agent) is not None


def run_episodes(
    agent: Any,
    scenario: str,
    seeds: Sequence[int],
    attack: AttackLike | str | None = None,
    generator_seed: int = 0,
    record: bool = False,
    simulator: Simulator = "compiled",
    progress: Callable[[float], None] | None = None,
) -> Episodes:
    """Drive one episode for each spawn seed and return what was measured.

    `agent` has ``act(obs_BVF) -> actions``, or is a teacher with ``decide``, or needs the worlds themselves and has
    ``bind(env) -> agent``. `attack` is an attack or its name. `progress` is called with the number of episodes that
    have just ended. The noise of an episode depends on `generator_seed`, its spawn seed and the step, not on the
    episodes beside it; only a gradient attack with a random start draws for all worlds of a step together.

    Raises:
        RapidError: no seeds, or a gradient attack on an agent without a network.
    """
    if len(seeds) == 0:
        raise RapidError("There are no spawn seeds to drive. Ask for at least one episode.")
    lanes = get_scenario(scenario).lanes
    attack_name, resolved = _resolve(attack, lanes)
    network = _network(agent)
    if resolved is not None and resolved.needs_gradient and network is None:
        raise RapidError(
            f"The attack '{attack_name}' needs the gradient of a network, and '{_name(agent)}' has none. Leave the "
            "attack out for this agent: the cell is not applicable."
        )
    parts: list[_Worlds] = []
    for first in range(0, len(seeds), MAX_WORLDS):
        worlds = _Worlds(np.asarray(seeds[first : first + MAX_WORLDS], np.int64), record)
        env = rapid.make_vec(scenario, len(worlds.seed_B), simulator=simulator, autoreset=False)
        try:
            driver = driver_for(agent, env, generator_seed)
            worlds.drive(env, driver, _Perturbation(resolved, network, generator_seed, worlds.seed_B), lanes, progress)
        finally:
            env.close()
        parts.append(worlds)

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts])

    length_E, ttc_E = joined("length_B"), joined("ttc_B")
    episodes = Episodes(
        scenario=scenario,
        agent=_name(agent),
        attack=attack_name,
        seed_E=joined("seed_B"),
        return_E=joined("return_B"),
        length_E=length_E,
        crashed_E=joined("crashed_B"),
        speed_E=joined("speed_B") / np.maximum(length_E, 1),
        distance_E=joined("distance_B"),
        lane_changes_E=joined("lane_changes_B"),
        min_ttc_E=np.where(np.isinf(ttc_E), np.nan, ttc_E),
        counts_EA=joined("counts_BA"),
        decision_seconds=sum(part.decision_seconds for part in parts),
        kind=kind_of(agent),
        has_network=network is not None,
        gradient_attack=resolved is not None and resolved.needs_gradient,
    )
    for part in parts:
        episodes.recordings.extend(part.recordings(_name(agent), scenario, attack_name))
    return episodes


def evaluate_agent(
    agent: Any,
    scenario: str,
    seeds: Sequence[int],
    attacks: Iterable[str] = (NO_ATTACK,),
    *,
    generator_seed: int = 0,
    training_seed: int | None = None,
    commit: str = "",
    simulator: Simulator = "compiled",
    progress: Callable[[float], None] | None = None,
) -> list[EpisodeRow]:
    """Drive `agent` under each attack that can be made on it and return the rows; the others get none."""
    rows: list[EpisodeRow] = []
    for attack in attacks:
        if is_applicable(agent, attack):
            episodes = run_episodes(
                agent, scenario, seeds, attack, generator_seed, simulator=simulator, progress=progress
            )
            rows += episodes.rows(training_seed, commit)
        elif progress is not None:
            progress(len(seeds))
    return rows


def _name(agent: Any) -> str:
    return str(getattr(agent, "name", type(agent).__name__))


def _network(agent: Any) -> torch.nn.Module | None:
    network = getattr(agent, "network", None)
    return network if isinstance(network, torch.nn.Module) else None


def _resolve(attack: AttackLike | str | None, lanes: int) -> tuple[str, AttackLike | None]:
    """Return the attack's name and the attack on a road with `lanes` lanes; None is no attack."""
    if attack is None or attack == NO_ATTACK:
        return NO_ATTACK, None
    if isinstance(attack, str):
        from rapid.attacks import get_attack

        return attack, get_attack(attack, lanes)
    return str(getattr(attack, "name", type(attack).__name__)), attack


class _Perturbation:
    """An attack, the network it reads and one stream of noise per episode."""

    def __init__(
        self, attack: AttackLike | None, network: torch.nn.Module | None, seed: int, spawns: NDArray[np.int64]
    ) -> None:
        self.attack, self.network = attack, network
        self._batch = torch_stream(seed, "attack/batch")
        self._streams = [torch_stream(seed, f"attack/{spawn}") for spawn in spawns] if attack is not None else []

    def __call__(self, obs_BVF: NDArray[np.float32], worlds: NDArray[np.int64]) -> NDArray[np.float32]:
        if self.attack is None:
            return obs_BVF
        obs = torch.from_numpy(np.ascontiguousarray(obs_BVF))
        if self.attack.needs_gradient and self.network is not None:
            device = next(self.network.parameters()).device
            seen = self.attack(self.network, obs.to(device), self._batch)
        else:
            each = [self.attack(self.network, obs[i : i + 1], self._streams[world]) for i, world in enumerate(worlds)]
            seen = torch.cat(each)
        return seen.detach().cpu().numpy().astype(np.float32, copy=False)


class _Worlds:
    """B worlds under way and what has been measured of them; a finished one counts no further."""

    def __init__(self, seed_B: NDArray[np.int64], record: bool) -> None:
        count = len(seed_B)
        self.seed_B = seed_B
        self.return_B, self.speed_B, self.distance_B = (np.zeros(count) for _ in range(3))
        self.length_B, self.lane_changes_B = (np.zeros(count, np.int64) for _ in range(2))
        self.crashed_B = np.zeros(count, np.bool_)
        self.ttc_B = np.full(count, np.inf)
        self.counts_BA = np.zeros((count, NUM_ACTIONS), np.int64)
        self.decision_seconds = 0.0
        self._steps: list[list[_Step]] | None = [[] for _ in range(count)] if record else None

    def drive(
        self,
        env: Any,
        driver: Driver,
        perturb: _Perturbation,
        lanes: int,
        progress: Callable[[float], None] | None,
    ) -> None:
        """Step all worlds until every one has ended."""
        obs_BVF, _ = env.reset(seed=self.seed_B.tolist())
        obs_BVF = np.array(obs_BVF, np.float32)
        start_B = obs_BVF[:, 0, 1].astype(np.float64)
        lane_B = _lane(obs_BVF, lanes)
        self.ttc_B = np.minimum(self.ttc_B, time_to_collision(obs_BVF))
        alive_B = np.ones(len(self.seed_B), np.bool_)
        step = 0
        while alive_B.any():
            worlds = np.flatnonzero(alive_B)
            seen_BVF = obs_BVF.copy()
            seen_BVF[worlds] = perturb(obs_BVF[worlds], worlds)
            began = time.perf_counter()
            chosen = driver.choose(seen_BVF, worlds, self.seed_B, step)
            self.decision_seconds += time.perf_counter() - began
            self._check(chosen, len(worlds))
            action_B = np.full(len(self.seed_B), IDLE, np.int64)
            action_B[worlds] = chosen
            if self._steps is not None:
                said = driver.commentary(seen_BVF, worlds)
                for i, world in enumerate(worlds):
                    self._steps[world].append(_Step(obs_BVF[world].copy(), int(chosen[i]), *said[i]))
            # Copied: an environment may write its next observation into the same memory.
            obs_BVF, reward_B, terminated_B, truncated_B, info = env.step(action_B)
            obs_BVF = np.array(obs_BVF, np.float32)
            self.return_B[worlds] += np.asarray(reward_B, np.float64)[worlds]
            self.length_B[worlds] += 1
            self.counts_BA[worlds, chosen] += 1
            self.crashed_B[worlds] = np.asarray(info["crashed"], np.bool_)[worlds]
            self.speed_B[worlds] += np.asarray(info["speed"], np.float64)[worlds]
            self.distance_B[worlds] = obs_BVF[worlds, 0, 1] - start_B[worlds]
            new_lane_B = _lane(obs_BVF, lanes)
            self.lane_changes_B[worlds] += (new_lane_B != lane_B)[worlds]
            lane_B = new_lane_B
            self.ttc_B[worlds] = np.minimum(self.ttc_B[worlds], time_to_collision(obs_BVF[worlds]))
            if self._steps is not None:
                for world in worlds:
                    last = self._steps[world][-1]
                    last.reward, last.after = float(reward_B[world]), obs_BVF[world].copy()
            ended_B = alive_B & (np.asarray(terminated_B, np.bool_) | np.asarray(truncated_B, np.bool_))
            alive_B &= ~ended_B
            if progress is not None and ended_B.any():
                progress(int(ended_B.sum()))
            step += 1

    @staticmethod
    def _check(chosen: NDArray[np.int64], expected: int) -> None:
        if chosen.shape != (expected,) or (chosen < 0).any() or (chosen >= NUM_ACTIONS).any():
            raise RapidError(
                f"The agent answered {chosen.tolist()!r} for {expected} worlds; expected as many actions, each one of "
                f"{', '.join(f'{i} {name}' for i, name in enumerate(ACTIONS))}."
            )

    def recordings(self, agent: str, scenario: str, attack: str) -> list[Recording]:
        """Return the recorded episodes, if any."""
        found: list[Recording] = []
        for world, steps in enumerate(self._steps or []):
            values = [step.q_A for step in steps]
            found.append(
                Recording(
                    agent=agent,
                    scenario=scenario,
                    seed=int(self.seed_B[world]),
                    attack=attack,
                    obs_TVF=np.stack([*(step.before for step in steps), steps[-1].after]),
                    action_T=np.array([step.action for step in steps], np.int64),
                    reward_T=np.array([step.reward for step in steps], np.float64),
                    crashed=bool(self.crashed_B[world]),
                    q_TA=np.stack([q for q in values if q is not None]) if values[0] is not None else None,
                    explanations=tuple(step.said for step in steps) if any(step.said for step in steps) else (),
                )
            )
        return found


@dataclass
class _Step:
    """One decision of one world, while it is recorded."""

    before: NDArray[np.float32]
    action: int
    q_A: NDArray[np.float32] | None
    said: str
    reward: float = 0.0
    after: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))


def _lane(obs_BVF: NDArray[np.float32], lanes: int) -> NDArray[np.int64]:
    """Return the lane each ego is nearest to; lanes are 4 m wide and their centres at 0, 4, 8 m."""
    return np.clip(np.rint(obs_BVF[:, 0, 2] / 4.0), 0, lanes - 1).astype(np.int64)
