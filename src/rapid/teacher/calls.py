"""Tool calls in a model's text, however it spells them: the protocol's line, JSON of all sorts, Python."""

import json
import re
from collections.abc import Iterator
from typing import Any, cast

from rapid.teacher.tools import TOOL_NAMES

_NAMES = "|".join(TOOL_NAMES)
_INPUT = r"(?i:json|action[ _]?input|tool[ _]?input|input|arguments?|args|parameters?|params|with)"
_GAP = rf"[^\w{{]*(?:{_INPUT}[^\w{{]*){{0,2}}"
# Small models leave the word CALL out, or put other words, brackets or punctuation around it. A call must not be taken
# for a decision: an object that follows a tool's name holds arguments.
_CALL = re.compile(
    rf"""
    (?: ^[ \t]*CALL[ \t]+                         # CALL and any name,
      | \b(?=(?:{_NAMES}){_GAP}\{{)               # or a tool's name before an object,
      | ^[ \t\[]*(?=(?:{_NAMES})[ \t]*(?:\(|$)) ) # or before a bracket, or alone in a line;
    (\w+)
    (?: {_GAP}(\{{[^{{}}]*\}})                    # then an object,
      | [ \t]*\(?(.*?)\)?\]?[ \t]*$ )             # or whatever follows in the line
    """,
    re.MULTILINE | re.VERBOSE,
)
_KEYWORDS = re.compile(r"\s*(\w+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)'|([\w.]+))\s*(?:,|$)")
_MARKED = re.compile(
    r"<\s*(?:tool_call|function_call|function|invoke)s?\b|\[TOOL_CALLS?\]|functools\[|\"tool_calls\"\s*:"
    r"|\baction[ _]input\"?\s*:|\btool[ _]input\"?\s*:",
    re.IGNORECASE,
)
_NAMING = ("name", "tool", "function", "tool_name", "action", "tool_calls")
_GIVING = ("arguments", "parameters", "args", "params", "input", "action_input", "tool_input")


def read_call(text: str) -> tuple[str, str] | None:
    """Return the tool and the arguments, a JSON object as text, that a text asks for, or `None`."""
    for found in objects_in(text):
        if call := _in_object(found):
            return call
    match = _CALL.search(text)
    if match is None:
        return None
    arguments = match[2] or match[3] or "{}"
    pairs = _KEYWORDS.findall(arguments) if _KEYWORDS.match(arguments) else []
    if pairs:
        values = {name: quoted or single or _number(bare) for name, quoted, single, bare in pairs}
        arguments = json.dumps(values)
    return match[1], arguments


def is_call(text: str) -> bool:
    """Say whether a text holds a call, also one of a tool that does not exist."""
    return read_call(text) is not None or _MARKED.search(text) is not None


def is_finished(text: str) -> bool:
    """Say whether a text that is still being written holds a whole call or decision: the rest would be made up."""
    call = _CALL.search(text)
    if call:
        return bool(call[2]) or call[3].endswith("}") or "\n" in text[call.end() :]
    return any("action" in found for found in objects_in(text))


def objects_in(text: str) -> Iterator[dict[str, Any]]:
    """Give the JSON objects in a text, whatever stands around them; none of those inside others.

    An object that gives one key two values is none: nobody can say which one is meant.
    """
    for start, end in _spans(text):
        try:
            value = json.loads(text[start:end], object_pairs_hook=_unambiguous)
        except (ValueError, RecursionError):
            continue
        if isinstance(value, dict):
            yield cast(dict[str, Any], value)


def without_objects(text: str) -> str:
    """Return a text without the JSON objects in it."""
    kept, position = "", 0
    for start, end in _spans(text):
        kept += text[position:start] + "\n"
        position = end
    return kept + text[position:]


def _spans(text: str) -> Iterator[tuple[int, int]]:
    decoder = json.JSONDecoder()
    position = text.find("{")
    while position >= 0:
        try:
            _, end = decoder.raw_decode(text, position)
        except (ValueError, RecursionError):
            end = position + 1
        else:
            yield position, end
        position = text.find("{", end)


def _unambiguous(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found and found[key] != value:
            raise ValueError(f"two values of {key!r}")
        found[key] = value
    return found


def _in_object(value: Any) -> tuple[str, str] | None:
    """Return the call that an object describes in one of the usual ways, however deep."""
    if isinstance(value, list):
        return next((call for item in cast(list[Any], value) if (call := _in_object(item))), None)
    if not isinstance(value, dict):
        return None
    fields = cast(dict[str, Any], value)
    for key in _NAMING:
        named = fields.get(key)
        if isinstance(named, str) and named in TOOL_NAMES:
            given = next((fields[name] for name in _GIVING if name in fields), None)
            if given is None:
                given = {name: item for name, item in fields.items() if name != key}
            return named, given if isinstance(given, str) else json.dumps(given)
        if isinstance(named, dict | list) and (call := _in_object(named)):
            return call
    return None


def _number(text: str) -> int | str:
    return int(text) if text.isdecimal() else text
