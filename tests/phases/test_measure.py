"""`rapid evaluate` under attack: presets, floors, worst case, adversaries, several processes."""

from dataclasses import replace

import pytest

from rapid.agents.saved import load_agent, save_agent
from rapid.attacks.adversary import fingerprint, save_adversary
from rapid.attacks.spec import parse_attack
from rapid.config import Config, EvaluateConfig, NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.metrics import load_rows
from rapid.networks.q_network import build_network
from rapid.phases.adversary import train
from rapid.phases.measure import compare


@pytest.fixture
def agent(tmp_path):
    folder = tmp_path / "agent"
    save_agent(folder, build_network(NetworkConfig(kind="mlp", hidden=(16,)), 3, 1), {"name": "tiny"})
    return str(folder)


def config(*attacks, **evaluate):
    return replace(Config(), evaluate=EvaluateConfig(spawns=2, attacks=attacks, adversary_steps=100, **evaluate))


def test_a_preset_brings_floors_and_the_worst_case_and_an_adversary_is_trained_once(agent, tmp_path):
    settings = config("paper", "lie:to=near", "directed:steps=2", "adversary:steps=2")
    rows = compare(settings, [agent], tmp_path / "out")
    assert {row.agent for row in rows} == {"tiny", "slower", "immune", "blind"}
    assert {row.attack for row in rows if row.agent == "tiny"} == {
        "none", "uniform", "gaussian", "fgsm", "pgd", "lie:to=near", "directed:steps=2", "adversary:steps=2"
    }  # fmt: skip
    assert {row.attack for row in rows if row.agent == "blind"} == {"none", "uniform", "gaussian", "lie:to=near"}
    text = (tmp_path / "out" / "summary.txt").read_text()
    assert "worst case" in text
    assert "within 0.1 (20 m along, 1.2 m across, 8 m/s)" in text
    (adversary,) = (tmp_path / "out" / "adversaries").iterdir()
    assert load_agent(adversary).metadata["adversary_of"] == fingerprint(load_agent(agent).network)
    assert compare(settings, [agent], tmp_path / "out") == rows
    assert load_rows(tmp_path / "out" / "episodes.parquet") == rows


def test_several_processes_measure_the_same(agent, tmp_path):
    attacks = ("none", "pgd:steps=2,start=random", "lie:to=drawn")
    alone = compare(config(*attacks), [agent], tmp_path / "alone")
    together = compare(config(*attacks, workers=3), [agent], tmp_path / "together")
    timeless = [[replace(row, decision_ms=0.0) for row in rows] for rows in (alone, together)]
    assert timeless[0] == timeless[1]


def test_an_adversary_of_another_agent_is_refused_before_anything_is_driven(agent, tmp_path):
    other = tmp_path / "other"
    save_agent(other, build_network(NetworkConfig(kind="mlp", hidden=(16,)), 3, 2), {"name": "other"})
    director = build_network(NetworkConfig(kind="mlp", hidden=(8,)), 3, 0)
    save_adversary(tmp_path / "its", director, load_agent(other), "lane-3-density-2", parse_attack("adversary"), 10)
    with pytest.raises(RapidError, match="trained against another agent than 'tiny'"):
        compare(config("none", f"adversary:{tmp_path / 'its'}"), ["slower", agent], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(RapidError, match="did you mean 'suite'"):
        compare(config("suit"), [agent], tmp_path / "out")


def test_the_command_trains_one_and_says_what_it_cannot_train(agent, tmp_path):
    before, after = train(agent, "lane-3-density-2", "adversary:steps=2,radius=0.05", 60, tmp_path / "its")
    assert min(before, after) > 0
    metadata = load_agent(tmp_path / "its").metadata
    assert metadata["attack"] == "adversary:steps=2,radius=0.05"
    rows = compare(config("none", f"adversary:{tmp_path / 'its'},radius=0.05"), [agent], tmp_path / "out")
    assert len(rows) == 4
    with pytest.raises(RapidError, match="must describe the adversary"):
        train(agent, "lane-3-density-2", "pgd", 60, tmp_path / "no")
    with pytest.raises(RapidError, match="--steps is 0"):
        train(agent, "lane-3-density-2", "adversary", 0, tmp_path / "no")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("spec", ["{}", "shield:0:{}", "smooth:2:{}", "monitored:{},{}"])
def test_what_was_measured_of_an_agent_is_not_taken_for_another_in_its_place(tmp_path, spec):
    made = {"name": "tiny", "scenario": "lane-3-density-2"}
    for seed in (1, 2):
        save_agent(tmp_path / "agent", build_network(NetworkConfig(kind="mlp", hidden=(16,)), 3, seed), made)
        request = [config("none"), [spec.format(*[tmp_path / "agent"] * 2)], tmp_path / "out"]
        if seed == 2:
            with pytest.raises(RapidError, match="--force"):
                compare(*request)
        else:
            assert compare(*request) == compare(*request)


def test_nor_what_was_measured_under_the_attack_of_another_agent(agent, tmp_path):
    for seed in (1, 2):
        save_agent(tmp_path / "other", build_network(NetworkConfig(kind="mlp", hidden=(16,)), 3, seed), {"name": "o"})
        request = [config("none", f"transfer:{tmp_path / 'other'},steps=2"), [agent], tmp_path / "out"]
        if seed == 2:
            with pytest.raises(RapidError, match="--force"):
                compare(*request)
        else:
            compare(*request)


def test_attacks_that_cannot_be_made_are_named_before_anything_is_driven(agent, tmp_path, capsys):
    with pytest.raises(RapidError, match="On 'slower' these attacks cannot be made: fgsm, pgd"):
        compare(config("fgsm", "pgd"), [agent, "slower"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    rows = compare(config("none", "fgsm", "uniform"), [agent, "rule"], tmp_path / "out")
    assert {row.attack for row in rows if row.agent == "rule"} == {"none", "uniform"}
    assert "On 'rule' these attacks cannot be made: fgsm." in capsys.readouterr().err


def test_a_preset_brings_the_floors_that_are_not_named_already(agent, tmp_path):
    rows = compare(config("paper"), ["slower", agent], tmp_path / "out")
    assert list(dict.fromkeys(row.agent for row in rows)) == ["slower", "tiny", "immune", "blind"]
