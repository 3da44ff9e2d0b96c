"""Datasets for other tools, and back: NumPy, Minari and d3rlpy. The teacher's log stays in RAPID's own format.

Minari and d3rlpy hold episodes. A mixture holds pieces of episodes: every run of consecutive steps becomes an episode
there, which is neither terminated nor truncated where it was cut out of a longer one.
"""

import copy
import importlib
import json
import os
import warnings
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from rapid.data.card import card
from rapid.data.dataset import LICENCE, Dataset
from rapid.data.dataset_files import SCHEMA_VERSION, check_kinds
from rapid.data.transitions import Transitions, concatenate
from rapid.errors import RapidError, how_to_install, sentence
from rapid.files import atomic_path
from rapid.scenarios import get_scenario

_KEPT = ("source_N", "episode_N", "step_N", "spawn_seed_N", "probabilities_NA")
"""What the other formats have no name for and carry as extra columns."""


def export_npz(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write all arrays as one compressed ``.npz``: names as in `Transitions`, and `meta`, a JSON text."""
    dataset.transitions.validate("the dataset")
    arrays: dict[str, Any] = {field.name: getattr(dataset.transitions, field.name) for field in fields(Transitions)}
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, meta=np.array(_meta(dataset)), **arrays)


def import_npz(path: str | os.PathLike[str]) -> Dataset:
    """Read what `export_npz` wrote.

    Raises:
        RapidError: the file is missing, damaged or something else.
    """
    with _foreign(f"'{path}' is no dataset in NumPy's format"):
        with zipfile.ZipFile(path) as packed:
            _check_size(sum(member.file_size for member in packed.infolist()), Path(path))
        with np.load(path, allow_pickle=False) as content:
            arrays: dict[str, Any] = {field.name: content[field.name] for field in fields(Transitions)}
            return _dataset(Transitions(**arrays), str(content["meta"]), str(path))


def export_minari(dataset: Dataset, name: str) -> Any:
    """Make a Minari dataset, which ``minari.load_dataset(name)`` finds and whose environment it recovers.

    Args:
        dataset: what to export.
        name: such as ``highway/lane-3-density-2/smollm2-v0``.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        RapidError: Minari is not installed, or has a dataset of this name.
    """
    minari, collector = _need("minari"), _need("minari.data_collector")
    importlib.import_module("rapid.simulator")  # registers the environment
    if name in minari.list_local_datasets():
        raise RapidError(f"Minari has a dataset '{name}' already. Choose another name, such as the next version.")
    spec = copy.deepcopy(gymnasium.spec("rapid/Highway-v0"))
    spec.kwargs = {"scenario": dataset.scenario}
    buffers: list[Any] = []
    for run in _runs(dataset.transitions):
        # One more than there are actions, as Minari counts infos: the last is the reset's or the end's.
        infos = {field: np.concatenate([getattr(run, field), getattr(run, field)[-1:]]) for field in _KEPT}
        buffers.append(
            collector.EpisodeBuffer(
                id=len(buffers),
                seed=int(run.spawn_seed_N[0]),
                observations=np.concatenate([run.obs_NVF, run.next_obs_NVF[-1:]]),  # pyright: ignore[reportArgumentType]
                actions=run.action_N,
                rewards=run.reward_N,
                terminations=run.terminated_N,
                truncations=run.truncated_N,
                infos=infos,
            )
        )
    with warnings.catch_warnings():
        # It warns of an author, an address and a link that it was not given.
        warnings.simplefilter("ignore", UserWarning)
        made = minari.create_dataset_from_buffers(
            name,
            buffers,
            env=spec,
            algorithm_name=", ".join(str(driver.get("name")) for driver in dataset.drivers.values()),
            description=card(dataset),
            requirements=["rapid-driving"],
        )
    made.storage.update_metadata({"rapid": _meta(dataset)})
    return made


def import_minari(name: str) -> Dataset:
    """Read what `export_minari` made.

    Raises:
        RapidError: Minari is not installed, has no such dataset, or it is damaged or was not made by RAPID.
    """
    minari = _need("minari")
    try:
        source = minari.load_dataset(name)
    except Exception as error:  # whatever is in its files
        raise RapidError(
            f"Minari has no dataset '{name}' that it can read: {sentence(str(error))} Choose one of `minari list "
            "local`."
        ) from error
    with _foreign(f"The Minari dataset '{name}' cannot be read"):
        meta = source.storage.metadata.get("rapid")
        if meta is None:
            raise RapidError(
                f"The Minari dataset '{name}' was not made by RAPID: it lacks the provenance of its steps."
            )
        for path in Path(source.storage.data_path).glob("*.hdf5"):
            with _need("h5py").File(path, "r") as file:
                _check_size(_bytes_in(file), path)
        runs = [
            _run(
                np.asarray(episode.observations, np.float32),
                np.asarray(episode.actions),
                np.asarray(episode.rewards),
                np.asarray(episode.terminations),
                np.asarray(episode.truncations),
                {field: np.asarray(episode.infos[field])[:-1] for field in _KEPT},
            )
            for episode in source.iterate_episodes()
        ]
        return _dataset(_together(runs), meta, name)


def export_d3rlpy(dataset: Dataset, path: str | os.PathLike[str], flatten: bool = True) -> None:
    """Write the HDF5 file that d3rlpy's `ReplayBuffer.load` reads (its dataset format 2.1).

    d3rlpy has no next observation at the end of an episode and drops the last step of one that was cut off by the
    clock. So that it drops nothing real, those episodes get one more step, which holds the last observation.

    Args:
        dataset: what to export.
        path: the file.
        flatten: whether an observation is a vector of 75 numbers, as d3rlpy's networks want it, or stays 15 x 5.

    Raises:
        RapidError: h5py is not installed.
    """
    h5py = _need("h5py")
    runs = _runs(dataset.transitions)
    # The file is locked by us already.
    with atomic_path(path) as temporary, h5py.File(temporary, "w", locking=False) as file:
        file.create_dataset("columns", data=["observations", "actions", "rewards", "terminated"])
        file.create_dataset("num_episodes", data=len(runs))
        file.create_dataset("version", data="2.1")
        file.attrs["rapid"] = _meta(dataset)
        for number, run in enumerate(runs):
            ended = bool(run.terminated_N[-1])
            obs, action, reward = run.obs_NVF, run.action_N, run.reward_N
            if not ended:
                obs = np.concatenate([obs, run.next_obs_NVF[-1:]])
                action, reward = np.append(action, 0), np.append(reward, np.float32(0))
            columns = {
                "observations": obs.reshape(len(obs), -1) if flatten else obs,
                "actions": action[:, None],
                "rewards": reward[:, None],
                "terminated": ended,
                # d3rlpy reads the four columns above; these are for the way back.
                "final_observation": run.next_obs_NVF[-1],
                "truncated": run.truncated_N[-1],
                **{field: getattr(run, field) for field in _KEPT},
            }
            for name, data in columns.items():
                file.create_dataset(f"{name}_{number}", data=data)


def import_d3rlpy(path: str | os.PathLike[str]) -> Dataset:
    """Read what `export_d3rlpy` wrote.

    Raises:
        RapidError: h5py is not installed, or the file is missing, damaged or was not written by RAPID.
    """
    h5py = _need("h5py")
    runs: list[Transitions] = []
    with _foreign(f"'{path}' is no d3rlpy dataset that RAPID exported"):
        with h5py.File(path, "r") as file:
            _check_size(_bytes_in(file), Path(path))
            meta = str(file.attrs["rapid"])
            for number in range(int(file["num_episodes"][()])):
                kept = {field: file[f"{field}_{number}"][()] for field in _KEPT}
                count = len(kept["step_N"])
                final = file[f"final_observation_{number}"][()]
                last_N = np.arange(count) == count - 1
                runs.append(
                    _run(
                        np.concatenate(
                            [file[f"observations_{number}"][()].reshape(-1, *final.shape)[:count], final[None]]
                        ),
                        file[f"actions_{number}"][()][:count, 0],
                        file[f"rewards_{number}"][()][:count, 0],
                        last_N & bool(file[f"terminated_{number}"][()]),
                        last_N & bool(file[f"truncated_{number}"][()]),
                        kept,
                    )
                )
        return _dataset(_together(runs), meta, str(path))


_EXPANSION = 1000
"""How many bytes may come of one in a file: compression gives no more, and a header may claim anything."""


@contextmanager
def _foreign(fault: str) -> Generator[None, None, None]:
    """Explain in one paragraph whatever the libraries that read a file of others find wrong with it."""
    try:
        yield
    except RapidError:
        raise
    except Exception as error:  # what they raise is written nowhere: TypeError, OverflowError, MemoryError, ...
        said = f"{type(error).__name__}: {error}"
        raise RapidError(f"{fault}: {sentence(said)} It is damaged, or of another kind; export it again.") from error


def _bytes_in(file: Any) -> int:
    """Return how much memory the arrays in an HDF5 file would take; their shapes are in headers."""
    sizes: list[int] = []
    file.visititems(lambda _, item: sizes.append(int(getattr(item, "nbytes", 0))))
    return sum(sizes)


def _check_size(claimed: int, path: Path) -> None:
    """Raise before anything is allocated for what a file claims to hold but cannot."""
    if claimed > _EXPANSION * path.stat().st_size:
        raise RapidError(
            f"'{path}' claims to hold {claimed} bytes, but is only {path.stat().st_size} long. It is damaged, or not "
            "meant well."
        )


def _runs(transitions: Transitions) -> list[Transitions]:
    """Return the runs of consecutive steps."""
    transitions.validate("the dataset")
    ends = np.flatnonzero(~transitions.follows_N()) + 1
    starts = [0, *ends[:-1].tolist()]
    return [transitions.select(slice(start, end)) for start, end in zip(starts, ends.tolist(), strict=True)]


def _run(obs: Any, action: Any, reward: Any, terminated: Any, truncated: Any, kept: dict[str, Any]) -> Transitions:
    """Return the transitions of one run from its T + 1 observations."""
    for name, whole in (("action", action), *kept.items()):
        # 2.7 is no action, and must not become 2.
        if name != "probabilities_NA" and np.asarray(whole).dtype.kind not in "iu":
            raise TypeError(f"{name.partition('_N')[0]} is of type {np.asarray(whole).dtype}")
    return Transitions(
        obs_NVF=np.asarray(obs[:-1], np.float32),
        action_N=np.asarray(action, np.int64),
        reward_N=np.asarray(reward, np.float32),
        next_obs_NVF=np.asarray(obs[1:], np.float32),
        terminated_N=np.asarray(terminated, np.bool_),
        truncated_N=np.asarray(truncated, np.bool_),
        source_N=np.asarray(kept["source_N"], np.int8),
        episode_N=np.asarray(kept["episode_N"], np.int64),
        step_N=np.asarray(kept["step_N"], np.int64),
        spawn_seed_N=np.asarray(kept["spawn_seed_N"], np.int64),
        probabilities_NA=np.asarray(kept["probabilities_NA"], np.float32),
    )


def _together(runs: list[Transitions]) -> Transitions:
    """Return the runs one after another with the episode numbers they have."""
    numbers = np.concatenate([run.episode_N for run in runs])
    joined = concatenate(runs)
    return replace(joined, episode_N=numbers)


def _meta(dataset: Dataset) -> str:
    facts = {"schema_version": SCHEMA_VERSION, "licence": LICENCE, "scenario": dataset.scenario}
    return json.dumps(
        {**facts, "drivers": dataset.drivers, "mixture": dataset.mixture, "collection": dataset.collection}
    )


def _dataset(transitions: Transitions, meta: str, where: str) -> Dataset:
    """Return the dataset if it is valid and of this version."""
    facts = json.loads(meta)
    check_kinds(facts)
    get_scenario(facts["scenario"])
    if facts.get("schema_version") != SCHEMA_VERSION:
        raise RapidError(
            f"'{where}' has schema version {facts.get('schema_version')}; this version of RAPID reads "
            f"{SCHEMA_VERSION}. Export it again with this version."
        )
    transitions.validate(f"'{where}'")
    return Dataset(
        facts["scenario"], transitions, facts["drivers"], mixture=facts["mixture"], collection=facts["collection"]
    )


def _need(module: str) -> Any:
    """Return an optional dependency."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RapidError(
            f"This format needs the package '{Path(module).stem}'. Install it: {how_to_install('minari')}"
        ) from error
