"""Spare the first step of a process a third of its time."""

from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any


def load_numba() -> None:
    """Import what numba needs to run cached machine code, without importing scipy's linear algebra along with it.

    Numba imports that only to learn that it is there, and imports it again wherever a function needs it. So numba works
    as before, also for others in this process. With a numba that is built otherwise nothing happens here.
    """
    if find_spec("scipy") is None:
        return
    with suppress(ImportError, AttributeError):
        linalg: Any = import_module("numba.np.linalg")
        check = linalg.ensure_blas
        linalg.ensure_blas = lambda: None
        try:
            import_module("numba.np.arraymath")
        finally:
            linalg.ensure_blas = check
