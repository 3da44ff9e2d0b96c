"""How a model is asked: one conversation at a time, from threads, or many conversations at once, in lockstep."""

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

from rapid.errors import RapidError
from rapid.progress import format_seconds, warn
from rapid.teacher.logprobs import Token
from rapid.teacher.patience import Patience, StoppedError

Message = dict[str, Any]


class ChatError(Exception):
    """The server gave no answer, after all retries; `retries` says how many."""

    def __init__(self, message: str, retries: int = 0) -> None:
        super().__init__(message)
        self.retries = retries


@dataclass(frozen=True)
class ToolCall:
    """A call as the server reports it."""

    id: str
    name: str
    arguments: str


@dataclass(frozen=True)
class Reply:
    """One answer of a model."""

    text: str
    calls: tuple[ToolCall, ...] = ()
    tokens_in: int = 0
    tokens_out: int = 0
    retries: int = 0
    tokens: tuple[Token, ...] = ()
    """The tokens of `text` with their probabilities, where they were asked for and given."""
    reasoning: str = ""
    """What the model thought aloud, where the server tells it apart from `text`; never part of the answer."""
    finish_reason: str = ""
    """Why the answer ended, in the server's word: `stop`, `length` if it was cut off, or another."""
    model: str = ""
    """The model's own name, as a server tells it."""
    estimated: bool = False
    """Whether the numbers of tokens are guesses, because a server tells none that make sense."""


@dataclass(frozen=True)
class Request:
    """What a model is asked: to answer a conversation."""

    messages: Sequence[Message]
    tools: list[dict[str, Any]]
    schema: dict[str, Any] | None
    """The form that the answer should have."""
    logprobs: bool = False
    """Whether the probabilities of the answer's tokens are wanted."""


class Chat(Protocol):
    """A model that answers one conversation at a time, and several at once from threads."""

    @property
    def native_tools(self) -> bool:
        """Whether tools are passed beside the messages; if not, the plain-text protocol is used."""
        ...

    def ask(self, request: Request) -> Reply:
        """Answer; `schema` and `logprobs` are wishes: the caller checks the form, and does without probabilities.

        Raises:
            ChatError: no answer could be had this time.
            RapidError: none will ever be had: a wrong key, address or model.
        """
        ...


@runtime_checkable
class BatchChat(Protocol):
    """A model that answers many conversations together."""

    @property
    def native_tools(self) -> bool:
        """See :class:`Chat`."""
        ...

    def ask_together(self, requests: Sequence[Request]) -> list[Reply]:
        """Answer every request; see :meth:`Chat.ask`."""
        ...

    def end(self) -> None:
        """Forget the conversations: all are over."""
        ...


T = TypeVar("T")
Conversation = Generator[Request, Reply | ChatError, T]
"""Yields what it asks, is sent the answer or what went wrong, and returns what came of it."""

_LOOK = 0.2
"""Seconds between two looks whether there is something to say about the wait."""


def converse(conversations: Sequence[Conversation[T]], chat: Chat | BatchChat, concurrency: int) -> Iterator[T | None]:
    """Lead conversations to their ends: all together if the chat can, else `concurrency` at once, each in a thread.

    What came of them is given in their order, each as soon as it and those before it have ended; None stands for one
    that was broken off, because the time was over or the user interrupted. See :func:`attend`.
    """
    if isinstance(chat, BatchChat):
        try:
            yield from _in_lockstep(conversations, chat.ask_together)
        finally:
            chat.end()
        return

    def alone(conversation: Conversation[T]) -> T:
        [result] = _in_lockstep([conversation], lambda requests: [_answer(chat, request) for request in requests])
        return result

    yield from attend([partial(alone, conversation) for conversation in conversations], patience_of(chat), concurrency)


def patience_of(chat: Any) -> Patience:
    """Return how long a chat waits; one that asks no server has a patience that nothing tries."""
    patience = getattr(chat, "patience", None)
    return patience if isinstance(patience, Patience) else Patience()


def attend(jobs: Sequence[Callable[[], T]], patience: Patience, concurrency: int = 1) -> Iterator[T | None]:
    """Do jobs that wait for a server, `concurrency` at once, and give what came of each in their order, or None.

    A line says what is waited for if that takes long. The first KeyboardInterrupt lets the requests under way end and
    begins no others, the second lets them go; it is raised again when all that came has been given. So is the first
    error of a job, after which nothing is begun or waited for.
    """
    interrupted = False
    failed: RapidError | None = None
    pool = ThreadPoolExecutor(max(concurrency, 1))
    try:
        futures = [pool.submit(job) for job in jobs]
        for future in futures:
            while True:
                try:
                    wait([future], _LOOK)
                    if future.done():
                        break
                    if word := patience.word():
                        warn(word)
                except KeyboardInterrupt:
                    if interrupted:
                        patience.drop()
                        continue
                    interrupted = True
                    patience.stop()
                    count, seconds = patience.under_way()
                    if count:
                        warn(
                            f"Interrupted: {count} {'request' if count == 1 else 'requests'} under way to "
                            f"{patience.name} {'is' if count == 1 else 'are'} waited for, at most "
                            f"{format_seconds(seconds)}, as they are paid for. Ctrl-C again does not wait."
                        )
            try:
                result = future.result()
            except StoppedError:
                result = None
            except RapidError as error:
                failed, result = failed or error, None
                patience.drop()
            yield result
        if failed:
            raise failed
        if interrupted:
            raise KeyboardInterrupt
    finally:
        # On the way out by an error, nothing that is still under way matters any more.
        patience.drop()
        pool.shutdown(wait=True, cancel_futures=True)
        patience.renew()


def _in_lockstep(
    conversations: Sequence[Conversation[T]], answer: Callable[[Sequence[Request]], Sequence[Reply | ChatError]]
) -> Iterator[T]:
    """Lead conversations to their ends; all that wait for an answer are answered together."""
    results: dict[int, T] = {}
    given = 0
    answers: dict[int, Any] = dict.fromkeys(range(len(conversations)))
    while answers:
        waiting: dict[int, Request] = {}
        for number, said in answers.items():
            try:
                waiting[number] = conversations[number].send(said)
            except StopIteration as end:
                results[number] = end.value
        while given in results:
            yield results.pop(given)
            given += 1
        try:
            answers = dict(zip(waiting, answer(list(waiting.values())), strict=True)) if waiting else {}
        except RapidError as error:
            for number in waiting:
                with suppress(RapidError):  # it learns of it, in case that something was paid for it already
                    conversations[number].throw(error)
            raise


def _answer(chat: Chat, request: Request) -> Reply | ChatError:
    try:
        return chat.ask(request)
    except ChatError as error:
        return error
