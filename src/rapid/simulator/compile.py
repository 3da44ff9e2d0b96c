# pyright: basic
# The fused multiply-add is written in numba's own terms, which pyright does not know.
"""How the kernels of this package are compiled: one thread, IEEE arithmetic, and a cache that is never stale."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def kernel_stamp() -> bytes:
    """Return a digest of every file of RAPID that holds a kernel."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        source = path.read_bytes()
        if b"@kernel" in source:
            digest.update(path.name.encode() + b"\0" + source)
    return digest.digest()


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
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:
        cache_file._source_stamp = kernel_stamp()
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
