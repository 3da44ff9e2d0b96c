"""The live page in a real browser: drive, attack, change, share, and lose the connection."""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

from browser import Tab, tab, until
from rapid.evaluation.rollouts import run_episodes
from rapid.play.roster import Roster
from rapid.play.server import LivePage

SCENARIO = "lane-3-density-2"
Open = Callable[..., Tab]


@pytest.fixture
def opened(chromium: Any, live: LivePage) -> Iterator[Open]:
    """Open the live page at a moment; at the end nothing may have gone wrong, and nobody else may have been asked."""
    with ExitStack() as stack:
        tabs: list[Tab] = []

        def show(emulated: dict[str, Any] | None = None, **moment: Any) -> Tab:
            shown = stack.enter_context(tab(chromium, **(emulated or {})))
            tabs.append(shown)
            words = {"scenario": SCENARIO, "spawn": 900_003, "left": "slower", **moment}
            shown.page.goto(f"{live.address.partition('#')[0]}#{urlencode(words)}")
            shown.page.locator(".strip").first.wait_for(state="attached")
            until(shown.page, "document.querySelector('.facts dd').textContent !== ''", 60)
            return shown

        yield show
        for shown in tabs:
            assert shown.troubles == []
            assert shown.elsewhere(live.address.partition("#")[0]) == []


def button(page: Any, name: str) -> Any:
    return page.get_by_role("button", name=name, exact=True)


def decisions(page: Any, pane: int = 0) -> int:
    return page.locator(".pane").nth(pane).locator(".strip button").count()


def steps(page: Any, count: int) -> None:
    """Drive so many decisions, one at a time."""
    before = int(float(page.locator(".at").inner_text().split()[0]))
    for number in range(1, count + 1):
        button(page, "one decision on").click()
        until(page, f"document.querySelector('.at').textContent.startsWith('{before + number:.1f}')", 60)


def test_it_plays_what_it_drives_to_the_end(opened: Open, roster: Roster) -> None:
    page = opened().page
    page.get_by_label("pace", exact=True).select_option("4")
    button(page, "Play").click()
    until(page, "document.querySelector('.score').textContent !== ''", 120)
    measured = run_episodes(roster.open("slower", SCENARIO), SCENARIO, [900_003])
    words = page.locator(".score").first.inner_text()
    assert words.startswith("crashed" if measured.crashed_E[0] else "arrived")
    assert float(words.split()[-1]) == pytest.approx(measured.return_E[0], abs=0.02)
    button(page, "Play").wait_for()


def test_an_attack_is_switched_on_while_it_drives(opened: Open, saved: Path) -> None:
    page = opened(left=str(saved)).page
    steps(page, 2)
    ghosts = page.get_by_label("what it is made to see")
    assert not ghosts.is_visible()
    page.get_by_label("attack", exact=True).select_option("pgd")
    page.get_by_label(re.compile("size of the attack")).fill("10")
    assert "10 m along, 0.6 m across, 4 m/s; ε = 0.05" in page.locator(".size").inner_text()
    steps(page, 1)
    assert ghosts.is_visible()
    assert "what the agent is made to see" in page.locator(".legend").inner_text()


def test_an_attack_that_cannot_be_made_is_told_beside_its_driver(opened: Open) -> None:
    page = opened().page
    page.get_by_label("attack", exact=True).select_option("pgd")
    steps(page, 1)
    assert "undisturbed" in page.locator(".pane-note").first.inner_text()


def test_you_drive_with_the_arrow_keys(opened: Open) -> None:
    page = opened(left="you", right="slower").page
    assert page.get_by_role("group", name="what you do next").first.is_visible()
    page.locator(".player").focus()
    page.keyboard.press("ArrowRight")
    until(page, "document.querySelector('.strip button')?.title.includes('faster')", 60)
    button(page, "Pause").click()
    # Nothing pressed is idle, and both panes are on the same clock.
    steps(page, 2)
    assert "idle" in page.locator(".strip button").nth(1).get_attribute("title")
    assert abs(decisions(page, 0) - decisions(page, 1)) <= 1


def test_you_drive_by_touch(opened: Open) -> None:
    page = opened({"viewport": {"width": 390, "height": 800}, "has_touch": True, "is_mobile": True}, left="you").page
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    button(page, "← slower").tap()
    until(page, "document.querySelector('.strip button')?.title.includes('slower')", 60)


