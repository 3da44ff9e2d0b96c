"""The cache of compiled kernels."""

import hashlib
import importlib.util
import pickle
from pathlib import Path
from typing import Any

import pytest

from rapid.simulator import compile as compiling

SOURCE = """
from rapid.simulator.compile import kernel

@kernel
def double(x):
    return 2 * x
"""


def _load(folder: Path) -> Any:
    path = folder / "some_kernels.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("some_kernels", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.double


def test_where_the_package_cannot_be_written_the_users_cache_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package, home = tmp_path / "package", tmp_path / "home"
    package.mkdir()
    (package / "__pycache__").write_text("")  # permissions do not stop root, a file in the way does
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    monkeypatch.setattr("numba.core.config.CACHE_DIR", "")
    double = _load(package)
    assert double(21) == 42
    assert list(home.rglob("*.nbc"))
    assert _load(package)(21) == 42


def test_where_nothing_can_be_written_kernels_still_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "__pycache__").write_text("")
    (tmp_path / "home").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("numba.core.config.CACHE_DIR", "")
    assert _load(tmp_path)(21) == 42


def _zeros(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def _wrong_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def _unreadable(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)  # permissions do not stop root, a link to itself does


@pytest.mark.parametrize("file", ["*.nbi", "*.nbc"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        _zeros,
        _wrong_byte,
        _unreadable,
    ],
    ids=["empty", "half", "zeros", "wrong byte", "unreadable"],
)
def test_a_damaged_cache_is_noticed_told_and_compiled_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, file: str, damage: Any
) -> None:
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiling, "_troubles", [])
    assert _load(tmp_path)(21) == 42
    (stored,) = (tmp_path / "cache").rglob(file)
    damage(stored)
    assert compiling.damaged_cache_files(stored.parent) == [stored]
    capsys.readouterr()
    assert _load(tmp_path)(21) == 42
    told = capsys.readouterr().err
    assert told.count("compiled anew") == 1
    assert str(stored.parent) in told
    assert stored.name in told
    assert compiling.damaged_cache_files(stored.parent) == []
    again = _load(tmp_path)
    assert again(21) == 42
    assert again.stats.cache_hits
    assert capsys.readouterr().err == ""


def test_a_full_disk_does_not_stop_a_kernel(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiling, "_troubles", [])
    monkeypatch.setattr(compiling._CheckedCacheFile, "_write", full)
    assert _load(tmp_path)(21) == 42
    assert "No space left" in capsys.readouterr().err


def test_doctor_names_damaged_machine_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rapid import doctor

    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))
    double = _load(tmp_path)
    assert double(21) == 42
    (stored,) = (tmp_path / "cache").rglob("*.nbc")
    assert stored.parent in compiling.cache_folders()
    assert "damaged" not in doctor._simulator().fact
    # The simulator's kernels, and those of networks and teachers.
    assert len({folder for folder in compiling.cache_folders() if folder != stored.parent}) >= 3
    _zeros(stored)
    found = doctor._simulator()
    assert found.verdict == "warning"
    assert "1 damaged file of machine code" in found.fact
    assert str(stored.parent) in found.fact


def test_a_change_of_any_kernel_makes_all_cached_kernels_stale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = Path(compiling.__file__).parents[1]
    for path in package.rglob("*.py"):
        copy = tmp_path / path.relative_to(package)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    monkeypatch.setattr(compiling, "__file__", str(tmp_path / "simulator" / "compile.py"))
    stamp = compiling.kernel_stamp.__wrapped__
    before = stamp()
    assert before == compiling.kernel_stamp()
    (tmp_path / "simulator" / "env.py").write_text("# holds none")
    assert stamp() == before
    with (tmp_path / "simulator" / "behavior.py").open("a") as file:
        file.write("\n")
    assert stamp() != before


class _OfAnotherVersion:
    """Stands for a type of a numba that is not installed: to unpickle it is an error."""

    def __reduce__(self) -> tuple[Any, ...]:
        return importlib.import_module, ("numba.core.types.old_scalars_of_another_version",)


@pytest.mark.parametrize("pieces", [1, 2])
def test_an_index_of_another_numba_is_not_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, pieces: int
) -> None:
    """After numba was updated its old types may be gone; the index of an earlier RAPID holds them in one piece."""
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiling, "_troubles", [])
    assert _load(tmp_path)(21) == 42
    (stored,) = (tmp_path / "cache").rglob("*.nbi")
    parts = ("0.1", b"stamp"), {"key": _OfAnotherVersion()}
    content = pickle.dumps((*parts[0], parts[1])) if pieces == 1 else b"".join(map(pickle.dumps, parts))
    stored.write_bytes(content + hashlib.sha256(content).digest())
    assert _load(tmp_path)(21) == 42
    again = _load(tmp_path)
    assert again(21) == 42
    assert again.stats.cache_hits
    assert capsys.readouterr().err == ""
