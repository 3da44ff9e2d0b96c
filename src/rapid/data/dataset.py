"""Datasets on disk: a directory of JSON facts, Parquet transitions and the teacher's log."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from rapid.data.dataset_files import (
    DATASET_FILE,
    LOG_FILE,
    SCHEMA_VERSION,
    TRANSITIONS_FILE,
    MixLevel,
    check_files,
    check_kinds,
)
from rapid.data.shipped import dataset_folder
from rapid.data.tables import current_log, from_table, read_parquet, to_table, write_parquet
from rapid.data.transitions import RANDOM, SOURCES, TEACHER, Transitions, concatenate
from rapid.errors import RapidError
from rapid.files import read_json, sha256, write_json, write_text
from rapid.scenarios import ACTIONS, get_scenario
from rapid.seeding import numpy_stream
from rapid.teacher.experience import MEMORY_FILE, Experience, read_experiences, to_lines

LICENCE = "Apache-2.0"


@dataclass(frozen=True)
class Dataset:
    """Transitions of one scenario, with who drove them and what was said."""

    scenario: str
    """Name of the scenario."""
    transitions: Transitions
    """The transitions."""
    drivers: dict[str, dict[str, Any]]
    """Name of a source -> identity of the driver behind it, as its `describe()` gave it."""
    log: pa.Table | None = None
    """One row a decision (`tables.LOG_SCHEMA`), in the order of the transitions; None in a mixture."""
    mixture: dict[str, Any] | None = None
    """How it was mixed: p, size, level, seed, and the summary of each source; None if it was collected."""
    collection: dict[str, Any] | None = None
    """How it was collected: seeds, shard, whether it is complete."""
    memory: tuple[Experience, ...] | None = None
    """What the teacher remembered while it drove, and then what it learned; None if it has no memory."""

    def __repr__(self) -> str:
        mixed = f", mixed with p = {self.mixture['p']:g}" if self.mixture and "p" in self.mixture else ""
        return f"<Dataset of {len(self):,} transitions of {self.scenario}, driven by {', '.join(self.drivers)}{mixed}>"

    def __len__(self) -> int:
        return len(self.transitions)

    @property
    def known(self) -> int:
        """Experiences in the memory that the teacher had before; what follows it learned here."""
        return max((driver.get("memory", {}).get("experiences", 0) for driver in self.drivers.values()), default=0)

    @property
    def fallback_N(self) -> np.ndarray:
        """Of which transitions a rule chose the action, as the model gave no usable answer; of none without a log."""
        if self.log is None:
            return np.zeros(len(self), np.bool_)
        return np.array(self.log.column("status").to_pylist(), object) == "fallback"

    @property
    def fallbacks(self) -> tuple[int, int]:
        """How many of how many of the teacher's decisions a rule made, as far as the dataset knows."""
        if self.mixture is not None:
            told = self.mixture.get("fallbacks") or {"count": 0, "of": 0}
            return told["count"], told["of"]
        return int(self.fallback_N.sum()), len(self)

    @property
    def teacher_share(self) -> float | None:
        """Share of teacher transitions that every batch must have; None where batches are drawn uniformly."""
        return float(self.mixture["p"]) if self.mixture and self.mixture["level"] == "batch" else None


def save_dataset(dataset: Dataset, directory: str | os.PathLike[str]) -> None:
    """Write a dataset; ``dataset.json`` comes last, so a directory that has it is whole.

    Raises:
        RapidError: the transitions are not valid, or the directory cannot be written.
    """
    root = Path(directory)
    dataset.transitions.validate("the dataset")
    # It vouches for the others, and goes first. Those that this dataset has not would be foreign to it.
    for name in (DATASET_FILE, LOG_FILE, MEMORY_FILE):
        (root / name).unlink(missing_ok=True)
    tables = {TRANSITIONS_FILE: to_table(dataset.transitions)}
    if dataset.log is not None:
        tables[LOG_FILE] = dataset.log
    for name, table in tables.items():
        write_parquet(table, root / name)
    rows = {name: table.num_rows for name, table in tables.items()}
    if dataset.memory is not None:
        write_text(root / MEMORY_FILE, to_lines(dataset.memory))
        rows[MEMORY_FILE] = len(dataset.memory)
    write_json(
        root / DATASET_FILE,
        {
            "format": "rapid-dataset",
            "schema_version": SCHEMA_VERSION,
            "scenario": dataset.scenario,
            "drivers": dataset.drivers,
            "mixture": dataset.mixture,
            "collection": dataset.collection,
            "summary": summary(dataset),
            "licence": LICENCE,
            "files": {
                name: {"rows": count, "bytes": (root / name).stat().st_size, "sha256": sha256(root / name)}
                for name, count in rows.items()
            },
        },
        sealed=True,
    )


