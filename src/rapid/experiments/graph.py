"""From the cells that are wanted to those that must be computed, and computing them on one machine or many."""

import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rapid.engines import Engine, run_jobs
from rapid.errors import RapidError
from rapid.experiments.cells import Cell, Collect, Decide, Drive, Driver, Shipped, inputs, key, kind_of, title
from rapid.experiments.compute import compute, work_of
from rapid.experiments.costs import rates
from rapid.experiments.store import Store, files_of, unpack
from rapid.locks import BusyError
from rapid.progress import quiet, task

POLL = 2.0
"""Seconds between two looks at cells that another process is computing."""


@dataclass(frozen=True)
class Plan:
    """What is to be done for the cells that are wanted, inputs first."""

    todo: tuple[Cell, ...]
    done: int
    seconds: float
    """Predicted, by one process, from the rates of :func:`rates`."""
    unknown: int
    """Cells of which no rate is known; they are not in `seconds`."""
    decisions: int
    """Decisions of language models that are needed."""


@dataclass
class Outcome:
    """What a run of a plan came to."""

    computed: list[Cell] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """Why, by key: the cell's own failure, or which input failed."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds of work, by kind of cell."""


def plan(wanted: Iterable[Cell], store: Store) -> Plan:
    """Return what must be computed; inputs of what is done are not asked for."""
    found: dict[str, Cell] = {}
    seen: set[str] = set()
    done = 0

    def visit(cell: Cell, needs_files: bool) -> None:
        nonlocal done
        name = key(cell)
        if isinstance(cell, Shipped) or name in found:
            return
        if store.is_here(cell) or (not needs_files and store.is_done(cell)):
            done += name not in seen
            seen.add(name)
            return
        for each in inputs(cell):
            visit(each, True)
        found[name] = cell

    for cell in wanted:
        visit(cell, False)
    rate = rates()
    known = [(work_of(cell), rate.get(work_of(cell)[0])) for cell in found.values()]
    seconds = sum(amount * each for (_, amount), each in known if each is not None)
    return Plan(
        tuple(found.values()),
        done,
        seconds,
        sum(each is None for _, each in known),
        sum(map(_decisions, found.values())),
    )


def run(
    todo: Sequence[Cell],
    store: Store,
    engine: Engine = "local",
    workers: int = 1,
    say: Callable[[str], None] = print,
) -> Outcome:
    """Compute cells, each once its inputs are there; one that fails is reported, and the rest goes on.

    Other processes may compute cells of the same store at the same time: what they hold is waited for. An input that
    is damaged or gone is computed again first; only those of cells that are to be computed are looked at.

    Raises:
        RapidError: the engine cannot be had.
    """
    outcome = Outcome()
    left = {key(cell): cell for cell in todo}
    running: dict[int, tuple[Cell, Any, float]] = {}
    sound: set[str] = set()
    """Inputs that were found as they were written, or computed here: none is read twice to see that."""
    count = 0
    rate = rates()

    def has(needed: Sequence[Cell]) -> bool:
        """Look whether inputs are here and whole; what is not, and nobody is at, is computed again."""
        underway = {key(cell) for cell, _, _ in running.values()}
        whole = True
        for each in needed:
            name = key(each)
            try:
                if name not in sound:
                    store.check(each)
            except BusyError:
                return False
            except RapidError as error:
                say(str(error))
            if store.is_here(each):
                sound.add(name)
                continue
            whole = False
            if name not in underway:
                left.setdefault(name, each)
        return whole

    def ready() -> list["Job"]:
        """Claim every cell that can be begun."""
        nonlocal count
        jobs: list[Job] = []
        for name, cell in list(left.items()):
            if len(running) + len(jobs) >= workers:
                break
            needed = [each for each in inputs(cell) if not isinstance(each, Shipped)]
            failed = next((each for each in needed if key(each) in outcome.failed), None)
            if failed is not None:
                del left[name]
                outcome.failed[name] = f"its input failed: {title(failed)}"
                continue
            if not has(needed):
                continue
            claim = store.begin(cell)
            try:
                place = claim.__enter__()
            except BusyError:
                continue
            del left[name]
            if store.is_here(cell):  # another process has done it meanwhile
                claim.__exit__(None, None, None)
                continue
            try:
                given = {key(each): str(store.place(each)) for each in needed}
                packed = {key(each): store.pack(each) for each in needed} if engine == "ray" else None
            except RapidError as error:
                claim.__exit__(None, None, None)
                outcome.failed[name] = str(error)
                continue
            running[count] = cell, claim, time.monotonic()
            jobs.append(Job(cell, str(place), given, packed))
            count += 1
        return jobs

    def settle(index: int, result: "Result") -> None:
        cell, claim, _ = running.pop(index)
        try:
            if result.error:
                outcome.failed[key(cell)] = result.error
                say(f"failed: {title(cell)}: {result.error}")
                return
            if result.files is not None:
                for name, content in result.files.items():
                    path = store.place(cell) / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
            store.finish(cell, result.seconds, result.cpu_seconds)
            sound.add(key(cell))
            outcome.computed.append(cell)
            outcome.seconds[kind_of(cell)] = outcome.seconds.get(kind_of(cell), 0.0) + result.seconds
        finally:
            claim.__exit__(None, None, None)

    predictable = all(work_of(cell)[0] in rate for cell in todo)

    def weight(cell: Cell) -> float:
        name, amount = work_of(cell)  # of an input that is computed again there may be no rate
        return max(amount * rate.get(name, 0.0), 1.0) if predictable else 1.0

    total, unit = sum(map(weight, todo)), "s of work, as predicted" if predictable else "parts"
    with task("reproduce", total, unit) as work:
        try:
            while left or running:
                before = len(left)
                for index, result in run_jobs(
                    do, (), engine, workers, more=ready, lost=lambda _, why: Result(0.0, None, why)
                ):
                    cell = running[index][0]
                    settle(index, result)
                    work.advance(weight(cell))
                    work.note(title(cell))
                if left and len(left) == before:
                    time.sleep(POLL)  # what is left waits for another process
                    for cell in [cell for cell in left.values() if store.is_here(cell)]:
                        del left[key(cell)]
                        work.advance(weight(cell))
        finally:
            for _, claim, _ in running.values():
                claim.__exit__(None, None, None)
    return outcome


