import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fake_worlds import FakeTeacher, FakeWorlds, assert_equal
from interruption import interrupted
from power import PowerCut
from rapid.data import collection, driving, parts
from rapid.data import journal as journal_module
from rapid.data.collection import collect, parse_shard
from rapid.data.dataset import Dataset, join, load_dataset
from rapid.data.driving import Budget
from rapid.errors import RapidError
from rapid.progress import Task

SCENARIO = "lane-3-density-2"


def run(directory: Path, teacher: FakeTeacher | None = None, transitions: int = 150, **options) -> Dataset:
    options = {"lockstep": 4, "make_worlds": FakeWorlds, **options}
    return collect(teacher or FakeTeacher(), SCENARIO, directory, transitions, **options)


def content(directory: Path) -> dict[str, bytes]:
    assert sorted(path.name for path in directory.iterdir()) == [
        "dataset.json",
        "teacher_log.parquet",
        "transitions.parquet",
    ]
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[dict[str, bytes], int]:
    """Files of an uninterrupted collection, and how often its teacher was asked."""
    directory, teacher = tmp_path_factory.mktemp("whole"), FakeTeacher()
    run(directory, teacher)
    return content(directory), teacher.asked


def test_one_episode_of_each_seed(tmp_path):
    seeds = [7, 3, 11, 5, 2, 13]
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, FakeTeacher(fail_after=40), None, seeds=seeds)
    rows = run(tmp_path, None, None, seeds=seeds).transitions
    assert rows.spawn_seed_N[rows.step_N == 0].tolist() == seeds
    assert rows.done_N.sum() == len(seeds)
    nobody = FakeTeacher()
    assert_equal(run(tmp_path, nobody, None, seeds=seeds).transitions, rows)
    assert nobody.asked == 0


def test_episodes_are_whole_and_lead_from_state_to_state(tmp_path):
    dataset = run(tmp_path)
    rows = dataset.transitions
    assert 150 <= len(rows) < 150 + 30
    assert_equal(load_dataset(tmp_path).transitions, rows)
    follows_N = rows.follows_N()
    assert (follows_N | rows.done_N).all()
    np.testing.assert_array_equal(rows.next_obs_NVF[:-1][follows_N[:-1]], rows.obs_NVF[1:][follows_N[:-1]])
    # The next observation at an end is a real one, not the first of another episode.
    assert not (rows.next_obs_NVF[rows.done_N][:, None] == rows.obs_NVF[rows.step_N == 0][None]).all((2, 3)).any()
    assert rows.spawn_seed_N.tolist() == rows.episode_N.tolist()
    assert rows.terminated_N.any()
    assert rows.truncated_N.any()
    for name in ("episode", "step", "spawn_seed", "source", "action"):
        assert dataset.log.column(name).to_pylist() == getattr(rows, f"{name}_N").tolist()
    assert "–" in dataset.log.column("explanation")[0].as_py()
    known_N = ~np.isnan(rows.probabilities_NA[:, 0])
    assert 0 < known_N.sum() < len(rows)
    assert (rows.probabilities_NA.argmax(1) == rows.action_N)[known_N].all()


def test_the_same_call_again_asks_nobody(tmp_path, whole):
    run(tmp_path)
    teacher = FakeTeacher()
    assert len(run(tmp_path, teacher)) >= 150
    assert teacher.asked == 0
    assert content(tmp_path) == whole[0]


@pytest.mark.parametrize("seed", range(6))
def test_interrupted_anywhere_it_ends_with_the_same_bytes(tmp_path, whole, seed):
    files, decisions = whole
    rng = np.random.default_rng(seed)
    asked = 0
    while True:
        teacher = FakeTeacher(fail_after=int(rng.integers(0, 40)))
        try:
            run(tmp_path, teacher)
            break
        except KeyboardInterrupt:
            journal = tmp_path / "collecting" / "journal.jsonl"
            if rng.random() < 0.5:
                journal.write_bytes(journal.read_bytes() + b'{"seen":12,"deci')
        finally:
            asked += teacher.asked
    assert content(tmp_path) == files
    assert asked == decisions


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (driving.Parts, "keep"),
        (parts, "write_parquet"),
        (parts, "write_json"),
        (collection, "save_dataset"),
        (collection, "_remove"),
        (driving.Journal, "finish"),
    ],
)
@pytest.mark.parametrize("when", ["before", "after"])
def test_interrupted_while_writing_it_ends_with_the_same_bytes(tmp_path, whole, monkeypatch, module, name, when):
    first, second = FakeTeacher(), FakeTeacher()
    with interrupted(monkeypatch, module, name, when):
        run(tmp_path, first)
    run(tmp_path, second)
    assert content(tmp_path) == whole[0]
    assert first.asked + second.asked == whole[1]


