"""Trackers: every row of the metrics once, whatever happened in between, and nothing sent away."""

import json
import os
import sys
import types
from dataclasses import replace

import pytest

from fake_worlds import fake_transitions
from rapid import tracking
from rapid.config import Config, DistillConfig, LossConfig, NetworkConfig, OptimizerConfig, without_place
from rapid.errors import RapidError
from rapid.networks.q_network import build_network
from rapid.presets import preset
from rapid.tracking import Tracker, check_tracking, numbers_of
from rapid.training import distill, offline
from rapid.training.learner import Learner

LOSS = LossConfig(robust_weight=0.0)
CONFIG = DistillConfig(iterations=30, evaluate_every=12, loss=LOSS, optimizer=OptimizerConfig(batch_size=8))
DATA = fake_transitions(10)


class Killed(BaseException):
    pass


class Fake:
    """Stands for a tracker; what runs were told outlives them."""

    told: dict[str, list]
    closed: int

    def __init__(self, directory, run, settings):
        self.rows = Fake.told.setdefault(run, [])

    def log(self, numbers, step):
        self.rows.append((step, numbers))

    def close(self):
        Fake.closed += 1


@pytest.fixture(autouse=True)
def _fakes(monkeypatch):
    Fake.told, Fake.closed = {}, 0
    monkeypatch.setattr(tracking, "_BACKENDS", dict.fromkeys(("tensorboard", "wandb", "trackio"), Fake))
    monkeypatch.setattr(tracking, "check_tracking", lambda kind: None)
    monkeypatch.setattr(offline, "LOG_EVERY", 5)


def network():
    return build_network(NetworkConfig(kind="mlp", hidden=(8,)), 3, 0)


def train(directory, kind="wandb", **options):
    with Tracker(kind, directory, "pupil", {"seed": 3}) as tracker:
        distill(DATA, network(), CONFIG, directory, seed=3, track=tracker.log, **options)


def steps() -> list[int]:
    (rows,) = Fake.told.values()
    return [step for step, _ in rows]


def test_a_tracker_is_told_what_the_metrics_say(tmp_path):
    train(tmp_path)
    (name,) = Fake.told
    assert name.startswith("pupil-")
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert Fake.told[name] == [(row["iteration"], numbers_of(row)) for row in rows]
    assert steps() == [5, 10, 12, 15, 20, 24, 25, 30]
    assert Fake.closed == 1


@pytest.mark.parametrize("seconds", [0, 1_000], ids=["checkpoints", "none"])
@pytest.mark.parametrize("stop", [3, 17])
def test_a_resumed_training_repeats_no_step_and_leaves_none_out(tmp_path, monkeypatch, stop, seconds):
    update = Learner.update

    def dying(self, batch):
        if self.updates == stop:
            raise Killed
        update(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", dying)
        with pytest.raises(Killed):
            train(tmp_path, checkpoint_seconds=seconds)
    train(tmp_path)
    assert steps() == [5, 10, 12, 15, 20, 24, 25, 30]


def test_a_tracker_that_comes_late_is_told_everything(tmp_path):
    distill(DATA, network(), CONFIG, tmp_path, seed=3)
    train(tmp_path)
    train(tmp_path)
    assert steps() == [5, 10, 12, 15, 20, 24, 25, 30]


def test_other_settings_are_another_run(tmp_path):
    for seed in (0, 0, 1):
        with Tracker("trackio", tmp_path, "pupil", {"seed": seed}) as tracker:
            tracker.log({"step": 10, "loss": 1.0})
    assert [len(rows) for rows in Fake.told.values()] == [1, 1]


def test_no_tracker_leaves_nothing(tmp_path):
    with Tracker("none", tmp_path, "pupil", {}) as tracker:
        tracker.log({"step": 1, "loss": 1.0})
    assert not Fake.told
    assert not list(tmp_path.iterdir())


def test_numbers_are_flattened_and_what_is_none_is_left_out():
    row = {"step": 3, "td": 0.5, "gate": None, "name": "x", "sure": True, "evaluation": {"return": 2, "crash": None}}
    assert numbers_of(row) == {"step": 3.0, "td": 0.5, "evaluation/return": 2.0}


def test_a_missing_package_and_one_that_fails_are_explained(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for kind in ("tensorboard", "wandb", "trackio"):
        with pytest.raises(RapidError, match=rf"\[({kind}|tracking)\]"):
            check_tracking(kind)
    check_tracking("none")

    def broken(directory, run, settings):
        raise OSError("no room")

    monkeypatch.setitem(tracking._BACKENDS, "wandb", broken)
    with pytest.raises(RapidError, match="does not start: no room"):
        Tracker("wandb", tmp_path, "pupil", {})


def test_tracking_changes_neither_a_run_nor_its_place():
    assert without_place(replace(preset(), tracking="wandb")) == without_place(preset())
    assert Config().tracking == "none"


@pytest.fixture
def real(monkeypatch):
    """Give the module as it is, with the packages' own names faked and the environment put back."""
    calls = []

    def take(name):
        def called(*args, **named):
            calls.append((name, args, named))
            return types.SimpleNamespace(log=take("run.log"), finish=take("run.finish"))

        return called

    for name in ("wandb", "trackio"):
        module = types.ModuleType(name)
        for function in ("init", "log", "finish"):
            setattr(module, function, take(f"{name}.{function}"))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(os, "environ", {key: value for key, value in os.environ.items() if key != "WANDB_MODE"})
    return calls


@pytest.mark.parametrize("mode", [None, "online", "disabled"])
def test_wandb_is_offline_unless_the_user_says_otherwise(tmp_path, real, mode):
    if mode:
        os.environ["WANDB_MODE"] = mode
    run = tracking._Wandb(tmp_path, "pupil-1", {"seed": 3})
    run.log({"loss": 1.0}, 10)
    run.close()
    (_, _, options), logged, finished = real
    assert options["mode"] == (mode or "offline")
    assert options["id"] == "pupil-1"
    assert options["resume"] == ("allow" if mode == "online" else None)
    assert options["config"] == {"seed": 3}
    assert logged == ("run.log", ({"loss": 1.0},), {"step": 10})
    assert finished[0] == "run.finish"
    assert (os.environ.get("WANDB_ERROR_REPORTING") == "false") == (mode is None)


def test_trackio_stays_local(tmp_path, real):
    run = tracking._Trackio(tmp_path, "pupil-1", {"seed": 3})
    run.log({"loss": 1.0}, 10)
    run.close()
    (_, _, options), logged, _ = real
    assert options == {"project": "rapid", "name": "pupil-1", "resume": "allow", "config": {"seed": 3}}
    assert logged == ("trackio.log", ({"loss": 1.0},), {"step": 10})
    assert os.environ["GRADIO_ANALYTICS_ENABLED"] == "False"
