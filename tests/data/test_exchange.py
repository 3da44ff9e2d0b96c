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
def dataset(request) -> Dataset:
    return request.param


def assert_same(first: Dataset, second: Dataset) -> None:
    assert_equal(first.transitions, second.transitions)
    assert (first.scenario, first.drivers, first.mixture) == (second.scenario, second.drivers, second.mixture)


def test_numpy_and_back(tmp_path, dataset):
    export_npz(dataset, tmp_path / "data.npz")
    assert_same(import_npz(tmp_path / "data.npz"), dataset)
    whole = (tmp_path / "data.npz").read_bytes()
    (tmp_path / "data.npz").write_bytes(whole[: len(whole) // 2])
    for path in ("data.npz", "none.npz"):
        with pytest.raises(RapidError, match="no dataset in NumPy's format"):
            import_npz(tmp_path / path)


def test_minari_and_back(tmp_path, monkeypatch, dataset):
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
def test_d3rlpy_and_back(tmp_path, dataset, flatten):
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


def test_an_invalid_dataset_is_not_exported(tmp_path):
    rows = fake_transitions()
    rows.obs_NVF[2] = np.nan
    for export in (export_npz, export_d3rlpy):
        with pytest.raises(RapidError, match="row 2"):
            export(Dataset(SCENARIO, rows, {}), tmp_path / "data")
    assert not list(tmp_path.iterdir())
