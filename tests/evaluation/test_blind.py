"""The search for the plans of `blind`."""

import json

import numpy as np
import pytest

from rapid.agents.open import open_agent
from rapid.evaluation import blind
from rapid.evaluation.blind import plans_for, returns, search
from rapid.evaluation.rollouts import run_episodes
from rapid.spawns import spawn_seeds
from rapid.teacher.scripted import PLANS


def test_a_plan_earns_in_the_search_what_its_driver_earns_on_the_road():
    seeds, plans = spawn_seeds("tune", 6), [(3, 2, 5), (0, 0, 9)]
    for scenario in ("lane-3-density-2", "lane-3-density-2:progress"):
        found = returns(scenario, plans, seeds)
        for plan, earned in zip(plans, found, strict=True):
            driver = open_agent(f"blind:{','.join(map(str, plan))}", scenario)
            assert run_episodes(driver, scenario, seeds).return_E == pytest.approx(earned)


def test_the_best_plan_is_taken_and_test_spawns_are_never_looked_at(monkeypatch):
    asked = []

    def earned(scenario, plans, seeds):
        asked.extend(seeds)
        # On the first spawns another plan looks best; more spawns tell.
        first = seeds[0] == 800_000
        better = (2, 1, 0) if first else (1, 2, 0)
        return np.array([[9.0 if plan == better else 8.0 if plan == (1, 2, 0) else 1.0] * len(seeds) for plan in plans])

    monkeypatch.setattr(blind, "returns", earned)
    found = search("lane-3-density-2")
    assert found["plan"] == [1, 2, 0]
    assert found["plans"] == len(plans_for(3)) == 17 * 3 * 9
    assert set(asked) <= set(spawn_seeds("tune", 400))
    assert found["spawns"] == 400


def test_the_plans_in_the_package_say_where_they_come_from():
    made = json.loads(PLANS.read_text())
    assert made["made"]["command"] == "python -m rapid.evaluation.blind"
    assert set(made["plans"]) == set(blind.SCENARIOS)
    assert all(low < plan["return"] < high for plan in made["plans"].values() for low, high in [plan["interval"]])
