"""How long is waited: what is said meanwhile, what Ctrl-C does, and what a budget of seconds holds."""

import contextlib
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from fake_server import Server, answer, completion
from rapid.config import TeacherConfig
from rapid.data.collection import collect
from rapid.data.dataset import load_dataset
from rapid.data.driving import Budget, SpentError
from rapid.teacher.chat import Chat, attend, converse
from rapid.teacher.conversation import FAILURES_IN_A_ROW, ConversingTeacher
from rapid.teacher.decision import Decision, InterruptedDecisions, UnfinishedError, UnreachableError
from rapid.teacher.endpoint import Endpoint
from rapid.teacher.experience import Experience
from rapid.teacher.memory import Episode
from rapid.teacher.patience import Patience, StoppedError


@pytest.fixture
def server(monkeypatch):
    monkeypatch.delenv("RAPID_TEST_KEY", raising=False)
    server = Server()
    yield server
    server.close()


def config_for(server, **changes) -> TeacherConfig:
    values = {"timeout_s": 20.0, "max_retries": 0, "concurrency": 8, **changes}
    return TeacherConfig(backend="endpoint", model="m", base_url=server.url, api_key_env="RAPID_TEST_KEY", **values)


def driver(server, **changes) -> ConversingTeacher:
    config = config_for(server, **changes)
    return ConversingTeacher(Endpoint(config, first_wait=0.01), config, {"model": "m"}, 3)


@pytest.fixture(scope="module", autouse=True)
def compiled(tmp_path_factory):
    """Kernels are compiled where no clock runs."""
    server = Server()
    collect(driver(server), "lane-3-density-2-fast", tmp_path_factory.mktemp("compiled"), 30, 4)
    server.close()


class Slow:
    """Answers the first requests at once and every later one after so many seconds, or when it is let go."""

    def __init__(self, quick: int, seconds: float) -> None:
        self.quick, self.seconds = itertools.count(quick, -1), seconds
        self.begun, self.open = threading.Semaphore(0), threading.Event()

    def __call__(self, handler, request) -> None:
        late = next(self.quick) <= 0
        self.begun.release()
        if late:
            self.open.wait(self.seconds)
        # Whoever no longer waits has gone.
        with contextlib.suppress(OSError):
            answer(completion("keep"))(handler, request)


def interrupt(begun: threading.Semaphore, count: int, times: int = 1) -> threading.Thread:
    """Press Ctrl-C, once or more, when so many requests are under way or done."""

    def press() -> None:
        for _ in range(count):
            begun.acquire()
        for _ in range(times):
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    return thread


def test_the_first_interruption_lets_paid_requests_end(server, crowd, capsys):
    slow = Slow(0, 1.5)
    server.acts = [slow]
    teacher = driver(server, concurrency=4)
    pressed = interrupt(slow.begun, 4)
    start = time.monotonic()
    with pytest.raises(InterruptedDecisions) as caught:
        teacher.decide(crowd[:8], [None] * 8)
    pressed.join()
    assert time.monotonic() - start < 8
    made = caught.value.decisions
    assert [decision is not None for decision in made] == [True] * 4 + [False] * 4
    assert len(server.requests) == 4
    said = capsys.readouterr().err
    assert f"Interrupted: 4 requests under way to {server.url} are waited for, at most " in said
    assert "Ctrl-C again does not wait" in said
    # Interrupted in a notebook, it can be asked again.
    server.acts = [answer(completion("keep"))]
    assert len(teacher.decide(crowd[:2], [None] * 2)) == 2


def test_the_second_interruption_waits_for_nothing(server, crowd):
    slow = Slow(0, 15)
    server.acts = [slow]
    pressed = interrupt(slow.begun, 8, times=2)
    start = time.monotonic()
    with pytest.raises(InterruptedDecisions) as caught:
        driver(server).decide(crowd[:8], [None] * 8)
    assert time.monotonic() - start < 10
    assert caught.value.decisions == [None] * 8
    pressed.join()


