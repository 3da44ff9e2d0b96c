"""``rapid reproduce``: the list of exhibits, what one needs, computing it, and the page of all of them."""

import base64
import importlib.resources
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rapid.config import RECIPES
from rapid.engines import Engine, check_engine
from rapid.errors import RapidError, did_you_mean
from rapid.evaluation.summary import aligned
from rapid.experiments import tables
from rapid.experiments.cells import Cell, key
from rapid.experiments.exhibit import Exhibit, Request, Shown
from rapid.experiments.exhibits import ALL, cells_of, recipe_of
from rapid.experiments.figures import Lines, Router, said, save
from rapid.experiments.graph import Outcome, plan, run
from rapid.experiments.latex import latex
from rapid.experiments.learned import EFFORTS
from rapid.experiments.reasons import reason
from rapid.experiments.store import Store
from rapid.experiments.tables import Facts, Table
from rapid.files import write_text
from rapid.pages.markup import Markup, join, tag
from rapid.progress import format_seconds
from rapid.runs import commit, versions

RESULTS = Path("results")
"""Where committed results lie in a checkout; their folder ``cells`` is the store's read-only layer."""

EVERY = "all"
"""Among ids: every exhibit."""


@dataclass(frozen=True)
class Reproduction:
    """What was asked for: exhibits in a recipe at a scale, from a store."""

    exhibits: tuple[Exhibit, ...]
    recipe: str
    """Empty: each exhibit's own first."""
    scale: str
    store: Store

    @property
    def recipes(self) -> list[str]:
        """The recipes in which the exhibits are shown."""
        shown = {self.request(exhibit).recipe for exhibit in self.exhibits}
        return [recipe for recipe in RECIPES if recipe in shown]

    def request(self, exhibit: Exhibit) -> Request:
        """Return the version of an exhibit."""
        return Request(recipe_of(exhibit, self.recipe), self.scale)

    def cells(self) -> list[Cell]:
        """Return the cells of all exhibits, each once."""
        found: dict[str, Cell] = {}
        for exhibit in self.exhibits:
            for cell in cells_of(exhibit, self.request(exhibit).recipe, self.scale):
                found[key(cell)] = cell
        return list(found.values())


def open_reproduction(
    ids: Sequence[str], recipe: str, scale: str, store: Path, layers: Sequence[Path] = ()
) -> Reproduction:
    """Return what is asked for; no id, or `all` among them, is every exhibit that has the recipe.

    No recipe is each exhibit's own first.

    Raises:
        RapidError: an id, recipe or scale does not exist, an exhibit lacks the recipe, or the store cannot be used.
    """
    for kind, value, choices in (("recipe", recipe or RECIPES[0], RECIPES), ("scale", scale, tuple(EFFORTS))):
        if value not in choices:
            raise RapidError(
                f"Unknown {kind} '{value}'{did_you_mean(value, choices)} Choose one of {', '.join(choices)}."
            )
    for name in ids:
        if name == EVERY:
            continue
        if name not in ALL:
            raise RapidError(
                f"There is no exhibit '{name}'{did_you_mean(name, (EVERY, *ALL))} `rapid reproduce` lists them: "
                f"{', '.join(ALL)}; `{EVERY}` is every one."
            )
        if recipe and recipe not in ALL[name].recipes:
            raise RapidError(
                f"'{name}' has no recipe '{recipe}', only {', '.join(ALL[name].recipes)}. Give --recipe "
                f"{ALL[name].recipes[0]}, or none: then each is shown in its own."
            )
    if not ids or EVERY in ids:
        exhibits = tuple(exhibit for exhibit in ALL.values() if not recipe or recipe in exhibit.recipes)
    else:
        exhibits = tuple(ALL[name] for name in dict.fromkeys(ids))
    usual = RESULTS / "cells"
    found = [*layers, *([usual] if usual.is_dir() and usual not in layers else [])]
    for layer in layers:
        if not layer.is_dir():
            raise RapidError(f"There are no results in '{layer}'. Give a directory that --export has written.")
    return Reproduction(exhibits, recipe, scale, Store(store, found, RESULTS if RESULTS.is_dir() else None))


def without_layers(of: Reproduction) -> str:
    """Return what to say where no committed results are read; otherwise nothing."""
    if of.store.layers:
        return ""
    return (
        f"There are no committed results in '{RESULTS / 'cells'}' here, so none of them counts as done. They lie in "
        "RAPID's checkout: start this there to use them.\n"
    )


