import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fake_worlds import FakeTeacher, FakeWorlds, assert_equal
from interruption import interrupted
from rapid.data import sharding
from rapid.data.collection import collect
from rapid.data.dataset import Dataset, join, load_dataset
from rapid.data.driving import Budget
from rapid.data.sharding import collect_shards, shards_of
from rapid.errors import RapidError
from rapid.progress import Task

SCENARIO = "lane-3-density-2"


def run(directory: Path, transitions: int = 150, shards: int = 3, fail_after: int | None = None, **options) -> Dataset:
    options = {"make_worlds": FakeWorlds, **options}
    teacher = partial(FakeTeacher, fail_after)
    return collect_shards(teacher, SCENARIO, directory, transitions, 4, shards=shards, **options)


def content(directory: Path) -> dict[str, bytes]:
    names = ["dataset.json", "teacher_log.parquet", "transitions.parquet"]
    assert sorted(path.name for path in directory.iterdir()) == names
    return {name: (directory / name).read_bytes() for name in names}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, bytes]:
    """Files of an uninterrupted collection in three shards."""
    directory = tmp_path_factory.mktemp("whole")
    run(directory)
    return content(directory)


def test_shards_joined_are_the_shards_collected_one_by_one(tmp_path):
    dataset = run(tmp_path / "all")
    single = [
        collect(FakeTeacher(), SCENARIO, tmp_path / f"{i}", 150, 4, shard=f"{i}/3", make_worlds=FakeWorlds)
        for i in (1, 2, 3)
    ]
    assert_equal(dataset.transitions, join(single).transitions)
    assert dataset.log.equals(join(single).log)
    assert len(dataset) >= 150
    assert dataset.collection["complete"]
    assert shards_of(tmp_path / "all") == 3
    assert shards_of(tmp_path / "1") == 1
    assert shards_of(tmp_path / "nowhere") is None


def test_processes_collect_the_same_bytes(tmp_path, whole):
    work = Task("collect", 150, "transitions", open("/dev/null", "w"), None)  # noqa: SIM115
    dataset = run(tmp_path, workers=2, progress=work)
    assert content(tmp_path) == whole
    assert work.done == len(dataset)
    assert "decisions/s, cost 0." in work._note


@pytest.mark.parametrize("seed", range(4))
def test_interrupted_anywhere_it_ends_with_the_same_bytes(tmp_path, whole, seed):
    rng = np.random.default_rng(seed)
    for _ in range(100):
        try:
            # The first decisions of a shard that goes on come from its journal, so every try gets further.
            run(tmp_path, fail_after=int(rng.integers(1, 60)))
            break
        except KeyboardInterrupt:
            assert shards_of(tmp_path) == 3
    assert content(tmp_path) == whole


@pytest.mark.parametrize("name", ["save_dataset", "write_json", "_split"])
@pytest.mark.parametrize("when", ["before", "after"])
def test_interrupted_while_it_is_extended_it_ends_with_the_same_data(tmp_path, whole, monkeypatch, name, when):
    run(tmp_path, 40)
    with interrupted(monkeypatch, sharding, name, when):
        run(tmp_path)
    run(tmp_path)
    assert content(tmp_path) == whole


def test_the_same_call_again_asks_nobody(tmp_path, whole):
    run(tmp_path)
    run(tmp_path, fail_after=0)
    run(tmp_path, 90, fail_after=0)
    assert content(tmp_path) == whole


@pytest.mark.parametrize("budget", [Budget(tokens=6_000), Budget(cost=0.06), Budget(decisions=100)])
def test_a_budget_is_shared_and_a_larger_one_goes_on(tmp_path, whole, budget):
    stopped = run(tmp_path, budget=budget)
    assert 0 < len(stopped) <= 100
    assert not stopped.collection["complete"]
    assert len(load_dataset(tmp_path)) == len(stopped)
    assert len(run(tmp_path, budget=budget, fail_after=0)) == len(stopped)
    # Only the dataset was kept: the shards go on from it.
    shutil.rmtree(tmp_path / "collecting")
    run(tmp_path)
    assert content(tmp_path) == whole


