"""The agent that drives greedily by a Q-network, and what it takes for observations.

Shapes: B batch, V vehicles, F features, A actions, S entries of a state.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from rapid.agents.watchable import Watchable
from rapid.errors import RapidError
from rapid.networks.memory import initial_state, next_state
from rapid.networks.q_network import Explanation, QNetwork
from rapid.scenarios import FEATURES, NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES


class QAgent(Watchable):
    """Drives greedily by a Q-network; one with a memory is a :class:`~rapid.agents.saved.RememberingAgent`.

    Args:
        network: the network; it is used as it is, not copied.
        name: the name shown in tables.
        metadata: what was saved with the network.

    Raises:
        RapidError: the network is a stack of several.
    """

    def __init__(self, network: QNetwork, name: str = "agent", metadata: dict[str, Any] | None = None) -> None:
        if network.is_stack:
            raise RapidError("A stack is several agents. Take one of those that `unstack_networks` returns.")
        self.network, self.name, self.metadata = network, name, metadata or {}

    @property
    def vehicles(self) -> int:
        """V: rows that its observations have."""
        return self.network.config.vehicles

    @property
    def mirrored_lanes(self) -> int | None:
        """On roads with how many lanes left is as good as right to it; None where it tells them apart."""
        return self.network.lanes if self.network.config.mirror else None

    @property
    def remembered_lanes(self) -> int | None:
        """On roads with how many lanes its memory is right; None where it has none."""
        return self.network.lanes if self.has_memory else None

    @property
    def shielded_lanes(self) -> int | None:
        """For roads with how many lanes its safety filter is; None where it has none."""
        return self.network.lanes if self.network.config.shield else None

    @property
    def has_memory(self) -> bool:
        """Whether `act` and `q_values` take a state beside the observations."""
        return self.network.memory is not None

    def start(self, worlds: int) -> np.ndarray:
        """Return the states (B, S), float32, with which episodes begin."""
        return initial_state(worlds, self.network.lanes)

    def remember(self, state_BS: np.ndarray, action_B: np.ndarray) -> np.ndarray:
        """Return the states (B, S) after these actions."""
        return next_state(state_BS, action_B, self.network.lanes)

    def __repr__(self) -> str:
        weights = sum(weight.numel() for weight in self.network.parameters())
        return (
            f"<QAgent '{self.name}': reads {self.vehicles} vehicles on {self.network.lanes} lanes, "
            f"{weights:,} weights, {NUM_ACTIONS} actions>"
        )

    def act(self, obs_BVF: np.ndarray, state_BS: np.ndarray | None = None) -> np.ndarray:
        """Return the greedy actions (B,), int64.

        Raises:
            RapidError: the observations have the wrong shape or are not finite, or a state is missing or too much.
        """
        return self.q_values(obs_BVF, state_BS).argmax(1)

    @torch.inference_mode()
    def q_values(self, obs_BVF: np.ndarray, state_BS: np.ndarray | None = None) -> np.ndarray:
        """Return the Q-values (B, A), float32.

        Raises:
            RapidError: the observations have the wrong shape or are not finite, or a state is missing or too much.
        """
        return self.network(self._tensor(obs_BVF), self._state(state_BS)).cpu().numpy()

    def explain(self, obs_BVF: np.ndarray, state_BS: np.ndarray | None = None) -> Explanation:
        """Return the Q-values and the routing weights, gate and attention they rest on.

        Raises:
            RapidError: the observations have the wrong shape or are not finite, or a state is missing or too much.
        """
        return self.network.explain(self._tensor(obs_BVF), self._state(state_BS))

    def _state(self, state_BS: np.ndarray | None) -> Tensor | None:
        if state_BS is None:
            return None
        return torch.from_numpy(np.ascontiguousarray(state_BS, np.float32)).to(self.network.scale_F.device)

    def _tensor(self, obs_BVF: np.ndarray) -> Tensor:
        return torch.from_numpy(check_observations(obs_BVF, self.name, self.vehicles)).to(self.network.scale_F.device)


def check_observations(obs_BVF: np.ndarray, name: str, vehicles: int) -> np.ndarray:
    """Return the observations as contiguous float32 (B, V, F).

    Raises:
        RapidError: they have the wrong shape or are not finite.
    """
    obs_BVF = np.ascontiguousarray(obs_BVF, np.float32)
    if obs_BVF.shape == (vehicles, NUM_FEATURES):
        raise RapidError(
            f"Agent '{name}' was given one observation, of shape {obs_BVF.shape}, but reads a batch, "
            f"(batch, {vehicles}, {NUM_FEATURES}). Add a batch axis and take the first answer: agent.act(obs[None])[0]."
        )
    if obs_BVF.ndim != 3 or obs_BVF.shape[1:] != (vehicles, NUM_FEATURES):
        raise RapidError(
            f"Agent '{name}' was given observations of shape {obs_BVF.shape}, but reads (batch, {vehicles}, "
            f"{NUM_FEATURES}): {vehicles} vehicles with {', '.join(FEATURES)}. Use a scenario of rapid.scenarios"
            f"{f', with config=rapid.scenarios.seeing({vehicles})' if vehicles != NUM_VEHICLES else ''}."
        )
    if not np.isfinite(obs_BVF).all():
        world, vehicle, feature = (int(index) for index in np.argwhere(~np.isfinite(obs_BVF))[0])
        raise RapidError(
            f"Agent '{name}' was given an observation that is not finite: world {world}, vehicle {vehicle}, "
            f"{FEATURES[feature]} = {obs_BVF[world, vehicle, feature]}. Check what feeds the agent."
        )
    return obs_BVF