def listing(of: Reproduction) -> str:
    """Return every exhibit with what is done, predicted time and decisions of language models."""
    lines = [["id", "recipe", "done", "to do", "predicted", "LLM decisions", "what it is"]]
    every: list[Cell] = []
    for exhibit in of.exhibits:
        request = of.request(exhibit)
        cells = cells_of(exhibit, request.recipe, of.scale)
        every += cells
        due = plan(cells, of.store)
        more = f" + {due.unknown} parts of unknown time" if due.unknown else ""
        time = f"{format_seconds(due.seconds)}{more}" if due.todo else "–"
        lines.append(
            [exhibit.id, request.recipe, str(due.done), str(len(due.todo)), time, str(due.decisions), exhibit.caption]
        )
    whole = plan(every, of.store)
    total = f"Together, shared parts once: {len(whole.todo)} to do, {format_seconds(whole.seconds)} for one process"
    asked = f"{whole.decisions} decisions of language models; scale {of.scale}."
    return f"{without_layers(of)}{aligned(lines)}\n\n{total}, as predicted, {asked}"


def reproduce(
    of: Reproduction,
    out: Path,
    engine: Engine = "local",
    workers: int = 1,
    say: Callable[[str], None] = print,
) -> tuple[Outcome, Path]:
    """Compute what is missing and write the page; return what was done and the page's path.

    Raises:
        RapidError: the engine cannot be had, or the page cannot be written.
    """
    check_engine(engine)
    due = plan(of.cells(), of.store)
    say(
        f"{without_layers(of)}"
        f"{len(due.todo)} parts to compute, {due.done} done before; predicted {format_seconds(due.seconds / workers)}"
        f"{f' and {due.unknown} parts of unknown time' if due.unknown else ''}, {due.decisions} LLM decisions."
    )
    outcome = run(due.todo, of.store, engine, workers, say)
    return outcome, write_page(of, out, outcome)


def write_page(of: Reproduction, out: Path, outcome: Outcome | None = None) -> Path:
    """Write every table and figure, the raw rows, and one page of all; return the page's path.

    Raises:
        RapidError: the directory cannot be written.
    """
    sections: list[Markup] = []
    summary: list[Markup] = []
    for exhibit in of.exhibits:
        request = of.request(exhibit)
        of.store.shown.clear()
        shown = exhibit.show(request, of.store, exhibit)
        measured = _commits([name for name, _ in of.store.shown.most_common()])
        command = f"rapid reproduce {exhibit.id} --recipe {request.recipe} --scale {of.scale}"
        cells = cells_of(exhibit, request.recipe, of.scale)
        raw = of.store.export(cells, out / "rows", f"{exhibit.id}-{request.recipe}-{of.scale}")
        blocks: list[Markup] = []
        for each in shown:
            blocks.append(_block(each, out))
        failed = [outcome.failed[key(cell)] for cell in cells if outcome and key(cell) in outcome.failed]
        if failed:
            reasons = tag("ul", *(tag("li", reason) for reason in dict.fromkeys(failed)))
            blocks.append(tag("div", tag("b", f"{len(failed)} parts failed."), reasons, class_="failed"))
        links = join([tag("a", path.name, href=f"rows/{path.name}") for path in raw], " ") if raw else "none"
        foot = tag("p", "Made with ", tag("code", command), ". ", measured, "Raw rows: ", links, class_="note")
        sections.append(tag("section", tag("h2", exhibit.id), tag("p", exhibit.caption), *blocks, foot, id=exhibit.id))
        sentences = verdicts(exhibit, shown) or ([f"{exhibit.id}: no verdicts."] if exhibit.of_paper else [])
        if sentences:
            why = tag("small", f"Why, at full scale: {reason(exhibit.id, request.recipe)}", class_="line")
            summary.append(tag("li", " ".join(sentences), why))
    page = out / "index.html"
    style = importlib.resources.files("rapid.experiments").joinpath("page.css").read_text(encoding="utf-8")
    about = versions()
    head = join(
        [
            tag("h1", "The paper, reproduced"),
            tag(
                "p",
                f"{_recipes(of)}, scale {of.scale}. Ours: mean and interquartile mean (IQM) with 95 % intervals, "
                "crash share, and trainings × spawns; the paper's number as printed. ≈ the paper's mean lies in our "
                "interval; ▲ our interval lies above it; ▼ below it; fewer than five trainings are no verdict.",
            ),
            tag("h2", "What reproduces, what does not, and why"),
            tag("ul", *summary) if summary else tag("p", "Nothing here has numbers of the paper beside it."),
            tag("nav", *(tag("a", exhibit.id, href=f"#{exhibit.id}") for exhibit in of.exhibits)),
        ]
    )
    made = ", ".join(f"{name} {version}" for name, version in about.items())
    foot = tag("footer", f"This page was written by commit {commit() or 'unknown'}. {made}.")
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    html = (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'><meta name='viewport' "
        f'content=\'width=device-width\'><meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>The paper, reproduced</title><style>{style}</style></head><body><main>"
        f"{head}{join(sections)}{foot}</main></body></html>\n"
    )
    write_text(page, html)
    return page.resolve()


