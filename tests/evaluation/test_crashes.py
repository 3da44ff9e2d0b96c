"""What was hit in a crash, and how crashes are counted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from test_metrics import ROW

from rapid.agents.open import open_agent
from rapid.evaluation.crashes import crashes_by, hit_in, hit_of
from rapid.evaluation.metrics import load_rows, save_rows
from rapid.evaluation.rollouts import run_episodes


def scene(*cars: tuple[float, float, float, float]) -> np.ndarray:
    found = np.zeros((15, 5), np.float32)
    for row, car in enumerate(cars):
        found[row] = (1, *car)
    return found


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        # The ego drives up to a slow car, and in the end is past its middle; another is beside all the time.
        ([(0, 4, 30, 0), (18, 4, 10, 0), (0, 8, 20, 0)], [(25, 4, 10, 0), (24, 4, 8, 0), (20, 8, 20, 0)], "ahead"),
        ([(0, 4, 10, 0), (-15, 4, 30, 0), (60, 4, 20, 0)], [(8, 4, 6, 0), (5, 4, 9, 0), (80, 4, 20, 0)], "behind"),
        # It changes lanes into a car that is half a length ahead of it, and into the tail of one.
        ([(0, 4, 20, 0), (3, 8, 20, 0)], [(18, 6.4, 9, 1), (21, 8, 9, 0)], "beside"),
        ([(0, 4, 25, 0), (16, 8, 10, 0)], [(20, 8, 9, 1), (24, 8, 9, 0)], "ahead"),
        ([(0, 4, 20, 0)], [(20, 4, 20, 0)], ""),
    ],
)
def test_what_was_hit(before: list, after: list, expected: str) -> None:
    assert hit_of(scene(*before), scene(*after)) == expected


def test_every_crash_of_an_episode_says_what_was_hit(tmp_path: Path) -> None:
    driven = run_episodes(open_agent("faster", ROW.scenario), ROW.scenario, range(900_000, 900_012), record=True)
    rows = driven.rows()
    assert {bool(row.hit) == row.crashed for row in rows} == {True}
    # Who never steers and is the fastest of all runs into those ahead, but for one that just changes lanes.
    crashed = [row.hit for row in rows if row.crashed]
    assert len(crashed) > 8
    assert crashed.count("ahead") >= len(crashed) - 2
    assert [row.hit for row in rows] == [hit_in(recording) for recording in driven.recordings]
    save_rows(tmp_path / "rows.parquet", rows)
    assert [row.hit for row in load_rows(tmp_path / "rows.parquet")] == [row.hit for row in rows]


def test_rows_of_earlier_versions_are_read(tmp_path: Path) -> None:
    save_rows(tmp_path / "rows.parquet", [replace(ROW, hit="ahead", origin="rapid")])
    assert load_rows(tmp_path / "rows.parquet")[0].origin == "rapid"
    table = pq.read_table(tmp_path / "rows.parquet").drop_columns(["hit", "origin"])
    pq.write_table(table, tmp_path / "old.parquet")
    assert [(row.hit, row.origin) for row in load_rows(tmp_path / "old.parquet")] == [("", "")]


def test_crashes_are_counted_by_scenario_attack_and_agent() -> None:
    rows = [
        replace(ROW, seed=seed, attack="pgd", crashed=seed < 3, length=length, hit=hit)
        for seed, (length, hit) in enumerate([(4, "beside"), (20, "behind"), (9, "beside"), (30, "")])
    ]
    found = crashes_by([*rows, ROW])
    cell = found[ROW.scenario, "pgd", "rapid"]
    assert (cell.episodes, cell.crashes, cell.second, cell.hit, cell.hits, cell.known) == (4, 3, 9, "beside", 2, 3)
    assert (found[ROW.scenario, "none", "rapid"].crashes, found[ROW.scenario, "none", "rapid"].hit) == (0, "")
