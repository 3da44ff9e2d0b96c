"""Being told to end: by Ctrl-C (SIGINT) at once, by SIGTERM, as batch systems send it, after a last checkpoint.

Within :func:`noticed` a training that is told by SIGTERM finishes the row of metrics that it is at, writes a checkpoint
and stops; everything else stops at once, as what it did is on the disk already.
"""

import _thread
import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import Any

EXIT_CODE = 128 + signal.SIGTERM
_asked, _interrupted = threading.Event(), threading.Event()
_waits = False
"""Whether somebody will look at `requested` soon."""


class StoppedError(BaseException):
    """The process was told to end, and what is under way is on the disk; the message says where.

    Like KeyboardInterrupt it is no error that anybody between should mend.
    """


@contextmanager
def noticed() -> Generator[None, None, None]:
    """While the block runs, end in order: SIGTERM raises :class:`StoppedError`, or waits for :func:`requested`.

    Does nothing but in the main thread, where Python handles signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _asked.clear()
    _interrupted.clear()
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    unraisable = sys.unraisablehook
    signal.signal(signal.SIGTERM, _notice)
    if before[signal.SIGINT] is signal.default_int_handler:  # else somebody wants it otherwise, or it is ignored
        signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _hide_interrupts
    try:
        yield
    finally:
        sys.unraisablehook = unraisable
        for number, handler in before.items():
            signal.signal(number, handler)
        _asked.clear()


@contextmanager
def waiting() -> Generator[None, None, None]:
    """Within the block :func:`requested` is looked at every few seconds: SIGTERM waits for that."""
    global _waits
    before, _waits = _waits, True
    try:
        yield
    finally:
        _waits = before
    if _asked.is_set():
        raise StoppedError("what is done is kept")


def requested() -> bool:
    """Whether the process was told to end by SIGTERM."""
    return _asked.is_set()


def interrupted() -> bool:
    """Whether Ctrl-C was pressed since this was last asked: C code may turn a KeyboardInterrupt into another error."""
    pressed = _interrupted.is_set()
    _interrupted.clear()
    return pressed


def quietly() -> None:
    """End without a word if Ctrl-C is pressed once more, while Python itself is ending."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def deaf_children() -> Generator[None, None, None]:
    """Processes that are started within the block hear no Ctrl-C, from their first moment on: the parent decides.

    The terminal sends it to the whole group, and a child that is still importing would answer with a traceback. The
    parent itself hears it at the end of the block, so that no child is started that nobody knows of.
    """
    if not hasattr(signal, "pthread_sigmask") or threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        signal.signal(signal.SIGINT, handler)
    if pressed:
        signal.raise_signal(signal.SIGINT)


def check() -> None:
    """Raise once more an interrupt that somebody has swallowed: much code catches whatever is raised in an import."""
    if _interrupted.is_set() and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt


def _notice(number: int, frame: FrameType | None) -> None:
    # The second time nothing is waited for.
    second = _asked.is_set()
    _asked.set()
    if second or not _waits:
        raise StoppedError("what is done is kept")


def _interrupt(number: int, frame: FrameType | None) -> None:
    _interrupted.set()
    raise KeyboardInterrupt


def _hide_interrupts(unraisable: Any) -> None:
    """Python prints what is raised where nobody can catch it, in a destructor for instance; no interrupt is shown."""
    if not isinstance(unraisable.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    # It was lost there: it comes again a moment later, when this hook is over.
    _interrupted.set()
    again = threading.Timer(0.05, _thread.interrupt_main)
    again.daemon = True
    again.start()
