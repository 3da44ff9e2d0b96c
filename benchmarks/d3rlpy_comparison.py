"""RAPID's baselines against d3rlpy's: the losses, the speed of training, and with --scores what the policies earn.

d3rlpy pins other versions of Gymnasium, so it lives in an environment of its own, made once in the user's cache, and
is spoken to through `d3rlpy_worker.py`. Both sides train on the same transitions: the export gives an episode that the
clock cut off one more step, so that d3rlpy drops nothing real, and both bootstrap there but not after a crash. For the
scores d3rlpy's weights are put into our network, so that one program measures both.

    python benchmarks/d3rlpy_comparison.py --losses
    python benchmarks/d3rlpy_comparison.py --speed --rounds 7
    python benchmarks/d3rlpy_comparison.py --together --seeds 5 --iterations 10000
    python benchmarks/d3rlpy_comparison.py --scores --dataset RUN/mix --seeds 5 --iterations 10000 --spawns 200
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import time
import venv
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rapid.agents.saved import QAgent
from rapid.baselines import offline_baseline
from rapid.config import DistillConfig, NetworkConfig
from rapid.data.batch import TransitionBatch
from rapid.data.dataset import Dataset, load_dataset, save_dataset
from rapid.data.exchange import export_d3rlpy
from rapid.data.replay import OfflineSampler
from rapid.evaluation.metrics import EpisodeRow, column, load_rows, save_rows
from rapid.evaluation.rollouts import run_episodes
from rapid.evaluation.statistics import Estimate, estimate
from rapid.files import cache_dir, write_json, write_text
from rapid.losses import q_loss
from rapid.networks.q_network import QNetwork, build_network
from rapid.networks.stack import stack_networks
from rapid.phases.data import collect_transitions
from rapid.presets import preset
from rapid.progress import task
from rapid.runs import commit as source_commit
from rapid.scenarios import get_scenario
from rapid.seeding import stream_seed
from rapid.spawns import spawn_seeds
from rapid.training.offline import data_fingerprint, distill

VERSION = "2.8.1"
KINDS = ("dqn", "ddqn", "cql")
PAPER = preset("paper", "full")
NETWORK: NetworkConfig = replace(PAPER.network, kind="mlp")


def settings(kind: str, iterations: int = 1) -> DistillConfig:
    """Return our settings of a baseline: recipe `paper`, without the robust term."""
    return replace(offline_baseline(PAPER, kind).distill, iterations=iterations, evaluate_every=0)


def their_settings(kind: str) -> dict[str, Any]:
    """Return the same settings in d3rlpy's words."""
    ours = settings(kind)
    return {
        "kind": kind,
        "learning_rate": ours.optimizer.learning_rate,
        "batch_size": ours.optimizer.batch_size,
        "target_update": ours.optimizer.target_update,
        "discount": ours.loss.discount,
        "hidden": list(NETWORK.hidden),
    }


