import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rapid.cli import main
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow
from rapid.experiments import readme, tables
from rapid.experiments.exhibit import Request, Shown, method_drives, rows_of
from rapid.experiments.exhibits import ALL, worst_entry
from rapid.experiments.figures import Curve, Lines, Point, Router, draw, save
from rapid.experiments.latex import latex
from rapid.experiments.methods import METHODS
from rapid.experiments.migrate import FILES, LABELS, Legacy, legacy_rows
from rapid.experiments.paper import PaperResult
from rapid.experiments.reasons import NOT_EXAMINED, REASONS, reason
from rapid.experiments.reproduce import listing, open_reproduction, verdicts, write_page
from rapid.experiments.store import Store
from rapid.experiments.tables import Entry, Facts, Table, entry
from rapid.files import write_json

RESULTS = Path(__file__).parents[2] / "results"


def command(*words: str) -> object:
    """Return how a command ends."""
    with pytest.raises(SystemExit) as stop:
        main(list(words))
    return stop.value.code


def rows(mean: float, seeds: int, spawns: int = 20) -> list[EpisodeRow]:
    # Symmetric about the mean, so that the mean is exact.
    offsets = np.linspace(-2, 2, spawns)
    return [
        EpisodeRow(
            *("lane-3-density-2", "RAPID", spawn, "none", mean + float(offsets[spawn]), 30, False, 2.0, 60.0, 0, 9.0),
            (0.0, 0.0, 0.0, 0.0, 1.0),
            training_seed=seed,
        )
        for seed in range(seeds)
        for spawn in range(spawns)
    ]


@pytest.mark.parametrize(
    ("mean", "seeds", "printed", "verdict"),
    [
        (20.0, 5, 20.0, "inside"),
        (20.0, 5, 10.0, "above"),
        (20.0, 5, 30.0, "below"),
        (20.0, 4, 10.0, "insufficient"),
    ],
)
def test_a_verdict_needs_five_trainings_and_an_interval(mean: float, seeds: int, printed: float, verdict: str):
    assert entry(rows(mean, seeds), PaperResult(printed, 3.0)).verdict == verdict


def test_the_worst_case_counts_only_trainings_that_met_every_attack():
    strong = [replace(row, agent="of before cells") for row in rows(5, 3)]
    each = worst_entry({"none": (rows(20, 5), ""), "world": (strong, "2 of 5 parts are missing")})
    assert each.mean is not None
    assert each.mean.value == pytest.approx(5)  # never the 20 of trainings that were not attacked
    assert (each.mean.training_seeds, each.mean.episodes) == (3, 60)
    assert each.failed == "world: 2 of 5 parts are missing"
    nobody = worst_entry({"none": (rows(20, 1), ""), "world": ([], "5 of 5 parts are missing")})
    assert (nobody.mean, nobody.failed) == (None, "world: 5 of 5 parts are missing")
    apart = {"none": (rows(20, 1), ""), "world": ([replace(row, training_seed=1) for row in rows(5, 1)], "")}
    assert worst_entry(apart).failed == "no training met every attack"


def test_no_numbers_of_the_paper_are_no_verdict():
    assert entry(rows(20, 5)).verdict == ""
    assert entry([], PaperResult(1, 1), "2 of 3 parts are missing").verdict == ""


TABLE = Table(
    "attack",
    "Return & more | under attack",
    ("scenario", "method"),
    ("none", "pgd_50"),
    ((("lane-3 <b>", "A|B"), (entry(rows(20.42, 5), PaperResult(20.42, 2.59)), Entry(failed="not driven"))),),
    ("A note.",),
)


def test_tables_are_written_in_every_form_with_what_is_missing():
    assert "20.42 ± 2.59" in tables.text(TABLE)
    assert "inside" in tables.text(TABLE)
    markdown = tables.markdown(TABLE).splitlines()
    assert len({line.count("|") for line in markdown if line.startswith("|")}) == 1
    assert r"pgd\_50" in latex(TABLE)
    assert r"Return \& more \textbar{} under attack" in latex(TABLE)
    html = tables.html(TABLE)
    assert "<b>" not in html.split("lane-3 ")[1][:3]
    assert "not driven" in html


def test_what_is_missing_of_a_cell_stands_beside_its_numbers_in_every_form():
    partial = entry(rows(20, 3), PaperResult(30, 1), "2 of 5 parts are missing")
    table = replace(TABLE, rows=((("lane-3", "RAPID"), (partial, entry(rows(20, 5)))),))
    for form in (tables.text, tables.markdown, latex, tables.html):
        assert form(table).count("2 of 5 parts are missing") == 1
    assert "missing" not in tables.short(partial)  # README's rows say how many trainings they have


