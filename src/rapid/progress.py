"""Progress with an estimate of the time left: a live bar in a terminal, a plain line every few seconds elsewhere."""

import io
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rapid import termination
from rapid.text import printable

SECONDS_BETWEEN_LINES = 5.0
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)


@contextmanager
def quiet() -> Generator[None, None, None]:
    """Show nothing of the pieces of work in this block: somebody else tells how far the whole is."""
    token = _QUIET.set(True)
    try:
        yield
    finally:
        _QUIET.reset(token)


class Task:
    """One piece of work of `total` units; :meth:`advance` counts, :meth:`note` sets the text shown beside it."""

    def __init__(self, title: str, total: float, unit: str, stream: TextIO, bar: Progress | None) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.done = 0.0
        self._note = ""
        self._stream, self._bar = stream, bar
        self._bar_id = bar.add_task(title, total=total, note="") if bar else None
        self._start = self._last_line = time.monotonic()
        self._skipped = 0.0

    def skip(self, amount: float) -> None:
        """Count units that an earlier run did; they do not enter the estimate of the time left."""
        self._skipped += amount
        self.advance(amount)
        if self._bar is not None and self._bar_id is not None:
            # A bar that is started anew forgets how fast it came here.
            self._bar.reset(self._bar_id, completed=int(self.done))

    def advance(self, amount: float = 1) -> None:
        """Count `amount` more units as done. Whole episodes may be a few more than were asked for."""
        termination.check()
        self.done += amount
        self.total = max(self.total, self.done)
        if self._bar is not None and self._bar_id is not None:
            self._bar.update(self._bar_id, completed=self.done, total=self.total)
        elif time.monotonic() - self._last_line >= SECONDS_BETWEEN_LINES:
            self._print_line()

    def note(self, text: str) -> None:
        """Show `text` beside the count: a score, a rate, a cost."""
        self._note = text
        if self._bar is not None and self._bar_id is not None:
            self._bar.update(self._bar_id, note=text)

    def finish(self) -> None:
        """Print the closing line."""
        seconds = time.monotonic() - self._start
        note = f"  {self._note}" if self._note else ""
        line = f"{self.title}: {_shown(self.done)} {self.unit} in {format_seconds(seconds)}{note}"
        print(line, file=self._stream, flush=True)

    def _print_line(self) -> None:
        now = time.monotonic()
        self._last_line = now
        fresh = self.done - self._skipped
        left = (now - self._start) / fresh * (self.total - self.done) if fresh > 0 else None
        eta = f"ETA {format_seconds(left)}" if left is not None else "ETA unknown"
        note = f"  {self._note}" if self._note else ""
        count = f"{_shown(self.done)}/{_shown(self.total)} {self.unit}"
        print(f"{self.title}: {count}  {eta}{note}", file=self._stream, flush=True)


@contextmanager
def task(title: str, total: float, unit: str, stream: TextIO | None = None) -> Generator[Task, None, None]:
    """Show the progress of one piece of work while the block runs; the closing line is printed if it succeeds."""
    out: TextIO = io.StringIO() if _QUIET.get() else stream or sys.stderr
    if not out.isatty():
        work = Task(title, total, unit, out, None)
        yield work
    else:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
        )
        with Progress(*columns, console=Console(file=out), transient=True) as bar:
            work = Task(title, total, unit, out, bar)
            yield work
    work.finish()


def warn(text: str) -> None:
    """Say on standard error what went otherwise than a user would expect, and is dealt with.

    It is one line, and control characters in it are shown, not obeyed.
    """
    line = printable(text).replace("\n", " ")
    print(f"rapid: {line}", file=sys.stderr, flush=True)


def _shown(amount: float) -> str:
    """Return a count in full, a million steps as 1000000, and parts of megabytes to a tenth."""
    return f"{round(amount, 1):.15g}"


def format_seconds(seconds: float) -> str:
    """Return a duration as people write it: ``8 s``, ``3 min 5 s``, ``2 h 4 min``."""
    whole = round(max(seconds, 0))
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
