"""Episodes as the player reads them, and recordings as they are kept."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from samples import SCENARIO, recording

from rapid.agents.open import open_agent
from rapid.agents.saved import QAgent
from rapid.attacks.spec import parse_attack
from rapid.config import NetworkConfig
from rapid.evaluation.recording import Recording, explained_by, follow, load_recordings, save_recordings
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.pages.episodes import moving_picture, side_by_side
from rapid.phases.measure import crashes_of
from rapid.presets import preset


@pytest.fixture(scope="module")
def agent() -> QAgent:
    network = build_network(NetworkConfig(kind="rapid", width=16, layers=1, decoder_layers=1, heads=2), 3, seed=1)
    network.gate.data.fill_(0.5)  # type: ignore[union-attr]
    return QAgent(network.eval(), "mixture")


@pytest.fixture(scope="module")
def attacked(agent: QAgent) -> Recording:
    found = run_episodes(agent, SCENARIO, [900_000], "uniform", record=True).recordings[0]
    return explained_by(agent, found)


def test_a_recording_keeps_what_the_agent_was_made_to_see(agent: QAgent, attacked: Recording) -> None:
    assert attacked.seen_TVF is not None
    assert attacked.seen_TVF.shape == attacked.obs_TVF[:-1].shape
    # The agent decided by it, and the noise is within its size: 0.2 is 40 m along the road.
    assert (agent.act(attacked.seen_TVF) == attacked.action_T).all()
    off = np.abs(attacked.seen_TVF - attacked.obs_TVF[:-1])[..., 1]
    assert 1 < off.max() <= 40.001


def test_routing_and_attention_are_those_at_what_was_seen(agent: QAgent, attacked: Recording) -> None:
    found = agent.explain(attacked.seen_TVF)
    assert attacked.weights_TVN is not None
    assert attacked.attention_TV is not None
    assert attacked.weights_TVN.shape == (len(attacked.action_T), 15, 2)
    np.testing.assert_array_equal(attacked.weights_TVN, found.weights_BVN.numpy())
    assert attacked.attention_TV.shape == (len(attacked.action_T), 15)
    assert (attacked.attention_TV.sum(1) <= 1 + 1e-5).all()


def test_recordings_come_back_as_they_were(tmp_path: Path, attacked: Recording) -> None:
    save_recordings(tmp_path / "r.json", [attacked, recording()])
    first, second = load_recordings(tmp_path / "r.json")
    for name in ("obs_TVF", "seen_TVF", "weights_TVN", "attention_TV", "q_TA"):
        np.testing.assert_array_equal(getattr(first, name), getattr(attacked, name))
    assert (second.seen_TVF, second.weights_TVN, second.attention_TV) == (None, None, None)


def test_a_recording_of_an_earlier_version_is_read(tmp_path: Path, attacked: Recording) -> None:
    import json

    save_recordings(tmp_path / "r.json", [attacked])
    content = json.loads((tmp_path / "r.json").read_text())
    for name in ("seen", "weights", "attention", "policies"):
        del content["episodes"][0][name]
    (tmp_path / "r.json").write_text(json.dumps(content))
    assert load_recordings(tmp_path / "r.json")[0].weights_TVN is None


def test_ghosts_are_told_only_where_the_agent_was_deceived(attacked: Recording) -> None:
    picture = moving_picture(attacked)
    assert len(picture["seen"]) == len(picture["actions"])
    row, x, y, vx, vy = picture["seen"][0][1]
    np.testing.assert_allclose([x, y, vx, vy], attacked.seen_TVF[0, row, 1:5], atol=0.006)
    honest = replace(attacked, seen_TVF=attacked.obs_TVF[:-1])
    assert set(moving_picture(honest)["seen"]) == {None}
    assert moving_picture(replace(attacked, seen_TVF=None))["seen"] is None


def test_following_vehicle_by_vehicle_is_following_the_whole_episode(attacked: Recording) -> None:
    whole, before, born = attacked.tracks(), None, 1
    for scene_VF, expected_V in zip(attacked.obs_TVF, whole, strict=True):
        tracks_V = follow(scene_VF, before, born)
        np.testing.assert_array_equal(tracks_V, expected_V)
        before, born = (scene_VF, tracks_V), max(born, int(tracks_V.max()) + 1)


def test_undisturbed_episodes_come_first_and_empty_ones_are_left_out(attacked: Recording) -> None:
    empty = replace(recording(), action_T=np.zeros(0, np.int64))
    drawn = side_by_side([attacked, empty, recording()])
    assert [episode["attack"] for episode in drawn] == ["none", "uniform"]


def test_a_run_keeps_the_first_crashes_of_learned_agents_as_they_were(agent: QAgent) -> None:
    seeds, spec = range(900_000, 900_006), parse_attack("uniform")
    measured = run_episodes(agent, "lane-5-density-3", seeds, "uniform")
    assert measured.crashed_E.any()
    kept = crashes_of(replace(preset(), seed=0), agent, [(spec, measured)])
    assert [recording.seed for recording in kept] == measured.seed_E[measured.crashed_E][:1].tolist()
    first = int(measured.crashed_E.argmax())
    assert len(kept[0].action_T) == measured.length_E[first]
    assert kept[0].reward_T.sum() == pytest.approx(measured.return_E[first])
    assert kept[0].attack == "uniform"
    assert crashes_of(preset(), agent, [(spec, replace(measured, kind="planner"))]) == []


def test_of_a_scripted_driver_a_crash_is_kept_and_of_those_alike_one() -> None:
    driver = open_agent("faster", SCENARIO)
    seeds, attacks = range(900_000, 900_004), [parse_attack(text) for text in ("none", "lie:to=far", "uniform")]
    driven = [(attack, run_episodes(driver, SCENARIO, seeds, attack)) for attack in attacks]
    kept = crashes_of(preset(), driver, driven)
    assert [(recording.agent, recording.attack) for recording in kept] == [("faster", "none")]
    ruled = open_agent("rule", SCENARIO)
    under = [(attack, run_episodes(ruled, SCENARIO, range(900_000, 900_030), attack)) for attack in attacks[1:]]
    assert [recording.attack for recording in crashes_of(preset(), ruled, under)] == ["lie", "uniform"]
