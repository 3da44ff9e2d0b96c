"""Where independent pieces of work run: in this process, in processes beside it, or on a Ray cluster.

A job is a function of one argument and of `report`, which sends anything back while the job is under way; all three
must be picklable. What a job returns does not depend on where it ran.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, Literal, TypeVar, get_args

import rapid
from rapid import termination
from rapid.errors import RapidError, did_you_mean, how_to_install
from rapid.ray_address import check_ray_address

Engine = Literal["local", "ray"]
"""`local`: this machine. `ray`: the cluster that the environment variable RAY_ADDRESS names or that runs here, else a
Ray of one's own on this machine."""

Report = Callable[[Any], None]
Argument = TypeVar("Argument")
Result = TypeVar("Result")

_POLL = 0.5
"""Seconds between two looks at what Ray's tasks have reported."""
_PATIENCE = 5.0
"""Seconds that a process has to end when it is told to."""
_RETRIES = 3
"""Times that Ray starts a task again whose process or machine was lost."""


def run_jobs(
    function: Callable[[Argument, Report], Result],
    arguments: Sequence[Argument],
    engine: Engine = "local",
    workers: int = 1,
    receive: Callable[[int, Any], None] | None = None,
    more: Callable[[], Sequence[Argument]] | None = None,
    lost: Callable[[int, str], Result] | None = None,
) -> Generator[tuple[int, Result], None, None]:
    """Run one job for each argument, at most `workers` at once, and yield (index, result) as they end.

    The first job that fails ends them all, as does closing the generator; jobs must be able to bear that. One local
    worker is this process.

    Args:
        function: the job, found by its name in a module.
        arguments: one for each job.
        engine: where they run.
        workers: how many run at once.
        receive: is called with (index, report) in this process.
        more: is asked for further arguments whenever a worker is free, and has none once all is done.
        lost: gives the result of a job whose process was lost, and the others go on; None ends them all.

    Raises:
        RapidError: what a job raised, a job's process that was lost, or an engine that cannot be had.
    """
    check_engine(engine)
    hear = receive or (lambda index, report: None)
    waiting = _Waiting(arguments, more)
    if engine == "ray":
        yield from _on_ray(function, waiting, workers, hear, lost)
    elif workers == 1:
        while waiting.fill():
            index, argument = waiting.pop()
            yield index, function(argument, partial(hear, index))
    else:
        yield from _in_processes(function, waiting, workers, hear, lost)


class _Waiting(Generic[Argument]):
    """Jobs that are waiting, and those that are still to come."""

    def __init__(self, arguments: Sequence[Argument], more: Callable[[], Sequence[Argument]] | None) -> None:
        self._waiting = deque(enumerate(arguments))
        self._more = more
        self.total = len(arguments)

    def fill(self) -> bool:
        """Ask for more if none is waiting; whether there is one now."""
        if not self._waiting and self._more is not None:
            for argument in self._more():
                self._waiting.append((self.total, argument))
                self.total += 1
        return bool(self._waiting)

    def put_back(self, index: int, argument: Argument) -> None:
        """Let a job be the next again."""
        self._waiting.appendleft((index, argument))

    def pop(self) -> tuple[int, Argument]:
        """Return the next job and its number."""
        return self._waiting.popleft()


@dataclass
class _Running(Generic[Argument]):
    """A job and the process that does it."""

    index: int
    argument: Argument
    process: Any
    begun: bool
    """Whether its end is the job's end: a process that did another job before may have ended since."""


def check_engine(engine: str) -> None:
    """Look whether an engine can be had.

    Raises:
        RapidError: it does not exist, is not installed, or nobody answers where RAY_ADDRESS says.
    """
    if engine not in get_args(Engine):
        raise RapidError(
            f"Unknown engine '{engine}'{did_you_mean(engine, get_args(Engine))} "
            f"Choose one of {', '.join(get_args(Engine))}."
        )
    if engine == "ray" and not _need_ray().is_initialized():
        check_ray_address(os.environ.get("RAY_ADDRESS", ""))


def _in_processes(
    function: Callable[[Argument, Report], Result],
    waiting: _Waiting[Argument],
    workers: int,
    receive: Callable[[int, Any], None],
    lost: Callable[[int, str], Result] | None,
) -> Generator[tuple[int, Result], None, None]:
    # Not an executor of the standard library: those cannot be told to end their processes.
    context = multiprocessing.get_context("spawn")
    running: dict[Connection, _Running[Argument]] = {}
    free: list[tuple[Connection, Any]] = []
    try:
        while waiting.fill() or running:
            while len(running) < workers and waiting.fill():
                index, argument = waiting.pop()
                again = bool(free)
                if not free:
                    ours, theirs = context.Pipe()
                    process = context.Process(target=_serve, args=(theirs, function), daemon=True)
                    with termination.deaf_children():
                        process.start()
                        # Only the process holds the other end, so that its death shows as the end of the pipe.
                        theirs.close()
                        free.append((ours, process))
                connection, process = free.pop()
                running[connection] = _Running(index, argument, process, begun=not again)
                with contextlib.suppress(ConnectionError):  # one that has ended shows as the end of the pipe
                    connection.send(argument)
            for connection in wait(list(running)):
                assert isinstance(connection, Connection)
                job = running[connection]
                index, process = job.index, job.process
                try:
                    kind, value = connection.recv()
                except (EOFError, ConnectionError):
                    process.join(_PATIENCE)
                    why = _ended(process.exitcode)
                    if not job.begun or lost is not None:
                        del running[connection]
                        connection.close()
                    if not job.begun:  # it ended while it had nothing to do
                        waiting.put_back(index, job.argument)
                        continue
                    if lost is not None:
                        yield index, lost(index, f"its process {why}")
                        continue
                    raise RapidError(
                        f"The process of job {index + 1} of {waiting.total} {why}. What is done is kept: run the same "
                        "command again, perhaps with fewer workers."
                    ) from None
                job.begun = True
                if kind == "begun":
                    continue
                if kind == "report":
                    receive(index, value)
                    continue
                del running[connection]
                free.append((connection, process))  # the next job spares its start, which takes seconds
                yield index, _unpack(kind, value)
                # Asked now that the result was taken, which may be what others waited for.
                if not waiting.fill():
                    free.remove((connection, process))
                    connection.close()  # it ends, and what it has of the memory is others'
                    process.join(_PATIENCE)
    finally:
        for connection, job in running.items():
            job.process.terminate()
            connection.close()
        for connection, _ in free:
            connection.close()
        for process in (*(job.process for job in running.values()), *(process for _, process in free)):
            process.join(_PATIENCE)


