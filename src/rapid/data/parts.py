"""The finished groups of a collection in progress: numbered Parquet files, and a list that says what each must hold.

The list (``parts.json``) is written after every part, so that one that vanished or changed later is noticed. It is then
named, and its episodes are driven again: the spawn seeds say which they are.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from rapid.data.tables import current_log, read_parquet, write_parquet
from rapid.errors import DamagedError, RapidError
from rapid.files import read_json, sha256, write_json
from rapid.progress import warn

LIST_FILE = "parts.json"


class Parts:
    """The groups of one collection, in their order.

    Args:
        work: the directory of the collection in progress.
        seeds: the spawn seeds that are driven, in order.

    Raises:
        RapidError: a part is of other spawn seeds, or one is missing and no list says what was in it.
    """

    def __init__(self, work: Path, seeds: Sequence[int]) -> None:
        self._work = work
        self._facts = _read_list(work)
        self.tables: list[pa.Table | None] = []
        """What each group gave; None where it has to be driven again."""
        present = {int(path.stem.removeprefix("part-")) for path in work.glob("part-[0-9]*.parquet")}
        listed = len(self._facts)
        first = 0
        for number in range(max([listed - 1, *present]) + 1):
            # Between a part and the list it enters a kill may come: then the file is whole, and speaks for itself.
            facts = self._facts[number] if number < listed else None
            table = _read_part(self.path(number), facts) if number in present else None
            if facts is None:
                if table is None:
                    raise RapidError(
                        f"The part '{self.path(number)}' of the collection is missing or damaged, and no {LIST_FILE} "
                        "says which episodes were in it. Put it back, or delete the directory to start anew."
                    )
                facts = self._describe(number, _spawns(table))
                self._facts.append(facts)
            group = facts["seeds"]
            if list(seeds[first : first + len(group)]) != group:
                raise RapidError(
                    f"'{self.path(number)}' does not hold the episodes that come next in this collection. It was "
                    "copied from elsewhere or renamed: put the right one there, or delete the directory to start anew."
                )
            if table is None:
                warn(
                    f"The part '{self.path(number)}' of the collection is missing or damaged. Its {len(group)} "
                    "episodes are driven again."
                )
            self.tables.append(table)
            first += len(group)
        if len(self._facts) > listed:
            self._write_list()

    def __len__(self) -> int:
        return len(self.tables)

    def path(self, number: int) -> Path:
        """Where a part lies."""
        return self._work / f"part-{number:05d}.parquet"

    def seeds(self, number: int) -> list[int]:
        """Return the spawn seeds of a group."""
        return self._facts[number]["seeds"]

    def first_episode(self, number: int) -> int:
        """Return how many episodes come before a group."""
        return sum(len(facts["seeds"]) for facts in self._facts[:number])

    @property
    def episodes(self) -> int:
        """Episodes of all groups, those to be driven again included."""
        return self.first_episode(len(self))

    @property
    def missing(self) -> list[int]:
        """Numbers of the groups that have to be driven again."""
        return [number for number, table in enumerate(self.tables) if table is None]

    @property
    def leading(self) -> list[pa.Table]:
        """The tables before the first that is missing."""
        count = min(self.missing, default=len(self))
        return [table for table in self.tables[:count] if table is not None]

    @property
    def present(self) -> list[pa.Table]:
        """What there is, in order."""
        return [table for table in self.tables if table is not None]

    def keep(self, number: int, seeds: list[int], table: pa.Table) -> None:
        """Write what a group gave, the next or a missing one; it is on the disk and listed when this returns."""
        write_parquet(table, self.path(number))
        self.tables[number:] = [table, *self.tables[number + 1 :]]
        self._facts[number:] = [self._describe(number, seeds), *self._facts[number + 1 :]]
        self._write_list()

    def _describe(self, number: int, seeds: list[int]) -> dict[str, Any]:
        return {"seeds": seeds, "sha256": sha256(self.path(number))}

    def _write_list(self) -> None:
        write_json(self._work / LIST_FILE, {"parts": self._facts}, sealed=True)


def _read_list(work: Path) -> list[dict[str, Any]]:
    path = work / LIST_FILE
    if not path.exists():
        return []
    try:
        return [
            {"seeds": [int(seed) for seed in part["seeds"]], "sha256": str(part["sha256"])}
            for part in read_json(path, "list of parts")["parts"]
        ]
    except (DamagedError, KeyError, TypeError, ValueError):
        warn(f"'{path}' is damaged; it is made again from the parts themselves.")
        return []


def _read_part(path: Path, facts: dict[str, Any] | None) -> pa.Table | None:
    """Return a part if it is what was written."""
    if facts and sha256(path) != facts["sha256"]:
        return None
    try:
        table = current_log(read_parquet(path, "part of a collection"))
        _spawns(table)
    except (DamagedError, KeyError):
        return None
    return table


def _spawns(table: pa.Table) -> list[int]:
    """Return the spawn seeds of a part's episodes, in order."""
    firsts_N = np.asarray(table.column("step").to_numpy()) == 0
    return np.asarray(table.column("spawn_seed").to_numpy())[firsts_N].tolist()
