"""Past situations and what came of them, to remind a model of the most similar ones (after DiLu, Wen et al. 2024).

A memory is a file of JSON lines. It is only read while a teacher drives, so that what is remembered depends neither on
batching nor on the episodes driven side by side; what is learned goes to a new memory, kept with the dataset.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.road import CAR_LENGTH
from rapid.teacher.decision import Decision
from rapid.teacher.experience import Experience, read_experiences, to_lines
from rapid.teacher.facts import Facts
from rapid.teacher.prompt import WORDS, outcome
from rapid.teacher.scene import Car, Scene
from rapid.teacher.tools import describe_car

FAR = 100.0
"""Metres beyond which a car does not matter to the similarity of situations."""
TEXT_LIMIT = 1000
"""Characters of each text of an experience that a model is shown."""


@dataclass(frozen=True)
class Episode:
    """A finished episode, as a teacher looks back on it."""

    obs_TVF: NDArray[np.float32]
    """What was seen before each decision."""
    decisions: Sequence[Decision]
    """T decisions; action, explanation and status are known."""
    crashed: bool
    spawn_seed: int


@runtime_checkable
class Reflective(Protocol):
    """A teacher with a memory."""

    @property
    def memory(self) -> "Memory":
        """What it remembers while it drives."""
        ...

    @property
    def reflects(self) -> bool:
        """Whether finished episodes are to be shown to it."""
        ...

    def look_back(self, episodes: Sequence[Episode]) -> Iterator[Experience]:
        """Give one experience for each episode, in order; each depends on its own episode only.

        Raises:
            RapidError: the model cannot be reached, or will never answer.
        """
        ...


class Memory:
    """Experiences in order; never changed."""

    def __init__(self, experiences: Sequence[Experience] = ()) -> None:
        self.experiences = tuple(experiences)
        self._situations_NS = np.array([experience.situation for experience in self.experiences], np.float64)

    def __len__(self) -> int:
        return len(self.experiences)

    def recall(self, scene: Scene, count: int) -> list[Experience]:
        """Return the `count` experiences nearest to a scene, nearest first, by the Euclidean distance of the vectors.

        Of equally near ones the earlier in the memory comes first.
        """
        if not count or not self.experiences:
            return []
        distances_N = np.square(self._situations_NS - np.array(situation(scene))).sum(1)
        return [self.experiences[index] for index in np.argsort(distances_N, kind="stable")[:count]]

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the experiences as they are written to a file."""
        return hashlib.sha256(to_lines(self.experiences).encode()).hexdigest()


def identify(memory: Memory, few_shot: int) -> dict[str, Any]:
    """Return what a memory adds to the identity of a teacher; nothing if it is empty."""
    if not len(memory):
        return {}
    return {"memory": {"sha256": memory.sha256, "experiences": len(memory), "few_shot": few_shot}}


def situation(scene: Scene) -> tuple[float, ...]:
    """Return a scene as 15 numbers of about the same importance, rounded to four places.

    They are: the speed, in 10 m/s; whether there is a lane on the left, and on the right; and for the left, the own and
    the right lane the nearness of the lead car, how fast the gap to it closes, and both of the rear car. Nearness falls
    from 1 at a gap of 0 to 0 at `FAR` metres. Closing speed, in 10 m/s, is multiplied with the nearness, so that a car
    that comes into sight changes little.
    """
    values = [scene.speed / 10, float(scene.lane > 0), float(scene.lane < scene.lanes - 1)]
    for lane in (scene.lane - 1, scene.lane, scene.lane + 1):
        for car, sign in ((scene.lead(lane), 1), (scene.rear(lane), -1)):
            nearness = 0.0 if car is None else max(0.0, 1 - max(abs(car.ahead) - CAR_LENGTH, 0.0) / FAR)
            closing = 0.0 if car is None else sign * (scene.speed - car.speed) / 10
            values += [nearness, nearness * closing]
    return tuple(round(value, 4) + 0.0 for value in values)


def describe(facts: Facts) -> str:
    """Return a situation in words: the cars around the ego, and what each action would lead to."""
    scene = facts.scene
    around: list[Car | None] = []
    for lane in (scene.lane - 1, scene.lane, scene.lane + 1):
        around += [scene.lead(lane), scene.rear(lane)]
    parts = [f"lane {scene.lane + 1} of {scene.lanes}, {scene.speed:.1f} m/s"]
    parts += [describe_car(car) for car in scene.cars if car in around]
    parts += [f"{WORDS[action]}: {outcome(facts, action)}" for action in facts.available]
    return "; ".join(parts)


def quote(text: str) -> str:
    """Return a text as JSON that no prompt can mistake for its own parts.

    What a model once said may hold line breaks, marks of a chat template or orders: all of it stays inside one string,
    on one line, without the brackets that such marks are made of.
    """
    return json.dumps(text[:TEXT_LIMIT]).replace("<", "\\u003c").replace("[", "\\u005b")


def show(experience: Experience) -> str:
    """Return an experience as one line for a prompt."""
    fields = {
        "situation": experience.facts,
        "decision": WORDS[experience.action],
        "reason": experience.explanation,
        "outcome": experience.outcome,
        "lesson": experience.lesson,
    }
    return "{" + ", ".join(f'"{name}": {quote(text)}' for name, text in fields.items() if text) + "}"


def open_memory(config: TeacherConfig) -> Memory:
    """Return the memory that the settings name; an empty one if they name none.

    Raises:
        RapidError: it cannot be read or is empty, or the settings do not go together.
    """
    wanted = bool(config.memory or config.few_shot or config.reflect)
    if not wanted:
        return Memory()
    if config.backend == "scripted" or (config.backend == "replay" and config.reflect):
        raise RapidError(
            f"A teacher of the backend '{config.backend}' has no model that could "
            f"{'look back' if config.reflect else 'be reminded'}. Use the backend local or endpoint, or leave "
            "--teacher.memory, --teacher.few-shot and --teacher.reflect out."
        )
    if config.shuffle_facts:
        raise RapidError("--teacher.shuffle-facts is for a model without a memory. Leave one of the two out.")
    if config.few_shot and not config.memory:
        raise RapidError(
            f"teacher.few_shot is {config.few_shot}, but there is no memory to take examples from. Name one with "
            "--teacher.memory; --teacher.reflect makes one."
        )
    if config.memory and not config.few_shot and not config.reflect:
        raise RapidError(
            "teacher.memory names a memory, but teacher.few_shot is 0, so that nothing is taken from it. Say how many "
            "past situations the model is shown, for instance --teacher.few-shot 3."
        )
    memory = Memory(read_experiences(Path(config.memory).expanduser())) if config.memory else Memory()
    if config.memory and not len(memory):
        raise RapidError(f"The memory '{config.memory}' is empty. Name another, or leave --teacher.memory out.")
    return memory
