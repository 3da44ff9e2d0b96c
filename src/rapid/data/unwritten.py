"""What was paid for and is in no row: decisions asked for before driving, and those lost by an end in the middle."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rapid.errors import DamagedError
from rapid.files import read_json, write_json
from rapid.progress import warn

UNWRITTEN_FILE = "unwritten.json"


@dataclass(frozen=True)
class Cost:
    """Of some decisions; of those that were lost, tokens and cost are guessed by the mean of the others."""

    decisions: int = 0
    tokens: int = 0
    cost: float = 0.0

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(self.decisions + other.decisions, self.tokens + other.tokens, self.cost + other.cost)

    def __str__(self) -> str:
        return f"at most {self._words('about ')}"

    @property
    def exactly(self) -> str:
        """Itself in words, where it is known and not guessed."""
        return self._words("")

    def _words(self, about: str) -> str:
        tokens = f", {about}{self.tokens} tokens" if self.tokens else ""
        cost = f", cost {about}{self.cost:.4g}" if self.cost else ""
        return f"{self.decisions} {'decision' if self.decisions == 1 else 'decisions'}{tokens}{cost}"


def lost_in(collection: dict[str, Any] | None) -> Cost:
    """Return what was lost in a collection, all its shards together."""
    return _sum_of("lost", collection)


def greetings_in(collection: dict[str, Any] | None) -> Cost:
    """Return what was asked for before driving, to see that the server answers, in all shards together."""
    return _sum_of("greetings", collection)


def _sum_of(name: str, collection: dict[str, Any] | None) -> Cost:
    found = Cost()
    for one in (collection or {}, *(collection or {}).get("shards", ())):
        found += Cost(**one.get(name, {}))
    return found


class Unwritten:
    """What is asked for at the moment, and what was lost or asked for before driving so far, on disk.

    It outlives a kill.

    A kill between an answer and the line of the journal costs it, one just after counts too much: hence "at most".
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.lost, self.greetings = Cost(), Cost()
        self._asked = Cost()
        if not path.exists():
            return
        try:
            record = read_json(path, "count of unwritten decisions")
            self.lost, asked = Cost(**record["lost"]), Cost(**record["asked"])
            # Earlier versions did not count them.
            self.greetings = Cost(**record.get("greetings", {}))
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
        """Whether anything was lost, asked for before driving, or is asked for."""
        return bool(self.lost.decisions or self.greetings.decisions or self._asked.decisions)

    @property
    def record(self) -> dict[str, Any]:
        """What a dataset tells of it, and :func:`reopen` goes on from; nothing if there is nothing to tell."""
        told = {"lost": self.lost, "greetings": self.greetings}
        return {name: asdict(cost) for name, cost in told.items() if cost.decisions}

    def ask(self, decisions: Cost) -> None:
        """Write down that these are asked for now."""
        self._asked = decisions
        self._write()

    def settle(self, lost: Cost, greetings: Cost) -> None:
        """Write down that what was asked for is in the journal, but for what was `lost` and `greetings`."""
        self._asked = Cost()
        self.lost += lost
        self.greetings += greetings
        self._write()

    def lose(self, lost: Cost) -> None:
        """Write down that these, which were written down, are asked for again."""
        self.lost += lost
        self._write()

    def _write(self) -> None:
        kept = {"lost": asdict(self.lost), "greetings": asdict(self.greetings), "asked": asdict(self._asked)}
        write_json(self._path, kept, sealed=True)


def reopen(path: Path, collection: dict[str, Any] | None) -> None:
    """Write the file anew from what a dataset tells."""
    told = {name: cost for name in ("lost", "greetings") if (cost := (collection or {}).get(name))}
    if told:
        write_json(path, {"lost": {}, "asked": {}} | told, sealed=True)
