"""A collection divided into shards: each a collection of its own, under way at once here or on many machines.

A directory in progress holds ``collecting/``: the settings and one directory a shard. Once all are done they are joined
into the dataset, and ``collecting/`` goes. What is collected depends on the number of shards, not on who works on them,
when or where; the same command goes on after a kill, also with other workers or another engine.
"""

import contextlib
import math
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from rapid.data.budget import Budget, SpentError, Tally
from rapid.data.collection import collect, identity
from rapid.data.dataset import Dataset, join, load_dataset, save_dataset
from rapid.data.dataset_files import DATASET_FILE, LOG_FILE, TRANSITIONS_FILE
from rapid.data.driving import MakeWorlds
from rapid.data.journal import check_settings, check_unclaimed
from rapid.data.transitions import SOURCES, concatenate
from rapid.engines import Engine, Report, check_engine, run_jobs
from rapid.errors import RapidError
from rapid.files import make_directory, read_json, write_bytes, write_json
from rapid.locks import LOCK_FILE, exclusive
from rapid.progress import Task
from rapid.scenarios import get_scenario
from rapid.spawns import TrainPart, train_part
from rapid.teacher.decision import Teacher
from rapid.teacher.experience import MEMORY_FILE

MAX_SHARDS = 1000
_BETWEEN_REPORTS = 1.0
"""Seconds."""


def settings_of(directory: Path) -> dict[str, Any] | None:
    """Return the settings of the collection in `directory`; None if there is none yet."""
    for path, keys in (
        (directory / "collecting" / "settings.json", ()),
        (directory / DATASET_FILE, ("collection", "settings")),
    ):
        if path.exists():
            value = read_json(path, "record of the collection")
            for key in keys:
                value = value.get(key) if isinstance(value, dict) else None
            return value if isinstance(value, dict) else {}
    return None


def shards_of(directory: Path) -> int | None:
    """Return into how many shards the collection in `directory` is divided; None if there is none yet."""
    settings = settings_of(directory)
    if settings is None:
        return None
    shards = settings.get("shards")
    return shards if isinstance(shards, int) else 1


def collect_shards(
    make_teacher: Callable[[], Teacher],
    scenario: str,
    directory: Path,
    transitions: int,
    lockstep: int = 16,
    *,
    shards: int,
    workers: int = 1,
    engine: Engine = "local",
    source: TrainPart = "teacher",
    budget: Budget | None = None,
    make_worlds: MakeWorlds | None = None,
    progress: Task | None = None,
) -> Dataset:
    """Collect at least `transitions` in `shards` parts, or go on with what the directory holds.

    Every shard takes every n-th spawn seed and 1/n of the transitions, as ``collect(shard="i/n")`` does; see there for
    the arguments not named here. Where the machines of a Ray cluster share the directory, a shard that was interrupted
    goes on from its last decision; where they do not, from what its last machine kept.

    `make_teacher` makes the driver anew for each worker; like `make_worlds` it must be picklable. At most `workers`
    shards are under way at once. The budget is of all shards together; each gets an equal part of decisions, tokens
    and cost.

    Raises:
        RapidError: as `collect`; the directory was divided otherwise; a worker was lost.
    """
    check_engine(engine)
    if not 1 <= shards <= MAX_SHARDS:
        raise RapidError(f"A collection has 1 to {MAX_SHARDS} shards, not {shards}.")
    root = directory.absolute()
    work = root / "collecting"
    # Made here first: a teacher that cannot be had is known before any worker starts, and its weights are fetched once.
    driver = identity(make_teacher())
    settings = {"scenario": get_scenario(scenario).name, "source": source, "driver": driver, "shards": shards}
    with exclusive(root):
        before = load_dataset(root) if (root / DATASET_FILE).exists() else None
        _check_same(root, settings, before)
        make_directory(work)
        if before is not None and (before.collection or {}).get("complete"):
            if len(before) >= transitions:
                _remove(work)
                if progress:
                    progress.skip(len(before))
                return before
            # It is the truth; what lies beside it was left by a process that ended while cleaning up.
            _clear(work)
        if before is not None and not (work / "settings.json").exists():
            _split(before, work)
        write_json(work / "settings.json", settings, sealed=True)
        if before is not None and (before.collection or {}).get("complete"):
            (root / DATASET_FILE).unlink()
        now = time.time()
        jobs = [
            _Job(
                make_teacher,
                make_worlds,
                scenario,
                _place(work, part, shards),
                transitions,
                lockstep,
                source,
                f"{part}/{shards}",
                _share(budget or Budget(), shards),
                deadline=now + budget.seconds if budget and budget.seconds else 0.0,
                ship=engine == "ray",
            )
            for part in range(1, shards + 1)
        ]
        try:
            unspent = _run(jobs, engine, workers, SOURCES.index(source), progress)
        except BaseException:
            if before is None and not any(work.glob("shard-*")):
                _remove(work)  # nothing was decided: other settings may follow
            raise
        parts = [load_dataset(job.directory) for job in jobs if (job.directory / DATASET_FILE).exists()]
        if not parts:
            raise SpentError(
                "The budget was spent before the first group of episodes of any shard was finished. Every decision is "
                "kept: raise the budget and run the same command again, or collect fewer episodes side by side."
            )
        joined = join(parts)
        dataset = replace(joined, collection={"complete": unspent, "settings": settings, **(joined.collection or {})})
        save_dataset(dataset, root)
        if unspent:
            _remove(work)
        return dataset


