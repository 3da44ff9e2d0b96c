"""Phase 1, collecting: a driver in many episodes side by side, every decision safe on disk (paper: sections 3.1, 4.2).

A directory in progress holds ``collecting/``: the settings, a Parquet part for each finished group of episodes and the
journal of the group in progress, and what a teacher that reflects has learned so far. A complete one holds the dataset
alone. The same command goes on wherever a process was ended, by any signal, and ends with the same transitions, byte
for byte, and the same log, apart from the seconds that its decisions took.
"""

import contextlib
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rapid.data.budget import Budget, SpentError, Tally
from rapid.data.dataset import Dataset, load_dataset, save_dataset
from rapid.data.dataset_files import DATASET_FILE, LOG_FILE, TRANSITIONS_FILE
from rapid.data.driving import JOURNAL_FILE, Collecting, MakeWorlds
from rapid.data.journal import check_settings, check_unclaimed
from rapid.data.parts import LIST_FILE
from rapid.data.tables import PART_SCHEMA, to_table, write_parquet
from rapid.data.unwritten import UNWRITTEN_FILE, reopen
from rapid.errors import RapidError
from rapid.files import make_directory, read_json, remove_leftovers, write_json, write_text
from rapid.locks import LOCK_FILE, exclusive
from rapid.progress import Task
from rapid.scenarios import get_scenario
from rapid.spawns import TrainPart, train_part
from rapid.teacher.decision import Teacher
from rapid.teacher.experience import MEMORY_FILE, to_lines


def parse_shard(shard: str) -> tuple[int, int]:
    """Return (i, n) of ``"i/n"``, 1 <= i <= n.

    Raises:
        RapidError: it is not written so.
    """
    left, _, right = shard.partition("/")
    if left.isdecimal() and right.isdecimal() and 1 <= int(left) <= int(right):
        return int(left), int(right)
    raise RapidError(f"Shard '{shard}' is not of the form i/n with 1 <= i <= n. For the second of four, write 2/4.")


def identity(teacher: Teacher) -> dict[str, Any]:
    """Return who drives, as it will be read back from JSON: a comparison then sees no tuples."""
    return json.loads(json.dumps({"name": teacher.name, **teacher.describe()}))


def collect(
    teacher: Teacher,
    scenario: str,
    directory: str | os.PathLike[str],
    transitions: int | None,
    lockstep: int = 16,
    *,
    source: TrainPart = "teacher",
    seeds: Sequence[int] | None = None,
    shard: str = "1/1",
    budget: Budget | None = None,
    make_worlds: MakeWorlds | None = None,
    progress: Task | None = None,
    watch: Callable[[Tally], None] | None = None,
) -> Dataset:
    """Collect whole episodes until there are at least `transitions`, or go on with what the directory holds.

    Args:
        teacher: who drives.
        scenario: name of the scenario.
        directory: the dataset's place.
        transitions: how many; of all shards together. At most 29 more are collected, to end with a whole episode.
            None is one episode of each of the `seeds`.
        lockstep: episodes driven side by side.
        source: `teacher` or `random`: the provenance of every transition.
        seeds: spawn seeds, used in order; None is the part of the set `train` that belongs to the source.
        shard: `i/n` collects every n-th seed from the i-th on, and 1/n of the transitions.
        budget: when to stop early; the dataset then has the finished groups and a later call goes on.
        make_worlds: gives a vector environment of so many worlds in which a finished world waits; None is
            `rapid.make_vec(scenario, n, autoreset=False)`.
        progress: counts transitions; its note shows decisions/s, cost and the share of fallbacks.
        watch: is called after every step with how far it is.

    Raises:
        SpentError: the budget did not suffice for a single group of episodes.
        RapidError: the directory holds something else, is in use or damaged, the seeds or the budget do not suffice.
    """
    root = Path(directory)
    part, parts = parse_shard(shard)
    seeds = (train_part(source) if seeds is None else seeds)[part - 1 :: parts]
    settings = {
        "scenario": get_scenario(scenario).name,
        "source": source,
        "driver": identity(teacher),
        "seeds": {"first": seeds[0] if len(seeds) else None, "count": len(seeds)},
        "shard": shard,
    }
    work = root / "collecting"
    with exclusive(root):
        dataset = _resume(root, work, settings)
        target = None if transitions is None else math.ceil(transitions / parts)
        if dataset is not None:
            episodes = len(np.unique(dataset.transitions.episode_N))
            if episodes >= len(seeds) if target is None else len(dataset) >= target:
                _remove(work)
                if progress:
                    progress.skip(len(dataset))
                return dataset
            _reopen(dataset, work)
            write_json(work / "settings.json", settings, sealed=True)
            (root / DATASET_FILE).unlink()
        run = Collecting(teacher, settings, seeds, work, budget or Budget(), progress, watch)
        try:
            spent = run.collect_until(target, lockstep, make_worlds or _default_worlds(scenario))
        except BaseException:
            if not run.begun:
                _remove(work)  # nothing was decided: other settings may follow
            raise
        dataset = run.dataset(complete=not spent)
        if not len(dataset):
            raise SpentError(
                f"{spent} before the first group of episodes was finished. Every decision is kept: raise the budget "
                "and run the same command again, or collect fewer episodes side by side."
            )
        save_dataset(dataset, root)
        if not spent:
            _remove(work)
        return dataset


