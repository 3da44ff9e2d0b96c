"""One process at a time in a directory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rapid.errors import RapidError
from rapid.locks import LOCK_FILE, exclusive, exclusive_file, is_empty

HOLD = (
    "import sys\n"
    "from rapid.locks import exclusive, exclusive_file\n"
    "with {}(sys.argv[1]):\n"
    "    print('held', flush=True)\n"
    "    sys.stdin.read()\n"
)


def holder(path: Path, kind: str = "exclusive") -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD.format(kind), str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.parametrize("kind", ["exclusive", "exclusive_file"])
def test_the_second_is_refused_until_the_first_ends_however_it_ends(tmp_path: Path, kind: str):
    lock = {"exclusive": exclusive, "exclusive_file": exclusive_file}[kind]
    first = holder(tmp_path / "place", kind)
    with pytest.raises(RapidError, match="Another process is at work"), lock(tmp_path / "place"):
        pytest.fail("two hold it")
    first.kill()
    first.communicate()
    with lock(tmp_path / "place"), lock(tmp_path / "place"):  # whoever holds it may ask again
        pass
    assert not os.listdir(tmp_path) or not list(tmp_path.glob("**/*lock"))


def test_nothing_is_left_of_a_directory_that_was_made_in_vain(tmp_path: Path):
    with pytest.raises(ValueError, match="refused"), exclusive(tmp_path / "a" / "b"):  # noqa: PT012
        assert is_empty(tmp_path / "a" / "b")
        raise ValueError("refused")
    assert not os.listdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with exclusive(tmp_path / "empty"):
        pass
    assert os.listdir(tmp_path) == ["empty"]


@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "directory", "something else"])
def test_what_is_in_the_place_of_the_lock_is_left_alone(tmp_path: Path, kind: str):
    precious, place = tmp_path / "precious", tmp_path / "place"
    place.mkdir()
    precious.write_text("mine")
    lock = place / LOCK_FILE
    if kind == "link":
        lock.symlink_to(precious)
    elif kind == "dangling link":
        lock.symlink_to(tmp_path / "nowhere")
    elif kind == "pipe":
        os.mkfifo(lock)
    elif kind == "directory":
        lock.mkdir()
    else:
        lock.write_text("a file of the user's")
    before = os.lstat(lock)
    with pytest.raises(RapidError, match="was left as it is"), exclusive(place):
        pytest.fail("held")
    assert os.path.samestat(before, os.lstat(lock))
    assert precious.read_text() == "mine"
    assert not (tmp_path / "nowhere").exists()


def test_a_lock_that_was_removed_is_none(tmp_path: Path):
    """Who opened the file before its owner removed it must not hold what is no longer there."""
    import fcntl

    with exclusive(tmp_path):
        stale = os.open(tmp_path / LOCK_FILE, os.O_RDWR)
    fcntl.flock(stale, fcntl.LOCK_EX | fcntl.LOCK_NB)
    with exclusive(tmp_path), pytest.raises(RapidError, match="Another process"):
        _second(tmp_path)
    os.close(stale)


def _second(path: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-c", HOLD.format("exclusive"), str(path)],
        input="",
        text=True,
        capture_output=True,
        check=False,
    )
    assert result.returncode
    raise RapidError(result.stderr.strip().splitlines()[-1])


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(RapidError, match="Cannot write in"), exclusive(place):
            pytest.fail("held")
