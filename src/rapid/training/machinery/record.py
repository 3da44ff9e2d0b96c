"""What a training leaves in its directory: metrics as JSON lines, and a checkpoint to resume from."""

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
from numpy.typing import NDArray

from rapid import checkpoint
from rapid.config_io import apply_overrides, to_dict
from rapid.errors import RapidError
from rapid.networks.q_network import QNetwork

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
            self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RapidError(f"Cannot train in '{directory}': {error}. Choose a directory you can write to.") from error
        self._kinds = {key: type(value) for key, value in settings.items() if is_dataclass(value)}
        self._settings = {key: _plain(value) for key, value in settings.items()}
        self._every, self._track = every_seconds, track
        self._seconds_before = 0.0
        self._start = self._last = time.monotonic()

    @property
    def seconds(self) -> float:
        """Seconds of training so far, those before a resume included."""
        return self._seconds_before + time.monotonic() - self._start

    def resume(self) -> dict[str, Any] | None:
        """Return the state of the last checkpoint, the metrics after it removed; None if there is none.

        Raises:
            RapidError: it belongs to another training, or is damaged.
        """
        path, metrics = self.directory / CHECKPOINT_FILE, self.directory / METRICS_FILE
        if not path.exists():
            metrics.unlink(missing_ok=True)
            return None
        state = checkpoint.load_state(path)
        before = state["settings"]
        for key in self._kinds.keys() & before.keys():
            before[key] = _plain(apply_overrides(self._kinds[key](), before[key], key, f"'{path}'"))
        differing = [key for key in self._settings if before.get(key) != self._settings[key]]
        if differing:
            raise RapidError(
                f"'{self.directory}' holds a training with other settings ({', '.join(differing)} differ). Choose "
                "another directory, or delete this one to start anew."
            )
        self._seconds_before = state["seconds"]
        if state["metrics_bytes"]:
            if not metrics.exists() or metrics.stat().st_size < state["metrics_bytes"]:
                raise RapidError(
                    f"'{metrics}' was cut off or removed. Restore it, or delete the directory to start anew."
                )
            os.truncate(metrics, state["metrics_bytes"])
            if self._track:
                for row in load_metrics(self.directory):
                    self._track(row)
        else:
            metrics.unlink(missing_ok=True)
        return state["state"]

    def write(self, row: dict[str, Any]) -> None:
        """Append one line of metrics; NaN and infinity become null."""
        row = _finite(row)
        with (self.directory / METRICS_FILE).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row, allow_nan=False) + "\n")
        if self._track:
            self._track(row)

    def checkpoint(self, state: Callable[[], dict[str, Any]], now: bool = False) -> None:
        """Save what `state` returns if it is time, or `now`."""
        if not now and time.monotonic() - self._last < self._every:
            return
        metrics = self.directory / METRICS_FILE
        size = metrics.stat().st_size if metrics.exists() else 0
        content = {"settings": self._settings, "seconds": self.seconds, "metrics_bytes": size, "state": state()}
        checkpoint.save_state(self.directory / CHECKPOINT_FILE, content)
        self._last = time.monotonic()


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

    Raises:
        RapidError: there are none, or a line is damaged.
    """
    path = Path(directory) / METRICS_FILE
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise RapidError(f"Cannot read the metrics '{path}': {error}. Train again.") from error
