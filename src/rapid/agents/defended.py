"""An agent behind a defence that needs no training (:mod:`rapid.defences`)."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.agents.monitored import MonitoredAgent
from rapid.agents.open import kind_of
from rapid.agents.q_agent import check_observations
from rapid.agents.saved import noticed, remembers
from rapid.attacks.attack import network_of
from rapid.defences import DefendedNetwork, make_defence
from rapid.errors import RapidError
from rapid.evaluation.metrics import Kind
from rapid.scenarios import NUM_VEHICLES, get_scenario


def defended(agent: Any, members: tuple[str, ...], scenario: str, seed: int = 0) -> "DefendedAgent":
    """Return an agent behind a defence, called after both; `agent` itself is left as it is.

    Args:
        agent: it tells its Q-values; if it has a network, gradient attacks see through both.
        members: what :func:`rapid.defences.make_defence` reads.
        scenario: where it drives.
        seed: of what the defence draws.

    Raises:
        RapidError: the agent has no Q-values, or there is no such defence.
    """
    name = str(getattr(agent, "name", type(agent).__name__))
    if isinstance(agent, MonitoredAgent):
        raise RapidError(
            f"'{name}' has a monitor, which would take for a lie what a defence makes of what is seen. Put the defence "
            "before one of the two policies: monitored:smooth:3:CALM,WARY."
        )
    if callable(getattr(agent, "bind", None)) or not callable(getattr(agent, "q_values", None)):
        raise RapidError(
            f"'{name}' tells no Q-values of what it sees, and the defences without training ask for them. Give a saved "
            "agent or an ONNX file; the filter shield:BOX: stands before any driver."
        )
    return DefendedAgent(agent, members, scenario, seed)


class DefendedAgent:
    """An agent whose Q-values are asked for through a defence; whatever else the agent has is found too."""

    def __init__(self, agent: Any, members: tuple[str, ...], scenario: str, seed: int = 0) -> None:
        self.agent, self.vehicles = agent, int(getattr(agent, "vehicles", NUM_VEHICLES))
        text = members[0] if len(members) == 1 else f"average:{'+'.join(members)}"
        self.name = f"{text}:{getattr(agent, 'name', type(agent).__name__)}"
        defence = make_defence(members, scenario, self.vehicles, seed)
        network = network_of(agent)
        self._through = DefendedNetwork(
            _Told(agent) if network is None else network, defence, get_scenario(scenario).lanes
        )
        if network is not None:
            defence.to(next(network.parameters()).device)
            self.network = self._through
        self.has_memory = bool(defence.size) or remembers(agent)

    @property
    def kind(self) -> Kind:
        """What kind of agent it is."""
        return kind_of(self.agent)

    def act(self, obs_BVF: NDArray[np.float32], *state: Any) -> NDArray[np.int64]:
        """Return the greedy actions (B,)."""
        return self.q_values(obs_BVF, *state).argmax(1)

    @torch.inference_mode()
    def q_values(self, obs_BVF: NDArray[np.float32], *state: Any) -> NDArray[np.float32]:
        """Return the Q-values (B, A)."""
        return self._through(self._tensor(obs_BVF), *map(self._state, state)).cpu().numpy()

    def start(self, worlds: int) -> NDArray[np.float32]:
        """Return the states (B, S) with which episodes begin."""
        own_BS = np.zeros((worlds, self._through.defence.size), np.float32)
        return np.concatenate([own_BS, self.agent.start(worlds)], 1) if remembers(self.agent) else own_BS

    @torch.inference_mode()
    def notice(self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the states (B, S) after this was seen."""
        defence = self._through.defence
        own, inner_BS = self._state(state_BS[:, : defence.size]), state_BS[:, defence.size :]
        seen = self._tensor(obs_BVF)
        if remembers(self.agent):
            inner_BS = noticed(self.agent, defence.passed(seen, own).cpu().numpy(), inner_BS)
        return np.concatenate([defence.notice(seen, own).cpu().numpy(), inner_BS], 1)

    def remember(self, state_BS: NDArray[np.float32], action_B: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the states (B, S) after these actions."""
        if not remembers(self.agent):
            return state_BS
        own_BS, inner_BS = np.split(state_BS, [self._through.defence.size], 1)
        return np.concatenate([own_BS, self.agent.remember(inner_BS, action_B)], 1)

    def _tensor(self, obs_BVF: NDArray[np.float32]) -> Tensor:
        return self._state(check_observations(obs_BVF, self.name, self.vehicles))

    def _state(self, values: NDArray[np.float32]) -> Tensor:
        weight = next(self._through.network.parameters(), torch.empty(0))
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(weight.device)

    def __getattr__(self, name: str) -> Any:
        if name in ("agent", "network", "bind", "decide", "explain", "metadata"):
            raise AttributeError(name)
        return getattr(self.agent, name)


class _Told(torch.nn.Module):
    """What an agent without a network says."""

    def __init__(self, agent: Any) -> None:
        super().__init__()
        self._agent = agent

    def forward(self, obs_BVF: Tensor, *state: Tensor) -> Tensor:
        told = self._agent.q_values(obs_BVF.numpy(), *(each.numpy() for each in state))
        return torch.from_numpy(np.array(told, np.float32))
