"""Phase 2 on disk: train policies offline on a dataset, RAPID and its baselines."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from rapid.agents.q_agent import QAgent
from rapid.agents.saved import save_agent
from rapid.config import Config, without_place
from rapid.config_io import parts_of, to_dict
from rapid.data.dataset import Dataset, load_dataset
from rapid.errors import RapidError
from rapid.networks.q_network import QNetwork, build_network
from rapid.networks.stack import stack_networks, unstack_networks
from rapid.phases.data import learnable
from rapid.phases.measure import learning_curve
from rapid.progress import task
from rapid.scenarios import get_scenario
from rapid.seeding import stream_seed
from rapid.tracking import Tracker
from rapid.training.machinery.record import CHECKPOINT_FILE
from rapid.training.offline import distill, is_stackable


def distill_agent(
    config: Config, data: Path, out: Path, name: str = "distilled", tell: Callable[[Dataset], None] | None = None
) -> QAgent:
    """Train a policy offline on the dataset in `data`, which `tell` is shown before; see ``out/agent``."""
    dataset = load_dataset(data)
    if tell:
        tell(dataset)
    network = _new_network(config, dataset)
    _distill_network(config, dataset, network, out, name, stream_seed(config.seed, "distill"))
    _save_distilled(config, data, dataset, network, out, name)
    return QAgent(network, name)


def distill_seeds(
    config: Config,
    data: Path,
    out: Path,
    seeds: Sequence[int],
    name: str = "distilled",
    tell: Callable[[Dataset], None] | None = None,
) -> list[Path]:
    """Train a policy of each seed on the dataset in `data`, and return their directories, ``out/seed-N``.

    Where the networks can be stacked (:mod:`rapid.networks.stack`) they train together, recorded in ``out/together``;
    others one after another.

    Raises:
        RapidError: a directory holds what was not trained like this, or anything that `distill` refuses.
    """
    homes = [out / f"seed-{seed}" for seed in seeds]
    own = [replace(config, seed=seed) for seed in seeds]
    together, stacked = out / "together", is_stackable(config.network, config.distill)
    for home in homes:
        alone = (home / CHECKPOINT_FILE).exists()
        if (alone and stacked) or (not alone and (home / "agent").exists() and not together.exists()):
            raise RapidError(f"'{home}' holds an agent that was trained otherwise. Choose another --out.")
    if not stacked:
        if together.exists():
            raise RapidError(f"'{together}' holds seeds that were trained together. Choose another --out.")
        for each, home in zip(own, homes, strict=True):
            distill_agent(each, data, home, name, tell if home == homes[0] else None)
        return homes
    dataset = load_dataset(data)
    if tell:
        tell(dataset)
    stack = stack_networks([_new_network(each, dataset) for each in own])
    streams = [stream_seed(seed, "distill") for seed in seeds]
    _distill_network(config, dataset, stack, together, f"{name} {len(homes)} seeds", streams)
    for each, network, home in zip(own, unstack_networks(stack), homes, strict=True):
        _save_distilled(each, data, dataset, network, home, name)
    return homes


def _new_network(config: Config, dataset: Dataset) -> QNetwork:
    lanes = get_scenario(dataset.scenario).lanes
    return build_network(config.network, lanes, stream_seed(config.seed, "network")).to(config.device)


def _distill_network(
    config: Config, dataset: Dataset, network: QNetwork, out: Path, name: str, seed: int | Sequence[int]
) -> None:
    tracker = Tracker(config.tracking, out, f"distill-{name}".replace(" ", "-"), to_dict(without_place(config)))
    with tracker, task(f"distill, {name}", config.distill.iterations, "iterations") as work:
        distill(
            learnable(dataset),
            network,
            config.distill,
            out,
            seed=seed,
            evaluate=learning_curve(config, dataset.scenario, name),
            progress=work,
            teacher_share=dataset.teacher_share,
            track=tracker.log,
        )


def _save_distilled(config: Config, data: Path, dataset: Dataset, network: QNetwork, out: Path, name: str) -> None:
    metadata = {"name": name, "phase": "distill", "data": str(data), "scenario": dataset.scenario, "seed": config.seed}
    used = replace(config, scenario=dataset.scenario, network=network.config)
    save_agent(out / "agent", network, metadata | {"config": parts_of(used, "network", "distill")})
