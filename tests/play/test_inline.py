"""The player in a notebook's cell: it drives as is measured, plays in a frame of its own, and asks nobody."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import rapid
from browser import tab, until
from rapid.agents.onnx import OnnxAgent
from rapid.agents.saved import save_agent
from rapid.agents.shielded import shielded
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.teacher.scripted import Scripted

SCENARIO = "lane-3-density-2"


def test_it_drives_the_episode_that_is_measured(saved: Path):
    agent = rapid.load_agent(saved)
    measured = run_episodes(agent, SCENARIO, [900_003], "fgsm")
    (episode,) = agent.watch(seed=900_003, attack="fgsm").episodes
    assert sum(episode["rewards"]) == pytest.approx(measured.return_E[0], abs=1e-2)
    assert len(episode["actions"]) == measured.length_E[0] == len(episode["frames"]) - 1
    assert episode["crashed"] == measured.crashed_E[0]
    assert any(episode["seen"])


def test_every_kind_of_driver_can_be_watched(saved: Path, tmp_path: Path):
    from rapid.agents.onnx import driven_observations, export_onnx

    agent = rapid.load_agent(saved)
    export_onnx(agent, tmp_path / "agent.onnx", *driven_observations(agent, SCENARIO, [800_000]))
    drivers = [OnnxAgent(tmp_path / "agent.onnx"), Scripted("rule", 3, 0), shielded(agent, "0.1", 3)]
    for driver in drivers:
        watched = driver.watch(SCENARIO, seed=900_003)
        assert watched.episodes[0]["ended"]
        assert "spawn 900003" in repr(watched)

    class Mine:
        def act(self, obs_BVF: Any) -> Any:
            return obs_BVF[:, 0, 0].astype(int)

    assert "Mine" in repr(rapid.watch(Mine(), beside="slower"))


def test_it_drives_where_the_agent_was_trained_unless_told_otherwise(tmp_path: Path):
    network = build_network(NetworkConfig(kind="mlp", hidden=(8,)), 4, seed=1)
    save_agent(tmp_path / "four", network, {"scenario": "lane-4-density-2.5"})
    assert rapid.load_agent(tmp_path / "four").watch().episodes[0]["scenario"] == "lane-4-density-2.5"
    assert rapid.watch(str(tmp_path / "four"), SCENARIO).episodes[0]["scenario"] == SCENARIO
    assert Scripted("idle", 3, 0).watch().episodes[0]["scenario"] == SCENARIO


def test_what_cannot_be_made_is_said(saved: Path):
    with pytest.raises(RapidError, match=r"'pgd' cannot be made on 'idle'.*uniform"):
        Scripted("idle", 3, 0).watch(attack="pgd")
    with pytest.raises(RapidError, match="lane-3-density-2"):
        Scripted("idle", 3, 0).watch("lane-3-densty-2")
    beside = rapid.load_agent(saved).watch(seed=900_003, attack="fgsm", beside="idle").episodes[1]
    assert beside["attack"] == "none"
    assert "fgsm" not in beside["label"]


def test_a_cell_plays_it_in_a_frame_that_reaches_nothing(chromium: Any, saved: Path, tmp_path: Path):
    agent = rapid.load_agent(saved)
    agent.name = "<img src=x onerror=alert(1)>\"'"
    watched = agent.watch(seed=900_003, attack="fgsm", beside="slower")
    html = watched._repr_html_()  # pyright: ignore[reportPrivateUsage]
    cell = tmp_path / "cell.html"
    cell.write_text(f"<!doctype html><meta charset=utf-8><body>{html}", encoding="utf-8")
    with tab(chromium, viewport={"width": 1000, "height": 900}, accept_downloads=True) as shown:
        shown.page.goto(cell.as_uri())
        page = shown.page.frames[1]
        assert page.locator(".pane-head b").first.inner_text().startswith(agent.name)
        page.get_by_label("pace", exact=True).select_option("4")
        page.get_by_role("button", name="Play", exact=True).click()
        until(page, "parseFloat(document.querySelector('.at').textContent) > 2", 20)
        page.get_by_role("button", name="Pause", exact=True).click()
        page.locator(".player").press("End")
        assert "return" in page.locator(".score").first.inner_text()
        # All of it is in sight; a link to this moment would lead nowhere.
        assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
        assert page.get_by_role("button", name="Copy link").count() == 0
        with shown.page.expect_download() as saved_picture:
            page.get_by_role("button", name="PNG", exact=True).click()
        assert Path(saved_picture.value.path()).read_bytes().startswith(b"\x89PNG")
        # Whatever were to run in the frame has no way out of it: neither to the notebook nor to the network.
        assert (
            page.evaluate("() => { try { return parent.document.title; } catch { return 'kept out'; } }") == "kept out"
        )
        assert shown.troubles == []
        assert shown.elsewhere(cell.as_uri()) == []


def test_the_page_can_be_kept(saved: Path, tmp_path: Path):
    watched = rapid.load_agent(saved).watch(seed=900_003)
    page = watched.save(tmp_path / "episode.html").read_text(encoding="utf-8")
    payload = re.search(r'id="payload">(.*?)</script>', page)
    assert payload
    assert json.loads(payload[1])["episodes"][0]["spawn"] == 900_003
