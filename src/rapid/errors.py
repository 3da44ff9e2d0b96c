"""Errors that a user can act on: what was wrong, what was expected, what to do."""

import re
from collections.abc import Iterable
from difflib import get_close_matches


class RapidError(Exception):
    """A mistake in the input or the surroundings, explained in one paragraph.

    The command line prints the message without a traceback and exits with 2. Foreign words that it quotes may end with
    a full stop of their own: one is enough.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(re.sub(r"([.!?])\.(?!\S)(?<!\.\.\.)", r"\1", message))


def sentence(text: str) -> str:
    """Return foreign words as a sentence, with one full stop at its end."""
    text = text.strip()
    return text if text.endswith((".", "!", "?", "…")) else f"{text}."


class DamagedError(RapidError):
    """A file of our own that is not what was written: cut off, overwritten or edited."""


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the choice nearest to `name`, or ``"."``."""
    near = get_close_matches(name, list(choices), n=1, cutoff=0.4)
    return f"; did you mean '{near[0]}'?" if near else "."
