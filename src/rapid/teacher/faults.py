"""What it means that a server refused: another form of the request may help, another try, or nothing."""

import re

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.progress import format_seconds
from rapid.teacher.address import Address
from rapid.teacher.chat import ChatError
from rapid.teacher.completion import Refusal

LONGEST_WAIT = 60.0
"""Seconds; a server that asks for a longer pause is not waited for."""
_LOADING = re.compile(r"\bloading\b|being loaded|not (yet )?(been )?loaded|warming up|starting up", re.IGNORECASE)


class FormRefusedError(Exception):
    """The server does not take the request as it is."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(f"HTTP {refusal.status}: {refusal.said}")
        self.refusal = refusal
        self.words = f"{refusal.said} {refusal.parameter} {refusal.code}"


class PassingError(Exception):
    """Something that another try may cure."""

    def __init__(self, message: str, refusal: Refusal | None = None) -> None:
        super().__init__(message)
        self.refusal = refusal
        self.loading = refusal is not None and refusal.status == 503 and _LOADING.search(refusal.said) is not None


def fault_of(refusal: Refusal, method: str, location: str, config: TeacherConfig, address: Address) -> Exception:
    """Return what a refusal means: FormRefusedError, PassingError, ChatError, or RapidError if it ends everything.

    Args:
        refusal: what the server said.
        method: of the request, as HTTP has it.
        location: the address that it pointed to, if it did.
        config: address, model and the variable of the key, for the words.
        address: for the proxy's variable.
    """
    status, said = refusal.status, f"HTTP {refusal.status}: {refusal.said}"
    url = config.base_url
    if status == 401:
        return key_error(refusal, config)
    if status in (400, 403, 413, 422, 501) or (status in (404, 405) and method == "GET"):
        return FormRefusedError(refusal)
    if status in (404, 405):
        return RapidError(
            f"{url} does not know the model '{config.model}', or is no OpenAI-style address: {said}. Check "
            "--teacher.model and --teacher.base-url."
        )
    if status == 402 or refusal.code in ("insufficient_quota", "billing_hard_limit_reached"):
        return RapidError(f"{url} wants to be paid first: {said}. What was collected is kept.")
    if status == 407:
        variable = address.proxy.variable if address.proxy else "the proxy"
        return RapidError(f"The proxy refuses to serve without a password: {said}. Put it into {variable}.")
    if 300 <= status < 400:
        return RapidError(f"{url} points elsewhere ({said}): set --teacher.base-url to {location or 'that'}.")
    if refusal.after is not None and refusal.after > LONGEST_WAIT:
        pause = format_seconds(refusal.after)
        return RapidError(f"{url} wants to be left alone for {pause}: {said}. Run the same command again then.")
    if status in (408, 409, 425, 429) or status >= 500:
        return PassingError(said, refusal)
    return ChatError(said)


def key_error(refusal: Refusal, config: TeacherConfig) -> RapidError:
    """Return the error for a key that the server refuses."""
    return RapidError(
        f"{config.base_url} refuses the key: HTTP {refusal.status}: {refusal.said}. Put a valid key into the "
        f"environment variable {config.api_key_env or 'that --teacher.api-key-env names'}."
    )
