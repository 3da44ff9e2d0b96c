"""Models that stable-baselines3 saved, as ONNX agents. Nothing of the file is unpickled.

A saved model is a zip: its weights (``policy.pth``) are read as tensors and nothing else, and of its settings
(``data``) only what stands there as plain text. The model keeps its own way of looking: the ONNX file reads the raw
rows that every agent of RAPID reads, and makes of them what the model was trained on.
"""

import io
import json
import os
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from rapid import files
from rapid.agents.onnx import METADATA_KEY, TOLERANCE, OnnxAgent, Parity
from rapid.agents.onnx_graph import Graph
from rapid.errors import RapidError
from rapid.scenarios import ACTIONS, FEATURES, MAX_VEHICLES, NUM_ACTIONS, NUM_FEATURES, Scenario, get_task

MOST_BYTES = 512 * 2**20
"""Weights beyond this are refused unread."""
SEEDS, STEPS = 16, 20
"""Worlds and decisions on which the exported model is compared."""

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Sb3Policy:
    """The multi-layer perceptron of a saved model."""

    algorithm: str
    """DQN, or PPO (A2C's policies are the same)."""
    version: str
    shape: tuple[int, ...]
    """Of one observation."""
    layers: list[tuple[Array, Array]]
    """Weights (out, in) and biases (out,), in order."""
    activation: str
    """A name of :data:`ACTIVATIONS`."""

    def values(self, seen_BVF: Array) -> Array:
        """Return the values or preferences of the actions, (B, A)."""
        rows = torch.from_numpy(seen_BVF.reshape(len(seen_BVF), -1))
        for index, (weight, bias) in enumerate(self.layers):
            rows = rows @ torch.from_numpy(weight).T + torch.from_numpy(bias)
            rows = ACTIVATIONS[self.activation](rows) if index < len(self.layers) - 1 else rows
        return rows.numpy()


ACTIVATIONS: dict[str, Any] = {
    "Relu": torch.relu,
    "Tanh": torch.tanh,
    "Sigmoid": torch.sigmoid,
    "Elu": torch.nn.functional.elu,
    "LeakyRelu": torch.nn.functional.leaky_relu,
}
"""By their names in ONNX; in torch only their case differs."""


def read_sb3(path: str | os.PathLike[str]) -> Sb3Policy:
    """Read the policy of a model that stable-baselines3 saved: ``MlpPolicy`` of DQN, PPO or A2C.

    Raises:
        RapidError: there is no such file, it is damaged or of something else, or its policy is none of these.
    """
    if not Path(path).is_file():
        raise RapidError(f"There is no model at '{path}'. Check the path; stable-baselines3 adds .zip to the name.")
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo("policy.pth").file_size > MOST_BYTES or archive.getinfo("data").file_size > MOST_BYTES:
                raise RapidError(f"The model '{path}' is larger than {MOST_BYTES >> 20} MiB. Is it a driving policy?")
            data: dict[str, Any] = json.loads(archive.read("data"))
            weights = torch.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
            version = ""
            if "_stable_baselines3_version" in archive.namelist():
                version = archive.read("_stable_baselines3_version").decode(errors="replace").strip()
        arrays = {str(key): value.float().numpy() for key, value in weights.items()}
        space = data["observation_space"]["_shape"]
        shape = tuple(int(size) for size in (json.loads(space) if isinstance(space, str) else space))
        told = (data.get("policy_kwargs") or {}).get("activation_fn")
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, zipfile.BadZipFile) as error:
        raise RapidError(
            f"'{path}' is no model that stable-baselines3 saved, or it is damaged ({type(error).__name__}: {error}). "
            "Save it again with model.save()."
        ) from error
    except pickle.UnpicklingError as error:
        raise RapidError(f"The weights in '{path}' hold more than tensors, so they are not read: {error}") from error
    algorithm, names = _layer_names(arrays, path)
    layers = [(arrays[f"{name}.weight"], arrays[f"{name}.bias"]) for name in names]
    _check_layers(layers, shape, path)
    return Sb3Policy(algorithm, version, shape, layers, _activation(told, algorithm, path))


