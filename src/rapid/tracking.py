"""Training metrics in TensorBoard, Weights & Biases or Trackio: copies of the rows that go to ``metrics.jsonl``.

That file stays the source. What was copied is remembered beside it, so that a training that goes on repeats no row and
leaves none out, also where it was killed between the two. Nothing leaves the machine unless the user asks for it: W&B
writes offline runs (``wandb sync`` uploads them later) unless WANDB_MODE says otherwise, Trackio its local database.
"""

import hashlib
import importlib.util
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self

from rapid import files
from rapid.errors import RapidError, how_to_install

Tracking = Literal["none", "tensorboard", "wandb", "trackio"]
PROJECT = "rapid"
_EXTRAS = {"tensorboard": "tracking", "wandb": "wandb", "trackio": "trackio"}
"""The extra of this package that brings each."""
STEPS = ("iteration", "step")
"""What counts the progress of phase 2 and of phase 3 in their rows."""


class Backend(Protocol):
    """Where numbers go."""

    def log(self, numbers: dict[str, float], step: int) -> None:
        """Keep the numbers of one step."""
        ...

    def close(self) -> None:
        """Write what is not written yet."""
        ...


def check_tracking(kind: Tracking) -> None:
    """Look whether a tracker can be had.

    Raises:
        RapidError: its package is not installed.
    """
    if kind != "none" and importlib.util.find_spec(kind) is None:
        raise RapidError(
            f"Tracking with '{kind}' needs the package '{kind}', which is not installed. Install it: "
            f"{how_to_install(_EXTRAS[kind])}; or use --tracking none."
        )


class Tracker:
    """Copies rows of metrics to a tracker; of kind `none` it does nothing. A context manager.

    Args:
        kind: the tracker.
        directory: of the training; what was copied is remembered there.
        name: of the run.
        settings: shown beside the run; other settings are another run.

    Raises:
        RapidError: the tracker is not installed or does not start.
    """

    def __init__(
        self, kind: Tracking, directory: str | os.PathLike[str], name: str, settings: Mapping[str, Any]
    ) -> None:
        self._backend: Backend | None = None
        if kind == "none":
            return
        check_tracking(kind)
        self._memory = Path(directory) / f"tracking-{kind}.json"
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
        memory: dict[str, Any] = files.read_json(self._memory, "tracking") if self._memory.exists() else {}
        if memory.get("settings") != digest:
            memory = {"run": secrets.token_hex(4), "settings": digest, "step": 0}
        self._state = memory
        try:
            self._backend = _BACKENDS[kind](Path(directory), f"{name}-{memory['run']}", settings)
        except Exception as error:  # Each of these packages raises its own.
            raise RapidError(
                f"Tracking with '{kind}' does not start: {error}. See its documentation, or use --tracking none."
            ) from error
        files.write_json(self._memory, self._state)

    def log(self, row: Mapping[str, Any]) -> None:
        """Copy a row of metrics, unless it was copied before."""
        step = next((int(row[key]) for key in STEPS if key in row), 0)
        if self._backend is None or step <= self._state["step"]:
            return
        self._backend.log(numbers_of(row), step)
        self._state["step"] = step
        files.write_json(self._memory, self._state)

    def close(self) -> None:
        """End the run."""
        if self._backend is not None:
            self._backend.close()
            self._backend = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def numbers_of(row: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return the numbers of a row by name, those of a table in it as ``table/name``; what is no number is left out."""
    numbers: dict[str, float] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            numbers |= numbers_of(value, f"{prefix}{key}/")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            numbers[f"{prefix}{key}"] = float(value)
    return numbers


class _TensorBoard:
    """Event files in ``tensorboard/``: ``tensorboard --logdir DIRECTORY``."""

    def __init__(self, directory: Path, run: str, settings: Mapping[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(directory / "tensorboard" / run))

    def log(self, numbers: dict[str, float], step: int) -> None:
        for name, number in numbers.items():
            self._writer.add_scalar(name, number, step)
        # What is remembered as copied must be on disk.
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class _Wandb:
    """A run in ``wandb/``."""

    def __init__(self, directory: Path, run: str, settings: Mapping[str, Any]) -> None:
        mode = os.environ.get("WANDB_MODE", "offline")
        if mode == "offline":
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        wandb: Any = importlib.import_module("wandb")
        # An offline run is resumed by its id when it is uploaded; only the server knows of `resume`.
        resume = "allow" if mode == "online" else None
        self._run: Any = wandb.init(
            project=PROJECT, id=run, name=run, dir=str(directory), mode=mode, resume=resume, config=dict(settings)
        )

    def log(self, numbers: dict[str, float], step: int) -> None:
        self._run.log(numbers, step=step)

    def close(self) -> None:
        self._run.finish()


class _Trackio:
    """A run in Trackio's local database: ``trackio show``."""

    def __init__(self, directory: Path, run: str, settings: Mapping[str, Any]) -> None:
        for name, value in (("GRADIO_ANALYTICS_ENABLED", "False"), ("HF_HUB_DISABLE_TELEMETRY", "1")):
            os.environ.setdefault(name, value)
        self._trackio: Any = importlib.import_module("trackio")
        self._trackio.init(project=PROJECT, name=run, resume="allow", config=dict(settings))

    def log(self, numbers: dict[str, float], step: int) -> None:
        self._trackio.log(numbers, step=step)

    def close(self) -> None:
        self._trackio.finish()


_BACKENDS = {"tensorboard": _TensorBoard, "wandb": _Wandb, "trackio": _Trackio}
