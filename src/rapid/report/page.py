"""The page: one HTML file with everything in it, which opens from disk and asks the network for nothing."""

import base64
import hashlib
import os
import re
from importlib import resources
from pathlib import Path

from rapid.evaluation.summary import summarize, summary_text
from rapid.files import write_text
from rapid.report import sections
from rapid.report.curves import charts, moving_picture
from rapid.report.data import ReportData
from rapid.report.markup import Markup, join, script_json, tag, text
from rapid.report.routing import routing
from rapid.report.tables import ACTION_WORDS
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
    pictures = [moving_picture(recording) for recording in run.recordings if len(recording.action_T)]
    lanes = get_scenario(str(run.settings.get("scenario", PAPER_SCENARIOS[0]))).lanes
    body = join(
        [
            sections.head(run),
            sections.results(run, summaries),
            sections.drawn(
                "watch",
                "Watch it drive",
                bool(pictures),
                "The road from above, moving with the ego; the numbers are ranks by distance, as the teacher names the "
                "cars. Space plays and pauses, the arrow keys step.",
                "No episode was recorded.",
            ),
            sections.attacks(run, summaries),
            sections.drawn(
                "curves",
                "Learning curves",
                bool(curves),
                "Point at a curve to read it; click a name to hide it. Returns are of tuning spawns, which are never "
                "those of the tables.",
                "No training was recorded.",
            ),
            routing(run.routing, lanes),
            sections.dataset(run.dataset),
            sections.made_by(run),
            tag("details", tag("summary", "The summary as plain text"), tag("pre", summary_text(run.rows))),
        ]
    )
    script = _file("page.js")
    return _fill(
        _file("page.html"),
        title=text(run.title),
        # The script's own hash: no other script runs here, whatever text found its way into the page.
        policy=text(
            f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{_hash(script)}'; img-src data:; "
            "base-uri 'none'; form-action 'none'"
        ),
        style=Markup(_file("page.css")),
        body=body,
        payload=script_json({"actions": ACTION_WORDS, "charts": curves, "episodes": pictures}),
        script=Markup(script),
    )


def _file(name: str) -> str:
    return resources.files(__package__ or "rapid.report").joinpath(name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _fill(template: str, **parts: Markup) -> str:
    """Put the parts in their places, in one pass: a part that looks like a place stays what it is."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: str(parts[match[1]]), template)
