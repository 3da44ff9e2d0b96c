"""Policy and critic of PPO, and what they learn from a rollout (Schulman et al., 2017).

Whoever drives is :mod:`rapid.training.ppo`.

Shapes: N transitions of a rollout, B a minibatch, V vehicles, F features, S entries of a state, A actions.
"""

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from rapid.config_learning import NetworkConfig, PpoConfig
from rapid.errors import RapidError
from rapid.losses import policy_gradient_loss
from rapid.networks.blocks import compiled_layers, spared_weights
from rapid.networks.denormals import no_denormals
from rapid.networks.q_network import QNetwork, build_network
from rapid.seeding import numpy_stream, stream_seed
from rapid.training.collector import Rollout
from rapid.training.machinery.adam import Adam, clip_norm

VALUE_SCALE = 10.0
"""By what the critic's output is multiplied: returns of 30 s reach some 30."""
VALUE, TERMS, SHOWN = ("value",), ("policy", "entropy", "kl"), ("shown", "follows")
"""What is recorded of every update of the critic, of the policy, and of the policy while a guide shows what to do. `kl`
estimates how far the policy has moved from the one that drove, `shown` is the cross-entropy to what is shown, `follows`
the share of greedy actions that are the shown ones."""


class PpoLearner:
    """Policy, critic and their optimisers, savable as a whole.

    Args:
        network: gives the policy; only its parameters that require a gradient are trained.
        config: the settings.
        gate_rate: by what the step size of the zero gate is multiplied.
        sees_clock: whether the policy is told the time, too.
        seed: of the critic's first weights and the minibatches.
        rollouts: how many are planned; the policy's step size falls to zero over them.
    """

    def __init__(
        self, network: QNetwork, config: PpoConfig, gate_rate: float, sees_clock: bool, seed: int, rollouts: int
    ) -> None:
        self.network, self.config, self.planned = network, config, rollouts
        self._sees_clock = sees_clock
        device = next(network.parameters()).device
        self.critic = build_network(_critic(network.config), network.lanes, stream_seed(seed, "ppo/critic")).to(device)
        self._trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
        self._critics = list(self.critic.parameters())
        rates = [gate_rate if parameter is network.gate else 1.0 for parameter in self._trained]
        self._adam, self._critic_adam = Adam(self._trained, rates), Adam(self._critics)
        self._rng = numpy_stream(seed, "ppo/minibatches")
        self._beside = torch.get_num_threads() > 1 and device.type == "cpu"
        self.rollouts = self.updates = self.taught = 0
        """Rollouts that were learned from, the minibatches in them, and rollouts from which the critic learned."""
        self._values: list[Tensor] = []
        self._terms: list[Tensor] = []
        self._shown: list[Tensor] = []

    @property
    def learning_rate(self) -> float:
        """The policy's step size with the next rollout; 0 while the critic learns what this policy is worth."""
        if self.taught * self.config.num_envs * self.config.rollout < self.config.critic_steps:
            return 0.0
        return self.config.learning_rate * max(1 - self.rollouts / self.planned, 0.0)

    @contextmanager
    def computing(self) -> Generator[None]:
        """Drive and learn within this: layers as the settings say, and torch with one thread wherever it is called.

        Torch's own threads wait for each other actively, which costs more than they gain with tensors of this size.
        """
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with compiled_layers(*((self.network, self.critic) if self.config.attention == "compiled" else ())):
                yield
        finally:
            torch.set_num_threads(threads)

    def as_seen(self, obs_BVF: Tensor) -> Tensor:
        """Return the observations as the policy may see them."""
        return obs_BVF if self._sees_clock else without_clock(obs_BVF)

    def q_values(self, seen_BVF: Tensor, state_BS: Tensor | None = None) -> Tensor:
        """Return the policy's Q-values (B, A); their gradient goes to what is seen, and not to compiled weights."""
        with spared_weights(*([self.network] if self.config.attention == "compiled" else [])):
            return self.network(seen_BVF, state_BS)

    def log_probs(self, seen_BVF: Tensor, state_BS: Tensor | None = None, first_BVD: Tensor | None = None) -> Tensor:
        """Return the policy's log-probabilities (B, A) = log softmax(Q / T) for what it sees and remembers.

        Policy 1's tokens, if they are given, need not be computed again (:meth:`QNetwork.frozen_tokens`).
        """
        return (self.network(seen_BVF, state_BS, first_BVD) / self.config.temperature).log_softmax(1)

    def values(self, obs_BVF: Tensor) -> Tensor:
        """Return what the critic expects until the end of the episode (B,)."""
        return VALUE_SCALE * self.critic(obs_BVF).mean(1)

    def update(self, rollout: Rollout, left: float = 1.0) -> None:
        """Learn from a rollout: several passes over it in minibatches.

        Where a guide showed what to do, the policy learns that and the critic nothing; the step size is that of the
        settings times `left`, the share of the guide's time that is left.

        Neither of policy and critic reads what the other learns, so in a process that may use several threads they
        learn beside each other; the result is the same, bit for bit.
        """
        count, device = len(rollout.action_N), rollout.obs_NVF.device
        orders = [torch.from_numpy(self._rng.permutation(count)).to(device) for _ in range(self.config.epochs)]
        minibatches = [rows_B for order_N in orders for rows_B in order_N.split(self.config.batch_size)]
        if rollout.shown_NA is not None:
            self._follow(rollout, minibatches, self.config.guide_rate * left)
        elif self._beside:
            with ThreadPoolExecutor(1) as other:
                critic = other.submit(no_denormals()(self._teach_critic), rollout, minibatches)
                self._teach_policy(rollout, minibatches)
                critic.result()
        else:
            self._teach_critic(rollout, minibatches)
            self._teach_policy(rollout, minibatches)
        self.updates += len(minibatches)
        self.rollouts += 1
        self.taught += rollout.shown_NA is None

    def _frozen_tokens(self, rollout: Rollout) -> Tensor | None:
        """Return what policy 1 makes of the whole rollout, where it is not trained: it is needed in every pass."""
        rows = torch.arange(len(rollout.action_N), device=rollout.action_N.device).split(self.config.batch_size)
        parts = [self.network.frozen_tokens(part.seen_NVF, part.state_NS) for part in map(rollout.rows, rows)]
        return None if parts[0] is None else torch.cat(cast(list[Tensor], parts))

    def _teach_critic(self, rollout: Rollout, minibatches: list[Tensor]) -> None:
        for rows_B in minibatches:
            value_B = self.values(rollout.obs_NVF[rows_B])
            value = (value_B - rollout.return_N[rows_B]).div(VALUE_SCALE).square().mean()
            gradients = torch.autograd.grad(value, self._critics, materialize_grads=True)
            clip_norm(gradients, self.config.critic_max_grad_norm)
            self._critic_adam.step(gradients, self.config.critic_rate)
            self._values.append(value.detach()[None])

    def _teach_policy(self, rollout: Rollout, minibatches: list[Tensor]) -> None:
        rate = self.learning_rate
        if not rate:
            return
        rollout = rollout._replace(first_NVD=self._frozen_tokens(rollout))
        for rows_B in minibatches:
            if not self._take_step(rollout.rows(rows_B), rate):
                break

    def _follow(self, rollout: Rollout, minibatches: list[Tensor], rate: float) -> None:
        """Move the policy towards what a guide showed, by cross-entropy."""
        for batch in map(rollout.rows, minibatches):
            shown_BA = cast(Tensor, batch.shown_NA)
            log_prob_BA = self.log_probs(batch.seen_NVF, batch.state_NS)
            loss = -(shown_BA * log_prob_BA).sum(1).mean()
            gradients = torch.autograd.grad(loss, self._trained, materialize_grads=True)
            clip_norm(gradients, self.config.max_grad_norm)
            self._adam.step(gradients, rate)
            follows = (log_prob_BA.detach().argmax(1) == shown_BA.argmax(1)).float().mean()
            self._shown.append(torch.stack([loss.detach(), follows]))

    def _take_step(self, batch: Rollout, rate: float) -> bool:
        """Move the policy; return whether it may go on, for it is not yet too far from the one that drove."""
        log_prob_BA = self.log_probs(batch.seen_NVF, batch.state_NS, batch.first_NVD)
        log_prob_B = log_prob_BA.gather(1, batch.action_N[:, None]).squeeze(1)
        with torch.no_grad():
            moved_B = log_prob_B - batch.log_prob_N
            # An estimate that is never below 0, of each transition (Schulman, 2020: "Approximating KL divergence").
            if self.config.largest_kl and (moved_B.exp() - 1 - moved_B).mean() > self.config.largest_kl:
                return False
        policy = policy_gradient_loss(log_prob_B, batch.log_prob_N, batch.advantage_N, self.config.clip)
        entropy = -(log_prob_BA.exp() * log_prob_BA).sum(1).mean()
        sought = policy - self.config.entropy * entropy if self.config.entropy else policy
        gradients = torch.autograd.grad(sought, self._trained, materialize_grads=True)
        clip_norm(gradients, self.config.max_grad_norm)
        self._adam.step(gradients, rate)
        self._terms.append(torch.stack([policy.detach(), entropy.detach(), -moved_B.mean()]))
        return True

    def means(self) -> dict[str, float]:
        """Return the mean of every term over the updates since the last call, and forget them.

        Raises:
            RapidError: a term or a weight is not finite.
        """
        means: dict[str, float] = {}
        weights = (*self._trained, *self._critics)
        finite = all(bool(weight.isfinite().all()) for weight in weights)
        for names, terms in ((VALUE, self._values), (TERMS, self._terms), (SHOWN, self._shown)):
            if terms:
                terms_UT = torch.stack(terms).cpu().double()
                finite &= bool(terms_UT.isfinite().all())
                means |= zip(names, terms_UT.mean(0).tolist(), strict=True)
            terms.clear()
        if not finite:
            raise RapidError(
                f"Training stopped by update {self.updates} of PPO: a loss or a weight is not finite. Lower "
                "adapt.ppo.learning_rate or adapt.ppo.critic_rate."
            )
        return means

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs; call `means` first, the recorded terms are not in it."""
        return {
            "network": self.network.state_dict(),
            "critic": self.critic.state_dict(),
            "adam": self._adam.state_dict(),
            "critic_adam": self._critic_adam.state_dict(),
            "rng": self._rng.bit_generator.state,
            "rollouts": self.rollouts,
            "updates": self.updates,
            "taught": self.taught,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Become as the learner was whose `state_dict` this is."""
        self.network.load_state_dict(state["network"])
        self.critic.load_state_dict(state["critic"])
        self._adam.load_state_dict(state["adam"])
        self._critic_adam.load_state_dict(state["critic_adam"])
        self._rng.bit_generator.state = state["rng"]
        self.rollouts, self.updates = state["rollouts"], state["updates"]
        # Earlier checkpoints counted all rollouts.
        self.taught = state.get("taught", self.rollouts)


def without_clock(obs_BVF: Tensor) -> Tensor:
    """Return observations of a scenario with a clock as those without one give them: the ego's presence is 1."""
    hidden_BVF = obs_BVF.clone()
    hidden_BVF[:, 0, 0] = 1
    return hidden_BVF


def _critic(config: NetworkConfig) -> NetworkConfig:
    """Return the settings of the critic's network: a single policy of the same size, or an MLP."""
    kind = "mlp" if config.kind.startswith("mlp") else "attentive"
    return replace(config, kind=kind, memory=False, squeeze=False)
