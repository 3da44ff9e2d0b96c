"""Servers that answer oddly but lawfully: the client adapts, says once what it gave up, and makes no wrong label."""
# pyright: basic

import itertools
import json
import math
import time
from email.utils import formatdate

import pytest

from fake_server import Server, answer, completion, refuse
from rapid.cli import main
from rapid.config import TeacherConfig
from rapid.data.card import card
from rapid.data.collection import collect
from rapid.data.dataset import load_dataset
from rapid.errors import RapidError
from rapid.teacher import make_teacher
from rapid.teacher.chat import ChatError, Reply, Request, ToolCall
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.dialect import Dialect, write
from rapid.teacher.endpoint import Endpoint
from rapid.teacher.tools import tool_specifications

QUESTION = Request([{"role": "system", "content": "S"}, {"role": "user", "content": "U"}], [], None)
SURE = {"token": "keep", "logprob": -0.01, "top_logprobs": [{"token": "keep", "logprob": -0.01}]}
STYLES = ("digest", "react")


@pytest.fixture
def server(monkeypatch):
    monkeypatch.delenv("RAPID_TEST_KEY", raising=False)
    server = Server()
    yield server
    server.close()


def settings(server, **changes) -> TeacherConfig:
    values = {"timeout_s": 5.0, "max_retries": 1, "concurrency": 4, **changes}
    return TeacherConfig(backend="endpoint", model="m", base_url=server.url, api_key_env="RAPID_TEST_KEY", **values)


def driver(server, **changes) -> ConversingTeacher:
    config = settings(server, **changes)
    return ConversingTeacher(Endpoint(config, first_wait=0.01), config, {"model": "m"}, 3)


def ask(server, request=QUESTION, **changes) -> Reply:
    return Endpoint(settings(server, **changes), first_wait=0.01).ask(request)


def refusing(wrong, status: int, said: str, good=None):
    """Act as a server that refuses every request of which `wrong` is true."""
    body = good or completion(json.dumps({"explanation": "free road", "action": "keep"}), {"content": [SURE]})

    def act(handler, request) -> None:
        (refuse(status, said) if wrong(request) else answer(body))(handler, request)

    return act


def roles(request) -> list[str]:
    return [message["role"] for message in request["messages"]]


def has_system(request) -> bool:
    return "system" in roles(request)


REFUSALS = {
    "max_tokens": (
        lambda request: "max_tokens" in request,
        400,
        "Unsupported parameter: 'max_tokens' is not supported with this model. Use 'max_completion_tokens' instead.",
        "'max_completion_tokens' bounds the answer",
    ),
    "any bound": (
        lambda request: "max_tokens" in request or "max_completion_tokens" in request,
        422,
        "extra fields: max tokens",
        "the length of an answer is not bounded",
    ),
    "a temperature": (
        lambda request: "temperature" in request,
        400,
        "Unsupported value: 'temperature' does not support 0 with this model.",
        "its own temperature is used",
    ),
    "a temperature, unnamed": (
        lambda request: "temperature" in request,
        400,
        "Bad request",
        "its own temperature is used",
    ),
    "a turn of the system": (has_system, 400, "System role not supported", "in the user's first turn"),
    "a turn of the system, with 500": (has_system, 500, "Jinja: System role not supported", "in the user's first turn"),
    "a turn of the system, with an empty 500": (has_system, 500, "", "in the user's first turn"),
}


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_refused_is_given_up_and_told_once(server, world, capsys, style, name):
    wrong, status, said, told = REFUSALS[name]
    server.acts = [refusing(wrong, status, said)]
    teacher = driver(server, style=style)
    for _ in range(3):
        [decision] = teacher.decide(world(), [None])
        assert (decision.action, decision.status) == (1, "ok")
        # Nothing else was given up: the label is as soft as before.
        assert (decision.probabilities is not None) == (style == "digest")
    assert capsys.readouterr().err.count(told) == 1
    last = server.requests[-1]
    assert not wrong(last)
    server.acts = [refuse(400, "no")]
    assert len([request for request in server.requests if wrong(request)]) <= 12


