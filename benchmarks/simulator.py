"""How fast the compiled simulator is, against highway-env in the same process on the same worlds.

Drives the same worlds with the same actions through both, in turn, and compares CPU time; then the first step of a
fresh process, memory, several processes, and where the time goes. Writes `simulator-speed.md` and
`simulator-speed.json`.

    python benchmarks/simulator.py --blocks 7 --out results
"""

import argparse
import os
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rapid.files import write_json, write_text
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.simulator.compile import kernel_stamp
from rapid.simulator.settings import read_settings
from rapid.simulator.vector_env import CompiledVectorEnv
from simulator_parts import Contest, first_step, process_throughput
from simulator_profile import profile

TRAJECTORIES = {"show_trajectories": False}
STEPS = {"v0": 4, "fast": 16}
"""Decisions of each world per block."""


def processor() -> str:
    """Return the model of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def shown(values: Sequence[float], digits: int = 0) -> str:
    """Return the median of some numbers and their range."""
    return f"{np.median(values):,.{digits}f} ({min(values):,.{digits}f} to {max(values):,.{digits}f})"


def vehicle_steps(scenario: str) -> int:
    """Return how many vehicles are moved by a frame in one decision: all of the road, the ego included, each frame."""
    named = get_scenario(scenario)
    settings = read_settings(named.config(), named.dynamics)
    return settings.frames * (settings.traffic + 1)


def race(scenario: str, worlds: int, blocks: int, config: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers of one scenario against highway-env."""
    contest = Contest(scenario, worlds, 8, config)
    dynamics = "fast" if "-fast" in scenario else "v0"
    with task(f"{scenario} against highway-env", blocks, "blocks") as progress:
        for _ in range(blocks):
            contest.block(STEPS[dynamics])
            progress.note(f"{np.median(contest.ratios('batch')):,.0f} times as fast")
            progress.advance()
    return {
        "scenario": scenario,
        "config": config,
        "worlds": worlds,
        "decisions_of_highway_env": contest.decisions,
        "resets_of_highway_env": contest.resets,
        "largest_difference_of_a_reward": contest.worst,
        "decisions_per_cpu_second": contest.results,
        "ratio_batch": contest.ratios("batch"),
        "ratio_single": contest.ratios("single"),
    }