def test_a_budget_of_time_ends_all_shards(tmp_path, whole):
    with pytest.raises(RapidError, match="before the first group of episodes of any shard"):
        run(tmp_path, budget=Budget(seconds=1e-6))
    run(tmp_path)
    assert content(tmp_path) == whole


def test_other_settings_overwrite_nothing(tmp_path, whole):
    run(tmp_path)
    with pytest.raises(RapidError, match="shards: 3 there, 4 now"):
        run(tmp_path, shards=4)
    with pytest.raises(RapidError, match=r"driver\.model"):
        collect_shards(partial(FakeTeacher, model="other"), SCENARIO, tmp_path, 150, shards=3, make_worlds=FakeWorlds)
    with pytest.raises(RapidError, match="shards: 3 there, nothing now"):
        collect(FakeTeacher(), SCENARIO, tmp_path, 150, make_worlds=FakeWorlds)
    with pytest.raises(RapidError, match="1 to 1000 shards"):
        run(tmp_path, shards=0)
    run(tmp_path)
    assert content(tmp_path) == whole
    collect(FakeTeacher(), SCENARIO, tmp_path / "plain", 50, make_worlds=FakeWorlds)
    with pytest.raises(RapidError, match="shards"):
        run(tmp_path / "plain")


def job_of(directory: Path, **changes) -> sharding._Job:
    budget = changes.pop("budget", Budget())
    job = sharding._Job(FakeTeacher, FakeWorlds, SCENARIO, directory, 150, 4, "teacher", "2/3", budget, 0.0, True)
    return replace(job, **changes)


def test_a_machine_without_our_files_gets_and_returns_them(tmp_path):
    """Three machines that share nothing: what one collected under a budget, the next goes on with."""
    one, two, ours = (tmp_path / name for name in ("one", "two", "ours"))
    reports: list = []
    files = sharding._collect_shard(job_of(one, budget=Budget(decisions=30)), reports.append)
    assert reports[-1].decisions <= 30
    sharding._write(ours, files)
    part = load_dataset(ours)
    assert not part.collection["complete"]
    assert not sharding._is_done(job_of(ours))
    sharding._write(ours, sharding._collect_shard(job_of(two, files=sharding._read(ours)), reports.append))
    assert sharding._is_done(job_of(ours))
    whole = load_dataset(ours)
    assert reports[-1].fresh == len(whole) - len(part)
    assert_equal(whole.transitions.select(slice(len(part))), part.transitions)
    assert json.loads((ours / "dataset.json").read_text())["collection"]["settings"]["shard"] == "2/3"


@pytest.mark.slow
def test_a_cluster_of_ray_collects_the_same_bytes(tmp_path, whole, monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    # The workers must find the stand-ins.
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=10**8)
    try:
        work = Task("collect", 150, "transitions", open("/dev/null", "w"), None)  # noqa: SIM115
        with pytest.raises(RapidError, match="before the first group"):
            run(tmp_path / "all", workers=2, engine="ray", budget=Budget(decisions=3))
        dataset = run(tmp_path / "all", workers=2, engine="ray", progress=work)
        assert work.done <= len(dataset)
        assert content(tmp_path / "all") == whole
        # What a worker refuses, and what it cannot even read, is explained here.
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "wrong", fail_after=3)
        (tmp_path / "wrong" / "collecting" / "shard-0002-of-0003").write_text("in the way")
        with pytest.raises(RapidError, match="Cannot write in"):
            run(tmp_path / "wrong", workers=2, engine="ray")
        with pytest.raises(RapidError, match=r"Ray lost a job.*No module named.*Every machine needs the same RAPID"):
            run(tmp_path / "unknown", workers=2, engine="ray", make_worlds=Unknown)
    finally:
        ray.shutdown()


class Unknown(FakeWorlds):
    """Worlds of a module that workers do not have."""
