"""Agents as ONNX: one file that any ONNX runtime drives with, no RAPID and no torch needed.

The model reads `obs` (batch, V, 5), float32, raw as the environment gives it, and returns `q` (batch, 5). That of an
agent with a memory also reads `state` (batch, 6) and returns `next_state`, which is given back at the next step; an
episode begins with [0, 6, 25, 0, lanes - 1, 0] (:mod:`rapid.networks.memory`). The state of two policies with a monitor
between them is longer (:mod:`rapid.monitor`).
"""

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rapid import files
from rapid.agents.monitored import MonitoredAgent
from rapid.agents.onnx_monitor import build_monitored_model
from rapid.agents.onnx_network import build_model
from rapid.agents.q_agent import QAgent, check_observations
from rapid.agents.saved import NAME_LENGTH, moved_on, remembers
from rapid.agents.watchable import Watchable
from rapid.errors import RapidError, how_to_install, sentence
from rapid.monitor import own_next, own_size, own_start
from rapid.networks.memory import STATE_SIZE, initial_state, next_state
from rapid.scenarios import ACTIONS, FEATURES, MAX_VEHICLES, MIN_VEHICLES, NUM_FEATURES, NUM_VEHICLES, seeing
from rapid.text import printable

METADATA_KEY = "rapid"
STATE = "state"
"""The input of a model with a memory beside the observations."""
TOLERANCE = 1e-4
"""Largest difference allowed between the Q-values of the exported model and the network, relative to their size."""


