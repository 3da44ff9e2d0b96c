import json
from pathlib import Path

import numpy as np
import pytest

import rapid
from rapid.agents.onnx import OnnxAgent, driven_observations, export_onnx
from rapid.agents.open import open_agent
from rapid.agents.shipped import CARD_FILE, ONNX_FILE, agent_folder, card, listing, shipped_adversaries, shipped_agents
from rapid.agents.specs import own_scenario
from rapid.errors import RapidError
from rapid.evaluation.rollouts import evaluate_agent, run_episodes
from rapid.files import sha256
from rapid.options import Adversary
from rapid.parsing import parse
from rapid.scenarios import PAPER_SCENARIOS
from rapid.spawns import spawn_seeds
from rapid.tool_options import Certify

NAMES = shipped_agents()


def test_there_are_some():
    drivers = ("distilled", "mlp", "monitored", "rapid", "rapid-10k", "robust", "squeezed", "wary")
    everywhere = {f"{scenario}/{name}" for scenario in PAPER_SCENARIOS for name in drivers}
    assert everywhere | {"lane-3-density-2/guided"} == set(NAMES)
    assert shipped_adversaries() == tuple(f"{scenario}/adversary" for scenario in PAPER_SCENARIOS)
    assert sum(path.stat().st_size for name in NAMES for path in agent_folder(f"shipped:{name}").iterdir()) < 10e6


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_agent_is_what_its_card_says(name: str):
    folder, about = agent_folder(f"shipped:{name}"), card(name)
    assert about["name"] == f"shipped:{name}"
    assert about["scenario"] == name.partition("/")[0]
    weights = sorted(folder.glob("**/weights.safetensors"))  # of a monitored agent two, the calm one first
    assert about["weights_sha256"] == " ".join(map(sha256, weights))
    assert {"none", "uniform", "gaussian", "fgsm", "pgd", "worst"} <= about["scores"].keys()
    assert about["floors"].keys() == {"slower", "immune", "blind"}
    assert about["attacks"].keys() == {"uniform", "gaussian", "fgsm", "pgd"}
    assert all(about[said] for said in ("summary", "recipe", "data", "scores_are", "commit", "limits"))
    assert about["scores"]["none"]["interval"][0] <= about["scores"]["none"]["return"]
    for path in (folder / CARD_FILE, folder / "config.json"):
        # Nothing of the machine on which it was made.
        assert not any(word in path.read_text() for word in ("/home/", "/work/", "/tmp/", "/root/"))
    if isinstance(about["onnx"], dict):
        assert about["onnx"]["sha256"] == sha256(folder / ONNX_FILE)


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_agent_drives_as_its_onnx_file_does(name: str):
    scenario = name.partition("/")[0]
    agent, seeds = rapid.load_agent(f"shipped:{name}"), spawn_seeds("tune", 3)
    ours = run_episodes(agent, scenario, seeds)
    theirs = run_episodes(OnnxAgent(agent_folder(f"shipped:{name}") / ONNX_FILE), scenario, seeds)
    assert np.allclose(ours.return_E, theirs.return_E)


def test_what_committed_results_go_on_from_is_what_it_was():
    # Their cells name a shipped agent and know nothing of its weights: whoever ships another measures those rows anew.
    origins = {
        "lane-3-density-2/rapid": "7d8cc2e8bfd715b4",
        "lane-4-density-2.5/rapid": "d14c3b6f275ef58a",
        "lane-5-density-3/rapid": "0b60a3a58a1e7d21",
    }
    for name, digest in origins.items():
        assert sha256(agent_folder(f"shipped:{name}") / "weights.safetensors").startswith(digest), name


def test_names_are_taken_wherever_an_agent_is_expected():
    assert own_scenario(["slower", "shipped:lane-3-density-2/robust"]) == "lane-3-density-2"
    assert open_agent("shipped:lane-3-density-2/robust", "lane-3-density-2").act is not None
    assert "shipped:lane-3-density-2/robust" in listing()
    with pytest.raises(RapidError, match="did you mean 'lane-3-density-2/robust'"):
        rapid.load_agent("shipped:lane-3-density-2/robus")
    with pytest.raises(RapidError, match="different scenarios"):
        own_scenario(["shipped:lane-3-density-2/robust", "shipped:lane-4-density-2.5/robust"])


def test_cards_are_json_that_a_reader_can_use():
    for name in NAMES:
        assert json.loads(Path(agent_folder(f"shipped:{name}") / CARD_FILE).read_text())["licence"] == "Apache-2.0"


@pytest.mark.parametrize("name", shipped_adversaries())
def test_a_shipped_adversary_attacks_the_agent_that_its_card_names_and_no_other(name: str):
    about = card(name)
    assert about["weights_sha256"] == sha256(agent_folder(f"shipped:{name}") / "weights.safetensors")
    assert f"shipped:{name}: {about['summary']}" in listing()
    victim, seeds = rapid.load_agent(about["victim"]), spawn_seeds("tune", 2)
    attack = f"adversary:shipped:{name}"
    assert {row.attack for row in evaluate_agent(victim, about["scenario"], seeds, (attack,))} == {attack}
    other = rapid.load_agent(f"shipped:{about['scenario']}/distilled")
    with pytest.raises(RapidError, match="was trained against another agent"):
        evaluate_agent(other, about["scenario"], seeds, (attack,))
    with pytest.raises(RapidError, match="drives nothing itself"):
        open_agent(f"shipped:{name}", about["scenario"])


def test_an_exported_agent_and_an_adversary_s_victim_know_where_they_belong(tmp_path):
    agent = rapid.load_agent("shipped:lane-4-density-2.5/distilled")
    seeds = spawn_seeds("tune", 1)
    export_onnx(agent, tmp_path / "it.onnx", *driven_observations(agent, "lane-4-density-2.5", seeds))
    assert own_scenario([str(tmp_path / "it.onnx")]) == "lane-4-density-2.5"
    for words in (["shipped:lane-4-density-2.5/distilled"], [str(tmp_path / "it.onnx")]):
        for verb, kind in (("adversary", Adversary), ("certify", Certify)):
            assert parse(verb, {verb: kind}, words)[1].scenario == "lane-4-density-2.5"
