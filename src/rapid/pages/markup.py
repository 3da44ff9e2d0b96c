"""Small pieces of HTML. Everything that is text passes through :func:`text`, and nothing reaches the page unescaped."""

import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


class Markup(str):
    """HTML that is safe as it stands."""

    __slots__ = ()


def text(value: object) -> Markup:
    """Return anything as escaped text; markup stays as it is."""
    if isinstance(value, Markup):
        return value
    # A lone half of a surrogate pair, which a model's answer may hold, cannot be written as UTF-8.
    clean = str(value).encode("utf-8", "replace").decode("utf-8").replace("\0", "\ufffd")
    return Markup(html.escape(clean, quote=True))


def _attribute(value: object) -> str:
    # Markup inside quotes would be no markup: an attribute is escaped whatever it is.
    return text(str.__str__(value) if isinstance(value, str) else value)


def join(parts: Iterable[object], between: str = "") -> Markup:
    """Return parts one after another, escaped where they are text."""
    return Markup(text(Markup(between)).join(text(part) for part in parts))


def tag(name: str, *children: object, **attributes: object) -> Markup:
    """Return an element.

    Of attributes, ``class_`` is written `class`, ``data_value`` `data-value`; one that is None is left out.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{_attribute(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{name}{written}>{join(children)}</{name}>")


def facts(pairs: Iterable[tuple[object, object]]) -> Markup:
    """Return a list of names and values."""
    return tag("dl", *(tag("div", tag("dt", name), tag("dd", value)) for name, value in pairs), class_="facts")


def plain(value: Any) -> Any:
    """Return `value` as JSON has it: no NaN, no infinity, no types of NumPy, no half surrogates."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode("utf-8")
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Sequence):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int) else str(value)


def script_json(value: Any) -> Markup:
    """Return JSON that cannot leave the script element it stands in, whatever text it holds.

    ASCII only, so that U+2028 and U+2029 are escapes too; `<`, `>` and `&` become escapes, so no tag, comment or
    entity can be read into it.
    """
    packed = json.dumps(plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        packed = packed.replace(character, f"\\u{ord(character):04x}")
    return Markup(packed)