class OnnxAgent(Watchable):
    """Drives greedily by an ONNX model, on one thread.

    Args:
        path: the model, made by :func:`export_onnx` or by anyone: its one input takes observations (batch, V, 5),
            flattened or not, and its first output gives Q-values (batch, 5). Where :func:`export_onnx` has given it a
            memory, it has `state` (batch, S) and `next_state` as well, and is driven as a
            :class:`~rapid.agents.saved.RememberingAgent`.
        name: the name shown in tables; the file's by default.

    Raises:
        RapidError: onnxruntime is not installed, or the file is missing, damaged or of other shapes.
    """

    def __init__(self, path: str | os.PathLike[str], name: str = "") -> None:
        runtime = _import_onnxruntime()
        if not Path(path).is_file():
            raise RapidError(f"There is no ONNX model at '{path}'. Check the path, or make it with `rapid export`.")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = runtime.ExecutionMode.ORT_SEQUENTIAL
        options.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_ENABLE_ALL
        options.log_severity_level = 3
        try:
            self.session = runtime.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base class that it exports.
            raise RapidError(f"The ONNX model '{path}' cannot be loaded: {error} Export it again.") from error
        inputs, outputs = self.session.get_inputs(), self.session.get_outputs()
        self.input, self.output = inputs[0].name, outputs[0].name
        shape = list(inputs[0].shape)
        sizes = range(MIN_VEHICLES, MAX_VEHICLES + 1)
        found = [size for size in sizes if shape[1:] in ([size, NUM_FEATURES], [size * NUM_FEATURES])]
        self.metadata = _metadata(self.session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "{}"), path)
        self.has_memory = bool(self.metadata.get("memory"))
        self.monitored = bool(self.metadata.get("monitored"))
        """Whether it is two policies with a monitor between them."""
        self._memories = int(self.metadata.get("memories", 1))
        """How many of its policies have a memory."""
        if [item.name for item in inputs[1:]] != [STATE] * self.has_memory or not found:
            raise RapidError(
                f"The ONNX model '{path}' reads {[(item.name, item.shape) for item in inputs]}, but an agent reads one "
                f"input of shape (batch, {NUM_VEHICLES}, {NUM_FEATURES}) or (batch, {NUM_VEHICLES * NUM_FEATURES}), or "
                f"of another number of vehicles up to {MAX_VEHICLES}. Export it with that input."
            )
        self.vehicles = found[0]
        if len(outputs[0].shape) != 2 or outputs[0].shape[1] != len(ACTIONS):
            raise RapidError(
                f"The ONNX model '{path}' returns shape {outputs[0].shape}, but an agent returns Q-values (batch, "
                f"{len(ACTIONS)}), one for each of {', '.join(ACTIONS)}. Export it with that output."
            )
        size = STATE_SIZE * self._memories + (own_size(self.vehicles) if self.monitored else 0)
        if self.has_memory and list(inputs[1].shape)[1:] != [size]:
            raise RapidError(
                f"The ONNX model '{path}' reads states of shape {inputs[1].shape}, but by what it says of itself they "
                f"are (batch, {size}). Export it again."
            )
        self.flat = len(shape) == 2
        self.name = printable(name or Path(path).stem)[:NAME_LENGTH]

    def __repr__(self) -> str:
        return f"<OnnxAgent '{self.name}': reads {self.vehicles} vehicles, {len(ACTIONS)} actions>"

    @property
    def mirrored_lanes(self) -> int | None:
        """On roads with how many lanes left is as good as right to it; None where it tells them apart."""
        return self.metadata.get("mirrored_lanes")

    @property
    def remembered_lanes(self) -> int | None:
        """On roads with how many lanes its memory is right; None where it has none."""
        return int(self.metadata["lanes"]) if self.has_memory else None

    @property
    def shielded_lanes(self) -> int | None:
        """For roads with how many lanes its safety filter is; None where it has none."""
        return self.metadata.get("shielded_lanes")

    def start(self, worlds: int) -> np.ndarray:
        """Return the states (B, S), float32, with which episodes begin."""
        lanes = int(self.metadata["lanes"])
        own = [own_start(worlds, self.vehicles, lanes)] if self.monitored else []
        return np.concatenate([*own, *[initial_state(worlds, lanes)] * self._memories], 1)

    def notice(self, obs_BVF: np.ndarray, state_BS: np.ndarray) -> np.ndarray:
        """Return the states (B, S) after this was seen, which only a monitor remembers."""
        if not self.monitored:
            return state_BS
        after_BS = self.session.run(["next_state"], self.inputs(obs_BVF, state_BS))[0]
        seen_BS = state_BS.copy()
        for part in (slice(1), slice(1 + STATE_SIZE, own_size(self.vehicles))):
            seen_BS[:, part] = after_BS[:, part]
        return seen_BS

    def remember(self, state_BS: np.ndarray, action_B: np.ndarray) -> np.ndarray:
        """Return the states (B, S) after these actions."""
        lanes, own = int(self.metadata["lanes"]), own_size(self.vehicles) if self.monitored else 0
        parts = np.split(state_BS[:, own:], self._memories, 1) if self._memories else []
        inner = [next_state(part_BS, action_B, lanes) for part_BS in parts]
        return np.concatenate([own_next(state_BS[:, :own], action_B, lanes) if own else state_BS[:, :0], *inner], 1)

    def act(self, obs_BVF: np.ndarray, state_BS: np.ndarray | None = None) -> np.ndarray:
        """Return the greedy actions (B,), int64.

        Raises:
            RapidError: the observations have the wrong shape or are not finite, or a state is missing or too much.
        """
        return self.q_values(obs_BVF, state_BS).argmax(1)

    def q_values(self, obs_BVF: np.ndarray, state_BS: np.ndarray | None = None) -> np.ndarray:
        """Return the Q-values (B, A), float32.

        Raises:
            RapidError: the observations have the wrong shape or are not finite, a state is missing or too much, or the
            model fails, or returns something else than finite Q-values.
        """
        inputs = self.inputs(obs_BVF, state_BS)
        try:
            values_BA = np.asarray(self.session.run([self.output], inputs)[0])
        except Exception as error:  # onnxruntime's errors share no base class that it exports.
            raise RapidError(f"The ONNX model '{self.name}' fails: {sentence(str(error))} Export it again.") from error
        expected = (len(obs_BVF), len(ACTIONS))
        if values_BA.shape != expected or values_BA.dtype != np.float32 or not np.isfinite(values_BA).all():
            raise RapidError(
                f"The ONNX model '{self.name}' returned {values_BA.dtype} of shape {values_BA.shape}"
                f"{'' if np.isfinite(np.asarray(values_BA, np.float64)).all() else ', not all finite'}; expected "
                f"finite float32 of shape {expected}. Export it again."
            )
        return values_BA

    def inputs(self, obs_BVF: np.ndarray, state_BS: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return what the model reads, by the names of its inputs.

        Raises:
            RapidError: the observations have the wrong shape or are not finite, or a state is missing or too much.
        """
        obs_BVF = check_observations(obs_BVF, self.name, self.vehicles)
        values = {self.input: obs_BVF.reshape(len(obs_BVF), -1) if self.flat else obs_BVF}
        if (state_BS is not None) != self.has_memory:
            raise RapidError(
                f"Agent '{self.name}' {'has a memory and needs' if self.has_memory else 'has no memory and takes no'} "
                "state beside the observations: agent.start(worlds) gives the first."
            )
        return values if state_BS is None else values | {STATE: np.ascontiguousarray(state_BS, np.float32)}


def _metadata(text: str, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what :func:`export_onnx` wrote into a model; nothing if somebody else made it.

    Raises:
        RapidError: it was edited or damaged.
    """
    try:
        found = json.loads(text)
        lanes = [found.get(key) for key in ("mirrored_lanes", "shielded_lanes", "lanes")]
        memories = found.get("memories", 1)
        counted = type(memories) is int and 0 <= memories <= 2
        known = all(of is None or (type(of) is int and of > 0) for of in lanes)
        if counted and known and (lanes[2] or not found.get("memory")):
            return found
    except (ValueError, AttributeError, RecursionError):
        pass
    raise RapidError(f"The ONNX model '{path}' has metadata that RAPID did not write. Export it again.")


class Parity(NamedTuple):
    """How an exported model compares with its network."""

    observations: int
    """Observations compared."""
    difference: float
    """The largest difference between Q-values."""
    agreement: float
    """Share of observations on which both are greedy for the same action."""


def export_onnx(
    agent: QAgent | MonitoredAgent,
    path: str | os.PathLike[str],
    obs_BVF: np.ndarray,
    state_BS: np.ndarray | None = None,
) -> Parity:
    """Write an agent's network as ONNX and compare the two on given observations.

    Adapters that a closed gate shuts out are left out of the file.

    Args:
        agent: the agent.
        path: the file; written only if the comparison succeeds.
        obs_BVF: real observations (B, V, F) for the comparison.
        state_BS: what is remembered beside them (B, S), by an agent with a memory; None is as at the beginning.

    Raises:
        RapidError: the extra `export` is not installed, there are no observations, or the exported model gives other
            Q-values or actions.
    """
    _import_onnxruntime()
    try:
        import onnx
    except ImportError as error:
        raise RapidError(f"Exporting needs onnx. Install it: {how_to_install('export')}") from error
    obs_BVF = check_observations(obs_BVF, agent.name, agent.vehicles)
    if not len(obs_BVF):
        raise RapidError("There are no observations to compare the exported model on. Give a dataset with transitions.")
    description: dict[str, Any] = {
        "name": agent.name,
        "scenario": agent.metadata.get("scenario"),
        "lanes": agent.network.lanes,
        "features": FEATURES,
        "actions": ACTIONS,
        "memory": agent.has_memory,
    }
    if isinstance(agent, MonitoredAgent):
        model = build_monitored_model(agent.network)
        description |= {"monitored": True, "memories": sum(map(remembers, (agent.calm, agent.wary)))}
    else:
        model = build_model(agent.network)
        description |= {
            "mirrored_lanes": agent.mirrored_lanes,
            "shielded_lanes": agent.shielded_lanes,
            "shield": agent.network.config.shield,
        }
    if agent.has_memory and state_BS is None:
        state_BS = agent.start(len(obs_BVF))
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(description)})
    with files.atomic_path(path) as temporary:
        onnx.save(model, os.fspath(temporary))
        expected = agent.q_values(obs_BVF, *(() if state_BS is None else (state_BS,)))
        exported = OnnxAgent(temporary, agent.name).q_values(obs_BVF, state_BS)
        difference = float(np.abs(exported - expected).max())
        allowed = TOLERANCE * max(1.0, float(np.abs(expected).max()))
        if not difference <= allowed:
            raise RapidError(
                f"The exported model's Q-values differ by {difference:.2g} from the agent's, more than {allowed:.2g}; "
                f"'{path}' was not written. Try another version of onnxruntime, and report this agent."
            )
        # Where two actions are equally good up to rounding, either is right.
        chosen_B = np.take_along_axis(expected, exported.argmax(1, keepdims=True), 1)[:, 0]
        wrong = int((expected.max(1) - chosen_B > 2 * allowed).sum())
        if wrong:
            raise RapidError(
                f"The exported model chooses another action on {wrong} of {len(obs_BVF)} observations; '{path}' was "
                "not written. Try another version of onnxruntime, and report this agent."
            )
    return Parity(len(obs_BVF), difference, float((exported.argmax(1) == expected.argmax(1)).mean()))


