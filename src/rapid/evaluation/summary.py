"""From episode rows to a table: one line per agent and scenario, every number with its interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rapid.evaluation.metrics import EpisodeRow, Kind, column
from rapid.evaluation.statistics import ENOUGH_SEEDS, RESAMPLES, Estimate, estimate, paired_difference
from rapid.scenarios import ACTIONS, get_scenario

KINDS: dict[Kind, str] = {
    "floor": "needs no learning",
    "teacher": "the teacher",
    "planner": "search in the simulator",
    "learned": "learned",
}
"""Kinds of agents in the order of the table. All but `learned` are there for reference."""

NOT_APPLICABLE = "n/a"
NOT_APPLICABLE_WHY = (
    "a gradient attack needs a network, one that searches the values of the actions; and who reads the world sees no "
    "observation."
)
NOT_RUN = "–"
NEED_VALUES = ("square", "world")
"""Kinds of attacks that ask for the values of the actions, which scripted drivers and language models have not."""

_SHOWN = {
    "slower": "always-slower",
    "idle": "always-idle",
    "faster": "always-faster",
    "random": "random",
    "uniform-safe": "random among safe",
    "rule": "rule",
    "rule-forecast": "rule, forecast",
    "rule-foresight": "rule, foresight",
    "immune": "immune: brakes while any car is there",
    "blind": "blind: a fixed plan",
    "planner-cars": "planner, drivers unknown",
    "planner-observation": "planner, as observed",
}

CLEAN = "none"
WIDE = 6
"""Attacks that a table of plain text holds side by side; more of them stand one below the other."""
METRICS: tuple[str, ...] = (
    "episode_return",
    "progress_return",
    "crashed",
    "mean_speed",
    "distance",
    "lane_changes",
    "min_ttc",
    "decision_ms",
)


@dataclass(frozen=True)
class AttackCell:
    """What an attack left of an agent; `missing` says why there is nothing."""

    episode_return: Estimate | None
    crashed: Estimate | None
    missing: str = ""


@dataclass(frozen=True)
class SummaryRow:
    """One agent in one scenario."""

    scenario: str
    agent: str
    label: str
    """The agent's name as shown."""
    kind: Kind
    origin: str
    """What it is, whatever it is called, as :attr:`EpisodeRow.what`."""
    metrics: dict[str, Estimate]
    """Without attack, by the name in :data:`METRICS`, and `iqm`, the interquartile mean of the return."""
    shares: tuple[float, ...]
    """Mean share of each action, without attack."""
    attacks: dict[str, AttackCell]
    """By name, without `none`, in the order of first appearance in the rows."""

    @property
    def is_reference(self) -> bool:
        """Whether the row is there to compare with and was not trained."""
        return self.kind != "learned"


def label_of(agent: str) -> str:
    """Return an agent's name as shown: ``slower`` is ``always-slower``."""
    return _SHOWN.get(agent, agent)


def summarize(rows: Sequence[EpisodeRow], resamples: int = RESAMPLES) -> list[SummaryRow]:
    """Return one summary per scenario and agent: floors, teacher, planner, then what was learned, as they came."""
    groups: dict[tuple[str, str], dict[str, list[EpisodeRow]]] = {}
    gradient: dict[str, bool] = {}
    for row in rows:
        groups.setdefault((row.scenario, row.agent), {}).setdefault(row.attack, []).append(row)
        gradient[row.attack] = gradient.get(row.attack, False) or row.gradient_attack
    gradient.pop(CLEAN, None)
    scenarios = list(dict.fromkeys(row.scenario for row in rows))
    order = list(KINDS)
    summaries = [
        SummaryRow(
            scenario=scenario,
            agent=agent,
            label=label_of(agent),
            kind=next(row.kind for of in by_attack.values() for row in of),
            origin=next(row.what for of in by_attack.values() for row in of),
            metrics=_metrics(by_attack.get(CLEAN, []), resamples),
            shares=_shares(by_attack.get(CLEAN, [])),
            attacks={name: _cell(by_attack, name, needs, resamples) for name, needs in gradient.items()},
        )
        for (scenario, agent), by_attack in groups.items()
    ]
    return sorted(summaries, key=lambda row: (scenarios.index(row.scenario), order.index(row.kind)))


