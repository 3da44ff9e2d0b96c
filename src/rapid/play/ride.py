"""One episode that is driven decision by decision, under an attack that may change between two of them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rapid
from rapid.agents.open import driver_for
from rapid.attacks import get_attack
from rapid.attacks.attack import offers
from rapid.errors import RapidError
from rapid.evaluation.recording import follow
from rapid.evaluation.summary import label_of
from rapid.evaluation.worlds import Perturbation
from rapid.pages.episodes import frame, rounded, seen
from rapid.play.roster import You
from rapid.road import RANGES
from rapid.safety import IntervalFilter
from rapid.scenarios import ACTIONS, MAX_VEHICLES, NUM_ACTIONS, NUM_VEHICLES, get_scenario, seeing
from rapid.teacher.decision import answer_in_words, computed_in_words

ALONG = RANGES[0]
"""What 1 means along the road, metres, in the features by which attacks are sized."""
MOST_METRES = 60.0
"""The largest attack that the page asks for, metres along the road."""
STEPS = 10
"""Gradient steps of an attack by gradients: it has to keep up with the driving."""


@dataclass(frozen=True)
class Kind:
    """An attack as the page offers it: its size is all that is chosen there."""

    key: str
    label: str
    options: str = ""

    def spec(self, metres: float) -> str:
        """Return the attack's text for a size in metres along the road."""
        more = f",{self.options}" if self.options else ""
        return f"{self.key.partition('-')[0]}:radius={metres / ALONG:.6g}{more}"


KINDS = {
    kind.key: kind
    for kind in (
        Kind("pgd", "gradient, 10 steps (PGD)", f"steps={STEPS},restarts=1"),
        Kind("fgsm", "gradient, one step (FGSM)"),
        Kind("directed-faster", "directed: make it speed up", f"target=faster,steps={STEPS},restarts=1"),
        Kind("directed-sideways", "directed: make it change lanes", f"target=sideways,steps={STEPS},restarts=1"),
        Kind("uniform", "noise, uniform"),
        Kind("gaussian", "noise, Gaussian"),
        Kind("lie-far", "a lie: all cars are farther away", "to=far"),
        Kind("square", "search without gradients", "queries=60"),
    )
}
"""Attacks that the page offers, by name."""


def attack_spec(kind: str, metres: float) -> str:
    """Return the text of an attack of that kind and size; `none` where the size is 0.

    Raises:
        RapidError: an unknown kind, or a size that is no number from 0 to :data:`MOST_METRES`.
    """
    if kind == "none" or metres == 0:
        return "none"
    if kind not in KINDS:
        raise RapidError(f"There is no attack '{kind}' here. Choose one of: none, {', '.join(KINDS)}.")
    if not math.isfinite(metres) or not 0 < metres <= MOST_METRES:
        raise RapidError(f"The size of an attack must lie between 0 and {MOST_METRES:g} m, got {metres!r}.")
    return KINDS[kind].spec(metres)


