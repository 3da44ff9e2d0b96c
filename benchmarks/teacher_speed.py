"""How fast the embedded teachers decide, and how many times faster a policy is that was distilled from them.

Every model decides the same recorded scenes, evenly spaced over the shipped set of a scenario, in batches of several
sizes (the episodes driven in lockstep): first with no score remembered, then again with all of them. What a scene's
facts cost is paid both times. Writes `teacher-speed.md` and `teacher-speed.json`.

    python benchmarks/teacher_speed.py --models smollm2-135m:256 --agents RUN/distill/agent --out results
"""

import argparse
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import rapid
from rapid.agents.onnx import export_onnx, latency
from rapid.data.dataset import load_dataset, summary
from rapid.files import write_json, write_text
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.teacher.agent import ScoringTeacher
from rapid.teacher.facts import gather
from rapid.teacher.foresight import look_ahead
from rapid.teacher.local import LocalModel
from rapid.teacher.models import dense_folder
from rapid.teacher.prompt import digest
from rapid.teacher.scene import read_scenes
from simulator import processor, shown

DECISIONS = 15_000
"""What a dataset of the paper holds; the aim is to have them in 40 minutes on two cores."""


def timed(call: Callable[[], object]) -> float:
    """Return the seconds on the wall that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def spaced(obs_NVF: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return `count` observations, evenly spaced."""
    return obs_NVF[np.linspace(0, len(obs_NVF) - 1, count).astype(int)]


def prompts(obs_BVF: NDArray[np.float32], lanes: int) -> list[str]:
    """Return the prompt of every scene; the look ahead starts anew."""
    look_ahead.cache_clear()
    return [digest(gather(scene)).user for scene in read_scenes(obs_BVF, lanes)]


def measure_model(name: str, obs_BVF: NDArray[np.float32], lanes: int, sizes: list[int], blocks: int) -> dict[str, Any]:
    """Return the numbers of one model: decisions/s by batch size, a value for each block."""
    folder, _, template = dense_folder(name)
    start = time.perf_counter()
    model = LocalModel(folder, template)
    loading = time.perf_counter() - start
    teacher = ScoringTeacher(model, {"model": name}, lanes)
    teacher.decide(obs_BVF[:1], [None])  # calibrates, and compiles what the facts need

    def decide(size: int) -> None:
        look_ahead.cache_clear()
        for first in range(0, len(obs_BVF), size):
            group = obs_BVF[first : first + size]
            teacher.decide(group, [None] * len(group))

    found: dict[str, Any] = {
        "model": name,
        "decisions": len(obs_BVF),
        "prompts": len(set(prompts(obs_BVF, lanes))),
        "seconds_to_load": loading,
        "cold": {size: [] for size in sizes},
        "warm": {size: [] for size in sizes},
    }
    with task(name, blocks * len(sizes), "passes") as progress:
        for _ in range(blocks):
            for size in sizes:
                model.forget()
                for state in ("cold", "warm"):
                    found[state][size].append(len(obs_BVF) / timed(lambda size=size: decide(size)))
                progress.note(f"batch {size}: {found['cold'][size][-1]:.1f} and {found['warm'][size][-1]:.1f}/s")
                progress.advance()
    return found


def seconds_per_prompt(found: dict[str, Any], size: int) -> float:
    """Return what a prompt costs that was not seen before, beyond its facts."""
    cold, warm = (np.median(found[state][size]) for state in ("cold", "warm"))
    return float(found["decisions"] * (1 / cold - 1 / warm) / found["prompts"])


def minutes(found: dict[str, Any], size: int, different: int) -> float:
    """Return how long a collection would take from cold: its facts, and each of its different prompts once."""
    return (DECISIONS / float(np.median(found["warm"][size])) + different * seconds_per_prompt(found, size)) / 60


def measure_agent(path: str, obs_BVF: NDArray[np.float32]) -> dict[str, Any]:
    """Return the seconds that a saved agent takes for one decision, by torch and exported."""
    agent = rapid.load_agent(path)
    calls = [timed(lambda row=row: agent.act(obs_BVF[row : row + 1])) for row in range(len(obs_BVF))]
    with tempfile.TemporaryDirectory() as folder:
        export_onnx(agent, Path(folder) / "agent.onnx", obs_BVF)
        exported = latency(Path(folder) / "agent.onnx", obs_BVF[0])
    return {"agent": agent.name, "torch": float(np.median(calls)), "onnx": exported}