def _estimate(rows: Sequence[EpisodeRow], name: str, resamples: int, iqm: bool = False) -> Estimate:
    return estimate(
        column(rows, name),
        [row.seed for row in rows],
        [row.training_seed for row in rows],
        "iqm" if iqm else "mean",
        resamples,
    )


def _metrics(rows: Sequence[EpisodeRow], resamples: int) -> dict[str, Estimate]:
    found = {name: _estimate(rows, name, resamples) for name in METRICS}
    found["iqm"] = _estimate(rows, "episode_return", resamples, iqm=True)
    return found


def _shares(rows: Sequence[EpisodeRow]) -> tuple[float, ...]:
    """Return the mean share of each action; every episode counts alike."""
    if not rows:
        return (math.nan,) * len(ACTIONS)
    return tuple(sum(row.shares[i] for row in rows) / len(rows) for i in range(len(ACTIONS)))


def _cell(by_attack: dict[str, list[EpisodeRow]], name: str, needs_gradient: bool, resamples: int) -> AttackCell:
    rows = by_attack.get(name, [])
    if rows:
        return AttackCell(_estimate(rows, "episode_return", resamples), _estimate(rows, "crashed", resamples))
    others = [row for of in by_attack.values() for row in of]
    without = needs_gradient and not any(row.has_network for row in others)
    without |= name.partition(":")[0] in NEED_VALUES and any(row.kind in ("floor", "teacher") for row in others)
    # All other planners read the worlds, so there is no observation of theirs to attack.
    blind = any(row.kind == "planner" and row.what != "planner-observation" for row in others)
    return AttackCell(None, None, NOT_APPLICABLE if without or blind else NOT_RUN)


def number(value: float, digits: int = 1, scale: float = 1.0) -> str:
    """Return a number as shown; NaN is a dash."""
    return NOT_RUN if math.isnan(value) else f"{value * scale:.{digits}f}"


def with_interval(of: Estimate, digits: int = 1, scale: float = 1.0) -> str:
    """Return ``value [low, high]``, or the value alone where there is no interval."""
    if math.isnan(of.low):
        return number(of.value, digits, scale)
    return f"{number(of.value, digits, scale)} [{number(of.low, digits, scale)}, {number(of.high, digits, scale)}]"


def units(rows: Sequence[SummaryRow]) -> str:
    """Return one sentence on what the intervals are over, and what they say nothing about."""
    learned = [row.metrics["episode_return"] for row in rows if row.kind == "learned"]
    trainings = {of.training_seeds for of in learned if of.training_seeds}
    # Who was never driven without attack has none.
    counts = {row.metrics["episode_return"].spawns for row in rows} - {0}
    spawns = f"{_span(counts)} spawn seeds" if counts else "spawn seeds"
    sentence = f"Means with 95 % bootstrap intervals over {spawns}"
    if trainings == {1}:
        return (
            f"{sentence}. Learned rows are one training each: their intervals cover the traffic, not what another "
            "training would give."
        )
    if trainings and max(trainings) > 1:
        few = min(trainings) < ENOUGH_SEEDS
        fewness = f" Fewer than {ENOUGH_SEEDS} trainings: preliminary." if few else ""
        return f"{sentence}, and over training seeds where there are several ({_span(trainings)}).{fewness}"
    return f"{sentence}."


def _span(counts: set[int]) -> str:
    low, high = min(counts), max(counts)
    return str(high) if low == high else f"{low} to {high}"


def summary_text(rows: Sequence[EpisodeRow], resamples: int = RESAMPLES) -> str:
    """Return the summary as aligned plain text: first without attack, then the return under each attack."""
    if not rows:
        return "Nothing was measured: there are no episodes."
    summaries = summarize(rows, resamples)
    blocks: list[str] = []
    for scenario in dict.fromkeys(row.scenario for row in summaries):
        here = [row for row in summaries if row.scenario == scenario]
        blocks.append(f"{scenario}\n{aligned(_clean_cells(here))}")
        if any(row.attacks for row in here):
            names = list(here[0].attacks)
            lines = [["return under attack", "none", *names]]
            lines += [[row.label, number(row.metrics["episode_return"].value), *_attack_texts(row)] for row in here]
            # Many attacks would make lines that no screen holds.
            blocks.append(aligned(lines if len(names) <= WIDE else list(zip(*lines, strict=True))))
    if any(cell.missing == NOT_APPLICABLE for row in summaries for cell in row.attacks.values()):
        blocks.append(f"{NOT_APPLICABLE}: {NOT_APPLICABLE_WHY}")
    blocks += ["\n".join(lines) for lines in [ahead_of(rows, resamples=resamples)] if lines]
    blocks.append(units(summaries))
    return "\n\n".join(blocks)


