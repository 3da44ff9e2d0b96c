"""What a server says, read without trusting its form: any value may stand in any place.

Nothing leaves this module but text that can be printed and kept, numbers that are finite and small, and what is known
to be secret has been cut out of it.
"""

import json
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from rapid.teacher.chat import Reply, ToolCall
from rapid.teacher.logprobs import Token
from rapid.text import printable

MOST_CALLS = 16
"""Tool calls of one answer that are read; one at a time is asked for."""
MOST_ARGUMENTS = 4096
"""Characters of a call's arguments that are read."""
ERROR_LIMIT = 300
"""Characters of an error that are kept."""
_NAME_LIMIT = 200
_MOST_NAMES = 1000
_MOST_TOKENS = 10_000_000
"""More tokens than any model reads or writes at once: a number beyond makes no sense."""
_CHARACTERS_PER_TOKEN = 4
"""Of English text, on the usual rule of thumb; for the budget where the server tells no numbers."""
_END = re.compile(r"(</s>|<\|[\w-]{1,30}\|>|<end_of_turn>|<eos>)$")


class FormError(Exception):
    """An answer that is none. `lasting` says that trying again would not help."""

    def __init__(self, message: str, lasting: bool = False) -> None:
        super().__init__(message)
        self.lasting = lasting


@dataclass(frozen=True)
class Refusal:
    """Why a server did not answer, in its own words."""

    status: int
    """As HTTP has them, also where the error came with status 200."""
    said: str
    code: str = ""
    """Its own name for the error, such as ``insufficient_quota``."""
    parameter: str = ""
    """The field of the request that it names."""
    after: float | None = None
    """Seconds after which it wants to be asked again."""


Clean = Callable[[str], str]


def decode(body: bytes, kind: str, clean: Clean) -> Mapping[str, Any]:
    """Return the JSON object that an answer is.

    Args:
        body: what was sent.
        kind: its Content-Type.
        clean: cuts secrets out of a text.

    Raises:
        FormError: it is something else; a few words of it are shown.
    """
    text = body.decode("utf-8-sig", errors="replace")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if isinstance(value, dict):
        return value
    start = text.lstrip()[:20].lower()
    if "event-stream" in kind or start.startswith(("data:", "event:")):
        raise FormError("it answered with a stream, which was not asked for", lasting=True)
    what = "a web page" if start.startswith(("<!doctype", "<html")) else "no JSON object"
    raise FormError(f"it answered with {what}: {excerpt(text, clean)}" if start else "its answer is empty")


def excerpt(text: str, clean: Clean) -> str:
    """Return the words of an error page or another text, as far as they matter."""
    title = re.search(r"<title[^>]{0,200}>([^<]{1,1000})", text[:65536], re.IGNORECASE)
    words = title[1] if title else re.sub(r"<[^<>]{0,1000}>", " ", text)
    # Cut after cleaning, here and below: a secret that is cut in two would not be found.
    return " ".join(clean(printable(words)).split())[:ERROR_LIMIT]


def read_refusal(status: int, headers: Mapping[str, str], body: bytes, clean: Clean) -> Refusal:
    """Read an answer whose status says that it is none."""
    after = _pause(headers.get("retry-after", ""))
    try:
        return _refusal(status, decode(body, headers.get("content-type", ""), clean), clean, after)
    except FormError:
        return Refusal(status, excerpt(body.decode(errors="replace"), clean), after=after)


def find_refusal(answer: Mapping[str, Any], headers: Mapping[str, str], clean: Clean) -> Refusal | None:
    """Return the error that an answer with status 200 holds, itself or in its first choice, or None."""
    holders = [answer, *(choice for choice in _list(answer.get("choices"))[:1] if isinstance(choice, dict))]
    holder = next((holder for holder in holders if holder.get("error")), None)
    if holder is None:
        return None
    code = _dict(holder["error"]).get("code")
    status = code if type(code) is int and 400 <= code < 600 else 500
    return _refusal(status, holder, clean, _pause(headers.get("retry-after", "")))


def _refusal(status: int, answer: Mapping[str, Any], clean: Clean, after: float | None) -> Refusal:
    error = answer.get("error")
    details: Mapping[str, Any] = error if isinstance(error, dict) else answer
    said = next((text for text in _sentences(answer) if text.strip()), "")
    code, parameter = (
        clean(printable(value))[:_NAME_LIMIT] if isinstance(value := details.get(name), str) else ""
        for name in ("code", "param")
    )
    kind = details.get("type")
    if not code and isinstance(kind, str):
        code = clean(printable(kind))[:_NAME_LIMIT]
    said = " ".join(clean(printable(said)).split())[:ERROR_LIMIT]
    return Refusal(status, said or "it does not say why", code, parameter, after)


def _sentences(answer: Mapping[str, Any]) -> Iterator[str]:
    """Give the places where servers put the sentence for people."""
    error = answer.get("error")
    for holder in (error, answer):
        if isinstance(holder, str):
            yield holder
        elif isinstance(holder, dict):
            for name in ("message", "detail", "msg", "error_description"):
                value: Any = holder.get(name)
                if isinstance(value, str):
                    yield value
                elif isinstance(value, list):
                    yield "; ".join(str(item.get("msg", "")) for item in value[:5] if isinstance(item, dict))


def _pause(asked: str) -> float | None:
    """Read Retry-After: seconds, or a date."""
    try:
        seconds = float(asked)
    except ValueError:
        try:
            seconds = parsedate_to_datetime(asked).timestamp() - time.time()
        except (ValueError, TypeError, OverflowError, IndexError):
            return None
    return max(seconds, 0.0) if math.isfinite(seconds) else None


