"""The interval filter around agents of every kind: what it lets pass, by spec, saved, attacked and exported."""

import dataclasses

import numpy as np
import pytest
import torch

from rapid.agents.open import check_road, kind_of, network_agent, open_agent
from rapid.agents.saved import QAgent, load_agent, save_agent
from rapid.agents.shielded import shielded
from rapid.attacks import get_attack
from rapid.cli import main
from rapid.config import Config, NetworkConfig
from rapid.config_io import validate
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.safety import IntervalFilter
from rapid.scenarios import FASTER, SLOWER
from rapid.simulator import make_vec
from rapid.spawns import spawn_seeds

SCENARIO = "lane-3-density-2"
SMALL = {"width": 16, "heads": 2, "feedforward": 32, "layers": 1, "hidden": (16,)}


def make(**settings) -> QAgent:
    return QAgent(build_network(NetworkConfig(**{**SMALL, **settings}), 3, 0), "pupil")


@pytest.fixture(scope="module")
def driven() -> np.ndarray:
    """Observations of traffic that thins out, from a driver that brakes and later does as it likes."""
    env, rng = make_vec(SCENARIO, 24, autoreset=False), np.random.default_rng(0)
    obs, _ = env.reset(seed=spawn_seeds("tune", 24))
    met = [obs]
    for step in range(25):
        action = np.where(rng.random(24) < step / 25, rng.integers(0, 5, 24), SLOWER)
        met.append(env.step(action)[0])
    return np.concatenate(met)


@pytest.mark.parametrize("kind", ["rapid", "mlp"])
def test_a_network_behind_the_filter_takes_the_best_action_that_passes(driven, kind):
    agent = make(kind=kind)
    for box in ("0", "0.02", "1m,0.5"):
        guarded = shielded(agent, box, 3)
        passes, q = IntervalFilter(3, box).passes(driven), agent.q_values(driven)
        chosen = guarded.act(driven)
        assert (chosen == np.where(passes, q, -np.inf).argmax(1)).mean() > 0.999  # but for single precision
        assert (chosen != agent.act(driven)).mean() > 0.1
        assert guarded.name == f"shield:{box}:pupil"
    assert agent.network.config.shield == ""  # left as it was


def test_no_attack_within_the_box_makes_it_do_what_is_not_safe_in_truth(driven):
    agent = shielded(make(kind="mlp"), "0.05", 3)
    obs, free = torch.from_numpy(driven), IntervalFilter(3, "0")
    changed = 0
    for spec in ("fgsm:radius=0.05", "pgd:steps=10,radius=0.05", "uniform:radius=0.05"):
        seen = get_attack(spec, 3)(agent.network, obs, torch.Generator().manual_seed(0)).numpy()
        chosen = agent.act(seen)
        changed += int((chosen != agent.act(driven)).sum())
        assert free.passes(driven)[np.arange(len(chosen)), chosen].all()
    assert changed > 100


def test_every_kind_of_driver_can_stand_behind_the_filter(driven):
    for name in ("faster", "random", "planner-observation"):
        guarded = open_agent(f"shield:0.02:{name}", SCENARIO)
        assert guarded.name == f"shield:0.02:{name}"
        assert guarded.kind == kind_of(open_agent(name, SCENARIO))
        episodes = run_episodes(guarded, SCENARIO, spawn_seeds("tune", 4))
        assert episodes.agent == guarded.name
        assert episodes.counts_EA[:, SLOWER].sum() > 0
    guarded = open_agent("shield:0.02:faster", SCENARIO)
    decisions = guarded.decide(driven, [None] * len(driven))
    passes = IntervalFilter(3, "0.02").passes(driven)
    assert [decision.action for decision in decisions] == np.where(passes[:, FASTER], FASTER, SLOWER).tolist()
    assert all(("filter brakes" in decision.explanation) is (decision.action == SLOWER) for decision in decisions)
    env = make_vec(SCENARIO, 3, autoreset=False)
    obs, _ = env.reset(seed=7)
    bound = open_agent("shield:0:planner-cars", SCENARIO).bind(env)
    assert IntervalFilter(3, "0").passes(obs)[np.arange(3), bound.act(obs)].all()


