"""Random noise on observations, in normalised features (paper: section 4.5)."""

from typing import Literal

import torch
from torch import Tensor

from rapid.attacks.draws import Source, normal, uniform


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
