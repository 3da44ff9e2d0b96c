"""Driving: an agent over many spawn seeds side by side, clean or with its observations attacked.

The agent sees what the attack leaves of the observation; everything measured comes from the true one.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rapid
from rapid.agents.open import check_road, driver_for, kind_of
from rapid.agents.origin import origin_of
from rapid.attacks.attack import Attack, network_of, offers
from rapid.attacks.spec import AttackSpec, parse_attack
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, Kind
from rapid.evaluation.recording import Recording
from rapid.evaluation.worlds import Perturbation, Worlds
from rapid.scenarios import NUM_VEHICLES, get_scenario, seeing
from rapid.simulator import Simulator

NO_ATTACK = "none"
MAX_WORLDS = 256
"""Worlds that are stepped at once; more seeds are driven in turns."""
PLANNED_WORLDS = 1
"""The same where a planner drives: it takes seconds for an episode and gains nothing from company, and so its progress
shows after each."""


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
    hit_E: tuple[str, ...] = ()
    """What was hit in each episode that crashed, as in `EpisodeRow`; nothing at all is nothing known."""
    origin: str = ""
    """What the agent is, whatever it is called."""
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
                hit=self.hit_E[i] if self.hit_E else "",
                origin=self.origin,
            )
            for i in range(len(self))
        ]


def is_applicable(agent: Any, attack: Attack | AttackSpec | str | None) -> bool:
    """Whether the attack can be made on the agent.

    A gradient attack needs the agent's network, some others its Q-values; and an agent that reads the worlds themselves
    sees no observation.
    """
    resolved = _resolve(attack, lanes=1)[1]
    return resolved is None or resolved.needs in offers(agent)


def run_episodes(
    agent: Any,
    scenario: str,
    seeds: Sequence[int],
    attack: Attack | AttackSpec | str | None = None,
    generator_seed: int = 0,
    record: bool = False,
    simulator: Simulator = "compiled",
    progress: Callable[[float], None] | None = None,
) -> Episodes:
    """Drive one episode for each spawn seed and return what was measured.

    `agent` has ``act(obs_BVF) -> actions``, or is a teacher with ``decide``, or needs the worlds themselves and has
    ``bind(env) -> agent``; one that reads other than 15 vehicles has ``vehicles``. `attack` is an attack, its spec or
    its text. `progress` is called with the number of episodes that have just ended. What an attack draws in an episode
    depends on `generator_seed`, its spawn seed and the step, not on the episodes beside it.

    Raises:
        RapidError: no seeds, an attack that cannot be made on the agent (see :func:`is_applicable`), or a road that the
            agent cannot mirror.
    """
    if len(seeds) == 0:
        raise RapidError("There are no spawn seeds to drive. Ask for at least one episode.")
    lanes = get_scenario(scenario).lanes
    check_road(agent, scenario)
    attack_name, resolved = _resolve(attack, lanes)
    if not is_applicable(agent, resolved):
        raise RapidError(
            f"The attack '{attack_name}' cannot be made on '{_name(agent)}': a gradient attack needs a network, one by "
            "search the values of the actions, and an agent that reads the worlds themselves sees no observation. "
            "Leave this cell out: it is not applicable. Noise, lies and transfer work on all that read observations."
        )
    vehicles = getattr(agent, "vehicles", NUM_VEHICLES)
    shown = seeing(max(vehicles, NUM_VEHICLES))
    parts: list[Worlds] = []
    together = PLANNED_WORLDS if kind_of(agent) == "planner" else MAX_WORLDS
    for first in range(0, len(seeds), together):
        worlds = Worlds(np.asarray(seeds[first : first + together], np.int64), record)
        env = rapid.make_vec(scenario, len(worlds.seed_B), simulator=simulator, config=shown, autoreset=False)
        try:
            driver = driver_for(agent, env, generator_seed)
            perturbation = Perturbation(resolved, agent, scenario, worlds.seed_B, generator_seed)
            worlds.drive(env, driver, perturbation, lanes, progress, vehicles)
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
        has_network=network_of(agent) is not None,
        gradient_attack=resolved is not None and resolved.needs_gradient,
        hit_E=tuple(hit for part in parts for hit in part.hit_B),
        origin=origin_of(agent),
    )
    for part in parts:
        episodes.recordings.extend(part.recordings(_name(agent), scenario, attack_name))
    return episodes


def evaluate_agent(
    agent: Any,
    scenario: str,
    seeds: Sequence[int],
    attacks: Iterable[str | AttackSpec] = (NO_ATTACK,),
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


def _resolve(attack: Attack | AttackSpec | str | None, lanes: int) -> tuple[str, Attack | None]:
    """Return the attack's name and the attack on a road with `lanes` lanes; None is no attack."""
    if isinstance(attack, str):
        attack = parse_attack(attack)
    if attack is None or attack == AttackSpec():
        return NO_ATTACK, None
    if isinstance(attack, AttackSpec):
        from rapid.attacks.registry import get_attack

        return attack.shown, get_attack(attack, lanes)
    return attack.name, attack
