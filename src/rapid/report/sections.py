"""The sections of the page that are text, tables and bars; its script draws the curves and the moving pictures."""

from collections.abc import Mapping, Sequence
from typing import Any

from rapid.evaluation.statistics import ENOUGH_SEEDS
from rapid.evaluation.summary import NOT_APPLICABLE, NOT_APPLICABLE_WHY, NOT_RUN, SummaryRow, ahead_of, number
from rapid.evaluation.worst import worst_cases
from rapid.pages.markup import Markup, facts, join, tag
from rapid.progress import format_seconds
from rapid.report.data import ReportData, paper_return
from rapid.report.tables import (
    action_legend,
    attack_sentences,
    attack_table,
    caption,
    interval_words,
    results_table,
    threats_table,
    worst_table,
)
from rapid.scenarios import get_scenario


def section(identity: str, title: str, *children: object) -> Markup:
    """Return a section with its heading."""
    return tag(
        "section", tag("h2", title, id=f"{identity}-title"), *children, id=identity, aria_labelledby=f"{identity}-title"
    )


def missing(what: str) -> Markup:
    """Return the sentence that stands where a part of the run is missing."""
    return tag("p", what, class_="missing")


def head(run: ReportData) -> Markup:
    """Return the headline: what was run, of what, how long each step took."""
    setting = run.settings
    known = [
        ("scenario", setting.get("scenario")),
        ("recipe", setting.get("recipe")),
        ("scale", setting.get("scale")),
        ("seed", setting.get("seed")),
        ("simulator", setting.get("simulator")),
        ("started", run.started),
        (
            "commit",
            tag("code", run.commit[:12] + ("+changes" if run.commit.endswith("+changes") else ""))
            if run.commit
            else "",
        ),
    ]
    parts: list[Markup] = [
        tag("h1", run.title),
        facts((name, value) for name, value in known if value not in (None, "")),
    ]
    if run.command:
        parts.append(tag("p", "Repeat it with ", tag("code", run.command), class_="command"))
    if run.trained:
        parts.append(_timeline(run.timings))
    return tag("header", *parts)


def _timeline(timings: Mapping[str, float]) -> Markup:
    total = sum(timings.values())
    if total <= 0:
        return missing("The wall time of the steps was not recorded.")
    bars = [
        tag(
            "i",
            class_=f"step-{number % 6}",
            style=f"width:{100 * seconds / total:.2f}%",
            title=f"{step}: {format_seconds(seconds)}",
        )
        for number, (step, seconds) in enumerate(timings.items())
    ]
    words = [
        tag("span", tag("i", class_=f"swatch step-{number % 6}"), f"{step} {format_seconds(seconds)}")
        for number, (step, seconds) in enumerate(timings.items())
    ]
    words.append(tag("span", tag("b", f"{format_seconds(total)} in all")))
    return tag(
        "div",
        tag("span", *bars, class_="stack wide", aria_hidden="true"),
        tag("p", *words, class_="legend"),
        class_="timeline",
    )


def results(run: ReportData, summaries: Sequence[SummaryRow]) -> Markup:
    """Return how all agents drive."""
    if not summaries:
        return section("results", "How they drive", missing("No episodes were measured."))
    parts: list[Markup] = []
    for scenario in dict.fromkeys(row.scenario for row in summaries):
        here = [row for row in summaries if row.scenario == scenario]
        lead = next((row for row in here if row.agent == run.lead), None)
        parts.append(tag("h3", scenario))
        if lead is not None:
            parts.append(_tiles(lead, here))
        parts += [results_table(here, run.lead), action_legend(), caption(here)]
    parts.append(
        tag(
            "p",
            "Under the normalised reward a parked car earns about two thirds of the most that a step can pay, so the "
            "return alone proves little: read it beside crashes, speed, distance and the rows marked floor. Rows "
            "marked floor, teacher and planner are there to compare with. The planner knows the simulator; it is a "
            "reference, not a bound.",
            class_="caption",
        )
    )
    parts += [tag("p", line) for line in ahead_of(run.rows, run.lead)]
    return section("results", "How they drive", *parts, _verdict(run, summaries))


def _verdict(run: ReportData, summaries: Sequence[SummaryRow]) -> Markup:
    ours = [row for row in summaries if row.agent == run.lead and paper_return(row.origin, get_scenario(row.scenario))]
    if not ours:
        return Markup("")
    trainings = min(row.metrics["episode_return"].training_seeds for row in ours)
    if trainings < ENOUGH_SEEDS:
        return tag(
            "p",
            f"Against the paper: insufficient. A verdict needs at least {ENOUGH_SEEDS} training seeds; here there "
            f"{'is' if trainings == 1 else 'are'} {trainings}.",
            class_="caption",
        )
    words: list[str] = []
    for row in ours:
        of, paper = row.metrics["episode_return"], paper_return(row.origin, get_scenario(row.scenario))
        assert paper is not None
        where = "above" if of.low > paper.mean else "below" if of.high < paper.mean else "around"
        words.append(f"{row.scenario}: our interval lies {where} the paper's mean of {paper.mean:.2f}.")
    return tag("p", "Against the paper: ", " ".join(words), class_="caption")


