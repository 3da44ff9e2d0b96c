import errno
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from power import PowerCut
from rapid.errors import DamagedError, RapidError
from rapid.files import (
    AppendedFile,
    atomic_path,
    cache_dir,
    make_directory,
    read_json,
    sha256,
    write_bytes,
    write_json,
    write_text,
)


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path):
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(ValueError, match="broken"), atomic_path(target) as path:  # noqa: PT012
        path.write_text("half")
        raise ValueError("broken")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_files_get_the_mode_that_open_would_give(tmp_path: Path):
    write_text(tmp_path / "a", "x")
    (tmp_path / "b").write_text("x")
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == stat.S_IMODE((tmp_path / "b").stat().st_mode)


def test_json_round_trip_and_its_errors(tmp_path: Path):
    write_json(tmp_path / "a.json", {"x": [1, "ü"]})
    assert read_json(tmp_path / "a.json") == {"x": [1, "ü"]}
    with pytest.raises(ValueError, match="Out of range"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert read_json(tmp_path / "a.json") == {"x": [1, "ü"]}
    (tmp_path / "a.json").write_text('{"x": [1')
    with pytest.raises(RapidError, match="damaged"):
        read_json(tmp_path / "a.json")
    with pytest.raises(RapidError, match="no card at"):
        read_json(tmp_path / "b.json", "card")


def test_a_directory_that_cannot_be_made(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RapidError, match="Cannot write"):
        write_text(tmp_path / "file" / "a", "x")


def test_sha256_of_a_known_text(tmp_path: Path):
    (tmp_path / "a").write_bytes(b"abc")
    seen: list[int] = []
    assert sha256(tmp_path / "a", seen.append) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert seen == [3]


def test_the_cache_follows_its_variables(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RAPID_CACHE", "/x/y")
    assert cache_dir() == Path("/x/y")
    monkeypatch.delenv("RAPID_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/z")
    assert cache_dir() == Path("/z/rapid")


def test_what_was_written_survives_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    disk = PowerCut(tmp_path, monkeypatch)
    write_text(tmp_path / "a" / "b" / "old", "first")
    write_text(tmp_path / "a" / "b" / "old", "second")
    with AppendedFile(tmp_path / "a" / "log") as log:
        log.append(b"one\n", sync=True)
        log.append(b"two\n")
    (tmp_path / "a" / "plain").write_text("nobody flushed this")
    left = disk.after()
    assert (left / "a" / "b" / "old").read_text() == "second"
    assert (left / "a" / "log").read_bytes() == b"one\n" + bytes(4)
    assert not (left / "a" / "plain").exists()


def test_a_sealed_record_that_changed_is_noticed(tmp_path: Path):
    path = tmp_path / "a.json"
    write_json(path, {"x": [1.5, "ü"], "y": {"z": None}}, sealed=True)
    assert read_json(path) == {"x": [1.5, "ü"], "y": {"z": None}}
    whole = path.read_text()
    for damaged in (
        whole.replace("1.5", "1.6"),
        whole.replace('"y"', '"z"'),
        whole[:-20],
        "\0" * len(whole),
        "[" * 9999,
    ):
        path.write_text(damaged)
        with pytest.raises(DamagedError, match="damaged"):
            read_json(path)
    path.write_text('{"x": NaN}')
    with pytest.raises(DamagedError, match="NaN is no number"):
        read_json(path)


def test_what_a_killed_writer_left_is_removed_and_what_another_is_writing_is_not(tmp_path: Path):
    script = (
        "import os, sys\n"
        "from rapid.files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as path:\n"
        "    path.write_text('half')\n"
        "    print('writing', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    target = tmp_path / "a"
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(target)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "writing\n"
    write_text(target, "ours")
    assert len(os.listdir(tmp_path)) == 2
    process.kill()
    process.communicate()
    assert len(os.listdir(tmp_path)) == 2
    write_text(target, "ours again")
    assert os.listdir(tmp_path) == ["a"]


def test_an_appended_piece_is_whole_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The system takes three bytes at a time, and then the disk is full."""
    room = [11]
    write = os.write

    def short(handle: int, content: bytes) -> int:
        if not room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        count = min(3, len(content), room[0])
        room[0] -= count
        return write(handle, bytes(content[:count]))

    with AppendedFile(tmp_path / "log") as log:
        monkeypatch.setattr(os, "write", short)
        log.append(b"12345678")
        with pytest.raises(OSError, match="No space left"):
            log.append(b"abcdefgh")
        room[0] = 100
        log.append(b"ABC", sync=True)
        monkeypatch.undo()
    assert (tmp_path / "log").read_bytes() == b"12345678ABC"


def test_nothing_is_appended_through_a_link(tmp_path: Path):
    write_bytes(tmp_path / "precious", b"mine")
    (tmp_path / "log").symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic links"):
        AppendedFile(tmp_path / "log")
    assert (tmp_path / "precious").read_bytes() == b"mine"


def test_a_file_in_the_place_of_a_directory_is_told(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        make_directory(tmp_path / "file")
    with pytest.raises(OSError, match="file"):
        make_directory(tmp_path / "file" / "below")
