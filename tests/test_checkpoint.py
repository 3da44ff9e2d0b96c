"""Resumable state: equal after a round trip, never half written, damage told apart."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from rapid import checkpoint
from rapid.checkpoint import load_state, save_state
from rapid.errors import RapidError


def same(a, b) -> bool:
    if isinstance(a, dict):
        return type(b) is dict and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())
    return type(a) is type(b) and a == b


def test_a_nested_state_comes_back_equal(tmp_path):
    rng = np.random.default_rng(0)
    state = {
        "step": 7,
        "big": 2**100,
        "share": 0.1,
        "text": "ε",
        "flags": [True, None, (1, 2.5)],
        "empty": {"dict": {}, "list": [], "tuple": (), "tensor": torch.zeros(0, 3), "array": np.zeros((0, 2))},
        "tensors": {kind: torch.arange(3).to(kind) for kind in (torch.bool, torch.uint8, torch.int64, torch.float64)}
        and {"bool": torch.tensor([True, False]), "half": torch.ones(2).bfloat16(), "scalar": torch.tensor(3.5)},
        "arrays": [
            rng.random((2, 3), np.float32),
            np.arange(3, dtype=np.uint64),
            np.array(4),
            np.ones((4, 4))[::2, 1:],
        ],
        "view": torch.arange(12.0).view(3, 4).T,
        "generator": rng.bit_generator.state,
        "torch_generator": torch.Generator().manual_seed(3).get_state(),
        3: {"tensor": "not a tensor", "dict": 1},
    }
    save_state(tmp_path / "a.state", state)
    assert same(state, load_state(tmp_path / "a.state"))


def test_optimizer_and_generators_continue_exactly(tmp_path):
    def make():
        model = torch.nn.Linear(3, 2)
        return model, torch.optim.Adam(model.parameters(), 0.1), torch.Generator().manual_seed(0)

    def step(model, optimizer, generator):
        optimizer.zero_grad()
        model(torch.randn(4, 3, generator=generator)).square().sum().backward()
        optimizer.step()

    parts = make()
    step(*parts)
    model, optimizer, generator = parts
    state = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "generator": generator.get_state()}
    save_state(tmp_path / "x", state)
    resumed = make()
    loaded = load_state(tmp_path / "x")
    resumed[0].load_state_dict(loaded["model"])
    resumed[1].load_state_dict(loaded["optimizer"])
    resumed[2].set_state(loaded["generator"])
    for _ in range(3):
        step(*parts)
        step(*resumed)
    assert torch.equal(model.weight, resumed[0].weight)


def test_tied_tensors_are_stored_once_and_stay_tied(tmp_path):
    shared = torch.randn(1000)
    save_state(tmp_path / "x", {"a": shared, "b": shared, "part": shared[:10], "array": np.ones(3)})
    assert (tmp_path / "x").stat().st_size < 6000
    loaded = load_state(tmp_path / "x")
    assert loaded["a"] is loaded["b"]
    loaded["part"][0] = 5
    loaded["array"][0] = 5
    assert loaded["a"][0] != 5


@pytest.mark.parametrize("bad", [{1.5: 0}, {"a": {"b": {1, 2}}}, {"a": [object()]}, {"a": np.array(["x"])}])
def test_what_cannot_be_saved_is_named(tmp_path, bad):
    with pytest.raises(RapidError, match="Cannot save state"):
        save_state(tmp_path / "x", bad)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_keeps_the_previous_checkpoint(tmp_path, monkeypatch):
    save_state(tmp_path / "x", {"a": 1})

    def fail(tensors, path, header):
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(checkpoint, "save_file", fail)
    with pytest.raises(RapidError, match="disk full"):
        save_state(tmp_path / "x", {"a": 2})
    assert load_state(tmp_path / "x") == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_damaged_foreign_and_future_files_are_refused(tmp_path):
    path = tmp_path / "x"
    with pytest.raises(RapidError, match="no checkpoint"):
        load_state(path)
    save_state(path, {"a": torch.randn(100), "b": [1]})
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[-3] ^= 1
    # A power cut may leave zeros at the end of a file whose length is right.
    zeros = content[:-64] + bytes(64)
    tree = content.replace(b"[1]", b"[2]")
    assert tree != content
    for damaged in (b"", content[:9], content[:-1], b"{" + content, bytes(flipped), zeros, tree):
        path.write_bytes(damaged)
        with pytest.raises(RapidError, match="damaged"):
            load_state(path)
    save_file({"a": torch.ones(1)}, path)
    with pytest.raises(RapidError, match="not a checkpoint"):
        load_state(path)
    save_file({}, path, {"format": "rapid-state", "version": "99", "tree": "{}"})
    with pytest.raises(RapidError, match="version 99"):
        load_state(path)
    for tree in ("{", '{"dict": [["a", {"tensor": "0"}]]}', '{"dict": 3}', '{"odd": 3}'):
        save_file({}, path, {"format": "rapid-state", "version": "2", "tree": tree})
        with pytest.raises(RapidError, match="damaged"):
            load_state(path)
