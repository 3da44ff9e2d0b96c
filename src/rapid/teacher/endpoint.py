"""Any OpenAI-compatible server: hosted models, vLLM, Ollama, llama-server.

The key is read from the environment when the client is made and appears nowhere else; it is cut out of everything
that a server says, because servers echo it. What a server does not support (token probabilities, output schema,
tools) is found out by its refusal and left out from then on.
"""

import json
import logging
import math
import os
import random
import threading
import time
from collections.abc import Sequence
from typing import Any
from urllib.parse import quote, urlsplit

import openai

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher.chat import ChatError, Message, Reply, Request, ToolCall
from rapid.teacher.logprobs import TOP, Token

LONGEST_WAIT = 60.0
"""Seconds; a server that asks for a longer pause is obeyed up to this."""
SHORTEST_KEY = 8
"""Characters from which on a key is taken to be a secret."""
ERROR_LIMIT = 300
"""Characters of an error that are kept."""


class Endpoint:
    """A chat model behind an address; implements :class:`rapid.teacher.chat.Chat`. Safe to use from threads.

    Args:
        config: address, model, key variable, time limit, retries and rate.
        first_wait: seconds before the first retry; each later wait is twice as long.

    Raises:
        RapidError: the address is none, or holds a password. No request is made yet.
    """

    def __init__(self, config: TeacherConfig, first_wait: float = 1.0) -> None:
        self._config, self._first_wait = config, first_wait
        _check_address(config.base_url)
        key = os.environ.get(config.api_key_env, "").strip()
        # What people give to servers that want none ("x", "EMPTY") hides nothing, and may occur in any answer.
        self._secret = key if len(key) >= SHORTEST_KEY else ""
        try:
            # Own retries: the client's cannot be counted. Local servers need no key, but the client insists on one.
            self._client = openai.OpenAI(
                base_url=config.base_url, api_key=key or "none", timeout=config.timeout_s, max_retries=0
            )
        except (openai.OpenAIError, ValueError) as error:
            raise RapidError(f"The address '{config.base_url}' cannot be used: {self._clean(error)}.") from None
        # Their debug log holds every header of a response, where a server may repeat the key.
        for transport in ("httpcore", "httpcore2"):
            logging.getLogger(transport).setLevel(logging.INFO)
        self._tools = config.tool_calling != "text"
        self._schema = self._logprobs = True
        self._lock = threading.Lock()
        self._next_slot = 0.0

    def __repr__(self) -> str:
        """Name the address and the model, never the key."""
        return f"Endpoint({self._config.base_url!r}, {self._config.model!r})"

    @property
    def native_tools(self) -> bool:
        """Whether tools are passed beside the messages."""
        return self._tools

    def ask(self, request: Request) -> Reply:
        """Answer a conversation, with bounded retries; see :class:`rapid.teacher.chat.Chat`."""
        retries = 0
        while True:
            options = self._options(request)
            self._wait_for_slot()
            try:
                return self._read(self._request(request.messages, options), retries)
            except (openai.AuthenticationError, openai.PermissionDeniedError) as error:
                raise RapidError(
                    f"{self._config.base_url} refuses the key: {self._clean(error)}. Put a valid key into the "
                    f"environment variable {self._config.api_key_env}."
                ) from None
            except openai.NotFoundError as error:
                raise RapidError(
                    f"{self._config.base_url} does not know the model '{self._config.model}', or is no OpenAI-style "
                    f"address: {self._clean(error)}. Check --teacher.model and --teacher.base-url."
                ) from None
            except (openai.BadRequestError, openai.UnprocessableEntityError) as error:
                if not options or not self._give_up_an_option(options):
                    raise ChatError(f"the request was refused: {self._clean(error)}", retries) from None
            except (openai.APIError, ValueError) as error:
                if retries >= self._config.max_retries:
                    raise ChatError(f"{type(error).__name__}: {self._clean(error)}", retries) from None
                time.sleep(self._pause(error, retries))
                retries += 1

    def _options(self, request: Request) -> dict[str, Any]:
        options: dict[str, Any] = {}
        if request.logprobs and self._logprobs:
            options |= {"logprobs": True, "top_logprobs": TOP}
        if request.tools and self._tools:
            options["tools"] = request.tools
        if request.schema and self._schema:
            described = {"name": "decision", "schema": request.schema, "strict": True}
            options["response_format"] = {"type": "json_schema", "json_schema": described}
        return options

    def _request(self, messages: Sequence[Message], options: dict[str, Any]) -> Any:
        sent: list[Any] = list(messages)
        return self._client.chat.completions.create(
            model=self._config.model,
            messages=sent,
            temperature=0.0,
            max_tokens=self._config.max_answer_tokens,
            **options,
        )

    def _read(self, completion: Any, retries: int) -> Reply:
        """Read an answer without trusting its form: servers answer 200 with all sorts of things."""
        choices = getattr(completion, "choices", None)
        if not choices or getattr(choices[0], "message", None) is None:
            raise ValueError("the server answered without a message")
        message, usage = choices[0].message, getattr(completion, "usage", None)
        text = message.content or getattr(message, "refusal", None) or ""
        calls = tuple(
            ToolCall(self._clean(call.id), self._clean(call.function.name), self._clean(call.function.arguments))
            for call in message.tool_calls or ()
            if getattr(call, "function", None) is not None
        )
        tokens_in, tokens_out = getattr(usage, "prompt_tokens", 0) or 0, getattr(usage, "completion_tokens", 0) or 0
        return Reply(self._clean(text), calls, int(tokens_in), int(tokens_out), retries, _tokens(choices[0]))

    def _give_up_an_option(self, options: dict[str, Any]) -> bool:
        """Leave out what the server may have refused, the rarest first; say whether there was anything."""
        with self._lock:
            if "logprobs" in options:
                self._logprobs = False
                return True
            if "response_format" in options:
                self._schema = False
                return True
            if "tools" in options and self._config.tool_calling == "auto":
                self._tools = False
                return True
        return False

    def _wait_for_slot(self) -> None:
        """Space requests evenly under the rate limit."""
        if self._config.requests_per_minute <= 0:
            return
        with self._lock:
            now = time.monotonic()
            slot = max(self._next_slot, now)
            self._next_slot = slot + 60.0 / self._config.requests_per_minute
        time.sleep(slot - now)

    def _pause(self, error: Exception, retries: int) -> float:
        """Return the seconds to wait: what the server asks for, else exponential with jitter."""
        response = getattr(error, "response", None)
        asked = response.headers.get("retry-after") if response is not None else None
        try:
            if asked is not None:
                return min(max(float(asked), 0.0), LONGEST_WAIT)
        except ValueError:
            pass  # a date instead of seconds: the backoff does as well
        return min(self._first_wait * 2.0**retries * random.uniform(0.5, 1.0), LONGEST_WAIT)

    def _clean(self, said: object) -> str:
        """Return what was said without the key, however it is spelled."""
        text = str(said)
        if self._secret:
            # Quoted as JSON, as Python or as a part of an address; the longest first, so that no rest stays.
            key = self._secret
            spellings = {key, json.dumps(key)[1:-1], repr(key)[1:-1], quote(key, safe=""), quote(key)}
            for spelling in sorted(spellings, key=len, reverse=True):
                text = text.replace(spelling, "[key]")
        # Cut after cleaning: a key that is cut in two would not be found.
        return text[:ERROR_LIMIT] if isinstance(said, Exception) else text


def _check_address(address: str) -> None:
    """Raise unless an address can be one; it is recorded with the data, so that it must not hold a password."""
    try:
        parts = urlsplit(address)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        parts, usable = None, False
    if parts is not None and "@" in parts.netloc:
        raise RapidError(
            "The address in --teacher.base-url holds a user name or password, which would be written into the data. "
            "Leave it out, and put the key into the environment variable that --teacher.api-key-env names."
        )
    if not usable:
        raise RapidError(
            f"The address '{address}' cannot be used. Give --teacher.base-url an address such as "
            "http://127.0.0.1:8000/v1."
        )


def _tokens(choice: Any) -> tuple[Token, ...]:
    """Read the token probabilities, if the server gave any that make sense."""
    try:
        return tuple(
            Token(
                str(written.token),
                tuple(
                    {str(other.token): _logprob(other) for other in (written, *(written.top_logprobs or ()))}.items()
                ),
            )
            for written in choice.logprobs.content
        )
    except (AttributeError, TypeError, ValueError):
        return ()


def _logprob(token: Any) -> float:
    value = float(token.logprob)
    if math.isnan(value):
        raise ValueError("a probability that is no number")
    return value