def test_a_pause_between_retries_ends_with_the_first_interruption(server, crowd):
    begun = threading.Semaphore(0)

    def busy(handler, request) -> None:
        answer({"error": {"message": "busy"}}, 429, {"Retry-After": "30"})(handler, request)
        begun.release()

    server.acts = [busy]
    pressed = interrupt(begun, 2)
    start = time.monotonic()
    with pytest.raises(InterruptedDecisions):
        driver(server, max_retries=3).decide(crowd[:2], [None] * 2)
    assert time.monotonic() - start < 10
    pressed.join()


def test_a_line_says_what_is_waited_for(server, world, capsys, monkeypatch):
    monkeypatch.setattr("rapid.teacher.patience.FIRST_WORD", 0.3)
    server.acts = [Slow(0, 1.2), answer(completion("keep"))]
    teacher = driver(server)
    teacher.decide(world(), [None])
    said = capsys.readouterr().err
    assert said.count(f"Waiting for {server.url}: 1 request under way, the oldest for ") == 1
    assert "s of at most 20 s" in said
    # It is known by now how long this server takes.
    server.acts = [Slow(0, 0.8)]
    teacher.decide(world(), [None])
    assert not capsys.readouterr().err


def test_words_become_rarer_while_nothing_comes(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("rapid.teacher.patience.time.monotonic", lambda: clock[0])
    patience = Patience("it")
    said: list[float] = []
    with patience.flight(1000.0):
        for _ in range(200):
            clock[0] += 1
            if patience.word():
                said.append(clock[0] - 100)
    assert said == [2, 12, 42, 102, 162]
    clock[0] += 100
    assert not patience.word()


def test_nothing_is_begun_or_waited_for_beyond_the_end(server, crowd):
    server.acts = [Slow(2, 15)]
    teacher = driver(server, concurrency=2)
    teacher.end_by(time.monotonic() + 3.0, "Enough")
    start = time.monotonic()
    with pytest.raises(UnfinishedError, match="Enough") as caught:
        teacher.decide(crowd[:6], [None] * 6)
    assert time.monotonic() - start < 8
    # Which two were answered is the threads' affair: a third may reach the server before the second.
    assert sum(decision is not None for decision in caught.value.decisions) == 2
    sent = len(server.requests)
    assert sent == 4
    with pytest.raises(UnfinishedError):
        teacher.decide(crowd[:6], [None] * 6)
    assert len(server.requests) == sent


def test_a_budget_of_seconds_holds_and_no_paid_decision_is_lost(server, tmp_path):
    slow = Slow(5, 15)
    server.acts = [slow]
    start = time.monotonic()
    with pytest.raises(SpentError, match="budget of 5 seconds was spent before the first group"):
        collect(driver(server), "lane-3-density-2-fast", tmp_path, 60, 4, budget=Budget(seconds=5.0))
    assert time.monotonic() - start < 12
    # Five were answered: four in the first two steps, one of the third, which is not asked for again.
    slow.open.set()
    paid = len(server.requests)
    assert paid == 6
    server.acts = [answer(completion("keep"))]
    collect(driver(server), "lane-3-density-2-fast", tmp_path, 60, 4)
    log = load_dataset(tmp_path).log
    assert len(server.requests) - paid == log.num_rows - 5
    other = tmp_path / "other"
    collect(driver(server), "lane-3-density-2-fast", other, 60, 4)
    whole = load_dataset(other).log
    assert log.drop(["seconds"]).equals(whole.drop(["seconds"]))


def test_an_interrupted_step_goes_on_where_it_was(server, tmp_path):
    slow = Slow(6, 4.0)
    server.acts = [slow]
    teacher = driver(server, concurrency=1)
    # The first decision of the fourth step is under way, the second waits for it.
    pressed = interrupt(slow.begun, 7)
    with pytest.raises(KeyboardInterrupt):
        collect(teacher, "lane-3-density-2-fast", tmp_path, 60, 4)
    pressed.join()
    assert len(server.requests) == 7
    server.acts = [answer(completion("keep"))]
    collect(driver(server), "lane-3-density-2-fast", tmp_path, 60, 4)
    assert len(server.requests) == load_dataset(tmp_path).log.num_rows


def test_lessons_that_come_after_a_server_was_given_up_are_counted_as_lost(server, world):
    """Those of two of the crashes were answered meanwhile, and one is under way: all three are asked again."""
    first = FAILURES_IN_A_ROW
    answered = threading.Barrier(first + 2)
    slow = Slow(0, 15)

    def act(handler, request) -> None:
        found = re.search(r"crash number (\d+)", json.dumps(request))
        assert found
        number = int(found[1])
        if number < first:
            answered.wait(30)
            time.sleep(0.3)
            answer({"choices": []})(handler, request)
        elif number == first + 1:
            slow(handler, request)
        else:
            answer(completion('{"lesson": "brake", "action": "slower"}'))(handler, request)
            answered.wait(30)

    server.acts = [act]
    obs_TVF = np.concatenate([world(cars=((30, 1, 14),))] * 2)
    crashes = [
        Episode(obs_TVF, [Decision(1), Decision(1, f"crash number {number}", status="ok")], True, number)
        for number in range(first + 3)
    ]
    teacher, known = driver(server, reflect=True), list[Experience]()
    with pytest.raises(UnreachableError, match="failed 5 decisions in a row"):
        known.extend(teacher.look_back(crashes))
    slow.open.set()
    assert [past.spawn_seed for past in known] == list(range(first - 1))
    assert len(server.requests) == len(crashes)
    assert teacher.lost == 3


class Script:
    """A chat without a server."""

    native_tools = False

    def ask(self, request):
        raise KeyboardInterrupt


def test_a_job_that_raises_is_no_interruption():
    def conversation():
        yield object()

    chat: Chat = Script()
    with pytest.raises(KeyboardInterrupt):
        list(converse([conversation()], chat, 1))
    with pytest.raises(ZeroDivisionError):
        list(attend([lambda: 1 // 0, lambda: time.sleep(0.1)], Patience(), 2))


def test_what_raises_ends_the_others_soon():
    patience = Patience()

    def wait() -> None:
        patience.sleep(30)

    start = time.monotonic()
    with pytest.raises(ZeroDivisionError):
        list(attend([lambda: 1 // 0, wait, wait], patience, 3))
    assert time.monotonic() - start < 3
    patience.check()


def test_a_stopped_patience_begins_nothing():
    patience = Patience()
    patience.stop()
    with pytest.raises(StoppedError), patience.flight(1.0):
        pytest.fail("begun")
    with pytest.raises(StoppedError):
        patience.sleep(0)


@pytest.mark.slow
def test_ctrl_c_at_the_command_line_ends_a_hanging_collection(server, tmp_path):
    """The server answers nothing any more after the first question; two Ctrl-C end it within seconds."""
    server.acts = [answer({"data": [{"id": "m"}]}), answer(completion("keep")), Slow(0, 300)]
    words = {"teacher.backend": "endpoint", "teacher.model": "m", "teacher.base-url": server.url, "lockstep": "2"}
    words |= {"teacher-transitions": "60", "out": str(tmp_path / "data"), "teacher.timeout-s": "600"}
    options = [word for name, value in words.items() for word in (f"--{name}", value)]
    process = subprocess.Popen(
        [sys.executable, "-m", "rapid.cli", "collect", *options], stderr=subprocess.PIPE, text=True
    )
    try:
        while len(server.requests) < 3:
            time.sleep(0.1)
            assert process.poll() is None
        time.sleep(4)
        process.send_signal(signal.SIGINT)
        time.sleep(1)
        start = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120)
    finally:
        process.kill()
    assert time.monotonic() - start < 100
    assert process.returncode == 130
    assert "Traceback" not in said
    assert "requests under way, the oldest for" in said
    assert "Interrupted: 2 requests under way" in said
