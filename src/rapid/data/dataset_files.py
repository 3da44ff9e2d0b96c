"""The files of a dataset: their names, what ``dataset.json`` must say, and whether they are those that were written."""

from pathlib import Path
from typing import Any, Literal, get_args

from rapid.errors import RapidError
from rapid.files import sha256
from rapid.teacher.experience import MEMORY_FILE

SCHEMA_VERSION = 1
DATASET_FILE, TRANSITIONS_FILE, LOG_FILE = "dataset.json", "transitions.parquet", "teacher_log.parquet"

MixLevel = Literal["transition", "batch"]


def check_kinds(meta: dict[str, Any]) -> None:
    """Raise TypeError or ValueError unless what ``dataset.json`` says has the form that its readers expect."""
    for name in ("mixture", "collection"):
        if meta[name] is not None and not isinstance(meta[name], dict):
            raise TypeError(f"'{name}' is {meta[name]!r}")
    if not all(isinstance(driver, dict) for driver in meta["drivers"].values()):
        raise TypeError("'drivers' does not describe each driver")
    mixture: dict[str, Any] = meta["mixture"] or {"p": 0, "level": "transition"}
    if not 0 <= mixture["p"] <= 1 or mixture["level"] not in get_args(MixLevel):
        raise ValueError(f"'mixture' has the share {mixture['p']!r} and the level {mixture['level']!r}")


def check_files(root: Path, listed: dict[str, Any]) -> None:
    """Raise unless every file of the dataset is named with its size and hash, and has them.

    Args:
        root: the dataset's directory.
        listed: what ``dataset.json`` says of each file.

    Raises:
        RapidError: a file is missing, foreign, not named, cut off or another one.
        KeyError: the size or hash of a file is not told.
    """
    unnamed = [name for name in (LOG_FILE, MEMORY_FILE) if name not in listed and (root / name).exists()]
    for name in (TRANSITIONS_FILE, *unnamed):
        if name not in listed:
            raise RapidError(
                f"'{root / DATASET_FILE}' does not name the SHA-256 of '{name}', so nobody can tell whether that is "
                "the file that was written. Copy the dataset again, as a whole."
            )
    for name, facts in listed.items():
        if name not in (TRANSITIONS_FILE, LOG_FILE, MEMORY_FILE):
            raise RapidError(f"'{root / DATASET_FILE}' names a file '{name}', which no dataset has. Copy it again.")
        _check_file(root / name, facts)


def _check_file(path: Path, facts: dict[str, Any]) -> None:
    """Raise unless the file has the size and hash that were recorded."""
    if not path.is_file():
        raise RapidError(f"The dataset lacks its file '{path}'. Copy it there, or make the dataset again.")
    size = path.stat().st_size
    if size != facts["bytes"]:
        raise RapidError(
            f"'{path}' has {size} bytes, expected {facts['bytes']}: it was cut off. Copy or make it again."
        )
    if sha256(path) != facts["sha256"]:
        raise RapidError(f"'{path}' is not the file that was written (its SHA-256 differs). Copy or make it again.")
