"""The datasets that come with the package; ``shipped:SCENARIO/SET`` stands for one wherever a path is expected."""

import os
from pathlib import Path

from rapid.errors import RapidError, did_you_mean

SHIPPED = "shipped"
"""The name of all of them together."""
_FOLDER = Path(__file__).resolve().parents[1] / SHIPPED


def shipped_sets() -> tuple[str, ...]:
    """Return their names, SCENARIO/SET, sorted."""
    return tuple(sorted(path.parent.relative_to(_FOLDER).as_posix() for path in _FOLDER.glob("*/*/dataset.json")))


def dataset_folder(path: str | os.PathLike[str]) -> Path:
    """Return the directory that `path` stands for: a shipped set's after ``shipped:``, else the path itself.

    Raises:
        RapidError: no set of this name is shipped.
    """
    prefix, colon, name = os.fspath(path).partition(":")
    if prefix != SHIPPED or not colon:
        return Path(path)
    if name not in shipped_sets():
        raise RapidError(
            f"No dataset '{name}' is shipped{did_you_mean(name, shipped_sets())} Shipped: {', '.join(shipped_sets())}."
        )
    return _FOLDER / name
