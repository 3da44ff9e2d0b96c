"""Decisions that a rule made because the model gave no usable answer: counted, told, and stopped at if they are many.

A dataset is said to be a model's. Where the rule decided, its action stands in the data all the same; whoever learns
from them must know how many they are, and can leave them out.
"""

from rapid.data.dataset import Dataset
from rapid.errors import RapidError, sentence
from rapid.teacher.decision import Decision

LEAST_DECISIONS = 40
"""Fewer count as so many. So bad luck at the beginning stops nothing, a model that never answers is stopped long
before, and what was kept of a collection that was stopped never stops it again."""
_SHOWN = 200
"""Characters of an answer that a message shows."""


class TooManyFallbacksError(RapidError):
    """The model decides too rarely for the data to be called its own."""


def is_fallback(decision: Decision) -> bool:
    """Whether the rule made this decision in a model's place."""
    return decision.status == "fallback"


def check_share(fallbacks: int, decisions: int, limit: float, last: Decision | None) -> None:
    """Stop if the rule made a larger share of the decisions than `limit`; see `LEAST_DECISIONS`.

    Raises:
        TooManyFallbacksError: it did; the message shows the answer to the `last` of them, and why it was refused.
    """
    if fallbacks <= limit * max(decisions, LEAST_DECISIONS):
        return
    said = "none"
    if last is not None and last.answer:
        said = repr(last.answer[:_SHOWN]) + (" …" if len(last.answer) > _SHOWN else "")
    refused = f" It was refused: {sentence(last.error)}" if last is not None and last.error else ""
    raise TooManyFallbacksError(
        f"A rule made {fallbacks} of {decisions} decisions ({fallbacks / decisions:.0%}), because the model's answers "
        f"could not be used; teacher.max_fallback_share allows {limit:.0%}. The last such answer: {said}.{refused} Try "
        "another --teacher.style or --teacher.model, or allow more with --teacher.max-fallback-share. The episodes in "
        "progress are kept up to the first such decision; the same command goes on from there."
    )


def fallback_notice(dataset: Dataset) -> str:
    """Return a sentence about the decisions that a rule made in the model's place; nothing if there are none."""
    count, total = dataset.fallbacks
    mixture = dataset.mixture or {}
    if left_out := (mixture.get("fallbacks") or {}).get("left_out", 0):
        return f"Left out: {left_out} transitions of which a rule chose the action, as the model gave no usable answer."
    if not count:
        return ""
    unit = "teacher's transitions" if mixture else "decisions"
    return (
        f"A rule made {count} of the {total} {unit} ({count / total:.1%}): there the model gave no usable answer. "
        "mix.drop_fallbacks leaves them out."
    )
