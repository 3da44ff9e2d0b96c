"""The transcription of the paper's tables: complete, and consistent wherever two tables print the same number."""

import itertools
from dataclasses import replace

import pytest

from rapid.attacks.spec import NAMED, parse_attack
from rapid.experiments.exhibit import Request
from rapid.experiments.paper import paper_numbers, paper_result
from rapid.presets import preset
from rapid.scenarios import PAPER_SCENARIOS, TARGET_SPEEDS, get_scenario

ATTACKS = ("none", "uniform", "gaussian", "fgsm", "pgd")


def test_every_table_is_complete() -> None:
    numbers = paper_numbers()
    expected = {"attack": (4, 5), "offline": (3, 5), "architecture": (3, 6), "beta": (4, 5)}
    for table, (rows_each, results_each) in expected.items():
        rows = numbers[table]["rows"]
        assert [row["scenario"] for row in rows] == [s for s in PAPER_SCENARIOS for _ in range(rows_each)]
        for row in rows:
            results = [value for value in row.values() if isinstance(value, list)]
            assert len(results) == results_each
            assert all(len(result) == 2 and 0 < result[0] < 30 and 0 < result[1] < 10 for result in results)


def test_tables_that_repeat_each_other_agree() -> None:
    for scenario, attack in itertools.product(PAPER_SCENARIOS, ATTACKS):
        ours = paper_result("attack", attack, scenario=scenario, method="RAPID")
        assert ours == paper_result("beta", attack, scenario=scenario, beta=0.5)
        without = paper_result("attack", attack, scenario=scenario, method="RAPID without robust term")
        assert without == paper_result("beta", attack, scenario=scenario, beta=0.0)
    for scenario, dataset in itertools.product(PAPER_SCENARIOS, ("random", "llm", "mixed")):
        where = {"scenario": scenario, "dataset": dataset}
        for name in ("cql", "dqn", "ddqn"):
            assert paper_result("offline", name, **where) == paper_result("architecture", f"mlp_{name}", **where)
        assert paper_result("offline", "rapid", **where) == paper_result("architecture", "attentive_dqn", **where)
    for scenario in PAPER_SCENARIOS:
        offline = paper_result("offline", "dqn", scenario=scenario, dataset="mixed")
        assert offline == paper_result("attack", "none", scenario=scenario, method="Offline DQN")


def test_our_settings_are_the_papers() -> None:
    environment = paper_numbers()["environment"]
    for name, lanes, density in zip(
        PAPER_SCENARIOS, environment["lanes_count"], environment["vehicles_density"], strict=True
    ):
        config = get_scenario(name).config()
        assert (config["lanes_count"], config["vehicles_density"]) == (lanes, density)
        assert config["duration"] == environment["duration"]
        assert config["observation"]["features"] == environment["observation_features"]
    speeds = environment["action_target_speeds"]
    assert (TARGET_SPEEDS[0], TARGET_SPEEDS[-1], len(TARGET_SPEEDS)) == (
        speeds["start"],
        speeds["stop"],
        speeds["count"],
    )
    assert preset("paper", "full").mix.p == paper_numbers()["text"]["teacher_share"]


def test_what_the_paper_does_not_have_is_none() -> None:
    assert paper_result("attack", "none", scenario="lane-9-density-9", method="RAPID") is None
    assert paper_result("attack", "strange", scenario="lane-3-density-2", method="RAPID") is None


@pytest.mark.parametrize("recipe", ["paper", "strong"])
def test_our_attacks_are_the_papers(recipe) -> None:
    for name in ATTACKS:
        text = Request(recipe, "full").attack(name)
        spec = parse_attack(text)
        assert spec.name == text
        free = recipe == "paper" and name != "none"
        assert spec == replace(NAMED[name], presence="free" if free else "masked"), text
