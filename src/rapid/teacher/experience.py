"""Experiences, and the file of JSON lines that holds them; importing this imports no driving code."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rapid.errors import RapidError
from rapid.scenarios import ACTIONS

MEMORY_FILE = "memory.jsonl"
"""Name of the memory in a dataset's directory."""
SITUATION_SIZE = 15
"""Numbers in the vector of a situation."""


@dataclass(frozen=True)
class Experience:
    """One situation of a past episode, what was decided in it, and what came of it; a line of a memory."""

    situation: tuple[float, ...]
    """Its vector, see :func:`situation`."""
    facts: str
    """It in words, see :func:`describe`."""
    action: int
    """What was decided; after a reflection, what should have been. An index of `scenarios.ACTIONS`."""
    explanation: str = ""
    """The reason given at the time."""
    outcome: str = ""
    """What came of it."""
    lesson: str = ""
    """What a reflection found; empty if there was none."""
    spawn_seed: int = -1
    """Traffic of the episode; -1 if it is not known."""
    tokens_in: int = 0
    """Tokens that the reflection read."""
    tokens_out: int = 0
    """Tokens that it wrote."""
    cost: float = 0.0
    """Its price."""


def to_lines(experiences: Sequence[Experience]) -> str:
    """Return experiences as the text of a memory file."""
    lines: list[str] = []
    for experience in experiences:
        record = dataclasses.asdict(experience)
        record["action"] = ACTIONS[experience.action]
        lines.append(json.dumps(record, ensure_ascii=False) + "\n")
    return "".join(lines)


def read_experiences(path: Path) -> tuple[Experience, ...]:
    """Read a memory file.

    Raises:
        RapidError: there is none, or a line is not an experience.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except FileNotFoundError as error:
        raise RapidError(
            f"There is no memory at '{path}'. Give --teacher.memory the path of a file of JSON lines, such as the "
            "memory.jsonl of a dataset that was collected with --teacher.reflect."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise RapidError(f"The memory '{path}' cannot be read: {error}. Give a file of JSON lines.") from error
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    return tuple(read_experience(line, f"line {number} of the memory '{path}'") for number, line in numbered)


def read_experience(line: str, where: str) -> Experience:
    """Return the experience in a line of a memory file; `where` names the line in the error.

    Raises:
        RapidError: it is not one: not JSON, a field is missing, unknown or of another type or size.
    """
    try:
        record = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise RapidError(f"There is no JSON in {where}: {error}. Correct or remove the line.") from error
    fault = _fault(record)
    if fault:
        raise RapidError(f"There is no experience in {where}: {fault}. Correct or remove the line.")
    numbers = tuple(round(float(value), 4) for value in record.pop("situation"))
    return Experience(situation=numbers, action=ACTIONS.index(record.pop("action")), **record)


_TYPES = {
    "facts": str,
    "action": str,
    "explanation": str,
    "outcome": str,
    "lesson": str,
    "spawn_seed": int,
    "tokens_in": int,
    "tokens_out": int,
    "cost": (int, float),
}


def _fault(record: Any) -> str:
    """Return what keeps a record from being an experience, or nothing."""
    if not isinstance(record, dict):
        return "it is not a JSON object"
    if missing := [name for name in ("situation", "facts", "action") if name not in record]:
        return f"it lacks {', '.join(missing)}"
    if unknown := [name for name in record if name not in _TYPES and name != "situation"]:
        return f"it has the unknown field {unknown[0]!r}; known are situation, {', '.join(_TYPES)}"
    for name, kind in _TYPES.items():
        value = record.get(name)
        if name in record and (not isinstance(value, kind) or isinstance(value, bool)):
            return f"its {name} has the wrong type"
    numbers = record["situation"]
    if not isinstance(numbers, list) or len(numbers) != SITUATION_SIZE:
        return f"its situation is not a list of {SITUATION_SIZE} numbers"
    for number in numbers:
        if not isinstance(number, int | float) or isinstance(number, bool) or not abs(number) < 1e6:
            return f"its situation holds {number!r}, which is not a number of a situation"
    if record["action"] not in ACTIONS:
        return f"its action is none of {', '.join(ACTIONS)}"
    return "" if math.isfinite(record.get("cost", 0)) else "its cost is not finite"
