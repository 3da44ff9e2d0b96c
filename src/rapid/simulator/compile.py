# pyright: basic
# The fused multiply-add is written in numba's own terms, which pyright does not know.
"""How the kernels of this package are compiled: one thread, IEEE arithmetic, and a cache that is never stale."""

import hashlib
import io
import pickle
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.core.caching import IndexDataCacheFile
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def kernel_stamp() -> bytes:
    """Return a digest of every file of RAPID that holds a kernel, or numbers that are compiled into one."""
    package = Path(__file__).parents[1]
    numbers = [package / name for name in ("road.py", "scenarios.py", "simulator/state.py")]
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        if b"@kernel" in source or path in numbers:
            digest.update(path.name.encode() + b"\0" + source)
    return digest.digest()


_DIGEST = hashlib.sha256().digest_size
_MARK = "-checked"
"""In the name of every file of the cache that ends with its digest; numba's own files have none."""
_troubles: list[str] = []
_folders: set[str] = set()


class _CheckedCacheFile(IndexDataCacheFile):
    """Numba's cache of one function, but a file that is damaged or unreadable counts as absent.

    Numba unpickles whatever it finds, so an empty or torn file is a traceback in every command, and one with a wrong
    byte in the machine code a crash of the process. Here each file ends with the SHA-256 of what stands before it.
    """

    def __init__(self, original: IndexDataCacheFile) -> None:
        index: str = original._index_name
        super().__init__(original._cache_path, index.removesuffix(".nbi") + _MARK, kernel_stamp())

    def load(self, key: Any) -> Any:
        """Return the machine code stored under `key`, or None if there is none that can be used."""
        return self._guarded(lambda: IndexDataCacheFile.load(self, key), None)

    def save(self, key: Any, data: Any) -> None:
        """Store machine code; where the disk does not take it, it is compiled again by the next process."""
        self._guarded(lambda: IndexDataCacheFile.save(self, key, data), None)

    def _load_index(self) -> dict[Any, Any]:
        def read() -> dict[Any, Any]:
            content = _checked_content(Path(self._index_path))
            if content is None:
                return {}
            # The types of another numba's index may not exist in this one: they are not looked at before it is known.
            stream = io.BytesIO(content)
            try:
                known = pickle.load(stream) == (self._version, self._source_stamp)
                return pickle.load(stream) if known else {}
            except Exception:  # an index of an earlier RAPID is one piece
                return {}

        return self._guarded(read, {})

    def _save_index(self, overloads: dict[Any, Any]) -> None:
        self._write(self._index_path, self._dump((self._version, self._source_stamp)) + self._dump(overloads))

    def _load_data(self, name: str) -> Any:
        content = _checked_content(Path(self._data_path(name)))
        return None if content is None else pickle.loads(content)

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), self._dump(data))

    def _write(self, path: str, content: bytes) -> None:
        with self._open_for_write(path) as file:
            file.write(content + hashlib.sha256(content).digest())

    def _guarded(self, work: Callable[[], Any], otherwise: Any) -> Any:
        try:
            return work()
        except (OSError, _DamagedError) as error:
            if not _troubles:
                print(
                    f"rapid: machine code in '{self._cache_path}' cannot be used ({error}). What "
                    "is needed of it is compiled anew, which takes up to half a minute.",
                    file=sys.stderr,
                    flush=True,
                )
            _troubles.append(str(error))
            return otherwise


class _DamagedError(Exception):
    """A file of the cache is not what was written."""


def _checked_content(path: Path) -> bytes | None:
    """Return what was written to a file of the cache, None if there is no such file."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise _DamagedError(f"{path.name} cannot be read: {error.strerror}") from error
    if len(content) < _DIGEST or hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
        raise _DamagedError(f"{path.name} is damaged")
    return content[:-_DIGEST]


def cache_folders() -> list[Path]:
    """Return where the kernels that were defined so far keep their machine code."""
    return sorted(map(Path, _folders))


def damaged_cache_files(folder: str | Path) -> list[Path]:
    """Return the cached kernels in a folder that are damaged or cannot be read.

    Each is compiled anew as soon as it is needed.
    """
    damaged: list[Path] = []
    for path in sorted(Path(folder).glob(f"*{_MARK}.*nb[ci]")):
        try:
            _checked_content(path)
        except _DamagedError:
            damaged.append(path)
    return damaged


def kernel(function: Function) -> Function:
    """Compile `function` with numba on its first call and keep the machine code on disk.

    Numba stamps a cached function with the content of its own file only, although the functions that it calls are
    compiled into it; an edit of a callee would leave the caller stale. Here the stamp covers all kernels. The cache
    lies in ``NUMBA_CACHE_DIR`` if that is set, else beside the package, else (a read-only installation) in the user's
    cache directory; where none of them can be written, kernels are compiled per process.

    No fast-math: reassociated sums would change decisions that sit on a threshold, and runs would not be bit-identical.
    """
    options: dict[str, Any] = {"error_model": "numpy", "nogil": True}
    try:
        dispatcher: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no directory can be written: numba finds no place for the cache
        return cast(Function, numba.njit(**options)(function))
    stored: Any = getattr(dispatcher, "_cache", None)
    if isinstance(getattr(stored, "_cache_file", None), IndexDataCacheFile):
        stored._cache_file = _CheckedCacheFile(stored._cache_file)
        _folders.add(str(stored.cache_path))
    return cast(Function, dispatcher)


@intrinsic
def _fused(typingctx, a, b, c):
    """Return a * b + c, rounded once."""
    signature = types.float64(types.float64, types.float64, types.float64)

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return signature, generate


@kernel
def dot(a_x, a_y, b_x, b_y):
    """Return the inner product of two plane vectors, rounded as NumPy's BLAS rounds it."""
    return _fused(a_y, b_y, a_x * b_x)  # pyright: ignore[reportCallIssue]  # numba passes the first argument
