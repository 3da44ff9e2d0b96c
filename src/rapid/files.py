"""Files that are whole or absent, also after a kill or a power cut: written beside their place, flushed, renamed.

The order in which things reach the disk: a file's content, then its name, then whatever counts on it.
"""

import contextlib
import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, Self

from rapid.errors import DamagedError, RapidError

SEAL = "content_sha256"
"""The key under which a JSON record of ours holds the SHA-256 of everything else in it."""
_PART = ".part"
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """Give a temporary path in the same directory; on success it replaces `path`, on error it vanishes.

    When the block has ended, the content and the name are on the disk. What earlier writers of the same file left when
    they were killed is removed.

    Raises:
        RapidError: the directory cannot be written.
    """
    target = Path(path)
    try:
        make_directory(target.parent)
        remove_leftovers(target.parent, f".{target.name}.")
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=_PART, dir=target.parent)
    except OSError as error:
        raise RapidError(f"Cannot write '{target}': {error}. Choose a directory that you can write to.") from error
    temporary = Path(name)
    try:
        # Held while we write, so that nobody takes the file for one that was left behind.
        _try_lock(handle)
        yield temporary
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        # mkstemp makes files private; give them the mode that open() would have.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(target)
        sync_directory(target.parent)
    finally:
        os.close(handle)
        temporary.unlink(missing_ok=True)


def make_directory(path: str | os.PathLike[str]) -> None:
    """Make a directory and those above it; all their names are on the disk then."""
    folder = Path(path)
    missing: list[Path] = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for folder in reversed(missing):
        folder.mkdir(exist_ok=True)
        sync_directory(folder.parent)
    Path(path).mkdir(exist_ok=True)  # says so if a file is in the place


def sync_directory(path: str | os.PathLike[str]) -> None:
    """Put the names in a directory on the disk, where the system can."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0))
    except OSError:  # Windows opens no directories, and flushes names by itself.
        return
    try:
        os.fsync(handle)
    except OSError as error:
        # Some network file systems cannot; all else is a failing disk.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(handle)


def remove_leftovers(directory: str | os.PathLike[str], prefix: str = ".") -> None:
    """Remove the temporary files that writers left in a directory when they were killed; those in use stay."""
    with os.scandir(directory) as entries:
        found = [entry.path for entry in entries if entry.name.startswith(prefix) and entry.name.endswith(_PART)]
    for path in found:
        try:
            handle = os.open(path, os.O_RDONLY | _NO_FOLLOW | getattr(os, "O_NONBLOCK", 0))
        except OSError:
            continue
        try:
            if _try_lock(handle):
                Path(path).unlink(missing_ok=True)
        finally:
            os.close(handle)


def _try_lock(handle: int) -> bool:
    """Lock an open file unless another process holds it; return whether it is ours now."""
    try:
        import fcntl
    except ImportError:  # Windows refuses to remove what is open.
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # A file system without locks: who is at work there cannot be told.
        return error.errno in (errno.ENOSYS, errno.ENOTSUP, errno.EINVAL)
    return True


class AppendedFile:
    """A file that grows by whole pieces: one that cannot be written to its end is taken back, and the error raised.

    A context manager. No symbolic link is followed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        fresh = not os.path.lexists(path)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_CLOEXEC", 0) | _NO_FOLLOW
        self._handle = os.open(path, flags, 0o666)
        if fresh:
            sync_directory(Path(path).parent)

    def append(self, content: bytes, sync: bool = False) -> None:
        """Write all of `content`, and with `sync` put it on the disk.

        Raises:
            OSError: it cannot be written; the file is as it was.
        """
        before = os.fstat(self._handle).st_size
        left = memoryview(content)
        try:
            while left:
                # The system may take only a part, for instance the last bytes that the disk has room for.
                written = os.write(self._handle, left)
                if written <= 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                left = left[written:]
            if sync:
                os.fsync(self._handle)
        except BaseException:
            with contextlib.suppress(OSError):
                os.ftruncate(self._handle, before)
            raise

    def sync(self) -> None:
        """Put everything appended so far on the disk."""
        os.fsync(self._handle)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def truncate(path: str | os.PathLike[str], size: int) -> None:
    """Cut a file to `size` bytes, on the disk too."""
    handle = os.open(path, os.O_WRONLY | _NO_FOLLOW)
    try:
        os.ftruncate(handle, size)
        os.fsync(handle)
    finally:
        os.close(handle)


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write bytes atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | os.PathLike[str], content: str) -> None:
    """Write UTF-8 text atomically.

    Raises:
        RapidError: it holds half a character, as a path that is not UTF-8 does.
    """
    try:
        encoded = content.encode()
    except UnicodeEncodeError as error:
        raise RapidError(
            f"Cannot write '{path}': {content[error.start - 20 : error.end + 20]!r} is not UTF-8. It is probably a "
            "path: work in a directory whose name is UTF-8."
        ) from error
    write_bytes(path, encoded)


def write_json(path: str | os.PathLike[str], content: Any, *, sealed: bool = False) -> None:
    """Write JSON atomically, indented, keys in the order given. NaN and infinity are refused.

    A `sealed` record, which must be a dictionary, holds the hash of its content, which :func:`read_json` checks.
    """
    if sealed:
        content = {**content, SEAL: content_hash(content)}
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: str | os.PathLike[str], what: str = "file") -> Any:
    """Read JSON; `what` names the artefact in the error. A seal is checked and taken off.

    Raises:
        DamagedError: the file is unreadable, not JSON, or not what was sealed.
        RapidError: the file is missing.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError as error:
        raise RapidError(f"There is no {what} at '{path}'. Check the path, or make it first.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DamagedError(
            f"The {what} '{path}' cannot be read: {error}. It is damaged or not a {what}; make it again."
        ) from error
    if isinstance(content, dict) and SEAL in content:
        seal = content.pop(SEAL)
        if seal != content_hash(content):
            raise DamagedError(
                f"The {what} '{path}' is not what was written: its content does not have the SHA-256 that it names. It "
                f"was edited or damaged; copy or make it again, or delete the line {SEAL} if the edit was yours."
            )
    return content


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number in JSON")


def content_hash(content: Any) -> str:
    """Return the SHA-256 of JSON values, whatever the order of keys and the white space."""
    plain = json.dumps(content, sort_keys=True, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(plain.encode("utf-8", "surrogatepass")).hexdigest()


def sha256(path: str | os.PathLike[str], progress: Callable[[int], None] | None = None) -> str:
    """Return the SHA-256 of a file in hexadecimal; `progress` is called with the size of each block read."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
            if progress:
                progress(len(block))
    return digest.hexdigest()


def cache_dir() -> Path:
    """Return the user's cache directory for RAPID: ``$RAPID_CACHE``, else the platform's own place."""
    if custom := os.environ.get("RAPID_CACHE"):
        return Path(custom).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base).expanduser() if base else Path.home() / ".cache") / "rapid"
