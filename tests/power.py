"""Cutting the power: what a directory holds afterwards if the system kept only what it was told to keep."""

import os
import stat
from pathlib import Path

import pytest


class PowerCut:
    """Watches ``os.fsync`` and knows what would be left of a directory.

    The strictest disk there is: a file has the content of its last fsync, followed by zeros for what was appended
    since; a name is there if the directory was synced after the file came by that name.

    Args:
        root: the directory; what it holds now is on the disk.
        monkeypatch: puts the watch in place.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root = root
        self.syncs = 0
        self._sync = os.fsync
        # Open for ever, so that no number of a file is given to another.
        self._handles: dict[tuple[int, int], int] = {}
        self._contents: dict[tuple[int, int], bytes] = {}
        self._names: dict[tuple[int, int], dict[str, tuple[int, int]]] = {}
        self._top = _number(root)
        for folder, _, files in os.walk(root):
            for path in (folder, *(os.path.join(folder, name) for name in files)):
                self._keep(os.open(path, os.O_RDONLY))
        monkeypatch.setattr(os, "fsync", self._watch)

    def _watch(self, handle: int) -> None:
        self._sync(handle)
        self.syncs += 1
        # Opened again, since the one that is synced may be for writing only.
        self._keep(os.open(f"/proc/self/fd/{handle}", os.O_RDONLY))

    def _keep(self, handle: int) -> None:
        number = _number(handle)
        if number in self._handles:
            os.close(handle)
            handle = self._handles[number]
        self._handles[number] = handle
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            self._names[number] = {
                name: _number(os.stat(name, dir_fd=handle, follow_symlinks=False)) for name in os.listdir(handle)
            }
        else:
            self._contents[number] = os.pread(handle, os.fstat(handle).st_size, 0)

    def after(self) -> Path:
        """Return a copy of the directory as it would be found after a power cut now; the watch is over."""
        copy = self.root.with_name(f"{self.root.name}+")
        self._restore(self._top, copy)
        for handle in self._handles.values():
            os.close(handle)
        return copy

    def _restore(self, number: tuple[int, int], copy: Path) -> None:
        copy.mkdir()
        for name, inside in self._names.get(number, {}).items():
            if inside in self._names:
                self._restore(inside, copy / name)
            elif inside in self._contents:
                content = self._contents[inside]
                size = os.fstat(self._handles[inside]).st_size
                (copy / name).write_bytes(content + bytes(max(size - len(content), 0)))
            else:  # a name whose content was never flushed; an empty directory is no different
                (copy / name).write_bytes(b"")


def _number(path: int | str | Path | os.stat_result) -> tuple[int, int]:
    found = path if isinstance(path, os.stat_result) else os.stat(path)
    return found.st_dev, found.st_ino
