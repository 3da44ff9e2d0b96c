"""How long a script of stable-baselines3 trains on HighwayEnv, and how long with one line changed on the twin.

The script is read as it is, such as HighwayEnv's own ``scripts/sb3_highway_dqn.py``. Every `highway-fast-v0` or
`highway-v0` in it becomes the twin's id, and nothing else. Both run in turn, each in processes of its own, until
``learn`` returns; what follows it is left out. Told is the CPU time of ``learn``, that of subprocesses included.

    python benchmarks/published_script.py sb3_highway_dqn.py --steps 1000 --blocks 3
"""

import argparse
import difflib
import json
import os
import platform
import re
import subprocess
import sys
import time
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import_module("highway_env")  # a script's subprocesses begin with this file in the script's place


def on_the_twin(source: str) -> str:
    """Return the script with HighwayEnv's ids replaced by the twin's, which Gymnasium finds by itself."""
    return re.sub(r"""(["'])(highway-(?:fast-)?v0)\1""", r"\1rapid:rapid/\2\1", source)


def changed_lines(source: str) -> list[str]:
    """Return the lines that are others on the twin, before and after."""
    lines = difflib.ndiff(source.splitlines(), on_the_twin(source).splitlines())
    return [line for line in lines if line.startswith(("- ", "+ "))]


def spent(model: Any) -> float:
    """Return the seconds of CPU time of this process and of those in which the model's worlds are."""
    total = time.process_time()
    for process in getattr(model.get_env().unwrapped, "processes", ()):
        words = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    return total


def train(path: Path, steps: int, twin: bool) -> None:
    """Run the script until it has learned for so many steps, and print the seconds that took as JSON."""
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    def timed(algorithm: type[BaseAlgorithm]) -> None:
        learn = algorithm.learn

        def measured(model: Any, total_timesteps: int, **more: Any) -> None:
            wall, cpu = time.perf_counter(), spent(model)
            learn(model, steps, **more)
            found = {"wall": time.perf_counter() - wall, "cpu": spent(model) - cpu, "steps": model.num_timesteps}
            model.get_env().close()
            print(json.dumps(found), flush=True)
            os._exit(0)

        algorithm.learn = measured  # type: ignore[method-assign, assignment]

    timed(OnPolicyAlgorithm)
    timed(OffPolicyAlgorithm)
    source = path.read_text(encoding="utf-8")
    exec(compile(on_the_twin(source) if twin else source, str(path), "exec"), {"__name__": "__main__"})
    raise SystemExit(f"{path} never called learn().")


def measure(path: Path, steps: int, twin: bool) -> dict[str, float]:
    """Return what a process of its own measured."""
    words = [sys.executable, __file__, str(path), "--steps", str(steps), "--train", "twin" if twin else "original"]
    ran = subprocess.run(words, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise SystemExit(f"{path} failed:\n{ran.stderr[-3000:]}")
    return json.loads(ran.stdout.strip().splitlines()[-1])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("script", type=Path)
    parser.add_argument("--steps", type=int, default=1_000)
    parser.add_argument("--blocks", type=int, default=3, help="how often each has its turn")
    parser.add_argument("--train", choices=("original", "twin"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.train:
        train(chosen.script, chosen.steps, chosen.train == "twin")
    print("\n".join(changed_lines(chosen.script.read_text(encoding="utf-8"))), flush=True)
    measure(chosen.script, 1, True)  # so that the kernels are compiled
    taken: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(chosen.blocks):
        for twin in taken:
            found = measure(chosen.script, chosen.steps, twin)
            taken[twin].append(found["cpu"])
            name = "twin" if twin else "original"
            words = (
                f"{found['steps']:,} steps in {taken[twin][-1]:.1f} s of CPU time, {found['wall']:.1f} s on the wall"
            )
            print(f"{name}: {words}", flush=True)
    ratio = np.array(taken[False]) / np.array(taken[True])
    names = ("highway-env", "stable_baselines3", "torch", "numba")
    print(f"original / twin: {np.median(ratio):.1f} ({ratio.min():.1f} to {ratio.max():.1f})")
    print(f"python {platform.python_version()}, " + ", ".join(f"{name} {version(name)}" for name in names))


if __name__ == "__main__":
    main()
