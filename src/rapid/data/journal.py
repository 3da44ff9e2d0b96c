"""The journal of a collection: every decision is on disk before it acts, so that no answer is ever paid for twice."""

import json
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.config_io import differences
from rapid.errors import RapidError
from rapid.files import AppendedFile, truncate
from rapid.outputs import ClashError
from rapid.progress import warn
from rapid.teacher.decision import Decision, from_record, to_record

_SYNC_AFTER_SECONDS = 0.1
_CRC = "crc32"


class Journal:
    """The decisions of the group of episodes in progress, one JSON line a lockstep step, each with its checksum.

    The simulator is deterministic, so the decisions alone bring the group back to where it was. From the first line on
    that was cut off or damaged the file is dropped: those steps are decided anew.
    """

    def __init__(self, path: Path, group: int) -> None:
        self.path = path
        self._lines: list[dict[str, Any]] = []
        content = path.read_bytes() if path.exists() else b""
        good = 0
        for line in content.splitlines(keepends=True):
            record = _read_line(line)
            if record is None:
                break
            self._lines.append(record)
            good += len(line)
        if content[good:].count(b"\n") > content[good:].endswith(b"\n"):
            warn(f"'{path}' is damaged after line {len(self._lines)}. The steps from there on are decided anew.")
        if self._lines and self._lines[0].get("group") != group:
            # The group was finished, and the process ended before it could remove its journal.
            self._lines, good = [], 0
        if good < len(content):
            truncate(path, good)
        self._next = 1
        self._kept: list[Decision | None] = []
        self._stream = AppendedFile(path)

    @property
    def seeds(self) -> list[int] | None:
        """Spawn seeds of the group in progress; None if the journal is empty."""
        return self._lines[0]["seeds"] if self._lines else None

    def begin(self, group: int, seeds: Sequence[int]) -> None:
        """Write the first line."""
        record = {"group": group, "seeds": list(seeds)}
        self._lines.append(record)
        self._write(record)

    def recall(self, obs_BVF: NDArray[np.float32]) -> list[Decision] | None:
        """Return the recorded decisions for these observations, or None where the record ends.

        What was decided of a step that was broken off is left for :meth:`kept`.

        Raises:
            RapidError: the decisions were made for other observations.
        """
        self._kept = []
        while self._next < len(self._lines):
            record = self._lines[self._next]
            if record["seen"] != _checksum(obs_BVF):
                raise RapidError(
                    f"Line {self._next + 1} of '{self.path}' was decided for other observations than the simulator "
                    "gives now: its version or this machine's arithmetic has changed. Delete the file to decide the "
                    "group anew."
                )
            self._next += 1
            self._kept = [decision and from_record(decision) for decision in record["decisions"]]
            decisions = [decision for decision in self._kept if decision is not None]
            if len(decisions) == len(self._kept):
                return decisions
        return None

    def kept(self, count: int) -> list[Decision | None]:
        """Return what :meth:`recall` found of the step that was broken off; None is still to be decided."""
        return self._kept or [None] * count

    def append(self, obs_BVF: NDArray[np.float32], decisions: Sequence[Decision | None]) -> None:
        """Write the decisions for these observations, on the disk before it returns; None if one was not made."""
        made = [decision for decision in decisions if decision is not None]
        record = {"seen": _checksum(obs_BVF), "decisions": [decision and to_record(decision) for decision in decisions]}
        self._lines.append(record)
        self._next += 1
        # What the system holds outlives the process; only a power cut could take it. Sync what took long to get.
        self._write(record, sync=sum(decision.seconds for decision in made) > _SYNC_AFTER_SECONDS)

    def forget_from(self, unwanted: Callable[[Decision], bool]) -> list[Decision]:
        """Remove the first step with an unwanted decision and all steps after it, to be decided anew; return them."""
        steps = [any(map(unwanted, self._decisions(line))) for line in self._lines[1:]]
        return self._keep(1 + steps.index(True)) if True in steps else []

    def forget_end(self, unwanted: Callable[[Decision], bool]) -> list[Decision]:
        """Remove the steps at the end of which the last decision is unwanted, and return what was decided in them."""
        count = len(self._lines)
        while count > 1 and any(map(unwanted, self._decisions(self._lines[count - 1])[-1:])):
            count -= 1
        return self._keep(count)

    def _keep(self, count: int) -> list[Decision]:
        """Remove all lines but the first `count`; return the decisions in the others."""
        removed = [decision for line in self._lines[count:] for decision in self._decisions(line)]
        lines = self.path.read_bytes().splitlines(keepends=True)
        truncate(self.path, sum(map(len, lines[:count])))
        del self._lines[count:]
        self._next = min(self._next, count)
        return removed

    @staticmethod
    def _decisions(line: dict[str, Any]) -> list[Decision]:
        return [from_record(decision) for decision in line["decisions"] if decision is not None]

    def close(self) -> None:
        """Close the file and keep it."""
        self._stream.close()

    def finish(self) -> None:
        """Close and remove the file: the group is safe elsewhere."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _write(self, record: dict[str, Any], sync: bool = False) -> None:
        text = _to_text(record)
        line = f'{text[:-1]},"{_CRC}":{zlib.crc32(_to_bytes(text))}}}\n'
        self._stream.append(_to_bytes(line), sync)


def _read_line(line: bytes) -> dict[str, Any] | None:
    """Return what a line holds; None if it was cut off or is not what was written."""
    try:
        record = json.loads(line) if line.endswith(b"\n") else None
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict):
        return None
    # An earlier version wrote no checksums.
    checksum = record.pop(_CRC, None)
    return record if checksum is None or checksum == zlib.crc32(_to_bytes(_to_text(record))) else None


def _to_text(record: dict[str, Any]) -> str:
    return json.dumps(record, ensure_ascii=False, separators=(",", ":"))


def _to_bytes(text: str) -> bytes:
    # Half a pair of surrogates, which a server may send, is read back as it was.
    return text.encode("utf-8", "surrogatepass")


def _checksum(obs_BVF: NDArray[np.float32]) -> int:
    return zlib.crc32(np.ascontiguousarray(obs_BVF).tobytes())


def check_settings(root: Path, before: dict[str, Any] | None, settings: dict[str, Any]) -> None:
    """Raise unless a collection in `root` was begun with these settings, or (None) not begun.

    Raises:
        ClashError: the settings differ; the message names them.
    """
    if before is not None and before != settings:
        raise ClashError(
            f"'{root}' was collected with other settings: {differences(before, settings)}. Nothing was changed. Use "
            "the same settings to go on, choose another directory, or replace what is there with --force."
        )


def check_unclaimed(root: Path, names: Sequence[str]) -> None:
    """Raise unless a directory in which nothing was collected is free of files that a dataset would replace.

    Raises:
        ClashError: one of `names` is there.
    """
    if found := [name for name in names if (root / name).exists()]:
        raise ClashError(
            f"'{root}' holds {found[0]}, but nothing says that it was collected there. Nothing was changed. Choose "
            "another directory, or replace what is there with --force."
        )
