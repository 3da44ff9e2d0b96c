"""Any OpenAI-compatible server: hosted models, vLLM, Ollama, llama-server.

The key is read from the environment when the client is made and appears nowhere else; it is cut out of every error
text, because servers echo it. What a server does not support (tools, output schema) is found out by its refusal and
left out from then on.
"""

import os
import random
import threading
import time
from collections.abc import Sequence
from typing import Any

import openai

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher.conversation import ChatError, Message, Reply, ToolCall

LONGEST_WAIT = 60.0
"""Seconds; a server that asks for a longer pause is obeyed up to this."""


class Endpoint:
    """A chat model behind an address; implements :class:`rapid.teacher.conversation.Chat`. Safe to use from threads.

    Args:
        config: address, model, key variable, time limit, retries and rate.
        first_wait: seconds before the first retry; each later wait is twice as long.
    """

    def __init__(self, config: TeacherConfig, first_wait: float = 1.0) -> None:
        self._config, self._first_wait = config, first_wait
        self._secret = os.environ.get(config.api_key_env, "").strip()
        try:
            # Own retries: the client's cannot be counted. Local servers need no key, but the client insists on one.
            self._client = openai.OpenAI(
                base_url=config.base_url, api_key=self._secret or "none", timeout=config.timeout_s, max_retries=0
            )
        except (openai.OpenAIError, ValueError) as error:
            raise RapidError(f"The address '{config.base_url}' cannot be used: {self._clean(error)}.") from None
        self._tools = config.tool_calling != "text"
        self._schema = True
        self._lock = threading.Lock()
        self._next_slot = 0.0

    def __repr__(self) -> str:
        """Name the address and the model, never the key."""
        return f"Endpoint({self._config.base_url!r}, {self._config.model!r})"

    @property
    def native_tools(self) -> bool:
        """Whether tools are passed beside the messages."""
        return self._tools

    def ask(self, messages: Sequence[Message], tools: list[dict[str, Any]], schema: dict[str, Any] | None) -> Reply:
        """Answer a conversation, with bounded retries; see :class:`rapid.teacher.conversation.Chat`."""
        retries = 0
        while True:
            options = self._options(tools, schema)
            self._wait_for_slot()
            try:
                return self._read(self._request(messages, options), retries)
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

    def _options(self, tools: list[dict[str, Any]], schema: dict[str, Any] | None) -> dict[str, Any]:
        options: dict[str, Any] = {}
        if tools and self._tools:
            options["tools"] = tools
        if schema and self._schema:
            described = {"name": "decision", "schema": schema, "strict": True}
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
            ToolCall(str(call.id), str(call.function.name), str(call.function.arguments))
            for call in message.tool_calls or ()
            if getattr(call, "function", None) is not None
        )
        tokens_in, tokens_out = getattr(usage, "prompt_tokens", 0) or 0, getattr(usage, "completion_tokens", 0) or 0
        return Reply(str(text), calls, int(tokens_in), int(tokens_out), retries)

    def _give_up_an_option(self, options: dict[str, Any]) -> bool:
        """Leave out what the server may have refused, the output schema first; say whether there was anything."""
        with self._lock:
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

    def _clean(self, error: Exception) -> str:
        text = str(error)[:300]
        return text.replace(self._secret, "[key]") if self._secret else text
