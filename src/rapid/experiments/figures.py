"""Figures as data, and how they are drawn: legible in print, told apart without colour."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rapid.experiments.tables import Entry, Facts
from rapid.files import atomic_path
from rapid.scenarios import FEATURES

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00")
"""Told apart by the colour-blind (Okabe and Ito)."""
MARKERS = ("o", "s", "^", "D", "v", "P")
STYLES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)))


class Point(NamedTuple):
    """A point of a curve with its interval; NaN where there is none."""

    x: float
    y: float
    low: float
    high: float


@dataclass(frozen=True)
class Curve:
    """A line with a name."""

    label: str
    points: tuple[Point, ...]
    is_level: bool = False
    """One value, drawn over the whole width."""

    @classmethod
    def of_entries(cls, label: str, points: Sequence[tuple[float, Entry]]) -> "Curve":
        """Return what episodes say at each x; places that were not driven are left out."""
        return cls(
            label,
            tuple(
                Point(x, each.mean.value, each.mean.low, each.mean.high) for x, each in points if each.mean is not None
            ),
        )

    @classmethod
    def level(cls, label: str, each: Entry) -> "Curve":
        """Return one value as a line."""
        mean = each.mean
        points = () if mean is None else (Point(0.0, mean.value, mean.low, mean.high),)
        return cls(label, points, is_level=True)

    @classmethod
    def of_metrics(
        cls,
        label: str,
        trainings: Sequence[tuple[Sequence[Mapping[str, Any]], Sequence[Mapping[str, Any]]]],
        before: int,
    ) -> "Curve":
        """Return the learning curve of several trainings, phase 3 from `before` on; the band is from least to most."""
        series = [
            [
                *((row["iteration"], row["evaluation"]["return"]) for row in offline if row.get("evaluation")),
                *((before + row["step"], row["evaluation"]["return"]) for row in online if row.get("evaluation")),
            ]
            for offline, online in trainings
        ]
        return cls(label, _together(series))

    @classmethod
    def of_term(cls, label: str, trainings: Sequence[Sequence[Mapping[str, Any]]], term: str) -> "Curve":
        """Return a term of the loss over several trainings."""
        series = [[(row["iteration"], row[term]) for row in rows if row.get(term) is not None] for rows in trainings]
        return cls(label, _together(series))


def _together(series: Sequence[Sequence[tuple[float, float]]]) -> tuple[Point, ...]:
    """Return mean, least and greatest of several curves at every x that all of them have."""
    filled = [dict(each) for each in series if each]
    if not filled:
        return ()
    shared = sorted(set.intersection(*(set(each) for each in filled)))
    points: list[Point] = []
    for x in shared:
        values = [each[x] for each in filled]
        points.append(Point(x, float(np.mean(values)), min(values), max(values)))
    return tuple(points)


@dataclass(frozen=True)
class Lines:
    """A chart of curves."""

    id: str
    caption: str
    curves: tuple[Curve, ...]
    x: str
    y: str
    mark: float | None = None
    """Where a new phase begins."""
    gap: str = ""
    """What is missing, in words."""

    @property
    def complete(self) -> bool:
        """Whether nothing is missing and every curve has points."""
        return not self.gap and all(curve.points for curve in self.curves)

    def data(self) -> Facts:
        """Return the points as a table."""
        rows = [
            (curve.label, f"{point.x:g}", f"{point.y:.3g}", _span(point))
            for curve in self.curves
            for point in curve.points
        ]
        notes = (said(self.gap),) if self.gap else ()
        return Facts(self.id, self.caption, ("curve", self.x, self.y, "from, to"), tuple(rows), notes)


@dataclass(frozen=True)
class Router:
    """A scene of the road, and what each policy contributes to each vehicle."""

    id: str
    caption: str
    obs: Sequence[Sequence[float]]
    weights: Sequence[Sequence[float]]
    """Signed weights, a row a vehicle, a column a policy."""
    lanes: int
    gap: str = ""
    """What other scenes lack, in words."""

    @property
    def complete(self) -> bool:
        """A scene is whole; others may be missing."""
        return not self.gap

    def data(self) -> Facts:
        """Return the weights as a table."""
        rows = [
            ("ego" if number == 0 else str(number), *(f"{weight:+.3f}" for weight in weights))
            for number, (row, weights) in enumerate(zip(self.obs, self.weights, strict=True))
            if row[FEATURES.index("presence")] >= 0.5
        ]
        names = [f"policy {number}" for number in range(1, len(self.weights[0]) + 1)]
        notes = (said(self.gap),) if self.gap else ()
        return Facts(self.id, self.caption, ("vehicle", *names), tuple(rows), notes)


def said(gap: str) -> str:
    """Return what is missing as a sentence; empty where nothing is."""
    return f"{gap[:1].upper()}{gap[1:]}." if gap else ""


def _span(point: Point) -> str:
    return "–" if np.isnan(point.low) else f"{point.low:.3g}, {point.high:.3g}"


def draw(shown: Lines | Router) -> Figure:
    """Return the figure."""
    return _lines(shown) if isinstance(shown, Lines) else _router(shown)


def save(shown: Lines | Router, folder: Path) -> list[Path]:
    """Write a figure as PNG and SVG and return the paths."""
    figure = draw(shown)
    written: list[Path] = []
    for ending in ("png", "svg"):
        path = folder / f"{shown.id}.{ending}"
        with atomic_path(path) as temporary:
            # No date in the file: the same figure is the same bytes.
            figure.savefig(temporary, format=ending, dpi=150, metadata={"Date": None} if ending == "svg" else None)
        written.append(path)
    plt.close(figure)
    return written


def _axes(width: float, height: float) -> tuple[Figure, Any]:
    plt.rcParams["svg.hashsalt"] = "rapid"
    figure, axes = plt.subplots(figsize=(width, height), layout="constrained")
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _lines(shown: Lines) -> Figure:
    figure, axes = _axes(7.0, 4.2)
    for number, curve in enumerate(shown.curves):
        colour, style = COLOURS[number % len(COLOURS)], STYLES[number % len(STYLES)]
        if not curve.points:
            continue
        if curve.is_level:
            axes.axhline(curve.points[0].y, color=colour, linestyle=style, label=_plain(curve.label))
            continue
        x, y, low, high = (np.array(values) for values in zip(*curve.points, strict=True))
        marker = MARKERS[number % len(MARKERS)]
        axes.plot(x, y, color=colour, linestyle=style, marker=marker, markersize=5, label=_plain(curve.label))
        axes.fill_between(
            x, np.where(np.isnan(low), y, low), np.where(np.isnan(high), y, high), color=colour, alpha=0.15
        )
    if shown.mark:
        axes.axvline(shown.mark, color="0.5", linewidth=1)
    axes.set_xlabel(shown.x)
    axes.set_ylabel(shown.y)
    axes.grid(axis="y", alpha=0.3)
    if shown.gap:
        # The picture says so itself: it is also used without its page.
        axes.set_title(shown.gap, loc="right", fontsize=8, color="0.3")
    if any(curve.points for curve in shown.curves):
        axes.legend(frameon=False, fontsize=9)
    else:
        nothing = shown.gap or "nothing has been computed yet"
        axes.text(0.5, 0.5, nothing, ha="center", transform=axes.transAxes)
    return figure


def _router(shown: Router) -> Figure:
    obs_VF: NDArray[np.float64] = np.array(shown.obs)
    weights_VN: NDArray[np.float64] = np.array(shown.weights)
    present_V = obs_VF[:, FEATURES.index("presence")] >= 0.5
    figure, (road, bars) = plt.subplots(
        2, 1, figsize=(8.0, 4.6), layout="constrained", gridspec_kw={"height_ratios": [1, 1.3]}
    )
    x_V, y_V = obs_VF[:, FEATURES.index("x")] - obs_VF[0, FEATURES.index("x")], obs_VF[:, FEATURES.index("y")]
    for lane in range(shown.lanes + 1):
        road.axhline(4 * lane - 2, color="0.6", linewidth=1, linestyle="-" if lane in (0, shown.lanes) else "--")
    share_V = np.abs(weights_VN[:, 1:]).sum(1) / np.maximum(np.abs(weights_VN).sum(1), 1e-9)
    marks = road.scatter(
        x_V[present_V],
        y_V[present_V],
        c=share_V[present_V],
        cmap="cividis",
        vmin=0,
        vmax=1,
        s=90,
        marker="s",
        edgecolors="black",
    )
    for number in np.flatnonzero(present_V):
        road.annotate(
            "ego" if number == 0 else str(number),
            (x_V[number], y_V[number]),
            xytext=(0, 7),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    road.set_ylim(4 * shown.lanes - 1, -3)
    road.set_xlabel("metres from the ego")
    road.set_yticks([])
    figure.colorbar(marks, ax=road, label="adapter's share")
    place_V = np.arange(int(present_V.sum()))
    width = 0.8 / weights_VN.shape[1]
    for policy in range(weights_VN.shape[1]):
        name = "policy 1 (distilled)" if policy == 0 else f"policy {policy + 1} (adapter)"
        bars.bar(
            place_V + policy * width,
            weights_VN[present_V, policy],
            width,
            label=name,
            color=COLOURS[policy % len(COLOURS)],
            hatch="" if policy == 0 else "//",
            edgecolor="white",
        )
    bars.set_xticks(place_V + 0.4 - width / 2, ["ego" if n == 0 else str(n) for n in np.flatnonzero(present_V)])
    bars.set_xlabel("vehicle, by distance")
    bars.set_ylabel("weight")
    bars.axhline(0, color="black", linewidth=0.8)
    bars.legend(frameon=False, fontsize=9, loc="lower right", bbox_to_anchor=(1, 1), ncols=weights_VN.shape[1])
    for axes in (road, bars):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _plain(text: str) -> str:
    """Return a label in which matplotlib finds no formula."""
    return text.replace("$", r"\$")