_UNMOVED = ("slower", "idle", "faster", "blind")
"""Floors that do not look: they drive under every attack as without one."""


def does_not_look(row: EpisodeRow) -> bool:
    """Whether the agent drives the same whatever it is shown."""
    return row.kind == "floor" and row.what.partition(":")[0] in _UNMOVED


def lead_of(rows: Sequence[EpisodeRow]) -> str:
    """Return the name of the one agent that RAPID adapted; empty if there is none, or several."""
    found = {row.agent for row in rows if row.kind == "learned" and row.what.startswith("rapid")}
    return next(iter(found)) if len(found) == 1 else ""


def ahead_of(rows: Sequence[EpisodeRow], lead: str = "", resamples: int = RESAMPLES) -> list[str]:
    """Return a sentence for each scenario and attack under which `lead` drove: which floors and baselines are ahead.

    Without a lead it is the one agent that RAPID adapted, if there is one. Ahead is who has the higher mean return on
    the spawns that both drove; whether the 95 % interval of that difference holds zero is said too. Teacher and
    planners are no baselines: they may take seconds for a decision.
    """
    lead = lead or lead_of(rows)
    groups: dict[tuple[str, str], dict[str, list[EpisodeRow]]] = {}
    for row in rows:
        if row.kind in ("floor", "learned"):
            groups.setdefault((row.scenario, row.attack), {}).setdefault(row.agent, []).append(row)
    lines: list[str] = []
    for (scenario, attack), agents in groups.items():
        clean = {name: of for name, of in groups.get((scenario, CLEAN), {}).items() if does_not_look(of[0])}
        agents = clean | agents
        others = [(name, of) for name, of in agents.items() if name != lead]
        if lead not in agents or not others:
            continue
        found = [text for name, of in others if (text := _lead_over(of, agents[lead], label_of(name), resamples))]
        where = f"{scenario}, {'without attack' if attack == CLEAN else f'under {attack}'}"
        told = "; ".join(found) or "no floor and no baseline"
        lines.append(f"Ahead of {lead} in {where}: {told}.")
    return lines


def _lead_over(of: Sequence[EpisodeRow], lead: Sequence[EpisodeRow], label: str, resamples: int) -> str:
    theirs, ours = column(of, "episode_return"), column(lead, "episode_return")
    gap = paired_difference(
        theirs,
        [row.seed for row in of],
        ours,
        [row.seed for row in lead],
        [row.training_seed for row in of],
        [row.training_seed for row in lead],
        resamples=resamples,
    )
    if not gap.value > 0:
        return ""
    doubt = "" if gap.low > 0 else ", which may be chance"
    return f"{label} by {with_interval(gap, 2)}{doubt}"


def _attack_texts(row: SummaryRow) -> list[str]:
    return [
        cell.missing if cell.episode_return is None else with_interval(cell.episode_return)
        for cell in row.attacks.values()
    ]


def _clean_cells(rows: Sequence[SummaryRow]) -> list[list[str]]:
    short = "/".join(name.removeprefix("LANE_")[0].lower() for name in ACTIONS)
    # Under the reward `progress` it is what the return is.
    other = get_scenario(rows[0].scenario).reward != "progress"
    lines = [
        [
            "agent",
            "return",
            "IQM",
            *(["progress"] if other else []),
            "crash %",
            "speed m/s",
            "distance m",
            f"actions % {short}",
        ]
    ]
    for row in rows:
        of = row.metrics
        lines.append(
            [
                row.label,
                with_interval(of["episode_return"]),
                number(of["iqm"].value),
                *([number(of["progress_return"].value)] if other else []),
                with_interval(of["crashed"], 0, 100),
                with_interval(of["mean_speed"]),
                number(of["distance"].value, 0),
                "/".join(number(share, 0, 100) for share in row.shares),
            ]
        )
    return lines


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Return the lines aligned, names to the left, a rule under the head."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([text[0], "  ".join("-" * width for width in widths), *text[1:]])
