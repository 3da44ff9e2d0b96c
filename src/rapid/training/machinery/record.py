"""What a training leaves in its directory: metrics as JSON lines, and a checkpoint to resume from.

The checkpoint is the truth: it holds the rows that were written before it, and the file of the metrics, which is there
for people and other programs, is made to agree with it whenever the training goes on.
"""

import contextlib
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rapid import checkpoint, termination
from rapid.config_io import apply_overrides, differences, to_dict
from rapid.errors import DamagedError, RapidError
from rapid.files import AppendedFile, make_directory, write_text
from rapid.networks.q_network import QNetwork
from rapid.progress import warn

METRICS_FILE, CHECKPOINT_FILE = "metrics.jsonl", "checkpoint.safetensors"

Evaluate = Callable[[QNetwork, int], dict[str, Any]]
"""Measures a network: (network, iterations or environment steps so far) -> numbers, or anything that JSON holds."""

Track = Callable[[dict[str, Any]], None]
"""Takes a row of metrics, as JSON holds it, to show it elsewhere."""


class Record:
    """The metrics and the checkpoint of one training.

    Args:
        directory: made if need be.
        settings: what makes this training this one, as JSON values and dataclasses of settings; a checkpoint of another
            is refused. A setting that its checkpoint was written without had the effect that its default has now.
        every_seconds: time between two checkpoints. When they are taken has no influence on the result.
        track: is given every row, and again the earlier ones when the training goes on.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        settings: dict[str, Any],
        every_seconds: float = 60.0,
        track: Track | None = None,
    ) -> None:
        self.directory = Path(directory)
        try:
            make_directory(self.directory)
        except OSError as error:
            raise RapidError(f"Cannot train in '{directory}': {error}. Choose a directory you can write to.") from error
        self._kinds = {key: type(value) for key, value in settings.items() if is_dataclass(value)}
        self._settings = {key: _plain(value) for key, value in settings.items()} | {"threads": torch.get_num_threads()}
        self._every, self._track = every_seconds, track
        self._seconds_before, self._text = 0.0, ""
        self._start = self._last = time.monotonic()

    @property
    def seconds(self) -> float:
        """Seconds of training so far, those before a resume included."""
        return self._seconds_before + time.monotonic() - self._start

    def resume(self) -> dict[str, Any] | None:
        """Return the state of the last checkpoint, the metrics made to agree with it; None if there is none.

        A damaged one is named and put aside, and the training begins anew: it comes to the same end.

        Raises:
            RapidError: it belongs to another training.
        """
        path, metrics = self.directory / CHECKPOINT_FILE, self.directory / METRICS_FILE
        content = self._read(path) if path.exists() else None
        if content is None:
            metrics.unlink(missing_ok=True)
            return None
        before = content["settings"]
        for key in self._kinds.keys() & before.keys():
            before[key] = _plain(apply_overrides(self._kinds[key](), before[key], key, f"'{path}'"))
        # Before it was told, it was the default.
        before.setdefault("threads", 1)
        if any(before.get(key) != value for key, value in self._settings.items()):
            raise RapidError(
                f"'{self.directory}' holds a training with other settings: {differences(before, self._settings)}. "
                "Nothing was changed. Choose another directory, or delete this one to start anew."
            )
        self._seconds_before = content["seconds"]
        self._text = content["metrics"]
        if not metrics.exists() or metrics.read_bytes() != self._text.encode():
            write_text(metrics, self._text)
        if self._track:
            for line in self._text.splitlines():
                self._track(json.loads(line))
        return content["state"]

    def _read(self, path: Path) -> dict[str, Any] | None:
        """Return what a checkpoint holds; None if it is damaged."""
        try:
            content = checkpoint.load_state(path)
            if "metrics" not in content:  # an earlier version left them to the other file
                log = self.directory / METRICS_FILE
                content["metrics"] = (log.read_bytes() if log.exists() else b"")[: content["metrics_bytes"]].decode()
                if len(content["metrics"].encode()) < content["metrics_bytes"]:
                    raise DamagedError(f"'{log}' was cut off or removed.")
            return content
        except (DamagedError, KeyError, UnicodeDecodeError) as error:
            aside = path.with_name(f"{path.stem}.damaged{path.suffix}")
            warn(f"{error} It is kept as '{aside.name}', and the training begins anew, with the same result.")
            path.replace(aside)
            return None

    def write(self, row: dict[str, Any]) -> None:
        """Append one line of metrics; NaN and infinity become null."""
        row = _finite(row)
        line = json.dumps(row, allow_nan=False) + "\n"
        with AppendedFile(self.directory / METRICS_FILE) as log:
            log.append(line.encode())
        self._text += line
        if self._track:
            self._track(row)

    def checkpoint(self, state: Callable[[], dict[str, Any]], now: bool = False) -> None:
        """Save what `state` returns if it is time, or `now`, or if the process was told to end.

        Raises:
            StoppedError: it was told to end, and the checkpoint is written.
        """
        ending = termination.requested()
        if not now and not ending and time.monotonic() - self._last < self._every:
            return
        # In this order: whoever finds the checkpoint finds all of its metrics.
        metrics = self.directory / METRICS_FILE
        if metrics.exists():
            with AppendedFile(metrics) as log:
                log.sync()
        content = {"settings": self._settings, "seconds": self.seconds, "metrics": self._text, "state": state()}
        checkpoint.save_state(self.directory / CHECKPOINT_FILE, content)
        self._last = time.monotonic()
        if ending and not now:
            raise termination.StoppedError(f"a last checkpoint is in '{self.directory}'")


def _plain(value: Any) -> Any:
    """Return a value as JSON gives it back, so that a comparison sees no tuples."""
    return json.loads(json.dumps(to_dict(value) if is_dataclass(value) else value))


def _finite(value: Any) -> Any:
    """Return `value` with numbers that JSON has no name for as None, and NumPy numbers as Python's."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def crossed(count: int, step: int, every: int) -> bool:
    """Return whether a count that just grew by `step` to `count` reached a multiple of `every`; 0 is never."""
    return every > 0 and count // every != (count - step) // every


def fingerprint(arrays: Iterable[NDArray[Any]]) -> str:
    """Return the SHA-256 of arrays, in order."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def network_fingerprint(network: QNetwork) -> str:
    """Return the SHA-256 of a network's weights."""
    return fingerprint(value.detach().cpu().numpy() for value in network.state_dict().values())


def load_metrics(directory: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Return the metrics that a training left in its directory, one dictionary per line.

    Where the file is missing or damaged, they are those in the checkpoint.

    Raises:
        RapidError: there are neither.
    """
    path, saved = Path(directory) / METRICS_FILE, Path(directory) / CHECKPOINT_FILE
    fault: Exception | None = None
    text = ""
    try:
        text = path.read_text(encoding="utf-8")
        rows = [json.loads(line) for line in text.splitlines()]
    except (OSError, ValueError, RecursionError) as error:
        fault, rows = error, []
    if saved.exists() and (fault or not rows):
        with contextlib.suppress(RapidError):
            text = checkpoint.load_state(saved).get("metrics", text)
            return [json.loads(line) for line in text.splitlines()]
    if fault:
        raise RapidError(f"Cannot read the metrics '{path}': {fault}. Train again.") from fault
    return rows
