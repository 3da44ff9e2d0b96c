"""Two figures of what survives attacks, from rows that are kept: clean return against worst case, and the sweep of ε.

In the first each agent is a point: its mean return without attack, and the mean over spawns of the least return under
any of the attacks in the rows. The second is what `rapid evaluate --attacks sweep` draws. Nothing is driven here.

    rapid evaluate AGENT ... --attacks paper --spawns 200 --out runs/under-attack
    rapid evaluate AGENT ... --attacks sweep --spawns 30 --out runs/sweep
    python benchmarks/robustness_figures.py runs/under-attack/episodes.parquet runs/sweep/episodes.parquet
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, column, load_rows
from rapid.evaluation.statistics import Estimate, estimate
from rapid.evaluation.summary import aligned, label_of, with_interval
from rapid.evaluation.worst import worst_rows
from rapid.report.figures import save_figure
from rapid.report.sweep import sweep_figure

FLOORS = ("slower", "immune", "blind")
"""Drivers that no lie about other cars misleads; drawn as squares."""
COLORS = (
    *("#1f6f8b", "#6b57b8", "#d0672a", "#3c8f4e", "#b33a67", "#8a939b", "#4a525a", "#8b7a2b"),
    *("#12b5cb", "#e52592", "#7cb342", "#f9ab00"),
)
MARKERS = "oD^v"
"""Where colours begin anew, other marks do as well: no two agents look the same."""


class Point(NamedTuple):
    """One agent of the trade-off."""

    agent: str
    clean: Estimate
    worst: Estimate
    crashed: Estimate
    """In the worst case."""


def points(rows: Sequence[EpisodeRow]) -> list[Point]:
    """Return each agent's clean return and worst case over all attacks in the rows.

    Raises:
        RapidError: there are no rows, several scenarios, or an agent without rows under no attack.
    """
    if len({row.scenario for row in rows}) != 1:
        raise RapidError("A trade-off is drawn of one scenario. Give the rows of one.")
    found: list[Point] = []
    for agent in dict.fromkeys(row.agent for row in rows):
        own = [row for row in rows if row.agent == agent]
        clean, worst = [row for row in own if row.attack == "none"], worst_rows(own)
        if not clean:
            raise RapidError(f"'{agent}' was not driven without attack. Measure it with --attacks paper.")
        found.append(
            Point(agent, _mean(clean, "episode_return"), *(_mean(worst, n) for n in ("episode_return", "crashed")))
        )
    return found


def _mean(rows: Sequence[EpisodeRow], name: str) -> Estimate:
    return estimate(column(rows, name), [row.seed for row in rows], [row.training_seed for row in rows])


def trade_off(rows: Sequence[EpisodeRow]) -> Figure:
    """Return the figure of clean return against worst case, with 95 % intervals."""
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, point in enumerate(points(rows)):
        spread = [[[each.value - each.low], [each.high - each.value]] for each in (point.clean, point.worst)]
        axes.errorbar(
            point.clean.value,
            point.worst.value,
            yerr=spread[1],
            xerr=spread[0],
            color=COLORS[place % len(COLORS)],
            marker="s" if point.agent in FLOORS else MARKERS[place // len(COLORS) % len(MARKERS)],
            linestyle="none",
            markersize=6,
            elinewidth=1,
            label=label_of(point.agent),
        )
    low, high = axes.get_xlim()
    axes.plot((low, high), (low, high), color="#8a939b", linewidth=0.7, linestyle=":")
    axes.set_xlim(low, high)
    axes.set_ylim(0, high)
    axes.set_xlabel("return without attack")
    axes.set_ylabel("mean over spawns of the least return under these attacks")
    axes.set_title(
        f"{rows[0].scenario}; dotted: nothing lost; squares: floors that no lie misleads", fontsize=9, loc="left"
    )
    axes.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#eceeef")
    axes.set_axisbelow(True)
    return figure


def table(rows: Sequence[EpisodeRow]) -> str:
    """Return the points as aligned text."""
    lines = [["agent", "clean", "worst case", "crash %"]]
    for point in points(rows):
        lines.append(
            [
                label_of(point.agent),
                with_interval(point.clean),
                with_interval(point.worst),
                with_interval(point.crashed, 0, 100),
            ]
        )
    return aligned(lines)


def main() -> None:
    """Read the rows and write ``trade-off`` and, with rows of a sweep, ``sweep``, each as PNG and SVG."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("under_attack", type=Path, help="rows of agents, without attack and under some")
    parser.add_argument("sweep", type=Path, nargs="?", help="rows of agents under attacks of several sizes")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    chosen = parser.parse_args()
    rows = load_rows(chosen.under_attack)
    figures = {"trade-off": trade_off(rows)}
    if chosen.sweep is not None:
        swept = sweep_figure(load_rows(chosen.sweep))
        if swept is None:
            raise RapidError(f"'{chosen.sweep}' has too few sizes of attacks. Measure with --attacks sweep.")
        figures["sweep"] = swept
    print(table(rows))
    for name, figure in figures.items():
        for kind in ("png", "svg"):
            save_figure(figure, chosen.out / f"{name}.{kind}")


if __name__ == "__main__":
    try:
        main()
    except RapidError as error:
        sys.exit(f"error: {error}")