def load_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Read a dataset, in a directory or shipped (``shipped:lane-3-density-2/teacher``), and check it whole.

    Raises:
        RapidError: no dataset there, of another schema version, cut off, damaged, or with values that make no sense.
    """
    root = dataset_folder(path)
    meta = read_json(root / DATASET_FILE, "dataset")
    if not isinstance(meta, dict) or meta.get("format") != "rapid-dataset":
        raise RapidError(f"'{root / DATASET_FILE}' does not describe a RAPID dataset. Give the directory of a dataset.")
    if meta.get("schema_version") != SCHEMA_VERSION:
        raise RapidError(
            f"The dataset '{root}' has schema version {meta.get('schema_version')}; this version of RAPID reads "
            f"{SCHEMA_VERSION}. Use the version of RAPID that made it, or collect it again."
        )
    try:
        get_scenario(meta["scenario"])
        check_files(root, meta["files"])
        table = read_parquet(root / TRANSITIONS_FILE, "transitions")
        log = current_log(read_parquet(root / LOG_FILE, "teacher log")) if LOG_FILE in meta["files"] else None
        memory = read_experiences(root / MEMORY_FILE) if MEMORY_FILE in meta["files"] else None
        check_kinds(meta)
        dataset = Dataset(
            meta["scenario"], from_table(table), meta["drivers"], log, meta["mixture"], meta["collection"], memory
        )
        if memory is not None and not (type(dataset.known) is int and 0 <= dataset.known <= len(memory)):
            raise ValueError("'drivers' tells of more experiences than there are")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RapidError(
            f"'{root / DATASET_FILE}' lacks what it should say: {error}. It was edited or damaged; make the dataset "
            "again."
        ) from error
    dataset.transitions.validate(f"the dataset '{root}'")
    if log is not None and log.num_rows != len(dataset):
        raise RapidError(
            f"The dataset '{root}' has {len(dataset)} transitions, but a log of {log.num_rows} decisions. They are not "
            "of one collection; copy or make it again."
        )
    return dataset


def episode_returns(transitions: Transitions) -> tuple[np.ndarray, np.ndarray]:
    """Return the return and whether it crashed, of every whole episode (from step 0 to its end), in order."""
    starts = np.flatnonzero(np.diff(transitions.episode_N, prepend=-1))
    ends = np.append(starts[1:], len(transitions)) if len(starts) else starts
    follows_N = transitions.follows_N()
    whole = [
        (start, end)
        for start, end in zip(starts, ends, strict=True)
        if transitions.step_N[start] == 0 and transitions.done_N[end - 1] and follows_N[start : end - 1].all()
    ]
    returns = np.array([transitions.reward_N[start:end].sum(dtype=np.float64) for start, end in whole])
    return returns, np.array([transitions.terminated_N[end - 1] for _, end in whole], np.bool_)


def summary(dataset: Dataset) -> dict[str, Any]:
    """Return counts, returns, crash share, speed and actions, for each source: what ``dataset.json`` shows."""
    result: dict[str, Any] = {"transitions": len(dataset)}
    for source, name in enumerate(SOURCES):
        rows = dataset.transitions.select(dataset.transitions.source_N == source)
        if not len(rows):
            continue
        share = np.bincount(rows.action_N, minlength=len(ACTIONS)) / len(rows)
        speed = np.hypot(rows.obs_NVF[:, 0, 3], rows.obs_NVF[:, 0, 4])
        facts: dict[str, Any] = {
            "transitions": len(rows),
            "mean_reward": _round(rows.reward_N.mean(dtype=np.float64)),
            "mean_speed": _round(speed.mean(dtype=np.float64)),
            "actions": dict(zip(ACTIONS, map(_round, share), strict=True)),
        }
        # Of a mixture, mostly the short episodes are whole: their returns would mislead.
        returns, crashed = episode_returns(rows) if dataset.mixture is None else (np.zeros(0), np.zeros(0))
        if len(returns):
            facts["episodes"] = len(returns)
            quantiles = np.quantile(returns, (0, 0.25, 0.5, 0.75, 1))
            facts["return_mean"], facts["return_std"] = _round(returns.mean()), _round(returns.std())
            facts["return_quantiles"] = [_round(value) for value in quantiles]
            facts["crash_share"] = _round(crashed.mean())
        result[name] = facts
    if dataset.log is not None and dataset.log.num_rows:
        log = dataset.log
        status = Counter(map(str, log.column("status").to_pylist()))
        decisions: dict[str, Any] = {
            "status": dict(sorted(status.items())),
            "prompts": len(log.column("prompt_hash").unique()),
            "served": sorted(filter(None, log.column("served").unique().to_pylist())),
        }
        for name in ("retries", "tokens_in", "tokens_out", "seconds", "cost"):
            decisions[name] = _round(np.nansum(log.column(name).to_numpy().astype(np.float64)))
        result["decisions"] = decisions
    if dataset.memory is not None:
        learned = dataset.memory[dataset.known :]
        result["memory"] = {
            "known": dataset.known,
            "learned": len(learned),
            "lessons": sum(bool(experience.lesson) for experience in learned),
            "tokens_in": sum(experience.tokens_in for experience in learned),
            "tokens_out": sum(experience.tokens_out for experience in learned),
            "cost": _round(sum(experience.cost for experience in learned)),
        }
    return result


def _round(value: float) -> float:
    """Return a number as people read it."""
    return round(float(value), 4)


def mix(
    teacher: Dataset | None,
    random: Dataset | None,
    p: float,
    size: int,
    seed: int,
    level: MixLevel = "transition",
    drop_fallbacks: bool = False,
) -> Dataset:
    """Return the offline dataset D*: a share `p` of teacher transitions, the rest random ones (paper: section 4.2).

    Level `transition` draws p·size and (1-p)·size transitions without replacement. Level `batch` keeps up to `size`
    transitions of each source and lets the sampler draw the share `p` anew in every batch. The result depends on
    the inputs and `seed` alone; `source_N` says where each transition came from. `drop_fallbacks` draws none of those
    of which a rule chose the action in the model's place.

    Raises:
        RapidError: different scenarios, too few transitions, p outside [0, 1], a source that is no such source.
    """
    if not 0 <= p <= 1 or size < 1:
        raise RapidError(
            f"Cannot mix {size} transitions at p={p}: p must lie in [0, 1] and the size must be at least 1."
        )
    wanted = {TEACHER: int(np.floor(p * size + 0.5)), RANDOM: size - int(np.floor(p * size + 0.5))}
    given = {source: dataset for source, dataset in ((TEACHER, teacher), (RANDOM, random)) if dataset is not None}
    places = {source: np.arange(len(dataset)) for source, dataset in given.items()}
    if drop_fallbacks:
        places = {source: np.flatnonzero(~dataset.fallback_N) for source, dataset in given.items()}
    if level == "batch":
        # The share is drawn in every batch, so each source brings what it has.
        wanted = {source: min(size, len(places.get(source, ()))) if wanted[source] else 0 for source in wanted}
    names = sorted({dataset.scenario for dataset in given.values()})
    if len(names) > 1:
        raise RapidError(
            f"Cannot mix datasets of different scenarios: {', '.join(names)}. Collect both on one scenario."
        )
    rng = numpy_stream(seed, "mix")
    parts: list[Transitions] = []
    drivers: dict[str, dict[str, Any]] = {}
    sources: dict[str, Any] = {}
    fallbacks: dict[str, Any] = {}
    for source, count in wanted.items():
        if not count and not (level == "batch" and (p if source == TEACHER else 1 - p) > 0):
            continue
        have = len(places.get(source, ()))
        if not have or count > have:
            raise RapidError(
                f"The mixture needs {count} {SOURCES[source]} transitions (p={p:g}, size={size}), but there are "
                f"{have}. Collect more, or ask for a smaller size."
            )
        rows = given[source].transitions
        if (rows.source_N != source).any():
            raise RapidError(
                f"The {SOURCES[source]} dataset has transitions of another source. "
                "Give a collected dataset, not a mixture."
            )
        # Sorted, so that neighbours that both were drawn stay neighbours: n-step returns can use them.
        drawn = places[source][np.sort(rng.choice(have, count, replace=False))]
        parts.append(rows.select(drawn))
        if source == TEACHER:
            rule = given[source].fallback_N
            left_out = len(rows) - len(places[source])
            fallbacks = {"count": int(rule[drawn].sum()), "of": count, "left_out": left_out} if rule.any() else {}
        sources[SOURCES[source]] = summary(given[source])[SOURCES[source]]
        drivers |= {name: facts for name, facts in given[source].drivers.items() if name == SOURCES[source]}
    mixture = {"p": p, "size": size, "level": level, "seed": seed, "sources": sources}
    if fallbacks:
        mixture["fallbacks"] = fallbacks
    return Dataset(names[0], concatenate(parts), drivers, mixture=mixture)


def join(datasets: Sequence[Dataset]) -> Dataset:
    """Return the shards of one collection as one dataset, in the order given.

    Raises:
        RapidError: nothing to join, different scenarios or drivers, or an episode that occurs twice.
    """
    if not datasets:
        raise RapidError("There is nothing to join. Give at least one dataset.")
    first = datasets[0]
    for other in datasets[1:]:
        if (other.scenario, other.drivers) != (first.scenario, first.drivers):
            raise RapidError(
                "Cannot join datasets of different scenarios or drivers. Join the shards of one collection."
            )
    seeds = [set(dataset.transitions.spawn_seed_N.tolist()) for dataset in datasets]
    if len(set[int]().union(*seeds)) < sum(map(len, seeds)):
        raise RapidError("The datasets share episodes: the same spawn seed occurs in two. Join each shard once.")
    transitions = concatenate([dataset.transitions for dataset in datasets])
    logs = [dataset.log for dataset in datasets if dataset.log is not None]
    log = pa.concat_tables(logs) if len(logs) == len(datasets) else None
    if log is not None:
        log = log.set_column(
            log.schema.get_field_index("episode"), log.schema.field("episode"), pa.array(transitions.episode_N)
        )
    collection = {"shards": [dataset.collection for dataset in datasets]}
    memory = first.memory
    if memory is not None:
        # Every shard began with the same memory, which the drivers' identities vouch for.
        learned = [experience for dataset in datasets for experience in (dataset.memory or ())[dataset.known :]]
        memory = (*memory[: first.known], *learned)
    return Dataset(first.scenario, transitions, first.drivers, log, collection=collection, memory=memory)
