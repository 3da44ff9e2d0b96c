"""Where a verb puts what it makes: a directory of its own, that says what was asked for, and nothing of anybody else's.

A directory that a command made holds ``request.json``. The same command goes on there; another is told what differs.
Without ``--out`` it then gets a directory beside it, named after the hash of what was asked for; with ``--force`` what
is there is replaced, if the verb made all of it.
"""

import contextlib
import json
import shutil
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from rapid.config_io import differences
from rapid.errors import DamagedError, RapidError
from rapid.files import content_hash, read_json, write_json
from rapid.locks import LOCK_FILE, exclusive

REQUEST_FILE = "request.json"
DATASET = ("dataset.json", "transitions.parquet", "teacher_log.parquet", "memory.jsonl", "collecting")
_RECORD = ("metrics.jsonl", "checkpoint*.safetensors", "tracking-*", "tensorboard", "wandb")
TRAINING = ("agent", "seed-*", "together", "ppo", *_RECORD)
EVALUATION = (
    "report.html",
    "parts",
    "episodes.parquet",
    "summary.*",
    "worst.*",
    "*.png",
    "*.svg",
    "adversar*",
    "sweep.*",
)

RUN = ("run.json", "config.toml", "steps", "collect", "mix", "distill", "adapt", "evaluate", "figures", "report.html")


class ClashError(RapidError):
    """A place is taken by something else."""


def place_for(usual: str, request: dict[str, Any]) -> Path:
    """Return where a command goes that was given no place: `usual`, or a directory beside it if that is taken."""
    place, other = Path(usual), beside(usual, request)
    if other.exists() or (place.exists() and (not place.is_dir() or _clash(place, _plain(request)))):
        return other
    return place


def beside(usual: str, request: dict[str, Any]) -> Path:
    """Return the directory beside `usual` that is named after what is asked for."""
    return Path(f"{usual}-{content_hash(_plain(request))[:8]}")


@contextmanager
def claimed(
    place: Path, request: dict[str, Any], makes: Sequence[str], *, force: bool = False, keep: Iterable[Path] = ()
) -> Generator[Path, None, None]:
    """Hold a directory for what `request` asks for while the block runs.

    Args:
        place: the directory; made if need be, and gone again if nothing came of it.
        request: plain values that say what is made, by their contents.
        makes: patterns of names that the verb makes in it: what `force` may remove.
        force: remove what another command made.
        keep: what the verb reads: it is never removed.

    Raises:
        ClashError: something else is there; the message says what, or what was asked for differently.
        RapidError: another process is at work there, or it cannot be written.
    """
    request = _plain(request)
    with exclusive(place):
        if fault := _clash(place, request):
            if not force:
                raise ClashError(
                    f"'{place}' {fault}. Nothing was changed. Choose another --out, or replace what is there with "
                    "--force."
                )
            clear(place, makes, keep)
        if not (place / REQUEST_FILE).exists():
            write_json(place / REQUEST_FILE, request, sealed=True)
        try:
            yield place
        except BaseException:
            if set(_entries(place)) == {REQUEST_FILE}:
                with contextlib.suppress(OSError):
                    (place / REQUEST_FILE).unlink()
            raise


def clear(place: Path, makes: Sequence[str], keep: Iterable[Path] = ()) -> None:
    """Remove what a verb made in a directory.

    Raises:
        ClashError: something is there that it does not make, or that is to be kept; nothing was removed.
    """
    foreign = [name for name in _entries(place) if not any(fnmatch(name, each) for each in (REQUEST_FILE, *makes))]
    if foreign:
        raise ClashError(
            f"'{place}' also holds {_named(foreign)}, which this verb does not make. --force removed nothing: move it "
            "away, or choose another --out."
        )
    inside = [path for path in keep if place.resolve() in (path.resolve(), *path.resolve().parents)]
    if inside:
        raise ClashError(
            f"'{inside[0]}' is read by this command and lies in '{place}', which --force would remove. Choose another "
            "--out."
        )
    # The record first: a kill in between leaves nothing that looks whole.
    for name in sorted(_entries(place), key=lambda name: name not in (REQUEST_FILE, "run.json", "dataset.json")):
        path = place / name
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def check_new_file(path: Path, force: bool) -> None:
    """Raise ClashError if a file is there and may not be replaced."""
    if path.exists() and not force:
        raise ClashError(f"'{path}' exists already. Choose another --out, or replace it with --force.")


def _clash(place: Path, request: dict[str, Any]) -> str:
    """Return what is wrong with a place for a request; nothing if it is empty or of the same request."""
    names = _entries(place)
    if not names:
        return ""
    if REQUEST_FILE not in names:
        return f"holds {_named(names)}, and no {REQUEST_FILE} that says that this command made it"
    try:
        before = read_json(place / REQUEST_FILE, "record of a request")
    except DamagedError:
        return f"has a damaged {REQUEST_FILE}, so that nobody can tell what it holds"
    return "" if before == request else f"was made by another request ({differences(before, request)})"


def _entries(place: Path) -> list[str]:
    return sorted(path.name for path in place.iterdir() if path.name != LOCK_FILE)


def _named(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:4])
    return shown + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _plain(request: dict[str, Any]) -> dict[str, Any]:
    """Return values as JSON gives them back."""
    return json.loads(json.dumps(request))
