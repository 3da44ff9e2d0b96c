"""What experiments cost: measured rates (``rates.toml``) as a table, and what large experiments come to."""

import tomllib
from functools import cache
from importlib import resources

from rapid.config import TeacherConfig
from rapid.experiments.cells import Cell, Collect, inputs, key
from rapid.experiments.compute import work_of
from rapid.experiments.learned import Setting, mixture, rapid
from rapid.experiments.tables import Facts, markdown
from rapid.scenarios import PAPER_SCENARIOS

UNITS = {
    "collect": "transition",
    "distill": "gradient step",
    "drive": "episode",
    "decide": "decision",
    "adapt": "gradient step; of `ppo`, environment step",
}
"""What the time of a kind of cell is counted in; of every other kind, the cell itself."""
MACHINES, CORES = (1, 10, 100), 2
EPISODE = 30
"""Decisions of an episode."""


@cache
def _measured() -> dict[str, dict[str, float]]:
    text = resources.files("rapid.experiments").joinpath("rates.toml").read_text(encoding="utf-8")
    return {part: {name: float(value) for name, value in found.items()} for part, found in tomllib.loads(text).items()}


def rates() -> dict[str, float]:
    """Return seconds of processor time per unit of work, by the names of :func:`rapid.experiments.compute.work_of`."""
    return _measured()["seconds"]


def sizes() -> dict[str, float]:
    """Return bytes on disk per unit of work, by the same names."""
    return _measured().get("bytes", {})


def rates_table() -> str:
    """Return the rates as Markdown."""
    rows = tuple(
        (f"`{name}`", UNITS.get(name.partition("/")[0], "cell"), _number(1e3 * value), _number(sizes().get(name)))
        for name, value in sorted(rates().items())
    )
    return markdown(Facts("rates", "Measured rates", ("work", "unit", "ms a unit", "bytes a unit"), rows))


def totals_table() -> str:
    """Return what large experiments come to, as Markdown, divided evenly among machines."""
    setting = Setting("strong", "full", PAPER_SCENARIOS[0])
    data = mixture(setting)
    random = Collect(PAPER_SCENARIOS[0], TeacherConfig(backend="scripted", model="random"), 1)
    wanted = (
        ("1,000 trainings of RAPID, recipe `strong`, its default plan `bold`", 1e3, _cost(rapid(setting, data))),
        ("1,000 of the plan `ppo`: 300K + 700K steps", 1e3, _cost(rapid(setting, data, plan="ppo"))),
        ("10⁶ decisions of the default teacher, driving", 1e6 / EPISODE, (rates().get("drive/teacher/none"), None)),
        ("10⁹ transitions of random driving", 1e9, _cost(random)),
    )
    rows: list[tuple[str, ...]] = []
    for what, count, (seconds, size) in wanted:
        hours = None if seconds is None else count * seconds / 3600
        each = ["–" if hours is None else f"{_number(hours / (CORES * machines))} h" for machines in MACHINES]
        rows.append((what, _number(hours), "–" if size is None else f"{_number(count * size / 1e9)} GB", *each))
    heads = tuple(f"{count} machine{'s' if count > 1 else ''} of {CORES} cores" for count in MACHINES)
    return markdown(
        Facts("totals", "Predicted from these rates", ("what", "core hours", "on disk", *heads), tuple(rows))
    )


def _cost(cell: Cell) -> tuple[float | None, float | None]:
    """Return seconds and bytes of a cell and everything it needs; None where a rate is missing."""
    found: dict[str, Cell] = {}
    waiting = [cell]
    while waiting:
        one = waiting.pop()
        found[key(one)] = one
        waiting += inputs(one)
    work = [work_of(one) for one in found.values()]
    if any(name not in rates() or name not in sizes() for name, _ in work):
        return None, None
    return sum(rates()[name] * amount for name, amount in work), sum(sizes()[name] * amount for name, amount in work)


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:,.0f}" if value >= 100 else f"{value:.2g}"
