"""Drivers that need no model: constants, chance, and rules over the same facts that a model is told.

They are floors to beat, controls that show what the model adds, and a way to run everything without any weights.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError, did_you_mean
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, SLOWER
from rapid.seeding import stream_seed
from rapid.teacher.decision import Decision
from rapid.teacher.facts import Facts, gather
from rapid.teacher.scene import Scene, read_scenes

_CONSTANTS = {"idle": IDLE, "slower": SLOWER, "faster": FASTER}


class Scripted:
    """A driver without a model. `name` is one of :data:`SCRIPTED`.

    Raises:
        RapidError: there is no driver of this name.
    """

    def __init__(self, name: str, lanes: int, seed: int) -> None:
        if name not in SCRIPTED:
            raise RapidError(
                f"Unknown scripted driver '{name}'{did_you_mean(name, SCRIPTED)} Choose one of {', '.join(SCRIPTED)}."
            )
        self.name = name
        self._lanes = lanes
        self._seed = stream_seed(seed, f"teacher/{name}")

    def describe(self) -> dict[str, Any]:
        """Return the driver's identity."""
        return {"backend": "scripted", "model": self.name}

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`."""
        start = time.perf_counter()
        scenes = read_scenes(obs_BVF, self._lanes)
        chosen = [self._choose(scene, keys_B, world) for world, scene in enumerate(scenes)]
        seconds = (time.perf_counter() - start) / max(len(chosen), 1)
        return [
            Decision(action, explanation, probabilities=probabilities, seconds=seconds)
            for action, explanation, probabilities in chosen
        ]

    def _choose(
        self, scene: Scene, keys_B: NDArray[np.int64] | None, world: int
    ) -> tuple[int, str, tuple[float, ...] | None]:
        if self.name in _CONSTANTS:
            return _CONSTANTS[self.name], "", None
        if self.name in _RULES:
            action, explanation = _RULES[self.name](gather(scene))
            return action, explanation, None
        choices = list(range(NUM_ACTIONS)) if self.name == "random" else safe_actions(gather(scene))
        if keys_B is None:
            raise RapidError(f"The driver '{self.name}' draws at random: pass `keys_B`, one number per decision.")
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
SCRIPTED = ("random", *_CONSTANTS, *_RULES, "uniform-safe")
"""`rule` uses the closed-form checks, `rule-forecast` the forecast, `rule-foresight` the best ways on, from which
`uniform-safe` draws one as good as any."""
