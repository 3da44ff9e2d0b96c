"""A teacher that reflects: one experience an episode, kept with the dataset, whatever interrupts the collection."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fake_worlds import FakeTeacher, FakeWorlds
from interruption import interrupted
from rapid.config import TeacherConfig
from rapid.data import collection, driving
from rapid.data.card import card
from rapid.data.collection import collect
from rapid.data.dataset import Dataset, join, load_dataset
from rapid.data.driving import Budget
from rapid.data.sharding import collect_shards
from rapid.errors import RapidError
from rapid.teacher.chat import Reply, Request
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.experience import SITUATION_SIZE, Experience, read_experiences, to_lines
from rapid.teacher.memory import Episode, Memory
from rapid.teacher.replay import Replay

SCENARIO = "lane-3-density-2"
KNOWN = [Experience((float(number),) * SITUATION_SIZE, f"known {number} – “é”", number) for number in range(3)]


class Reflecting(FakeTeacher):
    """A driver that learns its seeds; every crash costs tokens."""

    reflects = True

    def __init__(self, fail_after: int | None = None, forget_after: int | None = None) -> None:
        super().__init__(fail_after, memory={"experiences": len(KNOWN), "few_shot": 1})
        self.memory, self.looked, self.forget_after = Memory(KNOWN), [], forget_after

    def look_back(self, episodes: list[Episode]) -> Iterator[Experience]:
        for episode in episodes:
            if self.forget_after is not None and len(self.looked) >= self.forget_after:
                raise KeyboardInterrupt
            self.looked.append(episode.spawn_seed)
            lesson = f"{len(episode.decisions)} steps\n“{episode.decisions[-1].explanation}”" if episode.crashed else ""
            situation = tuple(round(float(value), 4) for value in episode.obs_TVF[-1].ravel()[:SITUATION_SIZE])
            spent = {"tokens_in": 50, "tokens_out": 7, "cost": 0.01} if lesson else {}
            yield Experience(situation, "f", 1, lesson=lesson, spawn_seed=episode.spawn_seed, **spent)


def run(directory: Path, teacher: FakeTeacher | None = None, transitions: int = 150, **options) -> Dataset:
    options = {"lockstep": 4, "make_worlds": FakeWorlds, **options}
    return collect(teacher or Reflecting(), SCENARIO, directory, transitions, **options)


def content(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[dict[str, bytes], list[int]]:
    """Files of an uninterrupted collection, and the episodes looked back on."""
    directory, teacher = tmp_path_factory.mktemp("whole"), Reflecting()
    run(directory, teacher)
    return content(directory), teacher.looked


def test_every_episode_leaves_one_experience_after_those_known(tmp_path):
    dataset = run(tmp_path)
    rows, learned = dataset.transitions, dataset.memory[3:]
    assert dataset.memory[:3] == tuple(KNOWN)
    assert [past.spawn_seed for past in learned] == rows.spawn_seed_N[rows.step_N == 0].tolist()
    crashed = set(rows.spawn_seed_N[rows.terminated_N].tolist())
    assert 0 < len(crashed) < len(learned)
    assert {past.spawn_seed for past in learned if past.lesson} == crashed
    assert load_dataset(tmp_path).memory == dataset.memory == read_experiences(tmp_path / "memory.jsonl")
    facts = json.loads((tmp_path / "dataset.json").read_text())
    assert facts["files"]["memory.jsonl"]["rows"] == len(dataset.memory)
    assert facts["summary"]["memory"] == {
        "known": 3,
        "learned": len(learned),
        "lessons": len(crashed),
        "tokens_in": 50 * len(crashed),
        "tokens_out": 7 * len(crashed),
        "cost": pytest.approx(0.01 * len(crashed)),
    }
    assert f"{len(crashed)} of them with a lesson" in card(dataset)
    (tmp_path / "memory.jsonl").write_text(to_lines(dataset.memory[:-1]))
    with pytest.raises(RapidError, match="cut off"):
        load_dataset(tmp_path)


def test_what_is_learned_does_not_depend_on_the_company(tmp_path, whole):
    alone = run(tmp_path, lockstep=1).memory
    together = whole[0]["memory.jsonl"].decode().split("\n")[:-1]
    assert to_lines(alone).split("\n")[:-1][: len(together)] == together[: len(alone)]


@pytest.mark.parametrize("seed", range(6))
def test_interrupted_anywhere_it_ends_with_the_same_bytes(tmp_path, whole, seed):
    rng = np.random.default_rng(seed)
    looked: list[int] = []
    while True:
        teacher = Reflecting(int(rng.integers(0, 80)), int(rng.integers(0, 4)))
        try:
            run(tmp_path, teacher)
            break
        except KeyboardInterrupt:
            memory = tmp_path / "collecting" / "memory.jsonl"
            if memory.exists() and rng.random() < 0.5:
                memory.write_bytes(memory.read_bytes() + '{"situation": [0.1], "facts": "“'.encode()[:-1])
        finally:
            looked += teacher.looked
    assert content(tmp_path) == whole[0]
    assert looked == whole[1]


@pytest.mark.parametrize(
    ("module", "name"), [(driving.Parts, "keep"), (collection, "save_dataset"), (collection, "_remove")]
)
@pytest.mark.parametrize("when", ["before", "after"])
def test_interrupted_while_writing_it_ends_with_the_same_bytes(tmp_path, whole, monkeypatch, module, name, when):
    first, second = Reflecting(), Reflecting()
    with interrupted(monkeypatch, module, name, when):
        run(tmp_path, first)
    run(tmp_path, second)
    assert content(tmp_path) == whole[0]
    assert first.looked + second.looked == whole[1]


def test_killed_by_the_system_while_looking_back_nothing_is_there_twice(tmp_path, whole):
    script = (
        "import sys, time\n"
        f"sys.path[:0] = [{str(Path(__file__).parents[1])!r}, {str(Path(__file__).parent)!r}]\n"
        "from test_hindsight import Reflecting, run\n"
        "from pathlib import Path\n"
        "class Slow(Reflecting):\n"
        "    def look_back(self, episodes):\n"
        "        for experience in super().look_back(episodes):\n"
        "            time.sleep(0.05)\n"
        "            yield experience\n"
        "run(Path(sys.argv[1]), Slow())\n"
    )
    memory = tmp_path / "collecting" / "memory.jsonl"
    process = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)])
    deadline = time.monotonic() + 60
    while not memory.exists() or len(memory.read_bytes().splitlines()) < 3:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    run(tmp_path)
    assert content(tmp_path) == whole[0]


def test_a_longer_collection_keeps_what_was_learned(tmp_path, whole):
    first = run(tmp_path, transitions=60)
    teacher = Reflecting()
    longer = run(tmp_path, teacher, transitions=150)
    assert longer.memory[: len(first.memory)] == first.memory
    assert not set(teacher.looked) & {past.spawn_seed for past in first.memory}
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Reflecting(forget_after=1), transitions=300)
    again = run(tmp_path, transitions=300)
    assert again.memory == run(tmp_path / "at once", transitions=300).memory[: len(again.memory)]
    assert len({past.spawn_seed for past in again.memory[3:]}) == len(again.memory) - 3


def test_reflections_count_against_the_budget(tmp_path, whole):
    crashes = json.loads(whole[0]["dataset.json"])["summary"]["memory"]["lessons"]
    decisions = json.loads(whole[0]["dataset.json"])["files"]["transitions.parquet"]["rows"]
    budget = Budget(tokens=decisions * 103 + 57 * (crashes - 1))
    stopped = run(tmp_path, budget=budget)
    assert stopped.collection["complete"] is False
    assert len(run(tmp_path, budget=budget)) == len(stopped)
    run(tmp_path)
    assert content(tmp_path) == whole[0]


def test_a_damaged_file_is_explained(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Reflecting(forget_after=3))
    path = tmp_path / "collecting" / "memory.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    for wrong in (b"{}\n", b"\xff\n"):
        path.write_bytes(wrong + lines[1])
        with pytest.raises(RapidError, match=r"memory.jsonl"):
            run(tmp_path)


def test_shards_share_what_was_known_and_add_what_they_learned(tmp_path):
    shards = [run(tmp_path / f"{part}", shard=f"{part}/2") for part in (1, 2)]
    joined = join(shards)
    assert joined.memory == (*KNOWN, *shards[0].memory[3:], *shards[1].memory[3:])
    assert [past.spawn_seed % 2 for past in joined.memory[3:]] == sorted(
        past.spawn_seed % 2 for past in joined.memory[3:]
    )


def test_a_divided_collection_goes_on_with_its_memory(tmp_path):
    def collected(transitions: int, place: str) -> Dataset:
        return collect_shards(Reflecting, SCENARIO, tmp_path / place, transitions, 4, shards=2, make_worlds=FakeWorlds)

    first, longer = collected(100, "one"), collected(200, "one")
    assert set(first.memory) < set(longer.memory)
    assert len({past.spawn_seed for past in longer.memory[3:]}) == len(longer.memory) - 3
    assert len(longer.memory) - 3 == len(set(longer.transitions.spawn_seed_N.tolist()))


class Chatter:
    """A model that keeps its lane and has one lesson."""

    native_tools = False

    def ask(self, request: Request) -> Reply:
        after_a_crash = request.messages[0]["content"].startswith("You teach")
        return Reply('{"lesson": "leave room", "action": "slower"}' if after_a_crash else "keep", (), 9, 1)


def test_what_one_collection_learns_the_next_remembers_and_a_replay_repeats(tmp_path):
    def drive(name: str, memory: Memory, few_shot: int) -> Dataset:
        config = TeacherConfig(backend="endpoint", model="m", reflect=True, few_shot=few_shot)
        return run(tmp_path / name, ConversingTeacher(Chatter(), config, {"model": "m"}, 3, memory), 60)

    first = drive("first", Memory(), 0)
    assert any(past.lesson == "leave room" for past in first.memory)
    second = drive("second", Memory(read_experiences(tmp_path / "first" / "memory.jsonl")), 2)
    assert second.memory[: len(first.memory)] == first.memory
    assert any("leave room" in said for said in second.log.column("told").to_pylist())
    assert second.drivers["teacher"]["memory"]["sha256"] == Memory(first.memory).sha256
    replay = Replay(TeacherConfig(backend="replay", replay_file=str(tmp_path / "second")), 3)
    third = run(tmp_path / "third", replay, 60)
    assert set(third.log.column("status").to_pylist()) == {"ok"}
    assert third.transitions.action_N.tolist() == second.transitions.action_N.tolist()
    assert third.memory is None
