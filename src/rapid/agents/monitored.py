"""Two agents as one, with a monitor between them (:mod:`rapid.monitor`); and such agents on disk."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.agents import saved
from rapid.agents.open import check_road
from rapid.agents.q_agent import QAgent, check_observations
from rapid.agents.saved import CONFIG_FILE, MONITORED_FORMAT, WEIGHTS_FILE, noticed, remembers
from rapid.agents.shipped import agent_folder
from rapid.agents.specs import MONITORED
from rapid.agents.watchable import Watchable
from rapid.attacks.attack import network_of
from rapid.errors import RapidError
from rapid.evaluation.metrics import Kind
from rapid.files import read_json, sha256, write_bytes, write_json
from rapid.monitor import MonitoredNetwork, own_next, own_start
from rapid.networks.memory import STATE_SIZE
from rapid.scenarios import NUM_VEHICLES, get_scenario
from rapid.text import printable

VERSION = 1
CALM, WARY = "calm", "wary"
"""Where, within the directory of a saved one, the two agents lie."""


class MonitoredAgent(Watchable):
    """Drives by the calm agent until something that it sees cannot be true, and then by the wary one.

    Args:
        calm: an agent with a network: a saved one, perhaps behind a filter or a defence.
        wary: another.
        scenario: where it drives.
        metadata: what was saved with it; a `name` there is its own.

    Raises:
        RapidError: one of them has no network or is for another road, they read different numbers of vehicles, or the
            scenario has dynamics that a car's memory does not know.
    """

    kind: Kind = "learned"
    has_memory = True

    def __init__(self, calm: Any, wary: Any, scenario: str, metadata: dict[str, Any] | None = None) -> None:
        self.calm, self.wary, self.scenario, self.metadata = calm, wary, scenario, metadata or {}
        names = [str(getattr(agent, "name", type(agent).__name__)) for agent in (calm, wary)]
        self.name = str(self.metadata.get("name") or f"{MONITORED}{','.join(names)}")
        rows = [int(getattr(agent, "vehicles", NUM_VEHICLES)) for agent in (calm, wary)]
        if rows[0] != rows[1]:
            raise RapidError(
                f"'{names[0]}' reads {rows[0]} vehicles and '{names[1]}' {rows[1]}. A monitor needs two agents that "
                "read as many."
            )
        self.vehicles = rows[0]
        seen = get_scenario(scenario)
        if seen.dynamics != "v0":
            raise RapidError(
                f"A monitor knows how a car moves with the dynamics of highway-v0, and {scenario} has others, so that "
                "it would doubt everything. Drive it in a scenario without '-fast'."
            )
        for agent in (calm, wary):
            check_road(agent, scenario)
        size = calm.start(1).shape[1] if remembers(calm) else 0
        networks = _network(calm, names[0]), _network(wary, names[1])
        self.network = MonitoredNetwork(*networks, size, self.vehicles, seen.lanes).eval()
        self._size = self.start(1).shape[1]

    def __repr__(self) -> str:
        return f"<MonitoredAgent '{self.name}': {self.calm!r}, then {self.wary!r}>"

    @property
    def remembered_lanes(self) -> int:
        """On roads with how many lanes its memory is right."""
        return self.network.lanes

    def act(self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32] | None = None) -> NDArray[np.int64]:
        """Return the greedy actions (B,).

        Raises:
            RapidError: the observations or the states have the wrong shape, or are not finite.
        """
        return self.q_values(obs_BVF, state_BS).argmax(1)

    @torch.inference_mode()
    def q_values(
        self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Return the Q-values (B, A) of the policy that drives.

        Raises:
            RapidError: the observations or the states have the wrong shape, or are not finite.
        """
        return self.network(*self._given(obs_BVF, state_BS)).cpu().numpy()

    @torch.inference_mode()
    def doubts(self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32] | None = None) -> NDArray[np.bool_]:
        """Return whether the wary agent drives (B,).

        Raises:
            RapidError: the observations or the states have the wrong shape, or are not finite.
        """
        return self.network.doubts(*self._given(obs_BVF, state_BS)).cpu().numpy()

    def start(self, worlds: int) -> NDArray[np.float32]:
        """Return the states (B, S) with which episodes begin."""
        inner = [agent.start(worlds) for agent in (self.calm, self.wary) if remembers(agent)]
        return np.concatenate([own_start(worlds, self.vehicles, self.network.lanes), *inner], 1)

    def notice(self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the states (B, S) after this was seen."""
        own_BS, calm_BS, wary_BS = self._split(state_BS)
        own_BS[:, 0] = self.doubts(obs_BVF, state_BS)
        own_BS[:, 1 + STATE_SIZE :] = obs_BVF.reshape(len(obs_BVF), -1)
        return np.concatenate([own_BS, noticed(self.calm, obs_BVF, calm_BS), noticed(self.wary, obs_BVF, wary_BS)], 1)

    def remember(self, state_BS: NDArray[np.float32], action_B: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the states (B, S) after these actions."""
        own_BS, *inner = self._split(state_BS)
        moved = [
            agent.remember(inner_BS, action_B) if remembers(agent) else inner_BS
            for agent, inner_BS in zip((self.calm, self.wary), inner, strict=True)
        ]
        return np.concatenate([own_next(own_BS, action_B, self.network.lanes), *moved], 1)

    def _split(self, state_BS: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        own = self.network.own_size
        return np.split(state_BS.copy(), [own, own + self.network.calm_size], 1)

    def _given(self, obs_BVF: NDArray[np.float32], state_BS: NDArray[np.float32] | None) -> tuple[Tensor, Tensor]:
        obs_BVF = check_observations(obs_BVF, self.name, self.vehicles)
        if state_BS is None or state_BS.shape != (len(obs_BVF), self._size):
            raise RapidError(
                f"Agent '{self.name}' needs a state of shape {(len(obs_BVF), self._size)} beside the observations, but "
                f"was given {'none' if state_BS is None else state_BS.shape}: agent.start(worlds) gives the first."
            )
        return self._tensor(obs_BVF), self._tensor(state_BS)

    def _tensor(self, values: NDArray[np.float32]) -> Tensor:
        device = next(self.network.parameters()).device
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(device)


def _network(agent: Any, name: str) -> torch.nn.Module:
    network = network_of(agent)
    if network is None:
        raise RapidError(
            f"'{name}' has no network, and a monitor stands between two policies that have. Give a saved agent, alone "
            "or with shield:BOX: or a defence before it."
        )
    return network


def save_monitored(directory: str | os.PathLike[str], calm: Path, wary: Path, metadata: dict[str, Any]) -> None:
    """Write two saved agents with a monitor between them to `directory`, as ``calm``, ``wary`` and ``config.json``.

    Args:
        directory: made if needed; an agent already there is replaced.
        calm: the directory of a saved agent, or the name of one that is shipped.
        wary: that of another.
        metadata: plain JSON values: how it was made; `scenario` tells where it drives.

    Raises:
        RapidError: one of them cannot be read, drives nothing, or does not fit the other; `metadata` has no scenario;
            or the directory cannot be written.
    """
    if not isinstance(metadata.get("scenario"), str):
        raise RapidError("The metadata of a monitored agent must tell its scenario. Add it.")
    first, second = saved.load_agent(calm), saved.load_agent(wary)
    for agent in (first, second):
        if agent.metadata.get("adversary_of"):
            raise RapidError(f"'{agent.name}' is an adversary, which drives nothing. Give an agent that does.")
    MonitoredAgent(first, second, metadata["scenario"])
    folder = Path(directory)
    # All is read before anything is written: one may lie where the other goes.
    content = {
        name: {file: (agent_folder(source) / file).read_bytes() for file in (WEIGHTS_FILE, CONFIG_FILE)}
        for name, source in ((CALM, calm), (WARY, wary))
    }
    for name, parts in content.items():
        for file, data in parts.items():
            write_bytes(folder / name / file, data)
    (folder / WEIGHTS_FILE).unlink(missing_ok=True)
    weights = {name: sha256(folder / name / WEIGHTS_FILE) for name in content}
    write_json(
        folder / CONFIG_FILE,
        {"format": MONITORED_FORMAT, "version": VERSION, "weights_sha256": weights, "metadata": metadata},
    )


def is_monitored(directory: str | os.PathLike[str]) -> bool:
    """Whether :func:`save_monitored` wrote this directory, or a shipped agent of this name."""
    path = agent_folder(directory) / CONFIG_FILE
    if not path.is_file():
        return False
    config = read_json(path, "agent")
    return isinstance(config, dict) and config.get("format") == MONITORED_FORMAT


def load_monitored(directory: str | os.PathLike[str], device: str = "cpu") -> MonitoredAgent:
    """Read what :func:`save_monitored` wrote.

    Raises:
        RapidError: it is damaged, of another version, or does not fit this program.
    """
    folder = agent_folder(directory)
    config = read_json(folder / CONFIG_FILE, "agent")
    metadata = config.get("metadata")
    if config.get("version") != VERSION:
        raise RapidError(
            f"The agent '{folder}' has format version {config.get('version')}, but this program reads version "
            f"{VERSION}. Use the program's version that wrote it, or make it again."
        )
    if not isinstance(metadata, dict) or not isinstance(metadata.get("scenario"), str):
        raise RapidError(f"The agent '{folder}' is damaged: {CONFIG_FILE} does not tell its scenario. Save it again.")
    metadata["name"] = printable(str(metadata.get("name") or folder.resolve().name))
    for name in (CALM, WARY):
        weights = folder / name / WEIGHTS_FILE
        if not weights.is_file() or config.get("weights_sha256", {}).get(name) != sha256(weights):
            raise RapidError(
                f"The agent '{folder}' is damaged: '{name}' is not the agent that it was saved with. Save it again."
            )
    calm, wary = (saved.load_agent(folder / name, device) for name in (CALM, WARY))
    return MonitoredAgent(calm, wary, metadata["scenario"], metadata)


def load_agent(directory: str | os.PathLike[str], device: str = "cpu") -> QAgent | MonitoredAgent:
    """Read a saved agent, or one that is shipped (``shipped:lane-3-density-2/rapid``): one policy, or two of them.

    Args:
        directory: what :func:`rapid.agents.saved.save_agent` or :func:`save_monitored` wrote, or the shipped name.
        device: where its network goes.

    Raises:
        RapidError: there is no agent, or it is damaged, of another version, or does not fit this program.
    """
    return load_monitored(directory, device) if is_monitored(directory) else saved.load_agent(directory, device)
