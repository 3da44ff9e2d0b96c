"""The running account of one conversation with a model, and one turn of it."""

from dataclasses import dataclass, field
from typing import Any

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher.chat import ChatError, Conversation, Message, Reply, Request
from rapid.teacher.logprobs import Token
from rapid.teacher.patience import Patience, StoppedError
from rapid.teacher.prompt import Prompt


@dataclass
class Talk:
    """The running account of one conversation."""

    messages: list[Message]
    tokens_in: int = 0
    tokens_out: int = 0
    retries: int = 0
    answer: str = ""
    tokens: tuple[Token, ...] = ()
    served: str = ""
    turns: int = 0
    """Answers that came."""
    faults: list[str] = field(default_factory=list[str])

    def note(self, reply: Reply) -> None:
        """Add what an answer says and took."""
        self.tokens_in += reply.tokens_in
        self.tokens_out += reply.tokens_out
        self.retries += reply.retries
        self.answer, self.tokens, self.served = reply.text, reply.tokens, reply.model
        self.turns += 1

    def cost(self, config: TeacherConfig) -> float:
        """Return its price so far, in the currency of the settings."""
        return (self.tokens_in * config.price_in + self.tokens_out * config.price_out) / 1e6

    def break_off(self, error: RapidError, patience: Patience) -> None:
        """Count a conversation that ends between two turns; a request under way has been counted."""
        if self.turns and not (isinstance(error, StoppedError) and error.under_way):
            patience.lose()


def opening(prompt: Prompt) -> list[Message]:
    """Return the messages that a conversation begins with."""
    return [{"role": "system", "content": prompt.system}, {"role": "user", "content": prompt.user}]


def ask(
    talk: Talk, tools: list[dict[str, Any]], schema: dict[str, Any] | None, logprobs: bool = False
) -> Conversation[Reply]:
    """Ask for the next turn, note the answer and return it.

    Raises:
        ChatError: none came.
    """
    reply = yield Request(talk.messages, tools, schema, logprobs)
    if isinstance(reply, ChatError):
        raise reply
    talk.note(reply)
    message: Message = {"role": "assistant", "content": reply.text}
    if reply.calls:
        message["tool_calls"] = [
            {"id": call.id, "type": "function", "function": {"name": call.name, "arguments": call.arguments}}
            for call in reply.calls
        ]
    talk.messages.append(message)
    return reply


def was_cut(reply: Reply) -> bool:
    """Whether the answer ended at the limit of its tokens."""
    return reply.finish_reason == "length"
