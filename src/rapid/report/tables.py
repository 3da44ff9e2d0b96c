"""The tables of the page: how all agents drive, and what attacks leave of them."""

import math
from collections.abc import Sequence
from contextlib import suppress

from rapid.attacks.spec import parse_attack
from rapid.errors import RapidError
from rapid.evaluation.statistics import Estimate
from rapid.evaluation.summary import (
    KINDS,
    NOT_APPLICABLE,
    NOT_RUN,
    AttackCell,
    SummaryRow,
    label_of,
    number,
    units,
)
from rapid.evaluation.worst import OVER_SLOWER, Worst, threats_of
from rapid.experiments.paper import PaperResult
from rapid.pages.episodes import ACTION_WORDS
from rapid.pages.markup import Markup, tag, text
from rapid.report.data import paper_return
from rapid.scenarios import Scenario, get_scenario

_MARKS: dict[str, str] = {"floor": "floor", "teacher": "teacher", "planner": "planner"}


def results_table(rows: Sequence[SummaryRow], lead: str) -> Markup:
    """Return the table of one scenario, without attack."""
    scenario = get_scenario(rows[0].scenario)
    span = _span([row.metrics["episode_return"] for row in rows])
    has_paper = any(paper_return(row.origin, scenario) for row in rows)
    has_other = scenario.reward != "progress"
    heads = [
        ("agent", "", "text"),
        ("return", "sum of rewards of an episode; bar: 95 % interval", "number"),
        *([("paper", "return that the paper prints; its ± is not explained there", "number")] if has_paper else []),
        ("IQM", "interquartile mean of the return", "number"),
        *([("progress", "return of the same driving under the reward progress", "number")] if has_other else []),
        ("crashed", "share of episodes that end in a crash", "number"),
        ("speed", "mean speed of the ego, m/s", "number"),
        ("distance", "metres driven in an episode of at most 30 s", "number"),
        ("lane changes", "per episode", "number"),
        ("min TTC", "least time to collision with the vehicle ahead on the own lane, s, mean over episodes", "number"),
        ("actions", f"share of {', '.join(ACTION_WORDS)}", "none"),
        ("ms/decision", "wall time per decision, worlds driven side by side on one machine", "number"),
    ]
    body: list[Markup] = []
    for row in rows:
        of = row.metrics
        paper = paper_return(row.origin, scenario)
        body.append(
            tag(
                "tr",
                _name(row, lead),
                _cell(of["episode_return"], bar=span),
                *([_paper_cell(paper)] if has_paper else []),
                _cell(of["iqm"]),
                *([_cell(of["progress_return"])] if has_other else []),
                _cell(of["crashed"], 0, 100, " %"),
                _cell(of["mean_speed"]),
                _cell(of["distance"], 0),
                _cell(of["lane_changes"]),
                _cell(of["min_ttc"]),
                tag("td", _action_bar(row.shares), class_="actions"),
                _plain_cell(of["decision_ms"], 2),
                class_=_row_class(row, lead),
            )
        )
    return table(heads, body)


def attack_table(rows: Sequence[SummaryRow], lead: str) -> Markup:
    """Return the table of one scenario: the return under each attack, the paper's beside it, and the crash share."""
    scenario = get_scenario(rows[0].scenario)
    names = list(rows[0].attacks)
    heads = [
        ("agent", "", "text"),
        ("none", "return without attack", "number"),
        *((name, f"return under {name}", "number") for name in names),
    ]
    top = max(
        (row.metrics["episode_return"].value for row in rows if row.metrics["episode_return"].episodes), default=1
    )
    body: list[Markup] = []
    for row in rows:
        clean = AttackCell(row.metrics["episode_return"], row.metrics["crashed"])
        cells = [
            _attack_cell(cell, paper_return(row.origin, scenario, attack), top)
            for attack, cell in {"none": clean, **row.attacks}.items()
        ]
        body.append(tag("tr", _name(row, lead), *cells, class_=_row_class(row, lead)))
    return table(heads, body)