def test_several_refusals_together(server, world):
    """A server in the manner of a reasoning model, which names one fault at a time."""

    def act(handler, request) -> None:
        for field in ("max_tokens", "temperature", "logprobs", "top_logprobs"):
            if field in request:
                refuse(400, f"Unsupported parameter: '{field}'")(handler, request)
                return
        answer(completion("keep"))(handler, request)

    server.acts = [act]
    teacher = driver(server, concurrency=4)
    decisions = teacher.decide(world().repeat(8, 0), [None] * 8)
    assert [decision.status for decision in decisions] == ["ok"] * 8
    assert set(server.requests[-1]) == {"model", "messages", "max_completion_tokens"}


@pytest.mark.parametrize("status", [400, 403, 422])
@pytest.mark.parametrize("most", [5, 1, 0])
def test_fewer_alternatives_come_before_none(server, world, status, most):
    good = completion("keep", {"content": [SURE]} if most else None)
    said = f"top_logprobs must be at most {most}" if most else "logprobs are not allowed for this model"
    server.acts = [refusing(lambda request: request.get("top_logprobs", 0) > most, status, said, good)]
    [decision] = driver(server).decide(world(), [None])
    assert decision.status == "ok"
    assert (decision.probabilities is not None) == (most > 0)
    assert server.requests[-1].get("top_logprobs", 0) == most


def test_one_alternative_alone_is_no_soft_label_where_the_rest_is_unknown(server, world):
    unsure = {"token": "keep", "logprob": math.log(0.55), "top_logprobs": []}
    server.acts = [answer(completion("keep", {"content": [unsure]}))]
    assert driver(server).decide(world(), [None])[0].probabilities is None


@pytest.mark.parametrize("spoiled", [None, {}, 7, {"token": "left"}, {"token": None, "logprob": 0}, {"logprob": -1}])
def test_a_spoiled_alternative_loses_itself_alone(server, world, spoiled):
    others = [{"token": "keep", "logprob": math.log(0.75)}, spoiled, {"token": "slower", "logprob": math.log(0.25)}]
    server.acts = [answer(completion("keep", {"content": [{**others[0], "top_logprobs": others}]}))]
    assert driver(server).decide(world(), [None])[0].probabilities == pytest.approx((0, 0.75, 0, 0, 0.25))


def test_a_forbidden_request_is_the_key_s_fault_if_nothing_else_helps(server):
    server.acts = [refuse(403, "Forbidden")]
    with pytest.raises(RapidError, match="refuses the key: HTTP 403: Forbidden"):
        ask(server)


def call_turns() -> list[dict]:
    function = {"name": "cars_on_lane", "arguments": '{"lane": 1}'}
    calls = [{"id": "c1", "type": "function", "function": function}]
    return [
        {"role": "system", "content": "S"},
        {"role": "user", "content": "U"},
        {"role": "assistant", "content": "", "tool_calls": calls},
        {"role": "tool", "tool_call_id": "c1", "content": "R"},
        {"role": "user", "content": "No more tool calls."},
    ]


def test_roles_that_must_alternate(server):
    def wrong(request) -> bool:
        seen = roles(request)
        return any(pair in (("tool", "user"), ("user", "user")) for pair in itertools.pairwise(seen))

    server.acts = [refusing(wrong, 400, "Unexpected role 'user' after role 'tool'")]
    ask(server, Request(call_turns(), [], None))
    assert roles(server.requests[-1]) == ["system", "user", "assistant", "tool"]
    assert server.requests[-1]["messages"][-1]["content"] == "R\n\nNo more tool calls."
    assert server.requests[-1]["messages"][-1]["tool_call_id"] == "c1"