def _ended(exit_code: int | None) -> str:
    """Return how a process ended without an answer."""
    if exit_code is not None and exit_code < 0:
        return f"was ended from outside (signal {-exit_code}); too little memory is the usual cause"
    return f"ended by itself (exit code {exit_code}); what it printed above says why"


def _serve(connection: Connection, function: Callable[[Any, Report], Any]) -> None:
    """Do one job after another in a process of its own.

    It ends when the parent closes the connection, or ends: that it notices when it next reports.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides

    def send(message: tuple[str, Any]) -> None:
        try:
            connection.send(message)
        except OSError:  # nobody listens any more
            raise SystemExit(1) from None

    with contextlib.suppress(EOFError, ConnectionError):  # nobody is there any more
        while True:
            argument = connection.recv()
            send(("begun", None))
            send(_attempt(rapid.__version__, function, argument, lambda value: send(("report", value))))


def _attempt(version: str, function: Callable[[Any, Report], Any], argument: Any, report: Report) -> tuple[str, Any]:
    """Do a job and return ("result", value) or why there is none: as ("refusal", message) or ("fault", traceback)."""
    if version != rapid.__version__:
        return "refusal", (
            f"This worker has version {rapid.__version__} of RAPID, the command {version}. Install the same version on "
            "every machine."
        )
    try:
        return "result", function(argument, report)
    except RapidError as error:
        return "refusal", str(error)
    except OSError as error:
        return "refusal", (
            f"The system refused a worker's work: {error}. Check the free space and the permissions. What is done is "
            "kept: run the same command again."
        )
    except MemoryError:
        return "refusal", "A worker has not enough memory. What is done is kept: run it again with fewer workers."
    except Exception:
        return "fault", traceback.format_exc()


def _unpack(kind: str, value: Any) -> Any:
    if kind == "refusal":
        raise RapidError(value)
    if kind == "fault":
        raise RuntimeError(f"A worker failed:\n{value}")
    return value


def _need_ray() -> Any:
    try:
        ray = importlib.import_module("ray")
        for part in ("ray.exceptions", "ray.util.queue", "ray.util.scheduling_strategies"):
            importlib.import_module(part)
    except ImportError as error:
        raise RapidError(
            "The engine 'ray' needs the package 'ray', which is not installed. Install it on every machine with: "
            f"{how_to_install('ray')}; or use --engine local."
        ) from error
    return ray


def _on_ray(
    function: Callable[[Argument, Report], Result],
    waiting: _Waiting[Argument],
    workers: int,
    receive: Callable[[int, Any], None],
    lost: Callable[[int, str], Result] | None,
) -> Generator[tuple[int, Result], None, None]:
    ray = _need_ray()
    started = not ray.is_initialized()
    if started:
        # A Ray of our own sends nothing home unless the user says so.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            ray.init(include_dashboard=False, log_to_driver=False, logging_level="error")
        except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
            raise RapidError(
                f"Ray cannot be reached or started: {error} Check RAY_ADDRESS and `ray status`, or use --engine local."
            ) from error
    # Named by their place in the list: what is kept of a task after it ended is no more than its result.
    running: dict[Any, int] = {}
    reports: Any = None
    try:
        # On this machine: a queue elsewhere would be lost with a machine that the jobs could do without.
        here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=False
        )
        reports = ray.util.queue.Queue(actor_options={"num_cpus": 0, "scheduling_strategy": here})
        attempt = ray.remote(num_cpus=1, max_retries=_RETRIES)(_attempt)
        while waiting.fill() or running:
            while len(running) < workers and waiting.fill():
                index, argument = waiting.pop()
                report = partial(_put, reports, index)
                running[attempt.remote(rapid.__version__, function, argument, report)] = index
            ended, _ = ray.wait(list(running), num_returns=1, timeout=_POLL)
            for index, report in reports.get_nowait_batch(reports.qsize()):
                receive(index, report)
            for task in ended:
                index = running.pop(task)
                try:
                    content = ray.get(task)
                except ray.exceptions.RayError as error:
                    if lost is None:
                        raise
                    yield index, lost(index, f"Ray lost it: {type(error).__name__}")
                    continue
                yield index, _unpack(*content)
    except ray.exceptions.RayError as error:
        last = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        raise RapidError(
            f"Ray lost a job: {type(error).__name__}: {last[0]} Every machine needs the same RAPID and enough memory. "
            "What is done is kept: run the same command again."
        ) from error
    finally:
        for task in running:
            ray.cancel(task, force=True)
        if reports is not None:
            reports.shutdown(force=True)
        if started:
            ray.shutdown()


def _put(reports: Any, index: int, report: Any) -> None:
    reports.put_nowait((index, report))