def measure(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return all numbers."""
    torch.set_num_threads(chosen.threads)
    data = load_dataset(f"shipped:{chosen.scenario}/teacher")
    obs_NVF, lanes = data.transitions.obs_NVF, get_scenario(chosen.scenario).lanes
    told = summary(data)["decisions"]
    result: dict[str, Any] = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join(["python", "benchmarks/teacher_speed.py", *sys.argv[1:]]),
        "commit": commit(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": chosen.threads,
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("rapid-driving", "torch", "transformers", "numpy", "numba")},
        },
        "scenario": chosen.scenario,
        "shipped": {name: told[name] for name in ("prompts", "seconds")} | {"decisions": len(data)},
        "models": [],
        "agents": [measure_agent(path, spaced(obs_NVF, 256)) for path in chosen.agents],
    }
    prompts(obs_NVF[:1], lanes)
    scenes = spaced(obs_NVF, 128)
    result["seconds_of_facts"] = [timed(lambda: prompts(scenes, lanes)) / len(scenes) for _ in range(chosen.blocks)]
    for entry in chosen.models:
        name, _, count = entry.partition(":")
        scenes = spaced(obs_NVF, int(count or 256))
        result["models"].append(measure_model(name, scenes, lanes, chosen.sizes, chosen.blocks))
    return result


def report(result: dict[str, Any]) -> str:
    """Return the tables as Markdown."""
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    facts, shipped = np.median(result["seconds_of_facts"]), result["shipped"]
    lines = [
        "# Speed of the embedded teachers",
        "",
        f"{result['date']}; {result['processor']}, {result['cores']} cores, {result['threads']} thread, load average "
        f"{result['load_average'][0] if result['load_average'] else float('nan'):.1f}; {versions}; commit "
        f"{result['commit'] or 'unknown'}.",
        "",
        f"Made with: {result['command']}",
        "",
        f"Style `digest`, scenes evenly spaced over `shipped:{result['scenario']}/teacher`, on the wall; median over "
        f"the passes (range). The facts of a scene take {facts * 1e3:.1f} ms, whoever is told them. Cold: no score is "
        "remembered; warm: all are. A new prompt: what it costs beyond its facts. The last column adds up what "
        f"{DECISIONS:,} decisions with {shipped['prompts']} different prompts would take from cold; the shipped ones "
        f"took {shipped['seconds'] / 60:.1f} minutes of deciding, in batches of 16.",
    ]
    for found in result["models"]:
        lines += ["", f"## {found['model']}", ""]
        lines += [
            f"{found['decisions']} decisions, {found['prompts']} different prompts; loaded in "
            f"{found['seconds_to_load']:.1f} s.",
            "",
            f"| batch | cold, decisions/s | warm, decisions/s | s per new prompt | minutes for {DECISIONS:,} |",
            "|---" * 5 + "|",
        ]
        for size in found["cold"]:
            cells = [str(size), shown(found["cold"][size], 2), shown(found["warm"][size], 1)]
            cells += [f"{seconds_per_prompt(found, size):.3f}", f"{minutes(found, size, shipped['prompts']):.1f}"]
            lines.append(f"| {' | '.join(cells)} |")
    if result["agents"]:
        teacher = result["models"][0]
        slowest, fastest = (
            float(pick(np.median(values) for state in ("cold", "warm") for values in teacher[state].values()))
            for pick in (min, max)
        )
        lines += ["", "## Policies", "", "One decision at batch 1, one thread, median.", ""]
        lines += [f"| agent | torch, µs | exported, µs | exported, times faster than {teacher['model']} |"]
        lines += ["|---" * 4 + "|"]
        for found in result["agents"]:
            times = f"{1 / fastest / found['onnx']:,.0f} (all remembered) to {1 / slowest / found['onnx']:,.0f} (cold)"
            cells = [found["agent"], f"{found['torch'] * 1e6:,.0f}", f"{found['onnx'] * 1e6:,.0f}", times]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--models", nargs="+", default=["smollm2-135m"], help="NAME[:SCENES]")
    parser.add_argument("--sizes", nargs="+", type=int, default=[1, 4, 16, 64], help="scenes decided together")
    parser.add_argument("--blocks", type=int, default=3, help="how often each size has its turn")
    parser.add_argument("--agents", nargs="*", default=[], help="directories of agents to compare with")
    parser.add_argument("--scenario", default="lane-3-density-2", help="whose shipped set gives the scenes")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the results go")
    chosen = parser.parse_args()
    result = measure(chosen)
    write_json(chosen.out / "teacher-speed.json", result)
    text = report(result)
    write_text(chosen.out / "teacher-speed.md", text)
    print(text)


if __name__ == "__main__":
    main()
