"""A real cluster of two nodes on this machine; a worker and then a node are killed in the middle: nothing is lost."""

import os
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from rapid.evaluation.metrics import EpisodeRow
from rapid.experiments.cells import Drive, Driver, key
from rapid.experiments.graph import plan, run
from rapid.experiments.store import Store

ray = pytest.importorskip("ray")
pytestmark = pytest.mark.slow

CELLS = [Drive(Driver("rule-forecast"), "lane-3-density-2", "none", 3, seed=seed) for seed in range(8)]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    cluster_utils = pytest.importorskip("ray.cluster_utils")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2] / "src"))
    found = cluster_utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False, "object_store_memory": 10**8}
    )
    ray.init(address=found.address, log_to_driver=False, logging_level="error")
    yield found
    ray.shutdown()
    found.shutdown()


def rows(store: Store) -> list[list[EpisodeRow]]:
    return [[replace(row, decision_ms=0.0, min_ttc=0.0, commit="") for row in store.rows(cell)] for cell in CELLS]


def test_a_worker_and_a_node_may_die_in_the_middle(cluster: Any, tmp_path: Path):
    node = cluster.add_node(num_cpus=1, object_store_memory=10**8)
    cluster.wait_for_nodes()
    store, ended, done = Store(tmp_path / "ray"), [], Event()

    def destroy() -> None:
        while not any(store.is_here(cell) for cell in CELLS):
            if done.wait(0.1):
                return
        workers = subprocess.run(["pgrep", "-f", "ray::_attempt"], capture_output=True, text=True, check=False)
        for pid in workers.stdout.split()[:1]:
            os.kill(int(pid), signal.SIGKILL)
            ended.append("worker")
        cluster.remove_node(node, allow_graceful=False)
        ended.append("node")

    killer = Thread(target=destroy)
    killer.start()
    try:
        outcome = run(plan(CELLS, store).todo, store, engine="ray", workers=2, say=lambda line: None)
    finally:
        done.set()
        killer.join()
    assert ended[-1] == "node"
    assert not outcome.failed
    assert len(outcome.computed) == len(CELLS)
    alone = Store(tmp_path / "alone")
    run(plan(CELLS, alone).todo, alone, say=lambda line: None)
    assert rows(store) == rows(alone)
    assert all((store.place(cell) / "cell.json").exists() for cell in CELLS)
    assert plan(CELLS, store).todo == ()
    assert len({key(cell) for cell in CELLS}) == len(CELLS)
