"""From facts to words: what a model that scores words reads, and the words that it may answer.

A prompt is a constant part, whose key/value cache a local model keeps, and a short part that changes; speed depends on
the latter's length only. The same facts give the same prompt, byte for byte. Every available action is offered in an
order that never changes, and no fact says which one to take: the rules of good driving stand in the constant part, as
in the paper's prefix prompt. The wording was chosen on recorded scenes; more words made small models choose worse.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.teacher.facts import MINIMUM_GAP, TIGHT_GAP, Facts
from rapid.teacher.forecast import HORIZON, NO_CAR

WORDS = {LANE_LEFT: "left", IDLE: "keep", LANE_RIGHT: "right", FASTER: "faster", SLOWER: "slower"}
"""The word for each action; short, and one token each for the models in the registry."""

ANSWER_START = "Action:"
"""The beginning of the answer, which is given; the next word is the decision."""

_ORDER = (LANE_RIGHT, FASTER, IDLE, LANE_LEFT, SLOWER)


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


def digest(facts: Facts) -> Prompt:
    """Return the prompt with all facts inlined and one decision asked for."""
    offered = [action for action in _ORDER if action in facts.available]
    good = [action for action in offered if facts.safe(action)]
    label = "Safe"
    if not good:
        # Nothing is safe: then it matters where there is most room, and the lists say so by their order.
        offered.sort(key=facts.room, reverse=True)
        good = [action for action in offered if facts.avoidable(action)]
        label = "Risky"
    bad = _listed([action for action in offered if action not in good])
    user = f"{label}: {_listed(good)}. Unsafe: {bad}." if good else f"Unsafe: {bad}."
    return Prompt(digest_system(facts.scene.lanes), user)


def content_free(lanes: int) -> Prompt:
    """Return the digest prompt without content; a model's leaning towards a word is measured on it."""
    return Prompt(digest_system(lanes), "Safe: ?. Unsafe: ?.")


def digest_system(lanes: int) -> str:
    """Return the constant part of the digest style."""
    return (
        f"You drive a car on a highway with {lanes} lanes. Each second you choose one action: left, keep, right, "
        "faster or slower. Never choose an unsafe action. Prefer right, then faster, then keep. Answer with one word."
    )


def outcome(facts: Facts, action: int) -> str:
    """Return in a few words what an action leads to."""
    if action not in facts.available:
        return "not possible"
    future = facts.forecasts[action]
    if future.brake_gap == 0:
        return f"unsafe, a crash in {future.brake_crash:.0f} s even when braking"
    if future.hold_crash != float("inf"):
        return f"unsafe, a crash in {future.hold_crash:.0f} s unless braking"
    verdict = "safe" if facts.safe(action) else "unsafe"
    gap = future.hold_gap
    return f"{verdict}, free road" if gap >= NO_CAR else f"{verdict}, smallest gap {gap:.0f} m"


def prompt_version(lanes: int) -> str:
    """Return a hash of everything that shapes the prompts; it changes when wording or thresholds do."""
    text = (content_free(lanes), WORDS, ANSWER_START, _ORDER, MINIMUM_GAP, TIGHT_GAP, HORIZON)
    return hashlib.sha256(repr(text).encode()).hexdigest()[:16]


def _listed(actions: Sequence[int]) -> str:
    return ", ".join(WORDS[action] for action in actions) or "none"
