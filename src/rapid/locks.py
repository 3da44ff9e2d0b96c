"""One process at a time in a directory: a lock file that the system releases when the process ends, however it ends."""

import contextlib
import errno
import os
import stat
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from rapid.errors import RapidError
from rapid.files import make_directory, remove_leftovers

LOCK_FILE = "lock"


class BusyError(RapidError):
    """Another process holds the lock."""


_held: set[tuple[int, str]] = set()
"""What this process holds: thread and path. A verb that calls another's code locks the same directory twice."""


@contextmanager
def exclusive(directory: str | os.PathLike[str]) -> Generator[None, None, None]:
    """Make a directory if need be and hold it for this process; what others left half written there is removed.

    Take the lock before the first look at the directory. The lock file goes with the lock, and so do directories that
    were made for it and hold nothing else.

    Raises:
        RapidError: another process holds it, the directory cannot be written, or something else is in the lock's place.
    """
    folder = Path(directory)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        make_directory(folder)
    except OSError as error:
        raise RapidError(f"Cannot write in '{folder}': {error}. Choose a directory that you can write to.") from error
    try:
        with _hold(folder / LOCK_FILE, folder):
            remove_leftovers(folder)
            yield
    finally:
        with contextlib.suppress(OSError):
            for path in made:
                path.rmdir()


@contextmanager
def exclusive_file(path: str | os.PathLike[str]) -> Generator[None, None, None]:
    """Hold a single file that is going to be written, by a lock file beside it.

    Raises:
        RapidError: as :func:`exclusive`.
    """
    target = Path(path)
    try:
        make_directory(target.parent)
    except OSError as error:
        raise RapidError(f"Cannot write '{target}': {error}. Choose a directory that you can write to.") from error
    with _hold(target.parent / f".{target.name}.{LOCK_FILE}", target):
        yield


def is_empty(directory: str | os.PathLike[str]) -> bool:
    """Whether a directory that we hold has nothing in it but the lock."""
    return all(name == LOCK_FILE for name in os.listdir(directory))


@contextmanager
def _hold(path: Path, what: Path) -> Generator[None, None, None]:
    key = threading.get_ident(), os.path.realpath(path)
    if key in _held:
        yield
        return
    handle = _lock(path, what)
    _held.add(key)
    try:
        yield
    finally:
        _held.discard(key)
        # Removed while it is ours: whoever has opened it meanwhile sees that it is not the one in the directory.
        with contextlib.suppress(OSError):
            path.unlink()
        if handle is not None:
            os.close(handle)


def _lock(path: Path, what: Path) -> int | None:
    """Return the open lock file; None where the system has no such locks (Windows, where they are the user's care)."""
    try:
        import fcntl
    except ImportError:
        return None
    # No link is followed, nothing is emptied, and a pipe in the place cannot make us wait.
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        try:
            handle = os.open(path, flags, 0o666)
        except OSError as error:
            if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
                raise _foreign(path) from error
            raise RapidError(f"Cannot lock '{what}': {error}. Choose a place that you can write to.") from error
        try:
            found = os.fstat(handle)
            if not stat.S_ISREG(found.st_mode) or found.st_size:
                raise _foreign(path)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(found, os.lstat(path)):
                    return handle
            os.close(handle)  # its owner has just removed it: take the new one
        except BlockingIOError as error:
            os.close(handle)
            raise BusyError(
                f"Another process is at work in '{what}'. Wait for it, or give each its own directory and, to "
                "collect, `--shard i/n`."
            ) from error
        except OSError as error:
            os.close(handle)
            raise RapidError(
                f"Cannot lock '{what}': {error}. This file system has no locks; choose a place on another."
            ) from error
        except RapidError:
            os.close(handle)
            raise


def _foreign(path: Path) -> RapidError:
    return RapidError(
        f"'{path}' is in the place of a lock, but it is a link, a pipe, a directory or a file with something in it, "
        "which is not ours. It was left as it is: move it away, or choose another directory."
    )
