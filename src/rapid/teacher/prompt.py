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
from rapid.teacher.facts import MINIMUM_GAP, OPEN_MARGIN, TIGHT_GAP, Facts
from rapid.teacher.forecast import HORIZON, NO_CAR
from rapid.teacher.foresight import CAUTION, DEPTH

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
    best = [action for action in offered if facts.is_open(action)]
    rest = [action for action in offered if action not in best]
    unsafe = [action for action in rest if not facts.survives(action)]
    tight = [action for action in rest if action not in unsafe]
    if not facts.survives(best[0]):
        # A crash is foreseen whatever one does: what puts it off longest is not safe, but not like the rest either.
        best, tight = [], best
    return Prompt(digest_system(facts.scene.lanes), _sorted_out(best, tight, unsafe))


def calibration(lanes: int) -> list[Prompt]:
    """Return prompts that name every action in every place once; a model's leaning is its mean score over them.

    One prompt with "?" for the actions measures something else: how likely the words are where none is named. With it
    SmolLM2 chose an unsafe action in 6 of 100 prompts, with these in 1.
    """
    places = [([action], [], [other for other in _ORDER if other != action]) for action in _ORDER]
    return [Prompt(digest_system(lanes), _sorted_out(*place)) for place in places]


def digest_system(lanes: int) -> str:
    """Return the constant part of the digest style."""
    return (
        f"You drive a car on a highway with {lanes} lanes. Each second you choose one action: left, keep, right, "
        "faster or slower. Never choose a tight or an unsafe action. Prefer right, then faster, then keep. "
        "Answer with one word."
    )


def outcome(facts: Facts, action: int) -> str:
    """Return in a few words what an action leads to."""
    if action not in facts.available:
        return "not possible"
    way, future = facts.ways[action], facts.forecasts[action]
    if way.seconds < DEPTH:
        return f"unsafe, a crash after {way.seconds:.0f} s whatever follows"
    verdict = "safe" if facts.is_open(action) else "tight: others lead on with more room or speed"
    if future.hold_crash != float("inf"):
        gap = f"a crash in {future.hold_crash:.0f} s unless braking or changing lane"
    else:
        gap = "free road" if future.hold_gap >= NO_CAR else f"smallest gap {future.hold_gap:.0f} m at this speed"
    return f"{verdict}, {way.distance:.0f} m in {way.seconds:.0f} s, {gap}"


def prompt_version(lanes: int) -> str:
    """Return a hash of everything that shapes the prompts; it changes when wording or thresholds do."""
    wording = tuple(prompt.user for prompt in calibration(lanes))
    numbers = (MINIMUM_GAP, TIGHT_GAP, HORIZON, OPEN_MARGIN, DEPTH, CAUTION)
    text = (digest_system(lanes), wording, WORDS, ANSWER_START, _ORDER, numbers)
    return hashlib.sha256(repr(text).encode()).hexdigest()[:16]


def _sorted_out(safe: Sequence[int], tight: Sequence[int], unsafe: Sequence[int]) -> str:
    return f"Safe: {_listed(safe)}. Tight: {_listed(tight)}. Unsafe: {_listed(unsafe)}."


def _listed(actions: Sequence[int]) -> str:
    return ", ".join(WORDS[action] for action in actions) or "none"
