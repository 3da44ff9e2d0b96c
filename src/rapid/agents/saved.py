"""Agents: what drives. And agents on disk: weights as safetensors, the rest as JSON, nothing that runs code."""

import dataclasses
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from rapid import files
from rapid.agents.q_agent import QAgent
from rapid.agents.shipped import agent_folder
from rapid.bounds import numbers
from rapid.config_io import apply_overrides
from rapid.config_learning import NetworkConfig
from rapid.errors import RapidError, sentence
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import QNetwork, build_network
from rapid.scenarios import ACTIONS, FEATURES
from rapid.text import printable

FORMAT = "rapid-agent"
MONITORED_FORMAT = "rapid-monitored-agent"
"""Of a directory with two agents and a monitor between them (:mod:`rapid.agents.monitored`)."""
VERSION = 1
CONFIG_FILE = "config.json"
WEIGHTS_FILE = "weights.safetensors"
NAME_LENGTH = 100
"""Characters of an agent's name that are shown."""
_DTYPES = {torch.float32: "F32", torch.float64: "F64", torch.int64: "I64", torch.bool: "BOOL"}
"""What safetensors calls the types of weights."""


class Agent(Protocol):
    """Anything that chooses actions from observations; of other than 15 vehicles, if it has an int `vehicles`.

    One that remembers has `has_memory` true, and :class:`RememberingAgent` says how it is driven.
    """

    @property
    def name(self) -> str:
        """The name shown in tables."""
        ...

    def act(self, obs_BVF: np.ndarray) -> np.ndarray:
        """Return the actions (B,), int64, for raw observations (B, V, F)."""
        ...


class RememberingAgent(Protocol):
    """An agent with a memory: a state (B, S) for each of B worlds, kept by whoever drives it.

    The state begins with the episode and moves on with each action. What depends on what was seen too is told it
    before, by a method ``notice(obs_BVF, state_BS)`` that returns the states; most have none.
    """

    has_memory: bool

    def start(self, worlds: int) -> np.ndarray:
        """Return the states (B, S), float32, with which episodes begin."""
        ...

    def act(self, obs_BVF: np.ndarray, state_BS: np.ndarray) -> np.ndarray:
        """Return the actions (B,), int64, for raw observations and states."""
        ...

    def remember(self, state_BS: np.ndarray, action_B: np.ndarray) -> np.ndarray:
        """Return the states (B, S) after these actions."""
        ...


def remembers(agent: Any) -> bool:
    """Whether an agent has a memory and is driven as a :class:`RememberingAgent`."""
    return bool(getattr(agent, "has_memory", False))


def noticed(agent: Any, obs_BVF: np.ndarray, state_BS: np.ndarray) -> np.ndarray:
    """Return an agent's states (B, S) after it was shown these observations."""
    return agent.notice(obs_BVF, state_BS) if callable(getattr(agent, "notice", None)) else state_BS


def moved_on(agent: Any, obs_BVF: np.ndarray, state_BS: np.ndarray, action_B: np.ndarray) -> np.ndarray:
    """Return an agent's states (B, S) after it was shown these observations and took these actions."""
    return agent.remember(noticed(agent, obs_BVF, state_BS), action_B)


def remembered(agent: Any, action_T: Sequence[int] | np.ndarray) -> np.ndarray | None:
    """Return an agent's states (T + 1, S) before each action of an episode and after the last; None without memory.

    It is one whose memory does not depend on what was seen.
    """
    if not remembers(agent):
        return None
    states = [agent.start(1)]
    for action in action_T:
        states.append(agent.remember(states[-1], np.array([action], np.int64)))
    return np.concatenate(states)


def save_agent(directory: str | os.PathLike[str], network: QNetwork, metadata: dict[str, Any]) -> None:
    """Write a network to `directory`, as ``config.json`` and ``weights.safetensors``.

    Args:
        directory: made if needed; an agent already there is replaced.
        network: the network.
        metadata: plain JSON values: how it was made.

    Raises:
        RapidError: the directory cannot be written, or `network` is a stack.
    """
    if network.is_stack:
        raise RapidError("A stack is several agents. Save each of those that `unstack_networks` returns.")
    folder = Path(directory)
    # A clone each, since safetensors refuses tensors that share memory.
    weights = {key: value.detach().cpu().contiguous().clone() for key, value in network.state_dict().items()}
    files.write_bytes(folder / WEIGHTS_FILE, save(weights))
    files.write_json(
        folder / CONFIG_FILE,
        {
            "format": FORMAT,
            "version": VERSION,
            "network": dataclasses.asdict(network.config),
            "lanes": network.lanes,
            "features": list(FEATURES),
            "ranges": [float(value) for value in network.scale_F],
            "vehicles": network.config.vehicles,
            "actions": list(ACTIONS),
            "weights_sha256": files.sha256(folder / WEIGHTS_FILE),
            "metadata": metadata,
        },
    )


