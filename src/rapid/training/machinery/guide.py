"""What a policy is shown as it begins to learn under attack, so that it need not find it by trying.

Under attack a policy that learns by trying alone brakes for good before it finds what still pays there. Two things are
known that pay: where nobody lies, what the policy did before the attacks; where somebody does, a plan that is followed
without looking (the driver `blind`). The policy, which sees what the adversary leaves and remembers what a car knows by
itself, learns to do the one or the other by cross-entropy, in the states that it comes to itself: distillation (Rusu et
al., 2016) from a teacher who sees the truth (Chen et al., 2019: "Learning by Cheating"), while more and more of the
episodes are driven by the learner (DAgger; Ross et al., 2011).

Shapes: W worlds, V vehicles, F features, A actions, S entries of a state.
"""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.config_learning import PpoConfig
from rapid.networks.memory import STEPS
from rapid.networks.q_network import QNetwork
from rapid.scenarios import IDLE, NUM_ACTIONS

CERTAINTY = 0.99
"""Probability of the plan's action; the rest is shared by all, so that some chance is left to learn from later."""


class Guide:
    """Shows each world's policy the probabilities it is to have, and drives some of the episodes by them.

    Args:
        network: the policy whose actions are shown where nobody attacks, as it was before the attacks; it is copied.
        plan: the actions of an episode under attack; IDLE follows the last.
        config: T of the policy softmax(Q / T), and W.
        generator: the source of all its chance; whoever resumes sets its state.
    """

    def __init__(self, network: QNetwork, plan: Sequence[int], config: PpoConfig, generator: torch.Generator) -> None:
        self.network = copy.deepcopy(network).requires_grad_(False)
        self._temperature, self._generator = config.temperature, generator
        planned_T = torch.tensor([*plan, IDLE], device=generator.device)
        self._planned_TA = (1 - CERTAINTY) / NUM_ACTIONS + CERTAINTY * torch.eye(
            NUM_ACTIONS, device=generator.device
        ).index_select(0, planned_T)
        self.leads_W = torch.ones(config.num_envs, dtype=torch.bool, device=generator.device)
        """Whose episode is driven by what is shown; the others are driven by the learner."""
        self.left = 1.0
        """Share of its time that is left."""

    @torch.no_grad()
    def __call__(self, obs_WVF: Tensor, state_WS: Tensor, attacked_W: Tensor) -> Tensor:
        """Return the probabilities to be learned (W, A).

        Args:
            obs_WVF: the truth, as the policy would see it.
            state_WS: what the policy remembers.
            attacked_W: whose episode is attacked.
        """
        own_WA = (self.network(obs_WVF, state_WS) / self._temperature).softmax(1)
        step_W = state_WS[:, STEPS].long().clamp(max=len(self._planned_TA) - 1)
        return torch.where(attacked_W[:, None], self._planned_TA[step_W], own_WA)

    def drive(self, action_W: Tensor, shown_WA: Tensor) -> Tensor:
        """Return the actions (W,) that are taken: the learner's or, where the guide leads, drawn from what is shown."""
        drawn_W = torch.multinomial(shown_WA, 1, generator=self._generator).squeeze(1)
        return torch.where(self.leads_W, drawn_W, action_W)

    def begin(self, ended_W: NDArray[np.bool_]) -> None:
        """Draw anew who leads in the worlds whose episode has ended: ever fewer, and none in the second half."""
        drawn_W = (
            torch.rand(len(self.leads_W), generator=self._generator, device=self._generator.device) < 2 * self.left - 1
        )
        self.leads_W = torch.where(torch.from_numpy(ended_W).to(drawn_W.device), drawn_W, self.leads_W)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs."""
        return {"network": self.network.state_dict(), "leads": self.leads_W, "generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Become as the guide was whose `state_dict` this is."""
        self.network.load_state_dict(state["network"])
        self.leads_W = state["leads"]
        self._generator.set_state(state["generator"])
