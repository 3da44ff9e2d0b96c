"""Agents, and agents on disk."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rapid.agents.saved import QAgent, load_agent, save_agent
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.q_network import build_network

SMALL = {"width": 16, "heads": 2, "feedforward": 32, "hidden": (24,)}


def make(**settings):
    return build_network(NetworkConfig(**{**SMALL, **settings}), lanes=4, seed=1)


@pytest.fixture
def saved(tmp_path):
    save_agent(tmp_path / "agent", make(), {"name": "pupil", "iterations": 3})
    return tmp_path / "agent"


def edit(folder, **changes):
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_an_agent_acts_greedily_without_gradient(roads):
    agent, obs = QAgent(make(), "a"), roads(6).numpy()
    actions, q = agent.act(obs), agent.q_values(obs)
    assert actions.dtype == np.int64
    assert q.dtype == np.float32
    assert (actions == q.argmax(1)).all()
    assert (agent.q_values(obs.astype(np.float64)) == q).all()
    assert np.array_equal(agent.explain(obs).q_BA, q)


@pytest.mark.parametrize("kind", ["rapid", "attentive", "mlp", "mlp-mixture"])
@pytest.mark.parametrize("vehicles", [15, 20])
def test_saved_and_loaded_agents_are_bit_equal(roads, tmp_path, kind, vehicles):
    network = make(kind=kind, vehicles=vehicles)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_()
    save_agent(tmp_path / "mine", network, {"from": "test"})
    agent = load_agent(tmp_path / "mine")
    assert agent.name == "mine"
    assert agent.metadata == {"from": "test"}
    assert agent.network.config == network.config
    assert agent.network.lanes == 4
    assert not agent.network.training
    assert agent.vehicles == vehicles
    obs = np.concatenate([roads(9).numpy(), roads(9, seed=1).numpy()], 1)[:, :vehicles]
    assert (agent.q_values(obs) == QAgent(network).q_values(obs)).all()
    for key, value in network.state_dict().items():
        assert torch.equal(value, agent.network.state_dict()[key])


def test_the_name_comes_from_the_metadata_and_saving_again_replaces(saved):
    assert load_agent(saved).name == "pupil"
    save_agent(saved, make(kind="mlp"), {})
    assert load_agent(saved).network.config.kind == "mlp"
    assert sorted(path.name for path in saved.iterdir()) == ["config.json", "weights.safetensors"]


def test_observations_that_do_not_fit_are_refused(roads):
    agent = QAgent(make(), "a")
    with pytest.raises(RapidError, match=r"shape \(2, 10, 5\)"):
        agent.act(np.zeros((2, 10, 5)))
    with pytest.raises(RapidError, match="shape"):
        agent.act(np.zeros((15, 5)))
    obs = roads(3).numpy()
    obs[2, 4, 3] = np.nan
    with pytest.raises(RapidError, match="world 2, vehicle 4, vx = nan"):
        agent.act(obs)


def test_missing_agents(tmp_path, saved):
    with pytest.raises(RapidError, match="no saved agent"):
        load_agent(tmp_path / "nowhere")
    (saved / "weights.safetensors").unlink()
    with pytest.raises(RapidError, match=r"no weights\.safetensors"):
        load_agent(saved)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "does not describe an agent"),
        ({"version": 99}, "version 99"),
        ({"vehicles": 5}, "5 vehicles"),
        ({"features": ["x"]}, "features"),
        ({"actions": ["LEFT"]}, "actions"),
        ({"lanes": "three"}, "damaged"),
        ({"lanes": True}, "damaged"),
        ({"lanes": 0}, "damaged"),
        ({"lanes": 5}, "ranges"),
        ({"ranges": [1.0, 100.0, 16.0, 80.0, 80.0]}, "ranges"),
        ({"network": None}, "damaged"),
        ({"metadata": None}, "damaged"),
        ({"network": {"wdith": 3}}, "wdith"),
        ({"network": {"num_policies": 0}}, "num_policies"),
        ({"network": {"width": 32, "heads": 2, "feedforward": 32}}, "do not fit"),
        ({"network": {"kind": "mlp"}}, "do not fit"),
        ({"weights_sha256": "0" * 64}, "not those"),
    ],
)
def test_descriptions_that_do_not_fit_are_refused(saved, changes, message):
    edit(saved, **changes)
    with pytest.raises(RapidError, match=message):
        load_agent(saved)


def test_damaged_files_are_refused(saved):
    path = saved / "weights.safetensors"
    content = path.read_bytes()
    for damaged in (content[:100], b"", content[:-4], content[:-1] + bytes([content[-1] ^ 1])):
        path.write_bytes(damaged)
        with pytest.raises(RapidError, match="weights"):
            load_agent(saved)
    path.write_bytes(content)
    load_agent(saved)
    for text in ("{", "[]", "\x00", "3"):
        (saved / "config.json").write_text(text)
        with pytest.raises(RapidError):
            load_agent(saved)


def test_the_ranges_travel_with_the_weights(saved):
    weights = load_file(saved / "weights.safetensors")
    assert weights["encoding.scale_F"].tolist() == [1, 200, 16, 80, 80]
    assert json.loads((saved / "config.json").read_text())["ranges"] == [1, 200, 16, 80, 80]


def test_weights_that_lack_a_tensor_are_refused(saved):
    from rapid import files

    weights = load_file(saved / "weights.safetensors")
    del weights["head.decoder.head.bias"]
    save_file(weights, saved / "weights.safetensors")
    edit(saved, weights_sha256=files.sha256(saved / "weights.safetensors"))
    with pytest.raises(RapidError, match="do not fit"):
        load_agent(saved)


def test_what_a_notebook_shows_of_an_agent_is_a_line():
    shown = repr(QAgent(make(vehicles=20), "pupil"))
    assert "'pupil': reads 20 vehicles on 4 lanes" in shown
    assert len(shown) < 120


def test_one_observation_is_told_to_want_a_batch_axis(roads):
    agent, obs = QAgent(make(), "pupil"), roads(2).numpy()
    with pytest.raises(RapidError, match=r"batch axis.*obs\[None\]"):
        agent.act(obs[0])
    assert agent.act(obs[0][None]) == agent.act(obs)[:1]