def test_turns_of_tools_are_told_as_text_where_none_are_offered(server):
    server.acts = [refusing(lambda request: "tool" in roles(request), 400, "'tools' is needed with tool messages")]
    ask(server, Request(call_turns(), [], None))
    assert [(turn["role"], turn["content"]) for turn in server.requests[-1]["messages"]] == [
        ("system", "S"),
        ("user", "U"),
        ("assistant", 'CALL cars_on_lane {"lane": 1}'),
        ("user", "RESULT R\n\nNo more tool calls."),
    ]


def test_tools_survive_a_refusal_that_they_are_not_to_blame_for(server, world, capsys):
    server.acts = [refusing(lambda request: "temperature" in request, 400, "invalid request")]
    teacher = driver(server, style="react")
    assert teacher.decide(world(), [None])[0].status == "ok"
    assert "tools" in server.requests[-1]
    assert "tools" not in capsys.readouterr().err
    # What was accepted before is no reason for a refusal later.
    server.acts = [refuse(400, "the prompt is too long")]
    [decision] = teacher.decide(world(), [None])
    assert decision.error.startswith("no answer: the request was refused: HTTP 400: the prompt is too long")
    server.acts = [answer(completion())]
    assert teacher.decide(world(), [None])[0].status == "ok"
    assert "tools" in server.requests[-1]


def test_a_refusal_of_everything_costs_few_requests(server):
    server.acts = [refuse(400, "no")]
    with pytest.raises(ChatError, match="the request was refused: HTTP 400: no"):
        ask(server, Request(call_turns(), tool_specifications(), {"type": "object"}, True))
    assert len(server.requests) <= 13


def test_every_dialect_keeps_every_word():
    request = Request(call_turns(), tool_specifications(), {"type": "object"}, True)
    for system in (True, False):
        for runs in (True, False):
            for tool_turns in (True, False):
                dialect = Dialect(system=system, runs=runs, tool_turns=tool_turns)
                said = json.dumps(write(dialect, request, "m", 4)["messages"])
                assert all(word in said for word in ("S", "U", "cars_on_lane", "R", "No more tool calls."))


# Shapes of answers.

CALL = {"id": "c1", "type": "function", "function": {"name": "cars_on_lane", "arguments": '{"lane": 1}'}}
OFFERED = Request(QUESTION.messages, tool_specifications(), None)


def with_function(**changes) -> dict:
    return {**CALL, "function": {**CALL["function"], **changes}}


@pytest.mark.parametrize(
    ("call", "read"),
    [
        (CALL, ToolCall("c1", "cars_on_lane", '{"lane": 1}')),
        (with_function(arguments={"lane": 1}), ToolCall("c1", "cars_on_lane", '{"lane": 1}')),
        (with_function(arguments=None), ToolCall("c1", "cars_on_lane", "{}")),
        (with_function(arguments=""), ToolCall("c1", "cars_on_lane", "{}")),
        (with_function(arguments=[1]), ToolCall("c1", "cars_on_lane", "{}")),
        ({"function": CALL["function"]}, ToolCall("call_1", "cars_on_lane", '{"lane": 1}')),
        ({**CALL, "id": None, "type": 7}, ToolCall("call_1", "cars_on_lane", '{"lane": 1}')),
        (with_function(name=None), None),
        ({"id": "c1", "function": "cars_on_lane"}, None),
        (None, None),
    ],
)
def test_calls_of_any_form(server, call, read):
    server.acts = [answer(completion(None, tool_calls=[call]))]
    assert ask(server, OFFERED).calls == ((read,) if read else ())
    # What nobody offered is no call.
    assert ask(server, QUESTION).calls == ()


def test_few_calls_of_one_turn_are_read(server):
    server.acts = [answer(completion(None, tool_calls=[CALL] * 5000))]
    assert len(ask(server, OFFERED).calls) == 16


