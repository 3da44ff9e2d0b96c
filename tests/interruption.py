"""Stopping a program in the middle of what it does."""

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def interrupted(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, when: str) -> Generator[None, None, None]:
    """Expect the block to end in a KeyboardInterrupt `before` or `after` the first call of `module.name`."""
    real = getattr(module, name)

    def stop(*arguments: Any, **options: Any) -> None:
        if when == "after":
            real(*arguments, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, name, stop)
        with pytest.raises(KeyboardInterrupt):
            yield