def _tiles(lead: SummaryRow, rows: Sequence[SummaryRow]) -> Markup:
    """Return the few numbers of the agent that the run is about."""
    of = lead.metrics
    paper = paper_return(lead.origin, get_scenario(lead.scenario))
    tiles = [
        _tile("return", number(of["episode_return"].value), interval_words(of["episode_return"])),
        _tile(
            "episodes with a crash",
            f"{number(of['crashed'].value, 0, 100)} %",
            interval_words(of["crashed"], 0, 100, " %"),
        ),
        _tile("mean speed", f"{number(of['mean_speed'].value)} m/s", interval_words(of["mean_speed"])),
        _tile("distance", f"{number(of['distance'].value, 0)} m", interval_words(of["distance"], 0)),
    ]
    if paper is not None:
        tiles.insert(1, _tile("the paper's return", f"{paper.mean:.2f}", f"± {paper.spread:.2f}, as printed"))
    slower = next((row for row in rows if row.origin == "slower"), None)
    planner = next((row for row in rows if row.origin == "planner"), None)
    if slower is not None and planner is not None:
        floor, top = slower.metrics["episode_return"].value, planner.metrics["episode_return"].value
        ours = of["episode_return"].value
        if floor <= ours and floor < top:
            way = f"{number((ours - floor) / (top - floor), 0, 100)} %"
            tiles.append(_tile("of the way to the planner", way, f"from always-slower, {floor:.1f}, to {top:.1f}"))
        else:
            tiles.append(_tile("against always-slower", f"{ours - floor:+.1f}", f"which gets {floor:.1f}"))
    return tag("div", *tiles, class_="tiles")


def _tile(label: str, value: str, more: str) -> Markup:
    return tag("div", tag("span", label), tag("b", value), tag("small", more), class_="tile")


def attacks(run: ReportData, summaries: Sequence[SummaryRow]) -> Markup:
    """Return what attacks leave, and what their sizes mean on the road."""
    if not any(row.attacks for row in summaries):
        return section("attacks", "Under attack", missing("No attacks were measured."))
    parts: list[Markup] = []
    for scenario in dict.fromkeys(row.scenario for row in summaries):
        here = [row for row in summaries if row.scenario == scenario and row.attacks]
        if not here:
            continue
        lanes = get_scenario(scenario).lanes
        parts += [
            tag("h3", scenario),
            tag(
                "p",
                "The observation is perturbed, the driving is measured in the true world. Sizes are in features scaled "
                f"to ±1, so on this road ε = 0.1 means up to 20 m along it, {0.4 * lanes:g} m across it and 8 m/s, "
                "on every vehicle at once. Near that size, only an agent that ignores what it sees is safe.",
            ),
            attack_table(here, run.lead),
            tag(
                "ul",
                *(tag("li", words) for words in attack_sentences(list(here[0].attacks), get_scenario(scenario))),
                class_="caption",
            ),
            tag(
                "p",
                f"{NOT_APPLICABLE}: {NOT_APPLICABLE_WHY} {NOT_RUN}: not measured.",
                class_="caption",
            ),
        ]
    return section("attacks", "Under attack", *parts)


def worst(run: ReportData) -> Markup:
    """Return the worst case over attacks of the same size, and over sizes if several were measured; else nothing."""
    cases = worst_cases(run.rows)
    if not cases:
        return Markup("")
    parts: list[Markup] = []
    for scenario in dict.fromkeys(case.scenario for case in cases):
        if table := threats_table([case for case in cases if case.scenario == scenario], run.lead):
            parts += [tag("h3", f"{scenario}, within each threat"), table]
    for scenario, threat in dict.fromkeys((case.scenario, case.threat) for case in cases):
        here = [case for case in cases if (case.scenario, case.threat) == (scenario, threat)]
        parts += [tag("h3", f"{scenario}, within {threat.words(get_scenario(scenario).lanes)}")]
        parts += [worst_table(here, run.lead)]
    intro = (
        "An attacker chooses anew for every spawn. A worst case is the mean over spawns of the least return under any "
        "of the attacks of one size, no attack among them. Agents without a network meet fewer attacks, so theirs is "
        "an upper bound of what the same attacker could do."
    )
    return section("worst", "The worst case", tag("p", intro), *parts, tag("div", id="worst-canvas"))


def dataset(numbers: Mapping[str, Any]) -> Markup:
    """Return the numbers of the dataset card."""
    if not numbers:
        return section("dataset", "The data", missing("The dataset's numbers were not recorded."))
    return section("dataset", "The data", _nested(numbers))


def _nested(numbers: Mapping[str, Any]) -> Markup:
    """Return nested facts: plain ones in a list, each deeper level under its name."""
    plain = [(_words(key), _value(value)) for key, value in numbers.items() if not isinstance(value, Mapping)]
    parts: list[Markup] = [facts(plain)] if plain else []
    for key, value in numbers.items():
        if isinstance(value, Mapping) and value:
            parts.append(tag("div", tag("h4", _words(key)), _nested(value), class_="nested"))
    return join(parts)


def _words(key: object) -> str:
    return str(key).replace("_", " ")


def _value(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list | tuple):
        return ", ".join(_value(item) for item in value)
    return str(value)


def made_by(run: ReportData) -> Markup:
    """Return the notes, and, folded away, all settings and versions."""
    parts: list[Markup] = []
    if run.notes:
        parts.append(tag("ul", *(tag("li", note) for note in run.notes)))
    for title, values in (("Settings", run.settings), ("Versions", run.versions)):
        body = _nested(values) if values else missing("Not recorded.")
        parts.append(tag("details", tag("summary", title), body))
    return section("made-by", "Notes and settings", *parts)


def drawn(identity: str, title: str, present: bool, intro: str, absent: str) -> Markup:
    """Return a section that the page's script fills, or the sentence that says why it is empty."""
    if not present:
        return section(identity, title, missing(absent))
    fallback = tag(
        "noscript", tag("p", "This part is drawn by a script, which is switched off here.", class_="missing")
    )
    return section(identity, title, tag("p", intro), tag("div", id=f"{identity}-canvas"), fallback)
