"""The figures of what survives attacks: their points are the means they say, and rows that do not fit are refused."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow

PATH = Path(__file__).parents[2] / "benchmarks" / "robustness_figures.py"


def rows_of(agent: str, attack: str, returns: list[float], scenario: str = "lane-3-density-2") -> list[EpisodeRow]:
    shares = (0.0, 1.0, 0.0, 0.0, 0.0)
    made: list[EpisodeRow] = []
    for seed, earned in enumerate(returns):
        crashed = earned < 5
        made.append(EpisodeRow(scenario, agent, seed, attack, earned, 30, crashed, 20.0, 600.0, 0, 1.0, shares))
    return made


@pytest.fixture(scope="module")
def figures() -> Any:
    spec = importlib.util.spec_from_file_location("robustness_figures", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_agents_point_is_its_clean_mean_and_the_mean_of_its_least_returns(figures: Any):
    rows = rows_of("bold", "none", [20, 22]) + rows_of("bold", "fgsm", [2, 21]) + rows_of("bold", "pgd", [9, 3])
    rows += rows_of("slower", "none", [19, 19])
    bold, slower = figures.points(rows)
    assert (bold.clean.value, bold.worst.value, bold.crashed.value) == (21, 2.5, 1)
    assert (slower.clean.value, slower.worst.value) == (19, 19)
    axes = figures.trade_off(rows).axes[0]
    assert axes.get_legend_handles_labels()[1] == ["bold", "always-slower"]
    assert "2.5" in figures.table(rows)


def test_no_two_agents_look_the_same(figures: Any):
    rows = [row for name in range(20) for row in rows_of(f"agent {name}", "none", [name, name + 1])]
    axes = figures.trade_off(rows).axes[0]
    looks = {(container[0].get_color(), container[0].get_marker()) for container in axes.containers}
    assert len(looks) == len(axes.containers) == 20


def test_rows_of_two_roads_and_agents_without_clean_rows_are_refused(figures: Any):
    with pytest.raises(RapidError, match="of one scenario"):
        figures.points(rows_of("bold", "none", [1]) + rows_of("bold", "none", [1], "lane-4-density-2.5"))
    with pytest.raises(RapidError, match="not driven without attack"):
        figures.points(rows_of("bold", "fgsm", [1]))