def _clear(work: Path) -> None:
    """Remove what a collection keeps while it is under way."""
    for path in work.glob("shard-*-of-*"):
        shutil.rmtree(path)
    (work / "settings.json").unlink(missing_ok=True)


def _remove(work: Path) -> None:
    """Remove the directory of a collection in progress, unless something is in it that is not ours."""
    _clear(work)
    (work / LOCK_FILE).unlink(missing_ok=True)  # where an earlier version had its lock
    with contextlib.suppress(OSError):
        work.rmdir()


@dataclass(frozen=True)
class _Job:
    """One shard, as it is sent to a worker."""

    make_teacher: Callable[[], Teacher]
    make_worlds: MakeWorlds | None
    scenario: str
    directory: Path
    transitions: int
    lockstep: int
    source: TrainPart
    shard: str
    budget: Budget
    deadline: float
    """Time of day at which to stop, seconds since the epoch; 0 is never."""
    ship: bool
    """Whether the worker may not see our files: then the shard's travel with the job and with its result."""
    files: Mapping[str, bytes] | None = None


def _run(jobs: list[_Job], engine: Engine, workers: int, source: int, progress: Task | None) -> bool:
    """Work on the shards that are not done; return whether all of them are now."""
    done = [job.directory for job in jobs if _is_done(job)]
    waiting = [job for job in jobs if job.directory not in done]
    if progress:
        progress.skip(sum(map(_rows, done)))
    show = _Display(source, progress)
    for index, files in run_jobs(
        _collect_shard,
        [replace(job, files=_read(job.directory)) if job.ship else job for job in waiting],
        engine,
        workers,
        show,
    ):
        _write(waiting[index].directory, files)
    return all(map(_is_done, jobs))


def _collect_shard(job: _Job, report: Report) -> dict[str, bytes]:
    """Collect one shard and return its files if they are wanted."""
    if job.files and not (job.directory / DATASET_FILE).exists() and not (job.directory / "collecting").exists():
        _write(job.directory, job.files)
    reporter = _Reporter(report)
    budget = job.budget
    if job.deadline:
        budget = replace(budget, seconds=max(job.deadline - time.time(), 1e-9))
    try:
        collect(
            job.make_teacher(),
            job.scenario,
            job.directory,
            job.transitions,
            job.lockstep,
            source=job.source,
            shard=job.shard,
            budget=budget,
            make_worlds=job.make_worlds,
            watch=reporter,
        )
    except SpentError:
        # Other shards may have something to show.
        return {}
    reporter.flush()
    return _read(job.directory) if job.ship else {}


class _Reporter:
    """Passes on how far a shard is, once a second, and at the end."""

    def __init__(self, report: Report) -> None:
        self._report, self._last, self._tally = report, -math.inf, Tally()

    def __call__(self, tally: Tally) -> None:
        self._tally = tally
        if time.monotonic() - self._last >= _BETWEEN_REPORTS:
            self.flush()

    def flush(self) -> None:
        self._last = time.monotonic()
        self._report(self._tally)