def load_agent(directory: str | os.PathLike[str], device: str = "cpu") -> QAgent:
    """Read an agent that :func:`save_agent` wrote, or one that is shipped (``shipped:lane-3-density-2/rapid``).

    It is called after its directory unless its metadata has a `name`.

    Raises:
        RapidError: there is no agent, or it is damaged, of another version, or does not fit this program.
    """
    folder = agent_folder(directory)
    if not (folder / CONFIG_FILE).is_file():
        raise RapidError(
            f"There is no saved agent at '{directory}'. Wanted is a directory that `rapid distill` or `rapid adapt` "
            "wrote, or shipped:NAME (`rapid agents list`). Drivers by name and ONNX files have no network for this."
        )
    config = files.read_json(folder / CONFIG_FILE, "agent")
    if isinstance(config, dict) and config.get("format") == MONITORED_FORMAT:
        raise RapidError(
            f"The agent '{directory}' is two policies with a monitor between them, and one is wanted here. Give "
            f"'{folder / 'calm'}', which drives while nothing that is seen contradicts, or '{folder / 'wary'}'."
        )
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise RapidError(f"'{folder / CONFIG_FILE}' does not describe an agent. Give the directory of a saved agent.")
    if config.get("version") != VERSION:
        raise RapidError(
            f"The agent '{folder}' has format version {config.get('version')}, but this program reads version "
            f"{VERSION}. Use the program's version that wrote it, or train it again."
        )
    spaces = {"features": list(FEATURES), "actions": list(ACTIONS)}
    for key, expected in spaces.items():
        if config.get(key) != expected:
            raise RapidError(
                f"The agent '{folder}' was made for {key} {config.get(key)}, but this program has {expected}. "
                "It cannot drive here."
            )
    lanes, metadata = config.get("lanes"), config.get("metadata")
    if (
        type(lanes) is not int
        or lanes < 1
        or not isinstance(config.get("network"), dict)
        or not isinstance(metadata, dict)
    ):
        raise RapidError(
            f"The agent '{folder}' is damaged: {CONFIG_FILE} lacks network, lanes or metadata. Save it again."
        )
    ranges = feature_scale(lanes).tolist()
    if config.get("ranges") != ranges:
        raise RapidError(
            f"The agent '{folder}' reads features in ranges {config.get('ranges')}, but on {lanes} lanes this program "
            f"has {ranges}. Use the program's version that wrote it, or train it again."
        )
    settings = apply_overrides(NetworkConfig(), config["network"], "network", f"'{folder / CONFIG_FILE}'")
    if config.get("vehicles") != settings.vehicles:
        raise RapidError(
            f"The agent '{folder}' is damaged: {CONFIG_FILE} has {config.get('vehicles')} vehicles, and a network that "
            f"reads {settings.vehicles}. Copy or train it again."
        )
    _check_bounds(settings, folder)
    _check_shapes(settings, lanes, folder)
    network = build_network(settings, lanes, seed=0)
    _load_weights(network, folder, config.get("weights_sha256"))
    name = printable(str(metadata.get("name") or folder.resolve().name))[:NAME_LENGTH]
    return QAgent(network.to(device).eval(), name, metadata)


def _check_bounds(settings: NetworkConfig, folder: Path) -> None:
    """Raise RapidError if a number in the settings of a network is none that the program itself would take."""
    for name, number, bounds in numbers(settings, "network."):
        if bounds is not None and not bounds.hold(number):
            raise RapidError(
                f"The agent '{folder}' is damaged: in {CONFIG_FILE} {name} is {number}, but must be {bounds}. Copy or "
                "train it again."
            )


def _check_shapes(settings: NetworkConfig, lanes: int, folder: Path) -> None:
    """Raise RapidError unless the weights on disk are those of such a network, as far as their header tells.

    Nothing of their size is allocated, neither of what the file names nor of what the settings ask for.
    """
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise RapidError(f"The agent '{folder}' has no {WEIGHTS_FILE}. Copy the whole directory of the agent.")
    try:
        with safe_open(path, "pt") as stream:
            slices = {key: stream.get_slice(key) for key in stream.keys()}  # noqa: SIM118
            found = {key: (list(part.get_shape()), part.get_dtype()) for key, part in slices.items()}
    except (SafetensorError, OSError) as error:
        raise RapidError(f"The weights '{path}' cannot be read: {error}. Copy or train the agent again.") from error
    parts = (settings.layers, settings.decoder_layers, settings.num_policies, len(settings.hidden))
    # Every one of these has weights of its own: more of them than there are tensors cannot be.
    fits = max(parts) <= len(found)
    if fits:
        try:
            with torch.device("meta"):
                expected = {key: (list(of.shape), _DTYPES[of.dtype]) for key, of in _empty(settings, lanes)}
        except (RuntimeError, ValueError, TypeError, OverflowError, KeyError) as error:
            raise RapidError(
                f"The agent '{folder}' is damaged: no network can be made as its {CONFIG_FILE} says: "
                f"{sentence(str(error).splitlines()[0])} Copy or train it again."
            ) from error
        fits = expected == found
    if not fits:
        raise RapidError(
            f"The weights '{path}' do not fit the network in {CONFIG_FILE}: other names, shapes or types. Copy or "
            "train the agent again."
        )


def _empty(settings: NetworkConfig, lanes: int) -> Iterable[tuple[str, Tensor]]:
    return build_network(settings, lanes, seed=0).state_dict().items()


def _load_weights(network: QNetwork, folder: Path, sha256: Any) -> None:
    path = folder / WEIGHTS_FILE
    try:
        weights = load_file(path)
    except (SafetensorError, OSError) as error:
        raise RapidError(f"The weights '{path}' cannot be read: {error}. Copy or train the agent again.") from error
    if files.sha256(path) != sha256:
        raise RapidError(f"The weights '{path}' are not those that {CONFIG_FILE} names. Copy or train the agent again.")
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise RapidError(
            f"The weights '{path}' do not fit the network in {CONFIG_FILE}: {str(error).splitlines()[-1].strip()} "
            "Copy or train the agent again."
        ) from error
    wrong = [key for key, value in network.state_dict().items() if not bool(value.isfinite().all())]
    if wrong:
        raise RapidError(
            f"The weights '{path}' are not all finite: {wrong[0]} holds NaN or infinity. The training went wrong or "
            "the file was edited; train the agent again."
        )
