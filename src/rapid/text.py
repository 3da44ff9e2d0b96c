"""Text from outside, made safe to print and to keep: no control character, nothing that UTF-8 cannot write."""

import re

# The controls of ASCII and Latin-1 but tab and newline; marks that turn the writing direction or cannot be seen, which
# make a text read as another; the halves of surrogate pairs, which no file can hold.
_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ufff9-\ufffb\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Return `text` with ``U+FFFD`` for every character that a terminal may obey or that no file can hold."""
    return _UNPRINTABLE.sub("\ufffd", text.replace("\r\n", "\n").replace("\r", "\n"))


# Not in it, as they mark nothing inside a line: space , ; ' " % - and brackets without the square ones before them.
_MARKS = re.compile(r"[!#$&*+./:<=>?@\[\\\]^_`{|}~]")


def in_markdown(text: str) -> str:
    """Return `text` as one line of Markdown that shows it letter by letter: no mark-up, link, HTML or table cell."""
    return _MARKS.sub(r"\\\g<0>", " ".join(printable(text).split()))
