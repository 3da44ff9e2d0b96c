"""What a gradient step of RAPID costs, beside a network built from torch's own layers, all in turns in one process.

The naive network is what one writes first: two layers of `torch.nn.TransformerEncoderLayer` for each policy and two for
the decoder, width 64, four heads, feed-forward 256; `same size` is the same with RAPID's sizes. Each variant takes
some steps, then the next one does, round after round, so that a busy moment meets them all; CPU time is counted, on one
thread. Writes `update-speed.md` and `update-speed.json`.

    python benchmarks/update_speed.py --rounds 11
"""

import argparse
import platform
import sys
import time
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rapid.config import Config, LossConfig, NetworkConfig
from rapid.data.batch import TransitionBatch
from rapid.data.dataset import Dataset, load_dataset
from rapid.data.replay import OfflineSampler
from rapid.files import write_json, write_text
from rapid.networks.mixture import MixtureOfPolicies
from rapid.networks.q_network import QNetwork, TokenHead, build_network, set_phase
from rapid.presets import preset
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.training.learner import Learner
from simulator import processor, shown

GATE = 0.3
"""The zero gate while adapting: once it is open, the adapter is computed."""
BATCHES = 8
"""Batches that a variant goes through in a round, the same ones every time."""
TEACHER_SHARE = 0.25
"""Share of each batch that the robust term attacks in `robust_on` teacher: the paper's mixture."""


@dataclass(frozen=True)
class Variant:
    """One kind of update."""

    title: str
    network: str
    """`rapid`; torch's own layers, `naive` in the usual sizes or `same size` in RAPID's."""
    batch_size: int
    phase: str = "distill"
    steps: int = 0
    """PGD steps; 0 is no robust term."""
    attacked: str = "teacher"


class NaiveEncoder(nn.Module):
    """A transformer from torch's own layers over tokens (B, T, D); the interface of `rapid.networks.blocks`."""

    def __init__(self, config: NetworkConfig, layers: int) -> None:
        super().__init__()
        layer = nn.TransformerEncoderLayer(config.width, config.heads, config.feedforward, 0.0, batch_first=True)
        self.encoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)

    def forward(self, tokens_BTD: Tensor, mask_B11T: Tensor | None, first_only: bool = False) -> Tensor:
        """Return the encoded tokens (B, T, D) or, with `first_only`, the first one (B, D)."""
        mask_BT = None if mask_B11T is None else mask_B11T[:, 0, 0]
        encoded_BTD = self.encoder(tokens_BTD, src_key_padding_mask=mask_BT)
        return encoded_BTD[:, 0] if first_only else encoded_BTD


def network_of(kind: str, config: Config, lanes: int) -> QNetwork:
    """Return RAPID's network, or one with every transformer replaced by torch's own layers."""
    if kind == "rapid":
        return build_network(config.network, lanes, 0)
    sizes = config.network
    if kind == "naive":
        sizes = replace(sizes, width=64, heads=4, layers=2, decoder_layers=2, feedforward=256)
    network = build_network(sizes, lanes, 0)
    head = network.head
    assert isinstance(head, TokenHead)
    for policy in head.mixture.policies:
        policy.transformer = NaiveEncoder(sizes, sizes.layers)
    head.decoder.transformer = NaiveEncoder(sizes, sizes.decoder_layers)  # pyright: ignore[reportAttributeAccessIssue]
    return network


def learner_of(variant: Variant, config: Config, lanes: int) -> Learner:
    """Return a learner at the beginning of the phase; while adapting with the gate open."""
    network = network_of(variant.network, config, lanes)
    if variant.phase == "adapt":
        set_phase(network, "adapt")
        mixture = network.head.mixture
        assert isinstance(mixture, MixtureOfPolicies)
        nn.init.constant_(mixture.gate_NV, GATE)
        loss, optimizer = config.adapt.loss, config.adapt.optimizer
    else:
        set_phase(network, "distill")
        loss, optimizer = robust(config.distill.loss, variant), config.distill.optimizer
    return Learner(network, optimizer, loss, 10**6, torch.Generator().manual_seed(0))


def robust(loss: LossConfig, variant: Variant) -> LossConfig:
    """Return the loss with the variant's inner attack."""
    if not variant.steps:
        return replace(loss, robust_weight=0.0)
    attack = replace(loss.robust, steps=variant.steps)
    return replace(loss, robust_on="all" if variant.attacked == "all" else "teacher", robust=attack)