def _default_worlds(scenario: str) -> MakeWorlds:
    from rapid.simulator import make_vec

    return lambda count: make_vec(scenario, count, autoreset=False)


def _resume(root: Path, work: Path, settings: dict[str, Any]) -> Dataset | None:
    """Check that the directory is of these settings; return its dataset if it is complete."""
    dataset = load_dataset(root) if (root / DATASET_FILE).exists() else None
    before: dict[str, Any] | None = None
    if dataset is not None:
        before = (dataset.collection or {}).get("settings", {})
    elif (work / "settings.json").exists():
        before = read_json(work / "settings.json", "record of the collection")
    elif (work / JOURNAL_FILE).exists() or any(work.glob("part-*")):
        raise RapidError(f"'{work}' has lost its settings.json. Delete the directory to start anew.")
    else:
        check_unclaimed(root, (TRANSITIONS_FILE, LOG_FILE, MEMORY_FILE))
    check_settings(root, before, settings)
    make_directory(work)
    if dataset is None or not dataset.collection or not dataset.collection["complete"]:
        if dataset is not None and not (work / "settings.json").exists():
            _reopen(dataset, work)
        write_json(work / "settings.json", settings, sealed=True)
        return None
    # A complete dataset is the truth; what lies beside it was left by a process that ended while cleaning up.
    _clear(work)
    return dataset


def _clear(work: Path) -> None:
    """Remove what a collection keeps while it is under way."""
    for pattern in ("part-*", "journal*.jsonl", LIST_FILE, MEMORY_FILE, UNWRITTEN_FILE, "settings.json"):
        for path in work.glob(pattern):
            path.unlink()


def _remove(work: Path) -> None:
    """Remove the directory of a collection in progress, unless something is in it that is not ours."""
    if not work.exists():
        return
    _clear(work)
    (work / LOCK_FILE).unlink(missing_ok=True)  # where an earlier version had its lock
    remove_leftovers(work)
    with contextlib.suppress(OSError):
        work.rmdir()


def _reopen(dataset: Dataset, work: Path) -> None:
    """Make a part of a dataset, so that a collection can go on from it."""
    _clear(work)
    table = to_table(dataset.transitions)
    if dataset.log is None:
        raise RapidError(f"The dataset beside '{work}' has no teacher log to go on from. Choose another directory.")
    for field in PART_SCHEMA:
        if field.name not in table.column_names:
            table = table.append_column(field, dataset.log.column(field.name))
    reopen(work / UNWRITTEN_FILE, dataset.collection)
    if dataset.memory is not None:
        # First: an episode in a part that is not in the memory would be looked back on again.
        write_text(work / MEMORY_FILE, to_lines(dataset.memory[dataset.known :]))
    write_parquet(table.cast(PART_SCHEMA), work / "part-00000.parquet")
