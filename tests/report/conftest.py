"""One browser for all tests of pages."""

from collections.abc import Iterator
from typing import Any

import pytest

import browser


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """The system's Chromium; skips where there is none, and fails in CI."""
    with browser.launched() as started:
        yield started