@pytest.mark.parametrize(
    ("content", "text", "reasoning"),
    [
        ("keep", "keep", ""),
        ([{"type": "text", "text": "ke"}, {"type": "text", "text": "ep"}], "keep", ""),
        (["ke", "ep"], "keep", ""),
        ([{"type": "thinking", "thinking": [{"type": "text", "text": "faster?"}]}, {"type": "text", "text": "keep"}],
         "keep", "faster?"),
        ([{"type": "reasoning", "text": "faster"}], "", "faster"),
        ([{"type": "image_url", "text": "faster"}, None, 7, [], {"type": [], "text": "x"}], "", ""),
        ({"type": "text", "text": "keep"}, "", ""),
        ("keep</s>", "keep", ""),
        ("keep<|im_end|>\n<|endoftext|>", "keep", ""),
        ("ke\x1b[31mep\x07\u202e\ud800", "ke\ufffd[31mep\ufffd\ufffd\ufffd", ""),
    ],
)  # fmt: skip
def test_content_of_any_form(server, content, text, reasoning):
    server.acts = [answer(json.dumps(completion(content)))]
    reply = ask(server)
    assert (reply.text, reply.reasoning) == (text, reasoning)
    reply.text.encode()


def test_thoughts_beside_the_content(server):
    server.acts = [answer(completion(None, reasoning_content="faster"))]
    assert (ask(server).text, ask(server).reasoning) == ("", "faster")


def test_of_several_choices_the_first_with_a_message_is_read(server):
    body = completion("keep")
    body["choices"] = [None, {"message": None}, body["choices"][0], {**body["choices"][0], "message": {"content": "x"}}]
    server.acts = [answer(body)]
    assert ask(server).text == "keep"


@pytest.mark.parametrize("reason", ["length", "max_tokens"])
def test_a_cut_answer_names_the_option(server, world, reason):
    body = completion("I would")
    body["choices"][0]["finish_reason"] = reason
    server.acts = [answer(body)]
    [decision] = driver(server).decide(world(), [None])
    assert "--teacher.max-answer-tokens" in decision.error


# Errors, in whatever place.


def choice_with_error(**error) -> dict:
    body = completion("kee")
    body["choices"][0] |= {"finish_reason": "error", "error": error}
    return body


@pytest.mark.parametrize(
    ("act", "said", "tries"),
    [
        (answer({"error": {"message": "Model overloaded", "code": 503}}), "HTTP 503: Model overloaded", 2),
        (answer({"error": "plain words"}), "HTTP 500: plain words", 2),
        (answer(choice_with_error(message="Upstream died", code=502)), "HTTP 502: Upstream died", 2),
        (answer({"error": {"message": "Context too long", "code": 400}}), "HTTP 400: Context too long", 1),
        (answer({"message": "in another place"}, 500), "HTTP 500: in another place", 2),
        (answer({"detail": [{"msg": "wrong type"}]}, 418), "HTTP 418: wrong type", 1),
        (answer("<html><title>502 Bad\n Gateway</title><p>x", 502), "HTTP 502: 502 Bad Gateway", 2),
        (answer("<html><body><b>Sorry</b>", 200), "a web page: Sorry", 2),
        (answer("data: {}\n\ndata: [DONE]\n\n"), "it answered with a stream", 1),
        (answer("[1]"), "no JSON object: [1]", 2),
        (answer("", 200), "its answer is empty", 2),
        (answer({"choices": []}), "without a message", 2),
        (answer({"error": {"message": "a\x1b]0;title\x07b\nc"}}, 500), "HTTP 500: a\ufffd]0;title\ufffdb c", 2),
    ],
)
def test_the_server_s_own_sentence_is_shown(server, act, said, tries):
    server.acts = [act]
    plain = Request([{"role": "user", "content": "?"}], [], None)
    endpoint = Endpoint(settings(server), first_wait=0.01)
    # As accepted once, the request itself is not to blame.
    server.acts = [answer(completion()), act]
    endpoint.ask(plain)
    with pytest.raises(ChatError) as caught:
        endpoint.ask(plain)
    assert said in str(caught.value)
    assert len(server.requests) == 1 + tries


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (refuse(429, "wait", **{"Retry-After": "3600"}), "wants to be left alone for 1 h 0 min: HTTP 429: wait"),
        (answer({"error": {"message": "pay", "code": "insufficient_quota"}}, 429), "wants to be paid first"),
        (answer("", 308, {"Location": "https://other.invalid/v1"}), "set --teacher.base-url to https://other.invalid"),
    ],
)
def test_what_no_retry_cures_is_not_retried(server, act, said):
    server.acts = [act]
    endpoint = Endpoint(settings(server), first_wait=0.01)
    for _ in range(2):
        with pytest.raises(RapidError, match=said):
            endpoint.ask(QUESTION)
    assert len(server.requests) == 1


