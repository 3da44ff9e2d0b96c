"""The page in a real browser: what a reader can do with it, and what it must never do."""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import HOSTILE, full, recording, rows

from browser import Tab, tab, until
from rapid.evaluation.recording import Recording
from rapid.report import ReportData, write_report

Open = Callable[..., Tab]


def ride(length: int, agent: str = "teacher", seed: int = 900_000) -> Recording:
    """An episode of so many decisions on a road with two cars."""
    one = recording()
    obs = np.zeros((length + 1, 15, 5), np.float32)
    obs[:, 0] = [(1, 100 + 20 * t, 4, 20, 0) for t in range(length + 1)]
    obs[:, 1] = [(1, 130 + 15 * t, 0, 15, 0) for t in range(length + 1)]
    return replace(
        one,
        agent=agent,
        seed=seed,
        obs_TVF=obs,
        action_T=np.arange(length) % 5,
        reward_T=np.full(length, 0.5),
        q_TA=np.tile(np.arange(5, dtype=np.float32), (length, 1)),
        answered=tuple(f"words {t}" for t in range(length)),
        crashed=False,
    )


def run(*recordings: Recording) -> ReportData:
    return replace(full(), recordings=list(recordings) or [ride(3), ride(5, "other", 900_001)])


@pytest.fixture
def opened(chromium: Any, tmp_path: Path) -> Iterator[Open]:
    """Open the page of a run; at the end nothing may have gone wrong in it, and nobody may have been asked."""
    with ExitStack() as stack:
        tabs: list[tuple[Tab, str]] = []

        def show(data: ReportData, **emulated: Any) -> Tab:
            url = write_report(data, tmp_path).as_uri()
            shown = stack.enter_context(tab(chromium, **emulated))
            shown.page.goto(url)
            tabs.append((shown, url))
            return shown

        yield show
        for shown, url in tabs:
            assert shown.troubles == []
            assert shown.elsewhere(url) == []


def clock(page: Any) -> float:
    return float(page.get_by_label("time, seconds").input_value())


def button(page: Any, name: str) -> Any:
    return page.get_by_role("button", name=name, exact=True)


def watch_clock(page: Any) -> None:
    """Keep every time that the player shows from now on."""
    page.evaluate(
        """() => {
          const scrub = document.querySelector(".player input[type=range]");
          window.shown = [];
          const own = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value");
          Object.defineProperty(scrub, "value", {
            get() { return own.get.call(this); },
            set(value) { window.shown.push(Number(value)); own.set.call(this, value); },
          });
        }"""
    )


def test_a_click_plays_to_the_end_every_time_and_the_clock_stays_inside(opened: Open) -> None:
    page = opened(run()).page
    watch_clock(page)
    page.get_by_label("pace", exact=True).select_option("4")
    for _ in range(4):
        button(page, "Play").click()
        button(page, "Pause").wait_for()
        button(page, "Play").wait_for(timeout=5000)
        assert clock(page) == 3
    shown = page.evaluate("window.shown")
    assert len(shown) > 20
    assert min(shown) >= 0
    assert max(shown) <= 3


def test_a_frame_whose_time_lies_before_the_click_or_far_after_it_does_no_harm(opened: Open) -> None:
    # Browsers give a frame the time at which it was due, which may be before the click that asked for it; and a tab
    # that was hidden gets its next frame after minutes.
    page = opened(run(ride(30))).page
    page.evaluate(
        """() => {
          const real = window.requestAnimationFrame.bind(window);
          const late = [-5000, -5000, 0, 600000, 600016];
          window.requestAnimationFrame = (call) => real((now) => call(now + (late.length ? late.shift() : 600032)));
        }"""
    )
    watch_clock(page)
    button(page, "Play").click()
    until(page, "window.shown.length > 12")
    button(page, "Pause").click()
    shown = page.evaluate("window.shown")
    assert shown == sorted(shown)
    assert 0 <= min(shown) <= max(shown) < 10


def test_clicking_play_many_times_leaves_one_clock(opened: Open) -> None:
    page = opened(run(ride(30))).page
    asked = page.evaluate(
        """async () => {
          let asked = 0;
          const real = window.requestAnimationFrame.bind(window);
          window.requestAnimationFrame = (call) => real((now) => { asked++; call(now); });
          const play = document.querySelector(".player .play");
          for (let i = 0; i < 7; i++) play.click();
          const frames = await new Promise((done) => {
            let seen = 0;
            const count = () => (++seen < 20 ? real(count) : done(seen));
            real(count);
          });
          play.click();
          return asked / frames;
        }"""
    )
    assert 0.5 < asked < 1.3


def test_scrubbing_shows_the_decision_under_it(opened: Open) -> None:
    page = opened(run(ride(5))).page
    page.get_by_label("time, seconds").fill("3.5")
    assert "words 3" in page.locator(".said").first.inner_text()
    assert "3.5 s" in page.locator(".controls .at").inner_text()
    page.get_by_label("time, seconds").fill("0")
    assert "words 0" in page.locator(".said").first.inner_text()
    page.get_by_title("decision 5: slower").click()
    assert clock(page) == 4


