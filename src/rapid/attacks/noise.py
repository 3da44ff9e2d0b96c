"""Random noise on observations, in normalised features (paper: section 4.5)."""

from typing import Literal

import torch
from torch import Tensor


def add_noise(
    obs_BVF: Tensor,
    scale_F: Tensor,
    kind: Literal["uniform", "gaussian"],
    size: float,
    attack_presence: bool,
    generator: torch.Generator,
) -> Tensor:
    """Return observations with independent noise on every feature of every row.

    Args:
        obs_BVF: the true observations, metres and m/s.
        scale_F: what 1 means in each normalised feature.
        kind: `uniform` within +-size, or `gaussian` with standard deviation `size`.
        size: in normalised features.
        attack_presence: whether the presence feature is changed too.
        generator: source of the noise.
    """
    if kind == "uniform":
        noise_BVF = torch.rand(obs_BVF.shape, generator=generator, device=generator.device) * 2 - 1
    else:
        noise_BVF = torch.randn(obs_BVF.shape, generator=generator, device=generator.device)
    noise_BVF = noise_BVF.to(obs_BVF.device) * (scale_F * size)
    if not attack_presence:
        noise_BVF[..., 0] = 0
    return obs_BVF + noise_BVF
