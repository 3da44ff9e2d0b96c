"""The training losses: temporal difference, conservative and robust term (paper: equations 2 to 5), and PPO's.

Pure functions of tensors. Shapes: B transitions, V vehicles, F features, A actions.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from rapid.attacks.gradient import maximize_loss
from rapid.config_learning import LossConfig
from rapid.data.batch import TransitionBatch
from rapid.errors import RapidError
from rapid.networks.q_network import QNetwork
from rapid.scenarios import NUM_ACTIONS

LOG_FLOOR = -1.0
"""Least temperature * log-probability that a Munchausen target adds, before its weight (Vieillard et al., 2020)."""


class QLoss(NamedTuple):
    """The terms of a loss before their weights, and the weighted total; scalars."""

    td: Tensor
    conservative: Tensor
    robust: Tensor
    total: Tensor


def q_loss(
    network: QNetwork,
    target_network: QNetwork,
    batch: TransitionBatch,
    config: LossConfig,
    generator: torch.Generator,
) -> QLoss:
    """Return J = TD + alpha * conservative + beta * robust (paper: equation 5); terms of weight 0 are 0, not computed.

    Args:
        network: the network being trained; the gradient flows to its weights alone.
        target_network: its slow copy.
        batch: the transitions.
        config: weights and kinds of the terms.
        generator: for the random start of the inner attack.

    Raises:
        RapidError: soft labels are asked for, but the batch has none.
    """
    if config.munchausen_weight:
        target_B = munchausen_target(target_network, batch, config.munchausen_weight, config.munchausen_temperature)
    else:
        target_B = td_target(network, target_network, batch, config.double)
    zero = torch.zeros((), device=target_B.device)
    attacked = _attack(network, batch, config, generator) if config.robust_weight else None
    if attacked is None:
        q_BA, robust = network(batch.obs_BVF), zero
    else:
        # One pass over the clean and the attacked observations is faster than two.
        attacked_obs, labels, weights = attacked
        q_BA, attacked_q = network(torch.cat([batch.obs_BVF, attacked_obs])).split([len(target_B), len(labels)])
        robust = cross_entropy(attacked_q, labels, config.temperature, weights)
    td = td_loss(q_BA, batch.action_B, target_B, config.td_error)
    conservative = conservative_loss(q_BA, batch.action_B) if config.conservative_weight else zero
    total = td + config.conservative_weight * conservative + config.robust_weight * robust
    return QLoss(td, conservative, robust, total)


@torch.no_grad()
def td_target(
    network: Callable[[Tensor], Tensor],
    target_network: Callable[[Tensor], Tensor],
    batch: TransitionBatch,
    double: bool,
) -> Tensor:
    """Return r + bootstrap * max_a Q_target(s', a) (B,); with `double`, `network` chooses a (paper: equation 2)."""
    next_q_BA = target_network(batch.next_obs_BVF)
    next_value_B = _taken(next_q_BA, network(batch.next_obs_BVF).argmax(1)) if double else next_q_BA.amax(1)
    return batch.reward_B + batch.bootstrap_B * next_value_B


@torch.no_grad()
def munchausen_target(
    target_network: Callable[[Tensor], Tensor], batch: TransitionBatch, weight: float, temperature: float
) -> Tensor:
    """Return the target of Munchausen DQN (B,), with pi = softmax(Q_target / temperature).

    r + weight * max(temperature * log pi(a|s), -1) + bootstrap * sum_a' pi(a'|s') (Q_target - temperature * log pi)(s',
    a'): equation 2 of Vieillard et al. (2020), "Munchausen Reinforcement Learning". Over n steps, the first action's
    probability alone is added.

    Args:
        target_network: the slow copy, which also gives the probabilities.
        batch: the transitions.
        weight: their alpha.
        temperature: their tau, in units of the reward.
    """
    # One pass over both ends of the transitions is faster than two.
    q_BA, next_q_BA = target_network(torch.cat([batch.obs_BVF, batch.next_obs_BVF])).chunk(2)
    log_taken_B = _taken((q_BA / temperature).log_softmax(1), batch.action_B)
    next_value_B = temperature * (next_q_BA / temperature).logsumexp(1)
    bonus_B = (temperature * log_taken_B).clamp_min(LOG_FLOOR)
    return batch.reward_B + weight * bonus_B + batch.bootstrap_B * next_value_B


def td_loss(q_BA: Tensor, action_B: Tensor, target_B: Tensor, kind: Literal["huber", "squared"]) -> Tensor:
    """Return the mean error of Q(s, a): Huber with threshold 1, or the square (paper: equation 2)."""
    taken_B = _taken(q_BA, action_B)
    return functional.huber_loss(taken_B, target_B) if kind == "huber" else functional.mse_loss(taken_B, target_B)


def conservative_loss(q_BA: Tensor, action_B: Tensor) -> Tensor:
    """Return the mean of logsumexp_a' Q(s, a') - Q(s, a), CQL's regulariser (paper: equation 4)."""
    return (q_BA.logsumexp(1) - _taken(q_BA, action_B)).mean()


def cross_entropy(q_BA: Tensor, labels_BA: Tensor, temperature: float = 1.0, weights_B: Tensor | None = None) -> Tensor:
    """Return the mean of -sum label log softmax(Q/T); for one-hot labels the KL divergence (paper: equation 5).

    With weights of 0 and 1 the mean is over the rows of weight 1; it is 0 where there are none.
    """
    loss_B = -(labels_BA * (q_BA / temperature).log_softmax(1)).sum(1)
    return loss_B.mean() if weights_B is None else (loss_B * weights_B).sum() / weights_B.sum().clamp_min(1)


def policy_gradient_loss(log_prob_B: Tensor, old_log_prob_B: Tensor, advantage_B: Tensor, clip: float) -> Tensor:
    """Return PPO's clipped objective, to be minimised (Schulman et al., 2017: equation 7).

    Advantages are brought to mean 0 and standard deviation 1 within the minibatch.
    """
    advantage_B = (advantage_B - advantage_B.mean()) / (advantage_B.std(correction=0) + 1e-8)
    ratio_B = (log_prob_B - old_log_prob_B).exp()
    return -torch.minimum(ratio_B * advantage_B, ratio_B.clamp(1 - clip, 1 + clip) * advantage_B).mean()


def behavior_cloning_loss(network: QNetwork, batch: TransitionBatch, teacher_only: bool = False) -> QLoss:
    """Return the cross-entropy of softmax(Q(s)) to the actions taken as the total; the other terms are 0.

    With `teacher_only` the mean is over the teacher's transitions; it is 0 where the batch has none.
    """
    loss_B = functional.cross_entropy(network(batch.obs_BVF), batch.action_B, reduction="none")
    chosen_B = batch.teacher_B.to(loss_B.dtype) if teacher_only else torch.ones_like(loss_B)
    total = (loss_B * chosen_B).sum() / chosen_B.sum().clamp_min(1)
    zero = torch.zeros_like(total)
    return QLoss(zero, zero, zero, total)


def _attack(
    network: QNetwork, batch: TransitionBatch, config: LossConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor | None] | None:
    """Return s~, labels and weights for the transitions that get the robust term, or None if there are none.

    Without weights every row counts.
    """
    labels_BA = functional.one_hot(batch.action_B, NUM_ACTIONS).to(batch.obs_BVF.dtype)
    if config.robust_labels == "soft":
        if batch.soft_BA is None:
            raise RapidError(
                "The robust term asks for soft labels, but the data has no action probabilities of the teacher. "
                "Set loss.robust_labels to 'hard', or collect data with a teacher that reports them."
            )
        labels_BA = torch.where(batch.soft_BA.isfinite().all(1, keepdim=True), batch.soft_BA, labels_BA)
    obs_BVF, weights_B = batch.obs_BVF, None
    if config.robust_on == "teacher" and obs_BVF.is_cuda:
        # To pick rows, Python would have to wait for their number; a GPU attacks all of them as fast as some.
        weights_B = batch.teacher_B.to(obs_BVF.dtype)
    elif config.robust_on == "teacher":
        obs_BVF, labels_BA = obs_BVF[batch.teacher_B], labels_BA[batch.teacher_B]
        if not len(obs_BVF):
            return None
    attacked = maximize_loss(network, obs_BVF, labels_BA, network.scale_F, config.robust, config.temperature, generator)
    return attacked, labels_BA, weights_B


def _taken(q_BA: Tensor, action_B: Tensor) -> Tensor:
    return q_BA.gather(1, action_B[:, None]).squeeze(1)
