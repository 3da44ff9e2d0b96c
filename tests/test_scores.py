"""The scores' script: what it takes for trained, and what its table compares."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest

from rapid.config import preset, to_dict
from rapid.errors import RapidError
from rapid.networks.agent import save_agent
from rapid.networks.q_network import build_network

PATH = Path(__file__).parents[1] / "benchmarks" / "scores.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("scores", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def config():
    return preset("strong", "full")


def write_agent(home: Path, config, settings) -> None:
    save_agent(home / "agent", build_network(config.network, 3, 0), {"name": "it", "config": settings})


def test_an_agent_counts_as_trained_only_with_the_same_settings(benchmark, config, tmp_path):
    assert not benchmark.is_trained(tmp_path, config, "adapt")
    write_agent(tmp_path, config, to_dict(config))
    assert benchmark.is_trained(tmp_path, config, "adapt")
    # Where and how fast it was computed, and how it will be measured, is another matter.
    assert benchmark.is_trained(tmp_path, replace(config, threads=2), "adapt")
    other = replace(config, adapt=replace(config.adapt, loss=replace(config.adapt.loss, discount=0.8)))
    assert benchmark.is_trained(tmp_path, other, "distill")
    with pytest.raises(RapidError, match=r"adapt\.loss\.discount = 0\.9, not 0\.8"):
        benchmark.is_trained(tmp_path, other, "adapt")


def test_a_setting_that_did_not_exist_yet_had_its_default(benchmark, config, tmp_path):
    settings = to_dict(config)
    del settings["adapt"]["exploration_hold"]
    write_agent(tmp_path, config, settings)
    assert benchmark.is_trained(tmp_path, config, "adapt")


def test_methods_of_one_budget_have_the_same_steps_and_updates(benchmark, config, tmp_path, monkeypatch):
    asked: dict[str, tuple] = {}
    monkeypatch.setattr(benchmark.pipeline, "mix_datasets", lambda *_: None)
    monkeypatch.setattr(benchmark, "datasets", lambda *_: (tmp_path, tmp_path))
    monkeypatch.setattr(benchmark.pipeline, "distill_agent", lambda *_: None)
    monkeypatch.setattr(
        benchmark.pipeline,
        "adapt_agent",
        lambda config, agent, data, out, name: asked.update({name: (config.adapt, agent, data)}),
    )
    benchmark.train(
        config, "lane-3-density-2", tmp_path / "work", "lane-4-density-2.5", (10_000, 100_000, 300_000), True
    )
    for steps in ("10K", "100K", "300K"):
        of_one = [adapt for name, (adapt, *_) in asked.items() if f", {steps}" in name]
        assert len({(a.steps, a.updates_per_step, a.optimizer.batch_size, a.num_envs) for a in of_one}) == 1
        assert {a.scenario for a in of_one} == {"lane-4-density-2.5"}
        # What the baseline lacks is the distilled policy: it starts anew, explores, and sees nothing offline.
        baseline, _, data = asked[f"online DDQN, {steps}"]
        assert (baseline.train, baseline.exploration_start, baseline.offline_share, data) == ("scratch", 1.0, 0.0, None)
        assert (baseline.loss.double, baseline.loss.munchausen_weight) == (True, 0.0)
    assert asked["online Munchausen DQN, 100K"][0].loss == asked["RAPID, 100K"][0].loss
    assert "online Munchausen DQN, 10K" not in asked