def worst_table(cases: Sequence[Worst], lead: str) -> Markup:
    """Return the table of one scenario and threat: what the worst of the attacks leaves on every spawn."""
    heads = [
        ("agent", "", "text"),
        ("return", "mean over spawns of the least return under any of the attacks", "number"),
        (OVER_SLOWER, "return less that of the driver that always brakes, on the same spawns", "number"),
        ("crashed", "share of these worst episodes that end in a crash", "number"),
        ("attacks", "how many attacks were made on it", "number"),
        ("most often the worst", "the attack under which the most spawns earned least", "text"),
    ]
    span = _span([case.episode_return for case in cases])
    body = [
        tag(
            "tr",
            _agent(case.agent),
            _cell(case.episode_return, bar=span),
            _none_cell() if case.over_slower is None else _cell(case.over_slower),
            _cell(case.crashed, 0, 100, " %"),
            tag("td", len(case.attacks), data_value=len(case.attacks)),
            tag("td", case.worst_attack, data_value=case.worst_attack),
            class_="lead" if case.agent == lead else None,
        )
        for case in cases
    ]
    return table(heads, body)


def threats_table(cases: Sequence[Worst], lead: str) -> Markup:
    """Return the worst cases of one scenario in one table, a column a threat; nothing where none is needed."""
    threats = threats_of(cases)
    if not threats:
        return Markup("")
    top = max(case.episode_return.value for case in cases)
    heads = [("agent", "", "text"), *((words, "worst case within this threat", "number") for words in threats.values())]
    body: list[Markup] = []
    for agent in dict.fromkeys(case.agent for case in cases):
        own = {case.threat: case for case in cases if case.agent == agent}
        cells = [
            _attack_cell(AttackCell(case.episode_return, case.crashed), None, top) if case else _none_cell()
            for case in map(own.get, threats)
        ]
        body.append(tag("tr", _agent(agent), *cells, class_="lead" if agent == lead else None))
    return table(heads, body)


def attack_sentences(attacks: Sequence[str], scenario: Scenario) -> list[str]:
    """Return what each attack may do, in metres and m/s."""
    sentences: list[str] = []
    for name in attacks:
        with suppress(RapidError):  # rows may carry a label that is no text of an attack
            sentences.append(f"{name}: {parse_attack(name).describe(scenario.lanes)}")
    return sentences


def caption(rows: Sequence[SummaryRow]) -> Markup:
    """Return the sentence under a table: what the intervals are over."""
    return tag("p", units(rows), class_="caption")


def action_legend() -> Markup:
    """Return the colours of the actions."""
    parts = [tag("span", tag("i", class_=f"swatch action-{index}"), word) for index, word in enumerate(ACTION_WORDS)]
    return tag("p", *parts, class_="legend")


def table(heads: Sequence[tuple[str, str, str]], body: Sequence[Markup]) -> Markup:
    """Return a table that can be sorted, of heads (label, help, what to sort by) and rows."""
    cells: list[Markup] = []
    for label, help_text, sort in heads:
        inside = tag("button", label, type="button") if sort != "none" else text(label)
        cells.append(
            tag(
                "th",
                inside,
                scope="col",
                title=help_text or None,
                data_sort=sort,
                class_="name" if sort == "text" else None,
            )
        )
    head = tag("thead", tag("tr", *cells))
    inner = tag("table", head, tag("tbody", *body), class_="sortable")
    return tag("div", inner, class_="scroll", tabindex="0", role="region", aria_label="table")


def _row_class(row: SummaryRow, lead: str) -> str:
    return "lead" if row.agent == lead else "reference" if row.is_reference else "learned"


def _name(row: SummaryRow, lead: str) -> Markup:
    mark = _MARKS.get(row.kind)
    badge = [tag("span", mark, class_=f"badge {row.kind}", title=KINDS[row.kind])] if mark else []
    if row.agent == lead:
        badge = [tag("span", "this run", class_="badge lead")]
    return tag("th", row.label, *badge, scope="row", class_="name", data_value=row.label.lower())


def _agent(name: str) -> Markup:
    return tag("th", label_of(name), scope="row", class_="name", data_value=label_of(name).lower())


def interval_words(of: Estimate, digits: int = 1, scale: float = 1.0, suffix: str = "") -> str:
    """Return an interval and its unit in words, for a hover."""
    if of.episodes == 0:
        return "not measured"
    if math.isnan(of.low):
        return f"one episode, no interval ({of.unit})"
    low, high = number(of.low, digits, scale), number(of.high, digits, scale)
    return f"95 % interval {low} to {high}{suffix}; {of.unit}"


