"""Errors that a user can act on: what was wrong, what was expected, what to do."""

from collections.abc import Iterable
from difflib import get_close_matches


class RapidError(Exception):
    """A mistake in the input or the surroundings, explained in one paragraph.

    The command line prints the message without a traceback and exits with 2.
    """


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the choice nearest to `name`, or ``"."``."""
    near = get_close_matches(name, list(choices), n=1, cutoff=0.4)
    return f"; did you mean '{near[0]}'?" if near else "."
