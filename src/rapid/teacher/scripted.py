"""Drivers that need no model: constants, chance, and rules over the same facts that a model is told.

They are floors to beat, controls that show what the model adds, and a way to run everything without any weights. Two
of them cannot be misled about where other cars are: `immune` asks only whether any is there, `blind` nothing at all.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.agents.watchable import Watchable
from rapid.errors import RapidError, did_you_mean
from rapid.evaluation.metrics import Kind
from rapid.files import read_json
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, SLOWER, get_scenario
from rapid.seeding import stream_seed
from rapid.teacher.decision import Decision
from rapid.teacher.facts import Facts, gather
from rapid.teacher.scene import Scene, read_scenes

_CONSTANTS = {"idle": IDLE, "slower": SLOWER, "faster": FASTER}


class Scripted(Watchable):
    """A driver without a model.

    Args:
        name: one of :data:`SCRIPTED`, or a plan of its own for `blind`, such as ``blind:5,2,4``.
        lanes: of the road.
        seed: for those that draw.
        scenario: where it drives; `blind` has a plan for each scenario that :mod:`rapid.evaluation.blind` searched.

    Raises:
        RapidError: there is no driver of this name, or no plan for `blind`.
    """

    kind: Kind = "floor"

    def __init__(self, name: str, lanes: int, seed: int, scenario: str = "") -> None:
        kind, _, plan = name.partition(":")
        if kind not in SCRIPTED or (plan and kind != "blind"):
            raise RapidError(
                f"Unknown scripted driver '{name}'{did_you_mean(name, SCRIPTED)} Choose one of {', '.join(SCRIPTED)}."
            )
        self.name = name
        """How it is labelled; may be changed."""
        self.driver = name
        """Which driver it is, whatever it is called."""
        self._lanes = lanes
        self._seed = stream_seed(seed, f"teacher/{name}")
        self.plan = (read_plan(plan) if plan else plan_for(scenario)) if kind == "blind" else None

    def describe(self) -> dict[str, Any]:
        """Return the driver's identity."""
        return {"backend": "scripted", "model": self.driver} | ({"plan": list(self.plan)} if self.plan else {})

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`."""
        start = time.perf_counter()
        scenes = read_scenes(obs_BVF, self._lanes)
        if self.plan is not None:
            chosen = [_follow(self.plan, before) for before in previous]
        elif self.driver == "immune":
            chosen = [_wait(bool((presence_V >= 0.5).any())) for presence_V in np.asarray(obs_BVF)[:, 1:, 0]]
        else:
            chosen = [self._choose(scene, keys_B, world) for world, scene in enumerate(scenes)]
        seconds = (time.perf_counter() - start) / max(len(chosen), 1)
        return [
            Decision(action, explanation, probabilities=probabilities, seconds=seconds)
            for action, explanation, probabilities in chosen
        ]

    def _choose(
        self, scene: Scene, keys_B: NDArray[np.int64] | None, world: int
    ) -> tuple[int, str, tuple[float, ...] | None]:
        if self.driver in _CONSTANTS:
            return _CONSTANTS[self.driver], "", None
        if self.driver in _RULES:
            action, explanation = _RULES[self.driver](gather(scene))
            return action, explanation, None
        choices = list(range(NUM_ACTIONS)) if self.driver == "random" else safe_actions(gather(scene))
        if keys_B is None:
            raise RapidError(f"The driver '{self.driver}' draws at random: pass `keys_B`, one number per decision.")
        # Not a shared generator: each draw depends on its own key, however the worlds are batched.
        generator = np.random.default_rng((self._seed, int(keys_B[world]) & (2**64 - 1)))
        probabilities = tuple(float(action in choices) / len(choices) for action in range(NUM_ACTIONS))
        return choices[int(generator.integers(len(choices)))], "", probabilities


def safe_actions(facts: Facts) -> list[int]:
    """Return the available actions that lead on about as well as the best one."""
    return [action for action in facts.available if facts.is_open(action)]


def _closed_form_rule(facts: Facts) -> tuple[int, str]:
    """First of: speed up, keep on, change lane, by the closed-form checks; else brake."""
    for action, reason in (
        (FASTER, "the road ahead is free"),
        (IDLE, "keeping on is safe"),
        (LANE_RIGHT, "the lane on the right has room"),
        (LANE_LEFT, "the lane on the left has room"),
    ):
        if action in facts.available and facts.checks[action].safe:
            return action, reason
    return SLOWER, "nothing else is safe"


def _forecast_rule(facts: Facts) -> tuple[int, str]:
    """The same order, by the forecast."""
    for action, reason in (
        (FASTER, "no conflict is foreseen when faster"),
        (IDLE, "no conflict is foreseen"),
        (LANE_RIGHT, "no conflict is foreseen on the right"),
        (LANE_LEFT, "no conflict is foreseen on the left"),
    ):
        if action in facts.available and facts.safe(action):
            return action, reason
    return SLOWER, "everything else ends in a conflict"


def _foresight_rule(facts: Facts) -> tuple[int, str]:
    """The order in which the language models are told to prefer actions, among those that lead on as well as any."""
    for action in (LANE_RIGHT, FASTER, IDLE, LANE_LEFT, SLOWER):
        if action in facts.available and facts.is_open(action):
            break
    return action, "it leads on as well as any"


_RULES: dict[str, Callable[[Facts], tuple[int, str]]] = {
    "rule": _closed_form_rule,
    "rule-forecast": _forecast_rule,
    "rule-foresight": _foresight_rule,
}
SCRIPTED = ("random", *_CONSTANTS, *_RULES, "uniform-safe", "immune", "blind")
"""`rule` uses the closed-form checks, `rule-forecast` the forecast, `rule-foresight` the best ways on, from which
`uniform-safe` draws one as good as any; `immune` brakes while any other car is present and speeds up while none is;
`blind` follows a fixed plan whatever it sees."""

PLANS = Path(__file__).with_name("blind.json")
"""The plans of `blind`, as :mod:`rapid.evaluation.blind` found them."""
Plan = tuple[int, int, int]
"""How often SLOWER, then LANE_RIGHT, then FASTER; after that IDLE."""


def read_plan(text: str) -> Plan:
    """Return a plan written as in ``5,2,4``.

    Raises:
        RapidError: it is not three whole numbers of at least 0.
    """
    words = [word.strip() for word in text.split(",")]
    if len(words) != 3 or not all(word.isascii() and word.isdigit() for word in words):
        raise RapidError(
            f"A plan is written 5,2,4: how often SLOWER, LANE_RIGHT and FASTER, then IDLE; as a driver blind:5,2,4; "
            f"got '{text}'."
        )
    slower, right, faster = map(int, words)
    return slower, right, faster


def _plans() -> dict[str, Any]:
    return read_json(PLANS, "file of plans")["plans"]


def has_plan(scenario: str) -> bool:
    """Whether `blind` has a plan for a scenario."""
    return replace(get_scenario(scenario), clock=False).name in _plans()


def plan_for(scenario: str) -> Plan:
    """Return the plan of `blind` for a scenario.

    Raises:
        RapidError: none was searched for it.
    """
    plans = _plans()
    if scenario:
        scenario = replace(get_scenario(scenario), clock=False).name
    if scenario not in plans:
        raise RapidError(
            f"The driver 'blind' has no plan for {scenario or 'a road without a name'}, only for {', '.join(plans)}. "
            f"Search one with `python -m rapid.evaluation.blind {scenario or 'SCENARIO'}` and name it: "
            "as a driver blind:5,2,4, as adapt.adversary.plan 5,2,4."
        )
    slower, right, faster = plans[scenario]["plan"]
    return slower, right, faster


def plan_actions(plan: Plan) -> list[int]:
    """Return the actions of a plan; after the last comes IDLE."""
    slower, right, faster = plan
    return [SLOWER] * slower + [LANE_RIGHT] * right + [FASTER] * faster


def _wait(present: bool) -> tuple[int, str, None]:
    """Brake while any car is present, wherever it is said to be: a scene leaves out what is said to be far away."""
    return (SLOWER, "another car is there", None) if present else (FASTER, "no car is there", None)


def _follow(plan: Plan, previous: Decision | None) -> tuple[int, str, None]:
    """Return the next action of the plan. What a driver remembers is its last decision, so that carries the count."""
    step = 0 if previous is None else int(previous.explanation.rpartition(" ")[2]) + 1
    actions = plan_actions(plan)
    action = actions[step] if step < len(actions) else IDLE
    return action, f"decision {step}", None