def _layer_names(arrays: dict[str, Array], path: Any) -> tuple[str, list[str]]:
    for algorithm, stem, last in (("DQN", "q_net.q_net.", None), ("PPO", "mlp_extractor.policy_net.", "action_net")):
        numbers = sorted(
            int(key.removeprefix(stem).split(".")[0])
            for key in arrays
            if key.startswith(stem) and key.endswith(".weight")
        )
        names = [f"{stem}{number}" for number in numbers] + ([last] if last else [])
        extractor = any("features_extractor" in key for key in arrays)
        if names and not extractor and all(f"{n}.{part}" in arrays for n in names for part in ("weight", "bias")):
            return algorithm, names
    raise RapidError(
        f"The model '{path}' is no MlpPolicy of DQN, PPO or A2C; its weights are {', '.join(list(arrays)[:6])}, … . "
        "Only those can be imported. Any other model drives as an ONNX file that you export yourself."
    )


def _check_layers(layers: list[tuple[Array, Array]], shape: tuple[int, ...], path: Any) -> None:
    width = int(np.prod(shape))
    for weight, bias in layers:
        if weight.ndim != 2 or weight.shape != (len(bias), width):
            raise RapidError(f"The layers of the model '{path}' do not fit together. It is damaged; save it again.")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise RapidError(f"The model '{path}' holds weights that are not finite. Its training failed; train again.")
        width = len(weight)
    if width != NUM_ACTIONS:
        raise RapidError(
            f"The model '{path}' chooses among {width} actions, but an agent has {NUM_ACTIONS}: {', '.join(ACTIONS)}."
        )


def _activation(told: Any, algorithm: str, path: Any) -> str:
    if told is None:
        return "Relu" if algorithm == "DQN" else "Tanh"
    name = str(told).split(".")[-1].rstrip("'>").lower()
    for known in ACTIVATIONS:
        if known.lower() == name:
            return known
    raise RapidError(
        f"The model '{path}' has the activation {told}, which is none of {', '.join(ACTIVATIONS)}. "
        "Export it as ONNX yourself."
    )


def import_sb3(path: str | os.PathLike[str], out: str | os.PathLike[str], trained_on: str) -> Parity:
    """Write a saved model as an ONNX agent and compare the two in the worlds that it was trained on.

    Args:
        path: the zip that ``model.save()`` wrote.
        out: the ONNX file; written only if the comparison succeeds.
        trained_on: a scenario or an id of HighwayEnv: whose observations the model reads.

    Raises:
        RapidError: the model cannot be read, it was not trained on such observations, the extra `export` is not
            installed, or the exported model gives other values.
    """
    policy, task = read_sb3(path), get_task(trained_on)
    looks = _Observation(task)
    if policy.shape != looks.shape:
        raise RapidError(
            f"The model '{path}' reads observations of shape {policy.shape}, but those of {trained_on} have "
            f"{looks.shape}. Say with --trained-on what it was trained on."
        )
    try:
        import onnx
    except ImportError as error:
        raise RapidError("Importing needs onnx. Install it: pip install onnx onnxruntime") from error
    model = _build(onnx, policy, looks)
    description = {
        "name": Path(path).stem,
        "scenario": trained_on if type(task) is Scenario else None,
        "lanes": task.lanes,
        "features": FEATURES,
        "actions": ACTIONS,
        "mirrored_lanes": None,
        "trained_on": trained_on,
        "source": f"stable-baselines3 {policy.version}, {policy.algorithm}",
    }
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(description)})
    seen_BVF, raw_BVF = _both_views(task, looks)
    with files.atomic_path(out) as temporary:
        onnx.save(model, os.fspath(temporary))
        expected, exported = policy.values(seen_BVF), OnnxAgent(temporary, "imported").q_values(raw_BVF)
        difference = float(np.abs(exported - expected).max())
        allowed = 10 * TOLERANCE * max(1.0, float(np.abs(expected).max()))
        if not difference <= allowed:
            raise RapidError(
                f"The exported model's values differ by {difference:.2g} from the model's, more than {allowed:.2g}; "
                f"'{out}' was not written. Try another version of onnxruntime."
            )
    return Parity(len(seen_BVF), difference, float((exported.argmax(1) == expected.argmax(1)).mean()))