def test_every_form_shows_both_means_with_intervals_and_of_how_many_episodes():
    found = entry(rows(20, 5))
    untrained = entry([replace(row, training_seed=None) for row in rows(20, 1)])
    assert found.iqm is not None
    assert found.iqm is found.iqm  # made once: its interval is slow
    interval = f"IQM {found.iqm.value:.1f} [{found.iqm.low:.1f}, {found.iqm.high:.1f}]"
    table = replace(TABLE, rows=((("lane-3", "RAPID"), (found, untrained)),))
    for form in (tables.text, tables.markdown, latex, tables.html):
        assert interval in form(table)
    html = tables.html(table)
    assert ">5×20<" in html
    assert ">20 spawns<" in html


def test_latex_has_no_sign_that_its_usual_fonts_print_as_another_and_fits_the_text():
    ((names, entries),) = TABLE.rows
    assert "resizebox" not in latex(TABLE)
    wide = latex(replace(TABLE, columns=TABLE.columns * 3, rows=((names, entries * 3),)))
    assert wide.splitlines()[0] == "% Needs \\usepackage{booktabs,graphicx}."
    assert "lane-3 \\textless{}b\\textgreater{}" in wide
    assert not set(wide) & set('|<>"')
    assert wide.count("\\resizebox{\\textwidth}{!}{%") == 1
    assert wide.count("{") - wide.count("\\{") == wide.count("}") - wide.count("\\}")
    assert wide.count("\\begin{tabular}") == wide.count("\\end{tabular}") == 1 + 6
    words = Facts(
        "prompt", "A caption.", ("who", "says"), (("[tool]", 'a "long"\nanswer\n\n' + 60 * "x"),), ("A note.",)
    )
    lines = latex(words).splitlines()
    assert "\\resizebox" not in latex(words)
    assert any(line.startswith("\\begin{tabular}{lp{0.") for line in lines)
    (row,) = [line for line in lines if "tool" in line]
    # A bracket after the end of a row would be read as a distance.
    assert row.startswith("{}[tool] & a ''long''\\newline answer\\newline \\newline xxx")
    assert any("A note." in line for line in lines)
    assert "{ll}" in latex(Facts("short", "A caption.", ("a", "b"), (("1", "2"),)))


def test_what_the_paper_prints_stands_also_where_ours_is_missing():
    table = replace(TABLE, rows=((("lane-3", "RAPID"), (entry([], PaperResult(30, 1)), Entry())),))
    for form in (tables.text, tables.markdown, tables.html):
        assert "30.00 ± 1.00" in form(table)


def test_the_page_says_in_words_what_reproduces():
    table = replace(TABLE, rows=((("lane-3", "RAPID"), (entry(rows(20, 5), PaperResult(30, 1)), Entry())),))
    (sentence,) = verdicts(ALL["attack"], [table])
    assert "1 below" in sentence
    assert "lane-3, RAPID, none" in sentence


def test_every_exhibit_of_the_paper_has_a_reason_or_says_that_nobody_looked(tmp_path: Path):
    names = {name.partition(":")[0] for name in REASONS}
    assert names <= ALL.keys()
    assert {name.partition(":")[2] for name in REASONS} <= {"", "paper", "strong"}
    assert {exhibit.id for exhibit in ALL.values() if exhibit.of_paper} <= names
    assert reason("offline", "strong") == NOT_EXAMINED  # measured in the other recipe only
    assert "router" in reason("routing", "paper")
    docs = RESULTS.parent / "docs"
    assert all(
        (docs.parent / path).is_file() for text in REASONS.values() for path in re.findall(r"docs/[\w/]+\.md", text)
    )
    of = open_reproduction(("attack", "beta", "environment"), "paper", "tiny", tmp_path / "store")
    page = write_page(of, tmp_path / "page").read_text()
    assert "all five end near braking" in page
    assert "Why, at full scale: not examined" in page
    assert "environment: no verdicts." in page


def test_figures_are_the_same_bytes_for_the_same_points(tmp_path: Path):
    lines = Lines("x", "A figure.", (Curve("a $1", (Point(0, 1, 0, 2), Point(1, 2, math.nan, math.nan))),), "x", "y")
    first = [path.read_bytes() for path in save(lines, tmp_path / "a")]
    assert first == [path.read_bytes() for path in save(lines, tmp_path / "b")]
    obs = [[1.0, 0.0, 4.0, 20.0, 0.0], [1.0, 30.0, 0.0, 20.0, 0.0], [0.0] * 5]
    router = Router("r", "Scene.", obs, [[0.9, 0.1], [0.4, -0.6], [1.0, 0.0]], 3)
    assert [row[0] for row in router.data().rows] == ["ego", "1"]
    assert all(path.stat().st_size > 1000 for path in save(router, tmp_path))


