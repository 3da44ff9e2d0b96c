"""The summary table: order, honest cells, aligned text."""

import math
import re
from dataclasses import replace

from test_metrics import ROW

from rapid.evaluation.summary import NOT_APPLICABLE, label_of, summarize, summary_text


def rows_of(agent: str, attack: str = "none", count: int = 6, **changes):
    return [
        replace(ROW, agent=agent, attack=attack, seed=i, episode_return=10.0 + i, training_seed=None, **changes)
        for i in range(count)
    ]


ROWS = [
    *rows_of("rapid", has_network=True),
    *rows_of("rapid", "pgd", has_network=True, gradient_attack=True, crashed=True),
    *rows_of("slower", kind="floor"),
    *rows_of("slower", "uniform", kind="floor"),
    *rows_of("smollm2", count=1, kind="teacher"),
    *rows_of("planner", kind="planner"),
    *rows_of("planner-observation", kind="planner"),
]


def test_order_kinds_and_labels() -> None:
    table = summarize(ROWS, resamples=100)
    assert [row.label for row in table] == ["always-slower", "smollm2", "planner", "planner, as observed", "rapid"]
    assert [row.is_reference for row in table] == [True, True, True, True, False]
    assert label_of("rapid") == "rapid"


def test_cells_say_why_they_are_empty() -> None:
    table = {row.agent: row for row in summarize(ROWS, resamples=100)}
    assert table["slower"].attacks["pgd"].missing == "n/a"
    assert table["planner"].attacks["uniform"].missing == "n/a"
    assert table["rapid"].attacks["uniform"].missing == "–"
    # It reads an observation, which can be perturbed, but has no network.
    assert table["planner-observation"].attacks["uniform"].missing == "–"
    assert table["planner-observation"].attacks["pgd"].missing == "n/a"
    pgd = table["rapid"].attacks["pgd"]
    assert pgd.crashed is not None
    assert pgd.crashed.value == 1
    assert pgd.crashed.low < 0.9
    assert math.isnan(table["smollm2"].metrics["episode_return"].low)


def test_text_is_aligned_and_complete() -> None:
    text = summary_text(ROWS, resamples=100)
    lines = text.splitlines()
    assert lines[0] == "lane-3-density-2"
    start = lines[1].index("IQM")
    assert all(line[start - 2 : start] == "  " for line in lines[3:7])
    assert re.search(r"always-slower +12\.5 \[", text)
    assert "n/a: a gradient attack needs a network" in text
    assert "95 % bootstrap intervals over 1 to 6 spawn seeds" in text
    assert summary_text([]).startswith("Nothing was measured")


def test_units_are_honest_about_trainings() -> None:
    one = [replace(row, training_seed=0) for row in rows_of("rapid")]
    assert "one training each" in summary_text(one, resamples=50)
    three = [replace(row, training_seed=seed) for row in rows_of("rapid") for seed in range(3)]
    assert "Fewer than 5 trainings: preliminary." in summary_text(three, resamples=50)


def test_who_has_no_values_is_not_attacked_by_search_and_that_is_said() -> None:
    floor, net = rows_of("slower", kind="floor"), rows_of("net", has_network=True)
    searched = [replace(row, attack=attack) for row in net for attack in ("square", "world:budget=1")]
    by_agent = {row.agent: row for row in summarize([*floor, *net, *searched])}
    assert {cell.missing for cell in by_agent["slower"].attacks.values()} == {NOT_APPLICABLE}
    assert {cell.missing for cell in by_agent["net"].attacks.values()} == {""}
