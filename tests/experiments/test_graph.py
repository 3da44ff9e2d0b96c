import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rapid.config import DistillConfig, MixConfig, NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, load_rows, save_rows
from rapid.experiments import costs, graph
from rapid.experiments.cells import Cell, Distill, Drive, Driver, Mix, Shipped, key
from rapid.experiments.graph import Job, Result, plan, run
from rapid.experiments.store import DONE, ROWS, Store
from rapid.locks import BusyError

MIX = Mix(Shipped("lane-3-density-2", "teacher"), Shipped("lane-3-density-2", "random"), MixConfig(), 0)
AGENTS = [Distill(MIX, NetworkConfig(), DistillConfig(), seed) for seed in range(3)]
DRIVES = [Drive(agent, "lane-3-density-2", name, 2) for agent in AGENTS for name in ("none", "pgd")]


def row(seed: int) -> EpisodeRow:
    return EpisodeRow("lane-3-density-2", "slower", seed, "none", 20.0, 30, False, 2.0, 60.0, 0, 9.0, (0, 0, 0, 0, 1))


def pretend(cell: Cell, place: Path, given: dict[str, Path]) -> None:
    """Compute nothing: write down who was there."""
    assert all((path / DONE).exists() or (path / "made").exists() for path in given.values())
    (place / "made").write_text(key(cell))
    if isinstance(cell, Drive):
        save_rows(place / ROWS, [row(1), row(2)])
    with (Path(os.environ["RAPID_TEST_LOG"])).open("a") as stream:
        stream.write(key(cell) + "\n")


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    log = tmp_path / "log"
    log.touch()
    monkeypatch.setenv("RAPID_TEST_LOG", str(log))
    monkeypatch.setattr(graph, "compute", pretend)
    return log


def test_inputs_come_first_and_nothing_is_computed_twice(tmp_path: Path, made: Path):
    store = Store(tmp_path / "store")
    due = plan(DRIVES, store)
    assert key(due.todo[0]) == key(MIX)
    assert len(due.todo) == 1 + len(AGENTS) + len(DRIVES)
    outcome = run(due.todo, store, say=lambda line: None)
    assert not outcome.failed
    assert len(made.read_text().split()) == len(due.todo)
    again = plan(DRIVES, Store(tmp_path / "store"))
    assert (again.todo, again.done) == ((), len(DRIVES))
    assert len(store.rows(DRIVES[0])) == 2


def test_what_only_led_to_a_result_is_not_asked_for_again(tmp_path: Path, made: Path):
    store = Store(tmp_path / "store")
    run(plan(DRIVES, store).todo, store, say=lambda line: None)
    store.export(DRIVES, tmp_path / "layer", "rows")
    fresh = Store(tmp_path / "elsewhere", [tmp_path / "layer"])
    assert plan(DRIVES, fresh).todo == ()
    assert fresh.rows(DRIVES[3]) == store.rows(DRIVES[3])
    # Another attack on the same agent needs the agent, which no layer has.
    other = plan([replace(DRIVES[0], attack="fgsm")], fresh)
    assert [key(cell) for cell in other.todo] == [key(MIX), key(AGENTS[0]), key(replace(DRIVES[0], attack="fgsm"))]


def test_a_failed_cell_is_reported_and_the_rest_goes_on(tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch):
    def fails(cell: Cell, place: Path, given: dict[str, Path]) -> None:
        if cell == AGENTS[1]:
            raise RapidError("No room.")
        pretend(cell, place, given)

    monkeypatch.setattr(graph, "compute", fails)
    store, said = Store(tmp_path / "store"), []
    outcome = run(plan(DRIVES, store).todo, store, say=said.append)
    assert outcome.failed[key(AGENTS[1])] == "No room."
    assert {key(cell) for cell in DRIVES[2:4]} < outcome.failed.keys()
    assert len(outcome.failed) == 3
    assert any("No room." in line for line in said)
    assert all(store.is_done(cell) for cell in (*DRIVES[:2], *DRIVES[4:]))
    monkeypatch.setattr(graph, "compute", pretend)
    assert not run(plan(DRIVES, store).todo, store, say=lambda line: None).failed


