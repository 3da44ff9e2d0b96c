"""What a gradient step of RAPID takes on a GPU, recorded as one graph or not, beside one thread of the CPU.

Every way takes some steps, then the next one does, round after round; time on the wall, the work of the GPU included.
Writes `device-speed.md` and `device-speed.json`.

    python benchmarks/device_speed.py --rounds 5
"""

import argparse
import platform
import sys
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from rapid.config import Config
from rapid.data.dataset import Dataset, load_dataset, mix
from rapid.data.replay import OfflineSampler
from rapid.files import write_json, write_text
from rapid.networks.denormals import no_denormals
from rapid.networks.q_network import build_network, set_phase
from rapid.presets import preset
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.training.learner import Learner
from simulator import processor, shown

WAYS = ("cpu", "cuda, step by step", "cuda, recorded")
UPDATES = 10
"""Updates that each way takes in a round."""


def kinds() -> dict[str, tuple[Config, str]]:
    """Return the settings and the phase of every kind of update, by its title."""
    strong, paper = preset("strong", "full"), preset("paper", "full")
    calm = replace(strong, distill=replace(strong.distill, loss=replace(strong.distill.loss, robust_weight=0.0)))
    return {
        "strong, no PGD": (calm, "distill"),
        "strong, PGD-5 on the teacher's half": (strong, "distill"),
        "paper, PGD-10 on all": (paper, "distill"),
        "strong, adapting, gate open": (preset("strong", "full", "ppo"), "adapt"),
    }


def learner_of(config: Config, phase: str, way: str, lanes: int) -> Learner:
    """Return a learner at the beginning of a phase; while adapting with the gate open."""
    device = way.partition(",")[0]
    network = build_network(config.network, lanes, 0).to(device)
    set_phase(network, phase)
    part = config.distill if phase == "distill" else config.adapt
    if phase == "adapt":
        assert network.gate is not None
        nn.init.constant_(network.gate, 0.3)
    learner = Learner(network, part.optimizer, part.loss, 10**6, torch.Generator(device).manual_seed(0))
    if way == "cuda, step by step":
        learner._step = learner._take_step
    return learner


@no_denormals()
def measure(dataset: Dataset, sizes: list[int], rounds: int) -> list[dict[str, Any]]:
    """Return the milliseconds of one update by kind, batch size, way and round."""
    lanes = get_scenario(dataset.scenario).lanes
    results: list[dict[str, Any]] = []
    with task("device speed", len(kinds()) * len(sizes), "kinds") as progress:
        for title, (config, phase) in kinds().items():
            for size in sizes:
                spent: dict[str, list[float]] = {way: [] for way in WAYS}
                learners = {way: learner_of(config, phase, way, lanes) for way in WAYS}
                samplers = {way: OfflineSampler(dataset.transitions, 0.9, 1, way.partition(",")[0]) for way in WAYS}
                for number in range(rounds + 1):
                    for way, learner in learners.items():
                        rng = np.random.default_rng(number)
                        torch.cuda.synchronize()
                        start = time.perf_counter()
                        for _ in range(UPDATES):
                            learner.update(samplers[way].sample(size, rng))
                        torch.cuda.synchronize()
                        if number:  # the first round warms up and records
                            spent[way].append((time.perf_counter() - start) / UPDATES * 1e3)
                        learner.means()
                results.append({"kind": title, "batch_size": size, "ms": spent})
                progress.advance()
    return results


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="rounds that are counted")
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[32, 64], help="transitions in a batch; 512 take the CPU minutes"
    )
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the table goes")
    chosen = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("error: torch sees no CUDA device here. Run this on a machine with one.")
    torch.set_num_threads(1)
    parts = [load_dataset(f"shipped:lane-3-density-2/{name}") for name in ("teacher", "random")]
    results = measure(mix(*parts, 0.5, 30_000, 0), chosen.sizes, chosen.rounds)
    lines = [
        "# Training on a GPU",
        "",
        f"Milliseconds of one update, sampling its batch included: median (least to most) of {chosen.rounds} rounds of "
        f"{UPDATES}, the ways in turns.",
        "",
        f"| update | batch | {' | '.join(WAYS)} | recorded against step by step | against the CPU |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in results:
        cells = [shown(row["ms"][way], 2) for way in WAYS]
        ratios = [
            f"×{shown([a / b for a, b in zip(row['ms'][way], row['ms'][WAYS[2]], strict=True)], 1)}"
            for way in (WAYS[1], WAYS[0])
        ]
        lines.append(f"| {row['kind']} | {row['batch_size']} | {' | '.join([*cells, *ratios])} |")
    command = " ".join(["python", "benchmarks/device_speed.py", *sys.argv[1:]])
    lines += [
        "",
        f"{torch.cuda.get_device_name()}; {processor()}, one thread; torch {version('torch')}, Python "
        f"{platform.python_version()}, commit {commit() or 'unknown'}. Made with `{command}`.",
    ]
    write_json(chosen.out / "device-speed.json", {"results": results, "commit": commit()})
    write_text(chosen.out / "device-speed.md", "\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