def test_killed_by_the_system_it_ends_with_the_same_bytes(tmp_path, whole):
    script = (
        "import sys, time\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from fake_worlds import FakeTeacher, FakeWorlds\n"
        "from rapid.data.collection import collect\n"
        "class Slow(FakeTeacher):\n"
        "    def decide(self, *arguments):\n"
        "        time.sleep(0.01)\n"
        "        return super().decide(*arguments)\n"
        f"collect(Slow(), {SCENARIO!r}, sys.argv[1], 150, 4, make_worlds=FakeWorlds)\n"
    )
    journal = tmp_path / "collecting" / "journal.jsonl"
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)])
    deadline = time.monotonic() + 60
    while not journal.exists() or len(journal.read_bytes().splitlines()) < 5:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)
    with pytest.raises(RapidError, match="Another process is at work"):
        run(tmp_path)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    teacher = FakeTeacher()
    run(tmp_path, teacher)
    assert content(tmp_path) == whole[0]
    assert teacher.asked < whole[1]


def test_other_settings_overwrite_nothing(tmp_path, whole):
    run(tmp_path)
    for options, message in (
        ({"teacher": FakeTeacher(model="other")}, "driver.model: 'fake' there, 'other' now"),
        ({"source": "random"}, "source: 'teacher' there, 'random' now; seeds"),
        ({"shard": "1/2"}, "shard: '1/1' there, '1/2' now"),
    ):
        with pytest.raises(RapidError, match=message):
            run(tmp_path, **options)
    with pytest.raises(RapidError, match="scenario: 'lane-3-density-2' there"):
        collect(FakeTeacher(), "lane-4-density-2.5", tmp_path, 150, make_worlds=FakeWorlds)
    run(tmp_path)
    assert content(tmp_path) == whole[0]
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "new", FakeTeacher(fail_after=5))
    with pytest.raises(RapidError, match=r"driver\.model"):
        run(tmp_path / "new", FakeTeacher(model="other"))


def test_a_collection_can_be_extended(tmp_path):
    first = run(tmp_path, transitions=60)
    teacher = FakeTeacher()
    longer = run(tmp_path, teacher, transitions=150)
    assert teacher.asked == len(longer) - len(first)
    assert_equal(longer.transitions.select(slice(len(first))), first.transitions)
    assert len(set(longer.transitions.spawn_seed_N.tolist())) == longer.transitions.episode_N.max() + 1


@pytest.mark.parametrize("budget", [Budget(tokens=6_000), Budget(cost=0.06)])
def test_a_budget_stops_and_a_larger_one_goes_on(tmp_path, whole, budget):
    stopped = run(tmp_path, budget=budget)
    assert 0 < len(stopped) < 150
    assert len(load_dataset(tmp_path)) == len(stopped)
    again = FakeTeacher()
    assert len(run(tmp_path, again, budget=budget)) == len(stopped)
    assert again.asked == 0
    run(tmp_path)
    assert content(tmp_path) == whole[0]


def test_a_budget_too_small_for_a_group_says_so_and_keeps_the_decisions(tmp_path, whole):
    first, second = FakeTeacher(), FakeTeacher()
    with pytest.raises(RapidError, match=r"budget of 900 tokens was spent before the first group"):
        run(tmp_path, first, budget=Budget(tokens=900))
    run(tmp_path, second)
    assert first.asked + second.asked == whole[1]
    assert content(tmp_path) == whole[0]


def test_shards_take_different_seeds_and_join(tmp_path):
    shards = [run(tmp_path / f"{part}", shard=f"{part}/3") for part in (1, 2, 3)]
    assert all(len(shard) >= 50 for shard in shards)
    assert [int(shard.transitions.spawn_seed_N[0]) for shard in shards] == [0, 1, 2]
    assert set(np.concatenate([shard.transitions.spawn_seed_N for shard in shards]) % 3) == {0, 1, 2}
    assert len(join(shards)) == sum(map(len, shards))
    assert parse_shard("2/4") == (2, 4)
    for wrong in ("0/2", "3/2", "1", "a/b", "-1/2"):
        with pytest.raises(RapidError, match="not of the form"):
            parse_shard(wrong)


def test_two_sources_share_no_traffic(tmp_path):
    teacher, random = run(tmp_path / "teacher"), run(tmp_path / "random", source="random")
    assert not set(teacher.transitions.spawn_seed_N) & set(random.transitions.spawn_seed_N)
    assert set(random.transitions.source_N) == {1}


def test_too_few_seeds_and_a_damaged_journal_are_explained(tmp_path):
    with pytest.raises(RapidError, match="All 2 spawn seeds are used"):
        run(tmp_path / "few", seeds=[5, 6])
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "torn", FakeTeacher(fail_after=20))
    journal = tmp_path / "torn" / "collecting" / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    record = json.loads(lines[1])
    del record["crc32"]  # as an earlier version wrote it
    lines[1] = json.dumps(record | {"seen": 1}).encode() + b"\n"
    journal.write_bytes(b"".join(lines))
    with pytest.raises(RapidError, match="decided for other observations"):
        run(tmp_path / "torn")


def stopped(directory: Path, decisions: int) -> Path:
    """Collect until so many decisions were made; return the directory of what is under way, with four parts or more."""
    with pytest.raises(KeyboardInterrupt):
        run(directory, FakeTeacher(fail_after=decisions))
    work = directory / "collecting"
    assert len(list(work.glob("part-*.parquet"))) >= 2
    return work