@pytest.mark.parametrize(
    "fault", ["another content", "a file is gone", "its record is damaged", "its input is gone too"]
)
def test_a_damaged_input_is_named_and_made_again(tmp_path: Path, made: Path, fault: str):
    store, said = Store(tmp_path / "store"), []
    run(plan(DRIVES[:1], store).todo, store, say=lambda line: None)
    place = store.place(AGENTS[0])
    due = plan(DRIVES[:2], store)
    assert due.todo == (DRIVES[1],)
    again = [AGENTS[0], DRIVES[1]]
    match fault:
        case "another content":
            (place / "made").write_text("zeros")
        case "its record is damaged":
            (place / DONE).write_text("{")
        case _:
            (place / "made").unlink()
    if fault == "its input is gone too":
        shutil.rmtree(store.place(MIX))
        again.insert(0, MIX)
    outcome = run(due.todo, store, say=said.append)
    assert not outcome.failed
    assert outcome.computed == again
    broken = DONE if fault == "its record is damaged" else "made"
    assert [f"'{place / broken}' is damaged or gone" in line for line in said] == [True]
    assert (place / "made").read_text() == key(AGENTS[0])
    store.check(AGENTS[0])
    # Nothing was thrown away, and what has no need of the damaged file was left alone.
    assert (store.root / "distill" / f"{key(AGENTS[0])}.damaged" / "cell.json").exists()
    assert plan(DRIVES[:2], store).todo == ()


def test_inputs_of_what_is_done_are_not_looked_at(tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch):
    store, looked = Store(tmp_path / "store"), []
    run(plan(DRIVES, store).todo, store, say=lambda line: None)
    check = store.check
    monkeypatch.setattr(store, "check", lambda cell: (looked.append(cell), check(cell))[1])
    assert run(plan(DRIVES, store).todo, store, say=lambda line: None).computed == []
    assert looked == []
    more = [replace(DRIVES[0], attack=name) for name in ("fgsm", "uniform")]
    run(plan(more, store).todo, store, say=lambda line: None)
    assert looked == [AGENTS[0]]


def test_a_damaged_input_that_another_makes_anew_is_waited_for(
    tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch
):
    store = Store(tmp_path / "store")
    run(plan(DRIVES[:1], store).todo, store, say=lambda line: None)
    path = store.place(AGENTS[0]) / "made"
    path.write_text("half")
    held, end = threading.Event(), threading.Event()

    def other() -> None:
        with Store(tmp_path / "store").begin(AGENTS[0]):
            held.set()
            end.wait(60)
            path.write_text(key(AGENTS[0]))

    thread = threading.Thread(target=other)
    thread.start()
    assert held.wait(60)
    sleep = graph.time.sleep

    def wait(seconds: float) -> None:
        if seconds != graph.POLL:  # somebody else's patience
            return sleep(seconds)
        end.set()
        return thread.join()

    monkeypatch.setattr(graph.time, "sleep", wait)
    assert run(plan(DRIVES[:2], store).todo, store, say=lambda line: None).computed == [DRIVES[1]]
    assert end.is_set()


def test_two_at_once_share_the_work_and_never_a_cell(tmp_path: Path, made: Path, monkeypatch: pytest.MonkeyPatch):
    # A lock belongs to a thread, so two threads meet as two processes do.
    store, held, end = Store(tmp_path / "store"), threading.Event(), threading.Event()

    def other() -> None:
        mine = Store(tmp_path / "store")
        with mine.begin(MIX) as place:
            held.set()
            end.wait(60)
            (place / "made").write_text("by the other")
            mine.finish(MIX, 1.0)

    thread = threading.Thread(target=other)
    thread.start()
    assert held.wait(60)
    with pytest.raises(BusyError), store.begin(MIX):
        pass
    sleep, slept = graph.time.sleep, []

    def wait(seconds: float) -> None:
        if seconds != graph.POLL:  # somebody else's patience
            return sleep(seconds)
        slept.append(seconds)
        end.set()
        return thread.join()

    monkeypatch.setattr(graph.time, "sleep", wait)
    assert not run(plan(DRIVES[:1], store).todo, store, say=lambda line: None).failed
    assert slept == [graph.POLL]
    assert key(MIX) not in made.read_text()
    assert (store.place(MIX) / "made").read_text() == "by the other"


