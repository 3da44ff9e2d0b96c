"""The summary table: order, honest cells, aligned text."""

import math
import re
from dataclasses import replace

import pytest
from test_metrics import ROW

from rapid.agents.open import open_agent
from rapid.evaluation.metrics import EpisodeRow, Kind
from rapid.evaluation.rollouts import run_episodes
from rapid.evaluation.summary import NOT_APPLICABLE, ahead_of, label_of, summarize, summary_text


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
    attacked = [replace(row, attack="pgd") for row in rows_of("rapid")]
    assert "bootstrap intervals over spawn seeds." in summary_text(attacked, resamples=50)


def test_who_has_no_values_is_not_attacked_by_search_and_that_is_said() -> None:
    floor, net = rows_of("slower", kind="floor"), rows_of("net", has_network=True)
    searched = [replace(row, attack=attack) for row in net for attack in ("square", "world:budget=1")]
    by_agent = {row.agent: row for row in summarize([*floor, *net, *searched])}
    assert {cell.missing for cell in by_agent["slower"].attacks.values()} == {NOT_APPLICABLE}
    assert {cell.missing for cell in by_agent["net"].attacks.values()} == {""}


def test_who_is_ahead_of_the_lead_is_said_plainly() -> None:
    def driven(agent: str, returns: list[float], attack: str = "none", kind: Kind = "learned") -> list[EpisodeRow]:
        (row, *_) = rows_of(agent, kind=kind)
        pairs = enumerate(returns)
        return [replace(row, seed=seed, episode_return=value, attack=attack) for seed, value in pairs]

    def lead(returns: list[float], attack: str = "none") -> list[EpisodeRow]:
        return [replace(row, origin="rapid") for row in driven("RAPID", returns, attack)]

    spread = [float(number % 3) for number in range(12)]
    rows = [
        *lead([20 + value for value in spread]),
        *driven("slower", [21 + value for value in spread], kind="floor"),
        *driven("online DQN", [20 + value + (-1) ** number * 5 + 0.1 for number, value in enumerate(spread)]),
        *driven("offline DQN", [10.0] * 12),
        *driven("smollm2-135m", [30.0] * 12, kind="teacher"),
        *lead([10 + value for value in spread], "pgd"),
        *driven("offline DQN", [15 + value for value in spread], "pgd"),
    ]
    clean, attacked = ahead_of(rows)
    first, second = clean.removesuffix(".").split("; ")
    assert first == "Ahead of RAPID in lane-3-density-2, without attack: always-slower by 1.00 [1.00, 1.00]"
    assert re.fullmatch(r"online DQN by 0\.10 \[-.*\], which may be chance", second)
    # Who does not look drives under an attack as without.
    assert attacked.startswith(
        "Ahead of RAPID in lane-3-density-2, under pgd: always-slower by 11.00 [11.00, 11.00]; off"
    )
    assert all(line in summary_text(rows) for line in (clean, attacked))
    assert ahead_of(lead([20.0] * 3) + driven("idle", [19.0] * 3, kind="floor")) == [
        "Ahead of RAPID in lane-3-density-2, without attack: no floor and no baseline."
    ]
    assert ahead_of(driven("slower", spread)) == []
    # Who leads, and who does not look, is what they are; names only change what is shown.
    renamed = {"RAPID": "mine", "slower": "RAPID"}
    known = [replace(row, origin=row.origin or row.agent) for row in rows if row.agent in renamed]
    assert ahead_of([replace(row, agent=renamed[row.agent]) for row in known])[1] == (
        "Ahead of mine in lane-3-density-2, under pgd: RAPID by 11.00 [11.00, 11.00]."
    )
    # Of earlier versions there are names alone: those that a run gave to what it trained.
    old = [replace(row, origin="", has_network=True) for row in known]
    assert ahead_of(old)[0].startswith("Ahead of RAPID in lane-3-density-2, without attack: always-slower")


def test_a_plan_of_ones_own_drives_under_every_attack_as_without() -> None:
    plan = [replace(row, origin="blind:5,2,4") for row in rows_of("my plan", kind="floor")]
    mine = [replace(row, origin="rapid", episode_return=1.0) for row in rows_of("mine", "pgd")]
    assert ahead_of([*plan, *mine])[0].startswith("Ahead of mine in lane-3-density-2, under pgd: my plan by 11.50 [")


@pytest.mark.parametrize("driver", ["rule", "faster", "random"])
def test_progress_beside_the_papers_reward_is_that_reward_of_the_same_driving(driver: str) -> None:
    seeds = list(range(900_000, 900_008))
    ours, theirs = (
        run_episodes(open_agent(driver, name), name, seeds).rows()
        for name in ("lane-3-density-2", "lane-3-density-2:progress")
    )
    for row, other in zip(ours, theirs, strict=True):
        assert (row.length, row.crashed) == (other.length, other.crashed)
        assert row.progress_return == pytest.approx(other.episode_return, abs=0.05)
    assert "progress" in summary_text(ours, resamples=50).splitlines()[1]
    assert "progress" not in summary_text(theirs, resamples=50).splitlines()[1]
