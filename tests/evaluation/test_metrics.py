"""Episode rows and the time to collision."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, column, load_rows, save_rows, time_to_collision

ROW = EpisodeRow(
    scenario="lane-3-density-2",
    agent="rapid",
    seed=900_000,
    attack="none",
    episode_return=20.25,
    length=30,
    crashed=False,
    mean_speed=21.5,
    distance=645.0,
    lane_changes=3,
    min_ttc=math.nan,
    shares=(0.1, 0.2, 0.3, 0.4, 0.0),
    training_seed=0,
    commit="0" * 40,
)


def scene(*others: tuple[float, float, float], ego: tuple[float, float, float] = (0, 4, 20)) -> np.ndarray:
    obs = np.zeros((1, 15, 5))
    for row, (x, y, v) in enumerate([ego, *others]):
        obs[0, row] = (1, x, y, v, 0)
    return obs


def test_rows_round_trip_with_missing_numbers_as_null(tmp_path: Path) -> None:
    rows = [ROW, replace(ROW, min_ttc=2.5, training_seed=None, crashed=True)]
    save_rows(tmp_path / "rows.parquet", rows)
    loaded = load_rows(tmp_path / "rows.parquet")
    assert math.isnan(loaded[0].min_ttc)
    assert replace(loaded[0], min_ttc=0, decision_ms=0) == replace(ROW, min_ttc=0, decision_ms=0)
    assert replace(loaded[1], decision_ms=0) == replace(rows[1], decision_ms=0)
    assert pq.read_table(tmp_path / "rows.parquet").column("min_ttc").null_count == 1
    save_rows(tmp_path / "none.parquet", [])
    assert load_rows(tmp_path / "none.parquet") == []


def test_files_that_are_no_rows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RapidError, match="no file of episode rows"):
        load_rows(tmp_path / "absent.parquet")
    (tmp_path / "text.parquet").write_text("no")
    with pytest.raises(RapidError, match="cannot be read"):
        load_rows(tmp_path / "text.parquet")
    pq.write_table(pa.table({"x": [1]}), tmp_path / "other.parquet")
    with pytest.raises(RapidError, match="is not a file of episode rows"):
        load_rows(tmp_path / "other.parquet")


def test_columns() -> None:
    assert column([ROW], "share_faster").tolist() == [0.4]
    assert column([ROW], "crashed").tolist() == [0.0]


@pytest.mark.parametrize(
    ("obs", "expected"),
    [
        (scene((45, 4, 10)), 4.0),  # 40 m between bumpers, 10 m/s closing
        (scene((45, 4, 25)), math.inf),  # it gets away
        (scene((45, 0, 10)), math.inf),  # another lane
        (scene((-45, 4, 30)), math.inf),  # behind
        (scene((45, 5.9, 10)), 4.0),  # partly on the lane
        (scene((4, 4, 30)), 0.0),  # touching
        (scene((105, 4, 0), (45, 4, 25)), math.inf),  # the nearest counts, not a slower one beyond it
        (scene(), math.inf),
    ],
)
def test_time_to_collision(obs: np.ndarray, expected: float) -> None:
    assert time_to_collision(obs).tolist() == [expected]


def test_absent_vehicles_do_not_count() -> None:
    obs = scene((45, 4, 10))
    obs[0, 1, 0] = 0
    assert time_to_collision(obs)[0] == math.inf