def test_curves_join_phases_and_trainings():
    offline = [{"iteration": 10, "evaluation": {"return": 1.0}}, {"iteration": 20, "evaluation": {"return": 2.0}}]
    online = [{"step": 5, "evaluation": {"return": 4.0}}, {"step": 7, "evaluation": None}]
    better = [{"step": 5, "evaluation": {"return": 6.0}}]
    curve = Curve.of_metrics("RAPID", [(offline, online), (offline, better)], 20)
    assert curve.points == (Point(10, 1, 1, 1), Point(20, 2, 2, 2), Point(25, 5, 4, 6))


@pytest.mark.parametrize(
    ("recipe", "method", "scenario", "attack", "count"),
    [
        ("strong", "rapid-ppo", "lane-4-density-2.5", "pgd", 1000),
        ("strong", "slower", "lane-5-density-3:progress", "none", 200),
        ("paper", "rapid", "lane-3-density-2", "none", 1000),
        # Presence was left alone there, which is not what the recipe says today.
        ("paper", "rapid", "lane-3-density-2", "pgd", 0),
        ("strong", "nobody", "lane-3-density-2", "none", 0),
    ],
)
def test_committed_rows_keep_their_meaning(recipe: str, method: str, scenario: str, attack: str, count: int):
    assert len(legacy_rows(RESULTS, Legacy(recipe, method, scenario, attack))) == count


def test_an_unknown_label_in_the_committed_rows_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / FILES["paper"][0]).write_bytes((RESULTS / FILES["paper"][0]).read_bytes())
    monkeypatch.delitem(LABELS["paper"], "CQL")
    with pytest.raises(RapidError, match="'CQL'"):
        legacy_rows(tmp_path, Legacy("paper", "rapid", "lane-3-density-2", "none"))


def test_a_page_of_nothing_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    of = open_reproduction(("attack", "environment", "ratio"), "paper", "tiny", tmp_path / "store")
    # Whoever asks elsewhere than in a checkout is told why nothing is done.
    assert listing(of).startswith("There are no committed results in")
    (tmp_path / "results" / "cells").mkdir(parents=True)
    beside = open_reproduction(("attack",), "paper", "tiny", tmp_path / "store")
    assert listing(beside).startswith("id")
    page = write_page(of, tmp_path / "page").read_text()
    assert "parts are missing" in page
    assert "KinematicsObservation" in page
    assert (tmp_path / "page" / "tables" / "attack.tex").exists()
    assert (tmp_path / "page" / "figures" / "ratio.svg").exists()


def test_no_figure_and_no_table_of_words_hides_that_parts_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store = Store(tmp_path / "store")
    for exhibit in ALL.values():
        request = Request(exhibit.recipes[0], "tiny")
        for shown in exhibit.show(request, store, exhibit) if exhibit.cells(request) else ():
            if isinstance(shown, Table):
                continue  # says so in each of its cells
            assert "othing has been computed yet: " in _notes(shown) or "are missing" in _notes(shown), exhibit.id
            assert isinstance(shown, Facts) or not shown.complete
    request = Request("paper", "tiny")
    (ratio,) = ALL["ratio"].show(request, store, ALL["ratio"])
    count = len(ALL["ratio"].cells(request))
    assert _notes(ratio) == f"Nothing has been computed yet: {count} parts."
    first = ALL["ratio"].cells(request)[0]
    monkeypatch.setattr(store, "is_done", lambda cell: cell == first)
    monkeypatch.setattr(store, "rows", lambda cell: rows(20, 1))
    (ratio,) = ALL["ratio"].show(request, store, ALL["ratio"])
    assert _notes(ratio) == f"{count - 1} of {count} parts are missing."
    assert isinstance(ratio, Lines)
    assert draw(ratio).axes[0].get_title("right") == f"{count - 1} of {count} parts are missing"


def _notes(shown: Shown) -> str:
    return " ".join((shown.data() if isinstance(shown, Lines | Router) else shown).notes)


