"""From the episodes of several teachers to one table: text, Markdown and JSON.

The first teacher is the one that the others are compared with, spawn by spawn.
"""

import dataclasses
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rapid.evaluation.statistics import RESAMPLES, Estimate, estimate, paired_difference
from rapid.evaluation.summary import NOT_RUN, aligned, number, with_interval
from rapid.evaluation.teachers import CLOSE, FLAP_WITHIN, LONGEST_HEADWAY, TeacherRow

EPISODE = 30
"""Decisions of a whole episode; flaps are counted per so many."""


@dataclass(frozen=True)
class TeacherSummary:
    """One teacher in one scenario. Shares are of decisions or steps of all episodes together; NaN is unknown."""

    scenario: str
    teacher: str
    episode_return: Estimate
    crashed: Estimate
    return_difference: Estimate | None
    """To the first teacher, over the spawns that both drove; None for that teacher itself."""
    crash_difference: Estimate | None
    mean_speed: float
    """m/s, every episode alike."""
    distance: float
    """Metres an episode."""
    unsafe_share: float
    """Of the decisions for which something safe was available, those that took something unsafe."""
    flaps: float
    """Per 30 decisions."""
    close_share: float
    """Of steps, those with less than two seconds to collision."""
    headway: float
    """Mean time headway, s, over the steps with a car ahead."""
    repaired_share: float
    fallback_share: float
    unlike_foresight_share: float
    """Of decisions, those that differ from what `rule-foresight` takes in the same scene."""
    unlike_forecast_share: float
    """The same for `rule-forecast`."""
    decisions_per_second: float
    tokens: float
    """Read and written, an episode."""
    cost: float
    """An episode."""


def summarize_teachers(rows: Sequence[TeacherRow], resamples: int = RESAMPLES) -> list[TeacherSummary]:
    """Return one summary per scenario and teacher, in the order of first appearance."""
    teachers = list(dict.fromkeys(row.teacher for row in rows))
    found: list[TeacherSummary] = []
    for scenario in dict.fromkeys(row.scenario for row in rows):
        groups = {name: [row for row in rows if (row.scenario, row.teacher) == (scenario, name)] for name in teachers}
        first = groups[teachers[0]]
        found += [_summary(of, first if name != teachers[0] else [], resamples) for name, of in groups.items() if of]
    return found


def _summary(rows: Sequence[TeacherRow], first: Sequence[TeacherRow], resamples: int) -> TeacherSummary:
    spawns = [row.seed for row in rows]

    def total(name: str) -> float:
        return float(sum(getattr(row, name) for row in rows))

    def column(name: str, of: Sequence[TeacherRow] = rows) -> list[float]:
        return [float(getattr(row, name)) for row in of]

    def difference(name: str) -> Estimate | None:
        if not first:
            return None
        others = [row.seed for row in first]
        return paired_difference(column(name), spawns, column(name, first), others, resamples=resamples)

    decisions = total("length")
    led = [(row.headway, row.lead_steps) for row in rows if row.lead_steps]
    return TeacherSummary(
        scenario=rows[0].scenario,
        teacher=rows[0].teacher,
        episode_return=estimate(column("episode_return"), spawns, resamples=resamples),
        crashed=estimate(column("crashed"), spawns, resamples=resamples),
        return_difference=difference("episode_return"),
        crash_difference=difference("crashed"),
        mean_speed=float(np.mean(column("mean_speed"))),
        distance=float(np.mean(column("distance"))),
        unsafe_share=_ratio(total("unsafe"), total("had_safe")),
        flaps=_ratio(EPISODE * total("flaps"), decisions),
        close_share=_ratio(total("close_steps"), decisions),
        headway=_ratio(sum(mean * steps for mean, steps in led), sum(steps for _, steps in led)),
        repaired_share=_ratio(total("repaired"), decisions),
        fallback_share=_ratio(total("fallbacks"), decisions),
        unlike_foresight_share=_ratio(total("unlike_foresight"), decisions),
        unlike_forecast_share=_ratio(total("unlike_forecast"), decisions),
        decisions_per_second=_ratio(decisions, sum(row.decision_seconds * row.length for row in rows)),
        tokens=_ratio(total("tokens_in") + total("tokens_out"), len(rows)),
        cost=_ratio(total("cost"), len(rows)),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def teachers_text(summaries: Sequence[TeacherSummary]) -> str:
    """Return the tables as aligned plain text: for each scenario how the teachers drove, then how they decided."""
    blocks: list[str] = []
    for scenario, tables in _tables(summaries):
        blocks += [f"{scenario}\n{aligned(tables[0])}", aligned(tables[1])]
    return "\n\n".join([*blocks, _notes(summaries)])


def teachers_markdown(summaries: Sequence[TeacherSummary]) -> str:
    """Return the tables as Markdown; names are escaped, so that none can be read as a tag or break a table."""
    lines: list[str] = []
    for scenario, tables in _tables(summaries):
        lines += [f"## {_escaped(scenario)}", ""]
        for head, *rest in tables:
            lines += [_row(head), "|" + "---|" * len(head), *map(_row, rest), ""]
    return "\n".join([*lines, _escaped(_notes(summaries)), ""])


def teachers_json(summaries: Sequence[TeacherSummary]) -> list[dict[str, Any]]:
    """Return the summaries as JSON has them: an interval is value, low and high; what is unknown is null."""
    return [_plain(dataclasses.asdict(summary)) for summary in summaries]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(map(_escaped, cells))} |"


