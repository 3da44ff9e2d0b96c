"""What a teacher is, and everything that one of its decisions carries."""

import dataclasses
import json
import math
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.scenarios import ACTIONS, NUM_ACTIONS
from rapid.teacher.patience import StoppedError

Status = Literal["ok", "repaired", "fallback", "scripted"]
STATUSES: tuple[str, ...] = typing.get_args(Status)
NO_ANSWER = "no answer"
"""How the error of a decision begins to which nobody gave an answer, usable or not."""


class UnreachableError(RapidError):
    """The model's server gives no answers; `decisions` holds what was decided meanwhile, in part by nobody asked."""

    decisions: Sequence["Decision | None"] = ()


class RefusedError(RapidError):
    """Nothing more can be asked; `decisions` holds those that were made before, and None."""

    def __init__(self, message: str, decisions: Sequence["Decision | None"]) -> None:
        super().__init__(message)
        self.decisions = decisions


class UnfinishedError(StoppedError):
    """The time was over before all worlds were decided for; `decisions` holds those that were, and None."""

    def __init__(self, message: str, decisions: Sequence["Decision | None"]) -> None:
        super().__init__(message)
        self.decisions = decisions


class InterruptedDecisions(KeyboardInterrupt):
    """The user interrupted; `decisions` holds those that were made all the same, and None for the others."""

    def __init__(self, decisions: Sequence["Decision | None"]) -> None:
        super().__init__()
        self.decisions = decisions


@dataclass(frozen=True)
class Decision:
    """One decision and how it came about; :func:`to_record` and :func:`from_record` take it through JSON."""

    action: int
    """Index into :data:`rapid.scenarios.ACTIONS`."""
    explanation: str = ""
    """The driver's own reason, empty if it gave none; it is fed back at the next step."""
    answer: str = ""
    """The answer as the model gave it."""
    probabilities: tuple[float, ...] | None = None
    """Soft label: the probability of each of the five actions, where the backend gives it."""
    prompt_hash: str = ""
    """SHA-256 of the first prompt; recorded answers are found by it."""
    status: Status = "scripted"
    """`ok`; `repaired` after one correction; `fallback` if the rule had to decide; `scripted` without a model."""
    error: str = ""
    """What went wrong, where something did."""
    retries: int = 0
    """Requests repeated."""
    tokens_in: int = 0
    """Prompt tokens read."""
    tokens_out: int = 0
    """Answer tokens written."""
    seconds: float = 0.0
    """Time taken; in a batch, the batch's time over its size."""
    cost: float = 0.0
    """Price, in the currency of the settings."""
    turns: str = ""
    """Everything said after `told`, as a JSON list of messages: answers, results of tools, the request to repair."""
    told: str = ""
    """What the model was told first, without the part of the prompt that never changes."""
    computed: str = ""
    """What RAPID itself computed about the action; no model said it."""
    served: str = ""
    """The model's own name, as its server told it with the answer; it may be another than was asked for."""

    @property
    def unanswered(self) -> bool:
        """Whether the rule had to decide because no answer came at all."""
        return self.status == "fallback" and self.error.startswith(NO_ANSWER)


