"""What a loss sees of the data: one batch of (n-step) transitions as tensors."""

from typing import NamedTuple

from torch import Tensor
from torch.nn import functional


class TransitionBatch(NamedTuple):
    """B transitions from t to t + n, where n is the number of rewards that could be summed without crossing an end."""

    obs_BVF: Tensor
    """float32, metres and m/s: what the driver saw at t."""
    action_B: Tensor
    """int64 in [0, A): what it did."""
    reward_B: Tensor
    """float32: r_t + gamma r_(t+1) + ... + gamma^(n-1) r_(t+n-1)."""
    next_obs_BVF: Tensor
    """float32: the real observation at t + n, also where the episode ended there."""
    bootstrap_B: Tensor
    """float32: what the value at t + n is multiplied by: gamma^n, or 0 if the episode terminated there.
    Truncation (the clock ran out) keeps gamma^n."""
    teacher_B: Tensor
    """bool: the teacher chose the action."""
    soft_BA: Tensor | None = None
    """float32: the teacher's probability of every action, rows of NaN where it gave none; None if nobody gave any."""


def with_rows(obs_BVF: Tensor, vehicles: int) -> Tensor:
    """Return observations with so many rows: the nearest vehicles, which come first, and after them absent ones."""
    missing = vehicles - obs_BVF.shape[1]
    # Padding by less than nothing cuts off.
    return functional.pad(obs_BVF, (0, 0, 0, missing)) if missing else obs_BVF
