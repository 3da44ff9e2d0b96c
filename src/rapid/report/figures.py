"""Pictures for a README or a paper, as files beside the page."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.text import Text

from rapid.evaluation.recording import Recording
from rapid.evaluation.statistics import Estimate
from rapid.evaluation.summary import SummaryRow, label_of, summarize, units
from rapid.evaluation.teacher_summary import TeacherSummary
from rapid.files import atomic_path
from rapid.pages.episodes import ACTION_WORDS
from rapid.report.curves import UNIFORM, series
from rapid.report.data import Entries, ReportData, paper_return
from rapid.scenarios import get_scenario

_ACCENT, _SOFT, _PAPER, _ROAD = "#1f6f8b", "#8a939b", "#a4490f", "#e4e6e6"
_LINES = ("#1f6f8b", "#d0672a", "#6b57b8", "#3c8f4e", "#b33a67", "#8b7a2b")


def write_figures(run: ReportData, directory: str | os.PathLike[str]) -> list[Path]:
    """Write the figures that the run has the parts for and return their paths: results, curves, episode.

    Raises:
        RapidError: the directory cannot be written.
    """
    drawn: dict[str, Figure | None] = {
        "results.png": results_figure(summarize(run.rows), run.lead),
        "curves.png": curves_figure(run.distill, run.adapt),
        "episode.png": episode_figure(run.recordings[0]) if run.recordings else None,
    }
    paths: list[Path] = []
    for name, figure in drawn.items():
        if figure is None:
            continue
        path = Path(directory) / name
        save_figure(figure, path)
        paths.append(path)
    return paths


def _figure(width: float, height: float) -> Figure:
    # Not pyplot: it keeps global state and may look for a display.
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _clean(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#c8ccd0")
    axes.tick_params(colors="#4a525a", labelsize=9)
    axes.grid(True, axis="x", color="#eceeef")
    axes.set_axisbelow(True)


def results_figure(rows: Sequence[SummaryRow], lead: str) -> Figure | None:
    """Return each agent's return, crash share and speed with their intervals, in the first scenario."""
    here = [row for row in rows if row.scenario == rows[0].scenario][::-1]
    if not here:
        return None
    scenario = get_scenario(here[0].scenario)
    figure = _figure(9.5, 1.5 + 0.34 * len(here))
    columns = (
        ("return", "episode_return", 1.0),
        ("crashed, %", "crashed", 100.0),
        ("mean speed, m/s", "mean_speed", 1.0),
    )
    grid = np.atleast_1d(figure.subplots(1, len(columns), sharey=True, width_ratios=(2, 1.2, 1.2)))
    for axes, (title, name, scale) in zip(grid, columns, strict=True):
        for y, row in enumerate(here):
            _whisker(axes, row.metrics[name], y, scale, _SOFT if row.is_reference else _ACCENT)
            paper = paper_return(row.origin, scenario) if name == "episode_return" else None
            if paper is not None:
                axes.plot(
                    paper.mean, y, "D", color=_PAPER, markersize=4.5, fillstyle="none", label="as the paper prints"
                )
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
        _clean(axes)
    grid[0].set_yticks(range(len(here)), [row.label for row in here])
    for label, row in zip(grid[0].get_yticklabels(), here, strict=True):
        label.set_fontweight("bold" if row.agent == lead else "normal")
    handles, labels = grid[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles[:1], labels[:1], fontsize=8, frameon=False, loc="outside upper right")
    figure.suptitle(here[0].scenario, fontsize=11, x=0.01, ha="left")
    figure.supxlabel(units(rows), fontsize=7.5, color="#5d6670", x=0.01, ha="left")
    return figure


def _whisker(axes: Axes, of: Estimate, y: float, scale: float, color: str) -> None:
    axes.plot([of.low * scale, of.high * scale], [y, y], color=color, linewidth=3, alpha=0.35, solid_capstyle="round")
    axes.plot(of.value * scale, y, "o", color=color, markersize=5)


