"""The paper beside us: every number of its tables, as data."""

import tomllib
from functools import cache
from importlib import resources
from typing import Any, NamedTuple


class PaperResult(NamedTuple):
    """A return as the paper prints it; what its ± is, it does not say."""

    mean: float
    spread: float


@cache
def paper_numbers() -> dict[str, Any]:
    """Return the content of ``paper.toml``: tables `attack`, `offline`, `architecture` and `beta` with their `rows`,
    and `environment`, `hyperparameters` and `text`. Treat it as read-only.
    """
    return tomllib.loads(resources.files("rapid.experiments").joinpath("paper.toml").read_text(encoding="utf-8"))


def paper_result(table: str, column: str, **where: Any) -> PaperResult | None:
    """Return one result, such as ``paper_result("attack", "pgd", scenario="lane-3-density-2", method="RAPID")``.

    None where the paper has no such row or column.
    """
    for row in paper_numbers()[table]["rows"]:
        if all(row.get(key) == value for key, value in where.items()) and isinstance(row.get(column), list):
            return PaperResult(*row[column])
    return None
