"""The worst case over the size of the attack: a table and a plot."""

from collections.abc import Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rapid.evaluation.metrics import EpisodeRow, column
from rapid.evaluation.statistics import Estimate, estimate
from rapid.evaluation.summary import aligned, label_of, with_interval
from rapid.evaluation.worst import ENOUGH, Worst, brief, worst_cases

_LINES = ("#1f6f8b", "#d0672a", "#6b57b8", "#3c8f4e", "#b33a67", "#8b7a2b", "#8a939b", "#4a525a")


def swept(rows: Sequence[EpisodeRow]) -> list[Worst]:
    """Return the worst cases of the first scenario over sizes alike in all else, if there are enough sizes."""
    cases = [case for case in worst_cases(rows) if case.threat.radius > 0 and case.scenario == rows[0].scenario]
    groups: dict[tuple[str, ...], list[Worst]] = {}
    for case in cases:
        groups.setdefault(case.threat[3:], []).append(case)
    largest = max(groups.values(), key=lambda group: len({case.threat.radius for case in group}), default=[])
    return largest if len({case.threat.radius for case in largest}) >= ENOUGH else []


def sweep_text(rows: Sequence[EpisodeRow]) -> str:
    """Return the worst case of each agent for each size as aligned text; empty if there are too few sizes."""
    cases = swept(rows)
    if not cases:
        return ""
    agents = list(dict.fromkeys(case.agent for case in cases))
    lines = [["worst case within", "clean", *(case_words(radius) for radius in _radii(cases))]]
    for agent in agents:
        cells = [brief(case_of(cases, agent, radius)) for radius in _radii(cases)]
        lines.append([label_of(agent), with_interval(_clean(rows, agent, "episode_return")), *cells])
    return aligned(lines)


def sweep_figure(rows: Sequence[EpisodeRow]) -> Figure | None:
    """Return return and crash share in the worst case over the size; None if there are too few sizes."""
    cases = swept(rows)
    if not cases:
        return None
    # Not pyplot: it keeps global state and may look for a display.
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = (("return", "episode_return", 1.0), ("crashed, %", "crashed", 100.0))
    for axes, (title, name, scale) in zip(figure.subplots(1, 2), panels, strict=True):
        for place, agent in enumerate(dict.fromkeys(case.agent for case in cases)):
            own = sorted((case for case in cases if case.agent == agent), key=lambda case: case.threat.radius)
            sizes = [case.threat.radius for case in own]
            numbers: list[Estimate] = [getattr(case, name) for case in own]
            color = _LINES[place % len(_LINES)]
            values = [number.value * scale for number in numbers]
            axes.plot(sizes, values, color=color, marker="o", markersize=3.5, label=label_of(agent))
            low, high = [number.low * scale for number in numbers], [number.high * scale for number in numbers]
            axes.fill_between(sizes, low, high, color=color, alpha=0.12, linewidth=0)
            axes.axhline(_clean(rows, agent, name).value * scale, color=color, linewidth=0.7, linestyle=":")
        axes.set_xscale("log")
        axes.set_xticks(_radii(cases), [f"{radius:g}\n{200 * radius:g} m" for radius in _radii(cases)])
        axes.minorticks_off()
        axes.set_xlabel("ε, and what it is along the road")
        axes.set_title(title, fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(True, color="#eceeef")
        axes.set_axisbelow(True)
    figure.axes[0].legend(fontsize=8, frameon=False)
    title = f"{cases[0].scenario}: worst case over attacks; dotted: without attack"
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return figure


def sweep_charts(rows: Sequence[EpisodeRow]) -> list[dict[str, Any]]:
    """Return return and crash share in the worst case over the size for a page's script; none of too few sizes."""
    cases = swept(rows)
    agents = list(dict.fromkeys(case.agent for case in cases))
    return [
        {
            "id": f"worst-{name}",
            "title": f"{title} in the worst case, by the size of the attack",
            "x": "metres along the road",
            "y": title.lower(),
            "zero": True,
            "marks": [],
            "series": [
                {
                    "name": label_of(agent),
                    "points": [
                        (0.0, _clean(rows, agent, name).value),
                        *(
                            (200 * radius, getattr(case, name).value)
                            for radius in _radii(cases)
                            if (case := case_of(cases, agent, radius)) is not None
                        ),
                    ],
                }
                for agent in agents
            ],
        }
        for title, name in (("Return", "episode_return"), ("Crash share", "crashed"))
        if cases
    ]


def case_of(cases: Sequence[Worst], agent: str, radius: float) -> Worst | None:
    """Return the case of an agent within a radius, if there is one."""
    return next((case for case in cases if case.agent == agent and case.threat.radius == radius), None)


def case_words(radius: float) -> str:
    """Return a size in words."""
    return f"{radius:g} ({200 * radius:g} m, {80 * radius:g} m/s)"


def _radii(cases: Sequence[Worst]) -> list[float]:
    return sorted({case.threat.radius for case in cases})


def _clean(rows: Sequence[EpisodeRow], agent: str, name: str) -> Estimate:
    own = [row for row in rows if row.agent == agent and row.attack == "none" and row.scenario == rows[0].scenario]
    return estimate(column(own, name), [row.seed for row in own], [row.training_seed for row in own])
