"""One gradient step: network, target network, optimiser and the step's random stream, savable as a whole."""

import copy
from typing import Any

import torch
from torch import Tensor

from rapid.config_learning import LossConfig, OptimizerConfig
from rapid.data.batch import TransitionBatch
from rapid.errors import RapidError
from rapid.losses import behavior_cloning_loss, q_loss
from rapid.networks.blocks import compiled_layers
from rapid.networks.q_network import QNetwork
from rapid.training.machinery.adam import Adam, clip_norm
from rapid.training.machinery.capture import CapturedStep

TERMS = ("td", "conservative", "robust", "total", "grad_norm")
"""What is recorded of every update; `grad_norm` is before clipping, and 0 where nothing is clipped. Of a stack, means
over its members."""


class Learner:
    """Trains the parameters of `network` that require a gradient; everything else stays as it is, bit for bit.

    Args:
        network: is trained in place. A stack's members learn as they would alone, each from its part of every batch,
            with a loss that :func:`rapid.training.offline.is_stackable` allows.
        config: the optimiser.
        loss: the loss.
        updates: gradient steps that are planned; the step size falls to zero over them if `config.linear_decay`.
        generator: for the random start of the inner attack, on the network's device.
    """

    def __init__(
        self, network: QNetwork, config: OptimizerConfig, loss: LossConfig, updates: int, generator: torch.Generator
    ) -> None:
        self.network, self.config, self.loss, self.planned = network, config, loss, updates
        self.target = copy.deepcopy(network).requires_grad_(False)
        self.generator = generator
        self.updates = 0
        trained = {name: parameter for name, parameter in network.named_parameters() if parameter.requires_grad}
        self._trained: list[Tensor] = list(trained.values())
        # The same parameters of both networks; frozen ones never differ.
        targets = dict(self.target.named_parameters())
        self._targets: list[Tensor] = [targets[name] for name in trained]
        rates = [config.gate_rate if parameter is network.gate else 1.0 for parameter in self._trained]
        self._adam = Adam(self._trained, rates)
        self._terms: list[Tensor] = []
        self._step_size: Tensor | None = None
        self._step = self._take_step
        device = self._trained[0].device
        if device.type == "cuda":
            # A recorded step reads its size from here; a number would be recorded with it.
            self._step_size = torch.zeros((), device=device)
            self._step = CapturedStep(self._take_step, generator)

    @property
    def learning_rate(self) -> float:
        """Step size of the next update."""
        left = 1 - self.updates / max(self.planned, 1) if self.config.linear_decay else 1.0
        return self.config.learning_rate * max(left, 0.0)

    def update(self, batch: TransitionBatch) -> None:
        """Take one gradient step on the batch (paper: equation 5)."""
        if self._step_size is not None:
            self._step_size.fill_(self.learning_rate)
        with compiled_layers(self.network, self.target):
            # Kept as a tensor: asking for its value would make every step wait for the device.
            self._terms.append(self._step(batch))
        self.updates += 1
        if self.updates % self.config.target_update == 0:
            self._update_target()

    def _take_step(self, batch: TransitionBatch) -> Tensor:
        """Move the weights and return the terms of the loss, as `TERMS` names them."""
        if self.config.algorithm == "bc":
            loss = behavior_cloning_loss(self.network, batch, teacher_only=self.loss.robust_on == "teacher")
        else:
            loss = q_loss(self.network, self.target, batch, self.loss, self.generator)
        # A weight that this batch has no use for gets the gradient 0: the same as if it had been used in vain.
        # The mean over a stack's batch has each member's own mean for a share only.
        members = self.network.members
        total = loss.total if members == 1 else loss.total * members
        gradients = torch.autograd.grad(total, self._trained, materialize_grads=True)
        norm = torch.zeros_like(total)
        if self.config.max_grad_norm:
            norm = clip_norm(gradients, self.config.max_grad_norm, members).mean()
        self._adam.step(gradients, self.learning_rate if self._step_size is None else self._step_size)
        return torch.stack([*loss, norm]).detach()

    @torch.no_grad()
    def _update_target(self) -> None:
        # One call for all weights, as torch's own optimisers do it; there is no public name for these.
        if self.config.target_rate == 1:
            torch._foreach_copy_(self._targets, self._trained)  # pyright: ignore[reportPrivateUsage]
        else:
            torch._foreach_lerp_(self._targets, self._trained, self.config.target_rate)  # pyright: ignore[reportPrivateUsage]

    def means(self) -> dict[str, float]:
        """Return the mean of every term over the updates since the last call, and forget them; empty after none.

        Raises:
            RapidError: a term or a weight is not finite; the message says where it began.
        """
        if not self._terms:
            return {}
        terms_UT = torch.stack(self._terms).cpu()
        bad_U = ~terms_UT.isfinite().all(1)
        if bad_U.any():
            row = int(bad_U.int().argmax())
            names = [name for name, term in zip(TERMS, terms_UT[row], strict=True) if not term.isfinite()]
            number = self.updates - len(terms_UT) + row + 1
            raise RapidError(
                f"Training stopped at update {number}: {', '.join(names)} is not finite. Lower "
                "optimizer.learning_rate, or set optimizer.max_grad_norm."
            )
        if not all(bool(parameter.isfinite().all()) for parameter in self._trained):
            raise RapidError(
                f"Training stopped at update {self.updates}: a weight is not finite. Lower optimizer.learning_rate, or "
                "set optimizer.max_grad_norm."
            )
        self._terms.clear()
        return dict(zip(TERMS, terms_UT.double().mean(0).tolist(), strict=True))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs; call `means` first, the recorded terms are not in it."""
        return {
            "network": self.network.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": self._adam.state_dict(),
            "generator": self.generator.get_state(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Become as the learner was whose `state_dict` this is.

        Raises:
            RapidError: it was on another kind of device, whose random numbers go on elsewhere.
        """
        check_generator(self.generator, state["generator"])
        self.network.load_state_dict(state["network"])
        self.target.load_state_dict(state["target"])
        self._adam.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"])
        self.updates = state["updates"]


def check_generator(generator: torch.Generator, state: Tensor) -> None:
    """Raise RapidError if `state` is that of a generator on another kind of device, whose numbers go on elsewhere."""
    if len(state) != len(generator.get_state()):
        raise RapidError(
            "The checkpoint was made on another kind of device. Go on with the --device that the training began "
            "with, or train in another directory."
        )