def read_names(answer: Mapping[str, Any], clean: Clean) -> tuple[str, ...]:
    """Return the models that a server lists."""
    listed = _list(answer.get("data")) or _list(answer.get("models"))
    names = (_dict(entry).get("id") or _dict(entry).get("name") for entry in listed[:_MOST_NAMES])
    return tuple(clean(printable(name))[:_NAME_LIMIT] for name in names if isinstance(name, str) and name)


def read_reply(answer: Mapping[str, Any], sent: int, most: int, offered: bool, clean: Clean) -> Reply:
    """Return what a model said.

    Args:
        answer: the server's.
        sent: characters of the request, from which its tokens are estimated if the server does not tell them.
        most: tokens that were allowed.
        offered: whether tools were.
        clean: cuts secrets out of a text.

    Raises:
        FormError: there is no message in it.
    """
    choice, message = _message(answer)
    text = _text(message.get("content")) or _string(message.get("refusal"))
    thought = _text(message.get("content"), ("thinking", "reasoning"))
    thought = thought or _string(message.get("reasoning_content")) or _string(message.get("reasoning"))
    # What nobody offered cannot be called.
    calls = _calls(message, clean) if offered else ()
    ended = clean(printable(_string(choice.get("finish_reason"))))[:_NAME_LIMIT]
    # A token is seldom longer than eight characters; what is beyond was not asked for.
    longest = max(16_384, 8 * most)
    said = _without_ends(clean(printable(text))[:longest])
    usage = _dict(answer.get("usage"))
    told = [_count(usage.get(name)) for name in ("prompt_tokens", "completion_tokens")]
    wrote = len(text) + sum(len(call.arguments) for call in calls)
    guesses = [max(amount // _CHARACTERS_PER_TOKEN, 1) for amount in (sent, wrote)]
    # No prompt is without tokens, and no text either.
    known = [number is not None and (number > 0 or (place == 1 and not wrote)) for place, number in enumerate(told)]
    tokens_in, tokens_out = (
        number if good and number is not None else guess
        for number, good, guess in zip(told, known, guesses, strict=True)
    )
    return Reply(
        said,
        calls,
        tokens_in,
        tokens_out,
        tokens=_tokens(choice, clean),
        model=clean(printable(_string(answer.get("model"))))[:_NAME_LIMIT],
        estimated=not all(known),
        reasoning=clean(printable(thought))[:longest],
        finish_reason="length" if ended == "max_tokens" else ended,
    )


def _message(answer: Mapping[str, Any]) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the first choice that holds a message, and the message."""
    for choice in _list(answer.get("choices")):
        message = _dict(choice).get("message")
        if isinstance(message, dict):
            return choice, message
    raise FormError("it answered without a message")


def _text(content: Any, kinds: Sequence[str] = ("text", "output_text", "refusal")) -> str:
    """Return the content of some kinds; it may come in typed pieces, and what was thought is not said."""
    if isinstance(content, str):
        return content if "text" in kinds else ""
    pieces: list[str] = []
    for piece in _list(content):
        if isinstance(piece, str):
            pieces.append(piece if "text" in kinds else "")
        elif isinstance(piece, dict) and piece.get("type", "text") in kinds:
            # Thoughts may come in pieces again.
            inner: Any = next((piece[name] for name in ("text", *kinds) if piece.get(name)), "")
            parts = [inner] if isinstance(inner, str) else [_dict(part).get("text") for part in _list(inner)]
            pieces += [_string(part) for part in parts]
    return "".join(pieces)


def _without_ends(text: str) -> str:
    """Return a text without the tokens that end a turn, which some servers leave in it."""
    while found := _END.search(text.rstrip()[-64:]):
        text = text.rstrip()[: -len(found[1])]
    return text


def _calls(message: Mapping[str, Any], clean: Clean) -> tuple[ToolCall, ...]:
    calls: list[ToolCall] = []
    for number, call in enumerate(_list(message.get("tool_calls"))[:MOST_CALLS], 1):
        function = _dict(_dict(call).get("function"))
        name = _string(function.get("name"))
        if not name:
            continue
        arguments: Any = function.get("arguments")
        if not isinstance(arguments, str):
            try:
                arguments = json.dumps(arguments) if isinstance(arguments, dict) else "{}"
            except RecursionError:
                arguments = "{}"
        identity = _string(_dict(call).get("id")) or f"call_{number}"
        calls.append(
            ToolCall(
                clean(printable(identity))[:_NAME_LIMIT],
                clean(printable(name))[:_NAME_LIMIT],
                clean(printable(arguments.strip() or "{}"))[:MOST_ARGUMENTS],
            )
        )
    return tuple(calls)


def _tokens(choice: Mapping[str, Any], clean: Clean) -> tuple[Token, ...]:
    """Read the token probabilities; a token that cannot be read spoils all, an alternative only itself."""
    tokens: list[Token] = []
    for written in _list(_dict(choice.get("logprobs")).get("content")):
        own = _alternative(written, clean)
        if own is None:
            return ()
        others = (_alternative(other, clean) for other in _list(written.get("top_logprobs"))[:100])
        tokens.append(Token(own[0], tuple(dict([own, *(other for other in others if other)]).items())))
    return tuple(tokens)


def _alternative(entry: Any, clean: Clean) -> tuple[str, float] | None:
    text, value = _dict(entry).get("token"), _dict(entry).get("logprob")
    if not isinstance(text, str) or not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return None if math.isnan(number) else (clean(printable(text))[:_NAME_LIMIT], min(number, 0.0))


def _count(value: Any) -> int | None:
    """Return a number of tokens, or None if it makes no sense."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if type(value) is int and 0 <= value <= _MOST_TOKENS else None


def _dict(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _string(value: Any) -> str:
    return value if isinstance(value, str) else ""
