"""What a step of PPO costs, clean and under attack, and in which part; on demand beside an earlier commit, in turns.

RAPID's network of the recipe `strong` learns from 128 worlds of a scenario by the plan `ppo`, where the adapter, the
router and the decoder are trained and policy 1 is not, and by the plan `robust`, where everything is trained and
attacks of so many gradient steps have begun. Each contestant is a process; rollout after rollout they
take turns, so that a busy moment meets them all. CPU time is counted, and the clock's, which says nothing on a busy
machine; at the end it is told whether the weights are the same. Writes `ppo-speed.md` and `ppo-speed.json`.

    python benchmarks/ppo_speed.py --before v0.9 --rounds 7
"""

import argparse
import importlib
import importlib.util
import inspect
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).parents[1]
PARTS: tuple[str, ...] = ("simulator", "driving", "attack", "forward", "backward", "optimiser")
"""Where the time goes: stepping the worlds; choosing actions and valuing what was met; the attack on what is seen; and
of the updates the losses, their gradients, and the steps along them."""
GATE = 0.3
"""The zero gate: once it is open, the adapter is computed."""


class Clock:
    """Counts the CPU seconds of each part; a part within another is taken off it.

    With several threads the parts of an update overlap, and each is counted with what goes on beside it.
    """

    def __init__(self) -> None:
        self.spent: dict[str, float] = dict.fromkeys(PARTS, 0.0)
        self.inside = ""

    def timed(self, part: str, function: Callable[..., Any], within: str = "") -> Callable[..., Any]:
        """Return the function, counted as `part` whenever the part `within`, if one is named, is under way."""

        def run(*given: Any, **named: Any) -> Any:
            before = self.inside
            if within and before != within:
                return function(*given, **named)
            start = time.process_time()
            self.inside = part
            try:
                return function(*given, **named)
            finally:
                self.inside = before
                seconds = time.process_time() - start
                self.spent[part] += seconds
                if before:
                    self.spent[before] -= seconds

        return run


def compete(plan: str, attack_steps: int, scenario: str, threads: int, attention: str) -> None:
    """Take a rollout for every line of the standard input; tell the seconds of each part, and what the weights are."""
    from rapid.networks import q_network
    from rapid.phases import adapt as phase
    from rapid.presets import preset
    from rapid.scenarios import get_scenario, seeing
    from rapid.simulator import make_vec
    from rapid.training.collector import Collector
    from rapid.training.machinery import adam, adversary, worlds
    from rapid.training.machinery.record import network_fingerprint

    # Earlier programs have the learner in the module of the training.
    place = "ppo_learner" if importlib.util.find_spec("rapid.training.ppo_learner") else "ppo"
    ppo = importlib.import_module(f"rapid.training.{place}")
    torch.set_num_threads(threads)
    torch.set_flush_denormal(True)
    config, seen = preset("strong", "full", plan), get_scenario(scenario)
    adapt = config.adapt
    settings = replace(adapt.ppo, critic_steps=0, **({"attention": attention} if attention else {}))
    liar = replace(adapt.adversary, steps=attack_steps) if attack_steps else adapt.adversary
    network = q_network.build_network(config.network, seen.lanes, 0)
    if adapt.memory:
        # Earlier programs squeeze nothing, and have this beside the network.
        place = "conversions" if importlib.util.find_spec("rapid.networks.conversions") else "q_network"
        with_memory = importlib.import_module(f"rapid.networks.{place}").with_memory
        network = with_memory(network, *([True] if getattr(adapt, "squeeze", False) else []))
    gate = network.gate
    assert gate is not None
    torch.nn.init.constant_(gate, GATE)
    q_network.set_phase(network, "adapt" if adapt.train == "adapter" else "all")
    clock = Clock()
    torch.autograd.grad = clock.timed("backward", torch.autograd.grad, within="forward")
    ppo.clip_norm = clock.timed("optimiser", adam.clip_norm)
    adam.Adam.step = clock.timed("optimiser", adam.Adam.step)
    adversary.Adversary.__call__ = clock.timed("attack", adversary.Adversary.__call__)
    worlds.Drive.step = clock.timed("simulator", worlds.Drive.step)
    learner = ppo.PpoLearner(network, settings, adapt.optimizer.gate_rate, seen.clock, 0, 10**6)
    timed, rows = replace(seen, clock=True), seeing(network.config.vehicles)
    # Earlier programs step all worlds in one process, whatever the threads.
    processes = threads if "processes" in inspect.getsource(phase) else 1
    make = partial(make_vec, timed, config=rows, processes=processes)
    drive = worlds.Drive(make, settings.num_envs, 0, network.lanes if network.config.memory else None)
    collector = Collector(drive, settings, liar, network.scale_F, 0, "cpu")
    collect, update = clock.timed("driving", collector.collect), clock.timed("forward", learner.update)
    for _ in sys.stdin:
        clock.spent = dict.fromkeys(PARTS, 0.0)
        start, start_cpu = time.perf_counter(), time.process_time()
        # Earlier programs have no choice of how attention is computed.
        with learner.computing() if hasattr(learner, "computing") else nullcontext():
            update(collect(learner, 1))
        whole = {"cpu": time.process_time() - start_cpu, "clock": time.perf_counter() - start}
        steps = settings.num_envs * settings.rollout
        told = {"steps": steps, "seconds": clock.spent | whole, "weights": network_fingerprint(network)}
        print(json.dumps(told), flush=True)