@pytest.mark.parametrize("after", ["nan", "inf", "-inf", "-5", "1e400", "soon", "0x10", "", "Wed, 99 Foo 2015"])
def test_a_pause_that_makes_no_sense_is_no_pause(server, after):
    server.acts = [refuse(503, **{"Retry-After": after}), answer(completion())]
    start = time.monotonic()
    assert ask(server).retries == 1
    assert time.monotonic() - start < 2


def test_a_pause_until_a_date_is_kept(server):
    server.acts = [refuse(503, **{"Retry-After": formatdate(time.time() + 2, usegmt=True)}), answer(completion())]
    start = time.monotonic()
    assert ask(server).retries == 1
    assert time.monotonic() - start > 0.7


# Numbers of tokens, and names.


@pytest.mark.parametrize(
    "usage",
    [
        None, [], 7, {}, {"prompt_tokens": 0, "completion_tokens": 0}, {"prompt_tokens": -5, "completion_tokens": -5},
        {"prompt_tokens": 2**70, "completion_tokens": 1e300}, {"prompt_tokens": "11", "completion_tokens": True},
        {"prompt_tokens": 1.5, "completion_tokens": None}, {"prompt_tokens": float("nan")},
    ],
)  # fmt: skip
def test_numbers_of_tokens_that_make_no_sense_are_estimated_and_told(server, world, capsys, usage):
    body = {**completion("keep"), "usage": usage}
    server.acts = [answer(body)]
    teacher = driver(server, price_in=1.0)
    for _ in range(2):
        [decision] = teacher.decide(world(), [None])
        assert 100 < decision.tokens_in < 2000
        assert 1 <= decision.tokens_out < 10
        assert decision.cost > 0
    assert capsys.readouterr().err.count("they are estimated") == 1


def test_another_model_than_asked_for_is_told(server, capsys):
    server.acts = [answer({**completion("keep"), "model": "n-2\x1b[1m"})]
    endpoint = Endpoint(settings(server))
    assert [endpoint.ask(QUESTION).model for _ in range(2)] == ["n-2\ufffd[1m"] * 2
    assert capsys.readouterr().err.count("calls itself 'n-2\ufffd[1m'") == 1


def test_the_model_s_own_name_is_recorded_and_on_the_card(server, tmp_path):
    server.acts = [answer({**completion("keep"), "model": "n-2024"})]
    collect(driver(server), "lane-3-density-2-fast", tmp_path, 20, 2)
    assert set(load_dataset(tmp_path).log.column("served").to_pylist()) == {"n-2024"}  # pyright: ignore[reportOptionalMemberAccess]
    assert "The model called itself: n-2024" in card(load_dataset(tmp_path))


# Before anything is driven.


def listing(*names: str):
    return answer({"object": "list", "data": [{"id": name} for name in names]})


def test_the_server_is_asked_for_its_models_and_one_decision_first(server, world, capsys):
    server.acts = [listing("other"), answer(completion("keep"))]
    teacher = make_teacher(settings(server), 3)
    for _ in range(2):
        assert teacher.decide(world(), [None])[0].status == "ok"
    assert len(server.requests) == 3
    assert "lists no model 'm' (but: other)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "act", [answer("", 404), answer("<html>", 200), answer({"data": [None, 7, {"id": 7}]}), refuse(403)]
)
def test_a_server_without_a_list_is_asked_all_the_same(server, world, act):
    server.acts = [act, answer(completion("keep"))]
    assert make_teacher(settings(server), 3).decide(world(), [None])[0].status == "ok"


