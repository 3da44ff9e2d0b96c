"""The endpoint against a server of ours on the loopback that plays every fault a real one has."""

import json
import math
import time
from collections.abc import Iterator

import pytest

from fake_server import Server, answer, completion, drop, hang, refuse
from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher import from_record, make_teacher, to_record
from rapid.teacher.chat import ChatError, Request
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.endpoint import Endpoint

SECRET = "sk-planted-0123456789"


@pytest.fixture
def server(monkeypatch) -> Iterator[Server]:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("RAPID_TEST_KEY", SECRET)
    server = Server()
    yield server
    server.close()


def settings(server, **changes) -> TeacherConfig:
    values = {"timeout_s": 5.0, "max_retries": 2, "concurrency": 4, **changes}
    return TeacherConfig(backend="endpoint", model="m", base_url=server.url, api_key_env="RAPID_TEST_KEY", **values)


def decide(server, world, **changes):
    config = settings(server, **changes)
    chat = Endpoint(config, first_wait=0.01)
    return ConversingTeacher(chat, config, {"model": "m"}, 3).decide(world(cars=((30, 1, 20),)), [None])[0]


def test_a_good_answer(server, world):
    decision = decide(server, world)
    assert (decision.action, decision.status, decision.tokens_in, decision.tokens_out) == (1, "ok", 11, 7)
    assert (server.requests[0]["logprobs"], server.requests[0]["top_logprobs"]) == (True, 20)
    assert server.authorization == [f"Bearer {SECRET}"]


@pytest.mark.parametrize(
    "fault",
    [
        refuse(429, **{"Retry-After": "0"}),
        refuse(429, **{"Retry-After": "Wed, 21 Oct 2015 07:28:00 GMT"}),
        refuse(500),
        refuse(503, "<html>busy</html>"),
        drop,
        answer("<html>not an API</html>"),
        answer("{"),
        answer({"choices": []}),
        answer({"choices": [{"index": 0, "message": None}]}),
    ],
)
def test_passing_faults_are_retried(server, world, fault):
    server.acts = [fault, answer(completion())]
    decision = decide(server, world)
    assert (decision.action, decision.status, decision.retries) == (1, "ok", 1)


def test_a_timeout_is_retried(server, world):
    server.acts = [hang, answer(completion())]
    decision = decide(server, world, timeout_s=0.2)
    assert (decision.status, decision.retries) == ("ok", 1)


def test_retry_after_is_honoured(server, world):
    server.acts = [refuse(429, **{"Retry-After": "0.3"}), answer(completion())]
    start = time.monotonic()
    assert decide(server, world).retries == 1
    assert time.monotonic() - start >= 0.3


def test_lasting_faults_end_in_a_counted_fallback(server, world):
    server.acts = [refuse(500)]
    decision = decide(server, world)
    # Some servers fail at a turn of the system: once it is tried without.
    roles = [[message["role"] for message in request["messages"]] for request in server.requests]
    assert roles == [["system", "user"]] * 3 + [["user"]]
    assert (decision.status, decision.retries) == ("fallback", 2)
    assert decision.error == "no answer: HTTP 500: no."


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, {}), ("", {}), (None, {"refusal": "I cannot drive."}), ("nonsense", {}), ('{"action": "fly"}', {})],
)
def test_a_server_that_ignores_the_schema_is_asked_once_more(server, world, text, message):
    server.acts = [answer(completion(text, **message)), answer(completion())]
    assert decide(server, world).status == "repaired"
    server.acts = [answer(completion(text, **message))]
    assert decide(server, world).status == "fallback"


