"""What an agent is must not depend on what it is called."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rapid.agents.open import open_agent
from rapid.agents.origin import OTHER, origin_of
from rapid.agents.q_agent import QAgent
from rapid.agents.saved import save_agent
from rapid.agents.shielded import shielded
from rapid.baselines import offline_baseline, online_baseline
from rapid.config import Config, EvaluateConfig, NetworkConfig
from rapid.config_io import parts_of
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.phases.adapt import _robust_weight
from rapid.phases.measure import compare
from rapid.presets import preset

SCENARIO = "lane-3-density-2"
SMALL: dict[str, Any] = {"width": 16, "layers": 1, "decoder_layers": 1, "heads": 2, "hidden": (8,)}


def trained(config: Config, phase: str, name: str = "any", **more: Any) -> QAgent:
    network = build_network(replace(NetworkConfig(kind=config.network.kind), **SMALL), 3, 0)
    parts = parts_of(config, "network", phase)
    return QAgent(network, name, {"name": name, "phase": phase, "config": parts, **more})


def without_robust(config: Config) -> Config:
    return replace(config, distill=replace(config.distill, loss=replace(config.distill.loss, robust_weight=0.0)))


def test_what_was_trained_is_known_by_its_settings() -> None:
    config = preset("paper")
    lied = replace(config.adapt, adversary=replace(config.adapt.adversary, gradient_share=0.5))
    found = {
        "distilled": trained(config, "distill"),
        "distilled-without-robust": trained(without_robust(config), "distill"),
        "offline-dqn": trained(offline_baseline(config, "dqn"), "distill"),
        "offline-ddqn": trained(offline_baseline(config, "ddqn"), "distill"),
        "cql": trained(offline_baseline(config, "cql"), "distill"),
        "bc": trained(offline_baseline(config, "bc"), "distill"),
        "rapid": trained(config, "adapt"),
        "rapid-without-robust": trained(config, "adapt", robust_weight=0.0),
        "rapid-robust": trained(replace(config, adapt=lied), "adapt"),
        "online-dqn": trained(online_baseline(config, "dqn"), "adapt"),
        OTHER: trained(online_baseline(config, "ddqn"), "adapt"),
    }
    assert {origin: origin_of(agent) for origin, agent in found.items()} == {origin: origin for origin in found}
    assert origin_of(shielded(found["rapid"], "0.1", 3)) == "rapid+shield"
    # What is only called so is not that; nor is there anything that metadata of others may break.
    network = found["cql"].network
    for metadata in ({}, {"name": "cql"}, {"phase": "distill", "config": "cql"}, {"phase": "adapt", "config": [1]}):
        assert origin_of(QAgent(network, "cql", metadata)) == OTHER
    config = {"adapt": {"train": "adapter", "adversary": {"gradient_share": "1"}}}
    assert origin_of(QAgent(found["rapid"].network, "x", {"phase": "adapt", "config": config})) == "rapid"


def test_an_adapted_agent_keeps_how_it_was_distilled() -> None:
    distilled = trained(without_robust(preset()), "distill")
    assert _robust_weight(distilled.metadata) == 0
    assert _robust_weight({"robust_weight": 0.1}) == 0.1
    assert _robust_weight({}) is None


@pytest.mark.parametrize("spec", ["slower", "blind", "blind:5,2,4", "planner", "planner-cars", "planner-observation"])
def test_drivers_are_what_their_spec_says(spec: str) -> None:
    agent = open_agent(spec, SCENARIO)
    agent.name = "renamed"
    assert origin_of(agent) == spec
    assert origin_of(open_agent(f"shield:0.1:{spec}", SCENARIO)) == OTHER


def test_the_rows_say_it() -> None:
    driver = open_agent("slower", SCENARIO)
    driver.name = "cql"
    (row,) = run_episodes(driver, SCENARIO, [900_000]).rows()
    assert (row.agent, row.origin, row.what) == ("cql", "slower", "slower")


def test_what_is_called_as_a_driver_is_not_shown_as_that_driver(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    save_agent(folder, build_network(NetworkConfig(kind="mlp", hidden=(8,)), 3, 1), {"name": "slower"})
    settings = replace(preset(), evaluate=EvaluateConfig(spawns=1, attacks=("none",)))
    rows = compare(settings, [str(folder)])
    assert [(row.agent, row.origin) for row in rows] == [(f"slower ({folder})", OTHER)]
    assert [row.agent for row in compare(settings, ["slower"])] == ["slower"]
