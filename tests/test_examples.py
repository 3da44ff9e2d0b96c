"""The examples run as they are printed, in small."""

import subprocess
import sys
from pathlib import Path

import pytest

from rapid.agents.open import open_agent
from rapid.agents.sb3 import import_sb3

EXAMPLES = Path(__file__).parents[1] / "examples"


def _run(folder: Path, name: str, *arguments: str) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.parametrize(
    ("name", "simulator", "steps"),
    [("sb3_dqn.py", "compiled", 240), ("sb3_dqn.py", "highway-env", 20), ("sb3_ppo.py", "compiled", 768)],
)
def test_stable_baselines3_trains_and_its_model_becomes_an_agent(
    tmp_path: Path, name: str, simulator: str, steps: int
) -> None:
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("onnxruntime")
    said = _run(tmp_path, name, "--simulator", simulator, "--steps", str(steps), "--episodes", "1", "--out", "model")
    assert f"{simulator}: {steps} steps in" in said
    assert import_sb3(tmp_path / "model.zip", tmp_path / "model.onnx", "highway-fast-v0").agreement > 0.99


def test_cleanrls_way_ends_with_an_agent(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    _run(tmp_path, "cleanrl_ppo.py", "--steps", "2048", "--worlds", "8", "--horizon", "64")
    assert open_agent(str(tmp_path / "cleanrl.onnx"), "lane-3-density-2").vehicles == 15


def test_d3rlpys_file_is_written(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    assert "15,005 transitions" in _run(tmp_path, "d3rlpy_dqn.py", "export", "shipped:lane-3-density-2/rule", "data.h5")
    assert (tmp_path / "data.h5").stat().st_size > 0
