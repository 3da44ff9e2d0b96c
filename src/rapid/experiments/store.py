"""Where the results of cells lie: one directory a cell, and read-only layers of what is committed.

A cell's directory ``KIND/KEY`` holds ``cell.json`` (what it is), its files, and last ``done.json`` (hashes, commit,
versions, seconds): without it the cell is not done, and a training in it goes on from its checkpoint. A layer is a
directory with the small results of many cells: ``*.parquet`` (episode rows with the key of their cell) and ``*.jsonl``
(one line a cell: metrics, scenes or seconds).
"""

import json
import shutil
from collections import Counter
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rapid.data.tables import read_parquet
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, load_rows, rows_of_table, save_rows
from rapid.experiments.cells import Cell, Drive, describe, key, kind_of
from rapid.experiments.migrate import Legacy, legacy_rows
from rapid.files import read_json, sha256, write_json, write_text
from rapid.locks import LOCK_FILE, exclusive
from rapid.runs import commit, versions
from rapid.training.machinery.record import CHECKPOINT_FILE, load_metrics

FORMAT = 1
ROWS, FACTS, DONE = "rows.parquet", "facts.json", "done.json"


class Store:
    """The results of cells under `root`, and in `layers`, which are only read; `results` has rows of before cells.

    Raises:
        RapidError: `root` holds something else, or a store of another format.
    """

    def __init__(self, root: Path, layers: Sequence[Path] = (), results: Path | None = None) -> None:
        self.root, self.layers, self._results = root, tuple(layers), results
        self.shown: Counter[str] = Counter()
        """Commits of what tables and figures have taken from here; a page clears it before each of them."""
        marker = root / "store.json"
        if marker.exists():
            found = read_json(marker, "store of results")
            if not isinstance(found, dict) or found.get("format") != FORMAT:
                raise RapidError(
                    f"'{root}' is a store of results of another version than {FORMAT}. Name another --store."
                )
        elif root.exists() and (not root.is_dir() or any(root.iterdir())):
            raise RapidError(f"'{root}' exists and is no store of results. Name another --store, or an empty one.")
        else:
            write_json(marker, {"format": FORMAT})

    def place(self, cell: Cell) -> Path:
        """Return the cell's own directory, whether or not it is there."""
        return self.root / kind_of(cell) / key(cell)

    def is_done(self, cell: Cell) -> bool:
        """Whether the cell's files are here, or its small results in a layer."""
        return self.is_here(cell) or key(cell) in self._layered

    def is_here(self, cell: Cell) -> bool:
        """Whether the cell's own files are here."""
        return (self.place(cell) / DONE).exists()

    def provenance(self, cell: Cell) -> dict[str, Any]:
        """Return who computed the cell: commit, versions, seconds; empty if it is not here."""
        return read_json(self.place(cell) / DONE, "record of a cell") if self.is_here(cell) else {}

    @contextmanager
    def begin(self, cell: Cell) -> Generator[Path, None, None]:
        """Hold the cell for this process and give its directory.

        Raises:
            rapid.locks.BusyError: another process holds it.
        """
        place = self.place(cell)
        with exclusive(place):
            if not (place / "cell.json").exists():
                write_json(place / "cell.json", describe(cell))
            yield place

    def finish(self, cell: Cell, seconds: float, cpu_seconds: float = 0.0) -> None:
        """Mark a cell as done; what was only needed to resume goes."""
        place = self.place(cell)
        for path in place.rglob(CHECKPOINT_FILE):
            path.unlink()
        files = sorted(path for path in place.rglob("*") if path.is_file() and path.name not in (DONE, LOCK_FILE))
        write_json(
            place / DONE,
            {
                "cell": describe(cell),
                "seconds": round(seconds, 3),
                "cpu_seconds": round(cpu_seconds, 3),
                **_provenance(),
                "files": {str(path.relative_to(place)): sha256(path) for path in files},
            },
        )

    def check(self, cell: Cell) -> None:
        """Look whether the files of a done cell are as they were written; if not, it is no longer done.

        What is left of it is put aside, and nothing is thrown away: it may hold answers that were paid for.

        Raises:
            rapid.locks.BusyError: it is not, and another process holds the cell, perhaps to make it anew.
            RapidError: it is not; the cell is to be made anew.
        """
        if not self._damaged(cell):
            return
        with self.begin(cell) as place:
            name = self._damaged(cell)  # again: another process may have made it anew meanwhile
            if not name:
                return
            aside = place.with_name(f"{place.name}.damaged")
            shutil.rmtree(aside, ignore_errors=True)
            aside.mkdir()
            (place / DONE).replace(aside / f"{DONE}.old")  # first: a kill in between leaves nothing that looks done
            for path in [path for path in place.iterdir() if path.name != LOCK_FILE]:
                path.replace(aside / path.name)
        raise RapidError(
            f"'{place / name}' is damaged or gone, so its part is made anew, by this command or by the same one again. "
            f"What is left of it lies in '{aside}' now."
        )

    def _damaged(self, cell: Cell) -> str:
        """Return the name of a file of a done cell that is not as it was written, or nothing."""
        place = self.place(cell)
        try:
            files = self.provenance(cell).get("files", {})
        except RapidError:
            return DONE
        for name, digest in files.items():
            if not (place / name).is_file() or sha256(place / name) != digest:
                return name
        return ""

    def rows(self, cell: Drive) -> list[EpisodeRow]:
        """Return the episodes of a driven cell.

        Raises:
            RapidError: they are not there, or damaged.
        """
        if self.is_here(cell):
            return load_rows(self.place(cell) / ROWS)
        found = self._layered.get(key(cell))
        if not isinstance(found, Slice):
            raise RapidError(f"The cell {key(cell)} has not been driven. Run `rapid reproduce` for it first.")
        return rows_of_table(found.table.take(found.rows), found.path)

    def legacy(self, wanted: Legacy) -> list[EpisodeRow]:
        """Return committed rows from before there were cells."""
        return legacy_rows(self._results, wanted) if self._results else []

    def note(self, rows: Iterable[EpisodeRow]) -> None:
        """Remember the commits of rows that are shown."""
        self.shown.update(row.commit for row in rows)

    def commit(self, cell: Cell) -> str:
        """Return the commit that computed a done cell; empty where nobody wrote it down."""
        found = self._layered.get(key(cell))
        return self.provenance(cell).get("commit", "") or (found.get("commit", "") if isinstance(found, dict) else "")

    def metrics(self, cell: Cell) -> list[dict[str, Any]]:
        """Return the metrics of a training, its second part after the first."""
        if self.is_done(cell):
            self.shown[self.commit(cell)] += 1
        if self.is_here(cell):
            return _all_metrics(self.place(cell))
        found = self._layered.get(key(cell))
        return found["metrics"] if isinstance(found, dict) else []

    def facts(self, cell: Cell) -> dict[str, Any]:
        """Return the facts that a cell of another kind gives."""
        if self.is_done(cell):
            self.shown[self.commit(cell)] += 1
        if self.is_here(cell):
            return read_json(self.place(cell) / FACTS, "facts of a cell")
        found = self._layered.get(key(cell))
        return found["facts"] if isinstance(found, dict) else {}

    def pack(self, cell: Cell) -> dict[str, bytes]:
        """Return the files of a done cell, for a machine that does not share this disk."""
        self.check(cell)
        place = self.place(cell)
        return {name: (place / name).read_bytes() for name in self.provenance(cell)["files"]}

    def export(self, cells: Iterable[Cell], folder: Path, name: str) -> list[Path]:
        """Write the small results of done cells as a layer: ``NAME.parquet`` and ``NAME.jsonl``."""
        tables: list[pa.Table] = []
        lines: list[str] = []
        for cell in sorted(set(cells), key=key):
            if not self.is_done(cell):
                continue
            if isinstance(cell, Drive):
                tables.append(_with_cell(self.rows(cell), cell, self.root))
                continue
            about = {"cell": key(cell), "spec": describe(cell), "commit": self.commit(cell)}
            if metrics := self.metrics(cell) if kind_of(cell) in ("distill", "adapt") else []:
                lines.append(json.dumps({**about, "metrics": metrics}))
            elif kind_of(cell) in ("scenes", "decide"):
                lines.append(json.dumps({**about, "facts": self.facts(cell)}))
        written: list[Path] = []
        if tables:
            written.append(folder / f"{name}.parquet")
            folder.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.concat_tables(tables), written[-1], compression="zstd")
        if lines:
            written.append(folder / f"{name}.jsonl")
            write_text(written[-1], "\n".join(lines) + "\n")
        return written

    @cached_property
    def _layered(self) -> dict[str, "Slice | dict[str, Any]"]:
        """Small results in the layers, by the key of their cell; of two the first counts."""
        found: dict[str, Slice | dict[str, Any]] = {}
        for layer in self.layers:
            for path in sorted(layer.glob("*.parquet")):
                table = read_parquet(path, "file of episode rows")
                if "cell" not in table.column_names:
                    raise RapidError(f"'{path}' is no layer of results: its rows name no cell. Remove it from there.")
                names = np.array(table.column("cell").to_pylist(), np.str_)
                for name in np.unique(names):
                    found.setdefault(str(name), Slice(path, table, np.flatnonzero(names == name)))
            for path in sorted(layer.glob("*.jsonl")):
                for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                    try:
                        content = json.loads(line)
                        found.setdefault(content["cell"], content)
                    except (ValueError, KeyError, TypeError) as error:
                        raise RapidError(f"Line {number} of '{path}' is damaged: {error}. Restore the file.") from error
        return found