def test_drivers_and_spawns_are_changed(opened: Open, saved: Path) -> None:
    page = opened().page
    steps(page, 1)
    page.get_by_label("who drives above").select_option(str(saved))
    until(page, "document.querySelector('.strip button') === null", 60)
    steps(page, 1)
    assert page.locator(".q .bar").count() == 5
    page.get_by_label("who drives below").select_option("rule")
    until(page, "!document.querySelectorAll('.pane')[1].classList.contains('empty')", 60)
    page.get_by_label("spawn").fill("900007")
    page.keyboard.press("Tab")
    until(page, "location.hash.includes('spawn=900007')", 60)
    # The name came from a file, and stays text.
    assert page.locator("b", has_text="mixture").count() == 0
    assert "<b>mixture</b>" in page.get_by_label("who drives above").inner_text()


def test_a_link_leads_to_the_same_moment(opened: Open, saved: Path) -> None:
    page = opened(left="you", right=str(saved)).page
    page.get_by_label("attack", exact=True).select_option("uniform")
    for key in ("→ faster", "↑ left"):
        button(page, key).first.click()
        button(page, "Pause").click()
        steps(page, 1)
    page.evaluate("() => { navigator.clipboard.writeText = () => Promise.reject(new Error('no right')); }")
    button(page, "Copy link").click()
    link = page.get_by_label("link to this moment").input_value()
    shown = [page.locator(".pane").nth(pane).locator(".facts").inner_text() for pane in (0, 1)]
    again = opened().page
    again.goto("about:blank")
    again.goto(link)
    at = page.locator(".at").inner_text()
    until(again, f"document.querySelector('.at').textContent === {at!r}", 60)
    assert [again.locator(".pane").nth(pane).locator(".facts").inner_text() for pane in (0, 1)] == shown


@pytest.mark.parametrize(("name", "start"), [("PNG", b"\x89PNG\r\n"), ("GIF", b"GIF89a")])
def test_a_moment_is_saved(opened: Open, tmp_path: Path, name: str, start: bytes) -> None:
    from PIL import Image

    page = opened(right="rule").page
    steps(page, 1)
    with page.expect_download(timeout=120_000) as download:
        button(page, name).click()
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    assert path.read_bytes().startswith(start)
    with Image.open(path) as image:
        image.load()
        assert image.width >= 720
        if name == "GIF":
            assert image.n_frames > 5  # type: ignore[attr-defined]
            first = image.convert("RGB").tobytes()
            image.seek(image.n_frames - 1)  # type: ignore[attr-defined]
            assert image.convert("RGB").tobytes() != first


def test_a_movie_is_saved(opened: Open, tmp_path: Path) -> None:
    page = opened().page
    steps(page, 1)
    with page.expect_download(timeout=120_000) as download:
        button(page, "Movie").click()
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    content = path.read_bytes()
    assert len(content) > 1000
    assert b"ftyp" in content[:12] or content.startswith(b"\x1a\x45\xdf\xa3")


def test_a_lost_connection_is_told_and_what_was_driven_can_still_be_watched(opened: Open, live: LivePage) -> None:
    shown = opened()
    page = shown.page
    steps(page, 2)
    live.close()
    until(page, "document.querySelector('.status').textContent.includes('was lost')", 60)
    button(page, "one decision back").click()
    assert page.locator(".at").inner_text().startswith("1.0 s")
    until(page, "document.querySelector('.status').textContent.includes('has ended')", 60)
    # The browser itself reports the attempts to connect again; nothing else went wrong.
    shown.troubles = [trouble for trouble in shown.troubles if "WebSocket" not in trouble]


def test_a_driver_that_is_not_here_is_told(opened: Open) -> None:
    page = opened(right="nobody-here").page
    assert "nobody-here" in page.locator(".status").inner_text()


def test_an_injected_script_does_not_run(opened: Open, chromium: Any, live: LivePage) -> None:
    with tab(chromium) as shown:
        evil = "<script>window.caught = 1</script><img src=x onerror='window.caught = 2'>"

        def altered(route: Any) -> None:
            answer = route.fetch()
            route.fulfill(response=answer, body=answer.text().replace("<main>", f"<main>{evil}"))

        shown.page.route("**/", altered)
        shown.page.goto(live.address)
        button(shown.page, "Play").wait_for()
        assert shown.page.evaluate("window.caught") is None
        assert any("Content Security Policy" in trouble for trouble in shown.troubles)


def test_a_connection_that_comes_back_goes_on_where_it_was(opened: Open, live: LivePage) -> None:
    shown = opened(left="rule")
    page = shown.page
    steps(page, 2)
    before = page.locator(".facts").first.inner_text()
    for connection in live._server.connections:
        connection.close()
    until(page, "document.querySelector('.status').textContent.includes('was lost')", 60)
    until(page, "document.querySelector('.status').textContent === ''", 60)
    until(page, "document.querySelector('.at').textContent === '2.0 s'", 60)
    assert page.locator(".facts").first.inner_text() == before
    steps(page, 1)
    shown.troubles = [trouble for trouble in shown.troubles if "WebSocket" not in trouble]
