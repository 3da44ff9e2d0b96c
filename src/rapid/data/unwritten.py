"""What an end in the middle costs: decisions that were asked for, perhaps paid, and never written down."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rapid.errors import DamagedError
from rapid.files import read_json, write_json
from rapid.progress import warn

UNWRITTEN_FILE = "unwritten.json"


@dataclass(frozen=True)
class Cost:
    """Of some decisions; tokens and cost are guessed by the mean of those that were written."""

    decisions: int = 0
    tokens: int = 0
    cost: float = 0.0

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(self.decisions + other.decisions, self.tokens + other.tokens, self.cost + other.cost)

    def __str__(self) -> str:
        tokens = f", about {self.tokens} tokens" if self.tokens else ""
        cost = f", cost about {self.cost:.4g}" if self.cost else ""
        return f"at most {self.decisions} {'decision' if self.decisions == 1 else 'decisions'}{tokens}{cost}"


def lost_in(collection: dict[str, Any] | None) -> Cost:
    """Return what was lost in a collection, all its shards together."""
    found = Cost()
    for one in (collection or {}, *(collection or {}).get("shards", ())):
        found += Cost(**one.get("lost", {}))
    return found


class Unwritten:
    """What is asked for at the moment, and what was lost so far, on disk; it outlives a kill.

    A kill between an answer and the line of the journal costs it, one just after counts too much: hence "at most".
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.lost = Cost()
        self._asked = Cost()
        if not path.exists():
            return
        try:
            record = read_json(path, "count of unwritten decisions")
            self.lost, asked = Cost(**record["lost"]), Cost(**record["asked"])
        except (DamagedError, KeyError, TypeError):
            warn(f"'{path}' is damaged. What was lost before is not counted.")
            return
        if asked.decisions:
            warn(
                f"The last process ended while decisions were asked for: {asked} were paid for and lost. They are "
                "asked for again."
            )
            self.lost += asked
            self._write()

    @property
    def tells(self) -> bool:
        """Whether anything was lost, or is asked for."""
        return bool(self.lost.decisions or self._asked.decisions)

    def ask(self, decisions: Cost) -> None:
        """Write down that these are asked for now."""
        self._asked = decisions
        self._write()

    def settle(self, lost: Cost) -> None:
        """Write down that what was asked for is in the journal, but for what was `lost`."""
        self._asked = Cost()
        self.lost += lost
        self._write()

    def _write(self) -> None:
        write_json(self._path, {"lost": asdict(self.lost), "asked": asdict(self._asked)}, sealed=True)
