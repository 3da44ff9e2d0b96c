"""Gradient attacks on observations, in normalised features (paper: sections 3.2 and 4.5).

An attack maximises the cross-entropy between softmax(Q(s~)/T) and labels within a ball around the true observation. For
evaluation the labels are the agent's own greedy actions; for the robust term of the loss, those of the data. Everything
is done on offsets in normalised features, which are added to the raw observation at the end.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from rapid.config_learning import RobustConfig
from rapid.networks.blocks import spared_weights
from rapid.networks.denormals import no_denormals

ROUNDING = 1e-5
"""Share of the radius left free, so that float32 metres, read back, still lie inside the ball."""


def maximize_loss(
    network: Callable[[Tensor], Tensor],
    obs_BVF: Tensor,
    labels_BA: Tensor,
    scale_F: Tensor,
    config: RobustConfig,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Return observations inside the ball on which the network fits the labels badly: projected gradient ascent.

    Each observation is attacked on its own. FGSM is one step as long as the radius.

    Args:
        network: raw observations (B, V, F) to Q-values (B, A).
        obs_BVF: the true observations, metres and m/s.
        labels_BA: probabilities of the actions to drive the network away from.
        scale_F: what 1 means in each normalised feature.
        config: norm, radius, steps, step size, random start, whether presence may change.
        temperature: T of the softmax over Q-values.
        generator: for the random start.
    """
    # Evaluation calls this from inference mode, in which no gradient could be taken.
    networks = [network] if isinstance(network, nn.Module) else []
    with torch.inference_mode(False), torch.enable_grad(), no_denormals(), spared_weights(*networks):
        obs_BVF, labels_BA = obs_BVF.detach().clone(), labels_BA.detach().clone()
        free_F = torch.ones_like(scale_F)
        if not config.attack_presence:
            free_F[:1].zero_()
        if config.random_start:
            offset_BVF = _random_offset(obs_BVF, free_F, config, generator)
        else:
            offset_BVF = torch.zeros_like(obs_BVF)
        for _ in range(config.steps):
            attacked_BVF = (obs_BVF + offset_BVF * scale_F).requires_grad_()
            loss = _cross_entropy(network(attacked_BVF) / temperature, labels_BA)
            (gradient_BVF,) = torch.autograd.grad(loss, attacked_BVF)
            step_BVF = _direction(gradient_BVF * (scale_F * free_F), config.norm) * config.step_size
            offset_BVF = _project(offset_BVF + step_BVF, config)
        return obs_BVF + offset_BVF * scale_F


def _cross_entropy(logits_BA: Tensor, labels_BA: Tensor) -> Tensor:
    """Return -sum label log softmax, with a gradient that stays exact however sure the network is.

    The usual form has the gradient p - 1 by the label's logit, which float32 rounds to 0 once p is near 1. This one is
    -log p_a = softplus(logsumexp over the others of z_j - z_a), where nothing cancels.
    """
    others_AA = torch.eye(logits_BA.shape[-1], device=logits_BA.device) * -1e30
    margins_BAA = logits_BA[:, None, :] - logits_BA[:, :, None] + others_AA
    return (labels_BA * functional.softplus(margins_BAA.logsumexp(-1))).sum()


def _direction(gradient_BVF: Tensor, norm: str) -> Tensor:
    """Return the steepest ascent of length 1 in `norm`; 0 where the gradient is 0."""
    if norm == "linf":
        return gradient_BVF.sign()
    # Scaling by the largest entry first keeps the squares of tiny gradients from vanishing.
    largest_B11 = gradient_BVF.abs().amax((1, 2), keepdim=True)
    scaled_BVF = gradient_BVF / torch.where(largest_B11 > 0, largest_B11, 1.0)
    length_B11 = scaled_BVF.square().sum((1, 2), keepdim=True).sqrt()
    return scaled_BVF / torch.where(length_B11 > 0, length_B11, 1.0)


def _project(offset_BVF: Tensor, config: RobustConfig) -> Tensor:
    """Return the nearest offset inside the ball."""
    radius = config.radius * (1 - ROUNDING)
    if config.norm == "linf":
        return offset_BVF.clamp(-radius, radius)
    length_B11 = offset_BVF.square().sum((1, 2), keepdim=True).sqrt()
    return offset_BVF * (radius / length_B11.clamp_min(radius)) if radius > 0 else torch.zeros_like(offset_BVF)


def _random_offset(obs_BVF: Tensor, free_F: Tensor, config: RobustConfig, generator: torch.Generator | None) -> Tensor:
    """Return offsets uniform in the ball, along the free features."""
    device = generator.device if generator is not None else obs_BVF.device
    if config.norm == "linf":
        noise_BVF = torch.rand(obs_BVF.shape, generator=generator, device=device) * 2 - 1
        offset_BVF = noise_BVF.to(obs_BVF.device) * free_F * config.radius
    else:
        noise_BVF = torch.randn(obs_BVF.shape, generator=generator, device=device).to(obs_BVF.device) * free_F
        share_B11 = torch.rand(obs_BVF.shape[0], 1, 1, generator=generator, device=device).to(obs_BVF.device)
        dimensions = obs_BVF.shape[1] * (obs_BVF.shape[2] - (not config.attack_presence))
        offset_BVF = _direction(noise_BVF, "l2") * config.radius * share_B11 ** (1 / dimensions)
    return _project(offset_BVF, config)
