import json
import math
from dataclasses import replace

import numpy as np
import pytest

from rapid.errors import RapidError
from rapid.evaluation import teachers
from rapid.evaluation.recording import Recording
from rapid.evaluation.rollouts import run_episodes
from rapid.evaluation.teacher_summary import summarize_teachers, teachers_json, teachers_markdown, teachers_text
from rapid.evaluation.teachers import (
    TeacherRow,
    count_flaps,
    drive_teacher,
    judge,
    load_teacher_rows,
    save_teacher_rows,
    time_headway,
)
from rapid.report.figures import save_figure, teachers_figure
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.teacher.decision import Decision
from rapid.teacher.scripted import Scripted

SCENARIO = "lane-3-density-2"


def scene(*cars: tuple[float, int, float], lane: int = 1, speed: float = 20.0) -> np.ndarray:
    """One observation: the ego at x = 1000, others as (metres ahead, lane, speed)."""
    obs_VF = np.zeros((15, 5), np.float32)
    obs_VF[0] = (1, 1000, 4 * lane, speed, 0)
    for row, (ahead, car_lane, car_speed) in enumerate(cars, 1):
        obs_VF[row] = (1, 1000 + ahead, 4 * car_lane, car_speed, 0)
    return obs_VF


def episode(scenes: list[np.ndarray], actions: list[int]) -> Recording:
    count = len(actions)
    return Recording("t", SCENARIO, 0, "none", np.stack(scenes), np.array(actions), np.ones(count), False)


def row(teacher: str, seed: int, **changes) -> TeacherRow:
    values = {
        "episode_return": 20.0 + seed,
        "length": 30,
        "crashed": False,
        "mean_speed": 20.0,
        "distance": 600.0,
        "min_ttc": 3.0,
        "had_safe": 20,
        "lead_steps": 10,
        "headway": 1.5,
        "decision_seconds": 0.1,
    }
    names = ("unsafe", "lane_changes", "flaps", "close_steps", "unlike_foresight", "unlike_forecast")
    counts = dict.fromkeys((*names, "repaired", "fallbacks", "retries"), 0)
    tokens = {"tokens_in": 100, "tokens_out": 10, "cost": 0.5}
    return TeacherRow(teacher=teacher, scenario=SCENARIO, seed=seed, **{**values, **counts, **tokens, **changes})


def test_a_lane_change_undone_soon_is_a_flap():
    assert count_flaps([(0, LANE_LEFT), (3, LANE_RIGHT)]) == 1
    assert count_flaps([(0, LANE_LEFT), (4, LANE_RIGHT)]) == 0
    assert count_flaps([(0, LANE_LEFT), (1, LANE_LEFT), (2, LANE_RIGHT), (3, LANE_LEFT)]) == 2
    assert count_flaps([]) == 0


def test_headway_is_the_time_to_where_the_car_ahead_is():
    obs = np.stack(
        [
            scene((45, 1, 10), (25, 0, 10), (-15, 1, 30)),  # the car on the other lane and the one behind do not lead
            scene((-45, 1, 10)),
            scene((105, 1, 10), speed=1.0),
            scene((4, 1, 10)),
            scene((45, 1, 10), speed=0.0),
        ]
    )
    np.testing.assert_allclose(time_headway(obs), [2.0, math.nan, teachers.LONGEST_HEADWAY, 0.0, 10.0])


def test_choices_are_judged_by_what_the_observation_tells():
    blocked, free = scene((12, 1, 5)), scene()
    found = judge(episode([blocked, free, free, free], [FASTER, IDLE, FASTER]), 3)
    assert found["had_safe"] == 3
    assert found["unsafe"] == 1
    # On a free road both rules speed up; with a car in the way they do not.
    assert found["unlike_foresight"] == found["unlike_forecast"] == 2
    # Nothing is safe here, so nothing chosen is held against the driver.
    boxed = scene((6, 1, 0), (6, 0, 0), (6, 2, 0), (-6, 0, 20), (-6, 2, 20), speed=28.0)
    assert judge(episode([boxed, boxed], [SLOWER]), 3)["had_safe"] == 0
    assert judge(episode([boxed, boxed], [SLOWER]), 3)["unsafe"] == 0


def test_states_that_decisions_led_to_are_counted():
    close = scene((15, 1, 10))  # 10 m at 10 m/s
    found = judge(episode([close, scene(), close, scene((105, 1, 20))], [IDLE] * 3), 3)
    assert found["close_steps"] == 1
    assert found["lead_steps"] == 2
    assert found["headway"] == pytest.approx((0.5 + 5.0) / 2)
    assert math.isnan(judge(episode([close, scene()], [IDLE]), 3)["headway"])


def test_lane_changes_off_the_road_are_none():
    left = [scene(lane=0)] * 3
    assert judge(episode(left, [LANE_LEFT, LANE_RIGHT]), 3)["lane_changes"] == 1
    assert judge(episode(left, [LANE_LEFT, LANE_RIGHT]), 3)["flaps"] == 0