def test_what_a_server_refuses_is_left_out(server, world):
    def act(handler, request) -> None:
        unknown = {"tools", "response_format"} & set(request)
        (refuse(400, f"unknown field {unknown}") if unknown else answer(completion()))(handler, request)

    server.acts = [act]
    decision = decide(server, world, style="react")
    assert decision.status == "ok"
    assert [set(request) & {"tools", "response_format"} for request in server.requests] == [{"tools"}, set()]
    # After the tool turns the decision is asked for by a schema.
    call = {"id": "c1", "type": "function", "function": {"name": "available_actions", "arguments": "{}"}}
    server.acts = [answer(completion(None, tool_calls=[call])), act]
    assert decide(server, world, style="react", max_turns=1).status == "ok"
    assert "response_format" in server.requests[-2]
    assert "response_format" not in server.requests[-1]
    assert decide(server, world, style="react", tool_calling="native").status == "fallback"


def token(text: str, **alternatives: float) -> dict:
    """A token as servers report it, with the probabilities of what might have stood there."""
    others = [{"token": other, "logprob": math.log(share), "bytes": None} for other, share in alternatives.items()]
    return {**max(others, key=lambda other: other["logprob"]), "token": text, "top_logprobs": others}


def test_token_probabilities_become_the_soft_label(server, world):
    spelled = {"keep": 0.4, " keep": 0.1, "Ke": 0.1, "slower": 0.2, "I": 0.1, "le": 0.1}
    server.acts = [answer(completion("keep", {"content": [token("keep", **spelled)]}))]
    decision = decide(server, world)
    assert decision.probabilities == pytest.approx((1 / 9, 6 / 9, 0, 0, 2 / 9))
    assert from_record(to_record(decision)) == decision
    # On the leftmost lane there is no way to the left, whatever the model thinks of it.
    config = settings(server)
    leftmost = ConversingTeacher(Endpoint(config), config, {}, 3).decide(world(lane=0), [None])[0]
    assert leftmost.probabilities == pytest.approx((0, 6 / 8, 0, 0, 2 / 8))


def test_the_decision_is_found_inside_json(server, world):
    parts = ["{", '"explanation": "I keep calm", ', '"action"', ': "', "slow", "er", '"}']
    tokens = [token(part, **{part: 1.0}) for part in parts]
    tokens[4] = token("slow", slow=0.75, keep=0.25)
    server.acts = [answer(completion("".join(parts), {"content": tokens}))]
    assert decide(server, world).probabilities == pytest.approx((0, 0.25, 0, 0, 0.75))


@pytest.mark.parametrize(
    "logprobs",
    [
        None,
        [],
        7,
        {"content": None},
        {"content": []},
        {"content": [{}]},
        {"content": [{"token": "keep"}]},
        {"content": [{"token": "keep", "logprob": None, "top_logprobs": None}]},
        {"content": [{"token": "keep", "logprob": "nan", "top_logprobs": []}]},
        {"content": [{"token": "other", "logprob": -0.1, "top_logprobs": [{"token": "x", "logprob": -3}]}]},
        {"content": [{"token": "keep", "logprob": -9999.0, "top_logprobs": []}]},
    ],
)
def test_probabilities_that_make_no_sense_are_none(server, world, logprobs):
    server.acts = [answer(completion("keep", logprobs))]
    decision = decide(server, world)
    assert (decision.action, decision.status, decision.probabilities) == (1, "ok", None)


def test_a_server_without_token_probabilities_is_asked_once_for_them(server, world):
    def act(handler, request) -> None:
        refused = "logprobs" in request
        (refuse(400, "logprobs are not supported") if refused else answer(completion("keep")))(handler, request)

    server.acts = [act]
    config = settings(server, concurrency=1)
    driver = ConversingTeacher(Endpoint(config), config, {"model": "m"}, 3)
    for _ in range(3):
        assert driver.decide(world(), [None])[0].status == "ok"
    assert [request.get("top_logprobs", 0) for request in server.requests] == [20, 5, 1, 0, 0, 0]


def test_native_tool_calls(server, world):
    call = {"id": "c1", "type": "function", "function": {"name": "available_actions", "arguments": "{}"}}
    server.acts = [answer(completion(None, tool_calls=[call])), answer(completion())]
    decision = decide(server, world, style="react")
    assert decision.status == "ok"
    assert server.requests[1]["messages"][-1]["tool_call_id"] == "c1"
    assert (decision.tokens_in, decision.tokens_out) == (22, 14)


