"""How a model is asked: one conversation at a time, from threads, or many conversations at once, in lockstep."""

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from rapid.teacher.logprobs import Token

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


def converse(conversations: Sequence[Conversation[T]], chat: Chat | BatchChat, concurrency: int) -> Iterator[T]:
    """Lead conversations to their ends: all together if the chat can, else `concurrency` at once, each in a thread.

    What came of them is given in their order, each as soon as it and those before it have ended.
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

    with ThreadPoolExecutor(max(concurrency, 1)) as pool:
        yield from pool.map(alone, conversations)


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
        answers = dict(zip(waiting, answer(list(waiting.values())), strict=True)) if waiting else {}


def _answer(chat: Chat, request: Request) -> Reply | ChatError:
    try:
        return chat.ask(request)
    except ChatError as error:
        return error