def test_behind_the_filter_faster_crashes_no_more_than_slower():
    seeds = spawn_seeds("tune", 120)
    crashed = {
        spec: run_episodes(open_agent(spec, SCENARIO), SCENARIO, seeds).crashed_E.sum()
        for spec in ("slower", "faster", "shield:0:faster", "shield:0.1:faster")
    }
    assert crashed["faster"] > 100
    assert max(crashed["shield:0:faster"], crashed["shield:0.1:faster"]) <= crashed["slower"] < 15


def test_a_saved_agent_keeps_its_filter_and_a_spec_gives_it_one(driven, tmp_path):
    plain = make(kind="mlp")
    save_agent(tmp_path / "plain", plain.network, {"name": "pupil"})
    save_agent(tmp_path / "guarded", shielded(plain, "0.02", 3).network, {"name": "guarded"})
    saved, named = load_agent(tmp_path / "guarded"), open_agent(f"shield:0.02:{tmp_path}/plain", SCENARIO)
    assert saved.network.config.shield == "0.02"
    assert np.array_equal(saved.q_values(driven), named.q_values(driven))
    assert saved.shielded_lanes == 3
    with pytest.raises(RapidError, match="filter for roads with 3 lanes"):
        check_road(saved, "lane-4-density-2.5")
    with pytest.raises(RapidError, match="filter for roads with 3 lanes"):
        check_road(open_agent("shield:0:faster", SCENARIO), "lane-4-density-2.5")


@pytest.mark.parametrize(
    "settings", [{"kind": "rapid"}, {"kind": "mlp", "mirror": True}, {"kind": "mlp", "vehicles": 20}]
)
@pytest.mark.parametrize("box", ["0", "0.02", "1m,0.5"])
def test_policy_and_filter_export_as_one_model(driven, tmp_path, settings, box):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from rapid.agents.onnx import OnnxAgent, export_onnx

    agent = shielded(make(**settings), box, 3)
    obs = np.pad(driven, ((0, 0), (0, agent.vehicles - 15), (0, 0)))
    parity = export_onnx(agent, tmp_path / "guarded.onnx", obs)
    assert parity.difference < 1e-3
    assert parity.agreement > 0.999
    exported = OnnxAgent(tmp_path / "guarded.onnx")
    assert exported.metadata["shield"] == box
    assert exported.shielded_lanes == 3
    passes = IntervalFilter(3, box).passes(obs)[np.arange(len(obs)), exported.act(obs)]
    assert passes.mean() > 0.999


def test_the_verb_exports_the_filter_with_the_policy(tmp_path):
    pytest.importorskip("onnxruntime")
    save_agent(tmp_path / "agent", make(kind="mlp").network, {"name": "pupil", "scenario": SCENARIO})
    with pytest.raises(SystemExit) as ended:
        main(["export", f"shield:0.1:{tmp_path}/agent", "--out", str(tmp_path / "guarded.onnx")])
    assert ended.value.code == 0
    guarded = open_agent(str(tmp_path / "guarded.onnx"), SCENARIO)
    assert guarded.metadata["shield"] == "0.1"


def test_specs_and_settings_that_make_no_sense_are_refused(tmp_path):
    for spec in ("shield:-0.1:slower", "shield:nan:slower", "shield:0.7:slower"):
        with pytest.raises(RapidError, match="cannot allow for"):
            open_agent(spec, SCENARIO)
    for spec in ("shield:0.1", "shield:0.1:"):
        with pytest.raises(RapidError, match="does not say what is shielded"):
            open_agent(spec, SCENARIO)
    with pytest.raises(RapidError, match="no agent 'nobody'"):
        open_agent("shield:0.1:nobody", SCENARIO)
    with pytest.raises(RapidError, match="no saved agent"):
        network_agent("shield:0.1:slower")
    config = Config()
    for section in ("network", "adapt"):
        wrong = dataclasses.replace(config, **{section: dataclasses.replace(getattr(config, section), shield="wide")})
        with pytest.raises(RapidError, match="cannot allow for"):
            validate(wrong)
    with pytest.raises(RapidError, match="cannot allow for"):
        build_network(NetworkConfig(shield="-1"), 3, 0)
