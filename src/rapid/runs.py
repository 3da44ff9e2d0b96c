"""A run's directory: who made it, with what settings, which steps are done. The same command goes on where it was.

Layout: ``run.json`` (settings, versions, commit, command), ``config.toml`` (the settings, for ``--config``), one folder
per step, and ``steps/STEP.json`` once a step is done.
"""

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import rapid
from rapid.config import Config, without_place
from rapid.config_io import apply_overrides, differences, to_dict, to_toml
from rapid.config_learning import PpoConfig
from rapid.errors import DamagedError, RapidError, did_you_mean
from rapid.files import read_json, write_json, write_text
from rapid.locks import is_empty
from rapid.presets import of_file, without_presets
from rapid.progress import warn

FORMAT = 1
MANIFEST = "run.json"
STEPS = ("collect", "mix", "distill", "adapt", "evaluate", "report")
"""The steps of a run, in their order."""
_PACKAGES = (
    "torch",
    "numpy",
    "numba",
    "gymnasium",
    "highway-env",
    "transformers",
    "xllamacpp",
    "safetensors",
    "pyarrow",
)


def versions() -> dict[str, str]:
    """Return the versions that decide what a run computes: this package, Python, the platform, the libraries."""
    found = {"rapid-driving": rapid.__version__, "python": platform.python_version(), "platform": platform.platform()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str:
    """Return the commit of the source tree, with ``+changes`` if it was edited since; empty outside a checkout."""
    here = Path(__file__).resolve().parent
    try:
        top = _git(here, "rev-parse", "--show-toplevel")
        if Path(top) != here.parent.parent:  # installed inside somebody else's repository
            return ""
        changed = _git(here, "status", "--porcelain", "--untracked-files=no")
        return _git(here, "rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def _git(directory: Path, *arguments: str) -> str:
    call = ["git", "-C", str(directory), *arguments]
    return subprocess.run(call, check=True, capture_output=True, text=True, timeout=10).stdout.strip()


class RunDirectory:
    """The directory of one run, opened for a list of `steps`. Whoever opens it holds its lock.

    Raises:
        RapidError: the directory was made by other settings, by another format, is no run's, or cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], config: Config, steps: Sequence[str]) -> None:
        self.path = Path(path)
        self.steps = tuple(steps)
        manifest = self.path / MANIFEST
        if manifest.exists():
            self._check_same(read_json(manifest, "run manifest"), config)
        elif self.path.exists() and (not self.path.is_dir() or not is_empty(self.path)):
            raise RapidError(
                f"'{self.path}' exists and is not the directory of a run. Choose another --directory, or empty it."
            )
        else:
            write_json(
                manifest,
                {
                    "format": FORMAT,
                    "config": to_dict(config),
                    "versions": versions(),
                    "commit": commit(),
                    "command": sys.argv[1:],
                    "started": datetime.now(UTC).isoformat(timespec="seconds"),
                },
                sealed=True,
            )
            write_text(self.path / "config.toml", to_toml(to_dict(config)))

    def _check_same(self, manifest: Any, config: Config) -> None:
        if (
            not isinstance(manifest, dict)
            or manifest.get("format") != FORMAT
            or not isinstance(manifest.get("config"), dict)
        ):
            raise RapidError(
                f"'{self.path / MANIFEST}' is not a run manifest of format {FORMAT}. It is damaged or was made by "
                "another version; choose another --directory, or replace what is there with --force."
            )
        made = manifest["config"]
        # A setting that did not exist when the run was made had the effect that its default has now.
        base = of_file(made)
        # There was no PPO before a run's settings told of it.
        base = replace(base, adapt=replace(base.adapt, ppo=PpoConfig()))
        there = apply_overrides(base, without_presets(made), source=f"'{self.path / MANIFEST}'")
        changes = differences(to_dict(without_place(there)), to_dict(without_place(config)))
        if changes:
            raise RapidError(
                f"The run in '{self.path}' was made with other settings: {changes}. Nothing was changed. Repeat "
                f"its own settings (rapid run --config {self.path / 'config.toml'} --directory {self.path}), choose "
                "another --directory, or replace what is there with --force."
            )

    def is_done(self, step: str) -> bool:
        """Whether `step` and all before it were finished."""
        return all(self._read_mark(before) for before in self.steps[: self.steps.index(step) + 1])

    def finish(self, step: str, seconds: float, **facts: Any) -> None:
        """Mark `step` as done, with the time it took and facts about it."""
        record = {"step": step, "seconds": round(seconds, 2), "time": time.time(), **facts}
        write_json(self._mark(step), record, sealed=True)

    def facts(self, step: str) -> dict[str, Any]:
        """Return what :meth:`finish` wrote, or nothing if the step is not done."""
        return self._read_mark(step) if self.is_done(step) else {}

    def restart_from(self, step: str) -> None:
        """Forget `step` and all later ones: their marks and their folders.

        Raises:
            RapidError: there is no such step.
        """
        if step not in self.steps:
            raise RapidError(f"Unknown step '{step}'{did_you_mean(step, self.steps)} Steps: {', '.join(self.steps)}.")
        later = self.steps[self.steps.index(step) :]
        # Marks first, the last one first: a kill in between leaves no step done whose input is gone.
        for name in reversed(later):
            self._mark(name).unlink(missing_ok=True)
        for name in later:
            if (self.path / name).exists():
                shutil.rmtree(self.path / name)

    def _read_mark(self, step: str) -> dict[str, Any]:
        """Return what a step left when it was done; nothing if it did not, or if its mark is damaged."""
        path = self._mark(step)
        if not path.exists():
            return {}
        try:
            return dict(read_json(path, "step record"))
        except (DamagedError, TypeError, ValueError):
            # A step finds what it has done already, so that to do it again costs little.
            warn(f"The step record '{path}' is damaged. The step '{step}' is done again.")
            path.unlink()
            return {}

    def _mark(self, step: str) -> Path:
        return self.path / "steps" / f"{step}.json"
