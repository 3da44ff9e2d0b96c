import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fake_worlds import assert_equal, fake_transitions
from rapid.data.dataset import Dataset, mix
from rapid.data.exchange import export_d3rlpy, export_minari, export_npz, import_d3rlpy, import_minari, import_npz
from rapid.data.transitions import RANDOM
from rapid.errors import RapidError

SCENARIO = "lane-3-density-2"
TEACHER_DATA = Dataset(SCENARIO, fake_transitions(), {"teacher": {"name": "fake", "model": "m"}})
RANDOM_DATA = Dataset(SCENARIO, fake_transitions(20, RANDOM, seed=1), {"random": {"name": "random"}})
MIXED = mix(TEACHER_DATA, RANDOM_DATA, 0.5, 150, 0)


@pytest.fixture(params=[TEACHER_DATA, MIXED], ids=["collected", "mixed"])
def dataset(request: Any) -> Dataset:
    return request.param


def assert_same(first: Dataset, second: Dataset) -> None:
    assert_equal(first.transitions, second.transitions)
    assert (first.scenario, first.drivers, first.mixture) == (second.scenario, second.drivers, second.mixture)


def test_numpy_and_back(tmp_path: Path, dataset: Dataset):
    export_npz(dataset, tmp_path / "data.npz")
    assert_same(import_npz(tmp_path / "data.npz"), dataset)
    whole = (tmp_path / "data.npz").read_bytes()
    (tmp_path / "data.npz").write_bytes(whole[: len(whole) // 2])
    for path in ("data.npz", "none.npz"):
        with pytest.raises(RapidError, match="no dataset in NumPy's format"):
            import_npz(tmp_path / path)


def test_minari_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dataset: Dataset):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    export_minari(dataset, "highway/lane-3/fake-v0")
    loaded = minari.load_dataset("highway/lane-3/fake-v0")
    assert loaded.total_steps == len(dataset)
    episode = loaded[0]
    assert len(episode.observations) == len(episode.actions) + 1
    env = loaded.recover_environment()
    assert env.observation_space == loaded.observation_space
    assert env.unwrapped.scenario.name == SCENARIO
    assert_same(import_minari("highway/lane-3/fake-v0"), dataset)
    with pytest.raises(RapidError, match="already"):
        export_minari(dataset, "highway/lane-3/fake-v0")
    with pytest.raises(RapidError, match="no dataset 'highway/none-v0'"):
        import_minari("highway/none-v0")


@pytest.mark.parametrize("flatten", [True, False])
def test_d3rlpy_and_back(tmp_path: Path, dataset: Dataset, flatten: bool):
    h5py = pytest.importorskip("h5py")
    export_d3rlpy(dataset, tmp_path / "data.h5", flatten)
    assert_same(import_d3rlpy(tmp_path / "data.h5"), dataset)
    rows, real = dataset.transitions, 0
    with h5py.File(tmp_path / "data.h5") as file:
        assert [name.decode() for name in file["columns"][()]] == ["observations", "actions", "rewards", "terminated"]
        for number in range(file["num_episodes"][()]):
            obs = file[f"observations_{number}"][()]
            count = len(obs)
            assert obs.shape == ((count, 75) if flatten else (count, 15, 5))
            assert file[f"actions_{number}"].shape == file[f"rewards_{number}"].shape == (count, 1)
            # What d3rlpy makes of it: the last step counts only where the episode terminated.
            real += count if file[f"terminated_{number}"][()] else count - 1
    assert real == len(rows)
    (tmp_path / "other.h5").write_bytes(b"no")
    with pytest.raises(RapidError, match="no d3rlpy dataset"):
        import_d3rlpy(tmp_path / "other.h5")


def test_an_invalid_dataset_is_not_exported(tmp_path: Path):
    rows = fake_transitions()
    rows.obs_NVF[2] = np.nan
    for export in (export_npz, export_d3rlpy):
        with pytest.raises(RapidError, match="row 2"):
            export(Dataset(SCENARIO, rows, {}), tmp_path / "data")
    assert not list(tmp_path.iterdir())


READERS = {"npz": (export_npz, import_npz), "h5": (export_d3rlpy, import_d3rlpy)}


def explained(read: Callable[[], Any]) -> str:
    """Read what may be anything: what comes is data that makes sense, or one paragraph."""
    told = ""
    try:
        read().transitions.validate()
    except RapidError as error:
        told = str(error)
    assert "\n" not in told
    return told


def damage(content: bytes, rng: random.Random) -> bytes:
    """Cut off the end, or change some bytes."""
    if rng.random() < 0.3:
        return content[: rng.randrange(len(content))]
    changed = bytearray(content)
    # Most of a file is numbers; what says how they lie stands at the beginning and at the end.
    reach = rng.choice([200, 3000, len(content)])
    for _ in range(rng.choice([1, 3, 30])):
        changed[rng.choice([1, -1]) * rng.randrange(1, reach)] = rng.choice([0, 255, rng.randrange(256)])
    return bytes(changed)


@pytest.mark.parametrize("kind", READERS)
def test_any_bytes_in_files_of_others(tmp_path: Path, kind: str):
    pytest.importorskip("h5py")
    export, read = READERS[kind]
    export(Dataset(SCENARIO, fake_transitions(3), {"teacher": {"name": "fake"}}), tmp_path / "data")
    whole, told = (tmp_path / "data").read_bytes(), 0
    for seed in range(150):
        (tmp_path / "data").write_bytes(damage(whole, random.Random(seed)))
        told += bool(explained(lambda: read(tmp_path / "data")))
    assert told > 50


def test_any_bytes_in_minaris_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    name = "highway/lane-3/fake-v0"
    export_minari(Dataset(SCENARIO, fake_transitions(3), {"teacher": {"name": "fake"}}), name)
    told = 0
    for path in sorted((tmp_path / name / "data").iterdir()):
        whole = path.read_bytes()
        for seed in range(60):
            path.write_bytes(damage(whole, random.Random(seed)))
            told += bool(explained(lambda: import_minari(name)))
        path.write_bytes(whole)
    assert not explained(lambda: import_minari(name))
    assert told > 50


ODD = (
    *(np.zeros(0), np.zeros((3, 2)), np.float64(2.7), np.full((9, 1), 2.5), np.full(9, np.nan), np.full(9, 2**40)),
    *(b"text", "text", np.zeros((9, 15, 5), "c8"), np.full((9, 1), -1), np.zeros((9, 1), bool)),
)


@pytest.mark.parametrize("value", ODD, ids=[str(number) for number in range(len(ODD))])
def test_any_array_in_the_place_of_another(tmp_path: Path, value: Any):
    h5py = pytest.importorskip("h5py")
    export_d3rlpy(Dataset(SCENARIO, fake_transitions(3), {"teacher": {"name": "fake"}}), tmp_path / "whole")
    with h5py.File(tmp_path / "whole") as file:
        names = [name for name in file if name.endswith("_0")] + ["num_episodes"]
    for name in names:
        shutil.copyfile(tmp_path / "whole", tmp_path / "data")
        with h5py.File(tmp_path / "data", "r+") as file:
            del file[name]
            file[name] = value
        explained(lambda: import_d3rlpy(tmp_path / "data"))


def test_a_fraction_does_not_become_an_action(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    export_d3rlpy(Dataset(SCENARIO, fake_transitions(3), {"teacher": {"name": "fake"}}), tmp_path / "data")
    with h5py.File(tmp_path / "data", "r+") as file:
        del file["actions_0"]
        file["actions_0"] = np.full((3, 1), 2.7)
    assert "of type float64" in explained(lambda: import_d3rlpy(tmp_path / "data"))


def test_a_size_that_is_only_claimed_is_not_allocated(tmp_path: Path):
    h5py = pytest.importorskip("h5py")
    export_d3rlpy(Dataset(SCENARIO, fake_transitions(3), {"teacher": {"name": "fake"}}), tmp_path / "data")
    with h5py.File(tmp_path / "data", "r+") as file:
        del file["observations_0"]
        file.create_dataset("observations_0", shape=(2**40, 75), dtype="f4", chunks=(1, 75))
    assert (tmp_path / "data").stat().st_size < 10**6
    assert "claims to hold" in explained(lambda: import_d3rlpy(tmp_path / "data"))
