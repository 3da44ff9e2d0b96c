"""The page: complete, self-contained, closed to what untrusted text might try, and calm when parts are missing."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from samples import HOSTILE, SCENARIO, full, recording, rows

from rapid.errors import RapidError
from rapid.pages.episodes import moving_picture
from rapid.pages.markup import script_json, tag, text
from rapid.report import ReportData, text_summary, write_figures, write_report
from rapid.report.curves import UNIFORM, charts, series
from rapid.report.page import page

VOID = {"meta", "img", "br", "input", "hr", "link"}


class Reader(HTMLParser):
    """Reads a page as a browser does: tags must close in order; scripts, attributes and text are kept."""

    def __init__(self, content: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self.feed(content)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)
        elif self.open and self.open[-1] != "style":
            self.words.append(data)


@pytest.mark.parametrize("hostile", ["plain", HOSTILE])
def test_page_is_well_formed_and_whole(hostile: str) -> None:
    content = page(full(hostile))
    reader = Reader(content)
    ids = {attributes["id"] for _, attributes in reader.tags if attributes.get("id")}
    assert {"results", "watch", "attacks", "curves", "routing", "dataset", "made-by", "payload"} <= ids
    assert [name for name, _ in reader.tags].count("script") == 2
    payload = json.loads(reader.scripts[0])
    assert len(payload["episodes"]) == 2
    words = " ".join(reader.words)
    for expected in ("always-slower", "20.42", "14.77", "n/a", "on this road ε = 0.1 means up to 20 m", "1.2 m across"):
        assert expected in words


def test_the_worst_case_has_a_table_and_over_sizes_a_plot() -> None:
    def plot(run: ReportData) -> list[dict[str, Any]]:
        return json.loads(Reader(page(run)).scripts[0])["worst"]

    pair = [*rows("RAPID"), *rows("RAPID", "fgsm"), *rows("RAPID", "pgd")]
    content = page(ReportData(title="t", rows=pair, trained=False))
    assert 'id="worst"' in content
    assert "most often the worst" in content
    with_floor = page(ReportData(title="t", rows=[*pair, *rows("slower", kind="floor")]))
    assert "over always-slower [95 %]" in with_floor
    assert "95 % interval 0.0 to 0.0; 8 spawns" in with_floor
    # What was not trained has no curves to miss.
    assert "No training was recorded" not in content
    assert plot(ReportData(title="t", rows=pair)) == []
    assert 'id="worst"' not in page(full())  # two attacks that are not of the same size
    assert "within each threat" not in content
    four = [("RAPID", "none"), *((f"<b>{n}", f"{kind}:radius=0.1{more}")
            for n in range(2) for kind in ("pgd", "world") for more in ("", ",ego=trusted"))]  # fmt: skip
    threats = page(ReportData(title="t", rows=[row for agent, attack in four for row in rows(agent, attack)]))
    Reader(threats)
    assert f"{SCENARIO}, within each threat" in threats
    assert ">presence masked, ego row trusted</button>" in threats
    assert "<b>0" not in threats
    kinds = ("pgd", "directed")
    swept = [
        *rows("RAPID"),
        *(row for r in (0.01, 0.02, 0.05) for k in kinds for row in rows("RAPID", f"{k}:radius={r}")),
    ]
    charts = plot(ReportData(title="t", rows=swept))
    assert [x for x, _ in charts[0]["series"][0]["points"]] == [0, 2, 4, 10]
    assert charts[1]["series"][0]["points"][1][1] == pytest.approx(1 / 8)


def test_crashes_are_counted_by_attack_and_agent_and_lead_to_what_was_kept() -> None:
    kept = [replace(recording(), agent="<i>a", attack="pgd", seed=seed) for seed in (1, 2)]
    driven = [
        *rows("<i>a", seeds=4),
        *(replace(row, crashed=row.seed < 3, length=row.seed + 5, hit=("ahead", "beside", "ahead", "")[row.seed])
          for row in rows("<i>a", "pgd", seeds=4)),
        *(replace(row, crashed=False) for row in rows("slower", kind="floor", seeds=4)),
    ]  # fmt: skip
    content = page(ReportData(title="t", rows=driven, recordings=[kept[0], recording(), kept[1]]))
    Reader(content)
    found = content[content.index('id="crashes"') : content.index('id="watch"')]
    cells = re.findall(r"<td.*?</td>", found)
    words = [re.sub(r"<[^>]*>", " ", cell).split() for cell in cells]
    assert [" ".join(each) for each in words] == [
        "1 of 4 at 30 s", "0 of 4",
        "3 of 4 at 6 s ahead: 2 of 3 watch", "–",
    ]  # fmt: skip
    # The episode without attack comes first on the page.
    assert re.findall(r'href="([^"]*)"', found) == ["#moment=1,,0"]
    assert "<i>a" not in found
    # Rows of earlier versions do not say what was hit, so that only what was kept tells.
    old = [replace(row, hit="") for row in driven]
    assert "ahead: 2 of 2 known" in page(ReportData(title="t", rows=old, recordings=kept))
    calm = [replace(row, crashed=False) for row in driven]
    assert 'id="crashes"' not in page(ReportData(title="t", rows=calm))


def test_text_of_others_stays_text() -> None:
    content = page(full(HOSTILE))
    reader = Reader(content)
    clean = HOSTILE.replace("\ud800", "?")
    assert json.loads(reader.scripts[0])["episodes"][0]["answered"] == [clean] * 3
    assert clean in " ".join(reader.words)
    assert not any(name == "img" or any(key.startswith("on") for key in attributes) for name, attributes in reader.tags)
    assert "\u2028" not in reader.scripts[0]
    assert "<" not in reader.scripts[0]
    content.encode("utf-8")


def test_page_asks_the_network_for_nothing() -> None:
    content = page(full())
    reader = Reader(content)
    for _, attributes in reader.tags:
        assert "src" not in attributes
        # Links lead to moments within the page.
        assert re.fullmatch(r"data:,|#moment=\d+,,\d+", attributes.get("href") or "data:,")
    assert "@import" not in content
    assert "url(" not in content
    links = set(re.findall(r"https?://[^\s\"'<\\]+", content))
    # The first is a name that SVG needs, the second a default of the settings, shown as text.
    assert links <= {"http://www.w3.org/2000/svg", "http://127.0.0.1:8000/v1"}


def test_only_its_own_script_may_run() -> None:
    reader = Reader(page(full(HOSTILE)))
    policy = next(
        a["content"] for n, a in reader.tags if n == "meta" and a.get("http-equiv") == "Content-Security-Policy"
    )
    digest = base64.b64encode(hashlib.sha256(reader.scripts[1].encode()).digest()).decode()
    assert policy is not None
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_missing_parts_are_said_to_be_missing(tmp_path: Path) -> None:
    path = write_report(ReportData(title="empty"), tmp_path)
    reader = Reader(path.read_text(encoding="utf-8"))
    assert path == (tmp_path / "report.html").resolve()
    missing = [attributes for _, attributes in reader.tags if attributes.get("class") == "missing"]
    assert len(missing) >= 8
    assert json.loads(reader.scripts[0])["episodes"] == []
    assert write_figures(ReportData(title="empty"), tmp_path) == []


@pytest.mark.parametrize(
    "part", ["rows", "distill", "adapt", "routing", "recordings", "dataset", "timings", "settings"]
)
def test_each_part_may_be_missing_by_itself(part: str) -> None:
    Reader(page(replace(full(), **{part: type(getattr(full(), part))()})))


def test_unwritable_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RapidError, match="Cannot write"):
        write_report(ReportData(title="x"), tmp_path / "file" / "report.html")


def test_verdict_needs_five_trainings() -> None:
    one = ReportData(title="x", rows=rows("mine", training_seed=0, origin="rapid"))
    assert "insufficient" in page(one)
    many = [row for seed in range(5) for row in rows("RAPID", training_seed=seed, origin="rapid")]
    assert "our interval lies" in page(ReportData(title="x", rows=many))


def test_paper_is_not_beside_another_reward() -> None:
    other = [replace(row, scenario=f"{SCENARIO}:progress") for row in rows("RAPID", origin="rapid")]
    assert "20.42" not in page(ReportData(title="x", rows=other))


def test_the_paper_is_beside_what_was_trained_here_whatever_it_is_called() -> None:
    def shown(**changes: Any) -> bool:
        return "20.42" in page(ReportData(title="x", rows=rows(**changes)))

    assert shown(agent="a name of my own", origin="rapid")
    assert not shown(agent="RAPID", origin="other")
    # Rows of earlier versions have names alone; a model of other origin has no network that is known here.
    assert shown(agent="RAPID", has_network=True)
    assert not shown(agent="RAPID")


def test_uniform_policy_is_marked_on_the_robust_curve_only() -> None:
    drawn = {chart["id"]: chart for chart in charts(full().distill, full().adapt)}
    assert pytest.approx(1.609, abs=1e-3) == UNIFORM
    assert drawn["robust"]["marks"][0]["y"] == UNIFORM
    assert drawn["distill-return"]["marks"] == []
    assert "agreement" not in drawn  # only nulls


def test_a_term_that_was_left_out_is_not_drawn_as_zero_but_no_crashes_are() -> None:
    entries = [{"iteration": i, "robust": 0.0, "evaluation": {"crash_share": 0.0}} for i in range(3)]
    assert {chart["id"] for chart in charts({"dqn": entries}, {})} == {"distill-crash"}


def test_long_series_are_averaged() -> None:
    points = series([{"step": i, "td": i} for i in range(10_000)], "td")
    assert len(points) == 400
    assert points[0] == (12.0, 12.0)


def test_moving_picture_keeps_names_and_ranks() -> None:
    picture = moving_picture(recording())
    assert picture["frames"][2][1] == [1, 1, 160.0, 0.0, 15.0, 0.0]
    assert picture["lanes"] == 3
    assert json.loads(script_json(picture))["rewards"][2] is None


def test_markup_escapes_text_and_attributes() -> None:
    assert tag("p", "<b>", tag("i", "x"), title='"<', data_value=1) == (
        '<p title="&quot;&lt;" data-value="1">&lt;b&gt;<i>x</i></p>'
    )
    assert text("\0\ud800") == "\ufffd?"
    assert script_json({"a": float("nan"), "b": "</script>&\u2028"}) == (
        '{"a":null,"b":"\\u003c/script\\u003e\\u0026\\u2028"}'
    )


def test_figures(tmp_path: Path) -> None:
    paths = write_figures(full(), tmp_path)
    assert [path.name for path in paths] == ["results.png", "curves.png", "episode.png"]
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in paths)


def test_text_summary() -> None:
    assert "always-slower" in text_summary(full().rows)