@pytest.mark.parametrize(("status", "tries"), [(401, 1), (402, 1), (403, 2), (404, 1), (405, 1), (302, 1)])
def test_what_will_never_work_stops_at_once(server, world, status, tries):
    server.acts = [refuse(status, f"Incorrect key {SECRET}")]
    with pytest.raises(RapidError) as caught:
        decide(server, world)
    # What is forbidden may be the probabilities.
    assert len(server.requests) == tries
    assert SECRET not in str(caught.value)


def test_the_key_is_found_nowhere(server, world, monkeypatch):
    server.acts = [refuse(500, f"key {SECRET} is fine but I am not")]
    config = settings(server)
    chat = Endpoint(config, first_wait=0.01)
    driver = ConversingTeacher(chat, config, {"model": "m"}, 3)
    decision = driver.decide(world(), [None])[0]
    made = make_teacher(config, 3)
    said = [json.dumps(to_record(decision)), json.dumps(driver.describe()), repr(chat), repr(config), repr(made)]
    with pytest.raises(ChatError) as caught:
        chat.ask(Request([{"role": "user", "content": "?"}], [], None))
    assert not [text for text in [*said, repr(caught.value)] if SECRET in text]


@pytest.mark.parametrize("key", ["sk-planted-0123456789", 'sk-"quoted"\\0123', "sk/with+signs=0123"])
def test_an_answer_that_echoes_the_key_is_cleaned(server, world, monkeypatch, key):
    monkeypatch.setenv("RAPID_TEST_KEY", key)
    said = json.dumps({"explanation": f"your key {key} is worn out", "action": "keep"})
    server.acts = [answer(completion(said))]
    record = json.dumps(to_record(decide(server, world)))
    for spelling in (key, json.dumps(key)[1:-1], json.dumps(json.dumps(key)[1:-1])[1:-1]):
        assert spelling not in record
    assert "your key [key] is worn out" in record


def test_a_placeholder_for_a_key_changes_no_answer(server, world, monkeypatch):
    monkeypatch.setenv("RAPID_TEST_KEY", "ee")
    assert decide(server, world).status == "ok"


@pytest.mark.parametrize(
    "address", ["", "localhost:8000/v1", "ftp://host/v1", "http://", "http://[::1", "http://host:port/v1"]
)
def test_what_is_no_address_is_refused(address):
    with pytest.raises(RapidError, match="cannot be used"):
        Endpoint(TeacherConfig(backend="endpoint", base_url=address))


def test_a_password_in_the_address_is_refused_and_not_repeated():
    with pytest.raises(RapidError, match="holds a user name or password") as caught:
        Endpoint(TeacherConfig(backend="endpoint", base_url=f"https://user:{SECRET}@host/v1"))
    assert SECRET not in str(caught.value)


def test_requests_run_side_by_side(server, crowd):
    def slow(handler, request) -> None:
        time.sleep(0.2)
        answer(completion())(handler, request)

    server.acts = [slow]
    config = settings(server, concurrency=8)
    start = time.monotonic()
    decisions = ConversingTeacher(Endpoint(config), config, {"model": "m"}, 3).decide(crowd[:8], [None] * 8)
    assert time.monotonic() - start < 8 * 0.2
    assert len(decisions) == 8


def test_the_rate_limit_spaces_requests(server, crowd):
    config = settings(server, requests_per_minute=600.0)
    start = time.monotonic()
    ConversingTeacher(Endpoint(config), config, {"model": "m"}, 3).decide(crowd[:4], [None] * 4)
    assert time.monotonic() - start >= 3 * 0.1


def test_no_server_at_all(world):
    config = TeacherConfig(backend="endpoint", model="m", base_url="http://127.0.0.1:9/v1", max_retries=1)
    decision = ConversingTeacher(Endpoint(config, 0.01), config, {}, 3).decide(world(), [None])[0]
    assert (decision.status, decision.retries) == ("fallback", 1)