def test_the_page_names_the_commits_that_measured_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    of = open_reproduction(("ratio", "efficiency"), "paper", "tiny", tmp_path / "store")
    done = {ALL["ratio"].cells(of.request(ALL["ratio"]))[0]}
    commits = ["a" * 40, f"{'b' * 40}+changes", ""]
    monkeypatch.setattr(of.store, "is_done", done.__contains__)
    monkeypatch.setattr(of.store, "export", lambda *_: [])
    monkeypatch.setattr(
        of.store, "rows", lambda cell: [replace(row, commit=commits[row.seed % 3]) for row in rows(20, 1)]
    )
    page = write_page(of, tmp_path / "page").read_text()
    ratio, efficiency = page.split("<section")[1:]
    said = "<code>aaaaaaaaa</code>, <code>bbbbbbbbb+changes</code> and a commit that nobody wrote down. Raw rows"
    assert f"Measured by commit {said}" in ratio
    assert "Measured by" not in efficiency


def test_a_layer_keeps_the_commit_of_what_is_no_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    cell = ALL["efficiency"].cells(Request("paper", "tiny"))[0]
    store = Store(tmp_path / "store")
    with store.begin(cell) as place:
        write_json(place / "facts.json", {"agent": "teacher"})
        store.finish(cell, 1.0)
    monkeypatch.setattr(store, "provenance", lambda cell: {"commit": "c" * 40, "files": {}})
    store.export([cell], tmp_path / "layer", "facts")
    again = Store(tmp_path / "other", [tmp_path / "layer"])
    assert again.facts(cell) == {"agent": "teacher"}
    assert again.shown == {"c" * 40: 1}


def test_without_a_recipe_each_exhibit_is_shown_in_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    of = open_reproduction(("teachers", "environment"), "", "tiny", tmp_path / "store")
    assert [of.request(exhibit).recipe for exhibit in of.exhibits] == ["strong", "paper"]
    assert of.recipes == ["paper", "strong"]
    assert [line.split()[:2] for line in listing(of).splitlines()[3:5]] == [
        ["teachers", "strong"],
        ["environment", "paper"],
    ]
    page = write_page(of, tmp_path / "page").read_text()
    assert "Recipes paper and strong, as the command under each says, scale tiny." in page
    assert "rapid reproduce teachers --recipe strong --scale tiny" in page
    assert "rapid reproduce environment --recipe paper --scale tiny" in page
    alone = open_reproduction(("teachers",), "", "tiny", tmp_path / "store")
    assert alone.recipes == ["strong"]
    assert "Recipe strong, scale tiny." in write_page(alone, tmp_path / "alone").read_text()


