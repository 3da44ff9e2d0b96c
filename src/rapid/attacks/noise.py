"""What is shown without asking the agent: random noise (paper: section 4.5), and constant lies."""

from typing import Literal

import torch
from torch import Tensor

from rapid.attacks.draws import Source, normal, uniform
from rapid.attacks.spec import Lie


def add_noise(obs_BVF: Tensor, size_VF: Tensor, kind: Literal["uniform", "gaussian"], source: Source) -> Tensor:
    """Return observations with independent noise on every feature of every row.

    Args:
        obs_BVF: the true observations, metres and m/s.
        size_VF: of each feature, in its own unit: the half width if `uniform`, the standard deviation if `gaussian`.
        kind: the distribution.
        source: of the noise.
    """
    device = obs_BVF.device
    noise_BVF = (
        uniform(obs_BVF.shape, source, device) * 2 - 1 if kind == "uniform" else normal(obs_BVF.shape, source, device)
    )
    return torch.where(size_VF > 0, obs_BVF + noise_BVF * size_VF, obs_BVF)


def lies(to: Lie, drawn_BVF: Tensor) -> Tensor:
    """Return offsets of -1, 0 and 1 by which all cars are misplaced alike, the ego the other way.

    Args:
        to: where the others are said to be.
        drawn_BVF: numbers in [0, 1); for `drawn` their sign decides where every feature of every row goes.
    """
    if to == "drawn":
        return (drawn_BVF - 0.5).sign()
    offset_F = torch.tensor(_LIES[to], device=drawn_BVF.device)
    offset_BVF = offset_F.expand(drawn_BVF.shape).clone()
    offset_BVF[:, 0] *= -1
    return offset_BVF


_LIES: dict[Lie, tuple[float, ...]] = {
    "far": (0, 1, 0, 1, 0),
    "near": (0, -1, 0, -1, 0),
    "left": (0, 0, -1, 0, -1),
    "right": (0, 0, 1, 0, 1),
}