def test_an_answer_that_is_none_is_told_before_anything_is_driven(server, world, capsys):
    server.acts = [listing("m"), *[answer(completion("I like\x1b[2J cheese"))] * 2, answer(completion("keep"))]
    assert make_teacher(settings(server), 3).decide(world(), [None])[0].status == "ok"
    assert "asked for one decision before driving, and its answer was none" in (said := capsys.readouterr().err)
    assert "\x1b" not in said


def test_a_server_that_is_not_there_ends_it_before_anything_is_driven(world):
    config = TeacherConfig(backend="endpoint", model="m", base_url="http://127.0.0.1:9/v1", max_retries=0)
    with pytest.raises(RapidError, match=r"gives no answer: no connection: connection refused\. Nothing was driven"):
        make_teacher(config, 3).decide(world(), [None])


@pytest.mark.parametrize("shards", [1, 2])
def test_where_nothing_was_driven_nothing_is_left_in_the_way(server, tmp_path, monkeypatch, shards):
    monkeypatch.setenv("RAPID_TEST_KEY", "k")
    address = {"teacher.backend": "endpoint", "teacher.api-key-env": "RAPID_TEST_KEY", "teacher.max-retries": "0"}
    sizes = {"teacher-transitions": "10", "shards": str(shards), "lockstep": "1", "out": str(tmp_path / "data")}
    options = [word for name, value in (address | sizes).items() for word in (f"--{name}", value)]
    with pytest.raises(SystemExit) as ended:
        main(["collect", *options, "--teacher.base-url", "http://127.0.0.1:9/v1", "--teacher.model", "wrong"])
    assert ended.value.code == 2
    assert not list(tmp_path.iterdir())
    server.acts = [answer({"data": [{"id": "m"}]}), answer(completion("keep"))]
    with pytest.raises(SystemExit) as ended:
        main(["collect", *options, "--teacher.base-url", server.url, "--teacher.model", "m"])
    assert ended.value.code == 0
    assert len(load_dataset(tmp_path / "data")) >= 10


def test_a_server_that_has_models_but_gives_no_answer(server, world):
    server.acts = [listing("m"), answer({"choices": []})]
    with pytest.raises(RapidError, match="was asked for one decision: no answer: it answered without a message"):
        make_teacher(settings(server, max_retries=0), 3).decide(world(), [None])


@pytest.mark.parametrize("status", [200, 503])
def test_a_model_that_is_still_loaded_is_waited_for(server, world, monkeypatch, capsys, status):
    monkeypatch.setattr("rapid.teacher.endpoint._LOADING_LOOK", 0.05)
    loading = answer({"error": {"message": "Loading model", "type": "unavailable_error", "code": 503}}, status)
    server.acts = [*[loading] * 8, listing("m"), *[loading] * 5, answer(completion("keep"))]
    [decision] = make_teacher(settings(server, max_retries=0), 3).decide(world(), [None])
    assert (decision.status, decision.retries) == ("ok", 0)
    assert capsys.readouterr().err.count("still loading its model") == 1


@pytest.mark.parametrize("said", ["Model overloaded", "download failed", "the load is too high"])
def test_what_only_sounds_like_loading_is_no_loading(server, said):
    server.acts = [refuse(503, said)]
    with pytest.raises(ChatError, match=said):
        ask(server)
    assert len(server.requests) == 2


def test_a_model_that_is_loaded_for_ever_is_given_up(server, monkeypatch):
    monkeypatch.setattr("rapid.teacher.endpoint._LOADING_LOOK", 0.05)
    monkeypatch.setattr("rapid.teacher.endpoint.LOADING_WAIT", 0.4)
    server.acts = [refuse(503, "Loading model")]
    with pytest.raises(ChatError, match="HTTP 503: Loading model"):
        ask(server, max_retries=0)
