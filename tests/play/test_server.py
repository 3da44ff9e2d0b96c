"""The server of the live page: who may ask, what it answers, and what it survives."""

import http.client
import json
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from rapid.cli import main
from rapid.errors import RapidError
from rapid.play.roster import TEACHER, YOU, Roster
from rapid.play.server import MOST_BYTES, MOST_TABS, LivePage, first_moment, serve
from rapid.play.session import Session

SCENARIO = "lane-3-density-2"


def get(live: LivePage, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", live.port, timeout=10)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def talk(live: LivePage, origin: str | None = "", token: str | None = None, host: str | None = None):
    origin = f"http://127.0.0.1:{live.port}" if origin == "" else origin
    address = f"ws://127.0.0.1:{live.port}/{token or live.token}/live"
    headers = {} if host is None else {"Host": host}
    return connect(address, origin=origin, additional_headers=headers, proxy=None)  # type: ignore[arg-type]


def asked(session: Session, **message: object) -> dict[str, Any]:
    return json.loads(session.answer(json.dumps({"pane": 0, "ride": 1, **message})))


@pytest.fixture
def session(roster: Roster) -> Session:
    return Session(roster, threading.Lock())


def test_the_page_needs_its_token(live: LivePage) -> None:
    assert get(live, f"/{live.token}/").status == 200
    for path in ("/", "/index.html", f"/{live.token[:-1]}/", f"/{live.token}x/", f"/{live.token}/../etc/passwd"):
        assert get(live, path).status == 404
    assert len(live.token) >= 32


def test_another_name_for_this_machine_is_refused(live: LivePage) -> None:
    # A name of somebody else's may be made to lead here (DNS rebinding); its page must not reach ours.
    assert get(live, f"/{live.token}/", host=f"evil.example:{live.port}").status == 403
    assert get(live, f"/{live.token}/", host="127.0.0.1").status == 403
    assert get(live, f"/{live.token}/", host=f"localhost:{live.port}").status == 200


def test_the_page_is_closed_to_others(live: LivePage) -> None:
    answer = get(live, f"/{live.token}/")
    content = answer.read().decode()
    assert "default-src &#x27;none&#x27;" in content
    assert f"connect-src ws://127.0.0.1:{live.port} ws://localhost:{live.port};" in content
    assert answer.headers["X-Frame-Options"] == "DENY"
    assert answer.headers["Referrer-Policy"] == "no-referrer"
    assert answer.headers["Cache-Control"] == "no-store"
    assert answer.headers["Access-Control-Allow-Origin"] is None
    assert "<b>mixture" not in content


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None, "https://127.0.0.1"])
def test_another_page_cannot_open_a_socket(live: LivePage, origin: str | None) -> None:
    with pytest.raises(InvalidStatus) as refused, talk(live, origin):
        pass
    assert refused.value.response.status_code == 403


def test_a_socket_needs_the_token(live: LivePage) -> None:
    with pytest.raises(InvalidStatus) as refused, talk(live, token="x" * 32):
        pass
    assert refused.value.response.status_code == 404


def test_it_listens_on_this_machine_only(live: LivePage) -> None:
    assert live.address.startswith(f"http://127.0.0.1:{live.port}/{live.token}/#scenario=")
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in (other for other in others if not str(other).startswith("127.")):
        with pytest.raises(OSError), socket.create_connection((str(address), live.port), timeout=2):
            pass


def test_two_tabs_drive_each_their_own_episodes(live: LivePage) -> None:
    with talk(live) as one, talk(live) as two:
        for tab, spawn in ((one, 900_000), (two, 900_001)):
            tab.send(
                json.dumps(
                    {"type": "open", "pane": 0, "ride": 1, "scenario": SCENARIO, "spawn": spawn, "agent": "slower"}
                )
            )
        first, second = (json.loads(tab.recv(timeout=60))["episode"] for tab in (one, two))
        assert (first["spawn"], second["spawn"]) == (900_000, 900_001)
        assert first["frames"] != second["frames"]


def test_a_tab_that_goes_in_the_middle_of_an_episode_leaves_its_place(live: LivePage) -> None:
    for _ in range(2 * MOST_TABS):
        tab = talk(live).__enter__()
        tab.send(
            json.dumps({"type": "open", "pane": 0, "ride": 1, "scenario": SCENARIO, "spawn": 1, "agent": "slower"})
        )
        tab.socket.shutdown(socket.SHUT_RDWR)  # without a word
    with talk(live) as tab:
        tab.send(
            json.dumps({"type": "open", "pane": 0, "ride": 1, "scenario": SCENARIO, "spawn": 1, "agent": "slower"})
        )
        assert json.loads(tab.recv(timeout=60))["type"] == "opened"


def test_too_many_tabs_are_told(live: LivePage) -> None:
    with ExitStack() as stack:
        for tab in [stack.enter_context(talk(live)) for _ in range(MOST_TABS)]:
            tab.send("{}")
            tab.recv(timeout=60)
        late = stack.enter_context(talk(live))
        assert "Close one" in json.loads(late.recv(timeout=60))["message"]


