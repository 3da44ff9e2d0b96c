"""The comparison with d3rlpy, without d3rlpy: both sides get the same settings, batches and weights."""

import importlib.util
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fake_worlds import fake_transitions
from rapid.data.dataset import Dataset
from rapid.data.replay import OfflineSampler
from rapid.networks.q_network import build_network

PATH = Path(__file__).parents[1] / "benchmarks" / "d3rlpy_comparison.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("d3rlpy_comparison", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_settings_are_the_papers(benchmark):
    for kind, rate, batch in (("dqn", 5e-3, 32), ("ddqn", 5e-4, 32), ("cql", 5e-4, 64)):
        ours, theirs = benchmark.settings(kind, 7), benchmark.their_settings(kind)
        assert (ours.optimizer.learning_rate, ours.optimizer.batch_size) == (rate, batch)
        assert (theirs["learning_rate"], theirs["batch_size"]) == (rate, batch)
        assert (theirs["target_update"], theirs["discount"], theirs["hidden"]) == (50, 0.99, [256, 256])
        assert (ours.optimizer.target_rate, ours.optimizer.max_grad_norm, ours.loss.robust_weight) == (1, 0, 0)
        # d3rlpy's discrete CQL is built on double DQN.
        assert (ours.loss.double, ours.loss.conservative_weight) == (kind != "dqn", float(kind == "cql"))
        assert ours.iterations == 7


def test_a_batch_is_told_as_d3rlpy_would_sample_it(benchmark):
    data = fake_transitions(20)
    sampler = OfflineSampler(data, 0.99)
    batch = sampler.sample(200, np.random.default_rng(0))
    arrays = benchmark.batch_arrays(batch)
    crashed = arrays["terminals"] == 1
    assert crashed.any()
    assert not crashed.all()
    assert arrays["observations"].shape == arrays["next_observations"].shape == (200, 75)
    assert (arrays["next_observations"][crashed] == 0).all()
    kept = batch.next_obs_BVF.flatten(1).numpy()[~crashed]
    np.testing.assert_array_equal(arrays["next_observations"][~crashed], kept)


def test_foreign_weights_drive_in_our_network(benchmark, roads, tmp_path):
    theirs, ours = (build_network(benchmark.NETWORK, 3, seed) for seed in (1, 2))
    layers = benchmark.linears(theirs)
    assert [layer.out_features for layer in layers] == [256, 256, 5]
    arrays = {f"online.weight{index}": layer.weight.detach().numpy() for index, layer in enumerate(layers)}
    arrays |= {f"online.bias{index}": layer.bias.detach().numpy() for index, layer in enumerate(layers)}
    np.savez(tmp_path / "weights.npz", **arrays)
    benchmark.adopt(ours, tmp_path / "weights.npz")
    assert torch.equal(ours(roads(4)), theirs(roads(4)))


def test_seeds_together_are_timed_against_fits_one_after_another(benchmark, tmp_path, monkeypatch):
    asked = []

    class FakeWorker:
        def ask(self, do, **request):
            asked.append((do, request.get("seed"), request.get("steps")))
            return {"seconds": 50.0}

    # The processes find their function by the module's name.
    monkeypatch.syspath_prepend(PATH.parent)
    monkeypatch.setitem(sys.modules, benchmark.__name__, benchmark)
    monkeypatch.setattr(benchmark, "KINDS", ("dqn",))
    dataset = Dataset("lane-3-density-2", fake_transitions(60), {})
    monkeypatch.setattr(benchmark.os, "cpu_count", lambda: 2)
    (row,) = benchmark.compare_together(FakeWorker(), dataset, tmp_path, seeds=3, iterations=3)
    assert asked == [("start", 0, None), ("fit", None, 3), ("start", 1, None), ("fit", None, 3), ("start", 2, None),
                     ("fit", None, 3)]  # fmt: skip
    assert row["d3rlpy"] == 150
    assert row["ratio"] == 150 / row["rapid"]
    # On two cores, the seeds 0 and 1 as one stack and seed 2 as another.
    for first in (0, 2):
        last = (tmp_path / f"dqn-stack-{first}" / "metrics.jsonl").read_text().splitlines()[-1]
        assert json.loads(last)["iteration"] == 3


def test_the_table_says_whether_intervals_overlap(benchmark):
    rows = [
        SimpleNamespace(agent=f"{kind}, {side}", seed=spawn, training_seed=seed, crashed=False,
                        episode_return=spawn % 3 + seed + 50 * (side == "rapid" and kind == "cql"))
        for kind in benchmark.KINDS for side in ("rapid", "d3rlpy") for seed in range(5) for spawn in range(10)
    ]  # fmt: skip
    lines = {line.split(" |")[0]: line for line in benchmark.scores_table(rows)}
    assert lines["| dqn, return"].endswith("| overlap |")
    assert lines["| cql, return"].endswith("| apart |")
    assert "5 trainings × 10 spawns" in benchmark.scores_table(rows)[-1]