def measure(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return all numbers."""
    names = ("rapid-driving", "numpy", "numba", "llvmlite", "gymnasium", "highway-env", "pygame-ce")
    result: dict[str, Any] = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join(["python", "benchmarks/simulator.py", *sys.argv[1:]]),
        "commit": commit(),
        "kernels": kernel_stamp().hex()[:12],
        "processor": processor(),
        "cores": os.cpu_count(),
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in names}},
        "races": [],
        "profiles": {},
        "bytes_per_world": {},
    }
    for scenario in chosen.scenarios:
        for config in ({}, TRAJECTORIES):
            result["races"].append(race(scenario, chosen.worlds, chosen.blocks, config))
        env = CompiledVectorEnv(scenario, 1)
        result["bytes_per_world"][scenario] = env.state.bytes_per_world
        phases, whole = profile(scenario, chosen.worlds, 25, 5)
        result["profiles"][scenario] = {"microseconds": phases, "whole_step_microseconds": whole}
    with task("first step of a fresh process", 4, "kinds") as progress:
        for name, single, cold in (("env", True, False), ("vector", False, False)):
            result[f"first_step_{name}_warm"] = first_step(single, cold, chosen.blocks)
            progress.advance()
        for name, single in (("env", True), ("vector", False)):
            result[f"first_step_{name}_cold"] = first_step(single, True, 1)
            progress.advance()
    if chosen.processes > 1:
        with task(f"{chosen.processes} processes", len(chosen.scenarios), "scenarios") as progress:
            result["processes"] = {}
            for scenario in chosen.scenarios:
                found = process_throughput(scenario, 256, chosen.processes, chosen.blocks, 2.0)
                result["processes"][scenario] = {"count": chosen.processes, "worlds": 256, **found}
                progress.advance()
    return result


def report(result: dict[str, Any]) -> str:
    """Return the tables as Markdown."""
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    worlds = result["races"][0]["worlds"]
    lines = [
        "# Speed of the compiled simulator",
        "",
        f"{result['date']}; {result['processor']}, {result['cores']} cores, load average "
        f"{result['load_average'][0] if result['load_average'] else float('nan'):.1f}; {versions}; commit "
        f"{result['commit'] or 'unknown'}, kernels {result['kernels']}.",
        "",
        f"Made with: {result['command']}",
        "",
        "## Against highway-env",
        "",
        "One process, one thread, CPU time, in turn, block by block. Both sides drive the same worlds from the same "
        "seeds with the same uniformly random actions, go on after every end, and resets count on both. Median "
        "over the blocks (range). A vehicle-step is one vehicle moved by one frame of the simulation, on one core. "
        "`B = 1` is the Gymnasium environment of one world. `show_trajectories` only draws, "
        "but highway-env spends time on it; the paper's configuration has it on.",
        "",
        "| scenario | show_trajectories | highway-env, decisions/s | "
        f"B = {worlds}, decisions/s | vehicle-steps/s | ratio | B = 1, decisions/s | ratio | decisions (resets) "
        "| rewards differ by |",
        "|---" * 10 + "|",
    ]
    for run in result["races"]:
        speeds = run["decisions_per_cpu_second"]
        cells = [
            run["scenario"],
            "off" if run["config"] else "on",
            shown(speeds["highway-env"], 2),
            shown(speeds["batch"]),
            f"{np.median(speeds['batch']) * vehicle_steps(run['scenario']) / 1e6:.1f} million",
            f"**{shown(run['ratio_batch'])}**",
            shown(speeds["single"]),
            shown(run["ratio_single"]),
            f"{run['decisions_of_highway_env']} ({run['resets_of_highway_env']})",
            f"{run['largest_difference_of_a_reward']:.1g}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## First step of a fresh process [s]", ""]
    lines += ["| | import | reset and first step | of it CPU |", "|---|---|---|---|"]
    for name, text in (("env", "one world"), ("vector", "64 worlds")):
        for cache, note in (("warm", "kernels cached"), ("cold", "kernels compiled")):
            found = result[f"first_step_{name}_{cache}"]
            cells = [f"{text}, {note}", *(shown(found[key], 2) for key in ("import", "first", "first_cpu"))]
            lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## Memory", "", "| scenario | bytes per world |", "|---|---|"]
    lines += [f"| {name} | {count:,} |" for name, count in result["bytes_per_world"].items()]
    if "processes" in result:
        lines += ["", "## Several processes, on the wall", ""]
        lines += [
            "The ratio on the wall says what this machine gave while it was measured; the other one compares CPU "
        ]
        lines[-1] += "time of the busiest process and says what cores of one's own give, were waking up free."
        lines += ["", "| scenario | processes | one, decisions/s | several, decisions/s | ratio | by CPU time |"]
        lines += ["|---" * 6 + "|"]
        for name, found in result["processes"].items():
            cells = [name, str(found["count"]), shown(found["one"]), shown(found["several"]), shown(found["ratio"], 2)]
            cells.append(shown(found["ratio_cpu"], 2) if found["ratio_cpu"] else "–")
            lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "## Where the time goes", "", "µs of CPU time per decision of one world, and the share.", ""]
    lines += ["| phase | " + " | ".join(result["profiles"]) + " |", "|---" * (1 + len(result["profiles"])) + "|"]
    profiles = [found["microseconds"] for found in result["profiles"].values()]
    for phase in profiles[0]:
        cells = [f"{found[phase]:.1f} ({found[phase] / sum(found.values()):.0%})" for found in profiles]
        lines.append(f"| {phase} | " + " | ".join(cells) + " |")
    lines.append("| sum | " + " | ".join(f"{sum(found.values()):.1f}" for found in profiles) + " |")
    whole = [found["whole_step_microseconds"] for found in result["profiles"].values()]
    lines.append("| the compiled step and resets, whole | " + " | ".join(f"{number:.1f}" for number in whole) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--scenarios", nargs="+", default=["lane-3-density-2", "lane-3-density-2-fast"])
    parser.add_argument("--blocks", type=int, default=7, help="how often each side has its turn")
    parser.add_argument("--worlds", type=int, default=64, help="B, a multiple of 8")
    parser.add_argument("--processes", type=int, default=2, help="compared with one; 1 leaves this out")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the results go")
    chosen = parser.parse_args()
    result = measure(chosen)
    write_json(chosen.out / "simulator-speed.json", result)
    text = report(result)
    write_text(chosen.out / "simulator-speed.md", text)
    print(text)


if __name__ == "__main__":
    main()
