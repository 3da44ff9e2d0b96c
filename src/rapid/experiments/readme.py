"""Marked blocks of README and the documentation, filled from the committed rows.

A block begins with ``<!-- table: NAME -->`` and ends with ``<!-- end -->``.

``rapid reproduce --readme`` writes them, ``--check`` says whether they are what the rows say.
"""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from rapid.errors import RapidError, did_you_mean
from rapid.evaluation.metrics import EpisodeRow, column
from rapid.experiments.costs import rates_table, totals_table
from rapid.experiments.exhibit import Request, rows_under
from rapid.experiments.exhibits import ALL
from rapid.experiments.figures import Lines, Router
from rapid.experiments.methods import METHODS
from rapid.experiments.paper import paper_result
from rapid.experiments.store import Store
from rapid.experiments.tables import Table, compact, markdown
from rapid.files import write_text
from rapid.scenarios import PAPER_SCENARIOS, get_scenario

BLOCK = re.compile(r"(<!-- table: ([\w:-]+) -->\n).*?(<!-- end -->)", re.S)
WORKS = ("slower", "blind", "teacher", "offline-dqn", "rapid-ppo", "rapid-squeezed", "rapid-monitored")
"""Rows of README's table; the paper's own row stands above them."""


def _number(rows: Sequence[EpisodeRow]) -> str:
    if not rows:
        return "–"
    crash = f"{float(np.mean(column(rows, 'crashed'))):.2f}".removeprefix("0")
    return f"{float(np.mean(column(rows, 'episode_return'))):.1f} ({crash})"


ALGORITHMS = {
    "distil": ("distilled", "distilled-without-robust", "bc", "offline-dqn"),
    "adapt": ("rapid-10k", "rapid", "rapid-ppo", "rapid-robust", "rapid-guided", "rapid-squeezed", "rapid-monitored"),
    "baselines": ("offline-dqn", "offline-ddqn", "cql", "bc", "online-dqn", "online-ddqn", "online-ppo", "mlp-ppo"),
}
"""Rows of the table on each algorithm's page."""
PRINTED = {
    "distilled": "rapid",
    "distilled-without-robust": "rapid_without_robust",
    "offline-ddqn": "ddqn",
    "cql": "cql",
}
"""Columns of the paper's offline table, which has no attacks; it is of the mixed data."""
PLACES = [(scenario, attack) for scenario in PAPER_SCENARIOS for attack in ("none", "pgd")]


def works(store: Store) -> str:
    """Return README's table: what each driver earns, clean and under PGD, in the paper's three scenarios."""
    lines = [["*the paper's RAPID*", *_paper("RAPID")]]
    for name in WORKS:
        label = METHODS[name].label
        lines.append([f"**{label}**" if name == WORKS[-1] else label, *_ours(store, name)])
    return _lines(lines)


def algorithm(store: Store, page: str) -> str:
    """Return the table of an algorithm's page: ours, and below it what the paper prints for the same."""
    lines: list[list[str]] = []
    for name in ALGORITHMS[page]:
        method, ours = METHODS[name], _ours(store, name)
        if set(ours) != {"–"}:
            lines.append([method.label, *ours])
        paper = _paper("RAPID" if name == "rapid-10k" else method.printed, PRINTED.get(name, ""))
        if set(paper) != {"–"} and name != "rapid":
            lines.append([f"*the paper's {method.printed or method.label.partition(',')[0]}*", *paper])
    return _lines(lines)


def _ours(store: Store, name: str) -> list[str]:
    """Return a method's cells, from the rows of the recipe `strong`."""
    method, cells = METHODS[name], list[str]()
    for scenario, attack in PLACES:
        rows, _ = rows_under(Request("strong", "full"), store, scenario, method, attack)
        cells.append(_number(rows))
    return cells


def _paper(method: str, offline: str = "") -> list[str]:
    """Return the paper's cells: of its table of attacks, or the column `offline` of its offline table."""
    cells: list[str] = []
    for scenario, attack in PLACES:
        if offline:
            said = paper_result("offline", offline, scenario=scenario, dataset="mixed") if attack == "none" else None
        else:
            said = paper_result("attack", attack, scenario=scenario, method=method) if method else None
        cells.append(f"{said.mean:.1f}" if said else "–")
    return cells


def _lines(rows: list[list[str]]) -> str:
    heads = [f"lane-{get_scenario(name).lanes}, {'PGD' if attack == 'pgd' else 'clean'}" for name, attack in PLACES]
    first, *rest = ("| " + " | ".join(line) + " |" for line in [["", *heads], *rows])
    return "\n".join([first, "|" + "---|" * (len(heads) + 1), *rest])


def _exhibit(name: str, recipe: str, store: Store) -> str:
    exhibit = ALL[name]
    shown = exhibit.show(Request(recipe, "full"), store, exhibit)
    tables = [each.data() if isinstance(each, Lines | Router) else each for each in shown]
    parts = [compact(table) if isinstance(table, Table) else markdown(table) for table in tables if table.rows]
    return "\n\n".join(parts)


BLOCKS: dict[str, Callable[[Store], str]] = {
    "works": works,
    **{f"algorithm-{page}": partial(algorithm, page=page) for page in ALGORITHMS},
    "rates": lambda store: rates_table(),
    "totals": lambda store: totals_table(),
}
"""Blocks with a form of their own; others are EXHIBIT:RECIPE."""


def filled(text: str, store: Store, path: Path) -> str:
    """Return a page with its blocks filled.

    Raises:
        RapidError: a block names nothing that exists.
    """

    def fill(match: re.Match[str]) -> str:
        name = match[2]
        exhibit, _, recipe = name.partition(":")
        if name in BLOCKS:
            body = BLOCKS[name](store)
        elif exhibit in ALL:
            body = _exhibit(exhibit, recipe or ALL[exhibit].recipes[0], store)
        else:
            raise RapidError(f"'{path}' has a block '{name}'{did_you_mean(name, (*BLOCKS, *ALL))} Correct its name.")
        return f"{match[1]}{body}\n{match[3]}"

    return BLOCK.sub(fill, text)


def pages(root: Path) -> list[Path]:
    """Return the pages under `root` that have blocks."""
    found = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    return [path for path in found if path.is_file() and BLOCK.search(path.read_text(encoding="utf-8"))]


def update(root: Path, store: Store, check: bool) -> list[Path]:
    """Fill the blocks of every page, or with `check` only look; return the pages that were not up to date."""
    stale: list[Path] = []
    for path in pages(root):
        before = path.read_text(encoding="utf-8")
        after = filled(before, store, path)
        if after != before:
            stale.append(path)
            if not check:
                write_text(path, after)
    return stale
