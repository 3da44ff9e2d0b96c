"""Rollouts: finished worlds count no further, the true observation is measured, noise is each episode's own."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import rapid
from rapid.agents.open import kind_of, open_agent
from rapid.attacks.attack import Base, Needs
from rapid.attacks.draws import uniform
from rapid.attacks.spec import AttackSpec
from rapid.errors import RapidError
from rapid.evaluation import rollouts
from rapid.evaluation.recording import Recording, load_recordings, save_recordings
from rapid.evaluation.rollouts import evaluate_agent, is_applicable, run_episodes
from rapid.pages.episodes import moving_picture
from rapid.scenarios import FASTER, IDLE, LANE_RIGHT
from rapid.teacher.decision import Decision

SCENARIO = "lane-3-density-2"


class Noise(Base):
    """Adds uniform noise to every feature."""

    def __init__(self, needs: Needs = "nothing", label: str = "noise") -> None:
        super().__init__(AttackSpec("uniform", label=label), None)
        self.needs = needs

    def __call__(self, network: Any, obs_BVF: torch.Tensor, source: Sequence[torch.Generator]) -> torch.Tensor:
        return obs_BVF + uniform(obs_BVF.shape, source)


class Watcher:
    """Remembers what it was shown."""

    name = "watcher"

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []
        self.network = torch.nn.Linear(1, 1)

    def act(self, obs_BVF: np.ndarray) -> np.ndarray:
        self.shown.append(obs_BVF.copy())
        return np.full(len(obs_BVF), IDLE)

    def q_values(self, obs_BVF: np.ndarray) -> np.ndarray:
        return np.tile(np.arange(5, dtype=np.float32), (len(obs_BVF), 1))


def test_each_episode_is_measured_until_its_own_end(toy, constant) -> None:
    done: list[float] = []
    episodes = run_episodes(constant(FASTER), SCENARIO, [10, 11, 14], progress=done.append)
    assert episodes.length_E.tolist() == [3, 4, 7]
    assert episodes.return_E.tolist() == [3, 4, 7]
    assert episodes.crashed_E.tolist() == [False, True, False]
    assert episodes.distance_E == pytest.approx([72, 96, 168])
    assert episodes.speed_E == pytest.approx([24, 24, 24])
    assert episodes.min_ttc_E == pytest.approx([10, 10, 10])
    assert sum(done) == 3
    assert toy[0].closed
    row = episodes.rows(training_seed=4, commit="abc")[1]
    assert (row.seed, row.crashed, row.training_seed, row.commit, row.attack) == (11, True, 4, "abc", "none")
    assert row.shares == (0, 0, 0, 1, 0)


def test_lane_changes_count_moves_not_wishes(toy, constant) -> None:
    episodes = run_episodes(constant(LANE_RIGHT), SCENARIO, [14])
    assert episodes.lane_changes_E.tolist() == [2]  # three lanes, so two moves; later wishes have no effect


def test_seeds_driven_in_turns_give_the_same(toy, constant, monkeypatch) -> None:
    together = run_episodes(constant(FASTER), SCENARIO, range(10))
    monkeypatch.setattr(rollouts, "MAX_WORLDS", 3)
    apart = run_episodes(constant(FASTER), SCENARIO, range(10), record=True)
    assert len(toy) == 5
    for one, other in zip(together.rows(), apart.rows(), strict=True):
        assert replace(one, decision_ms=0.0) == replace(other, decision_ms=0.0)
    assert [recording.seed for recording in apart.recordings] == list(range(10))


def test_a_planner_shows_its_progress_before_it_has_driven_everything(toy, constant) -> None:
    agent, ended = constant(FASTER), []
    agent.kind = "planner"
    run_episodes(agent, SCENARIO, range(3), progress=ended.append)
    assert [worlds.count for worlds in toy] == [1, 1, 1]
    assert sum(ended) == 3


def test_agent_sees_the_attack_and_metrics_do_not(toy) -> None:
    watcher = Watcher()
    episodes = run_episodes(watcher, SCENARIO, [10], Noise())
    assert episodes.attack == "noise"
    assert 100 < watcher.shown[0][0, 0, 1] < 101
    assert episodes.distance_E == pytest.approx([60])


def test_noise_of_an_episode_does_not_depend_on_its_company(toy) -> None:
    alone, together, other = Watcher(), Watcher(), Watcher()
    run_episodes(alone, SCENARIO, [14], Noise(), generator_seed=3)
    run_episodes(together, SCENARIO, [10, 14, 11], Noise(), generator_seed=3)
    run_episodes(other, SCENARIO, [14], Noise(), generator_seed=4)
    assert np.array_equal(alone.shown[0][0], together.shown[0][1])
    assert np.array_equal(alone.shown[6][0], together.shown[6][0])  # the last under way
    assert not np.array_equal(alone.shown[0], other.shown[0])


def test_gradient_attack_needs_a_network(toy, constant) -> None:
    attack = Noise("gradient", "pgd")
    assert not is_applicable(constant(IDLE), attack)
    assert is_applicable(Watcher(), attack)
    assert is_applicable(constant(IDLE), "none")
    planner = SimpleNamespace(bind=lambda env: constant(IDLE))
    assert is_applicable(planner, "none")
    assert not is_applicable(planner, Noise())
    with pytest.raises(RapidError, match=r"a gradient attack needs a network.*not applicable"):
        run_episodes(constant(IDLE), SCENARIO, [10], attack)
    assert run_episodes(Watcher(), SCENARIO, [10], attack).gradient_attack


def test_teacher_gets_its_own_last_decision_and_a_key_per_decision(toy) -> None:
    calls: list[tuple[list[Any], list[int]]] = []

    class Teacher:
        name = "teacher"

        def decide(self, obs_BVF, previous, keys_B):
            calls.append((list(previous), keys_B.tolist()))
            return [Decision(FASTER, explanation=f"gap {obs[1, 1] - obs[0, 1]:.0f} m") for obs in obs_BVF]

    episodes = run_episodes(Teacher(), SCENARIO, [10, 14], record=True)
    assert [len(previous) for previous, _ in calls] == [2, 2, 2, 1, 1, 1, 1]
    assert calls[0][0] == [None, None]
    assert all(decision.action == FASTER for previous, _ in calls[1:] for decision in previous)
    keys = [key for _, of in calls for key in of]
    assert len(set(keys)) == len(keys)
    calls.clear()
    run_episodes(Teacher(), SCENARIO, [14])
    assert calls[0][1][0] == keys[1]
    # A rule's reason is ours: no model said it.
    assert (episodes.recordings[1].computed, episodes.recordings[1].answered) == (("gap 45 m",) * 7, ())


def test_what_was_told_answered_and_computed_is_recorded_apart(toy, tmp_path) -> None:
    talk = json.dumps([{"role": "assistant", "content": "look {}"}, {"role": "user", "content": "RESULT free"}])
    odds = (0.0, 0.25, 0.0, 0.75, 0.0)

    class Teacher:
        name = "teacher"

        def decide(self, obs_BVF, previous, keys_B):
            fallback = Decision(FASTER, status="fallback", told="Faster?", turns=talk, computed="the rule's choice")
            word = Decision(FASTER, answer="faster", status="ok", told="Faster?", probabilities=odds, computed="9 m")
            return [word if previous[0] is None else fallback for _ in obs_BVF]

    found = run_episodes(Teacher(), SCENARIO, [10], record=True).recordings[0]
    save_recordings(tmp_path / "r.json", [found])
    for one in (found, load_recordings(tmp_path / "r.json")[0]):
        assert set(one.told) == {"Faster?"}
        assert one.answered[:2] == ("faster", "model: look {}\ntool: RESULT free")
        assert one.computed[:2] == ("9 m", "the rule's choice")
        assert one.odds_TA[0].tolist() == list(odds)
        assert np.isnan(one.odds_TA[1]).all()
    picture = moving_picture(found)
    assert picture["odds"][:2] == [list(odds), None]
    assert (picture["told"], picture["answered"][0], picture["computed"][0]) == (["Faster?"] * 3, "faster", "9 m")
    assert json.dumps(picture, allow_nan=False)


def test_agent_bound_to_the_worlds_gets_all_of_them(toy, constant) -> None:
    class Planner:
        name = "planner"

        def bind(self, env):
            return constant(FASTER if env is toy[-1] else IDLE)

    assert run_episodes(Planner(), SCENARIO, [10, 14]).counts_EA[:, FASTER].tolist() == [3, 7]


def test_recording_round_trip_keeps_everything(toy, tmp_path: Path) -> None:
    recordings = run_episodes(Watcher(), SCENARIO, [10, 11], record=True).recordings
    save_recordings(tmp_path / "episodes.json", recordings)
    loaded = load_recordings(tmp_path / "episodes.json")
    for before, after in zip(recordings, loaded, strict=True):
        assert np.array_equal(before.obs_TVF, after.obs_TVF)
        assert before.obs_TVF.shape == (len(before.action_T) + 1, 15, 5)
        assert np.array_equal(before.q_TA, after.q_TA)
        assert (before.seed, before.crashed, before.agent) == (after.seed, after.crashed, after.agent)
    (tmp_path / "bad.json").write_text('{"format": 99}')
    with pytest.raises(RapidError, match="Record them again"):
        load_recordings(tmp_path / "bad.json")


def test_tracks_follow_vehicles_through_changes_of_rank() -> None:
    obs = np.zeros((3, 15, 5), np.float32)
    for t in range(3):
        x = 20.0 * t
        cars = sorted([(30 + 15 * t, 0.0, 15.0), (5 + 26 * t, 4.0, 26.0)], key=lambda car: abs(car[0] - x))
        obs[t, 0] = (1, x, 8, 20, 0)
        for row, (cx, cy, v) in enumerate(cars, 1):
            obs[t, row] = (1, cx, cy, v, 0)
    obs[2, 3] = (1, 190, 0, 22, 0)
    recording = Recording("a", SCENARIO, 0, "none", obs, np.zeros(2, int), np.zeros(2), False)
    tracks = recording.tracks()
    for t in range(3):
        by_lane = {float(obs[t, row, 2]): int(tracks[t, row]) for row in (1, 2)}
        assert by_lane == {4.0: 1, 0.0: 2}
    assert tracks[2, 3] == 3
    assert (tracks[:, 5:] == -1).all()


def test_rows_of_cells_that_do_not_apply_are_left_out(toy, constant, monkeypatch) -> None:
    monkeypatch.setattr(
        rollouts,
        "_resolve",
        lambda a, lanes: (a, None if a == "none" else Noise("gradient" if a == "pgd" else "nothing", a)),
    )
    done: list[float] = []
    rows = evaluate_agent(constant(IDLE), SCENARIO, [10, 11], ("none", "uniform", "pgd"), progress=done.append)
    assert [row.attack for row in rows] == ["none", "none", "uniform", "uniform"]
    assert sum(done) == 6


@pytest.mark.parametrize(
    ("agent", "match"),
    [(object(), "cannot drive"), (SimpleNamespace(act=lambda obs: [9] * len(obs)), "one of 0 LANE_LEFT")],
)
def test_what_cannot_drive_is_named(toy, agent: Any, match: str) -> None:
    with pytest.raises(RapidError, match=match):
        run_episodes(agent, SCENARIO, [10])


def test_a_saved_agent_goes_to_the_device(monkeypatch):
    asked, saved = [], SimpleNamespace(metadata={})
    monkeypatch.setattr(rapid, "load_agent", lambda directory, device: asked.append((directory, device)) or saved)
    assert open_agent(".", SCENARIO, device="cuda") is saved
    assert asked == [(".", "cuda")]


def test_bad_requests(toy, constant) -> None:
    with pytest.raises(RapidError, match="no spawn seeds"):
        run_episodes(constant(IDLE), SCENARIO, [])
    with pytest.raises(RapidError, match="did you mean 'slower'"):
        open_agent("slowr", SCENARIO)


def test_kinds_follow_from_what_an_agent_offers(constant) -> None:
    assert kind_of(open_agent("slower", SCENARIO)) == "floor"
    assert kind_of(SimpleNamespace(decide=print, name="smollm2")) == "teacher"
    assert kind_of(SimpleNamespace(bind=print)) == "planner"
    assert kind_of(constant(IDLE)) == "learned"
    assert kind_of(SimpleNamespace(act=print, kind="planner")) == "planner"


def test_agents_open_by_name_or_file(tmp_path: Path) -> None:
    assert kind_of(open_agent("planner", SCENARIO)) == "planner"
    with pytest.raises(RapidError):
        open_agent(str(tmp_path / "absent.onnx"), SCENARIO)
    with pytest.raises(RapidError, match=r"There is no agent 'rapd'.*an ONNX file"):
        open_agent("rapd", SCENARIO)
