"""What a server takes: the fields and the turns of a request, given up one by one as it refuses them."""

import dataclasses
import itertools
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rapid.teacher.chat import Message, Request
from rapid.teacher.logprobs import TOP

_FEWER = {TOP: 5, 5: 1, 1: 0}
"""Alternatives to ask for after so many were refused."""
_LIMITS = {"max_tokens": "max_completion_tokens", "max_completion_tokens": ""}
"""The names of the field that bounds an answer, the usual one first; nothing is no bound."""


@dataclass(frozen=True)
class Dialect:
    """How requests are written for one server; the first is what most of them take."""

    limit: str = "max_tokens"
    """The field that bounds the answer's length."""
    temperature: bool = True
    """Whether the temperature is set."""
    top: int = TOP
    """Alternatives asked for at each token; 0 is none, and no probabilities."""
    schema: bool = True
    """Whether the form of the answer is prescribed."""
    tools: bool = True
    """Whether tools are passed beside the messages."""
    tool_turns: bool = True
    """Whether calls and their results are turns of their own; else they are told as text."""
    system: bool = True
    """Whether there is a turn of the system; else its text opens the user's first turn."""
    runs: bool = True
    """Whether turns of one role may follow one another, and a user's turn a tool's; else they are joined."""


@dataclass(frozen=True)
class Step:
    """One thing to give up."""

    simpler: Dialect
    pattern: str
    """What a server's words on it hold, whatever their case."""
    told: str
    """What the user is told."""

    def is_meant(self, words: str) -> bool:
        """Say whether a server's words name it."""
        return re.search(self.pattern, words, re.IGNORECASE) is not None


def steps(dialect: Dialect, request: Request, may_lose_tools: bool) -> Iterator[Step]:
    """Give what can be given up of a request, the most dispensable first."""

    def without(**changes: Any) -> Dialect:
        return dataclasses.replace(dialect, **changes)

    if request.logprobs and dialect.top:
        fewer = _FEWER[dialect.top]
        told = f"only the {fewer} likeliest tokens are asked for" if fewer else "there are no soft labels"
        yield Step(without(top=fewer), r"log.?prob", told)
    if request.schema and dialect.schema:
        yield Step(
            without(schema=False),
            r"response.?format|schema|grammar|structured|json.?object",
            "the form of the answer is asked for in words",
        )
    if dialect.temperature:
        yield Step(without(temperature=False), r"temperature|sampl", "its own temperature is used")
    if dialect.limit:
        name = _LIMITS[dialect.limit]
        told = f"'{name}' bounds the answer" if name else "the length of an answer is not bounded"
        yield Step(without(limit=name), r"max.?(completion.?|new.?|output.?)?tokens", told)
    roles = [message["role"] for message in request.messages]
    if "system" in roles and dialect.system:
        told = "the rules are told in the user's first turn"
        yield Step(without(system=False), r"\bsystem|developer|template|jinja", told)
    if dialect.runs and any(
        later == before or (before, later) == ("tool", "user")
        for before, later in itertools.pairwise(roles)
        if later != "tool"
    ):
        told = "turns of one role are joined"
        yield Step(without(runs=False), r"alternat|\broles?\b|\bturns?\b|\buser\b|template|jinja|conversation", told)
    if "tool" in roles and dialect.tool_turns and (may_lose_tools or not request.tools):
        told = "calls and results are told as text"
        yield Step(without(tool_turns=False), r"tool|function|\broles?\b|template|jinja", told)
    if request.tools and dialect.tools and may_lose_tools:
        told = "the tools are explained in words"
        yield Step(without(tools=False, tool_turns=False), r"tool|function|template|jinja", told)


def without_probabilities(dialect: Dialect, request: Request) -> Step | None:
    """Return the step that gives all probabilities up at once, if any are asked for."""
    if not request.logprobs or not dialect.top:
        return None
    return Step(dataclasses.replace(dialect, top=0), "log.?prob", "there are no soft labels")


def differences(before: Dialect, after: Dialect) -> tuple[str, ...]:
    """Return the fields in which two dialects differ."""
    names = [field.name for field in dataclasses.fields(Dialect)]
    return tuple(name for name in names if getattr(before, name) != getattr(after, name))


def features(dialect: Dialect, request: Request) -> frozenset[str]:
    """Return what a request makes use of: one that was accepted shows that the server takes these together."""
    roles = [message["role"] for message in request.messages]
    used = {f"limit {dialect.limit}", f"temperature {dialect.temperature}", f"system {dialect.system}", *roles}
    used |= {f"tool turns {dialect.tool_turns}", f"runs {dialect.runs}"}
    used |= {f"{before} {later}" for before, later in itertools.pairwise(roles)}
    if request.logprobs:
        used.add(f"top {dialect.top}")
    if request.schema and dialect.schema:
        used.add("schema")
    if request.tools and dialect.tools:
        used.add("tools")
    return frozenset(used)


def write(dialect: Dialect, request: Request, model: str, most_tokens: int) -> dict[str, Any]:
    """Return the body of a request."""
    messages = _messages(dialect, request.messages)
    body: dict[str, Any] = {"model": model, "messages": messages}
    if dialect.limit:
        body[dialect.limit] = most_tokens
    if dialect.temperature:
        body["temperature"] = 0.0
    if request.logprobs and dialect.top:
        body |= {"logprobs": True, "top_logprobs": dialect.top}
    if request.tools and dialect.tools:
        body["tools"] = request.tools
    if request.schema and dialect.schema:
        described = {"name": "decision", "schema": request.schema, "strict": True}
        body["response_format"] = {"type": "json_schema", "json_schema": described}
    return body


def _messages(dialect: Dialect, given: Sequence[Message]) -> list[Message]:
    messages = list(given)
    if not dialect.tool_turns:
        messages = [_told(message) for message in messages]
    if not dialect.system:
        messages = [{**message, "role": "user"} if message["role"] == "system" else message for message in messages]
    if not dialect.system or not dialect.runs or not dialect.tool_turns:
        joined: list[Message] = []
        for message in messages:
            before = joined[-1] if joined else None
            role = message["role"]
            after_a_tool = not dialect.runs and before and (before["role"], role) == ("tool", "user")
            if before and role != "tool" and (before["role"] == role or after_a_tool):
                text = "\n\n".join(part for part in (before["content"], message["content"]) if part)
                joined[-1] = {**before, **message, "role": before["role"], "content": text}
            else:
                joined.append(message)
        messages = joined
    return messages


def _told(message: Message) -> Message:
    """Return a turn with calls, or with a call's result, as text."""
    if message["role"] == "tool":
        return {"role": "user", "content": f"RESULT {message['content']}"}
    if "tool_calls" not in message:
        return message
    calls = [call["function"] for call in message["tool_calls"]]
    lines = [message["content"], *(f"CALL {call['name']} {_one_line(call['arguments'])}" for call in calls)]
    return {"role": message["role"], "content": "\n".join(line for line in lines if line)}


def _one_line(arguments: str) -> str:
    try:
        return json.dumps(json.loads(arguments))
    except (ValueError, RecursionError):
        return " ".join(arguments.split())
