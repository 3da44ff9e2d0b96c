"""Denormal numbers, in float32 those below 1.2e-38: processors are up to a hundred times slower at them.

The averages of a weight that gets no gradient, behind a unit that has died, fade into them: 3,000 updates of a baseline
on raw inputs take 1.3 (CQL) to 1.7 times (DQN) as long with them. So do the gradients of tokens that hardly anything
attends to: ten steps of an attack on an agent with raw inputs take three times as long.

The mode is a thread's own, and a thread begins with that of the thread that starts it. The threads among which torch
divides work are started once, by the first work that is large enough. If that is within :func:`no_denormals` they keep
the mode until the process ends; if it was before, they never have it, and leave to the calling thread alone to leave
denormal numbers out. NumPy and the compiled simulator, which has one thread, are not concerned, nor is torch with one
thread. Q-values, and what attacks find, come out the same: a number below 1.2e-38 vanishes in any sum of usual size. On
33,480 observations, driven, perturbed and empty, all shipped agents have the same Q-values, bit for bit, with denormal
numbers and without, although there are some in between; `fgsm` and `pgd` find the same perturbations with, without, and
with two threads of which one has the mode. So they are let be: only a training in a thread of its own, which signals do
not reach, would have threads of its own.
"""

from collections.abc import Generator
from contextlib import contextmanager

import torch

_LEAST = 5e-324
"""The smallest double, denormal."""


@contextmanager
def no_denormals() -> Generator[None]:
    """Let this thread count denormal numbers as zero, as a decorator or in a `with`.

    Trainings and gradient attacks compute so. Threads that torch starts meanwhile keep it, and those that it started
    before do not have it (see the module), which is one reason more why the number of threads belongs to what a run is.
    """
    before = _LEAST + 0 * _LEAST == 0  # there is no way to ask but to try
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