class Worker:
    """A process in d3rlpy's environment, which is made if need be."""

    def __init__(self, folder: Path) -> None:
        python = folder / "bin" / "python"
        if not (folder / ".installed").exists():
            print(f"Installing d3rlpy {VERSION} into {folder} (once; some minutes) ...", file=sys.stderr)
            venv.create(folder, with_pip=True)
            ours = version("torch")
            index = ["--extra-index-url", "https://download.pytorch.org/whl/cpu"] if ours.endswith("+cpu") else []
            wanted = [f"torch=={ours}", f"numpy=={version('numpy')}", f"d3rlpy=={VERSION}"]
            subprocess.run([str(python), "-m", "pip", "install", "-q", *index, *wanted], check=True)
            (folder / ".installed").touch()
        self._process = subprocess.Popen(
            [str(python), str(Path(__file__).with_name("d3rlpy_worker.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )

    def ask(self, do: str, **request: Any) -> dict[str, Any]:
        """Send a request and return the answer."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(json.dumps({"do": do, **request}) + "\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise SystemExit(f"d3rlpy's process ended during '{do}'; what it said is above.")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def linears(network: QNetwork) -> list[torch.nn.Linear]:
    """Return the linear layers from the input to the output."""
    return [module for module in network.modules() if isinstance(module, torch.nn.Linear)]


def compare_losses(worker: Worker, dataset: Dataset, work: Path, batches: int) -> list[dict[str, Any]]:
    """Return for each kind the largest differences of loss and gradient, relative to their size, over some batches."""
    results: list[dict[str, Any]] = []
    for kind in KINDS:
        config, differences = settings(kind), {"td": 0.0, "conservative": 0.0, "total": 0.0, "gradient": 0.0}
        sampler = OfflineSampler(dataset.transitions, config.loss.discount)
        for number in range(batches):
            lanes = get_scenario(dataset.scenario).lanes
            network, target = (
                build_network(NETWORK, lanes, stream_seed(number, name)) for name in ("online", "target")
            )
            batch = sampler.sample(config.optimizer.batch_size, np.random.default_rng(number))
            given, taken = work / "given.npz", work / "taken.npz"
            arrays = batch_arrays(batch)
            for prefix, module in (("online", network), ("target", target)):
                for index, layer in enumerate(linears(module)):
                    arrays[f"{prefix}.weight{index}"] = layer.weight.detach().numpy()
                    arrays[f"{prefix}.bias{index}"] = layer.bias.detach().numpy()
            np.savez(given, **arrays)
            theirs = worker.ask("losses", file=str(given), out=str(taken), settings=their_settings(kind))
            ours = q_loss(network, target, batch, config.loss, torch.Generator())
            ours.total.backward()
            pairs = {"total": (ours.total.item(), theirs["loss"]), "td": (ours.td.item(), theirs.get("td_loss"))}
            pairs["conservative"] = (ours.conservative.item(), theirs.get("conservative_loss"))
            for name, (our, their) in pairs.items():
                if their is not None:
                    differences[name] = max(differences[name], abs(our - their) / max(abs(their), 1e-6))
            gradients = np.load(taken)
            for index, layer in enumerate(linears(network)):
                for name in ("weight", "bias"):
                    their_gradient, our_gradient = gradients[f"{name}{index}"], getattr(layer, name).grad.numpy()
                    gap = np.abs(our_gradient - their_gradient).max() / np.abs(their_gradient).max()
                    differences["gradient"] = max(differences["gradient"], float(gap))
        if kind != "cql":
            # There the temporal difference is all of it.
            differences["td"], differences["conservative"] = differences["total"], None
        results.append({"kind": kind, "batches": batches, "batch_size": config.optimizer.batch_size, **differences})
    return results


def batch_arrays(batch: TransitionBatch) -> dict[str, np.ndarray]:
    """Return a batch of single steps as d3rlpy names and shapes it; next observations after a crash are zero there."""
    terminal_B = batch.bootstrap_B == 0
    next_BVF = torch.where(terminal_B[:, None, None], 0.0, batch.next_obs_BVF)
    return {
        "observations": batch.obs_BVF.flatten(1).numpy(),
        "actions": batch.action_B.numpy(),
        "rewards": batch.reward_B.numpy(),
        "next_observations": next_BVF.flatten(1).numpy(),
        "terminals": terminal_B.float().numpy(),
    }


def compare_speed(worker: Worker, dataset: Dataset, work: Path, rounds: int, steps: int) -> list[dict[str, Any]]:
    """Return updates per second of both, in turns: RAPID's `distill`, with its record and checkpoint, and `fit`."""
    data = work / "data.h5"
    export_d3rlpy(dataset, data)
    results: list[dict[str, Any]] = []
    lanes = get_scenario(dataset.scenario).lanes
    for kind in KINDS:
        worker.ask("start", data=str(data), settings=their_settings(kind), seed=0)
        worker.ask("fit", steps=100)
        ours: list[float] = []
        theirs: list[float] = []
        with task(f"speed, {kind}", rounds, "rounds") as progress:
            for number in range(rounds):
                network = build_network(NETWORK, lanes, number)
                start = time.perf_counter()
                distill(dataset.transitions, network, settings(kind, steps), work / f"{kind}-{number}", seed=number)
                ours.append(steps / (time.perf_counter() - start))
                theirs.append(steps / worker.ask("fit", steps=steps)["seconds"])
                progress.advance()
        ratios = np.array(ours) / np.array(theirs)
        results.append(
            {
                "kind": kind,
                "batch_size": settings(kind).optimizer.batch_size,
                "rapid": ours,
                "d3rlpy": theirs,
                "ratio": float(np.median(ratios)),
                "ratio_low": float(ratios.min()),
                "ratio_high": float(ratios.max()),
            }
        )
    return results


def compare_together(worker: Worker, dataset: Dataset, work: Path, seeds: int, iterations: int) -> list[dict[str, Any]]:
    """Return the seconds of several seeds: RAPID's as stacks, one a core, begun together, d3rlpy's one after another.

    Ours count the start of the processes and reading the data; theirs only `fit`.
    """
    data = work / "data.h5"
    export_d3rlpy(dataset, data)
    save_dataset(dataset, work / "data")
    # One process imports torch and RAPID, and the others are forked from it.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["rapid.training.offline", "rapid.data.exchange"])
    parts = [part.tolist() for part in np.array_split(np.arange(seeds), min(os.cpu_count() or 1, seeds))]
    results: list[dict[str, Any]] = []
    with task("together", len(KINDS), "algorithms") as progress:
        for kind in KINDS:
            start = time.perf_counter()
            with ProcessPoolExecutor(len(parts), context) as pool:
                ended = [
                    pool.submit(train_stack, work / "data", kind, iterations, work / f"{kind}-stack-{part[0]}", part)
                    for part in parts
                ]
                for each in ended:
                    each.result()
            ours, theirs = time.perf_counter() - start, 0.0
            for seed in range(seeds):
                worker.ask("start", data=str(data), settings=their_settings(kind), seed=seed)
                theirs += worker.ask("fit", steps=iterations)["seconds"]
            size = settings(kind).optimizer.batch_size
            results.append({"kind": kind, "batch_size": size, "rapid": ours, "d3rlpy": theirs, "ratio": theirs / ours})
            progress.advance()
    return results


def train_stack(folder: Path, kind: str, iterations: int, directory: Path, seeds: list[int]) -> None:
    """Train some seeds as one stack, in a process of its own."""
    torch.set_num_threads(1)
    dataset = load_dataset(folder)
    stack = stack_networks([build_network(NETWORK, get_scenario(dataset.scenario).lanes, seed) for seed in seeds])
    distill(dataset.transitions, stack, settings(kind, iterations), directory, seeds)


def compare_scores(
    worker: Worker, dataset: Dataset, work: Path, seeds: int, iterations: int, spawns: int, keep: Path
) -> list[EpisodeRow]:
    """Train both with every seed on the same data, drive the same test spawns and return the rows.

    Every training's rows are kept under `keep` at once, so that an interrupted comparison goes on; other data or
    sizes are another comparison.
    """
    request = f"{iterations} {spawns} {dataset.scenario} {data_fingerprint(dataset.transitions)}"
    data, parts = work / "data.h5", keep / hashlib.sha256(request.encode()).hexdigest()[:12]
    export_d3rlpy(dataset, data)
    lanes, rows, commit = get_scenario(dataset.scenario).lanes, list[EpisodeRow](), source_commit()
    with task("scores", 2 * seeds * len(KINDS), "trainings") as progress:
        for kind in KINDS:
            for seed in range(seeds):
                for side in ("rapid", "d3rlpy"):
                    part = parts / f"{kind}-{side}-seed{seed}.parquet"
                    if not part.exists():
                        network = build_network(NETWORK, lanes, stream_seed(seed, "network"))
                        if side == "rapid":
                            distill(dataset.transitions, network, settings(kind, iterations), parts / part.stem, seed)
                        else:
                            worker.ask("start", data=str(data), settings=their_settings(kind), seed=seed)
                            worker.ask("fit", steps=iterations)
                            weights = work / "weights.npz"
                            worker.ask("weights", out=str(weights))
                            adopt(network, weights)
                        agent = QAgent(network, f"{kind}, {side}")
                        episodes = run_episodes(agent, dataset.scenario, spawn_seeds("test", spawns))
                        save_rows(part, episodes.rows(seed, commit))
                    rows += load_rows(part)
                    progress.advance()
    return rows


@torch.no_grad()
def adopt(network: QNetwork, path: Path) -> None:
    """Give a network the weights of d3rlpy's."""
    file = np.load(path)
    for index, layer in enumerate(linears(network)):
        layer.weight.copy_(torch.from_numpy(file[f"online.weight{index}"]))
        layer.bias.copy_(torch.from_numpy(file[f"online.bias{index}"]))


def scores_table(rows: list[EpisodeRow]) -> list[str]:
    """Return the lines of the table of scores."""
    lines = ["| | RAPID | d3rlpy | intervals |", "|---|---|---|---|"]
    for kind in KINDS:
        for label, name in (("return", "episode_return"), ("crash share", "crashed")):
            both = [of_agent(rows, f"{kind}, {side}", name) for side in ("rapid", "d3rlpy")]
            overlap = both[0].low <= both[1].high and both[1].low <= both[0].high
            cells = " | ".join(f"{one.value:.2f} [{one.low:.2f}, {one.high:.2f}]" for one in both)
            lines.append(f"| {kind}, {label} | {cells} | {'overlap' if overlap else 'apart'} |")
    first = of_agent(rows, f"{KINDS[0]}, rapid", "episode_return")
    return [*lines, "", f"Means with 95 % intervals over {first.unit}."]


def of_agent(rows: list[EpisodeRow], agent: str, name: str) -> Estimate:
    """Return the mean of one column of an agent's rows."""
    own = [row for row in rows if row.agent == agent]
    return estimate(column(own, name), [row.seed for row in own], [row.training_seed for row in own])


def machine(worker: Worker) -> dict[str, Any]:
    """Return versions and processor."""
    ours = {name: version(name) for name in ("torch", "numpy")}
    model = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "rapid": {"commit": source_commit(), "python": platform.python_version(), **ours},
        "d3rlpy": worker.ask("versions"),
        "processor": model[0].partition(": ")[2] if model else platform.processor(),
        "threads": 1,
    }


def data_of(arguments: argparse.Namespace, work: Path) -> Dataset:
    """Return the dataset named, or 3000 transitions of the random driver."""
    if arguments.dataset:
        return load_dataset(arguments.dataset)
    config = preset("paper", "tiny")
    return collect_transitions(
        replace(config, collect=replace(config.collect, random_transitions=3_000)), work / "random", "random"
    )


def main() -> None:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name in ("losses", "speed", "together", "scores"):
        parser.add_argument(f"--{name}", action="store_true")
    parser.add_argument("--dataset", default="", help="directory of a dataset; by default random driving is collected")
    parser.add_argument("--venv", type=Path, default=cache_dir() / f"d3rlpy-{VERSION}")
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--work", type=Path, default=Path("runs/d3rlpy-scores"), help="where trainings are kept")
    parser.add_argument("--batches", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=1_000, help="updates in a round")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=10_000)
    parser.add_argument("--spawns", type=int, default=200)
    arguments = parser.parse_args()
    if not (arguments.losses or arguments.speed or arguments.together or arguments.scores):
        parser.error("say what to compare: --losses, --speed, --together or --scores")
    torch.set_num_threads(1)
    worker = Worker(arguments.venv)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        dataset = data_of(arguments, work)
        about = machine(worker) | {"transitions": len(dataset), "scenario": dataset.scenario}
        told = f"{about['processor']}, one thread a process; RAPID {about['rapid']}, d3rlpy {about['d3rlpy']}."
        told += f" Data: {len(dataset)} transitions, {dataset.scenario}."
        if arguments.losses:
            results = compare_losses(worker, dataset, work, arguments.batches)
            lines = [
                "# The same losses as d3rlpy",
                "",
                "Largest difference between the two, relative to the value, over batches with new weights each; the",
                "gradient's relative to the largest entry of its tensor. float32 rounds at 1.2e-7.",
                "",
                "| | batches | TD | conservative | total | gradient |",
                "|---|---|---|---|---|---|",
            ]
            for row in results:
                cells = [row[name] for name in ("td", "conservative", "total", "gradient")]
                shown = " | ".join("–" if cell is None else f"{cell:.1e}" for cell in cells)
                lines.append(f"| {row['kind']} | {row['batches']} × {row['batch_size']} | {shown} |")
            finish(arguments.out, "d3rlpy-losses", [*lines, "", told], {**about, "results": results})
        if arguments.speed:
            results = compare_speed(worker, dataset, work, arguments.rounds, arguments.steps)
            lines = [
                "# Offline training against d3rlpy",
                "",
                f"Updates per second: medians of {arguments.rounds} rounds of {arguments.steps}, taken in turns.",
                "",
                "| | batch | RAPID | d3rlpy | ratio, median [least, most] |",
                "|---|---|---|---|---|",
            ]
            for row in results:
                span = f"{row['ratio']:.2f} [{row['ratio_low']:.2f}, {row['ratio_high']:.2f}]"
                speeds = f"{np.median(row['rapid']):.0f} | {np.median(row['d3rlpy']):.0f}"
                lines.append(f"| {row['kind']} | {row['batch_size']} | {speeds} | {span} |")
            finish(arguments.out, "d3rlpy-speed", [*lines, "", told], {**about, "results": results})
        if arguments.together:
            results = compare_together(worker, dataset, work, arguments.seeds, arguments.iterations)
            lines = [
                "# Several seeds against d3rlpy",
                "",
                f"Seconds for {arguments.seeds} seeds of {arguments.iterations} updates on {os.cpu_count()} cores: "
                "RAPID's in stacks, a process for each core, begun together, the start of the processes counted; "
                "d3rlpy's one after another, `fit` alone.",
                "",
                "| | batch | RAPID | d3rlpy | ratio |",
                "|---|---|---|---|---|",
                *(
                    f"| {row['kind']} | {row['batch_size']} | {row['rapid']:.0f} | {row['d3rlpy']:.0f} | "
                    f"{row['ratio']:.1f} |"
                    for row in results
                ),
            ]
            finish(arguments.out, "d3rlpy-together", [*lines, "", told], {**about, "results": results})
        if arguments.scores:
            sizes = (arguments.seeds, arguments.iterations, arguments.spawns)
            rows = compare_scores(worker, dataset, work, *sizes, arguments.work)
            save_rows(arguments.out / "d3rlpy-scores.parquet", rows)
            lines = [
                "# What the baselines earn, trained by RAPID and by d3rlpy",
                "",
                f"{arguments.seeds} trainings each of {arguments.iterations} updates, {arguments.spawns} test spawns.",
                "",
                *scores_table(rows),
            ]
            finish(arguments.out, "d3rlpy-scores", [*lines, "", told], about)
    worker.close()


def finish(out: Path, name: str, lines: list[str], content: dict[str, Any]) -> None:
    """Write a table and its numbers, and show the table."""
    write_text(out / f"{name}.md", "\n".join(lines) + "\n")
    write_json(out / f"{name}.json", content)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