class Ride:
    """One episode under way.

    Args:
        agent: who drives.
        scenario: where.
        spawn: the spawn seed, which fixes the traffic.
        seed: decides the noise of attacks and drivers that draw.

    Raises:
        RapidError: an unknown scenario, or nothing that can drive.
    """

    def __init__(self, agent: Any, scenario: str, spawn: int, seed: int = 0) -> None:
        self._agent, self._scenario, self._seed = agent, get_scenario(scenario), seed
        self._spawn_B = np.array([spawn], np.int64)
        self._vehicles: int = getattr(agent, "vehicles", NUM_VEHICLES)
        # All cars near the ego are shown, also those of which its driver knows nothing.
        self._env = rapid.make_vec(self._scenario.name, 1, config=seeing(MAX_VEHICLES), autoreset=False)
        self._driver = driver_for(agent, self._env, seed)
        self._attack, self._perturb = "none", self._perturbation("none")
        self._obs_BVF = np.array(self._env.reset(seed=self._spawn_B.tolist())[0], np.float32)
        self._tracks_V = follow(self._obs_BVF[0], None, 1)
        self._born = int(self._tracks_V.max()) + 1
        self._step = 0
        self.ended = self.crashed = False

    def opening(self) -> dict[str, Any]:
        """Return the episode as the player reads it, before the first decision."""
        return {
            "agent": label_of(str(getattr(self._agent, "name", type(self._agent).__name__))),
            "scenario": self._scenario.name,
            "spawn": int(self._spawn_B[0]),
            "attack": "none",
            "lanes": self._scenario.lanes,
            "vehicles": self._vehicles,
            "human": isinstance(self._agent, You),
            "ended": False,
            "crashed": False,
            "limit": int(self._scenario.config()["duration"]),
            "frames": [frame(self._obs_BVF[0], self._tracks_V)],
            **{name: [] for name in ("actions", "rewards", "seen", "q", "routing", "attention", "verdict", "attacks")},
            **{name: [] for name in ("told", "answered", "odds", "computed")},
        }

    def step(self, action: int | None = None, attack: str = "none", radius: float = 0.0) -> dict[str, Any]:
        """Take one decision and let its second pass; return what it adds to the episode.

        Args:
            action: what the reader chose, who is asked only where `you` drive.
            attack: the text of the attack at this decision.
            radius: within which the interval filter is asked what is safe.

        Raises:
            RapidError: the episode has ended, an action that does not exist, or an attack that cannot be read.
        """
        if self.ended:
            raise RapidError("This episode has ended. Begin another one.")
        note = self._set_attack(attack)
        if isinstance(self._agent, You):
            self._agent.next = check_action(action)
        worlds = np.zeros(1, np.int64)
        true_BVF = self._obs_BVF[:, : self._vehicles].copy()
        # What an agent with a memory remembers: its attack knows it, and its values rest on it.
        state_BS = self._driver.memory(worlds, 1)
        state_BS = None if state_BS is None else state_BS.copy()
        seen_BVF = self._perturb(true_BVF.copy(), worlds, self._env, state_BS)
        chosen = int(self._driver.choose(seen_BVF, worlds, self._spawn_B, self._step)[0])
        added = self._commentary(seen_BVF, worlds, state_BS) | {
            "actions": chosen,
            "seen": seen(seen_BVF[0], true_BVF[0]),
            "verdict": verdict(seen_BVF, self._scenario.lanes, radius),
            "attacks": self._attack,
        }
        obs_BVF, reward_B, terminated_B, truncated_B, info = self._env.step(np.array([chosen], np.int64))
        now_BVF = np.array(obs_BVF, np.float32)
        self._tracks_V = follow(now_BVF[0], (self._obs_BVF[0], self._tracks_V), self._born)
        self._born = max(self._born, int(self._tracks_V.max()) + 1)
        self._obs_BVF = now_BVF
        self._step += 1
        self.ended = bool(terminated_B[0] or truncated_B[0])
        self.crashed = bool(info["crashed"][0])
        return {
            "added": added | {"rewards": rounded(reward_B)[0], "frames": frame(now_BVF[0], self._tracks_V)},
            "ended": self.ended,
            "crashed": self.crashed,
            "attack": self._attack,
            "note": note,
        }

    def _set_attack(self, text: str) -> str:
        """Take over an attack; return why it is not made, where it cannot be made on this driver."""
        if text == "none":
            wanted, note = "none", ""
        else:
            spec = get_attack(text, self._scenario.lanes)
            able = spec.needs in offers(self._agent)
            needs = {"gradient": "a network", "values": "values of the actions", "nothing": "a driver that observes"}
            why = f"This attack needs {needs[spec.needs]}, which this driver is not or has not: it drives undisturbed."
            wanted, note = (text, "") if able else ("none", why)
        if wanted != self._attack:
            self._attack, self._perturb = wanted, self._perturbation(wanted)
        return note

    def _perturbation(self, text: str) -> Perturbation:
        made = None if text == "none" else get_attack(text, self._scenario.lanes)
        return Perturbation(made, self._agent, self._scenario.name, self._spawn_B, self._seed)

    def _commentary(
        self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64], state_BS: NDArray[np.float32] | None
    ) -> dict[str, Any]:
        """Return what there is to say about the decision just made: values, routing, attention, words."""
        q_A, decision = self._driver.commentary(seen_BVF, worlds)[0]
        explain = getattr(self._agent, "explain", None)
        given = () if state_BS is None else (state_BS,)
        found: Any = explain(seen_BVF, *given) if callable(explain) else None
        weights = None if found is None else found.weights_BVN
        attention = None if found is None else found.attention_BLHV
        return {
            "q": None if q_A is None else rounded(q_A),
            "routing": None if weights is None else rounded(weights[0].cpu(), 3),
            "attention": None if attention is None else rounded(attention[0].mean((0, 1)).cpu(), 3),
            "told": decision.told if decision else "",
            "answered": answer_in_words(decision) if decision else "",
            "odds": rounded(decision.probabilities) if decision and decision.probabilities else None,
            "computed": computed_in_words(decision) if decision else "",
        }


def check_action(action: object) -> int:
    """Return an action that the reader chose.

    Raises:
        RapidError: it is none.
    """
    if type(action) is not int or not 0 <= action < NUM_ACTIONS:
        raise RapidError(f"There is no action {action!r}; expected 0 to {NUM_ACTIONS - 1} ({', '.join(ACTIONS)}).")
    return action


def verdict(seen_BVF: NDArray[np.float32], lanes: int, radius: float) -> dict[str, Any]:
    """Return which actions are safe for every true state within `radius` of what is seen, by the interval filter."""
    margins = IntervalFilter(lanes, f"{radius:g}").margins(seen_BVF)[0]
    return {"safe": [bool(margin >= 0) for margin in margins], "spare": [rounded(min(m, 999.0), 1) for m in margins]}
