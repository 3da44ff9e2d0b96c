"""Any OpenAI-compatible server: hosted models, vLLM, Ollama, llama-server.

The key is read from the environment when the client is made and appears nowhere else; it is cut out of everything
that a server says, because servers echo it. What a server does not take is found out by its refusal, given up step by
step (:mod:`rapid.teacher.dialect`), and told once.
"""

import dataclasses
import json
import random
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.progress import format_seconds, warn
from rapid.teacher.address import open_access
from rapid.teacher.chat import ChatError, Reply, Request
from rapid.teacher.completion import (
    FormError,
    Refusal,
    decode,
    find_refusal,
    read_names,
    read_refusal,
    read_reply,
)
from rapid.teacher.dialect import Dialect, Step, differences, features, steps, without_probabilities, write
from rapid.teacher.faults import LONGEST_WAIT, FormRefusedError, PassingError, fault_of, key_error
from rapid.teacher.patience import FIRST_WORD, Patience, StoppedError
from rapid.teacher.secrets import Secrets
from rapid.teacher.wire import WireError, exchange

T = TypeVar("T")

LOADING_WAIT = 600.0
"""Seconds that a server may take to load its model."""
_LOADING_LOOK = 1.0
"""Seconds between two looks whether it has."""
_BETWEEN_LINES = 10.0
"""Seconds between two lines on a pause."""


