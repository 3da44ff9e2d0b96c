"""Agents as ONNX: one file that any ONNX runtime drives with, no RAPID and no torch needed.

The model reads `obs` (batch, V, 5), float32, raw as the environment gives it, and returns `q` (batch, 5).
"""

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rapid import files
from rapid.agents.onnx_graph import build_model
from rapid.agents.saved import QAgent, check_observations
from rapid.errors import RapidError
from rapid.scenarios import ACTIONS, FEATURES, MAX_VEHICLES, MIN_VEHICLES, NUM_FEATURES, NUM_VEHICLES, seeing

METADATA_KEY = "rapid"
TOLERANCE = 1e-4
"""Largest difference allowed between the Q-values of the exported model and the network, relative to their size."""


class OnnxAgent:
    """Drives greedily by an ONNX model, on one thread.

    Args:
        path: the model, made by :func:`export_onnx` or by anyone: its one input takes observations (batch, V, 5),
            flattened or not, and its first output gives Q-values (batch, 5).
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
        if len(inputs) != 1 or not found:
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
        self.flat = len(shape) == 2
        self.name = name or Path(path).stem
        self.metadata: dict[str, Any] = json.loads(
            self.session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "{}")
        )

    @property
    def mirrored_lanes(self) -> int | None:
        """On roads with how many lanes left is as good as right to it; None where it tells them apart."""
        return self.metadata.get("mirrored_lanes")

    def act(self, obs_BVF: np.ndarray) -> np.ndarray:
        """Return the greedy actions (B,), int64.

        Raises:
            RapidError: the observations have the wrong shape or are not finite.
        """
        return self.q_values(obs_BVF).argmax(1)

    def q_values(self, obs_BVF: np.ndarray) -> np.ndarray:
        """Return the Q-values (B, A), float32.

        Raises:
            RapidError: the observations have the wrong shape or are not finite.
        """
        obs_BVF = check_observations(obs_BVF, self.name, self.vehicles)
        values = obs_BVF.reshape(len(obs_BVF), -1) if self.flat else obs_BVF
        return np.asarray(self.session.run([self.output], {self.input: values})[0])


class Parity(NamedTuple):
    """How an exported model compares with its network."""

    observations: int
    """Observations compared."""
    difference: float
    """The largest difference between Q-values."""
    agreement: float
    """Share of observations on which both are greedy for the same action."""


def export_onnx(agent: QAgent, path: str | os.PathLike[str], obs_BVF: np.ndarray) -> Parity:
    """Write an agent's network as ONNX and compare the two on given observations.

    Adapters that a closed gate shuts out are left out of the file.

    Args:
        agent: the agent.
        path: the file; written only if the comparison succeeds.
        obs_BVF: real observations (B, V, F) for the comparison.

    Raises:
        RapidError: the extra `export` is not installed, there are no observations, or the exported model gives other
            Q-values or actions.
    """
    _import_onnxruntime()
    try:
        import onnx
    except ImportError as error:
        raise RapidError("Exporting needs onnx. Install it: pip install 'rapid-driving[export]'") from error
    obs_BVF = check_observations(obs_BVF, agent.name, agent.vehicles)
    if not len(obs_BVF):
        raise RapidError("There are no observations to compare the exported model on. Give a dataset with transitions.")
    network = agent.network
    description = {
        "name": agent.name,
        "lanes": network.lanes,
        "features": FEATURES,
        "actions": ACTIONS,
        "mirrored_lanes": agent.mirrored_lanes,
    }
    model = build_model(network)
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(description)})
    with files.atomic_path(path) as temporary:
        onnx.save(model, os.fspath(temporary))
        expected = agent.q_values(obs_BVF)
        exported = OnnxAgent(temporary, agent.name).q_values(obs_BVF)
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


def driven_observations(agent: QAgent, scenario: str, seeds: Sequence[int]) -> np.ndarray:
    """Return every observation (B, V, F) that the agent meets in one episode of each spawn seed."""
    from rapid.simulator import make_vec

    worlds: Any = make_vec(scenario, len(seeds), autoreset=False, config=seeing(agent.vehicles))
    obs_WVF, _ = worlds.reset(seed=list(seeds))
    met, running_W = [np.array(obs_WVF)], np.ones(len(seeds), np.bool_)
    while running_W.any():
        obs_WVF, _, terminated_W, truncated_W, _ = worlds.step(agent.act(met[-1]))
        met.append(np.array(obs_WVF))
        running_W &= ~(terminated_W | truncated_W)
    worlds.close()
    return np.concatenate(met)


def latency(path: str | os.PathLike[str], obs_VF: np.ndarray, calls: int = 2_000) -> float:
    """Return the median seconds of one decision at batch 1 on one thread, the array in and the action out."""
    agent = OnnxAgent(path)
    session, obs_BVF = agent.session, check_observations(obs_VF[None], agent.name, agent.vehicles)
    inputs = {agent.input: obs_BVF.reshape(1, -1) if agent.flat else obs_BVF}
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
        raise RapidError("ONNX needs onnxruntime. Install it: pip install 'rapid-driving[export]'") from error
    return onnxruntime
