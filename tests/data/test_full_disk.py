"""A real file system that is too small: the worker's own error is shown, and the same command goes on after."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rapid.data.dataset import load_dataset

pytestmark = pytest.mark.slow


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    place = tmp_path / "small"
    place.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", place], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs the right to mount a file system")
    yield place
    subprocess.run(["umount", "-l", place], check=False)


def test_workers_on_a_full_disk_say_so_and_go_on_once_there_is_room(small: Path):
    words = "collect --teacher.backend scripted --teacher.model slower --workers 2 --teacher-transitions 2000"
    command = [sys.executable, "-m", "rapid.cli", *words.split(), "--lockstep", "20", "--out", str(small / "data")]
    full = subprocess.run(command, capture_output=True, text=True, check=False)
    assert full.returncode == 2
    assert "No space left on device" in full.stderr
    assert "too little memory" not in full.stderr
    assert "Traceback" not in full.stderr
    assert not (small / "data" / "dataset.json").exists()
    subprocess.run(["mount", "-o", "remount,size=64m", small], check=True)
    assert subprocess.run(command, capture_output=True, text=True, check=False).returncode == 0
    assert len(load_dataset(small / "data")) >= 2000
