"""Agents as ONNX: one file that any ONNX runtime drives with, no RAPID and no torch needed.

The model reads `obs` (batch, 15, 5), float32, raw as the environment gives it, and returns `q` (batch, 5).
"""

import contextlib
import io
import json
import logging
import os
import warnings
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rapid import files
from rapid.errors import RapidError
from rapid.networks.agent import QAgent, check_observations
from rapid.networks.q_network import QNetwork, TokenHead
from rapid.scenarios import ACTIONS, FEATURES, NUM_FEATURES, NUM_VEHICLES

METADATA_KEY = "rapid"
OPSET = 20
TOLERANCE = 1e-4
"""Largest difference allowed between the Q-values of the exported model and the network, relative to their size."""


class OnnxAgent:
    """Drives greedily by an ONNX model, on one thread.

    Args:
        path: the model, made by :func:`export_onnx` or by anyone: its one input takes observations (batch, 15, 5),
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
        options.log_severity_level = 3
        try:
            self._session = runtime.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no base class that it exports.
            raise RapidError(f"The ONNX model '{path}' cannot be loaded: {error} Export it again.") from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        self._input, self._output = inputs[0].name, outputs[0].name
        shape = list(inputs[0].shape)
        flat = NUM_VEHICLES * NUM_FEATURES
        if len(inputs) != 1 or shape[1:] not in ([NUM_VEHICLES, NUM_FEATURES], [flat]):
            raise RapidError(
                f"The ONNX model '{path}' reads {[(item.name, item.shape) for item in inputs]}, but an agent reads one "
                f"input of shape (batch, {NUM_VEHICLES}, {NUM_FEATURES}) or (batch, {flat}). Export it with that input."
            )
        if len(outputs[0].shape) != 2 or outputs[0].shape[1] != len(ACTIONS):
            raise RapidError(
                f"The ONNX model '{path}' returns shape {outputs[0].shape}, but an agent returns Q-values (batch, "
                f"{len(ACTIONS)}), one for each of {', '.join(ACTIONS)}. Export it with that output."
            )
        self._flat = len(shape) == 2
        self.name = name or Path(path).stem
        self.metadata: dict[str, Any] = json.loads(
            self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "{}")
        )

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
        obs_BVF = check_observations(obs_BVF, self.name)
        values = obs_BVF.reshape(len(obs_BVF), -1) if self._flat else obs_BVF
        return np.asarray(self._session.run([self._output], {self._input: values})[0])


def export_onnx(agent: QAgent, path: str | os.PathLike[str], obs_BVF: np.ndarray) -> float:
    """Write an agent's network as ONNX and compare the two on given observations.

    Adapters that a closed gate shuts out are left out of the file.

    Args:
        agent: the agent.
        path: the file; written only if the comparison succeeds.
        obs_BVF: real observations (B, V, F) for the comparison.

    Returns:
        The largest difference between Q-values.

    Raises:
        RapidError: the extra `export` is not installed, or the exported model gives other Q-values.
    """
    _import_onnxruntime()
    try:
        import onnx
        import onnxscript  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise RapidError(
            "Exporting needs onnx and onnxscript. Install them: pip install 'rapid-driving[export]'"
        ) from error
    obs_BVF = check_observations(obs_BVF, agent.name)
    network = agent.network
    example = torch.zeros(2, NUM_VEHICLES, NUM_FEATURES, device=network.scale_F.device)
    with files.atomic_path(path) as temporary:
        with _static(network), _quiet():
            program = torch.onnx.export(
                network,
                (example,),
                dynamo=True,
                input_names=["obs"],
                output_names=["q"],
                dynamic_shapes=({0: torch.export.Dim("batch")},),
                opset_version=OPSET,
                verbose=False,
            )
        assert program is not None
        model = program.model_proto
        description = {"name": agent.name, "lanes": network.lanes, "features": FEATURES, "actions": ACTIONS}
        onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(description)})
        onnx.save(model, os.fspath(temporary))
        expected = agent.q_values(obs_BVF)
        difference = float(np.abs(OnnxAgent(temporary, agent.name).q_values(obs_BVF) - expected).max(initial=0))
        allowed = TOLERANCE * max(1.0, float(np.abs(expected).max(initial=0)))
        if not difference <= allowed:
            raise RapidError(
                f"The exported model's Q-values differ by {difference:.2g} from the agent's, more than {allowed:.2g}; "
                f"'{path}' was not written. Try another version of torch or onnxruntime."
            )
    return difference


@contextlib.contextmanager
def _static(network: QNetwork) -> Generator[None, None, None]:
    """Fix which policies run, since an exported graph cannot decide it for each batch."""
    if not isinstance(network.head, TokenHead):
        yield
        return
    mixture = network.head.mixture
    opened = [index + 1 for index, gate_V in enumerate(mixture.gate_NV) if bool(gate_V.any())]
    mixture.always_run = (0, *opened)
    try:
        yield
    finally:
        mixture.always_run = None


@contextlib.contextmanager
def _quiet() -> Generator[None, None, None]:
    """Keep the exporter's chatter off the terminal."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _import_onnxruntime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise RapidError("ONNX needs onnxruntime. Install it: pip install 'rapid-driving[export]'") from error
    return onnxruntime
