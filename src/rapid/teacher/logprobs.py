"""Soft labels of a model that writes: the probability of every action at the token that decides."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from rapid.scenarios import NUM_ACTIONS
from rapid.teacher.prompt import WORDS

TOP = 20
"""Alternatives asked for at each token; the most that servers commonly give."""
LEAST_TOLD = 0.9
"""Share of the probability that the alternatives must add up to: of what is left, nobody knows to whom it belongs."""

_VALUE = re.compile(r'"action"\s*:\s*"')
_LETTERS = re.compile(r"[^a-z]*([a-z]+)")


@dataclass(frozen=True)
class Token:
    """A token that was written, and what might have stood in its place."""

    text: str
    alternatives: tuple[tuple[str, float], ...]
    """Text and natural logarithm of the probability, the token itself among them."""


def action_probabilities(tokens: Sequence[Token], action: int, available: Sequence[int]) -> tuple[float, ...] | None:
    """Return the probability of each of the five actions, among the available ones, where `action` was written.

    A word may be spelled in several ways (a space before it, a capital, cut after a few letters): an alternative
    counts for an action if its letters begin the action's word. Actions that are not among the alternatives get 0.

    Returns:
        Five numbers that add up to 1, or `None` if the tokens do not show where the decision fell, or how.
    """
    written = "".join(token.text for token in tokens)
    values = list(_VALUE.finditer(written))
    start = values[-1].end() if values else _only_word(written, WORDS[action])
    if start is None:
        return None
    masses = [0.0] * NUM_ACTIONS
    end = 0
    for token in tokens:
        end += len(token.text)
        if end > start:
            if sum(math.exp(min(logprob, 0.0)) for _, logprob in token.alternatives) < LEAST_TOLD:
                return None
            for text, logprob in token.alternatives:
                meant = _action_begun(text)
                if meant is not None and meant in available:
                    masses[meant] += math.exp(min(logprob, 0.0))
            break
    total = sum(masses)
    return tuple(mass / total for mass in masses) if masses[action] > 0 else None


def _only_word(text: str, word: str) -> int | None:
    """Return where the word stands after the thinking; None if it stands there twice: either may be the decision."""
    found = list(re.finditer(rf"\b{word}\b", text[text.rfind("</think>") + 1 :], re.IGNORECASE))
    return text.rfind("</think>") + 1 + found[0].start() if len(found) == 1 else None


def _action_begun(text: str) -> int | None:
    letters = _LETTERS.match(text.lower())
    if letters is None:
        return None
    # The five words begin with five different letters, so that at most one is meant.
    return next((action for action, word in WORDS.items() if word.startswith(letters[1])), None)