def test_a_message_that_is_too_long_ends_that_tab_alone(live: LivePage) -> None:
    with talk(live) as tab:
        tab.send("x" * (MOST_BYTES + 1))
        with pytest.raises(ConnectionClosed):
            tab.recv(timeout=60)
    assert get(live, f"/{live.token}/").status == 200


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", '"x"', "{}", "[" * 100_000, '{"type": []}', '{"type": "close", "pane": 0}'),
        *('{"type": "open", "pane": 0}', '{"type": "step", "pane": 0}', '{"type": "step", "pane": true}'),
        '{"type": "step", "pane": 2}',
        '{"type": "open", "pane": 0, "scenario": "lane-3-density-2", "spawn": -1, "agent": "slower"}',
        '{"type": "open", "pane": 0, "scenario": "lane-3-density-2", "spawn": 1e3, "agent": "slower"}',
        '{"type": "open", "pane": 0, "scenario": "lane-3-density-2", "spawn": 99999999999999999999, "agent": "slower"}',
        '{"type": "open", "pane": 0, "scenario": "lane-9", "spawn": 1, "agent": "slower"}',
        '{"type": "open", "pane": 0, "scenario": "lane-3-density-2", "spawn": 1, "agent": "../../etc"}',
    ],
)
def test_a_wrong_message_is_answered_by_what_is_wrong_with_it(session: Session, text: str) -> None:
    answer = json.loads(session.answer(text))
    assert answer["type"] == "error"
    assert len(answer["message"]) > 10


def test_wrong_attacks_and_actions_are_told_and_the_episode_goes_on(session: Session) -> None:
    assert asked(session, type="open", scenario=SCENARIO, spawn=1, agent=YOU)["type"] == "opened"
    for wrong in (
        {"action": 9},
        {"action": 1, "attack": "x", "metres": 1},
        {"action": 1, "attack": "pgd", "metres": "1"},
    ):
        assert asked(session, type="step", **wrong)["type"] == "error"
    # json reads NaN, which is no number of metres.
    assert "error" in session.answer('{"type": "step", "pane": 0, "action": 1, "attack": "pgd", "metres": NaN}')
    assert asked(session, type="step", action=1)["type"] == "stepped"


def test_a_failed_choice_leaves_the_episode_that_was(session: Session) -> None:
    asked(session, type="open", scenario=SCENARIO, spawn=1, agent="slower")
    wrong = asked(session, type="open", scenario=SCENARIO, spawn=1, agent="slwer")
    assert "slower" in wrong["message"]  # the nearest name
    assert asked(session, type="step")["type"] == "stepped"


def test_a_crash_is_found(session: Session) -> None:
    found = asked(session, type="find", scenario="lane-5-density-3", spawn=900_000, agent="faster")
    assert found["spawn"] > 900_000
    asked(session, type="open", scenario="lane-5-density-3", spawn=found["spawn"], agent="faster")
    step: dict = {}
    while not step.get("ended"):
        step = asked(session, type="step")
    assert step["crashed"]
    assert "Only you" in asked(session, type="find", scenario=SCENARIO, spawn=1, agent=YOU)["message"]


def test_a_teacher_whose_model_is_not_here_is_told_how_to_fetch_it(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rapid.play.roster.is_present", lambda name: False)
    words = asked(session, type="open", scenario=SCENARIO, spawn=1, agent=TEACHER)["message"]
    assert "rapid models pull" in words


def test_a_road_that_an_agent_does_not_know_is_told(saved: Path, tmp_path: Path) -> None:
    roster = Roster((), tmp_path)
    assert [entry for entry in roster.entries.values() if entry.group == "learned"] == []
    found = Roster((), saved.parents[3]).entries[str(saved)]
    assert (found.label, found.scenario) == ("<b>mixture</b> (tiny)", SCENARIO)


def test_a_port_in_use_and_one_that_is_none(roster: Roster, live: LivePage) -> None:
    with pytest.raises(RapidError, match=rf"Port {live.port} is in use"):
        LivePage(roster, {}, live.port)
    with pytest.raises(RapidError, match="Choose another with --port"):
        LivePage(roster, {}, 99_999)


def failing(address: str) -> bool:
    raise OSError("no browser here")


@pytest.mark.parametrize("opener", [lambda address: False, failing])
def test_without_a_browser_the_address_is_printed(
    roster: Roster, monkeypatch: pytest.MonkeyPatch, opener: Callable[[str], bool]
) -> None:
    def interrupted(self: LivePage) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LivePage, "serve_forever", interrupted)
    lines: list[str] = []
    serve(roster, {}, say=lines.append, opener=opener)
    assert "http://127.0.0.1:" in lines[0]
    assert any("open the address above" in line for line in lines)
    assert lines[-1].endswith("has ended.")


def test_what_is_shown_first(roster: Roster, saved: Path) -> None:
    start = first_moment(roster, (str(saved),))
    assert (start["left"], start["right"], start["scenario"]) == (str(saved), "rule-foresight", SCENARIO)
    again = first_moment(roster, (), moment="http://127.0.0.1:1/x/#scenario=lane-4-density-2&spawn=7&left=you&t=3.0")
    assert again == {"scenario": "lane-4-density-2", "spawn": "7", "left": "you", "t": "3.0"}
    with pytest.raises(RapidError, match="no driver"):
        first_moment(roster, (), moment="scenario=lane-4-density-2&left=nobody")
    with pytest.raises(RapidError, match="no moment"):
        first_moment(roster, (), moment="hello")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["rulee"], "did you mean 'rule'"),
        (["--scenario", "lane-3"], "Unknown scenario"),
        (["--scenario", "highway-v0"], "The same road is 'lane-4-density-1'"),
        (["--port", "70000"], "between 0 and 65535"),
        (["--moment", "x"], "no moment"),
    ],
)
def test_the_verb_refuses_before_it_serves(words: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["play", "--no-browser", *words])
    assert ended.value.code == 2
    assert expected in capsys.readouterr().err
