"""The measurements of the simulator's benchmark: interleaved against highway-env, first step, processes."""

import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from rapid.simulator import make_env
from rapid.simulator.reference import make_reference_vec
from rapid.simulator.vector_env import CompiledVectorEnv

Blocks = dict[str, list[float]]


class Contest:
    """The same worlds in highway-env and in the twin, through the same actions, block by block in turn.

    highway-env drives `originals` worlds one after the other; the vector twin drives each of them
    ``worlds / originals`` times and the single twin each once, one environment per world. All go on from one block to
    the next, resets included, and all must earn the same. A side that is quick repeats its block from a copy of its
    state until the clock can tell, and the mean counts.
    """

    def __init__(self, scenario: str, worlds: int, originals: int, config: dict[str, Any], seed: int = 0) -> None:
        if worlds % originals:
            raise SystemExit(f"{worlds} worlds are no multiple of {originals}.")
        seeds = list(range(seed, seed + originals))
        self._worlds, self._originals = worlds, originals
        self._reference = make_reference_vec(scenario, originals, config=config)
        self._twin = CompiledVectorEnv(scenario, worlds, config=config)
        self._singles = [make_env(scenario, config=config) for _ in seeds]
        self._reference.reset(seed=list(seeds))
        self._twin.reset(seed=seeds * (worlds // originals))
        for env, one in zip(self._singles, seeds, strict=True):
            env.reset(seed=one)
        self._generator = np.random.default_rng(seed)
        self.results: Blocks = {"highway-env": [], "batch": [], "single": []}
        self.decisions = self.resets = 0
        self.worst = 0.0
        self._compile()

    def _compile(self) -> None:
        state, everyone = self._twin.state.copy(), np.ones(self._worlds, np.int64)
        self._twin.step(everyone)
        self._restore(state)
        snap = self._singles[0].unwrapped.snapshot()  # type: ignore[attr-defined]
        self._singles[0].step(1)
        self._singles[0].unwrapped.restore(snap)  # type: ignore[attr-defined]

    def _restore(self, state: Any) -> None:
        for array, saved in zip(self._twin.state, state, strict=True):
            array[:] = saved

    def block(self, steps: int) -> None:
        """Drive all sides through `steps` decisions of every world and note the decisions per second of CPU time."""
        actions = self._generator.integers(0, 5, (steps, self._originals))
        start = time.process_time()
        rewards = []
        for row in actions:
            _, earned, terminated, truncated, _ = self._reference.step(row)
            rewards.append(earned)
            self.resets += int((terminated | truncated).sum())
        self.results["highway-env"].append(actions.size / (time.process_time() - start))
        self.decisions += actions.size
        self._batch(actions, rewards)
        self._single(actions)

    def _batch(self, actions: Any, rewards: list[Any]) -> None:
        copies = self._worlds // self._originals
        tiled = np.tile(actions, (1, copies))
        before, spent, rounds, earned = self._twin.state.copy(), 0.0, 0, []
        while spent < 0.3:
            self._restore(before)
            start = time.process_time()
            earned = [self._twin.step(row)[1] for row in tiled]
            spent += time.process_time() - start
            rounds += 1
        self.results["batch"].append(tiled.size * rounds / spent)
        difference = np.abs(np.array(earned) - np.tile(np.array(rewards), (1, copies))).max()
        self.worst = max(self.worst, float(difference))

    def _single(self, actions: Any) -> None:
        inner: list[Any] = [env.unwrapped for env in self._singles]
        before, spent, rounds = [env.snapshot() for env in inner], 0.0, 0
        while spent < 0.3:
            for env, snap in zip(inner, before, strict=True):
                env.restore(snap)
            start = time.process_time()
            for row in actions.tolist():
                for env, action in zip(self._singles, row, strict=True):
                    *_, terminated, truncated, _ = env.step(action)
                    if terminated or truncated:
                        env.reset()
            spent += time.process_time() - start
            rounds += 1
        self.results["single"].append(actions.size * rounds / spent)

    def ratios(self, side: str) -> list[float]:
        """Return, for each block, how many times faster a side was than highway-env."""
        return [ours / theirs for ours, theirs in zip(self.results[side], self.results["highway-env"], strict=True)]


_FIRST = """
import json, time
began = time.perf_counter(), time.process_time()
from rapid.simulator import {maker}
imported = time.perf_counter(), time.process_time()
env = {make}
env.reset(seed=0)
env.step({action})
stepped = time.perf_counter(), time.process_time()
print(json.dumps([b - a for a, b in zip(began + imported, imported + stepped)]))
"""


def first_step(single: bool, cold: bool, times: int) -> dict[str, list[float]]:
    """Return import and first reset with step [s], on the wall and on the CPU, each in processes of their own.

    Args:
        single: an Env, else a VectorEnv of 64 worlds.
        cold: begin each time with an empty cache of compiled kernels; otherwise with a filled one.
        times: how often.
    """
    maker, make, action = ("make_env", 'make_env("lane-3-density-2")', "1") if single else (
        "make_vec", 'make_vec("lane-3-density-2", 64)', "[1] * 64")  # fmt: skip
    code = _FIRST.format(maker=maker, make=make, action=action)
    found: dict[str, list[float]] = {"import": [], "import_cpu": [], "first": [], "first_cpu": []}

    def run(folder: str) -> None:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder}
        ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        for name, value in zip(found, json.loads(ran.stdout), strict=True):
            found[name].append(value)

    with tempfile.TemporaryDirectory() as kept:
        if not cold:
            run(kept)
            for values in found.values():
                values.clear()
        for _ in range(times):
            with tempfile.TemporaryDirectory() as fresh:
                run(fresh if cold else kept)
    return found


def process_throughput(
    scenario: str, worlds: int, processes: int, blocks: int, seconds: float
) -> dict[str, list[float]]:
    """Return decisions per second on the wall with one process and with several, and their ratio, block by block.

    ``ratio_cpu`` compares decisions per second of CPU time of the busiest process; empty where that cannot be read.
    """
    one, several = (CompiledVectorEnv(scenario, worlds, processes=count) for count in (1, processes))
    found: dict[str, list[float]] = {"one": [], "several": [], "ratio": [], "ratio_cpu": []}
    try:
        for env in (one, several):
            env.reset(seed=0)
            env.step(np.ones(worlds, np.int64))
        generator = np.random.default_rng(0)
        for _ in range(blocks):
            # One, several, several, one: what else the machine does changes slowly and weighs on both alike.
            rates = [_rate(env, worlds, generator, seconds / 2) for env in (one, several, several, one)]
            wall, cpu = (
                [(pair[i] + other[i]) / 2 for pair, other in ((rates[0], rates[3]), rates[1:3])] for i in (0, 1)
            )
            found["one"].append(wall[0])
            found["several"].append(wall[1])
            found["ratio"].append(wall[1] / wall[0])
            if np.isfinite(cpu).all():
                found["ratio_cpu"].append(cpu[1] / cpu[0])
    finally:
        for env in (one, several):
            env.close()
    return found


def _rate(env: CompiledVectorEnv, worlds: int, generator: np.random.Generator, seconds: float) -> tuple[float, float]:
    pids = [os.getpid(), *(child.pid for child in multiprocessing.active_children() if child.pid is not None)]
    count, start, before = 0, time.perf_counter(), [_cpu_time(pid) for pid in pids]
    while (spent := time.perf_counter() - start) < seconds:
        env.step(generator.integers(0, 5, worlds))
        count += worlds
    busiest = max(_cpu_time(pid) - earlier for pid, earlier in zip(pids, before, strict=True))
    return count / spent, count / busiest


def _cpu_time(pid: int) -> float:
    """Return the CPU time of a process [s], nan where the system does not tell it."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9
    except (OSError, ValueError):
        return float("nan")