@pytest.mark.parametrize(
    ("words", "recipes", "place"),
    [
        (["teachers", "environment"], {"teachers": "strong", "environment": "paper"}, "paper-strong-tiny"),
        (["environment"], {"environment": "paper"}, "paper-tiny"),
        (["hyperparameters", "--recipe", "strong"], {"hyperparameters": "strong"}, "strong-tiny"),
    ],
)
def test_the_command_takes_each_id_in_its_own_recipe(
    words: list[str],
    recipes: dict[str, str],
    place: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    assert command("reproduce", *words, "--scale", "tiny", "--dry-run") == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert {line[0]: line[1] for line in lines if line and line[0] in ALL} == recipes
    assert command("reproduce", *words, "--scale", "tiny", "--page-only") == 0
    assert [path.name for path in Path("runs/reproduce").iterdir()] == [place]


@pytest.mark.parametrize("ids", [(), ("all",), ("attack", "all"), ("all", "robustness")])
def test_every_id_is_listed_and_all_is_every_one_also_beside_others(ids: tuple[str, ...], tmp_path: Path):
    of = open_reproduction(ids, "", "tiny", tmp_path / "store")
    assert [exhibit.id for exhibit in of.exhibits] == list(ALL)
    assert all(of.request(exhibit).recipe == exhibit.recipes[0] for exhibit in of.exhibits)
    # A recipe that is named is what all of them are shown in.
    paper = open_reproduction(ids[:1] if "all" in ids[:1] else (), "paper", "tiny", tmp_path / "store")
    assert {exhibit.id for exhibit in paper.exhibits} == {name for name in ALL if "paper" in ALL[name].recipes}


def test_words_are_those_of_the_presets():
    (facts,) = ALL["hyperparameters"].show(Request("paper", "full"), Store.__new__(Store), ALL["hyperparameters"])
    assert isinstance(facts, Facts)
    assert all(ours == paper for _, name, ours, paper in facts.rows if paper != "–" and name != "learning rate")


@pytest.mark.parametrize(
    ("ids", "recipe", "scale", "says"),
    [
        (("atack",), "paper", "tiny", "did you mean 'attack'"),
        (("floors",), "paper", "tiny", "only strong"),
        (("all", "floors"), "paper", "tiny", "only strong"),
        (("all", "atack"), "", "tiny", "did you mean 'attack'"),
        ((), "papper", "tiny", "did you mean 'paper'"),
        ((), "paper", "long", "tiny, quick, full"),
    ],
)
def test_what_does_not_exist_is_named(ids: tuple[str, ...], recipe: str, scale: str, says: str, tmp_path: Path):
    with pytest.raises(RapidError, match=says):
        open_reproduction(ids, recipe, scale, tmp_path / "store")


def test_a_compact_table_has_one_part_for_each_scenario_and_names_what_was_not_measured():
    found = (entry(rows(20.42, 5), PaperResult(20.42, 2.59)), Entry(failed="not driven"))
    few = (entry(rows(20.42, 1)), Entry(failed="not driven"))
    missing = (Entry(failed="not driven"), Entry(failed="not driven"))
    table = Table(
        "attack",
        "caption",
        ("scenario", "method"),
        ("none", "pgd"),
        ((("lane-3", "A"), found), (("lane-3", "B"), missing), (("lane-4", "A"), found), (("lane-4", "C"), few)),
        ("A note.",),
    )
    text = tables.compact(table)
    assert text.count("| method | none | pgd |") == 2
    assert "Not measured on lane-3: B." in text
    assert text.endswith("A note.")
    (line,) = [line for line in text.split("**lane-4**")[1].splitlines() if line.startswith("| A |")]
    assert line.startswith("| A | 20.4 [")
    assert line.endswith("] (.00) *20.4* | – |")
    assert "| C (1 training) | 20.4 [" in text


def test_who_does_not_look_is_driven_once_and_who_has_no_network_meets_no_gradient():
    attacks = ("none", "uniform", "gaussian", "fgsm", "pgd")
    assert [METHODS["blind"].under(attack) for attack in attacks] == ["none"] * 5
    assert [METHODS["immune"].under(attack) for attack in attacks] == ["none", "uniform", "gaussian", "none", "none"]
    assert [METHODS["rule"].under(attack) for attack in attacks] == ["none", "uniform", "gaussian", "", ""]
    assert [METHODS["teacher"].under(attack) for attack in attacks] == ["none", "", "", "", ""]
    assert [METHODS["rapid"].under(attack) for attack in attacks] == list(attacks)


def test_a_page_s_blocks_are_filled_from_the_rows_and_an_unknown_block_is_named(tmp_path: Path):
    store = Store(tmp_path / "store", [RESULTS / "cells"], RESULTS)
    page = "before\n<!-- table: teachers:strong -->\nold\n<!-- end -->\nafter\n"
    once = readme.filled(page, store, Path("page.md"))
    assert "| teacher (LLM) | 2" in once
    assert "old" not in once
    assert readme.filled(once, store, Path("page.md")) == once
    with pytest.raises(RapidError, match=r"'page.md' has a block 'teacher'; did you mean 'teachers'"):
        readme.filled(page.replace("teachers:strong", "teacher"), store, Path("page.md"))


@pytest.mark.parametrize("option", ["--check", "--readme"])
def test_where_no_block_is_marked_nothing_is_said_to_be_right(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert command("reproduce", option) == 2
    assert f"no marked block (<!-- table: NAME -->) in README.md or docs/ below '{tmp_path}'" in capsys.readouterr().err
    assert command("reproduce", "attack", "routing", option) == 2
    assert "'attack routing' was given. Leave the ids out" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    page = "<!-- table: rates -->\n<!-- end -->\n"
    Path("README.md").write_text(page)
    assert command("reproduce", option) == (1 if option == "--check" else 0)
    assert (Path("README.md").read_text() == page) == (option == "--check")


def test_older_rows_stand_in_until_as_many_trainings_are_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    store = Store(tmp_path / "store", [], RESULTS)
    drives = method_drives(Request("strong", "full"), METHODS["rapid-robust"], "lane-3-density-2", ("pgd",))
    legacy = Legacy("strong", "rapid-robust", "lane-3-density-2", "pgd")
    monkeypatch.setattr(store, "legacy", lambda wanted: rows(21.96, 1))
    done = {drives[0]}
    monkeypatch.setattr(store, "is_done", done.__contains__)
    monkeypatch.setattr(store, "rows", lambda cell: [replace(row, training_seed=cell.seed) for row in rows(20, 1)])
    assert rows_of(store, drives, legacy) == (rows(21.96, 1), "")
    done.add(drives[1])
    found, why = rows_of(store, drives, legacy)
    assert {row.training_seed for row in found} == {0, 1}
    assert why == "3 of 5 parts are missing"
