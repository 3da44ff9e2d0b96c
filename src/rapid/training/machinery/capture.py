"""A gradient step recorded once as a CUDA graph and then replayed.

RAPID's networks are so small that a GPU spends an update waiting for Python to launch the next of some thousand
kernels. A recorded update is launched as one. It computes the same, while adapting a little in vain: a recording cannot
look whether a gate is open, so where gates are trained it runs every adapter, also those that an unrecorded step leaves
out.
"""

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

from rapid.data.batch import TransitionBatch

WARM_UP = 3
"""Steps taken without a graph first, as CUDA asks for: libraries allocate at their first calls."""


class CapturedStep:
    """Calls `step`; after `WARM_UP` calls as one graph.

    `step` must do the same whatever the numbers are: ask for no value, and read everything that changes from tensors
    that stay where they are. A batch of other shapes than the recorded one is computed without the graph.

    Args:
        step: a gradient step; what it returns must be a tensor.
        generator: whose random numbers it draws, on the CUDA device.
    """

    def __init__(self, step: Callable[[TransitionBatch], Tensor], generator: torch.Generator) -> None:
        self._step, self._generator = step, generator
        self._graph: torch.cuda.CUDAGraph | None = None
        self._calls = 0
        self._given: TransitionBatch | None = None
        self._result: Tensor | None = None

    def __call__(self, batch: TransitionBatch) -> Tensor:
        """Take the step and return what it returns, as a tensor of its own."""
        with torch.cuda.device(self._generator.device):
            return self._on_device(batch)

    def _on_device(self, batch: TransitionBatch) -> Tensor:
        self._calls += 1
        if self._calls <= WARM_UP:
            # What is recorded later runs on a stream of its own, so its kernels are loaded on one.
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                result = self._step(batch)
            torch.cuda.current_stream().wait_stream(stream)
            return result
        if self._given is None:
            self._record(batch)
        assert self._graph is not None
        assert self._given is not None
        assert self._result is not None
        if any(_differ(mine, new) for mine, new in zip(self._given, batch, strict=True)):
            return self._step(batch)
        for mine, new in zip(self._given, batch, strict=True):
            if mine is not None and new is not None:
                mine.copy_(new)
        self._graph.replay()
        return self._result.clone()

    def _record(self, batch: TransitionBatch) -> None:
        """Record the step; nothing is computed yet."""
        copies = [cast(Tensor, None if tensor is None else tensor.clone()) for tensor in batch]
        self._given = TransitionBatch(*copies)
        self._graph = torch.cuda.CUDAGraph()
        self._graph.register_generator_state(self._generator)
        # A stream of this device: torch's usual one for recordings belongs to the first device that recorded.
        with torch.cuda.graph(self._graph, stream=torch.cuda.Stream()):
            self._result = self._step(self._given)


def _differ(mine: Tensor | None, new: Tensor | None) -> bool:
    if mine is None or new is None:
        return mine is not new
    return mine.shape != new.shape