class _Display:
    """Adds up what the shards report."""

    def __init__(self, source: int, progress: Task | None) -> None:
        self._source, self._progress = source, progress
        self._tallies: dict[int, Tally] = {}
        self._start = time.monotonic()

    def __call__(self, index: int, tally: Tally) -> None:
        before = self._tallies.get(index, Tally())
        self._tallies[index] = tally
        if self._progress is None:
            return
        fresh = tally.fresh - before.fresh
        decisions, asked, _, cost, fallbacks = map(sum, zip(*self._tallies.values(), strict=True))
        rate = asked / max(time.monotonic() - self._start, 1e-9)
        self._progress.note(Tally(decisions, asked, rate, cost, fallbacks).note(self._source))
        # What an earlier run decided does not enter the estimate of the time left.
        self._progress.skip(tally.decisions - before.decisions - fresh)
        self._progress.advance(fresh)


def _place(work: Path, part: int, shards: int) -> Path:
    return work / f"shard-{part:04}-of-{shards:04}"


def _share(budget: Budget, shards: int) -> Budget:
    """Return one shard's part of a budget; what is limited stays limited."""
    decisions, tokens = (max(1, limit // shards) if limit else 0 for limit in (budget.decisions, budget.tokens))
    return replace(budget, tokens=tokens, cost=budget.cost / shards, seconds=0.0, decisions=decisions)


def _is_done(job: _Job) -> bool:
    path = job.directory / DATASET_FILE
    if not path.exists():
        return False
    how = read_json(path, "dataset")["collection"]
    shards = int(job.shard.partition("/")[2])
    return bool(how["complete"]) and _rows(job.directory) >= math.ceil(job.transitions / shards)


def _rows(directory: Path) -> int:
    return int(read_json(directory / DATASET_FILE, "dataset")["files"][TRANSITIONS_FILE]["rows"])


def _read(directory: Path) -> dict[str, bytes]:
    """Return the files of a dataset, the one that vouches for the others last; nothing if there is none."""
    if not (directory / DATASET_FILE).exists():
        return {}
    names = (TRANSITIONS_FILE, LOG_FILE, MEMORY_FILE, DATASET_FILE)
    return {name: (directory / name).read_bytes() for name in names if (directory / name).exists()}


def _write(directory: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        path = directory / name
        # Where the directory is shared, the file is there already.
        if not path.exists() or path.read_bytes() != content:
            write_bytes(path, content)


def _check_same(root: Path, settings: dict[str, Any], dataset: Dataset | None) -> None:
    """Raise unless the directory is empty or of these settings."""
    work, before = root / "collecting", None
    if (work / "settings.json").exists():
        before = read_json(work / "settings.json", "record of the collection")
    elif dataset is not None:
        before = (dataset.collection or {}).get("settings", {})
    elif any(work.glob("shard-*")):
        raise RapidError(f"'{work}' has lost its settings.json. Delete the directory to start anew.")
    else:
        check_unclaimed(root, (TRANSITIONS_FILE, LOG_FILE, MEMORY_FILE))
    check_settings(root, before, settings)


def _split(dataset: Dataset, work: Path) -> None:
    """Undo the join, so that each shard can go on."""
    how, rows, log = dataset.collection, dataset.transitions, dataset.log
    if how is None or log is None:
        raise RapidError(f"The dataset beside '{work}' has no teacher log to go on from. Choose another directory.")
    for collection in how["shards"]:
        part, shards = map(int, collection["settings"]["shard"].split("/"))
        seeds = train_part(collection["settings"]["source"])[part - 1 :: shards]
        index = np.flatnonzero(np.isin(rows.spawn_seed_N, np.arange(seeds.start, seeds.stop, seeds.step)))
        own = rows.select(index)
        own = concatenate([replace(own, episode_N=own.episode_N - own.episode_N.min())])
        place = log.schema.get_field_index("episode")
        own_log = log.take(pa.array(index)).set_column(place, log.schema.field("episode"), pa.array(own.episode_N))
        memory = dataset.memory
        if memory is not None:
            learned = [past for past in memory[dataset.known :] if past.spawn_seed in seeds]
            memory = (*memory[: dataset.known], *learned)
        save_dataset(
            Dataset(dataset.scenario, own, dataset.drivers, own_log, collection=collection, memory=memory),
            _place(work, part, shards),
        )
