"""Tables as data, and as text, Markdown and HTML: what is obtained stands beside what is printed.

A verdict is given where at least five trainings were driven: `inside` where the paper's mean lies in our 95 % interval,
`above` and `below` where the interval lies above or below it; else `insufficient`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from rapid.evaluation.metrics import EpisodeRow, column
from rapid.evaluation.statistics import ENOUGH_SEEDS, Estimate, estimate
from rapid.evaluation.summary import aligned
from rapid.experiments.paper import PaperResult
from rapid.pages.markup import Markup, join, tag

IQM_RESAMPLES = 1_000
"""Of the bootstrap behind the interval of an interquartile mean: a page has hundreds of them, and each sorts."""
Verdict = Literal["inside", "above", "below", "insufficient", ""]


@dataclass(frozen=True)
class Entry:
    """One cell of a table: our return, and the paper's."""

    mean: Estimate | None = None
    iqm_of: Callable[[], Estimate] | None = None
    """Makes the interquartile mean; its interval takes as long as the others together, and README shows none."""
    crash: Estimate | None = None
    printed: PaperResult | None = None
    failed: str = ""
    """Why there is nothing, or less than there should be."""

    @cached_property
    def iqm(self) -> Estimate | None:
        """The interquartile mean, made once for all forms of a table."""
        return self.iqm_of() if self.iqm_of else None

    @property
    def verdict(self) -> Verdict:
        """How ours compares with the paper's; empty where one of them is missing."""
        if self.mean is None or self.printed is None:
            return ""
        if self.mean.training_seeds < ENOUGH_SEEDS:
            return "insufficient"
        if self.mean.low > self.printed.mean:
            return "above"
        return "below" if self.mean.high < self.printed.mean else "inside"


def entry(rows: Sequence[EpisodeRow], printed: PaperResult | None = None, failed: str = "") -> Entry:
    """Return what episodes of one agent under one attack say."""
    if not rows:
        return Entry(printed=printed, failed=failed or "not driven")
    spawns = [row.seed for row in rows]
    seeds = [row.training_seed for row in rows]
    returns, crashes = column(rows, "episode_return"), column(rows, "crashed")
    return Entry(
        estimate(returns, spawns, seeds),
        lambda: estimate(returns, spawns, seeds, statistic="iqm", resamples=IQM_RESAMPLES),
        estimate(crashes, spawns, seeds),
        printed,
        failed,
    )


@dataclass(frozen=True)
class Table:
    """Rows of entries under columns; the first cells of a row say what it is."""

    id: str
    caption: str
    heads: tuple[str, ...]
    """Names of the first cells."""
    columns: tuple[str, ...]
    rows: tuple[tuple[tuple[str, ...], tuple[Entry, ...]], ...]
    notes: tuple[str, ...] = field(default=())

    @property
    def complete(self) -> bool:
        """Whether no entry is missing."""
        return all(each.mean is not None for _, entries in self.rows for each in entries)


@dataclass(frozen=True)
class Facts:
    """A table of words: settings, seconds, prompts."""

    id: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = field(default=())


def ours(each: Entry) -> str:
    """Return our mean with its interval, the IQM, the number of trainings or spawns, and what of them is missing."""
    if each.mean is None:
        return f"– ({each.failed})" if each.failed else "–"
    middle = "" if each.iqm is None else f", IQM {each.iqm.value:.1f}{span(each.iqm)}"
    crash = "" if each.crash is None else f", crash {each.crash.value:.2f}"
    gap = f"; {each.failed}" if each.failed else ""
    return f"{each.mean.value:.1f}{span(each.mean)}{middle}{crash} ({count(each.mean)}{gap})"


def parts(each: Entry) -> list[str]:
    """Return an entry as short lines: both means, crashes, episodes, the paper's and the verdict, what is missing."""
    said = " ".join(filter(None, (printed(each), each.verdict)))
    if each.mean is None:
        return [part for part in ("–", each.failed, said) if part]
    middle = "" if each.iqm is None else f"IQM {each.iqm.value:.1f}{span(each.iqm)}"
    crash = "" if each.crash is None else f"crash {each.crash.value:.2f} "
    lines = (f"{each.mean.value:.1f}{span(each.mean)}", middle, f"{crash}({count(each.mean)})", said, each.failed)
    return [part for part in lines if part]


def span(found: Estimate) -> str:
    """Return an interval in brackets after a space; empty where there is none."""
    return "" if np.isnan(found.low) else f" [{found.low:.1f}, {found.high:.1f}]"


def count(found: Estimate) -> str:
    """Return trainings × spawns, or only the spawns of what was never trained."""
    return f"{found.training_seeds}×{found.spawns}" if found.training_seeds else f"{found.spawns}"


def printed(each: Entry) -> str:
    """Return what the paper prints."""
    return "" if each.printed is None else f"{each.printed.mean:.2f} ± {each.printed.spread:.2f}"


def _cells(each: Entry) -> str:
    parts = [ours(each), printed(each), each.verdict]
    return " | ".join(part for part in parts if part)


