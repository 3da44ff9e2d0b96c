"""A script written for HighwayEnv trains on the twin with one line changed, and the benchmark says which."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "published_script.py"
SCRIPT = """import gymnasium
import highway_env
from stable_baselines3 import DQN

env = gymnasium.make("highway-fast-v0")
DQN("MlpPolicy", env, learning_starts=8).learn(total_timesteps=int(2e4))
raise SystemExit("what follows the training is left out")
"""


@pytest.mark.slow
def test_it_trains_on_the_twin_and_tells_the_line_that_changed(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    words = [sys.executable, str(BENCHMARK), str(script), "--steps", "16", "--blocks", "1"]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert told[:2] == [
        '- env = gymnasium.make("highway-fast-v0")',
        '+ env = gymnasium.make("rapid:rapid/highway-fast-v0")',
    ]
    assert [line.split(" in ")[0] for line in told[2:4]] == ["original: 16 steps", "twin: 16 steps"]