@pytest.mark.parametrize("damage", ["deleted", "zeros", "cut", "other"])
@pytest.mark.parametrize("number", [0, 1])
def test_a_part_that_vanished_or_changed_is_named_and_driven_again(tmp_path, whole, capsys, damage, number):
    work = stopped(tmp_path, 140)
    part, other = (work / f"part-{n:05}.parquet" for n in (number, 1 - number))
    content_before = part.read_bytes()
    if damage == "deleted":
        part.unlink()
    elif damage == "zeros":
        part.write_bytes(content_before[:50] + bytes(len(content_before) - 50))
    elif damage == "cut":
        part.write_bytes(content_before[:-10])
    else:
        part.write_bytes(other.read_bytes())
    run(tmp_path)
    assert part.name in capsys.readouterr().err
    assert content(tmp_path) == whole[0]


def test_a_part_of_other_episodes_is_refused(tmp_path):
    work = stopped(tmp_path, 140)
    (work / "parts.json").unlink()  # as an earlier version left it
    (work / "part-00000.parquet").rename(work / "part-00002.parquet")
    with pytest.raises(RapidError, match=r"part-00000\.parquet' of the collection is missing"):
        run(tmp_path)
    (work / "part-00001.parquet").rename(work / "part-00000.parquet")
    (work / "part-00002.parquet").rename(work / "part-00001.parquet")
    with pytest.raises(RapidError, match="does not hold the episodes that come next"):
        run(tmp_path)


@pytest.mark.parametrize("damage", ["deleted", "damaged"])
def test_without_its_list_a_collection_goes_on_from_the_parts(tmp_path, whole, damage):
    work = stopped(tmp_path, 140)
    if damage == "deleted":
        (work / "parts.json").unlink()
    else:
        (work / "parts.json").write_text("{")
    run(tmp_path)
    assert content(tmp_path) == whole[0]


def test_a_damaged_line_of_the_journal_costs_the_decisions_from_there_on(tmp_path, whole, capsys):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, FakeTeacher(fail_after=20))
    journal = tmp_path / "collecting" / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    assert len(lines) > 4
    # One decision changed, the line still good JSON.
    record = json.loads(lines[2])
    record["decisions"][0]["action"] = (record["decisions"][0]["action"] + 1) % 5
    lines[2] = json.dumps(record, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"
    journal.write_bytes(b"".join(lines))
    again = FakeTeacher()
    run(tmp_path, again)
    assert "damaged after line 2" in capsys.readouterr().err
    assert content(tmp_path) == whole[0]
    assert again.asked == whole[1] - 4  # of the first step, the one that was kept


@pytest.mark.parametrize("seed", range(6))
def test_after_a_power_cut_it_ends_with_the_same_bytes(tmp_path, whole, monkeypatch, seed):
    """Only what was flushed is left, and of a file's end zeros; no answer that took long to get is asked for again."""
    monkeypatch.setattr(journal_module, "_SYNC_AFTER_SECONDS", 0.0)
    place = tmp_path / "here"
    place.mkdir()
    rng, asked = np.random.default_rng(seed), 0
    for _ in range(100):
        with monkeypatch.context() as patch:
            disk = PowerCut(place, patch)
            teacher = FakeTeacher(fail_after=int(rng.integers(0, 60)))
            try:
                run(place, teacher)
                ended = True
            except KeyboardInterrupt:
                ended = False
            asked += teacher.asked
            place = disk.after()
        if ended:
            break
    # What was removed last may be back; the dataset stands.
    nobody = FakeTeacher()
    run(place, nobody)
    assert content(place) == whole[0]
    assert asked == whole[1]
    assert nobody.asked == 0


@pytest.mark.parametrize("seed", range(4))
def test_with_a_disk_that_fills_up_it_ends_with_the_same_bytes(tmp_path, whole, monkeypatch, seed):
    rng, write = np.random.default_rng(seed), os.write
    for _ in range(100):
        room = int(rng.integers(100, 20_000))

        def short(handle: int, data: bytes) -> int:
            nonlocal room
            if not room:
                raise OSError(28, "No space left on device")
            count = min(len(data), room)  # the last bytes that there is room for
            room -= count
            return write(handle, bytes(data[:count]))

        with monkeypatch.context() as patch:
            patch.setattr(os, "write", short)
            try:
                run(tmp_path)
                break
            except OSError:
                continue
    assert content(tmp_path) == whole[0]


def test_files_of_the_users_beside_a_collection_stay(tmp_path, whole):
    (tmp_path / "collecting").mkdir()
    (tmp_path / "collecting" / "notes.txt").write_text("mine")
    run(tmp_path)
    assert (tmp_path / "collecting" / "notes.txt").read_text() == "mine"


def test_progress_counts_and_shows_what_it_costs(tmp_path):
    work = Task("collect", 150, "transitions", sys.stderr, None)
    dataset = run(tmp_path, progress=work)
    assert work.done == len(dataset)
    assert "decisions/s, cost 0.1" in work._note
    assert "0.0% fallbacks" in work._note
