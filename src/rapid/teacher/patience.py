"""How long a server is waited for: a deadline for each whole answer, and one end for all of them."""

import math
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager

from rapid.errors import RapidError

POLL = 0.1
"""Seconds after which a wait looks again whether it is still wanted."""
FIRST_WORD = 2.0
"""Seconds of silence after which a line says what is waited for."""
_SILENCES = (10.0, 30.0, 60.0)
"""Seconds to the next such lines, as long as nothing comes; the last one repeats."""


class StoppedError(RapidError):
    """No answer was waited for any longer: the time for all of them is over, or the user wants an end."""

    under_way = False
    """Whether a request was under way, and was let go."""


class Flight:
    """One request under way."""

    def __init__(self, patience: "Patience", seconds: float) -> None:
        self._patience, self.seconds = patience, seconds
        self.start = time.monotonic()
        self.deadline = self.start + seconds

    def remaining(self) -> float:
        """Return the seconds that are left, above 0.

        Raises:
            TimeoutError: none are left for this request.
            StoppedError: nothing is waited for any longer.
        """
        now = time.monotonic()
        if now >= self._patience.wait_until:
            raise StoppedError(self._patience.reason)
        if now >= self.deadline:
            raise TimeoutError(f"no whole answer within {self.seconds:g} s (--teacher.timeout-s)")
        return min(self.deadline, self._patience.wait_until) - now


class Patience:
    """What all requests to one server share. Safe to use from threads."""

    def __init__(self, name: str = "the model's server") -> None:
        self.name = name
        self.reason = "The time for this is over."
        self._limit = math.inf
        self._stopped = self._dropped = False
        self._lock = threading.Lock()
        self._flights: list[Flight] = []
        self._heard = time.monotonic()
        self._slowest = self._silence = 0.0
        self._words = 0
        self.lost = 0
        """Decisions that were broken off although something may have been paid for them."""

    @property
    def begin_until(self) -> float:
        """The moment (of :func:`time.monotonic`) from which on no request may begin."""
        return -math.inf if self._stopped else self._limit

    @property
    def wait_until(self) -> float:
        """The moment from which on none is waited for."""
        return -math.inf if self._dropped else self._limit

    def end_by(self, moment: float, reason: str) -> None:
        """Begin nothing after `moment` (of :func:`time.monotonic`), and wait for nothing beyond it."""
        self._limit, self.reason = moment, reason

    def stop(self) -> None:
        """Begin no request any more; those under way may end."""
        self._stopped = True

    def drop(self) -> None:
        """Begin nothing and wait for nothing any more."""
        self._stopped = self._dropped = True

    def renew(self) -> None:
        """Forget :meth:`stop` and :meth:`drop`; a limit in time stays."""
        self._stopped = self._dropped = False

    def lose(self) -> None:
        """Count a decision that is broken off although something may have been paid for it."""
        with self._lock:
            self.lost += 1

    def check(self) -> None:
        """Raise StoppedError if no request may begin any more."""
        if time.monotonic() >= self.begin_until:
            raise StoppedError(self.reason)

    def sleep(self, seconds: float) -> None:
        """Wait before a request; raises StoppedError as soon as none may begin any more."""
        until = time.monotonic() + seconds
        self.check()
        while (left := until - time.monotonic()) > 0:
            time.sleep(min(left, POLL))
            self.check()

    @contextmanager
    def flight(self, seconds: float, paid: bool = True) -> Generator[Flight, None, None]:
        """Count a request that may take so many seconds as under way while the block runs; `paid`, if it costs."""
        self.check()
        flight = Flight(self, seconds)
        with self._lock:
            if not self._flights:
                self._heard = flight.start
            self._flights.append(flight)
        try:
            yield flight
            with self._lock:
                self._slowest = max(self._slowest, time.monotonic() - flight.start)
        except StoppedError as stopped:
            stopped.under_way = True
            if paid:
                self.lose()
            raise
        finally:
            with self._lock:
                self._flights.remove(flight)
                self._heard, self._silence, self._words = time.monotonic(), 0.0, 0

    def under_way(self) -> tuple[int, float]:
        """Return how many requests are under way, and in how many seconds the last of them is over."""
        with self._lock:
            ends = [min(flight.deadline, self.wait_until) for flight in self._flights]
        return len(ends), max(max(ends, default=0.0) - time.monotonic(), 0.0)

    def word(self) -> str:
        """Return a line on what is waited for, if nothing was heard for longer than usual, else nothing.

        It comes after two seconds, or three times as long as the slowest answer took; then ever more rarely.
        """
        now = time.monotonic()
        with self._lock:
            due = self._heard + max(FIRST_WORD, 3 * self._slowest) + self._silence
            if not self._flights or now < due:
                return ""
            self._silence += _SILENCES[min(self._words, len(_SILENCES) - 1)]
            self._words += 1
            oldest = min(self._flights, key=lambda flight: flight.start)
            count = len(self._flights)
        return (
            f"Waiting for {self.name}: {count} {'request' if count == 1 else 'requests'} under way, the oldest for "
            f"{now - oldest.start:.0f} s of at most {oldest.seconds:g} s."
        )
