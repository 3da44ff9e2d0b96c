"""What all pages are made of: one HTML file each, with style and script inside, that asks the network for nothing.

The scripts are plain files that are put one after another into one function, so that each may use what the ones before
it define. The player is shared by the page of a run and by the live page.
"""

import base64
import hashlib
import re
from collections.abc import Sequence
from importlib import resources
from typing import Any

from rapid.pages.markup import Markup, script_json, text

PLAYER = ("dom.js", "motion.js", "road.js", "pane.js", "gif.js", "share.js", "player.js")
"""The scripts of the player, in the order in which they need each other."""


def fill_page(
    title: str, body: Markup, payload: Any, scripts: Sequence[str], styles: Sequence[str], connect: str = "'none'"
) -> str:
    """Return a page as HTML.

    Args:
        title: of the window.
        body: what stands in it.
        payload: what its script reads, as :func:`~rapid.pages.markup.script_json` takes it.
        scripts: names of files of this package.
        styles: names of files of this package.
        connect: whom its script may talk to, as a content security policy says it.
    """
    script = '"use strict";\n(() => {\n' + "\n".join(_file(name) for name in scripts) + "})();\n"
    return _fill(
        _file("page.html"),
        title=text(title),
        # The script's own hash: no other script runs here, whatever text found its way into the page.
        policy=text(
            f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{_hash(script)}'; img-src data: blob:; "
            f"connect-src {connect}; base-uri 'none'; form-action 'none'"
        ),
        style=Markup("\n".join(_file(name) for name in styles)),
        body=body,
        payload=script_json(payload),
        script=Markup(script),
    )


def _file(name: str) -> str:
    return resources.files(__name__).joinpath(name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _fill(template: str, **parts: Markup) -> str:
    """Put the parts in their places, in one pass: a part that looks like a place stays what it is."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: str(parts[match[1]]), template)