def _escaped(value: str) -> str:
    clean = html.escape(" ".join(value.split()), quote=False)
    return "".join(f"\\{character}" if character in "\\`*_[]|#" else character for character in clean)


def _tables(
    summaries: Sequence[TeacherSummary],
) -> list[tuple[str, tuple[list[list[str]], list[list[str]]]]]:
    """Return the cells of both tables of each scenario, heads first."""
    found: list[tuple[str, tuple[list[list[str]], list[list[str]]]]] = []
    for scenario in dict.fromkeys(summary.scenario for summary in summaries):
        drove = [["teacher", "return", "difference", "crash %", "difference", "speed m/s", "distance m", "headway s"]]
        drove[0] += [f"TTC < {CLOSE:g} s %", "flaps"]
        decided = [["teacher", "unsafe %", "unlike foresight %", "unlike forecast %", "repaired %", "fallback %"]]
        decided[0] += ["decisions/s", "tokens", "cost"]
        for of in summaries:
            if of.scenario != scenario:
                continue
            drove.append(
                [
                    of.teacher,
                    with_interval(of.episode_return),
                    _difference(of.return_difference),
                    with_interval(of.crashed, 0, 100),
                    _difference(of.crash_difference, 0, 100),
                    number(of.mean_speed),
                    number(of.distance, 0),
                    number(of.headway),
                    number(of.close_share, 1, 100),
                    number(of.flaps, 2),
                ]
            )
            decided.append(
                [
                    of.teacher,
                    number(of.unsafe_share, 1, 100),
                    number(of.unlike_foresight_share, 1, 100),
                    number(of.unlike_forecast_share, 1, 100),
                    number(of.repaired_share, 1, 100),
                    number(of.fallback_share, 1, 100),
                    number(of.decisions_per_second, 0 if of.decisions_per_second >= 100 else 2),
                    number(of.tokens, 0),
                    f"{of.cost:.3g}",
                ]
            )
        found.append((scenario, (drove, decided)))
    return found


def _difference(of: Estimate | None, digits: int = 1, scale: float = 1.0) -> str:
    """Return a difference with its sign and interval."""
    if of is None or math.isnan(of.value):
        return NOT_RUN
    interval = "" if math.isnan(of.low) else f" [{of.low * scale:+.{digits}f}, {of.high * scale:+.{digits}f}]"
    return f"{of.value * scale:+.{digits}f}{interval}"


def _notes(summaries: Sequence[TeacherSummary]) -> str:
    counts = sorted({summary.episode_return.spawns for summary in summaries})
    spawns = "no" if not counts else f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    first = summaries[0].teacher if summaries else NOT_RUN
    return (
        f"Means over {spawns} spawn seeds, with 95 % bootstrap intervals; differences are to {first}, paired by spawn "
        "(crashes in percentage points). unsafe: choices after which every way on is foreseen to crash, of those "
        "where another action had a way on. unlike foresight, unlike forecast: choices other than those of "
        f"rule-foresight and of rule-forecast in the same scene. flaps: lane changes undone within {FLAP_WITHIN} "
        f"decisions, per {EPISODE}. TTC: time to collision. headway: time to reach where the car ahead is, each at "
        f"most {LONGEST_HEADWAY:g} s. repaired: invalid answers put right on a second try; fallback: those that the "
        "rule replaced. tokens and cost: an episode."
    )