class Contestant:
    """A process that learns, of one tree of files."""

    def __init__(self, tree: Path, plan: str, attack_steps: int, given: list[str]) -> None:
        words = ["--compete", plan, "--attack-steps", str(attack_steps), *given]
        self._process = subprocess.Popen(
            [sys.executable, __file__, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": "1"},
        )

    def turn(self) -> dict[str, Any]:
        """Return what one more rollout took."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print("go", file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            sys.exit("A contestant has ended; what it said stands above.")
        return json.loads(answer)

    def end(self) -> None:
        """Let it go."""
        self._process.communicate()


def race(
    contestants: dict[str, tuple[Path, list[str]]], plans: dict[str, tuple[str, int]], rounds: int
) -> list[dict[str, Any]]:
    """Return what every contestant, a tree of files and further words, took in each round."""
    results: list[dict[str, Any]] = []
    for title, (plan, attack_steps) in plans.items():
        there = {name: Contestant(tree, plan, attack_steps, words) for name, (tree, words) in contestants.items()}
        turns: dict[str, list[dict[str, Any]]] = {name: [] for name in contestants}
        for _ in range(rounds + 1):
            for name, contestant in there.items():
                turns[name].append(contestant.turn())
        for name, contestant in there.items():
            contestant.end()
            # The first round warms up.
            took = turns[name][1:]
            seconds = {part: [each["seconds"][part] for each in took] for part in (*PARTS, "cpu", "clock")}
            weights = took[-1]["weights"]
            results.append(
                {"kind": title, "who": name, "steps": took[0]["steps"], "seconds": seconds, "weights": weights}
            )
    return results


def report(results: list[dict[str, Any]], commits: dict[str, str], scenario: str, rounds: int, command: str) -> str:
    """Return the tables as Markdown."""
    lines = [
        "# What a step of PPO costs",
        "",
        f"Steps of {scenario} in a second of CPU time, and by the clock, median (least to most) of {rounds} rollouts "
        f"of {results[0]['steps']:,} steps, all contestants in turns. The shares are of the median rollout's CPU time: "
        "stepping the worlds; choosing actions and valuing what was met; attacking what is seen; and of the updates "
        "the losses, their gradients, and the steps along them.",
        "",
        f"| training | program | steps per CPU second | by the clock | {' | '.join(PARTS)} | weights |",
        f"|---|---|---|---|{'---|' * len(PARTS)}---|",
    ]
    for result in results:
        rates, clocked = (result["steps"] / np.array(result["seconds"][kind]) for kind in ("cpu", "clock"))
        shares = [np.median(result["seconds"][part]) / np.median(result["seconds"]["cpu"]) for part in PARTS]
        first = next(other for other in results if other["kind"] == result["kind"])
        same = "" if first is result else "the same" if first["weights"] == result["weights"] else "others"
        rate = f"**{np.median(rates):,.0f}** ({min(rates):,.0f} to {max(rates):,.0f}) | {np.median(clocked):,.0f}"
        parts = " | ".join(f"{share:.0%}" for share in shares)
        lines.append(f"| {result['kind']} | {result['who']} | {rate} | {parts} | {same} |")
    made = ", ".join(f"{name}: commit {sha}" for name, sha in commits.items())
    versions = f"torch {version('torch')}, numba {version('numba')}, Python {platform.python_version()}"
    lines += [
        "",
        f"{processor()}, {versions}; {made}. Made with `{command}`.",
    ]
    return "\n".join(lines) + "\n"


def processor() -> str:
    """Return the model of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def git(tree: Path, *words: str) -> str:
    """Return what git answers in a tree of files."""
    return subprocess.run(["git", "-C", str(tree), *words], capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=7, help="rollouts that are counted")
    parser.add_argument("--before", default="", help="a commit, or a folder with one, beside which it is measured")
    parser.add_argument("--attack-steps", type=int, default=10, help="gradient steps of the attack")
    parser.add_argument("--scenario", default="lane-3-density-2", help="where it drives")
    parser.add_argument("--threads", type=int, default=1, help="threads of a contestant")
    parser.add_argument("--attention", default="", help="adapt.ppo.attention of these files in place of the plans'")
    parser.add_argument("--out", type=Path, default=ROOT / "results", help="where the tables go")
    parser.add_argument("--compete", default="", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.compete:
        compete(chosen.compete, chosen.attack_steps, chosen.scenario, chosen.threads, chosen.attention)
        return
    plans = {"clean": ("ppo", 0), f"{chosen.attack_steps} attack steps": ("robust", chosen.attack_steps)}
    command = " ".join(["python", "benchmarks/ppo_speed.py", *sys.argv[1:]])
    with tempfile.TemporaryDirectory() as folder:
        trees, made = {"now": ROOT}, bool(chosen.before) and not Path(chosen.before).is_dir()
        if chosen.before:
            before = Path(folder) / "before" if made else Path(chosen.before)
            trees = {"before": before, **trees}
        if made:
            git(ROOT, "worktree", "add", "--detach", str(trees["before"]), chosen.before)
        try:
            commits = {name: git(tree, "rev-parse", "--short", "HEAD") for name, tree in trees.items()}
            given = ["--scenario", chosen.scenario, "--threads", str(chosen.threads)]
            own = given + (["--attention", chosen.attention] if chosen.attention else [])
            contestants = {name: (tree, own if name == "now" else given) for name, tree in trees.items()}
            results = race(contestants, plans, chosen.rounds)
        finally:
            if made:
                git(ROOT, "worktree", "remove", "--force", str(trees["before"]))
    text = report(results, commits, chosen.scenario, chosen.rounds, command)
    chosen.out.mkdir(parents=True, exist_ok=True)
    (chosen.out / "ppo-speed.json").write_text(json.dumps({"results": results, "commits": commits}, indent=1) + "\n")
    (chosen.out / "ppo-speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
