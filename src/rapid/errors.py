"""Errors that a user can act on: what was wrong, what was expected, what to do."""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path


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


def how_to_install(*extras: str) -> str:
    """Return the command that installs extras of this project: from a checkout, as there is no package on the index."""
    checkout = Path(__file__).resolve().parents[2]
    where = f"in {checkout}" if (checkout / "pyproject.toml").is_file() else "in a checkout of RAPID"
    return f"pip install -c constraints.txt -e '.[{','.join(extras)}]' ({where})"


class DamagedError(RapidError):
    """A file of our own that is not what was written: cut off, overwritten or edited."""


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the choice nearest to `name`, or ``"."``."""
    near = get_close_matches(name, list(choices), n=1, cutoff=0.4)
    return f"; did you mean '{near[0]}'?" if near else "."
