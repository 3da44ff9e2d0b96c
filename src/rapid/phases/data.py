"""Phase 1 on disk: collect, find what is given or shipped, mix."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from rapid.config import Config, TeacherConfig
from rapid.config_io import differences
from rapid.data.collection import Budget, collect, identity
from rapid.data.dataset import Dataset, load_dataset, mix, save_dataset
from rapid.data.sharding import collect_shards, settings_of, shards_of
from rapid.data.shipped import SHIPPED, shipped_sets
from rapid.data.transitions import Transitions
from rapid.errors import RapidError
from rapid.outputs import beside
from rapid.progress import task, warn
from rapid.scenarios import get_scenario
from rapid.seeding import stream_seed
from rapid.simulator import make_vec
from rapid.spawns import TrainPart
from rapid.teacher import Teacher, make_teacher


def place_to_collect(config: Config, source: TrainPart) -> Path:
    """Return where a collection goes that was given no place: data/SOURCE, or beside it if that is another's."""
    usual = Path("data") / source
    if not usual.exists() and not any(usual.parent.glob(f"{source}-*")):
        return usual
    driver = identity(
        make_teacher(_driver(config, source), get_scenario(config.scenario).lanes, config.seed, config.scenario)
    )
    wanted = {"scenario": get_scenario(config.scenario).name, "source": source, "driver": driver}
    other, there = beside(str(usual), wanted), settings_of(usual)
    if not other.exists() and (there is None or {key: there.get(key) for key in wanted} == wanted):
        return usual
    if there is not None:
        held = {key: there.get(key) for key in wanted}
        warn(f"'{usual}' is of another request ({differences(held, wanted)}); this one is in '{other}'.")
    return other


def _driver(config: Config, source: TrainPart) -> TeacherConfig:
    return config.teacher if source == "teacher" else TeacherConfig(backend="scripted", model="random")


def collect_transitions(config: Config, out: Path, source: TrainPart = "teacher") -> Dataset:
    """Let the configured teacher drive, or for `source` random the uniform driver, and keep every step in `out`."""
    settings = _driver(config, source)
    sizes = config.collect
    wanted = sizes.teacher_transitions if source == "teacher" else sizes.random_transitions
    budget = Budget(
        *(sizes.max_tokens, sizes.max_cost, sizes.max_seconds, sizes.max_decisions), settings.max_fallback_share
    )
    options: dict[str, Any] = {
        "source": source,
        "budget": budget if source == "teacher" else None,
        "make_worlds": partial(make_vec, config.scenario, simulator=config.simulator, autoreset=False),
    }
    lockstep = sizes.lockstep if source == "teacher" else max(sizes.lockstep, 100)
    have = shards_of(out)
    shards = sizes.shards or have or sizes.workers
    if shards == 1 and sizes.workers > 1:
        raise RapidError(
            f"The collection in '{out}' was begun in one part, which one worker drives. Go on with --workers 1 and "
            "--engine local, or choose another directory."
        )
    if shards == 1:
        teacher = make_teacher(settings, get_scenario(config.scenario).lanes, config.seed, config.scenario)
        with task(f"collect, {teacher.name}", wanted, "transitions") as work:
            return collect(teacher, config.scenario, out, wanted, lockstep, shard=sizes.shard, progress=work, **options)
    # Each worker has a teacher of its own; together they ask no more than one would.
    at_once = min(sizes.workers, shards)
    settings = replace(
        settings,
        concurrency=max(1, settings.concurrency // at_once),
        requests_per_minute=settings.requests_per_minute / at_once,
    )
    title = f"collect, {settings.model}, {shards} shards"
    with task(title, wanted, "transitions") as work:
        return collect_shards(
            partial(_worker_teacher, settings, config.scenario, config.seed, config.threads),
            config.scenario,
            out,
            wanted,
            lockstep,
            shards=shards,
            workers=sizes.workers,
            engine=sizes.engine,
            progress=work,
            **options,
        )


def _worker_teacher(settings: TeacherConfig, scenario: str, seed: int, threads: int) -> Teacher:
    torch.set_num_threads(threads)
    return make_teacher(settings, get_scenario(scenario).lanes, seed, scenario)


def data_folders(config: Config, directory: Path) -> tuple[Path, Path]:
    """Where the teacher's and the random dataset of the run in `directory` are: given, shipped, or its own."""
    folder = Path(config.data) if config.data else directory / "collect"
    if config.data == SHIPPED:
        folder = Path(f"{SHIPPED}:{get_scenario(config.scenario).name}")
    return folder / "teacher", folder / "random"


def given_data(config: Config) -> tuple[Dataset, Dataset]:
    """Load the teacher's and the random dataset that the settings name, and see that the mixture can be made of them.

    Raises:
        RapidError: none are shipped for the scenario, they are not there, damaged, of another scenario, or too small.
    """
    scenario = get_scenario(config.scenario).name
    shipped = sorted({name.partition("/")[0] for name in shipped_sets()})
    if config.data == SHIPPED and scenario not in shipped:
        raise RapidError(
            f"No data is shipped for the scenario '{scenario}'. Choose --scenario {', '.join(shipped)}, or leave "
            "--data out, to collect."
        )
    teacher, random = map(load_dataset, data_folders(config, Path()))
    for name, dataset in (("teacher", teacher), ("random", random)):
        if dataset.scenario != scenario:
            raise RapidError(
                f"The {name} dataset in '{config.data}' is of the scenario '{dataset.scenario}', not '{scenario}'. "
                f"Choose --scenario {dataset.scenario}, or other data."
            )
    mix_as_set(config, teacher, random, config.seed)
    return teacher, random


def mix_as_set(config: Config, teacher: Dataset, random: Dataset, seed: int) -> Dataset:
    """Mix two datasets as the settings say."""
    how = config.mix
    return mix(teacher, random, how.p, how.size, seed, how.level, how.drop_fallbacks)


def mix_datasets(config: Config, teacher_data: Path, random_data: Path, out: Path) -> Dataset:
    """Mix two datasets at ratio p into `out`."""
    teacher, random = load_dataset(teacher_data), load_dataset(random_data)
    mixed = mix_as_set(config, teacher, random, stream_seed(config.seed, "mix"))
    save_dataset(mixed, out)
    return mixed


def learnable(dataset: Dataset) -> Transitions:
    """Return the transitions as a trainer takes them."""
    return dataset.transitions.timed() if get_scenario(dataset.scenario).clock else dataset.transitions
