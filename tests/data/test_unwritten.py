"""What an end in the middle costs in paid answers is counted: by a kill, by a second Ctrl-C, by the end of the time."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fake_server import Server, answer, completion
from rapid.config import TeacherConfig
from rapid.data.card import card
from rapid.data.collection import collect
from rapid.data.dataset import Dataset, load_dataset
from rapid.data.driving import Budget, SpentError
from rapid.data.fallbacks import TooManyFallbacksError
from rapid.data.unwritten import Cost, greetings_in, lost_in
from rapid.errors import RapidError
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.decision import Decision
from rapid.teacher.endpoint import Endpoint
from rapid.termination import StoppedError

SCENARIO = "lane-3-density-2-fast"
SCRIPT = """
import sys
from rapid.config import TeacherConfig
from rapid.data.collection import collect
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.endpoint import Endpoint
config = TeacherConfig(backend="endpoint", model="m", base_url=sys.argv[1], api_key_env="NONE")
teacher = ConversingTeacher(Endpoint(config), config, {"model": "m"}, 3)
collect(teacher, "lane-3-density-2-fast", sys.argv[2], 120, 4)
"""


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


class Stuck:
    """Answers so many requests at once, and none after them until it is let go."""

    def __init__(self, quick: int) -> None:
        self.left, self.begun, self.open = quick, threading.Semaphore(0), threading.Event()

    def __call__(self, handler: Any, request: Any) -> None:
        self.left -= 1
        if self.left < 0:
            self.begun.release()
            self.open.wait(30)
        try:
            answer(completion("keep"))(handler, request)
        except OSError:  # nobody waits any more
            return


def driver(server: Server, greets: bool = False, **settings: Any) -> ConversingTeacher:
    config = TeacherConfig(backend="endpoint", model="m", base_url=server.url, api_key_env="NONE", **settings)
    endpoint = Endpoint(config)
    return ConversingTeacher(endpoint, config, {"model": "m"}, 3, greet=endpoint.greet if greets else None)


def go_on(server: Server, place: Path, **options: Any) -> Dataset:
    server.acts = [answer(completion("keep"))]
    return collect(driver(server), SCENARIO, place, 120, 4, **options)


def test_what_a_kill_costs_in_paid_answers_is_counted(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    stuck = Stuck(8)  # two steps of four worlds; in the third there are three
    server.acts = [stuck]
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, server.url, str(tmp_path / "killed")])
    for _ in range(3):
        assert stuck.begun.acquire(timeout=120)
    process.kill()
    process.wait()
    stuck.open.set()
    before = len(server.requests)
    assert before == 11
    data = go_on(server, tmp_path / "killed")
    # What a decision costs, as that server tells.
    each = json.loads(json.dumps(completion("keep")))["usage"]
    tokens = 3 * (each["prompt_tokens"] + each["completion_tokens"])
    said = capsys.readouterr().err
    assert f"at most 3 decisions, about {tokens} tokens were paid for and lost" in said
    assert len(server.requests) - before == len(data) - 8
    assert lost_in(data.collection) == Cost(3, tokens, 0.0)
    assert f"lost when processes ended: at most 3 decisions, about {tokens} tokens" in card(data)
    # It stays known when the collection is extended, and a whole one tells of nothing.
    more = collect(driver(server), SCENARIO, tmp_path / "killed", 150, 4)
    assert len(more) > len(data)
    assert lost_in(load_dataset(tmp_path / "killed").collection).decisions == 3
    whole = go_on(server, tmp_path / "whole")
    assert whole.collection is not None
    assert "lost" not in whole.collection
    assert "lost when" not in card(whole)
    assert whole.transitions.action_N.tolist() == data.transitions.action_N.tolist()


def test_to_be_told_to_end_costs_as_much(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    server.acts = [answer(completion("keep"))]
    teacher, calls = driver(server), iter(["yes", "yes", "no"])
    decide = teacher.decide

    def until_told(*given: Any) -> list[Decision]:
        if next(calls) == "no":
            raise StoppedError("what is done is kept")
        return decide(*given)

    monkeypatch.setattr(teacher, "decide", until_told)
    with pytest.raises(StoppedError):
        collect(teacher, SCENARIO, tmp_path, 120, 4)
    assert lost_in(go_on(server, tmp_path).collection).decisions == 3


def test_what_the_second_interruption_lets_go_is_counted(server: Server, tmp_path: Path):
    stuck = Stuck(8)
    server.acts = [stuck]

    def press() -> None:
        for _ in range(3):
            stuck.begun.acquire(timeout=60)
        for _ in range(2):
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGINT)

    presses = threading.Thread(target=press)
    presses.start()
    with pytest.raises(KeyboardInterrupt):
        collect(driver(server), SCENARIO, tmp_path, 120, 4)
    presses.join()
    stuck.open.set()
    assert lost_in(go_on(server, tmp_path).collection).decisions == 3


def test_turns_that_were_paid_for_are_counted_where_a_conversation_ends_between_two(server: Server, tmp_path: Path):
    """The first interruption lets the requests under way end and begins no other: here, the second turns."""
    call = {"id": "1", "type": "function", "function": {"name": "get_available_actions", "arguments": "{}"}}
    turn, pressed = answer(completion(None, tool_calls=[call])), threading.Event()

    def first_turn(handler: Any, request: Any) -> None:
        if len(server.requests) > 4:  # the fourth of the second step
            if len(server.requests) == 8:
                os.kill(os.getpid(), signal.SIGINT)
                pressed.set()
            assert pressed.wait(30)
            time.sleep(0.5)
            turn(handler, request)
        else:
            answer(completion())(handler, request)

    server.acts = [first_turn]
    with pytest.raises(KeyboardInterrupt):
        collect(driver(server, style="react"), SCENARIO, tmp_path, 120, 4)
    assert len(server.requests) == 8
    server.acts = [answer(completion())]
    data = collect(driver(server, style="react"), SCENARIO, tmp_path, 120, 4)
    usage = completion()["usage"]
    assert lost_in(data.collection) == Cost(4, 4 * (usage["prompt_tokens"] + usage["completion_tokens"]), 0.0)


@pytest.mark.parametrize("status", [402, 401])
def test_what_was_answered_before_the_server_refused_is_kept(server: Server, tmp_path: Path, status: int):
    """Of the four of the second step three are answered, and are not asked again."""
    answered = threading.Semaphore(0)

    def act(handler: Any, request: Any) -> None:
        if len(server.requests) == 8 and not refused.is_set():
            refused.set()
            for _ in range(3):
                assert answered.acquire(timeout=30)
            time.sleep(0.3)
            answer({"error": {"message": "no money"}}, status)(handler, request)
            return
        answer(completion("keep"))(handler, request)
        if len(server.requests) > 4:
            answered.release()

    refused = threading.Event()
    server.acts = [act]
    with pytest.raises(RapidError):
        collect(driver(server), SCENARIO, tmp_path, 120, 4)
    before = len(server.requests)
    assert before == 8
    data = go_on(server, tmp_path)
    assert len(server.requests) - before == len(data) - 7
    assert lost_in(data.collection).decisions == 0


def test_lessons_that_were_asked_for_are_counted(server: Server, tmp_path: Path):
    """Crashes are looked back on; the one that is asked about when the user wants no more is paid for and lost."""
    stuck, looked = Stuck(0), threading.Event()

    def act(handler: Any, request: Any) -> None:
        if "lesson" in json.dumps(request):
            looked.set()
            return stuck(handler, request)
        return answer(completion("faster"))(handler, request)

    def press() -> None:
        assert looked.wait(60)
        for _ in range(2):
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGINT)

    server.acts = [act]
    presses = threading.Thread(target=press)
    presses.start()
    with pytest.raises(KeyboardInterrupt):
        collect(driver(server, reflect=True), SCENARIO, tmp_path, 120, 4)
    presses.join()
    stuck.open.set()
    server.acts = [answer(completion("keep"))]
    data = collect(driver(server, reflect=True), SCENARIO, tmp_path, 120, 4)
    lost = lost_in(data.collection)
    assert lost.decisions >= 1
    assert lost.tokens > 0


def test_what_the_end_of_the_time_lets_go_is_counted_and_spent(server: Server, tmp_path: Path):
    stuck = Stuck(8)
    server.acts = [stuck]
    with pytest.raises(SpentError, match="seconds was spent"):
        collect(driver(server), SCENARIO, tmp_path, 120, 4, budget=Budget(seconds=3.0))
    stuck.open.set()
    paid = 8 * 18
    # What was lost counts against the budget: eight were answered, three are guessed.
    with pytest.raises(SpentError, match="tokens was spent"):
        go_on(server, tmp_path, budget=Budget(tokens=paid + 30))
    lost = lost_in(go_on(server, tmp_path).collection)
    assert (lost.decisions, lost.tokens > 0) == (3, True)


LISTING = answer({"data": [{"id": "m"}]})
EACH = 18
"""Tokens of one answer."""


def test_the_decision_that_greets_a_server_is_counted_as_spent(server: Server, tmp_path: Path):
    prices = {"price_in": 1e6, "price_out": 0.0}  # one answer costs 11
    server.acts = [LISTING, answer(completion("keep"))]
    # Four worlds: their first step takes 72 tokens, and with the greeting the budget is spent.
    with pytest.raises(SpentError, match="tokens was spent"):
        collect(driver(server, greets=True, **prices), SCENARIO, tmp_path, 120, 4, budget=Budget(tokens=4 * EACH + 1))
    assert len(server.requests) == 1 + 4
    # Nobody is greeted where nothing may be spent any more.
    with pytest.raises(SpentError, match="cost was spent"):
        collect(driver(server, greets=True, **prices), SCENARIO, tmp_path, 120, 4, budget=Budget(cost=44.5))
    assert len(server.requests) == 1 + 4
    server.acts = [LISTING, answer(completion("keep"))]
    data = collect(driver(server, greets=True, **prices), SCENARIO, tmp_path, 120, 4)
    assert len(server.requests) == 2 + len(data)
    assert greetings_in(data.collection) == Cost(2, 2 * EACH, 22.0)
    assert lost_in(data.collection) == Cost()
    assert "to see that the server answers: 2 decisions, 36 tokens, cost 22\n" in card(data)
    # A finished collection that is extended greets again, and keeps count.
    server.acts = [LISTING, answer(completion("keep"))]
    more = collect(driver(server, greets=True, **prices), SCENARIO, tmp_path, 150, 4)
    assert len(server.requests) == 3 + len(more)
    assert greetings_in(load_dataset(tmp_path).collection).decisions == 3
    assert "greetings" not in (go_on(server, tmp_path / "nobody").collection or {})


def test_a_question_for_the_models_that_is_let_go_is_no_decision(server: Server, tmp_path: Path):
    stuck = Stuck(0)
    server.acts = [stuck]
    with pytest.raises(SpentError, match="seconds was spent"):
        collect(driver(server, greets=True), SCENARIO, tmp_path, 120, 4, budget=Budget(seconds=1.0))
    assert not server.requests
    stuck.open.set()
    assert lost_in(go_on(server, tmp_path).collection) == Cost()


def test_a_greeting_that_is_let_go_is_one_decision_lost(server: Server, tmp_path: Path):
    stuck = Stuck(0)
    server.acts = [LISTING, stuck]
    with pytest.raises(SpentError, match="seconds was spent"):
        collect(driver(server, greets=True), SCENARIO, tmp_path / "late", 120, 4, budget=Budget(seconds=2.0))
    stuck.open.set()
    assert len(server.requests) == 1
    assert lost_in(go_on(server, tmp_path / "late").collection).decisions == 1


def test_a_process_that_ends_while_it_greets_loses_one_decision(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    teacher = driver(server, greets=True)

    def told() -> None:
        raise StoppedError("what is done is kept")

    monkeypatch.setattr(teacher, "get_ready", told)
    with pytest.raises(StoppedError):
        collect(teacher, SCENARIO, tmp_path, 120, 4)
    assert lost_in(go_on(server, tmp_path).collection).decisions == 1


def test_a_greeting_that_an_interruption_lets_end_is_spent_and_not_lost(server: Server, tmp_path: Path):
    def act(handler: Any, request: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.5)
        answer(completion("keep"))(handler, request)

    server.acts = [LISTING, act]
    with pytest.raises(KeyboardInterrupt):
        collect(driver(server, greets=True), SCENARIO, tmp_path, 120, 4)
    assert len(server.requests) == 1
    data = go_on(server, tmp_path)
    assert (greetings_in(data.collection), lost_in(data.collection)) == (Cost(1, EACH, 0.0), Cost())


def test_a_greeting_without_a_usable_end_is_counted_for_what_it_took(server: Server, tmp_path: Path):
    """In react style the first turn is answered and the second is not: nothing is driven, and 18 tokens are paid."""
    call = {"id": "1", "type": "function", "function": {"name": "get_available_actions", "arguments": "{}"}}
    broken = answer({"choices": []})
    server.acts = [LISTING, answer(completion(None, tool_calls=[call])), broken]
    with pytest.raises(RapidError, match="was asked for one decision"):
        collect(driver(server, greets=True, style="react", max_retries=0), SCENARIO, tmp_path, 120, 4)
    server.acts = [answer(completion())]
    data = collect(driver(server, style="react", max_retries=0), SCENARIO, tmp_path, 120, 4)
    assert greetings_in(data.collection) == Cost(1, EACH, 0.0)


def test_answers_that_are_thrown_away_since_the_rule_decides_too_often_are_counted(server: Server, tmp_path: Path):
    """Four decisions are made and kept; from then on every answer, and its correction, is none."""
    server.acts = [*[answer(completion("keep"))] * 4, answer(completion("I like cheese"))]
    with pytest.raises(TooManyFallbacksError):
        collect(driver(server), SCENARIO, tmp_path, 120, 4, budget=Budget(fallback_share=0.2))
    thrown = len(server.requests) - 4
    assert thrown > 0
    assert lost_in(go_on(server, tmp_path).collection) == Cost(thrown // 2, EACH * thrown, 0.0)


def test_turns_that_led_to_no_answer_before_the_server_was_given_up_are_counted(server: Server, tmp_path: Path):
    """First turns are answered and second ones are not: what the rule decided so, in two steps, is asked again."""
    call = {"id": "1", "type": "function", "function": {"name": "get_available_actions", "arguments": "{}"}}
    first, second = answer(completion(None, tool_calls=[call])), answer({"choices": []})

    def act(handler: Any, request: Any) -> None:
        (second if request["messages"][-1]["role"] == "tool" else first)(handler, request)

    server.acts = [act]
    with pytest.raises(RapidError, match="in a row"):
        collect(driver(server, style="react", max_retries=0), SCENARIO, tmp_path, 120, 4)
    asked = len(server.requests) // 2
    assert asked > 4
    server.acts = [answer(completion())]
    data = collect(driver(server, style="react", max_retries=0), SCENARIO, tmp_path, 120, 4)
    assert lost_in(data.collection) == Cost(asked, EACH * asked, 0.0)