def driven_observations(agent: Any, scenario: str, seeds: Sequence[int]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return every observation (B, V, F) that the agent meets in one episode of each spawn seed.

    Beside them what it remembers there (B, S), if it has a memory.
    """
    from rapid.simulator import make_vec

    worlds: Any = make_vec(scenario, len(seeds), autoreset=False, config=seeing(agent.vehicles))
    obs_WVF, _ = worlds.reset(seed=list(seeds))
    met, running_W = [np.array(obs_WVF)], np.ones(len(seeds), np.bool_)
    states = [agent.start(len(seeds))] if agent.has_memory else []
    while running_W.any():
        action_W = agent.act(met[-1], *states[-1:])
        obs_WVF, _, terminated_W, truncated_W, _ = worlds.step(action_W)
        met.append(np.array(obs_WVF))
        if states:
            states.append(moved_on(agent, met[-2], states[-1], action_W))
        running_W &= ~(terminated_W | truncated_W)
    worlds.close()
    return np.concatenate(met), np.concatenate(states) if states else None


def latency(path: str | os.PathLike[str], obs_VF: np.ndarray, calls: int = 2_000) -> float:
    """Return the median seconds of one decision at batch 1 on one thread, the array in and the action out."""
    agent = OnnxAgent(path)
    session, inputs = agent.session, agent.inputs(obs_VF[None], agent.start(1) if agent.has_memory else None)
    warm_up, seconds = 100, list[float]()
    for _ in range(warm_up + calls):
        start = time.perf_counter()
        session.run([agent.output], inputs)[0].argmax()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds[warm_up:]))


def _import_onnxruntime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise RapidError(f"ONNX needs onnxruntime. Install it: {how_to_install('export')}") from error
    return onnxruntime