class Slice(NamedTuple):
    """The rows of one cell in a file of a layer."""

    path: Path
    table: pa.Table
    rows: NDArray[np.int64]


def unpack(place: Path, files: dict[str, bytes]) -> None:
    """Write packed files to a directory, whose earlier content goes."""
    if place.exists():
        shutil.rmtree(place)
    for name, content in files.items():
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def files_of(place: Path) -> dict[str, bytes]:
    """Return every file under a directory."""
    return {
        str(path.relative_to(place)): path.read_bytes()
        for path in sorted(place.rglob("*"))
        if path.is_file() and path.name not in (LOCK_FILE, CHECKPOINT_FILE)
    }


@cache
def _provenance() -> dict[str, Any]:
    """Who computes, asked for once a process."""
    return {"commit": commit(), "versions": versions()}


def _all_metrics(place: Path) -> list[dict[str, Any]]:
    folders = sorted({path.parent for path in place.rglob("metrics.jsonl")}, key=lambda path: len(path.parts))
    return [row for folder in folders for row in load_metrics(folder)]


def _with_cell(rows: Sequence[EpisodeRow], cell: Drive, scratch: Path) -> pa.Table:
    path = scratch / "export.parquet"
    save_rows(path, rows)
    table = read_parquet(path, "file of episode rows")
    path.unlink()
    return table.append_column("cell", pa.array([key(cell)] * len(rows), pa.string()))