def test_the_episode_can_be_changed_while_it_plays(opened: Open) -> None:
    page = opened(run(ride(30), ride(2, "other", 900_001))).page
    page.get_by_label("time, seconds").fill("20")
    button(page, "Play").click()
    page.get_by_label("episode", exact=True).select_option("1")
    button(page, "Play").wait_for()
    assert clock(page) == 0
    assert page.locator(".strip button").count() == 2
    page.get_by_label("pace", exact=True).select_option("4")
    button(page, "Play").click()
    until(page, "document.querySelector('.scrub').value === '2'")


def test_keys(opened: Open) -> None:
    page = opened(run(ride(5))).page
    page.locator(".player").first.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert clock(page) == 2
    page.keyboard.press("ArrowLeft")
    assert clock(page) == 1
    for _ in range(9):
        page.keyboard.press("ArrowLeft")
    assert clock(page) == 0
    page.keyboard.press("Space")
    button(page, "Pause").wait_for()
    page.keyboard.press("Space")
    button(page, "Play").wait_for()
    for _ in range(9):
        page.keyboard.press("ArrowRight")
    assert clock(page) == 5


def test_tables_are_sorted_by_their_values(opened: Open) -> None:
    page = opened(run()).page
    head = page.locator("table.sortable").first.locator("thead th", has=page.locator("button")).nth(1)

    def column() -> list[float]:
        return page.evaluate(
            """() => {
              const table = document.querySelector("table.sortable");
              const heads = [...table.tHead.rows[0].cells];
              const at = heads.findIndex((head) => head.hasAttribute("aria-sort"));
              return [...table.tBodies[0].rows].map((row) => row.cells[at].dataset.value).filter(Boolean).map(Number);
            }"""
        )

    head.get_by_role("button").click()
    falling = column()
    assert head.get_attribute("aria-sort") == "descending"
    assert len(falling) >= 2
    assert falling == sorted(falling, reverse=True)
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert column() == sorted(falling)


@pytest.mark.parametrize("width", [320, 390])
def test_a_narrow_screen_needs_no_scrolling_sideways(opened: Open, width: int) -> None:
    page = opened(run(), viewport={"width": width, "height": 800}, has_touch=True, is_mobile=True).page
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    button(page, "Play").tap()
    button(page, "Pause").wait_for()


def test_dark_is_dark(opened: Open) -> None:
    def brightness(scheme: str) -> tuple[float, float]:
        page = opened(run(), color_scheme=scheme).page
        return tuple(
            page.evaluate(
                """(part) => getComputedStyle(document.body)[part].match(/[\\d.]+/g).slice(0, 3)
                  .reduce((sum, value) => sum + Number(value), 0) / 765""",
                part,
            )
            for part in ("backgroundColor", "color")
        )

    paper, ink = brightness("light")
    assert paper > 0.9 > 0.3 > ink
    paper, ink = brightness("dark")
    assert paper < 0.2 < 0.8 < ink


def test_hostile_text_stays_text(opened: Open) -> None:
    shown = opened(replace(full(HOSTILE), recordings=[recording(HOSTILE)]))
    page = shown.page
    assert page.locator("img").count() == 0
    assert page.locator("script").count() == 2
    assert "<script>alert(1)</script>" in page.locator(".said").first.inner_text()


def test_an_injected_script_does_not_run(chromium: Any, tmp_path: Path) -> None:
    # As if something had found its way past all escaping: the browser itself refuses to run it.
    path = write_report(run(), tmp_path)
    content = path.read_text(encoding="utf-8")
    evil = "<script>window.caught = 1</script><img src=x onerror='window.caught = 2'>"
    path.write_text(content.replace("<main>", f"<main>{evil}"), encoding="utf-8")
    with tab(chromium) as shown:
        shown.page.goto(path.as_uri())
        button(shown.page, "Play").wait_for()
        assert shown.page.evaluate("window.caught") is None
        assert any("Content Security Policy" in trouble for trouble in shown.troubles)


def test_a_page_without_episodes_has_no_player(opened: Open) -> None:
    page = opened(replace(full(), recordings=[])).page
    assert page.locator(".player").count() == 0
    assert "No episode was recorded." in page.locator("#watch").inner_text()


def crashed(seed: int = 900_002) -> Recording:
    """An attacked episode that ends in a crash, in which the one car was seen ten metres farther on."""
    one = replace(ride(6, "RAPID", seed), crashed=True, attack="pgd")
    seen = one.obs_TVF[:-1].copy()
    seen[:, 1, 1] += 10
    return replace(one, seen_TVF=seen, weights_TVN=np.full((6, 15, 2), 0.5, np.float32))