@dataclass(frozen=True)
class Job:
    """A cell to be computed, here in its place, or elsewhere from packed inputs."""

    cell: Cell
    place: str
    given: Mapping[str, str]
    packed: Mapping[str, dict[str, bytes]] | None


@dataclass(frozen=True)
class Result:
    """Seconds of work, the files if they were made elsewhere, and why there are none."""

    seconds: float
    files: dict[str, bytes] | None = None
    error: str = ""
    cpu_seconds: float = 0.0
    """Seconds of processor time, which other work beside it does not lengthen."""


def do(job: Job, report: Callable[[Any], None]) -> Result:
    """Compute a cell; a failure is a result, so that the others go on."""
    start, cpu = time.monotonic(), time.process_time()
    try:
        with quiet():
            if job.packed is None:
                compute(job.cell, Path(job.place), {name: Path(path) for name, path in job.given.items()})
                return Result(time.monotonic() - start, cpu_seconds=time.process_time() - cpu)
            with tempfile.TemporaryDirectory(prefix="rapid-") as scratch:
                root = Path(scratch)
                for name, files in job.packed.items():
                    unpack(root / name, files)
                (root / "own").mkdir()
                compute(job.cell, root / "own", {name: root / name for name in job.packed})
                files = files_of(root / "own")
                return Result(time.monotonic() - start, files, cpu_seconds=time.process_time() - cpu)
    except RapidError as error:
        return Result(time.monotonic() - start, None, str(error))
    except OSError as error:
        return Result(time.monotonic() - start, None, f"The system refused: {error}. Make room or check permissions.")
    except Exception as error:  # a fault of the program in one cell is no reason to lose the others
        return Result(time.monotonic() - start, None, f"{type(error).__name__}: {error}")


def _decisions(cell: Cell) -> int:
    if isinstance(cell, Collect):
        return cell.transitions if cell.driver.backend != "scripted" else 0
    if isinstance(cell, Drive | Decide) and isinstance(cell.agent, Driver) and cell.agent.teacher is not None:
        scripted = cell.agent.teacher.backend == "scripted"
        return 0 if scripted else cell.decisions if isinstance(cell, Decide) else 30 * cell.spawns
    return 0
