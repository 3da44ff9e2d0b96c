"""The cache of compiled kernels."""

import importlib.util
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