def test_the_gallery_plays_a_crash(opened: Open) -> None:
    page = opened(run(ride(3), crashed())).page
    page.get_by_role("button", name=re.compile("RAPID under pgd, spawn 900002")).click()
    assert page.get_by_label("episode", exact=True).input_value() == "1"
    until(page, "document.querySelector('.score').textContent.startsWith('crashed after 6 s')", 20)
    assert page.get_by_label("what it is made to see").is_checked()
    page.locator(".player").first.focus()
    page.keyboard.press("c")
    assert 3 <= clock(page) < 6


def test_the_table_of_crashes_plays_them(opened: Open) -> None:
    driven = [*rows("RAPID"), *rows("RAPID", "pgd")]
    page = opened(replace(run(ride(3), crashed()), rows=driven)).page
    link = page.locator("#crashes").get_by_role("link", name="watch")
    for _ in range(2):
        link.click()
        assert page.get_by_label("episode", exact=True).input_value() == "1"
        until(page, "document.querySelector('.score').textContent.startsWith('crashed after 6 s')", 20)
        page.get_by_label("episode", exact=True).select_option("0")


def test_two_episodes_of_one_spawn_stand_side_by_side_on_one_clock(opened: Open) -> None:
    page = opened(run(ride(3), ride(5, "other"))).page
    assert page.get_by_label("beside it").input_value() == "1"
    assert page.locator(".score").count() == 2
    page.get_by_label("time, seconds").fill("4")
    assert page.locator(".score").first.inner_text() == "arrived after 3 s, return 1.50"
    assert page.locator(".score").nth(1).inner_text() == ""
    page.get_by_label("beside it").select_option("")
    assert not page.locator(".pane").nth(1).locator("canvas").is_visible()


def test_a_link_leads_to_its_moment(opened: Open) -> None:
    page = opened(run(ride(3), crashed())).page
    page.evaluate("() => { location.hash = '#moment=1,0,2.5'; }")
    until(page, "document.querySelector('.scrub').value === '2.5'")
    assert page.get_by_label("beside it").input_value() == "0"
    # One that leads nowhere changes nothing.
    page.evaluate("() => { location.hash = '#moment=99,0,1'; }")
    assert clock(page) == 2.5


def test_routing_over_time_has_a_line_for_each_car_and_a_column_for_each_decision(opened: Open) -> None:
    page = opened(run(crashed())).page
    page.get_by_text("Which policy decides about which car, over time").first.click()
    until(page, "document.querySelectorAll('.heat-map rect').length === 2 * 6 + 1")


def test_on_paper_there_is_nothing_to_press(opened: Open) -> None:
    page = opened(run(crashed())).page
    page.emulate_media(media="print")
    for hidden in (".play", ".scrub", ".strip", ".sharing"):
        assert not page.locator(hidden).first.is_visible()
    assert page.locator(".player canvas").first.is_visible()


def test_the_worst_case_is_drawn_over_the_size_of_the_attack(opened: Open) -> None:
    kinds = [f"{kind}:radius={radius}" for radius in (0.01, 0.02, 0.05) for kind in ("pgd", "directed")]
    swept = [row for attack in ("none", *kinds) for row in rows("RAPID", attack)]
    page = opened(replace(run(), rows=swept, trained=False)).page
    assert page.locator("#worst-canvas svg").count() == 2
    assert page.locator("#worst table").count() == 3
    button(page, "most often the worst").first.click()
    page.locator("#worst-canvas svg").first.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert "metres along the road 2" in page.locator("#worst-canvas svg").first.inner_html()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_that_can_be_used_has_a_name_and_all_text_can_be_read(opened: Open, scheme: str) -> None:
    page = opened(run(crashed(), ride(3)), color_scheme=scheme).page
    nameless = page.evaluate(
        """() => [...document.querySelectorAll("button, select, input, canvas, [tabindex='0']")]
          .filter((node) => !node.closest("[aria-hidden]") && !node.ariaLabel && !node.textContent.trim()
            && !node.labels?.length && !node.title).map((node) => node.outerHTML.slice(0, 90))"""
    )
    assert nameless == []
    # WCAG 2.2, 1.4.3: text stands out from what is behind it by 4.5 to 1.
    ratios = page.evaluate(
        """() => {
          const style = getComputedStyle(document.documentElement);
          const light = (name) => {
            const parts = [1, 3, 5].map((i) => parseInt(style.getPropertyValue(name).trim().slice(i, i + 2), 16) / 255)
              .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
            return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2];
          };
          const pairs = [["--ink", "--card"], ["--soft", "--card"], ["--soft", "--paper"], ["--ink", "--paper"],
            ["--crash", "--card"], ["--ghost", "--card"], ["--accent", "--card"], ["--paper", "--accent"],
            ["--on-car", "--car"], ["--on-car", "--one"], ["--soft", "--grass"]];
          return Object.fromEntries(pairs.map(([a, b]) => {
            const [x, y] = [light(a), light(b)].sort((p, q) => q - p);
            return [`${a} on ${b}`, (x + 0.05) / (y + 0.05)];
          }));
        }"""
    )
    assert {pair: round(ratio, 2) for pair, ratio in ratios.items() if ratio < 4.5} == {}
