"""From facts to words: what a model reads and the words that it may answer.

A prompt is a constant part, whose key/value cache a local model keeps, and a short part that changes; speed depends on
the latter's length only. The same facts give the same prompt, byte for byte. Every available action is offered, and
no fact says which one to take: the rules of good driving stand in the constant part, as in the paper's prefix prompt.
"""

import hashlib
from dataclasses import dataclass

from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, SLOWER
from rapid.teacher.decision import Decision
from rapid.teacher.facts import MINIMUM_GAP, TIGHT_GAP, Facts
from rapid.teacher.forecast import HORIZON, NO_CAR

WORDS = {LANE_LEFT: "left", IDLE: "keep", LANE_RIGHT: "right", FASTER: "faster", SLOWER: "slower"}
"""The word for each action; short, and one token each for the models in the registry."""

ANSWER_START = "Action:"
"""The beginning of the answer, which is given; the next word is the decision."""


@dataclass(frozen=True)
class Prompt:
    """What a model is told."""

    system: str
    """The constant part: task, actions, rules."""
    user: str
    """The part that changes: the scene and its facts."""

    @property
    def hash(self) -> str:
        """SHA-256 of the whole prompt in hexadecimal."""
        return hashlib.sha256(f"{self.system}\0{self.user}".encode()).hexdigest()


def digest(facts: Facts, previous: Decision | None) -> Prompt:
    """Return the prompt with all facts inlined and one decision asked for."""
    scene = facts.scene
    lines = [f"Lane {scene.lane + 1} of {scene.lanes}, {scene.speed:.0f} m/s, last action: {_last(previous)}."]
    lines += [f"{WORDS[action]}: {outcome(facts, action)}" for action in range(NUM_ACTIONS)]
    return Prompt(digest_system(scene.lanes), "\n".join(lines))


def digest_system(lanes: int) -> str:
    """Return the constant part of the digest style."""
    return (
        f"You drive a car on a one-way highway with {lanes} lanes. Lane 1 is the leftmost, lane {lanes} the rightmost. "
        "Each second you choose one action:\n"
        "left: change to the lane on the left\n"
        "keep: hold lane and speed\n"
        "right: change to the lane on the right\n"
        "faster: speed up by 4 m/s\n"
        "slower: slow down by 4 m/s\n"
        "You are told what each action leads to.\n"
        "Rules: Safety first: never choose an action that ends in a crash or is risky. If every action is risky, choose "
        "slower. Drive in the right lane when it is safe. Drive faster than 20 m/s when it is safe. Do not change lanes back and "
        "forth.\n"
        "Answer with one word: left, keep, right, faster or slower."
    )


def content_free(lanes: int) -> Prompt:
    """Return the digest prompt without content; a model's leaning towards a word is measured on it."""
    lines = [f"Lane ? of {lanes}, ? m/s, last action: ?."]
    lines += [f"{WORDS[action]}: ?" for action in range(NUM_ACTIONS)]
    return Prompt(digest_system(lanes), "\n".join(lines))


def outcome(facts: Facts, action: int) -> str:
    """Return in a few words what an action leads to."""
    if action not in facts.available:
        return "not possible"
    future = facts.forecasts[action]
    if future.brake_gap == 0:
        return f"crash in {future.brake_crash:.0f} s"
    if not facts.safe(action):
        return "risky"
    gap = min(future.hold_gap, NO_CAR)
    return "safe, free road" if gap >= NO_CAR else f"safe, gap {5 * round(gap / 5)} m"


def prompt_version(lanes: int) -> str:
    """Return a hash of everything that shapes the prompts; it changes when wording or thresholds do."""
    text = (digest_system(lanes), content_free(lanes).user, WORDS, ANSWER_START, MINIMUM_GAP, TIGHT_GAP, HORIZON)
    return hashlib.sha256(repr(text).encode()).hexdigest()[:16]


def _last(previous: Decision | None) -> str:
    return WORDS[previous.action] if previous else "none"