def text(table: Table | Facts) -> str:
    """Return a table for a terminal."""
    if isinstance(table, Facts):
        lines = [list(table.columns), *(list(row) for row in table.rows)]
    else:
        lines = [[*table.heads, *table.columns]]
        lines += [[*names, *map(_cells, entries)] for names, entries in table.rows]
    return "\n".join([table.caption, "", aligned(lines), *table.notes])


def markdown(table: Table | Facts) -> str:
    """Return a table as Markdown."""
    if isinstance(table, Facts):
        heads, body = list(table.columns), [list(row) for row in table.rows]
    else:
        heads = [*table.heads, *table.columns]
        body = [[*names, *map(_cells, entries)] for names, entries in table.rows]
    notes = [f"\n{note}" for note in table.notes]
    return "\n".join([f"**{table.caption}**", "", *_pipes(heads, body), *notes])


def _pipes(heads: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "·").replace("\n", "<br>") for cell in cells) + " |"

    return [line(heads), "|" + "---|" * len(heads), *map(line, body)]


def short(each: Entry) -> str:
    """Return our mean with its interval, the crash share in brackets, and what the paper prints in italics."""
    said = "" if each.printed is None else f" *{each.printed.mean:.1f}*"
    if each.mean is None:
        return f"–{said}"
    crash = "" if each.crash is None else f" ({each.crash.value:.2f})".replace("(0.", "(.")
    return f"{each.mean.value:.1f}{span(each.mean)}{crash}{said}"


def _few(entries: Sequence[Entry]) -> str:
    """Return how many trainings a row has, where they are too few for a verdict."""
    most = max(each.mean.training_seeds for each in entries if each.mean is not None)
    return f"({most} training{'s' if most > 1 else ''})" if 0 < most < ENOUGH_SEEDS else ""


def compact(table: Table) -> str:
    """Return a table of scenarios and methods as Markdown that fits a page: one table for each scenario.

    Methods without any episode in a scenario are named below its table.
    """
    parts: list[str] = []
    for scenario in dict.fromkeys(names[0] for names, _ in table.rows):
        rows = [(names[1:], entries) for names, entries in table.rows if names[0] == scenario]
        shown = [(names, entries) for names, entries in rows if any(each.mean is not None for each in entries)]
        missing = [", ".join(names) for names, entries in rows if (names, entries) not in shown]
        if shown:
            body = [[" ".join(filter(None, (*names, _few(entries)))), *map(short, entries)] for names, entries in shown]
            parts.append("\n".join([f"**{scenario}**", "", *_pipes([*table.heads[1:], *table.columns], body)]))
        if missing:
            parts.append(f"Not measured on {scenario}: {'; '.join(missing)}.")
    return "\n\n".join([*parts, *table.notes])


_MARKS = {"inside": "≈", "above": "▲", "below": "▼", "insufficient": "?", "": ""}


def html(table: Table | Facts) -> Markup:
    """Return a table as HTML, everything in it escaped."""
    if isinstance(table, Facts):
        head = tag("tr", *(tag("th", name, scope="col") for name in table.columns))
        body = [
            tag("tr", *(tag("td", tag("pre", cell) if "\n" in cell else cell) for cell in row)) for row in table.rows
        ]
    else:
        head = tag("tr", *(tag("th", name, scope="col") for name in (*table.heads, *table.columns)))
        body = [
            tag("tr", *(tag("th", name, scope="row") for name in names), *map(_html_entry, entries))
            for names, entries in table.rows
        ]
    notes = [tag("p", note, class_="note") for note in table.notes]
    return join([tag("div", tag("table", tag("thead", head), tag("tbody", *body)), class_="scroll"), *notes])


def _html_entry(each: Entry) -> Markup:
    if each.mean is None:
        said = tag("small", f"paper {printed(each)}", class_="line paper") if each.printed else ""
        return tag("td", "–", tag("small", each.failed), said, class_="missing")
    mean = each.mean
    parts: list[Markup] = [tag("b", f"{mean.value:.1f}"), tag("small", span(mean))]
    if each.iqm is not None:
        parts.append(tag("small", f"IQM {each.iqm.value:.1f}{span(each.iqm)}", class_="line"))
    if each.crash is not None:
        parts.append(tag("small", f"crash {each.crash.value:.2f}", class_="line"))
    parts.append(tag("small", f"{count(mean)}{'' if mean.training_seeds else ' spawns'}", class_="line"))
    if each.printed is not None:
        parts.append(tag("small", f"paper {printed(each)}", class_="line paper"))
        word = each.verdict if each.verdict != "insufficient" else f"{mean.training_seeds} of {ENOUGH_SEEDS} seeds"
        parts.append(tag("small", f"{_MARKS[each.verdict]} {word}", class_=f"line verdict {each.verdict}"))
    if each.failed:
        parts.append(tag("small", each.failed, class_="line gap"))
    return tag("td", *parts, title=mean.unit)