def test_jobs_on_machines_that_share_no_disk_travel_as_bytes(tmp_path: Path, made: Path):
    store = Store(tmp_path / "store")
    run(plan(DRIVES[:1], store).todo, store, say=lambda line: None)
    packed = {key(AGENTS[0]): store.pack(AGENTS[0])}
    result = graph.do(Job(DRIVES[0], "/nowhere", {}, packed), lambda report: None)
    assert result.error == ""
    assert result.files is not None
    path = tmp_path / "back.parquet"
    path.write_bytes(result.files[ROWS])
    assert load_rows(path) == store.rows(DRIVES[0])


def test_a_fault_of_the_program_is_a_failed_cell(made: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def fault(cell: Cell, place: Path, given: dict[str, Path]) -> None:
        raise KeyError("gone")

    monkeypatch.setattr(graph, "compute", fault)
    result = graph.do(Job(MIX, str(tmp_path), {}, None), lambda report: None)
    assert result == Result(result.seconds, None, "KeyError: 'gone'")


@pytest.mark.slow
def test_killed_at_any_moment_the_same_command_ends_with_the_same_rows(tmp_path: Path):
    command = [sys.executable, "-m", "rapid.cli", "reproduce", "mixing-actions", "--scale", "tiny"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"

    def start(store: Path) -> "subprocess.Popen[str]":
        words = [*command, "--store", str(store), "--out", str(store) + "-page"]
        return subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path)

    assert start(whole).wait(600) == 0
    for delay in (6, 9, 12):
        process = start(killed)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(killed).wait(600) == 0

    def rows(store: Path) -> dict[str, list[tuple[object, ...]]]:
        found = {}
        for path in store.glob("drive/*/rows.parquet"):
            kept = [replace(each, decision_ms=0.0, min_ttc=0.0, commit="") for each in load_rows(path)]
            found[path.parent.name] = kept
        return found

    assert rows(whole) == rows(killed)
    assert len(rows(whole)) >= 6


def test_a_store_of_another_version_is_refused(tmp_path: Path):
    (tmp_path / "store.json").write_text(json.dumps({"format": 99}))
    with pytest.raises(RapidError, match="another version"):
        Store(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(RapidError, match="no store of results"):
        Store(tmp_path / "other")


def test_language_models_are_counted_before_anything_is_driven(tmp_path: Path):
    from rapid.config import TeacherConfig

    asked = Drive(Driver("teacher", TeacherConfig()), "lane-3-density-2", "none", 10)
    free = Drive(Driver("teacher", TeacherConfig(backend="scripted", model="rule")), "lane-3-density-2", "none", 10)
    assert plan([asked, free], Store(tmp_path)).decisions == 300


def test_what_large_experiments_cost_is_predicted_from_the_rates(monkeypatch: pytest.MonkeyPatch):
    random = "collect/scripted/random/digest"
    measured = {"seconds": {random: 0.00072, "drive/teacher/none": 0.3}, "bytes": {random: 50.0}}
    monkeypatch.setattr(costs, "_measured", lambda: measured)
    trainings, decisions, transitions = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in costs.totals_table().splitlines()[-3:]
    ]
    assert trainings[1:] == ["–"] * 5  # rates are missing
    assert decisions[1:] == ["2.8", "–", "1.4 h", "0.14 h", "0.014 h"]
    assert transitions[1:] == ["200", "50 GB", "100 h", "10 h", "1 h"]
