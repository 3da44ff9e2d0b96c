"""A real browser for the tests of pages: the system's Chromium, and a tab that keeps what went wrong in it."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NoReturn

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""What the program is called, by system."""


def unavailable(why: str) -> NoReturn:
    """Skip the test; where changes are decided upon, a page that nobody looked at is a failure."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"In CI every page is tried in a browser, but {why}", pytrace=False)
    pytest.skip(why)


@contextmanager
def launched() -> Iterator[Any]:
    """Start the system's Chromium, without its own window."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        unavailable("there is no Chromium on this machine. On Debian and Ubuntu: apt-get install chromium.")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        unavailable("the package playwright is not installed. The extra `dev` has it.")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path)
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Tab:
    """A page that is open, and all that a reader would not see: errors, warnings and requests."""

    page: Any
    troubles: list[str] = field(default_factory=list[str])
    requests: list[str] = field(default_factory=list[str])

    def listen(self) -> None:
        """Write down from now on what goes wrong and what is asked for."""
        self.page.on(
            "console",
            lambda said: self.troubles.append(said.text) if said.type in ("error", "warning") else None,
        )
        self.page.on("pageerror", lambda error: self.troubles.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))

    def elsewhere(self, home: str) -> list[str]:
        """Return what was asked for outside `home`; what a page makes itself is asked of nobody."""
        return [url for url in self.requests if not url.startswith((home, "data:", "blob:"))]


@contextmanager
def tab(browser: Any, **emulated: Any) -> Iterator[Tab]:
    """Open an empty tab; `emulated` is what Playwright's ``new_context`` takes: a size, dark colours, touch."""
    context = browser.new_context(**emulated)
    try:
        opened = Tab(context.new_page())
        opened.listen()
        yield opened
    finally:
        context.close()


def until(page: Any, expression: str, seconds: float = 5.0) -> None:
    """Wait until an expression is true; Playwright's own way evaluates text in the page, which its policy stops."""
    deadline = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < deadline, f"not true within {seconds} s: {expression}"
        page.wait_for_timeout(20)
