"""Paired differences of methods: signs, what is missing, and that every pair can be driven."""

from dataclasses import replace
from pathlib import Path

import pytest

from rapid.evaluation.metrics import EpisodeRow, load_rows
from rapid.evaluation.statistics import Estimate
from rapid.experiments.differences import PAIRS, cells, difference, show, told
from rapid.experiments.exhibit import Request
from rapid.experiments.exhibits import ALL
from rapid.experiments.store import Store
from rapid.experiments.tables import Facts

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def row() -> EpisodeRow:
    return load_rows(ROOT / "results" / "defences.parquet")[0]


def driven(row: EpisodeRow, returns: list[list[float]]) -> list[EpisodeRow]:
    """Episodes of one training a list, one spawn a number."""
    return [
        replace(row, seed=spawn, training_seed=training, episode_return=value)
        for training, values in enumerate(returns)
        for spawn, value in enumerate(values)
    ]


def test_it_is_ours_less_theirs_over_the_spawns_of_both(row: EpisodeRow):
    found = difference(driven(row, [[3, 5, 100], [5, 7, 100]]), driven(row, [[1, 2]]))
    assert found is not None
    assert found.value == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert found.low <= found.value <= found.high
    assert difference([], driven(row, [[1, 2]])) is None
    assert difference(driven(row, [[1, 2]]), []) is None


def test_it_is_told_with_its_sign():
    assert told(None) == "–"
    assert told(Estimate(1.25, -0.5, 3.0, 10, 10, 5)) == "+1.2 [−0.5, +3.0]"


@pytest.mark.parametrize("recipe", PAIRS)
def test_every_pair_is_of_methods_that_can_be_driven(recipe: str):
    assert cells(Request(recipe, "tiny"))
    assert all(pair.ours != pair.theirs for pair in PAIRS[recipe])


def test_where_nothing_is_driven_there_are_dashes(tmp_path: Path):
    request = Request("paper", "tiny")
    (table,) = show(request, Store(tmp_path / "store"), ALL["differences"])
    assert isinstance(table, Facts)
    assert len(table.rows) == sum(len(pair.scenarios) for pair in PAIRS["paper"])
    assert all(cell == "–" for row in table.rows for cell in row[3:])
    sides = len({(name, scenario) for pair in PAIRS["paper"] for name in pair[1:3] for scenario in pair.scenarios}) * 5
    assert table.notes[-1].startswith(f"{sides} of {sides} drives")
