"""Certificates: bounds that hold for all that can be sampled and attacked, and what is concluded from them."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rapid.agents.saved import QAgent, save_agent
from rapid.agents.shielded import shielded
from rapid.attacks import get_attack
from rapid.certify.bounds import Bounds, perceptron
from rapid.certify.forms import Form
from rapid.certify.rate import Reach, certified_return, decision_rates
from rapid.cli import main
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.encoding import feature_scale
from rapid.networks.memory import DISTANCE, SPEED, Memory
from rapid.networks.q_network import build_network
from rapid.safety import Box, margins
from rapid.scenarios import FASTER, LANE_RIGHT, SLOWER
from rapid.spawns import spawn_seeds

SCENARIO = "lane-3-density-2"
SMALL: dict[str, Any] = {"width": 8, "heads": 2, "feedforward": 16, "layers": 1, "hidden": (16, 16), "vehicles": 6}
NETWORKS: list[dict[str, Any]] = [
    {"kind": "mlp"},
    {"kind": "mlp", "input": "raw", "mask_absent": False},
    {"kind": "mlp-mixture", "mirror": True, "input": "normalized"},
    {"kind": "rapid"},
    {"kind": "rapid", "input": "ego", "gate": "tanh", "num_policies": 3, "top_k": 2},
    {"kind": "rapid", "num_policies": 3, "top_k": 1, "position": "learned"},
    {"kind": "rapid", "mask_absent": False, "input": "normalized", "action_token": "ego"},
    {"kind": "attentive", "layers": 2, "decoder_layers": 2, "position": "sinusoidal", "mirror": True},
]


def make(**settings: Any) -> QAgent:
    network = build_network(NetworkConfig(**{**SMALL, **settings}), 3, 0)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        if network.gate is not None and network.gate.numel():
            torch.nn.init.normal_(network.gate)
    return QAgent(network.requires_grad_(False), "pupil")


def _perceptron_of(agent: QAgent) -> Any:
    head: Any = agent.network.head
    return head.mlps[0]


def careful() -> QAgent:
    """A pupil that brakes unless something speaks against it, and so comes to the end."""
    agent = make(kind="mlp")
    last = [layer for layer in _perceptron_of(agent) if isinstance(layer, torch.nn.Linear)][-1]
    last.bias[SLOWER] += 0.5
    return agent


def offsets(samples: int, vehicles: int, seed: int = 0) -> torch.Tensor:
    """Points of the unit box (samples, vehicles, 5), half of them corners; presence stays."""
    points = torch.rand(samples, vehicles, 5, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    points[::2] = points[::2].sign()
    return points * torch.tensor([0.0, 1, 1, 1, 1])


@pytest.mark.parametrize("settings", NETWORKS, ids=str)
def test_bounds_hold_at_every_sampled_point_of_the_box(roads: Any, settings: dict[str, Any]):
    # Four observations, four radii and 800 points each, in eight networks: more than 10^5 points.
    agent, scale = make(**settings), feature_scale(3) * torch.tensor([0.0, 1, 1, 1, 1])
    obs, bounds = roads(4, absent=0.4)[:, :6], Bounds(agent.network)
    for radius in (1e-5, 5e-4, 5e-3, 5e-2):
        least = bounds.differences(obs - radius * scale, obs + radius * scale)
        assert radius > 1e-4 or not least.isnan().any()
        for index in range(4):
            points = obs[index] + offsets(800, 6, index) * (scale * radius * 0.99999)
            q = agent.network(points).double()
            found = (q[:, :, None] - q[:, None]).amin(0)
            assert bool(((found >= least[index] - 2e-5) | least[index].isnan()).all())


@pytest.mark.parametrize("settings", NETWORKS, ids=str)
def test_bounds_are_exact_at_a_point_and_tight_near_it(roads: Any, settings: dict[str, Any]):
    agent, scale = make(**settings), feature_scale(3) * torch.tensor([0.0, 1, 1, 1, 1])
    obs, bounds = roads(4)[:, :6], Bounds(agent.network)
    q = agent.network(obs).double()
    exact = q[:, :, None] - q[:, None]
    assert torch.allclose(bounds.differences(obs, obs), exact, atol=2e-5)
    # To first order the bound is the sum of the slopes: ten times less radius, ten times less room.
    near, nearer = (exact - bounds.differences(obs - r * scale, obs + r * scale) for r in (1e-6, 1e-7))
    rounding = 1e-5
    assert (near - 10 * nearer).abs().max() < 0.1 * near.max() + 20 * rounding


def test_linear_bounds_from_the_back_are_the_networks_own_slopes_where_no_relu_turns():
    generator = torch.Generator().manual_seed(0)
    layers = [torch.nn.Linear(3, 8).double(), torch.nn.Linear(8, 2).double()]
    centre = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    errors = torch.eye(3, dtype=torch.float64)[:, None] * 1e-9
    form = Form(centre, errors.expand(3, 5, 3), torch.zeros(5, 3, dtype=torch.float64))
    wanted = torch.tensor([[1.0, -1.0]], dtype=torch.float64)
    with torch.no_grad():
        least = perceptron(layers, form, wanted)
        value = layers[1](layers[0](centre).relu()) @ wanted.T
        slope = torch.func.vmap(torch.func.jacrev(lambda x: layers[1](layers[0](x).relu()) @ wanted[0]))(centre)
    assert torch.allclose(value[:, 0] - least[:, 0], 1e-9 * slope.abs().sum(1), rtol=1e-4, atol=1e-15)


def test_the_filters_room_lies_below_what_a_smaller_box_says_anywhere_around(roads: Any):
    rng, obs = np.random.default_rng(0), roads(300).double().numpy()
    obs[:, 1:, 1] = obs[:, :1, 1] + rng.uniform(-200, 200, (300, 14)) * obs[:, 1:, 0]
    size = np.array([0, 4, 0.3, 1, 1])
    for filter_box in (Box(0, 0, 0), Box(2, 0.1, 0.5), Box(20, 1.2, 8)):
        most = margins(np, obs, 3, Box(filter_box.along - 4, filter_box.across - 0.3, filter_box.speed - 1))
        least = margins(np, obs, 3, Box(filter_box.along + 4, filter_box.across + 0.3, filter_box.speed + 1))
        for corner in [False, True] * 10:
            offset = rng.uniform(-1, 1, obs.shape)
            room = margins(np, obs + (np.sign(offset) if corner else offset) * size, 3, filter_box)
            assert (least - 1e-6 <= room).all()
            assert (room <= most + 1e-6).all()


def _memory_of(agent: QAgent) -> Memory:
    assert agent.network.memory is not None
    return agent.network.memory


def remembering(**settings: Any) -> QAgent:
    """A pupil whose memory says something."""
    agent = make(kind="rapid", memory=True, **settings)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        torch.nn.init.normal_(_memory_of(agent).out.weight, std=0.3)
    return agent


@pytest.mark.parametrize(
    "settings", [{}, {"action_token": "ego", "num_policies": 3, "top_k": 2}, {"squeeze": True}], ids=str
)
def test_bounds_hold_through_a_memory_whose_state_is_known(roads: Any, settings: dict[str, Any]):
    agent, scale = remembering(**settings), feature_scale(3) * torch.tensor([0.0, 1, 1, 1, 1])
    obs, bounds = roads(4, absent=0.4)[:, :6], Bounds(agent.network)
    state = agent.start(4)
    for action in (FASTER, LANE_RIGHT, SLOWER):
        state = agent.remember(state, np.full(4, action))
    state = torch.from_numpy(state)
    # The ego at the edges of what it knows of itself, within, and far beyond.
    place = _memory_of(agent).start_x + state[0, DISTANCE]
    obs[:, 0, 1] = place + torch.tensor([5.5, -5.5 - 0.4 * 3, 0.0, 30.0])
    obs[:, 0, 3] = state[0, SPEED] - torch.tensor([0.0, 1.5, 0.5, 8.0])
    # One car near where its lane is rounded, so that within the largest box it is read as on either.
    obs[1, 1, 0], obs[1, 1, 2] = 1, 2.03
    q = agent.network(obs, state).double()
    exact = bounds.differences(obs, obs, state)
    assert torch.allclose(exact, q[:, :, None] - q[:, None], atol=2e-5)
    for radius in (1e-5, 5e-4, 5e-3):
        least = bounds.differences(obs - radius * scale, obs + radius * scale, state)
        assert radius > 1e-4 or not least.isnan().any()
        for index in range(4):
            points = obs[index] + offsets(800, 6, index) * (scale * radius * 0.99999)
            q = agent.network(points, state[index].expand(800, -1)).double()
            found = (q[:, :, None] - q[:, None]).amin(0)
            assert bool(((found >= least[index] - 2e-5) | least[index].isnan()).all())


def test_a_certified_return_of_who_remembers_is_exact_without_a_radius_and_holds_with_one():
    agent, seed = remembering(), spawn_seeds("tune", 1)[0]
    exact = certified_return(agent, SCENARIO, seed, 0.0)
    assert exact.complete
    assert exact.least == pytest.approx(exact.clean)
    wide = certified_return(agent, SCENARIO, seed, 2e-4, width=4)
    attacked = run_episodes(agent, SCENARIO, [seed], "pgd:steps=20,radius=0.0002")
    assert wide.least <= min(exact.least, attacked.return_E[0]) + 1e-9
    (rate,) = decision_rates(agent, SCENARIO, [seed], (0.0,), 4)
    assert rate.unchanged.value == 1


@pytest.fixture(scope="module")
def decisions():
    from rapid.certify.rate import decisions_of

    return decisions_of(make(kind="mlp", vehicles=15), SCENARIO, spawn_seeds("tune", 8), 32)[0][:, :6]


@pytest.mark.parametrize("shield", ["", "0", "0.005"])
@pytest.mark.parametrize("settings", [NETWORKS[0], NETWORKS[3]], ids=str)
def test_no_attack_brings_about_an_action_that_is_ruled_out(decisions: Any, settings: dict[str, Any], shield: str):
    agent = make(**settings) if not shield else shielded(make(**settings), shield, 3)
    for radius in (5e-4, 5e-3):
        may = Reach(agent, radius).actions(decisions)
        rows = np.arange(len(decisions))
        assert may[rows, agent.act(decisions)].all()
        for spec in (f"pgd:steps=20,restarts=2,radius={radius}", f"pgd:loss=margin,steps=20,radius={radius}"):
            seen = get_attack(spec, 3)(agent.network, torch.from_numpy(decisions), torch.Generator().manual_seed(0))
            assert may[rows, agent.act(seen.numpy())].all()
        for index in rows:
            points = decisions[index] + (offsets(200, 6) * feature_scale(3) * radius * 0.99999).numpy()
            assert may[index, agent.act(points)].all()


def test_rates_fall_with_the_radius_and_the_filter_makes_every_decision_safe():
    agent, seeds = careful(), spawn_seeds("tune", 6)
    rates = decision_rates(agent, SCENARIO, seeds, (0.0, 5e-4, 5e-3, 0.1), 40)
    assert [rate.decisions for rate in rates] == [40] * 4
    unchanged = [rate.unchanged.value for rate in rates]
    assert unchanged[0] == 1
    assert unchanged == sorted(unchanged, reverse=True)
    assert rates[-1].safe.value < 1
    guarded = decision_rates(shielded(agent, "0.01", 3), SCENARIO, seeds, (5e-4, 5e-3), 40)
    assert all(rate.safe.value == 1 for rate in guarded)


def test_a_certified_return_is_what_is_earned_without_attack_and_less_with_a_radius():
    seed = spawn_seeds("tune", 2)[1]
    agent = shielded(careful(), "0.05", 3)
    exact = certified_return(agent, SCENARIO, seed, 0.0)
    assert exact.complete
    assert exact.least == pytest.approx(exact.clean)
    wide = certified_return(agent, SCENARIO, seed, 1e-3, width=8)
    assert wide.least <= exact.least
    hard = "steps=5,radius=0.001"
    for attack in (
        f"pgd:{hard}",
        f"directed:target=faster,{hard}",
        f"world:horizon=2,{hard}",
        "lie:to=far,radius=0.001",
    ):
        assert wide.least <= run_episodes(agent, SCENARIO, [seed], attack).return_E[0] + 1e-9
    # Beyond the filter's box a crash in the first step is in reach, and nobody earns less.
    beyond = certified_return(agent, SCENARIO, seed, 0.1)
    assert beyond.complete
    assert not beyond.crash_free
    assert beyond.least < 2
    cut = certified_return(agent, SCENARIO, seed, 0.0, width=0)
    assert not cut.complete
    assert cut.least == 0


def test_the_verb_writes_what_it_has_proven_and_refuses_the_rest_first(tmp_path: Path, capsys: Any):
    save_agent(tmp_path / "agent", careful().network, {"name": "pupil", "scenario": SCENARIO})

    def call(*words: str) -> int:
        with pytest.raises(SystemExit) as ended:
            main(["certify", *words, "--out", str(tmp_path / "out")])
        return int(ended.value.code or 0)

    small = ("--decisions", "12", "--spawns", "3", "--returns", "1", "--radii", "0.000001", "0.001")
    assert call(f"shield:0.01:{tmp_path}/agent", *small) == 0
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "out" / "certificate.txt").read_text()
    assert "0.2 m, 0.012 m, 0.08 m/s" in printed
    assert "return under every attack within 0.001, 1 episodes: at least" in printed
    found = json.loads((tmp_path / "out" / "certificate.json").read_text())
    assert found["shield"] == "0.01"
    assert [rate["safe"]["value"] for rate in found["decisions"]] == [1, 1]
    assert found["decisions"][0]["unchanged"]["value"] == 1
    assert found["returns"][0]["least"] == pytest.approx(found["returns"][0]["clean"])
    assert call(f"{tmp_path}/agent", *small) == 2  # another certificate is not replaced
    assert "--force" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "certificate.json").read_text()) == found
    shutil.rmtree(tmp_path / "out")
    for words, said in (
        ((str(tmp_path / "agent"), "--radii", "0.001", "0.6"), "radi"),
        ((str(tmp_path / "agent"), "--spawns", "2", "--returns", "3"), "Ask for more"),
        (("slower",), "no saved agent"),
        ((str(tmp_path / "agent"), "--scenario", f"{SCENARIO}:progress", "--returns", "1"), "never negative"),
    ):
        assert call(*words) == 2
        assert said in capsys.readouterr().err
        assert not list((tmp_path / "out").glob("certificate*"))


def test_what_cannot_be_certified_is_refused():
    from rapid.agents.open import open_agent

    agent = make(kind="mlp")
    for radius in (-0.1, float("nan"), 0.5):
        with pytest.raises(RapidError, match="within a radius"):
            Reach(agent, radius)
    with pytest.raises(RapidError, match="no network whose bounds"):
        Reach(open_agent("slower", SCENARIO), 0.01)
    with pytest.raises(RapidError, match="never negative"):
        certified_return(agent, f"{SCENARIO}:progress", 0, 0.01)
    with pytest.raises(RapidError, match="at least one decision"):
        decision_rates(agent, SCENARIO, [1], (0.01,), 0)


def test_who_always_brakes_is_proven_to():
    agent = make(kind="mlp")
    last = [layer for layer in _perceptron_of(agent) if isinstance(layer, torch.nn.Linear)][-1]
    last.weight.zero_()
    last.bias.copy_(torch.eye(5)[SLOWER])
    (rate,) = decision_rates(agent, SCENARIO, spawn_seeds("tune", 2), (0.1,), 20)
    assert rate.unchanged.value == rate.safe.value == 1
    found = certified_return(agent, SCENARIO, spawn_seeds("tune", 1)[0], 0.1)
    assert found.complete
    assert found.least == pytest.approx(found.clean)
    assert dataclasses.asdict(found)["seed"] == found.seed


def test_without_a_place_the_table_is_printed_and_nothing_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    save_agent(tmp_path / "agent", careful().network, {"name": "pupil", "scenario": SCENARIO})
    monkeypatch.chdir(tmp_path)
    for radius in ("0.001", "0.002"):
        with pytest.raises(SystemExit) as ended:
            main(["certify", "agent", "--decisions", "1", "--spawns", "1", "--radii", radius])
        assert not ended.value.code
        assert "Nothing was kept; --out DIRECTORY keeps" in capsys.readouterr().out
        assert [path.name for path in tmp_path.iterdir()] == ["agent"]
