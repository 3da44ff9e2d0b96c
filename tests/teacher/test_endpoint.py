"""The endpoint against a server of ours on the loopback that plays every fault a real one has."""

import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher import make_teacher, to_record
from rapid.teacher.conversation import ChatError, ConversingTeacher
from rapid.teacher.endpoint import Endpoint

KEEP = '{"explanation": "calm road", "action": "keep"}'
SECRET = "sk-planted-0123456789"


def completion(text: str | None = KEEP, **message) -> dict:
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 1,
        "model": "m",
        "choices": [
            {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text, **message}}
        ],
        "usage": {"prompt_tokens": 11, "completion_tokens": 7, "total_tokens": 18},
    }


class Server:
    """Plays a list of acts, one per request, the last one for ever; an act gets the handler and the request."""

    def __init__(self) -> None:
        self.acts: list = [answer(completion())]
        self.requests: list[dict] = []
        self.authorization: list[str | None] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                server.requests.append(request)
                server.authorization.append(self.headers["Authorization"])
                act = server.acts.pop(0) if len(server.acts) > 1 else server.acts[0]
                act(self, request)

            def log_message(self, *args) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}/v1"


def answer(body, status=200, headers=None):
    def act(handler, request) -> None:
        content = body.encode() if isinstance(body, str) else json.dumps(body).encode()
        handler.send_response(status)
        for name, value in {"Content-Type": "application/json", **(headers or {})}.items():
            handler.send_header(name, value)
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content)

    return act


def drop(handler, request) -> None:
    handler.close_connection = True
    handler.connection.close()


def hang(handler, request) -> None:
    time.sleep(1.0)
    drop(handler, request)


def refuse(status, text="no", **headers):
    return answer({"error": {"message": text}}, status, headers)


@pytest.fixture
def server(monkeypatch) -> Iterator[Server]:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("RAPID_TEST_KEY", SECRET)
    server = Server()
    yield server
    server.http.shutdown()
    server.http.server_close()


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
    assert server.requests[0]["response_format"]["type"] == "json_schema"
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
    assert (decision.status, decision.retries, len(server.requests)) == ("fallback", 2, 3)
    assert decision.error.startswith("no answer: InternalServerError")


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
    assert decide(server, world).status == "ok"
    assert decide(server, world, style="react", tool_calling="native").status == "fallback"


def test_native_tool_calls(server, world):
    call = {"id": "c1", "type": "function", "function": {"name": "available_actions", "arguments": "{}"}}
    server.acts = [answer(completion(None, tool_calls=[call])), answer(completion())]
    decision = decide(server, world, style="react")
    assert decision.status == "ok"
    assert server.requests[1]["messages"][-1]["tool_call_id"] == "c1"
    assert (decision.tokens_in, decision.tokens_out) == (22, 14)


@pytest.mark.parametrize("status", [401, 403, 404])
def test_what_will_never_work_stops_at_once(server, world, status):
    server.acts = [refuse(status, f"Incorrect key {SECRET}")]
    with pytest.raises(RapidError) as caught:
        decide(server, world)
    assert len(server.requests) == 1
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
        chat.ask([{"role": "user", "content": "?"}], [], None)
    assert not [text for text in [*said, repr(caught.value)] if SECRET in text]


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