class Endpoint:
    """A chat model behind an address; implements :class:`rapid.teacher.chat.Chat`. Safe to use from threads.

    Args:
        config: address, model, variables of key and headers, time limit, retries and rate.
        first_wait: seconds before the first retry; each later wait is twice as long.

    Raises:
        RapidError: the address is none or holds a secret, or a variable that it needs is not set. No request is made.
    """

    def __init__(self, config: TeacherConfig, first_wait: float = 1.0) -> None:
        self._config, self._first_wait = config, first_wait
        access = open_access(config)
        self._address, self._headers = access.address, dict(access.headers)
        self._clean = Secrets(access.secrets).clean
        self.patience = Patience(config.base_url)
        # A token with the probabilities of twenty others takes some two thousand characters.
        self._most_bytes = max(2 << 20, config.max_answer_tokens << 12)
        self._dialect = Dialect(tools=config.tool_calling != "text")
        self._proven: set[frozenset[str]] = set()
        self._told: set[str] = set()
        self._lock, self._adapting = threading.Lock(), threading.Lock()
        self._next_slot = self._next_line = 0.0
        self._end: RapidError | None = None

    def __repr__(self) -> str:
        """Name the address and the model, never the key."""
        return f"Endpoint({self._config.base_url!r}, {self._config.model!r})"

    @property
    def native_tools(self) -> bool:
        """Whether tools are passed beside the messages."""
        return self._dialect.tools

    def models(self) -> tuple[str, ...]:
        """Return the names of the models that the server lists, none if it has no list; it may load its model first.

        Raises:
            ChatError: it gave no answer.
            RapidError: it refuses the key, or its address.
        """

        def once() -> tuple[str, ...]:
            try:
                return read_names(self._exchange("GET", "models", b""), self._clean)
            except (FormRefusedError, FormError):
                return ()

        return self._tried(once, [0])

    def greet(self) -> None:
        """Look whether the server is there and has the model, before anything is driven.

        Raises:
            RapidError: it gives no answer, or refuses the key.
        """
        try:
            names = self.models()
        except ChatError as error:
            raise RapidError(
                f"The model's server {self._config.base_url} gives no answer: {error}. Nothing was driven. Is it "
                "running, and is --teacher.base-url its address?"
            ) from None
        if names and self._config.model not in names:
            some = ", ".join(names[:5])
            self._tell(f"It lists no model '{self._config.model}' (but: {some}); it is asked for it all the same.")

    def ask(self, request: Request) -> Reply:
        """Answer a conversation, with bounded retries; see :class:`rapid.teacher.chat.Chat`."""
        dialect, retries = self._dialect, [0]
        try:
            try:
                return self._ask(request, dialect, retries)
            except FormRefusedError as refused:
                # One thread finds out what it is; those that wait here may find it known already.
                with self._adapting:
                    return self._adapt(request, dialect, refused, retries)
        except StoppedError:
            raise
        except RapidError as error:
            # No further request would change it, and none is made.
            self._end = self._end or error
            raise

    def _ask(self, request: Request, dialect: Dialect, retries: list[int]) -> Reply:
        """Ask in one dialect, and count the retries."""
        if self._end is not None:
            raise self._end
        most = self._config.max_answer_tokens
        body = json.dumps(write(dialect, request, self._config.model, most)).encode()
        offered = bool(request.tools and dialect.tools)

        def once() -> Reply:
            return read_reply(self._exchange("POST", "chat/completions", body), len(body), most, offered, self._clean)

        used = features(dialect, request)
        reply = self._tried(once, retries, lambda words: self._names_a_step(words, request, dialect), used)
        with self._lock:
            self._proven.add(used)
        if reply.estimated:
            self._tell("It tells no sensible numbers of tokens: they are estimated, at 4 characters each.")
        if reply.model and reply.model != self._config.model:
            self._tell(f"The model that answers calls itself '{reply.model}'.")
        # Probabilities that nobody asked for are of a decision that was made before, in the turns.
        return dataclasses.replace(reply, retries=retries[0], tokens=reply.tokens if request.logprobs else ())

    def _names_a_step(self, words: str, request: Request, dialect: Dialect) -> bool:
        return any(step.is_meant(words) for step in steps(dialect, request, self._config.tool_calling == "auto"))

    def _adapt(self, request: Request, before: Dialect, refused: FormRefusedError, retries: list[int]) -> Reply:
        """Find a dialect in which the server takes a request, giving up what it names, or else one thing after another.

        What turns out to have been no hindrance is taken up again. What was accepted before is given up for this
        request alone, and only if the server names it: some distribute requests over others of several kinds.
        """
        if self._dialect != before:
            try:
                return self._ask(request, self._dialect, retries)
            except FormRefusedError as error:
                refused = error
        base = dialect = self._dialect
        known = features(base, request) in self._proven
        first, given_up = refused, dict[tuple[str, ...], Step]()
        reply: Reply | None = None
        while reply is None:
            possible = list(steps(dialect, request, self._config.tool_calling == "auto"))
            named = [step for step in possible if step.is_meant(refused.words)]
            if refused.refusal.status == 403:
                # What may be forbidden apart from everything else are probabilities.
                possible = [silent] if (silent := without_probabilities(dialect, request)) else []
            elif refused.refusal.status == 500:
                possible = [step for step in possible if step.simpler.system < dialect.system]
            step = next(iter(named or ([] if known else possible)), None)
            if step is None:
                raise self._final(first, retries[0])
            given_up[differences(dialect, step.simpler)] = step
            dialect = step.simpler
            try:
                reply = self._ask(request, dialect, retries)
            except FormRefusedError as error:
                refused = error
        for fields in list(given_up)[:-1]:
            again = dataclasses.replace(dialect, **{name: getattr(base, name) for name in fields})
            try:
                reply = self._ask(request, again, retries)
            except FormRefusedError:
                continue
            dialect = again
            del given_up[fields]
        if not known:
            with self._lock:
                self._dialect = dialect
            gone = "; ".join(step.told for step in given_up.values())
            self._tell(f"It refused a request ({first}). From now on: {gone}.")
        return reply

    def _final(self, refused: FormRefusedError, retries: int) -> Exception:
        """Return the error for a request that the server takes in no form."""
        if refused.refusal.status == 403:
            return key_error(refused.refusal, self._config)
        what = "" if refused.refusal.status >= 500 else "the request was refused: "
        return ChatError(f"{what}{refused}", retries)

    def _exchange(self, method: str, name: str, body: bytes) -> Mapping[str, Any]:
        """Make one request and return the object that came."""
        self._wait_for_slot()
        with self.patience.flight(self._config.timeout_s, paid=method == "POST") as flight:
            try:
                response = exchange(method, self._address, name, self._headers, body, flight, self._most_bytes)
            except WireError as error:
                said = self._clean(str(error))
                raise (ChatError(said) if error.lasting else PassingError(said)) from None
        if response.status == 200:
            answer = decode(response.body, response.headers.get("content-type", ""), self._clean)
            refusal = find_refusal(answer, response.headers, self._clean)
            if refusal is None:
                return answer
        else:
            refusal = read_refusal(response.status, response.headers, response.body, self._clean)
        location = self._clean(response.headers.get("location", ""))
        raise fault_of(refusal, method, location, self._config, self._address)

    def _tried(
        self,
        action: Callable[[], T],
        retries: list[int],
        named: Callable[[str], bool] = lambda words: False,
        used: frozenset[str] = frozenset(),
    ) -> T:
        """Do something until it succeeds; wait in between, and for a model that is still loaded."""
        loaded_by = 0.0
        while True:
            try:
                return action()
            except ChatError as error:
                raise ChatError(str(error), retries[0]) from None
            except (PassingError, FormError) as error:
                refusal = error.refusal if isinstance(error, PassingError) else None
                # Some call it an error of their own that they cannot write a conversation down for their model.
                strange = refusal if refusal is not None and refusal.status == 500 else None
                if strange and named(strange.said):
                    raise FormRefusedError(strange) from None
                if isinstance(error, PassingError) and error.loading:
                    loaded_by = loaded_by or time.monotonic() + LOADING_WAIT
                    if time.monotonic() < loaded_by:
                        self._tell(f"It is still loading its model; that may take {format_seconds(LOADING_WAIT)}.")
                        self.patience.sleep(_LOADING_LOOK)
                        continue
                lasting = isinstance(error, FormError) and error.lasting
                if lasting or retries[0] >= self._config.max_retries:
                    if strange and used and used not in self._proven:
                        raise FormRefusedError(strange) from None
                    raise ChatError(str(error), retries[0]) from None
                pause = self._pause(refusal, retries[0])
                if pause >= FIRST_WORD:
                    self._tell_of_pause(
                        f"{self._config.base_url}: {error}; the next try is in {format_seconds(pause)}."
                    )
                self.patience.sleep(pause)
                retries[0] += 1

    def _wait_for_slot(self) -> None:
        """Space requests evenly under the rate limit."""
        if self._config.requests_per_minute <= 0:
            return
        with self._lock:
            now = time.monotonic()
            slot = max(self._next_slot, now)
            self._next_slot = slot + 60.0 / self._config.requests_per_minute
        self.patience.sleep(slot - now)

    def _pause(self, refusal: Refusal | None, retries: int) -> float:
        """Return the seconds to wait: what the server asks for, else exponential with jitter."""
        if refusal is not None and refusal.after is not None:
            return min(refusal.after, LONGEST_WAIT)
        return min(self._first_wait * 2.0 ** min(retries, 20) * random.uniform(0.5, 1.0), LONGEST_WAIT)

    def _tell(self, sentence: str) -> None:
        """Say something about the server, once."""
        with self._lock:
            if sentence in self._told:
                return
            self._told.add(sentence)
        warn(f"{self._config.base_url}: {sentence}")

    def _tell_of_pause(self, sentence: str) -> None:
        with self._lock:
            now = time.monotonic()
            if now < self._next_line:
                return
            self._next_line = now + _BETWEEN_LINES
        warn(sentence)
