"""What a training leaves behind: whose checkpoint it is, and that metrics and checkpoint agree whatever happens."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from power import PowerCut
from rapid import checkpoint, termination
from rapid.config import AdaptConfig
from rapid.errors import RapidError
from rapid.training.machinery.record import CHECKPOINT_FILE, METRICS_FILE, Record, load_metrics

CONFIG = AdaptConfig(steps=20)


def test_a_setting_that_is_new_since_the_checkpoint_had_its_default(tmp_path):
    Record(tmp_path, {"config": CONFIG, "seed": 1}).checkpoint(lambda: {"done": 7}, now=True)
    path = tmp_path / CHECKPOINT_FILE
    content = checkpoint.load_state(path)
    del content["settings"]["config"]["mirror"], content["settings"]["config"]["ppo"]["clip"]
    checkpoint.save_state(path, content)
    assert Record(tmp_path, {"config": CONFIG, "seed": 1}).resume() == {"done": 7}
    others = (
        replace(CONFIG, mirror=True),
        replace(CONFIG, ppo=replace(CONFIG.ppo, clip=0.1)),
        replace(CONFIG, steps=9),
    )
    for other in others:
        with pytest.raises(RapidError, match=r"other settings: config\."):
            Record(tmp_path, {"config": other, "seed": 1}).resume()
    with pytest.raises(RapidError, match=r"other settings: seed: 1 there, 2 now"):
        Record(tmp_path, {"config": CONFIG, "seed": 2}).resume()


def train(directory: Path, steps: int = 12, stop: int | None = None, every: float = 0.0) -> float:
    """A training of which each step depends on the one before; `stop` steps later it is killed."""
    record = Record(directory, {"config": CONFIG, "seed": 1}, every)
    weight, done = torch.zeros(1000), 0
    if (saved := record.resume()) is not None:
        weight, done = saved["weight"], saved["done"]
    first = done
    while done < steps:
        if stop is not None and done - first == stop:
            raise KeyboardInterrupt
        weight = weight * 0.5 + done
        done += 1
        record.write({"step": done, "mean": float(weight.mean())})
        state = {"weight": weight, "done": done}
        record.checkpoint(lambda state=state: state, now=done == steps)
    return float(weight.mean())


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[float, str]:
    """The end of an uninterrupted training, and its metrics."""
    directory = tmp_path_factory.mktemp("whole")
    return train(directory), (directory / METRICS_FILE).read_text()


@pytest.mark.parametrize("seed", range(8))
def test_after_power_cuts_metrics_are_those_of_an_uninterrupted_training(tmp_path, whole, monkeypatch, seed):
    place, rng = tmp_path / "here", np.random.default_rng(seed)
    place.mkdir()
    for _ in range(50):
        with monkeypatch.context() as patch:
            disk = PowerCut(place, patch)
            try:
                end = train(place, stop=int(rng.integers(0, 6)), every=float(rng.choice([0, 1e9])))
            except KeyboardInterrupt:
                end = None
            place = disk.after()
        if end is not None:
            break
    assert end == whole[0]
    assert (place / METRICS_FILE).read_text() == whole[1]
    assert train(place) == whole[0]


@pytest.mark.parametrize("metrics", [None, "", "{", '{"step": 1, "mean": 0.0}\n', "\0" * 5000, "more\n" * 500])
def test_the_metrics_are_made_to_agree_with_the_checkpoint(tmp_path, whole, metrics):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, stop=7)
    path = tmp_path / METRICS_FILE
    path.unlink() if metrics is None else path.write_text(metrics)
    assert train(tmp_path) == whole[0]
    assert path.read_text() == whole[1]


@pytest.mark.parametrize("damage", ["zeros at the end", "cut", "one bit", "empty"])
def test_a_damaged_checkpoint_is_named_and_the_training_comes_to_the_same_end(tmp_path, whole, capsys, damage):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, stop=7)
    path = tmp_path / CHECKPOINT_FILE
    content = bytearray(path.read_bytes())
    if damage == "zeros at the end":
        content[-2000:] = bytes(2000)
    elif damage == "one bit":
        content[-9] ^= 4
    path.write_bytes({"cut": content[:-500], "empty": b""}.get(damage, content))
    assert train(tmp_path) == whole[0]
    assert f"'{path}' is damaged" in capsys.readouterr().err
    assert (tmp_path / METRICS_FILE).read_text() == whole[1]
    assert (tmp_path / "checkpoint.damaged.safetensors").exists()


def test_a_training_of_an_earlier_version_goes_on(tmp_path, whole):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, stop=7)
    path, metrics = tmp_path / CHECKPOINT_FILE, tmp_path / METRICS_FILE
    content = checkpoint.load_state(path)
    content["metrics_bytes"] = len(content.pop("metrics").encode())
    del content["settings"]["threads"]
    checkpoint.save_state(path, content)
    metrics.write_text(metrics.read_text() + '{"step": 8')
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert train(tmp_path) == whole[0]
    finally:
        torch.set_num_threads(before)
    assert metrics.read_text() == whole[1]


def test_metrics_that_are_lost_are_read_from_the_checkpoint(tmp_path, whole):
    train(tmp_path)
    for content in ("", "{", "\0\0"):
        (tmp_path / METRICS_FILE).write_text(content)
        assert load_metrics(tmp_path) == [json.loads(line) for line in whole[1].splitlines()]
    (tmp_path / CHECKPOINT_FILE).unlink()
    with pytest.raises(RapidError, match="Cannot read the metrics"):
        load_metrics(tmp_path)


def test_other_threads_are_another_training(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, stop=3)
    before = torch.get_num_threads()
    torch.set_num_threads(before + 1)
    try:
        with pytest.raises(RapidError, match=rf"threads: {before} there, {before + 1} now"):
            train(tmp_path)
    finally:
        torch.set_num_threads(before)


def test_told_to_end_it_writes_a_last_checkpoint(tmp_path, whole):
    """However long ago the last one was; and what is done is not done again."""
    with termination.noticed():
        with pytest.raises(termination.StoppedError, match="a last checkpoint"), termination.waiting():  # noqa: PT012
            record = Record(tmp_path, {"config": CONFIG, "seed": 1}, 1e9)
            assert record.resume() is None
            weight = torch.zeros(1000)
            for done in range(1, 13):
                weight = weight * 0.5 + done - 1
                if done == 5:
                    os.kill(os.getpid(), signal.SIGTERM)
                record.write({"step": done, "mean": float(weight.mean())})
                state = {"weight": weight, "done": done}
                record.checkpoint(lambda state=state: state)
        assert checkpoint.load_state(tmp_path / CHECKPOINT_FILE)["state"]["done"] == 5
    assert train(tmp_path) == whole[0]
    assert (tmp_path / METRICS_FILE).read_text() == whole[1]


def test_outside_a_training_it_ends_at_once_and_the_old_handler_comes_back():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(termination.StoppedError, match="what is done is kept"), termination.noticed():  # noqa: PT012
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("went on")
    assert signal.getsignal(signal.SIGTERM) == before
    with termination.noticed():
        assert not termination.requested()
