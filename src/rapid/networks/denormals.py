"""Denormal numbers, those too small for float32's full precision: a processor is up to a hundred times slower at them.

They arise in the gradients of tokens that hardly anything attends to, where they are sums' smallest terms.
"""

from collections.abc import Generator
from contextlib import contextmanager

import torch

_LEAST = 5e-324
"""The smallest double, denormal."""


@contextmanager
def no_denormals() -> Generator[None]:
    """Let this thread compute with 0 in place of denormal numbers meanwhile.

    The simulator is never driven within: it is held bit for bit against one that computes with them.
    """
    before = _LEAST + 0 * _LEAST == 0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