def _cell(
    of: Estimate, digits: int = 1, scale: float = 1.0, suffix: str = "", bar: tuple[float, float] | None = None
) -> Markup:
    """Return a cell with its interval below."""
    shown = number(of.value, digits, scale)
    inside: list[Markup] = [tag("span", shown + (suffix if shown != NOT_RUN else ""), class_="value")]
    if bar and not math.isnan(of.value):
        inside.append(_interval_bar(of, bar))
    if not math.isnan(of.low):
        inside.append(tag("small", f"{number(of.low, digits, scale)}–{number(of.high, digits, scale)}"))
    value = None if math.isnan(of.value) else of.value
    return tag("td", *inside, data_value=value, title=interval_words(of, digits, scale, suffix))


def _none_cell() -> Markup:
    """Return a cell of what there is no number for."""
    return tag("td", tag("span", NOT_RUN, class_="value none"))


def _plain_cell(of: Estimate, digits: int) -> Markup:
    """Return a cell of a number that was measured once for all episodes, so that an interval would mean nothing."""
    value = None if math.isnan(of.value) else of.value
    return tag("td", tag("span", number(of.value, digits), class_="value"), data_value=value)


def _span(estimates: Sequence[Estimate]) -> tuple[float, float]:
    """Return the ends of the common axis of interval bars: zero, unless something is below it, to the highest end."""
    ends = [end for of in estimates for end in (of.value, of.low, of.high) if not math.isnan(end)]
    low, high = min([0.0, *ends]), max([0.0, *ends])
    return (low, high if high > low else low + 1)


def _interval_bar(of: Estimate, span: tuple[float, float]) -> Markup:
    def percent(value: float) -> float:
        return 100 * (value - span[0]) / (span[1] - span[0])

    low, high = (of.value, of.value) if math.isnan(of.low) else (of.low, of.high)
    left, width = percent(low), percent(high) - percent(low)
    return tag(
        "span",
        tag("i", style=f"left:{left:.2f}%;width:{width:.2f}%"),
        tag("b", style=f"left:{percent(of.value):.2f}%"),
        class_="interval",
        aria_hidden="true",
    )


def _paper_cell(paper: PaperResult | None) -> Markup:
    if paper is None:
        return _none_cell()
    words = f"the paper prints {paper.mean:.2f} ± {paper.spread:.2f}"
    inside = (tag("span", f"{paper.mean:.2f}", class_="value"), tag("small", f"± {paper.spread:.2f}"))
    return tag("td", *inside, data_value=paper.mean, title=words, class_="paper")


def _attack_cell(cell: AttackCell, paper: PaperResult | None, top: float) -> Markup:
    if cell.episode_return is None or cell.crashed is None:
        words = "not applicable" if cell.missing == NOT_APPLICABLE else "not measured"
        return tag("td", tag("span", cell.missing, class_="value none"), title=words)
    of = cell.episode_return
    inside = [tag("span", number(of.value), class_="value")]
    if not math.isnan(of.low):
        inside.append(tag("small", f"{number(of.low)}–{number(of.high)}"))
    if paper is not None:
        inside.append(tag("small", f"paper {paper.mean:.2f}", class_="paper"))
    crashed = number(cell.crashed.value, 0, 100)
    inside.append(tag("small", f"{crashed} % crash"))
    share = 0.0 if math.isnan(of.value) or top <= 0 else min(max(of.value / top, 0), 1)
    return tag(
        "td",
        *inside,
        data_value=None if math.isnan(of.value) else of.value,
        title=f"{interval_words(of)}; crashed in {crashed} %",
        class_="heat",
        style=f"--share:{100 * share:.0f}%",
    )


def _action_bar(shares: Sequence[float]) -> Markup:
    if any(math.isnan(share) for share in shares):
        return tag("span", NOT_RUN, class_="value none")
    words = ", ".join(f"{word} {share:.0%}" for word, share in zip(ACTION_WORDS, shares, strict=True))
    parts = [
        tag("i", class_=f"action-{index}", style=f"width:{100 * share:.2f}%") for index, share in enumerate(shares)
    ]
    return tag("span", *parts, class_="stack", role="img", aria_label=words, title=words)