class Teacher(Protocol):
    """Who drives in phase 1 (paper: section 3.1). Nothing is remembered from call to call but caches."""

    name: str

    def describe(self) -> dict[str, Any]:
        """Return what identifies the teacher, ready for JSON: backend, model, hash of the weights, style, prompt."""
        ...

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world.

        Args:
            obs_BVF: observations as the environment gives them: rows (presence, x, y, vx, vy), the ego first; m, m/s.
            previous: each world's last decision, or `None` at the first step.
            keys_B: one number per decision from which a random driver draws, so that nothing depends on batching.

        Raises:
            RapidError: an observation of the wrong shape or with a number that is not finite.
        """
        ...


@runtime_checkable
class Timed(Protocol):
    """A teacher that waits for others."""

    @property
    def lost(self) -> int:
        """Decisions that were broken off although something may have been paid for them."""
        ...

    @property
    def greetings(self) -> Sequence[Decision]:
        """Decisions that :meth:`get_ready` paid for; they drive nothing."""
        ...

    def get_ready(self) -> None:
        """Look whether whoever is asked answers, once and before anything is driven; :meth:`Teacher.decide` does, too.

        Raises:
            RapidError: there is no answer.
        """
        ...

    def end_by(self, moment: float, reason: str) -> None:
        """Wait for nothing beyond `moment` (of :func:`time.monotonic`); `reason` is a sentence.

        A call of :meth:`Teacher.decide` that is not done by then raises :class:`UnfinishedError`.
        """
        ...


def to_record(decision: Decision) -> dict[str, Any]:
    """Return the decision as a dictionary for JSON."""
    return dataclasses.asdict(decision)


def _is_of(value: Any, kind: Any) -> bool:
    """Whether a value is of the kind of a field; of kinds other than text and numbers any is."""
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return kind not in (str, int) or type(value) is kind


def from_record(record: dict[str, Any]) -> Decision:
    """Return the decision that :func:`to_record` took apart.

    Raises:
        RapidError: fields are missing or unknown, or a value is out of range.
    """
    if "transcript" in record:
        told, turns = split_transcript(record["transcript"])
        record = {name: value for name, value in record.items() if name != "transcript"} | {
            "told": told,
            "turns": turns,
        }
    names = {field.name for field in dataclasses.fields(Decision)}
    if unknown := set(record) - names:
        raise RapidError(
            f"A recorded decision has unknown fields {sorted(unknown)}; it comes from another version. Expected "
            f"{', '.join(sorted(names))}."
        )
    action, status = record.get("action"), record.get("status", "scripted")
    if type(action) is not int or not 0 <= action < NUM_ACTIONS:
        raise RapidError(f"A recorded decision has action {action!r}; expected 0 to 4 ({', '.join(ACTIONS)}).")
    if status not in STATUSES:
        raise RapidError(f"A recorded decision has status {status!r}; expected one of {', '.join(STATUSES)}.")
    for field in dataclasses.fields(Decision):
        if field.name in record and not _is_of(record[field.name], field.type):
            raise RapidError(f"A recorded decision has {record[field.name]!r} as {field.name}, which it cannot be.")
    probabilities = record.get("probabilities")
    if probabilities is not None:
        probabilities = tuple(float(value) for value in probabilities)
        if len(probabilities) != NUM_ACTIONS:
            raise RapidError(f"A recorded decision has {len(probabilities)} probabilities; expected {NUM_ACTIONS}.")
    values: dict[str, Any] = {**record, "probabilities": probabilities}
    return Decision(**values)


@dataclass(frozen=True)
class Turn:
    """One message of a conversation after what was told first."""

    role: Literal["model", "tool", "driver"]
    """Who speaks; `driver` is RAPID, which asks for a decision."""
    text: str


def turns_of(turns: str) -> tuple[Turn, ...]:
    """Return the `turns` of a decision; those that cannot be read are none."""
    try:
        messages: Any = json.loads(turns or "[]")
    except ValueError:
        return ()
    found: list[Turn] = []
    for message in cast(list[Any], messages) if isinstance(messages, list) else ():
        if not isinstance(message, dict):
            continue
        message = cast(dict[str, Any], message)
        role, text = message.get("role"), str(message.get("content") or "")
        calls = [call["function"] for call in message.get("tool_calls") or ()]
        text = "\n".join(filter(None, [text, *(f"{call['name']} {call['arguments']}" for call in calls)]))
        if role == "assistant":
            found.append(Turn("model", text))
        else:
            found.append(Turn("tool" if role == "tool" or text.startswith("RESULT ") else "driver", text))
    return tuple(found)


def answer_in_words(decision: Decision) -> str:
    """Return what a model answered, for people: one answer as it is, of a conversation its turns."""
    turns = turns_of(decision.turns)
    if len(turns) < 2:
        return decision.answer
    return "\n".join(f"{turn.role}: {turn.text}" for turn in turns)


def computed_in_words(decision: Decision) -> str:
    """Return what RAPID computed about an action, for people: also the reason that a rule gives, which is ours."""
    return decision.computed or (decision.explanation if decision.status == "scripted" else "")


def split_transcript(transcript: Any) -> tuple[str, str]:
    """Return what was told and the turns after it, of a transcript as decisions had it until version 0.1.

    Raises:
        RapidError: it is no transcript.
    """
    try:
        messages = json.loads(transcript or "[]")
        told = str(messages[0]["content"]) if messages else ""
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise RapidError(f"A recorded decision has a transcript that is no list of messages: {error}.") from error
    return told, json.dumps(messages[1:]) if messages else ""
