"""More cores: the worlds lie in memory that several processes share, and each process steps a part of them.

Worlds do not know of each other, so how they are divided changes nothing in what they do. The memory has no name in the
file system: whatever way the processes end, nothing is left behind.
"""

import multiprocessing
import signal
import traceback
import weakref
from contextlib import suppress
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from rapid import termination
from rapid.errors import RapidError
from rapid.simulator import startup
from rapid.simulator.settings import Settings
from rapid.simulator.state import State, allocate
from rapid.simulator.step import Outputs, allocate_outputs, step_worlds

startup.load_numba()

_STEP, _STOP, _READY = b"step", b"stop", b"ready"
_ALIGNMENT = 64
_PATIENCE = 2.0
"""Seconds that a process has to end by itself."""


def shared_memory_layout(worlds: int, settings: Settings) -> tuple[list[tuple[tuple[int, ...], Any, int]], int]:
    """Return shape, type and offset of each shared array (state, outputs, actions) and the bytes in all."""
    # One world tells the shapes; the memory of the others need not be allocated to know them.
    parts = [*allocate(1, settings), *allocate_outputs(1, settings), np.zeros(1, np.int64)]
    entries: list[tuple[tuple[int, ...], Any, int]] = []
    end = 0
    for part in parts:
        entries.append(((worlds, *part.shape[1:]), part.dtype, end))
        end += -(-part.nbytes * worlds // _ALIGNMENT) * _ALIGNMENT
    return entries, end


def _arrays(memory: Any, worlds: int, settings: Settings) -> tuple[State, Outputs, NDArray[np.int64]]:
    entries, _ = shared_memory_layout(worlds, settings)
    found: list[Any] = []
    for shape, dtype, offset in entries:
        count = int(np.prod(shape))
        found.append(np.frombuffer(memory, dtype, count, offset).reshape(shape))
    states, outputs = len(State._fields), len(Outputs._fields)
    return State(*found[:states]), Outputs(*found[states : states + outputs]), found[-1]


def _part(arrays: Any, first: int, end: int) -> Any:
    return type(arrays)(*(array[first:end] for array in arrays))


def _work(
    connection: Connection, memory: Any, worlds: int, settings: Settings, mode: int, part: tuple[int, int]
) -> None:
    """Step worlds `part` each time the parent says so, until it closes its end or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    state, out, actions = _arrays(memory, worlds, settings)
    state, out, actions = _part(state, *part), _part(out, *part), actions[part[0] : part[1]]
    with suppress(EOFError, OSError):
        connection.send_bytes(_READY)
        while connection.recv_bytes() == _STEP:
            try:
                step_worlds(state, actions, settings, mode, out)
            except Exception:
                connection.send_bytes(traceback.format_exc().encode())
            else:
                connection.send_bytes(_READY)


class WorldPool:
    """Memory for B worlds that several processes share; the calling process is one of them.

    Args:
        worlds: B.
        settings: the configuration.
        mode: what a step does with ended worlds, see :mod:`rapid.simulator.step`.
        processes: among how many processes the worlds are divided; at most one per world is used.

    Raises:
        RapidError: a process could not be started.
    """

    def __init__(self, worlds: int, settings: Settings, mode: int, processes: int) -> None:
        self._settings, self._mode = settings, mode
        processes = min(processes, worlds)
        bounds = [worlds * k // processes for k in range(processes + 1)]
        parts = list(pairwise(bounds))
        context = multiprocessing.get_context("spawn")  # forking a process that has threads, such as torch's, can hang
        memory = context.RawArray("b", shared_memory_layout(worlds, settings)[1])
        self.state, self._out, self._actions = _arrays(memory, worlds, settings)
        self._own = parts[0]
        self._workers: list[Any] = []
        self._connections: list[Connection] = []
        self._why_closed = "This environment is closed. Make another one."
        self._finalizer = weakref.finalize(self, _shut, self._workers, self._connections)
        try:
            for part in parts[1:]:
                ours, theirs = context.Pipe()
                self._connections.append(ours)
                arguments = (theirs, memory, worlds, settings, mode, part)
                worker = context.Process(target=_work, args=arguments, daemon=True, name="rapid-worlds")
                with termination.deaf_children():
                    worker.start()
                    self._workers.append(worker)
                theirs.close()
            for place in range(len(self._workers)):
                self._answer(place, starting=True)
        except RuntimeError as error:  # what multiprocessing says where a process may not start another
            self.close()
            raise RapidError(f"Processes cannot be started: {error}") from error
        except BaseException:
            self.close()
            raise

    def step(self, actions: NDArray[np.int64]) -> Outputs:
        """Step every world once, as :func:`~rapid.simulator.step.step_worlds` does, and return copies of the results.

        Raises:
            RapidError: a process died or failed, or the pool is closed.
        """
        if not self._finalizer.alive:
            raise RapidError(self._why_closed)
        self._actions[:] = actions
        try:
            for place, connection in enumerate(self._connections):
                try:
                    connection.send_bytes(_STEP)
                except OSError:
                    self._fail(place)
            own = _part(self.state, *self._own)
            step_worlds(own, self._actions[slice(*self._own)], self._settings, self._mode, _part(self._out, *self._own))
            for place in range(len(self._connections)):
                self._answer(place)
        except RapidError as error:
            self._why_closed = f"This environment failed earlier. {error}"
            self.close()
            raise
        except BaseException:  # such as Ctrl-C: some worlds were stepped and others not
            self._why_closed = "A step of this environment was interrupted half-way. Make another environment."
            self.close()
            raise
        return Outputs(*(cast(Any, array).copy() for array in self._out))

    def close(self) -> None:
        """End the processes; also happens when this object is forgotten and when Python exits."""
        self._finalizer()

    def _answer(self, place: int, starting: bool = False) -> None:
        try:
            answer = self._connections[place].recv_bytes()
        except (EOFError, OSError):
            self._fail(place, starting)
        if answer != _READY:
            raise RapidError(f"A process of the simulator failed:\n{answer.decode()}")

    def _fail(self, place: int, starting: bool = False) -> NoReturn:
        worker = self._workers[place]
        worker.join(_PATIENCE)
        code = worker.exitcode
        how = "ended" if code is None else f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        if starting:
            raise RapidError(
                f"A process of the simulator {how} while starting. A script that asks for several processes must begin "
                "its work below `if __name__ == '__main__':`, because each process imports the script. Otherwise use "
                "processes=1, or threads=1 where a training asked for them."
            )
        raise RapidError(
            f"A process of the simulator {how}, so some worlds are lost. Make the environment anew; if memory ran out, "
            "with fewer worlds or processes."
        )


def _shut(workers: list[Any], connections: list[Connection]) -> None:
    """End the processes: they go when told so or when the connection closes, and are killed where they do not."""
    for connection in connections:
        with suppress(OSError):
            connection.send_bytes(_STOP)
        connection.close()
    for worker in cast("list[multiprocessing.Process]", workers):
        with suppress(AssertionError):  # in a fork of this process, the workers are not its children
            worker.join(_PATIENCE)
            if worker.is_alive():
                worker.kill()
                worker.join()
    workers.clear()
    connections.clear()
