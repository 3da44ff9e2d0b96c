"""Models of stable-baselines3 as agents: the same decisions, and nothing of the file is run."""

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rapid
from rapid.cli import main
from rapid.errors import RapidError

sb3 = pytest.importorskip("stable_baselines3")
pytest.importorskip("onnxruntime")

from rapid.agents.open import open_agent  # noqa: E402
from rapid.agents.sb3 import import_sb3, read_sb3  # noqa: E402

FAST = "highway-fast-v0"
RAW = {"observation": {"type": "Kinematics", "absolute": True, "normalize": False, "see_behind": True, "vehicles_count": 51}}  # fmt: skip  # noqa: E501


def _saved(
    folder: Path, algorithm: str, task: str = FAST, config: dict[str, Any] | None = None, **policy: Any
) -> tuple[Any, Path]:
    worlds = rapid.make_sb3_vec(task, 2, config=config)
    sizes = {"buffer_size": 10} if algorithm == "DQN" else {}
    model = getattr(sb3, algorithm)("MlpPolicy", worlds, policy_kwargs=policy, device="cpu", seed=1, **sizes)
    with torch.no_grad():  # an untrained PPO's preferences are all but equal
        for weights in model.policy.parameters():
            weights.mul_(4.0)
    model.save(folder / "model.zip")
    return model, folder / "model.zip"


@pytest.mark.parametrize(
    ("algorithm", "task", "policy"),
    [
        ("DQN", FAST, {"net_arch": [32, 32]}),
        ("PPO", FAST, {}),
        ("A2C", "highway-v0", {"net_arch": {"pi": [16], "vf": []}, "activation_fn": torch.nn.ELU}),
        ("PPO", "lane-3-density-2-fast", {"net_arch": [], "activation_fn": torch.nn.ReLU}),
        ("DQN", "lane-5-density-3", {"activation_fn": torch.nn.LeakyReLU}),
    ],
)
def test_the_agent_decides_as_the_model_does(tmp_path: Path, algorithm: str, task: str, policy: dict[str, Any]) -> None:
    model, path = _saved(tmp_path, algorithm, task, **policy)
    parity = import_sb3(path, tmp_path / "agent.onnx", task)
    assert parity.agreement > 0.99
    agent = open_agent(str(tmp_path / "agent.onnx"), "lane-3-density-2")
    vehicles = agent.vehicles
    looks, raw = rapid.make_vec(task, 4, seed=9), rapid.make_vec(
        task, 4, seed=9, config={"observation": RAW["observation"] | {"vehicles_count": vehicles}}
    )  # fmt: skip
    seen, rows = looks.reset()[0], raw.reset()[0]
    actions_seen: set[int] = set()
    for _ in range(12):
        expected = model.predict(seen, deterministic=True)[0]
        assert (agent.act(rows) == expected).all()
        actions_seen |= set(expected.tolist())
        # Some random steps, so that the ego also gets between others.
        steps = np.random.default_rng(len(actions_seen)).integers(0, 5, 4)
        seen, rows = looks.step(steps)[0], raw.step(steps)[0]


def test_the_command_makes_an_agent_that_evaluate_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, path = _saved(tmp_path, "DQN")
    with pytest.raises(SystemExit) as ended:
        main(["import", str(path)])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert "the same action on 100.00%" in said
    assert f"rapid evaluate {tmp_path / 'model.onnx'}" in said
    agent = open_agent(str(tmp_path / "model.onnx"), "lane-3-density-2")
    assert agent.metadata["trained_on"] == FAST
    assert agent.metadata["source"].startswith("stable-baselines3 ")
    for option, code in ((), 2), (("--force",), 0):
        with pytest.raises(SystemExit) as ended:
            main(["import", str(path), *option])
        assert ended.value.code == code
        assert ("--force" in capsys.readouterr().err) == bool(code)


class _Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return Path.touch, (self.marker,)


def _with(path: Path, name: str, content: bytes | None) -> Path:
    """Return a copy of a saved model with one member exchanged or left out."""
    changed = path.with_name("changed.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(changed, "w") as new:
        for member in old.namelist():
            if member != name:
                new.writestr(member, old.read(member))
            elif content is not None:
                new.writestr(member, content)
    return changed


def test_pickled_code_is_never_run(tmp_path: Path) -> None:
    import base64

    _, path = _saved(tmp_path, "DQN")
    marker = tmp_path / "was run"
    evil = _Evil(marker)
    buffer = io.BytesIO()
    torch.save({"q_net.q_net.0.weight": evil}, buffer)
    with pytest.raises(RapidError, match="more than tensors"):
        read_sb3(_with(path, "policy.pth", buffer.getvalue()))
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    pickled = base64.b64encode(pickle.dumps(evil)).decode()
    for value in data.values():
        if isinstance(value, dict) and ":serialized:" in value:
            value[":serialized:"] = pickled
    read_sb3(_with(path, "data", json.dumps(data).encode()))
    assert not marker.exists()


def test_models_that_cannot_be_imported_are_explained(tmp_path: Path) -> None:
    _, path = _saved(tmp_path, "DQN")
    out = tmp_path / "agent.onnx"
    with pytest.raises(RapidError, match=r"no model at"):
        import_sb3(tmp_path / "nothing.zip", out, FAST)
    with pytest.raises(RapidError, match="--trained-on"):
        import_sb3(path, out, "lane-3-density-2")
    with pytest.raises(RapidError, match="Unknown scenario"):
        import_sb3(path, out, "highway-slow-v0")
    whole = path.read_bytes()
    for content in (b"", whole[: len(whole) // 2], b"PK" + whole[2:3000]):
        (tmp_path / "half.zip").write_bytes(content)
        with pytest.raises(RapidError, match=r"damaged|stable-baselines3"):
            import_sb3(tmp_path / "half.zip", out, FAST)
    for member, content in (
        ("policy.pth", None),
        ("data", None),
        ("data", b"[]"),
        ("data", b"{"),
        ("policy.pth", b"x"),
    ):
        with pytest.raises(RapidError):
            import_sb3(_with(path, member, content), out, FAST)
    data = json.loads(zipfile.ZipFile(path).read("data"))
    odd = data | {"policy_kwargs": {"activation_fn": "<class 'torch.nn.modules.activation.GELU'>"}}
    with pytest.raises(RapidError, match="GELU"):
        import_sb3(_with(path, "data", json.dumps(odd).encode()), out, FAST)
    for weights, named in (
        ({"features_extractor.cnn.0.weight": torch.zeros(2, 2)}, "MlpPolicy"),
        ({"q_net.q_net.0.weight": torch.zeros(3, 25), "q_net.q_net.0.bias": torch.zeros(3)}, "3 actions"),
        ({"q_net.q_net.0.weight": torch.zeros(5, 24), "q_net.q_net.0.bias": torch.zeros(5)}, "do not fit"),
        ({"q_net.q_net.0.weight": torch.full((5, 25), torch.nan), "q_net.q_net.0.bias": torch.zeros(5)}, "finite"),
    ):
        buffer = io.BytesIO()
        torch.save(weights, buffer)
        with pytest.raises(RapidError, match=named):
            import_sb3(_with(path, "policy.pth", buffer.getvalue()), out, FAST)
    assert not out.exists()
