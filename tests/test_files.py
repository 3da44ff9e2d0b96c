import os
import stat
from pathlib import Path

import pytest

from rapid.errors import RapidError
from rapid.files import atomic_path, cache_dir, read_json, sha256, write_json, write_text


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