def _commits(names: Sequence[str]) -> Markup:
    """Return the commits that measured what an exhibit shows, shortened; they need not be the one that writes it."""
    if not names:
        return Markup()
    known = [tag("code", f"{name[:9]}{'+changes' if name.endswith('+changes') else ''}") for name in names if name]
    parts = [join(["commit ", join(known, ", ")])] if known else []
    if "" in names:
        parts.append(Markup("a commit that nobody wrote down"))
    return join(["Measured by ", join(parts, " and "), ". "])


def _recipes(of: Reproduction) -> str:
    """Return the recipes of a page, as its first words."""
    if len(of.recipes) == 1:
        return f"Recipe {of.recipes[0]}"
    return f"Recipes {' and '.join(of.recipes)}, as the command under each says"


def _block(shown: Shown, out: Path) -> Markup:
    """Write one table or figure in every form, and return it as HTML."""
    if isinstance(shown, Lines | Router):
        written = save(shown, out / "figures")
        picture = base64.b64encode(written[0].read_bytes()).decode()
        links = join([tag("a", path.name, href=f"figures/{path.name}") for path in written], " ")
        facts = shown.data()
        return tag(
            "figure",
            Markup(f'<img alt="{tables_text(facts)}" src="data:image/png;base64,{picture}">'),
            tag(
                "figcaption",
                shown.caption,
                " ",
                tag("b", said(shown.gap), class_="gap") if shown.gap else "",
                " ",
                links,
            ),
            tag("details", tag("summary", "The numbers"), tables.html(facts)),
        )
    write_text(out / "tables" / f"{shown.id}.md", tables.markdown(shown) + "\n")
    write_text(out / "tables" / f"{shown.id}.tex", latex(shown) + "\n")
    links = join(
        [tag("a", f"{shown.id}.{ending}", href=f"tables/{shown.id}.{ending}") for ending in ("md", "tex")], " "
    )
    return join([tables.html(shown), tag("p", links, class_="note")])


def tables_text(facts: Facts) -> str:
    """Return what a picture shows in words, for who cannot see it; escaped."""
    return Markup(tag("i", facts.caption))[3:-4]


def verdicts(exhibit: Exhibit, shown: Sequence[Shown]) -> list[str]:
    """Return one sentence for each table with the paper's numbers: how many are inside, above, below, and which."""
    found: list[str] = []
    for table in shown:
        if not isinstance(table, Table):
            continue
        counted: dict[str, list[str]] = {}
        for names, entries in table.rows:
            for column, each in zip(table.columns, entries, strict=True):
                if each.printed is not None:
                    word = each.verdict or "missing"
                    counted.setdefault(word, []).append(f"{', '.join(names)}, {column}")
        if not counted:
            continue
        order = ("inside", "above", "below", "insufficient", "missing")
        counts = ", ".join(f"{len(counted[word])} {word}" for word in order if word in counted)
        which = f" Below: {'; '.join(counted['below'][:6])}." if "below" in counted else ""
        more = f" And {len(counted['below']) - 6} more." if len(counted.get("below", ())) > 6 else ""
        found.append(f"{exhibit.id}: of {sum(map(len, counted.values()))} printed numbers, {counts}.{which}{more}")
    return found


def text_of(of: Reproduction) -> str:
    """Return the tables asked for as text, for a terminal."""
    parts: list[str] = []
    for exhibit in of.exhibits:
        for shown in exhibit.show(of.request(exhibit), of.store, exhibit):
            table: Any = shown.data() if isinstance(shown, Lines | Router) else shown
            parts.append(f"== {exhibit.id}\n{tables.text(table)}")
    return "\n\n".join(parts)