def batches_of(dataset: Dataset, size: int) -> list[TransitionBatch]:
    """Return the batches, :data:`TEACHER_SHARE` of each marked as the teacher's."""
    sampler = OfflineSampler(dataset.transitions, 0.9, 1, "cpu")
    rng = np.random.default_rng(0)
    teacher_B = torch.arange(size) < round(TEACHER_SHARE * size)
    return [sampler.sample(size, rng)._replace(teacher_B=teacher_B) for _ in range(BATCHES)]


def variants() -> list[Variant]:
    """Return what is measured."""
    found: list[Variant] = []
    for size in (32, 64):
        found += [
            Variant("naive, no PGD", "naive", size),
            Variant("same size, no PGD", "same size", size),
            Variant("distil, no PGD", "rapid", size),
            Variant("distil, PGD-5 on the teacher's quarter", "rapid", size, steps=5),
            Variant("distil, PGD-10 on the teacher's quarter", "rapid", size, steps=10),
            Variant("naive, PGD-10 on all", "naive", size, steps=10, attacked="all"),
            Variant("same size, PGD-10 on all", "same size", size, steps=10, attacked="all"),
            Variant("distil, PGD-10 on all", "rapid", size, steps=10, attacked="all"),
            Variant("adapt, gate open", "rapid", size, "adapt"),
        ]
    return found


def measure(config: Config, dataset: Dataset, rounds: int) -> list[dict[str, Any]]:
    """Return the milliseconds of CPU time of one update, by variant and round."""
    lanes = get_scenario(dataset.scenario).lanes
    batches = {size: batches_of(dataset, size) for size in (32, 64)}
    chosen = [(variant, learner_of(variant, config, lanes)) for variant in variants()]
    spent: list[list[float]] = [[] for _ in chosen]
    with task("update speed", rounds + 1, "rounds") as progress:
        for number in range(rounds + 1):
            for (variant, learner), times in zip(chosen, spent, strict=True):
                start = time.process_time()
                for batch in batches[variant.batch_size]:
                    learner.update(batch)
                if number:  # the first round warms up
                    times.append((time.process_time() - start) / BATCHES * 1e3)
                learner.means()
            progress.advance()
    return [
        {"variant": variant.title, "batch_size": variant.batch_size, "network": variant.network, "ms": times}
        for (variant, _), times in zip(chosen, spent, strict=True)
    ]


def report(results: list[dict[str, Any]], config: Config, rounds: int, command: str) -> str:
    """Return the table as Markdown."""
    network = config.network
    lines = [
        "# What a gradient step costs",
        "",
        f"Milliseconds of CPU time on one thread, median (least to most) of {rounds} rounds of {BATCHES} updates, all "
        f"variants in turns. RAPID: recipe `{config.recipe}`, width {network.width}, {network.heads} head, feed-"
        f"forward {network.feedforward}, {network.layers} layer a policy, {network.decoder_layers} in the decoder. "
        "Naive: torch's own layers, width 64, 4 heads, feed-forward 256, two layers each; same size: torch's own "
        "layers in RAPID's sizes. The ratios are to the update of the same kind in the same round.",
        "",
        "| update | batch | ms | naive / this | same size / this |",
        "|---|---|---|---|---|",
    ]
    for result in results:
        cells = [ratio(results, result, network) for network in ("naive", "same size")]
        lines.append(
            f"| {result['variant']} | {result['batch_size']} | {shown(result['ms'], 1)} | {' | '.join(cells)} |"
        )
    lines += [
        "",
        f"{processor()}, torch {version('torch')}, Python {platform.python_version()}, commit {commit() or 'unknown'}. "
        f"Made with `{command}`.",
    ]
    return "\n".join(lines) + "\n"


def ratio(results: list[dict[str, Any]], result: dict[str, Any], network: str) -> str:
    """Return how many times as long the same update of another network takes."""

    def kind(of: dict[str, Any]) -> tuple[int, str]:
        return of["batch_size"], of["variant"].split(", ", 1)[1]

    others = [of for of in results if of["network"] == network and kind(of) == kind(result)]
    if not others or others[0] is result:
        return "–"
    return f"×{shown([a / b for a, b in zip(others[0]['ms'], result['ms'], strict=True)], 1)}"


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=11, help="rounds that are counted")
    parser.add_argument("--dataset", default="shipped:lane-3-density-2/teacher", help="the transitions")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the table goes")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    config = preset("strong", "full")
    results = measure(config, load_dataset(chosen.dataset), chosen.rounds)
    command = " ".join(["python", "benchmarks/update_speed.py", *sys.argv[1:]])
    text = report(results, config, chosen.rounds, command)
    write_json(chosen.out / "update-speed.json", {"results": results, "commit": commit()})
    write_text(chosen.out / "update-speed.md", text)
    print(text)


if __name__ == "__main__":
    main()
