"""What a collection has used: tokens and price of what was written down, and of what was paid for all the same."""

import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rapid.data.unwritten import UNWRITTEN_FILE, Cost, Unwritten
from rapid.teacher.decision import Decision, Teacher, Timed
from rapid.teacher.experience import Experience
from rapid.termination import StoppedError as TerminatedError


def cost_of(answers: Iterable[Decision | Experience]) -> Cost:
    """Return what decisions, and lessons from crashes, cost; an experience that nobody was asked about is none."""
    found = Cost()
    for answer in answers:
        counts = isinstance(answer, Decision) or answer.tokens_in > 0
        found += Cost(int(counts), answer.tokens_in + answer.tokens_out, answer.cost)
    return found


class Spending:
    """The sum, and what is asked for at the moment; of a teacher that waits for others it outlives a kill."""

    def __init__(self, work: Path, teacher: Teacher) -> None:
        self._teacher = teacher if isinstance(teacher, Timed) else None
        self._unwritten = Unwritten(work / UNWRITTEN_FILE) if self._teacher else None
        self._ready = False
        self.total = self._unwritten.lost + self._unwritten.greetings if self._unwritten else Cost()

    @property
    def tells(self) -> bool:
        """Whether anything was paid for that is written down nowhere else, or is asked for."""
        return self._unwritten is not None and self._unwritten.tells

    def add(self, spent: Cost) -> None:
        """Add what was written down."""
        self.total += spent

    def ask(self, count: int) -> None:
        """Keep on disk that so many decisions or lessons are asked for."""
        if self._unwritten:
            self._unwritten.ask(self._guess(count))

    def get_ready(self) -> None:
        """Let the teacher look whether whoever it asks answers, before anything is driven; that is paid for, too."""
        if self._teacher and not self._ready:
            with self.asked(1):
                self._teacher.get_ready()
            self._ready = True

    @contextmanager
    def asked(self, count: int, known: Sequence[Decision] = ()) -> Generator[None]:
        """Keep on disk that so many are asked for, and afterwards what was lost; `known` are made but not yet added."""
        if not self._unwritten or not self._teacher:
            yield
            return
        before, greeted = self._teacher.lost, len(self._teacher.greetings)
        self.ask(count)
        try:
            yield
        finally:
            # Told to end by a signal, it waits for nothing: that is as a kill.
            if not isinstance(sys.exception(), TerminatedError):
                greetings = cost_of(self._teacher.greetings[greeted:])
                self.total += greetings
                self._unwritten.settle(self._guess(self._teacher.lost - before, known), greetings)

    def forget(self, decisions: Iterable[Decision]) -> None:
        """Count decisions as lost that were made and are asked for again, those of them that took tokens."""
        spent = cost_of(decision for decision in decisions if decision.tokens_in)
        if self._unwritten and spent.decisions:
            self._unwritten.lose(spent)

    def record(self) -> dict[str, Any]:
        """Return what a dataset tells of what is in none of its rows."""
        return self._unwritten.record if self._unwritten else {}

    def _guess(self, count: int, more: Sequence[Decision] = ()) -> Cost:
        """Return what so many decisions or lessons cost, by the mean of those that were made, `more` among them."""
        of = self.total + cost_of(more)
        share = count / max(of.decisions, 1)
        return Cost(count, round(of.tokens * share), of.cost * share)
