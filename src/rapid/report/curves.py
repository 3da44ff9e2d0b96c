"""The learning curves that the page's script draws, as plain data."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rapid.pages.episodes import ACTION_WORDS
from rapid.report.data import Entries

UNIFORM = math.log(len(ACTION_WORDS))
"""ln 5 = 1.609: the cross-entropy of a policy that gives every action the same probability."""

_TIMES = ("iteration", "step")
_MOST_POINTS = 400
_TERMS = ("total", "td", "conservative")


def flatten(entry: Mapping[str, Any], where: str = "") -> dict[str, float]:
    """Return the numbers of a nested record by dotted names."""
    found: dict[str, float] = {}
    for key, value in entry.items():
        name = f"{where}{key}"
        if isinstance(value, Mapping):
            found |= flatten(value, f"{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = float(value)
    return found


def series(entries: Entries, name: str) -> list[tuple[float, float]]:
    """Return (time, value) wherever `name` occurs; many points are averaged down to a few hundred."""
    points: list[tuple[float, float]] = []
    for number, record in enumerate(flatten(entry) for entry in entries):
        if name in record and math.isfinite(record[name]):
            time = next((record[key] for key in _TIMES if key in record), float(number))
            points.append((time, record[name]))
    if len(points) <= _MOST_POINTS:
        return points
    groups = np.array_split(np.array(points), _MOST_POINTS)
    return [(float(group[:, 0].mean()), float(group[:, 1].mean())) for group in groups]


def _chart(
    identity: str,
    title: str,
    x: str,
    y: str,
    trainings: Mapping[str, Entries],
    name: str,
    marks: Sequence[tuple[float, str]] = (),
    **more: Any,
) -> dict[str, Any] | None:
    lines = [{"name": agent, "points": series(entries, name)} for agent, entries in trainings.items()]
    # A term of weight 0 is recorded as zero; drawn, it would look as if it had been learned away.
    is_term = name in ("robust", "value")
    lines = [line for line in lines if any(value or not is_term for _, value in line["points"])]
    if not lines:
        return None
    shown = [{"y": value, "label": label} for value, label in marks]
    return {"id": identity, "title": title, "x": x, "y": y, "series": lines, "marks": shown, **more}


def charts(distill: Mapping[str, Entries], adapt: Mapping[str, Entries]) -> list[dict[str, Any]]:
    """Return the charts that the trainings' records allow, in the order of the page; `detail` ones are folded away."""
    uniform = [(UNIFORM, f"ln 5 = {UNIFORM:.3f}: every action alike")]
    offline, online = "iteration", "environment step"
    score, crash = "evaluation.return", "evaluation.crash_share"
    found = [
        _chart("distill-return", "Return while distilling", offline, "return", distill, score, zero=True),
        _chart("adapt-return", "Return while adapting", online, "return", adapt, score, zero=True),
        _chart("distill-crash", "Crash share while distilling", offline, "crash share", distill, crash, zero=True),
        _chart("adapt-crash", "Crash share while adapting", online, "crash share", adapt, crash, zero=True),
        _chart(
            "robust",
            "Robust term J_robust",
            offline,
            "cross-entropy under attack",
            distill,
            "robust",
            uniform,
            zero=True,
        ),
        _chart("gate", "How far the gate is open", online, "mean |g|", adapt, "gate", zero=True),
        _chart(
            "agreement", "Still acting as distilled", online, "share of offline states", adapt, "agreement", zero=True
        ),
        _chart("exploring", "Return while exploring", online, "return", adapt, "return", zero=True, detail=True),
    ]
    for phase, trainings, time in (("distilling", distill, offline), ("adapting", adapt, online)):
        for agent, entries in trainings.items():
            # One line per term: the term's value takes the place of the agent's.
            terms = {term: [_only(entry, term) for entry in entries] for term in _TERMS}
            title = f"Loss while {phase}: {agent}"
            found.append(_chart(f"loss-{phase}-{agent}", title, time, "loss", terms, "value", detail=True))
    return [chart for chart in found if chart is not None]


def _only(entry: Mapping[str, Any], term: str) -> dict[str, Any]:
    """Return the time of a record and one of its terms, as `value`."""
    return {name: entry[name] for name in _TIMES if name in entry} | ({"value": entry[term]} if term in entry else {})
