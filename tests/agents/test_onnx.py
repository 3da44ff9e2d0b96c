"""ONNX: the same Q-values, and clear words when something is missing."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from rapid.agents.onnx import OnnxAgent, driven_observations, export_onnx, latency
from rapid.agents.saved import QAgent, save_agent
from rapid.cli import main
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network

pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

SMALL = {"width": 16, "heads": 2, "feedforward": 32, "layers": 1, "hidden": (16,)}


def make(**settings) -> QAgent:
    return QAgent(build_network(NetworkConfig(**{**SMALL, **settings}), 3, 0), "pupil")


def opened(agent: QAgent) -> QAgent:
    gate = getattr(getattr(agent.network.head, "mixture", None), "gate_NV", None)
    if gate is not None:
        torch.nn.init.normal_(gate)
    return agent


def test_an_exported_agent_drives_the_same(roads, tmp_path):
    agent, obs = opened(make(num_policies=3, top_k=2)), roads(9, absent=0.4).numpy()
    parity = export_onnx(agent, tmp_path / "pupil.onnx", obs)
    assert parity.observations == 9
    assert parity.difference < 1e-5
    assert parity.agreement == 1
    exported = OnnxAgent(tmp_path / "pupil.onnx")
    assert exported.name == "pupil"
    assert exported.metadata["lanes"] == 3
    for count in (1, 9):
        assert np.abs(exported.q_values(obs[:count]) - agent.q_values(obs[:count])).max() < 1e-5
    assert exported.act(obs).dtype == np.int64
    assert (exported.act(obs) == agent.act(obs)).all()
    with pytest.raises(RapidError, match="not finite"):
        exported.act(obs * np.nan)
    assert latency(tmp_path / "pupil.onnx", obs[0], calls=5) > 0


@pytest.mark.parametrize(
    "settings",
    [
        {"kind": "mlp", "input": "raw", "mask_absent": False},
        {"kind": "mlp", "hidden": (16, 8)},
        {"kind": "mlp-mixture", "input": "normalized"},
        {"kind": "attentive", "position": "none", "action_token": "ego"},
        {"kind": "attentive", "position": "sinusoidal", "layers": 2, "decoder_layers": 2, "heads": 4},
        {"kind": "rapid", "input": "raw", "position": "learned", "mask_absent": False, "decoder_layers": 2},
        {"kind": "rapid", "input": "normalized", "action_token": "ego", "decoder_layers": 2},
        {"kind": "mlp", "input": "ego", "hidden": (16,)},
        {"kind": "rapid", "input": "ego"},
        {"kind": "rapid", "gate": "tanh"},
        {"kind": "rapid", "gate": "tanh", "num_policies": 4, "top_k": 3},
        {"kind": "rapid", "num_policies": 4, "top_k": 1},
        {"kind": "rapid", "num_policies": 1, "top_k": 1},
        {"kind": "rapid", "mirror": True},
        {"kind": "rapid", "vehicles": 31},
        {"kind": "mlp", "vehicles": 20, "mirror": True},
        {"kind": "mlp", "input": "raw", "mask_absent": False, "mirror": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("gate", ["closed", "open"])
def test_every_kind_of_network_exports(roads, tmp_path, settings, gate):
    agent = make(**settings) if gate == "closed" else opened(make(**settings))
    if agent.network.config.kind == "mlp-mixture" and gate == "open":
        torch.nn.init.normal_(agent.network.head.weights_N)
    obs = np.concatenate([roads(9, absent=0.4).numpy(), roads(9, seed=1).numpy(), roads(9, seed=2).numpy()], 1)
    obs = obs[:, : agent.vehicles]
    obs[0, 0, 0] = 0  # The ego counts whatever its presence says.
    expected = agent.q_values(obs)
    assert export_onnx(agent, tmp_path / "x.onnx", obs).difference < 1e-5 * max(1, np.abs(expected).max())


def test_a_closed_gate_leaves_its_adapters_out(roads, tmp_path):
    agent, obs = make(num_policies=3), roads(2).numpy()
    export_onnx(agent, tmp_path / "closed.onnx", obs)
    export_onnx(opened(agent), tmp_path / "open.onnx", obs)
    assert (tmp_path / "open.onnx").stat().st_size > 1.5 * (tmp_path / "closed.onnx").stat().st_size


def test_the_verb_exports_and_the_example_drives_without_torch(roads, tmp_path, capsys):
    save_agent(tmp_path / "agent", make(kind="attentive").network, {"name": "pupil", "scenario": "lane-3-density-2"})
    with pytest.raises(SystemExit) as ended:
        main(["export", str(tmp_path / "agent"), "--out", str(tmp_path / "pupil.onnx")])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    for words in ("largest difference of Q-values", "the same action on 100.00%", "microseconds (median)"):
        assert words in printed
    example = Path(__file__).parents[2] / "examples" / "drive_onnx.py"
    assert len(example.read_text().splitlines()) <= 30
    command = [sys.executable, str(example), str(tmp_path / "pupil.onnx"), "1"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "episode 0: return" in told
    assert "torch was not needed" in told


def test_the_check_needs_observations(roads, tmp_path):
    with pytest.raises(RapidError, match="no observations to compare"):
        export_onnx(make(kind="mlp"), tmp_path / "x.onnx", roads(1).numpy()[:0])


def test_a_model_that_differs_is_not_written(roads, tmp_path, monkeypatch):
    agent = make(kind="mlp")
    original = agent.q_values
    monkeypatch.setattr(agent, "q_values", lambda obs, state=None: original(obs) + 1)
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
    assert agent.vehicles == 15
    save_model(tmp_path / "near.onnx", 25, 5)
    assert OnnxAgent(tmp_path / "near.onnx").vehicles == 5
    save_model(tmp_path / "narrow.onnx", 24, 5)
    with pytest.raises(RapidError, match="reads"):
        OnnxAgent(tmp_path / "narrow.onnx")


def test_missing_files_and_packages_are_explained(roads, tmp_path, monkeypatch):
    with pytest.raises(RapidError, match="no ONNX model"):
        OnnxAgent(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(RapidError, match="cannot be loaded"):
        OnnxAgent(tmp_path / "bad.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(RapidError, match=r"-e '\.\[export\]'"):
        export_onnx(make(kind="mlp"), tmp_path / "x.onnx", roads(1).numpy())
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(RapidError, match=r"-e '\.\[export\]'"):
        OnnxAgent(tmp_path / "bad.onnx")


@pytest.mark.parametrize(
    "settings",
    [{}, {"kind": "attentive"}, {"action_token": "ego", "gate": "tanh"}, {"num_policies": 3}, {"squeeze": True}],
)
def test_a_memory_is_exported_with_the_agent(settings, tmp_path):
    agent = opened(make(memory=True, **settings))
    with torch.no_grad():
        agent.network.memory.out.weight.normal_(0, 0.5, generator=torch.Generator().manual_seed(1))
    seeds = list(range(900_000, 900_012))
    obs, state = driven_observations(agent, "lane-3-density-2", seeds)
    # As if it were attacked: what is believed of the ego is bounded in the model as well.
    obs[::2, 0, 1:4] += np.array([20, 1, -8], np.float32)
    obs[::3, 1:, 2:] += np.array([-5, 8, -8], np.float32)
    path = tmp_path / "it.onnx"
    parity = export_onnx(agent, path, obs, state)
    assert parity.observations == len(obs) > 24
    assert parity.agreement > 0.99
    exported = OnnxAgent(path)
    assert exported.has_memory
    np.testing.assert_array_equal(exported.start(2), agent.start(2))
    np.testing.assert_allclose(exported.q_values(obs, state), agent.q_values(obs, state), atol=1e-4)
    # Whoever drives with the model alone gets the same state from it.
    following = exported.session.run(["next_state"], exported.inputs(obs, state))[0]
    np.testing.assert_allclose(following, agent.remember(state, exported.act(obs, state)), atol=2e-4)
    mine, theirs = (run_episodes(each, "lane-3-density-2", seeds) for each in (agent, exported))
    np.testing.assert_allclose(mine.return_E, theirs.return_E)
    with pytest.raises(RapidError, match=r"has a memory and needs state beside the observations: agent\.start"):
        exported.act(obs)
    assert latency(path, obs[0], calls=5) > 0


def test_who_has_no_memory_takes_no_state(roads, tmp_path):
    agent, obs = make(), roads(2).numpy()
    export_onnx(agent, tmp_path / "it.onnx", obs)
    exported = OnnxAgent(tmp_path / "it.onnx")
    assert not exported.has_memory
    with pytest.raises(RapidError, match="has no memory and takes no state"):
        exported.act(obs, exported.start(2))
