"""What is watched during phase 3 beside the score: forgetting, and how far the gate has opened."""

from typing import cast

import torch

from rapid.data.transitions import Transitions
from rapid.networks.q_network import QNetwork
from rapid.seeding import numpy_stream

FORGETTING_STATES = 1_000
"""Offline states on which agreement with the distilled policy is measured."""


class Forgetting:
    """On which share of the offline data's states a network still acts as the distilled one did."""

    def __init__(self, distilled: QNetwork, offline: Transitions | None, seed: int) -> None:
        count = len(offline) if offline is not None else 0
        self._obs_BVF: torch.Tensor | None = None
        if offline is None or not count:
            return
        rows = numpy_stream(seed, "adapt/forgetting").permutation(count)[:FORGETTING_STATES]
        self._obs_BVF = torch.from_numpy(offline.obs_NVF[rows]).to(next(distilled.parameters()).device)
        if distilled.memory is not None:
            self._obs_BVF = None
            return
        self._action_B = self._greedy(distilled)

    def agreement(self, network: QNetwork) -> float | None:
        """Return the share; None without offline data, or for a network with a memory, of which such data has none."""
        if self._obs_BVF is None or network.memory is not None:
            return None
        return float((self._greedy(network) == self._action_B).double().mean())

    @torch.inference_mode()
    def _greedy(self, network: QNetwork) -> torch.Tensor:
        return network(self._obs_BVF).argmax(1)


def gate_size(network: QNetwork) -> float | None:
    """Return the mean of |g| over adapters and vehicles; None for a network without a zero gate."""
    gate = getattr(getattr(network.head, "mixture", None), "gate_NV", None)
    return float(cast(torch.Tensor, gate).detach().abs().mean()) if gate is not None and gate.numel() else None
