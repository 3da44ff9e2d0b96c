"""Known secrets, cut out of whatever comes from outside: servers echo keys, in any spelling."""

import base64
import html
import json
import re
from collections.abc import Iterable
from urllib.parse import quote

SHORTEST = 8
"""Characters from which on a value is taken to be a secret. What people give to servers that want no key ("x", "EMPTY")
hides nothing, and may occur in any answer."""


class Secrets:
    """Values that must appear nowhere, plain or in base64, hexadecimal, percent, JSON, Python or HTML forms."""

    def __init__(self, values: Iterable[str] = ()) -> None:
        exact: set[str] = set()
        any_case: set[str] = set()
        for value in values:
            if len(value) >= SHORTEST:
                exact |= _spellings(value)
                any_case |= _spellings_in_any_case(value)
        # The longest first, so that no rest stays.
        parts = [(text, re.escape(text)) for text in exact]
        parts += [(text, f"(?i:{re.escape(text)})") for text in any_case]
        ordered = [pattern for _, pattern in sorted(parts, key=lambda part: (-len(part[0]), part))]
        self._pattern = re.compile("|".join(ordered)) if ordered else None

    def clean(self, text: str) -> str:
        """Return `text` with ``[key]`` for every secret."""
        return self._pattern.sub("[key]", text) if self._pattern else text


def _spellings(value: str) -> set[str]:
    as_json = json.dumps(value)[1:-1]
    found = {value, as_json, json.dumps(as_json)[1:-1], repr(value)[1:-1], html.escape(value)}
    content = value.encode()
    for offset in range(3):
        # In base64 three bytes are four characters, so that a value looks different at each of three places. The
        # characters at either end are also made of what stands beside it, and are left.
        coded = base64.b64encode(bytes(offset) + content).decode().rstrip("=")
        core = coded[(0, 2, 3)[offset] : len(coded) - ((offset + len(content)) % 3 > 0)]
        if len(core) >= SHORTEST:
            found |= {core, core.replace("+", "-").replace("/", "_")}
    return found


def _spellings_in_any_case(value: str) -> set[str]:
    content = value.encode()
    forms = {quote(value, safe=""), quote(value), "".join(f"%{byte:02x}" for byte in content)}
    return forms | {content.hex(separator) for separator in (":", " ", "-")} | {content.hex()}
