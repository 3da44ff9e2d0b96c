"""The page: one HTML file with everything in it, which opens from disk and asks the network for nothing."""

import os
from pathlib import Path

from rapid.evaluation.summary import summarize, summary_text
from rapid.files import write_text
from rapid.pages import PLAYER, fill_page
from rapid.pages.episodes import ACTION_WORDS, in_order, side_by_side
from rapid.pages.markup import Markup, join, tag
from rapid.report import sections
from rapid.report.crashes import crashes
from rapid.report.curves import charts
from rapid.report.data import ReportData
from rapid.report.routing import routing
from rapid.report.sweep import sweep_charts
from rapid.scenarios import PAPER_SCENARIOS, get_scenario


def write_report(run: ReportData, path: str | os.PathLike[str]) -> Path:
    """Write the page of a run and return its absolute path; a directory gets ``report.html``.

    Raises:
        RapidError: the file cannot be written.
    """
    target = Path(path)
    target = target / "report.html" if target.is_dir() else target
    write_text(target, page(run))
    return target.resolve()


def page(run: ReportData) -> str:
    """Return the page of a run as HTML."""
    summaries = summarize(run.rows)
    curves = charts(run.distill, run.adapt)
    pictures = side_by_side(run.recordings)
    lanes = get_scenario(str(run.settings.get("scenario", PAPER_SCENARIOS[0]))).lanes
    body = join(
        [
            sections.head(run),
            sections.results(run, summaries),
            crashes(run.rows, in_order(run.recordings)),
            sections.drawn(
                "watch",
                "Watch it drive",
                bool(pictures),
                "The road from above, moving with the ego; the numbers are ranks by distance, as the teacher names the "
                "cars. A car's colour says how much of the decision about it is policy 1's, which was distilled, and "
                "how much the adapter's. Space plays and pauses, the arrow keys step, c goes to the crash.",
                "No episode was recorded.",
            ),
            sections.attacks(run, summaries),
            sections.worst(run),
            *(_training(run, bool(curves), lanes) if run.trained else ()),
            sections.made_by(run),
            tag("details", tag("summary", "The summary as plain text"), tag("pre", summary_text(run.rows))),
        ]
    )
    return fill_page(
        run.title,
        body,
        {"actions": ACTION_WORDS, "charts": curves, "worst": sweep_charts(run.rows), "episodes": pictures},
        scripts=(*PLAYER, "tables.js", "charts.js", "report.js"),
        styles=("base.css", "report.css", "player.css"),
    )


def _training(run: ReportData, has_curves: bool, lanes: int) -> list[Markup]:
    """Return what there is to say of trainings: their curves, what phase 3 made of the routing, their data."""
    return [
        sections.drawn(
            "curves",
            "Learning curves",
            has_curves,
            "Point at a curve to read it; click a name to hide it. Returns are of tuning spawns, which are never "
            "those of the tables.",
            "No training was recorded.",
        ),
        routing(run.routing, lanes),
        sections.dataset(run.dataset),
    ]