def teachers_figure(summaries: Sequence[TeacherSummary]) -> Figure:
    """Return each teacher's return and crash share with their intervals, and its unsafe choices; a row a scenario."""
    scenarios = list(dict.fromkeys(summary.scenario for summary in summaries))
    groups = [[of for of in summaries if of.scenario == scenario][::-1] for scenario in scenarios]
    figure = _figure(9.5, 0.8 + sum(0.75 + 0.34 * len(group) for group in groups))
    grid = figure.subplots(len(groups), 3, squeeze=False, sharex="col", height_ratios=[1 + len(of) for of in groups])
    for row, scenario, group in zip(grid, scenarios, groups, strict=True):
        for y, of in enumerate(group):
            color = _SOFT if of.return_difference is None else _ACCENT
            _whisker(row[0], of.episode_return, y, 1.0, color)
            _whisker(row[1], of.crashed, y, 100.0, color)
            row[2].barh(y, of.unsafe_share * 100, 0.45, color=color)
        for axes, title in zip(row, ("return", "crashed, %", "unsafe choices, %"), strict=True):
            axes.set_title(f"{scenario}: {title}" if axes is row[0] else title, fontsize=10, loc="left")
            axes.set_ylim(-0.6, len(group) - 0.4)
            axes.set_yticks(range(len(group)), [of.teacher for of in group] if axes is row[0] else [""] * len(group))
            for label in axes.get_yticklabels():
                # A name is not ours: a dollar sign in it begins no formula.
                label.set_parse_math(False)
            _clean(axes)
    for axes in grid[0]:
        # Last, as it ends the fitting of the axis to what is drawn; it holds for the column.
        axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure atomically, in the format that the path's suffix names (png, svg).

    Names in it are shown as they are: a `$` in the name of an agent begins no formula.
    """
    for text in figure.findobj(Text):
        # Ticks of a logarithmic axis are formulas of matplotlib's own.
        text.set_parse_math(text.get_text().startswith(r"$\mathdefault"))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix.removeprefix("."), dpi=160, facecolor="white")


def curves_figure(distill: Mapping[str, Entries], adapt: Mapping[str, Entries]) -> Figure | None:
    """Return the learning curves of both phases and the robust term."""
    panels: list[tuple[str, str, dict[str, Any]]] = []
    for title, x, trainings, name in (
        ("return while distilling", "iteration", distill, "evaluation.return"),
        ("return while adapting", "environment step", adapt, "evaluation.return"),
        ("robust term", "iteration", distill, "robust"),
    ):
        lines = {agent: series(entries, name) for agent, entries in trainings.items()}
        lines = {agent: line for agent, line in lines.items() if any(value for _, value in line)}
        if lines:
            panels.append((title, x, lines))
    if not panels:
        return None
    figure = _figure(3.4 * len(panels) + 0.4, 2.8)
    for axes, (title, x, lines) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
        for number, (agent, line) in enumerate(lines.items()):
            times, values = zip(*line, strict=True)
            axes.plot(times, values, color=_LINES[number % len(_LINES)], linewidth=1.6, label=agent)
        if title == "robust term":
            axes.axhline(UNIFORM, color=_PAPER, linestyle="--", linewidth=1, label="ln 5: every action alike")
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.set_title(title, fontsize=10, loc="left")
        axes.set_xlabel(x, fontsize=8)
        axes.legend(fontsize=7.5, frameon=False)
        _clean(axes)
    return figure


def episode_figure(recording: Recording, moments: int = 4) -> Figure:
    """Return a few moments of an episode, one below the other: the road from above, moving with the ego."""
    last = len(recording.action_T)
    steps = np.unique(np.linspace(0, last, moments).round().astype(int))
    lanes = get_scenario(recording.scenario).lanes
    figure = _figure(9.5, 0.5 + len(steps) * (0.42 + 0.2 * lanes))
    for axes, step in zip(np.atleast_1d(figure.subplots(len(steps), 1)), steps, strict=True):
        scene = np.asarray(recording.obs_TVF[step], np.float64)
        ego = scene[0]
        axes.axhspan(-2, 4 * lanes - 2, color=_ROAD)
        for lane in range(lanes + 1):
            inner = 0 < lane < lanes
            axes.axhline(4 * lane - 2, color="white", linewidth=1.5, linestyle=(0, (5, 6)) if inner else "-")
        for row in range(len(scene) - 1, -1, -1):
            if scene[row, 0] > 0.5 and -30 <= scene[row, 1] - ego[1] <= 100:
                _car(axes, scene[row, 1] - ego[1], scene[row, 2], row)
        axes.set(xlim=(-30, 100), ylim=(4 * lanes - 2, -2), yticks=[], xticks=[], aspect="equal")
        axes.spines[:].set_visible(False)
        speed = f"{np.hypot(ego[3], ego[4]):.0f} m/s"
        does = ACTION_WORDS[int(recording.action_T[step])] if step < last else "crash" if recording.crashed else "end"
        axes.set_title(f"{step} s: {speed}, {does}", fontsize=8.5, loc="left", pad=2)
    figure.suptitle(f"{label_of(recording.agent)}, {recording.scenario}", fontsize=10, x=0.01, ha="left")
    return figure


def _car(axes: Axes, x: float, y: float, row: int) -> None:
    shape = FancyBboxPatch(
        (x - 2.2, y - 0.7), 4.4, 1.4, "round,pad=0.3", facecolor=_SOFT if row else _ACCENT, linewidth=0
    )
    axes.add_patch(shape)
    axes.text(x, y, str(row) if row else "ego", fontsize=6, color="white", ha="center", va="center", clip_on=True)