class _Observation:
    """How a task's observation follows from the raw rows of all vehicles."""

    def __init__(self, task: Scenario) -> None:
        from rapid.simulator.configuration import Configuration

        configuration = Configuration(task)
        settings = configuration.settings
        names = configuration.values["observation"].get("features") or FEATURES
        unknown = [name for name in names if name not in FEATURES]
        if unknown or settings.clock >= 0:
            raise RapidError(f"A model that reads {unknown or 'the time'} cannot be imported; rows hold {FEATURES}.")
        self.columns = [FEATURES.index(name) for name in names]
        self.shape = (settings.rows, len(names))
        self.absolute, self.see_behind, self.clip = settings.absolute, settings.see_behind, settings.clip
        self.scaled, self.low, self.high = settings.scaled, settings.low, settings.high
        plain = settings.absolute and settings.see_behind and not settings.scaled.any()
        self.plain = plain and self.columns == list(range(NUM_FEATURES))
        self.vehicles = settings.rows if self.plain else MAX_VEHICLES
        """Raw rows that are read: enough that none that the task shows is missing."""


def _build(onnx: Any, policy: Sb3Policy, looks: _Observation) -> Any:
    graph = Graph(onnx, looks.vehicles)
    rows = "obs" if looks.plain else _look(graph, looks)
    rows = graph.reshape(rows, -1, int(np.prod(looks.shape)))
    for index, (weight, bias) in enumerate(policy.layers):
        rows = graph.node("Gemm", rows, weight.T, bias)
        rows = graph.node(policy.activation, rows) if index < len(policy.layers) - 1 else rows
    graph.nodes[-1].output[0] = "q"
    return graph.model()


def _look(graph: Graph, looks: _Observation) -> str:
    """Return what the task shows, (B, rows, features), of the raw rows `obs`, which are sorted by distance."""
    vehicles, (rows, _) = looks.vehicles, looks.shape
    ego, x = graph.cut("obs", 0, 1, 1), FEATURES.index("x")
    shown = graph.node("Greater", graph.cut("obs", 0, 1, 2), 0.5)
    if not looks.see_behind:
        ahead = graph.node("Sub", graph.cut("obs", x, x + 1, 2), graph.cut(ego, x, x + 1, 2))
        # Two lengths behind the ego is where highway-env stops to look.
        shown = graph.node("And", shown, graph.node("Greater", ahead, -10.0))
    place = np.arange(vehicles, dtype=np.float32)[:, None]
    score = graph.node("Where", shown, place, place + vehicles)
    count = graph.constant([rows], np.int64)
    _, first = graph.node("TopK", score, count, outputs=2, axis=1, largest=0, sorted=1)
    values = "obs"
    if not looks.absolute:
        others = np.ones((vehicles, NUM_FEATURES), np.float32)
        others[0] = others[:, 0] = 0.0  # the ego's own row and every presence stay as they are
        values = graph.node("Sub", "obs", graph.node("Mul", ego, others))
    wide = graph.node("Expand", first, graph.constant([1, 1, NUM_FEATURES], np.int64))
    chosen = graph.node("GatherElements", values, wide, axis=1)
    chosen = graph.node("Gather", chosen, graph.constant(looks.columns, np.int64), axis=2)
    factor = np.where(looks.scaled, 2.0 / (looks.high - looks.low), 1.0).astype(np.float32)
    offset = np.where(looks.scaled, -1.0 - looks.low * factor, 0.0).astype(np.float32)
    chosen = graph.node("Add", graph.node("Mul", chosen, factor), offset)
    if looks.clip and looks.scaled.any():
        limit = np.where(looks.scaled, 1.0, np.inf).astype(np.float32)
        chosen = graph.node("Max", graph.node("Min", chosen, limit), -limit)
    real = graph.node("GatherElements", graph.node("Cast", shown, to=1), first, axis=1)
    return graph.node("Mul", chosen, real)


def _both_views(task: Scenario, looks: _Observation) -> tuple[Array, Array]:
    """Return what the task shows and the raw rows of the same moments, driven at random."""
    from rapid.simulator import make_vec

    raw = {
        "observation": {
            "type": "Kinematics",
            "features": list(FEATURES),
            "absolute": True,
            "normalize": False,
            "see_behind": True,
            "vehicles_count": looks.vehicles,
        }
    }
    both: list[Any] = [make_vec(task, SEEDS, seed=0), make_vec(task, SEEDS, seed=0, config=raw)]
    generator = np.random.default_rng(0)
    moments = [[worlds.reset()[0] for worlds in both]]
    for _ in range(STEPS):
        actions = generator.integers(0, NUM_ACTIONS, SEEDS)
        moments.append([worlds.step(actions)[0] for worlds in both])
    for worlds in both:
        worlds.close()
    seen, rows = (np.concatenate(cast(Any, part)) for part in zip(*moments, strict=True))
    return seen, rows
