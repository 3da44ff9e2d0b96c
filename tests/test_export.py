"""ONNX: the same Q-values, and clear words when something is missing."""

import sys

import numpy as np
import pytest
import torch

from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.export import OnnxAgent, export_onnx
from rapid.networks.agent import QAgent
from rapid.networks.q_network import build_network

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

SMALL = {"width": 16, "heads": 2, "feedforward": 32, "layers": 1, "hidden": (16,)}


def make(**settings) -> QAgent:
    return QAgent(build_network(NetworkConfig(**{**SMALL, **settings}), 3, 0), "pupil")


@pytest.mark.slow
@pytest.mark.parametrize("opened", [False, True])
def test_an_exported_agent_drives_the_same(roads, tmp_path, opened):
    agent, obs = make(num_policies=3, top_k=2), roads(9, absent=0.4).numpy()
    mixture = agent.network.head.mixture
    if opened:
        torch.nn.init.normal_(mixture.gate_NV)
    difference = export_onnx(agent, tmp_path / "pupil.onnx", obs)
    assert difference < 1e-5
    assert mixture.always_run is None
    exported = OnnxAgent(tmp_path / "pupil.onnx")
    assert exported.name == "pupil"
    assert exported.metadata["lanes"] == 3
    for count in (1, 9):
        assert np.abs(exported.q_values(obs[:count]) - agent.q_values(obs[:count])).max() < 1e-5
    assert exported.act(obs).dtype == np.int64
    assert (exported.act(obs) == agent.act(obs)).all()
    with pytest.raises(RapidError, match="not finite"):
        exported.act(obs * np.nan)


def test_a_model_that_differs_is_not_written(roads, tmp_path, monkeypatch):
    agent = make(kind="mlp")
    original = agent.q_values
    monkeypatch.setattr(agent, "q_values", lambda obs: original(obs) + 1)
    with pytest.raises(RapidError, match="was not written"):
        export_onnx(agent, tmp_path / "x.onnx", roads(3).numpy())
    assert not list(tmp_path.iterdir())


def save_model(path, inputs: int, outputs: int):
    """Write a model of another origin: one linear layer over a flat observation."""
    from onnx import TensorProto, helper, save

    weight = np.arange(inputs * outputs, dtype=np.float32).reshape(inputs, outputs) / 100
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["state", "weight"], ["values"])],
        "linear",
        [helper.make_tensor_value_info("state", TensorProto.FLOAT, ["n", inputs])],
        [helper.make_tensor_value_info("values", TensorProto.FLOAT, ["n", outputs])],
        [helper.make_tensor("weight", TensorProto.FLOAT, weight.shape, weight.tobytes(), raw=True)],
    )
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return weight


def test_models_made_elsewhere_drive_too_if_their_shapes_fit(roads, tmp_path):
    weight = save_model(tmp_path / "foreign.onnx", 75, 5)
    obs = roads(4).numpy()
    agent = OnnxAgent(tmp_path / "foreign.onnx", "foreign")
    assert np.allclose(agent.q_values(obs), obs.reshape(4, -1) @ weight, rtol=1e-4)
    assert agent.metadata == {}
    save_model(tmp_path / "few.onnx", 75, 3)
    with pytest.raises(RapidError, match="returns shape"):
        OnnxAgent(tmp_path / "few.onnx")
    save_model(tmp_path / "narrow.onnx", 25, 5)
    with pytest.raises(RapidError, match="reads"):
        OnnxAgent(tmp_path / "narrow.onnx")


def test_missing_files_and_packages_are_explained(roads, tmp_path, monkeypatch):
    with pytest.raises(RapidError, match="no ONNX model"):
        OnnxAgent(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(RapidError, match="cannot be loaded"):
        OnnxAgent(tmp_path / "bad.onnx")
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(RapidError, match=r"rapid-driving\[export\]"):
        export_onnx(make(kind="mlp"), tmp_path / "x.onnx", roads(1).numpy())
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(RapidError, match=r"rapid-driving\[export\]"):
        OnnxAgent(tmp_path / "bad.onnx")