class Faulty:
    """Answers in all ways, by turns of four; counts how often it is asked for how many."""

    name = "faulty"

    def __init__(self) -> None:
        self.batches: list[int] = []

    def decide(self, obs_BVF, previous, keys_B):
        self.batches.append(len(obs_BVF))
        turn = (len(self.batches) - 1) % 4
        status = ("ok", "repaired", "fallback", "ok")[turn]
        return [Decision(SLOWER, "", status=status, retries=turn, tokens_in=10, tokens_out=1, cost=0.25)] * len(obs_BVF)


def test_driving_measures_what_rollouts_do_and_what_was_said():
    seeds = list(range(800_000, 800_006))
    progress: list[float] = []
    rows = drive_teacher(Scripted("rule", 3, 0), "my rule", SCENARIO, seeds, 4, progress=progress.append)
    known = run_episodes(Scripted("rule", 3, 0), SCENARIO, seeds)
    assert [of.seed for of in rows] == seeds
    for name in ("episode_return", "length", "crashed", "mean_speed", "distance"):
        of = {"episode_return": "return_E", "mean_speed": "speed_E"}.get(name, f"{name}_E")
        np.testing.assert_allclose([getattr(row, name) for row in rows], getattr(known, of))
    assert sum(progress) == 6 * 30
    assert all(amount > 0 for amount in progress)
    assert {row.teacher for row in rows} == {"my rule"}
    for rule, column in (("rule-foresight", "unlike_foresight"), ("rule-forecast", "unlike_forecast")):
        assert getattr(drive_teacher(Scripted(rule, 3, 0), "r", SCENARIO, seeds[:2], 2)[0], column) == 0

    faulty = Faulty()
    (row,) = drive_teacher(faulty, "faulty", SCENARIO, seeds[:1], 1)
    turns = [i % 4 for i in range(row.length)]
    assert faulty.batches == [1] * row.length
    assert (row.repaired, row.fallbacks) == (turns.count(1), turns.count(2))
    assert (row.retries, row.tokens_in, row.tokens_out) == (sum(turns), 10 * row.length, row.length)
    assert row.cost == 0.25 * row.length


def test_rows_survive_the_file(tmp_path):
    rows = [row("a", 1, headway=math.nan, lead_steps=0, crashed=True), row("b", 2, min_ttc=math.nan)]
    path = tmp_path / "rows.parquet"
    save_teacher_rows(path, rows)
    loaded = load_teacher_rows(path)
    assert repr(loaded) == repr(rows)
    path.write_bytes(b"no")
    with pytest.raises(RapidError, match="cannot be read"):
        load_teacher_rows(path)


def test_shares_are_of_all_decisions_together():
    rows = [row("a", 1, length=10, repaired=5, unsafe=2, had_safe=2), row("a", 2, length=30, fallbacks=4, flaps=2)]
    rows[1] = replace(rows[1], lead_steps=30, headway=0.5)
    (found,) = summarize_teachers(rows)
    assert found.repaired_share == 5 / 40
    assert found.fallback_share == 4 / 40
    assert found.unsafe_share == 2 / 22
    assert found.flaps == 30 * 2 / 40
    assert found.headway == pytest.approx((1.5 * 10 + 0.5 * 30) / 40)
    assert found.decisions_per_second == pytest.approx(10)
    assert (found.tokens, found.cost) == (110, 0.5)
    assert found.return_difference is None


def test_differences_are_paired_by_spawn():
    noise = np.random.default_rng(0).normal(0, 5, 20)
    rows = [row("first", seed, episode_return=20 + noise[seed]) for seed in range(20)]
    rows += [row("second", seed, episode_return=21 + noise[seed], crashed=seed < 5) for seed in range(20)]
    first, second = summarize_teachers(rows)
    assert first.return_difference is None
    # The traffic varies by far more than the teachers do, but it is the same traffic.
    assert second.return_difference.low == pytest.approx(1) == second.return_difference.high
    assert second.episode_return.high - second.episode_return.low > 2
    assert second.crash_difference.value == 0.25
    assert 0 < second.crash_difference.low < 0.25 < second.crash_difference.high


def test_names_reach_no_page_as_markup(tmp_path):
    name = "<script>alert(1)</script>|$\\frac$ *x*"
    summaries = summarize_teachers([row("first", 1), row("first", 2), row(name, 1), row(name, 2)])
    page = teachers_markdown(summaries)
    assert "<" not in page
    line = next(line for line in page.splitlines() if "script" in line)
    assert line.replace("\\|", "").count("|") == page.splitlines()[2].count("|")
    assert name in teachers_text(summaries)
    assert teachers_json(summaries)[1]["teacher"] == name
    json.dumps(teachers_json(summaries), allow_nan=False)
    for suffix in ("png", "svg"):
        save_figure(teachers_figure(summaries), tmp_path / f"plot.{suffix}")
    assert b"<script>" not in (tmp_path / "plot.svg").read_bytes()
