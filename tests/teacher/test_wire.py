"""What enters from outside enters under a deadline and a limit, whatever is sent and however slowly."""

import gzip
import json
import os
import socket
import ssl
import subprocess
import threading
import time
import tracemalloc
import zlib
from functools import cache

import pytest

from fake_server import completion
from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher.address import open_access
from rapid.teacher.chat import ChatError, Request
from rapid.teacher.endpoint import Endpoint
from rapid.teacher.patience import Patience, StoppedError
from rapid.teacher.wire import WireError, _context, exchange
from raw_server import read_request, serving

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
GOOD = json.dumps(completion("keep")).encode()
QUESTION = Request([{"role": "user", "content": "?"}], [], None)
PROXIES = ("http_proxy", "https_proxy", "all_proxy", "no_proxy")


@pytest.fixture(autouse=True)
def no_proxies(monkeypatch):
    for name in PROXIES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)


def whole(body: bytes, *headers: bytes) -> bytes:
    lines = b"".join(header + b"\r\n" for header in headers)
    return HEAD + lines + b"Content-Length: %d\r\n\r\n" % len(body) + body


def config_for(url: str, **changes) -> TeacherConfig:
    values = {"timeout_s": 0.6, "max_retries": 0, "api_key_env": "RAPID_TEST_KEY", **changes}
    return TeacherConfig(backend="endpoint", model="m", base_url=url, **values)


def drip(*pieces: bytes, every: float = 0.05):
    """Send the first piece, and then the others for ever, one at a time: no single wait is long."""

    def act(connection: socket.socket) -> None:
        connection.sendall(pieces[0])
        while True:
            for piece in pieces[1:]:
                time.sleep(every)
                connection.sendall(piece)

    return act


SLOW = {
    "silence": lambda connection: time.sleep(5),
    "one byte of the status at a time": drip(b"HTTP/1.1 200 ", b"x"),
    "one header after another": drip(b"HTTP/1.1 200 OK\r\n", b"X: 1\r\n"),
    "one byte of a header at a time": drip(b"HTTP/1.1 200 OK\r\nX: ", b"y"),
    "continue for ever": drip(b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "a body that drips": drip(HEAD + b"Content-Length: 100000\r\n\r\n", b" "),
    "chunks that drip": drip(HEAD + b"Transfer-Encoding: chunked\r\n\r\n", b"1\r\n \r\n"),
    "trailers that drip": drip(HEAD + b"Transfer-Encoding: chunked\r\n\r\n0\r\n", b"T: 1\r\n"),
    "a body without an end": drip(HEAD + b"\r\n{", b" "),
}


@pytest.mark.parametrize("act", SLOW.values(), ids=SLOW)
def test_the_deadline_is_for_the_whole_answer(act):
    with serving(act) as server:
        start = time.monotonic()
        with pytest.raises(ChatError, match=r"no whole answer within 0.6 s \(--teacher.timeout-s\)"):
            Endpoint(config_for(server.url)).ask(QUESTION)
        assert time.monotonic() - start < 3


def test_a_server_that_accepts_nothing_is_not_waited_for_longer():
    # A queue of one that is full: the system answers no further attempt to connect.
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen(0)
    port = listening.getsockname()[1]
    waiting = [socket.socket() for _ in range(4)]
    for one in waiting:
        one.setblocking(False)
        one.connect_ex(("127.0.0.1", port))
    start = time.monotonic()
    with pytest.raises(ChatError):
        Endpoint(config_for(f"http://127.0.0.1:{port}/v1")).ask(QUESTION)
    assert time.monotonic() - start < 3
    for one in (*waiting, listening):
        one.close()


def test_a_name_that_is_looked_up_for_ever(monkeypatch):
    real = socket.getaddrinfo

    def slow(host, *rest, flags=0, **options):
        if not flags & socket.AI_NUMERICHOST:
            time.sleep(3)
        return real(host, *rest, flags=flags, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    start = time.monotonic()
    with pytest.raises(ChatError, match="no whole answer"):
        Endpoint(config_for("http://localhost:9/v1")).ask(QUESTION)
    assert time.monotonic() - start < 2


def flood(start: bytes, piece: bytes):
    def act(connection: socket.socket) -> None:
        connection.sendall(start)
        while True:
            connection.sendall(piece)

    return act


FLOODS = {
    "a body without an end": flood(HEAD + b"\r\n", b" " * 65536),
    "chunks without an end": flood(HEAD + b"Transfer-Encoding: chunked\r\n\r\n", b"10000\r\n" + b" " * 65536 + b"\r\n"),
    "a chunk of negative size": flood(HEAD + b"Transfer-Encoding: chunked\r\n\r\n-1\r\n", b" " * 65536),
    "a chunk of huge size": flood(HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + b"f" * 15 + b"\r\n", b" " * 65536),
    "a huge length": flood(HEAD + b"Content-Length: 99999999999999999999\r\n\r\n", b" " * 65536),
    "trailers without an end": flood(HEAD + b"Transfer-Encoding: chunked\r\n\r\n0\r\n", b"T: " + b"1" * 6000 + b"\r\n"),
    "continue without an end": flood(b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 2000),
    "a bomb": lambda connection: connection.sendall(whole(bomb(), b"Content-Encoding: gzip")),
    "a bomb in a bomb": lambda connection: connection.sendall(whole(gzip.compress(bomb()), b"Content-Encoding: gzip")),
}


@cache
def bomb() -> bytes:
    """Pack 60 MB of spaces into 60 KB."""
    packing = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS + 16)
    piece = b" " * 1_000_000
    return b"".join([packing.compress(piece) for _ in range(60)]) + packing.flush()


@pytest.mark.parametrize("act", FLOODS.values(), ids=FLOODS)
def test_no_more_is_read_than_an_answer_can_have(act):
    with serving(act) as server:
        endpoint = Endpoint(config_for(server.url, timeout_s=20.0))
        bomb()
        tracemalloc.start()
        start = time.monotonic()
        try:
            with pytest.raises((ChatError, RapidError)):
                endpoint.ask(QUESTION)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 30e6
        assert time.monotonic() - start < 15


NESTED = {
    "open lists": b"[" * 1_000_000,
    "open objects": b'{"a":' * 400_000,
    "open braces": b"{" * 2_000_000,
    "closed lists": b'{"choices":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "a long number": b'{"usage":' + b"9" * 1_000_000 + b"}",
    "no text at all": bytes(range(128, 256)) * 8000,
    "tags": b"<" * 2_000_000,
    "titles": b"<title" * 300_000,
    "spaces in arguments": json.dumps(
        completion(None, tool_calls=[{"id": "1", "function": {"name": "a", "arguments": " " * 1_900_000}}])
    ).encode(),
    "braces in the text": json.dumps(completion("{" * 1_900_000)).encode(),
    "end marks in the text": json.dumps(completion("</s>" * 400_000)).encode(),
}


@pytest.mark.parametrize("body", NESTED.values(), ids=NESTED)
def test_what_is_read_takes_time_in_proportion(body):
    with serving(lambda connection: connection.sendall(whole(body))) as server:
        endpoint = Endpoint(config_for(server.url, timeout_s=20.0))
        start = time.monotonic()
        try:
            said = endpoint.ask(QUESTION).text
        except ChatError as error:
            said = str(error)
        assert len(said) <= 16_384
        assert time.monotonic() - start < 5


BROKEN = {
    "nothing": b"",
    "no HTTP": b"SSH-2.0-OpenSSH_9\r\n",
    "half a head": HEAD,
    "half a body": HEAD + b"Content-Length: 5000\r\n\r\n" + GOOD,
    "half a chunk": HEAD + b"Transfer-Encoding: chunked\r\n\r\n500\r\n" + GOOD,
    "a chunk of no size": HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n",
    "a long header": HEAD + b"X: " + b"y" * 70_000 + b"\r\n\r\n",
    "many headers": HEAD + b"X: y\r\n" * 200 + b"\r\n",
    "a status of no number": b"HTTP/1.1 abc OK\r\n\r\n",
    "a status beyond": b"HTTP/1.1 99999 OK\r\n\r\n",
    "damaged gzip": whole(b"\x1f\x8bxxxxxxxxxxxxxxxx", b"Content-Encoding: gzip"),
    "half gzip": whole(gzip.compress(GOOD)[:-12], b"Content-Encoding: gzip"),
    "another encoding": whole(GOOD, b"Content-Encoding: br"),
    "header bytes of any kind": HEAD + bytes(range(128, 256)) + b": \xff\r\nRetry-After: \xff\r\n\r\n",
}


@pytest.mark.parametrize("sent", BROKEN.values(), ids=BROKEN)
def test_what_is_no_answer_is_a_sentence(sent):
    with serving(lambda connection: connection.sendall(sent)) as server, pytest.raises(ChatError) as caught:
        Endpoint(config_for(server.url)).ask(QUESTION)
    assert len(str(caught.value)) > 10


@pytest.mark.parametrize(
    ("body", "headers"),
    [
        (GOOD, ()),
        (b"\xef\xbb\xbf" + GOOD, ()),
        (gzip.compress(GOOD), (b"Content-Encoding: gzip",)),
        (zlib.compress(GOOD), (b"Content-Encoding: deflate",)),
    ],
    ids=["plain", "with a byte order mark", "gzip", "deflate"],
)
def test_what_is_sent_unasked_but_lawfully_is_read(body, headers):
    with serving(lambda connection: connection.sendall(whole(body, *headers))) as server:
        assert Endpoint(config_for(server.url)).ask(QUESTION).text == "keep"


def test_interim_answers_are_passed_over():
    sent = b"HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 103 Early Hints\r\nLink: x\r\n\r\n"
    with serving(lambda connection: connection.sendall(b"HTTP/1.1 100 Continue\r\n\r\n" + whole(GOOD))) as server:
        assert Endpoint(config_for(server.url)).ask(QUESTION).text == "keep"
    with serving(lambda connection: connection.sendall(sent + whole(GOOD))) as server, pytest.raises(ChatError):
        # Of interim answers only "continue" is known; another is told as what it is.
        Endpoint(config_for(server.url)).ask(QUESTION)


def exchanged(url: str, patience: Patience, seconds: float = 5.0):
    access = open_access(config_for(url))
    with patience.flight(seconds) as flight:
        return exchange("GET", access.address, "models", access.headers, b"", flight, 1 << 20)


def test_a_wait_ends_when_it_is_no_longer_wanted():
    patience = Patience()
    with serving(SLOW["silence"]) as server:
        threading.Timer(0.3, patience.drop).start()
        start = time.monotonic()
        with pytest.raises(StoppedError):
            exchanged(server.url, patience)
        assert 0.2 < time.monotonic() - start < 1.5
        with pytest.raises(StoppedError):
            exchanged(server.url, patience)
        assert len(server.requests) == 1


def test_a_query_of_the_base_address_stays_at_the_end(monkeypatch):
    monkeypatch.setenv("RAPID_SECRET_PART", "s/cret 1234567890")
    with serving(lambda connection: connection.sendall(whole(GOOD))) as server:
        url = f"{server.url}/deployments/gpt-4o-mini-2024-07-18?api-version=2024-10-21&key=${{RAPID_SECRET_PART}}"
        Endpoint(config_for(url)).ask(QUESTION)
        Endpoint(config_for(f"{server.url}/chat/completions")).ask(QUESTION)
    lines = [request.partition(b"\r\n")[0] for request in server.requests]
    path = b"/v1/deployments/gpt-4o-mini-2024-07-18/chat/completions"
    assert lines == [
        b"POST " + path + b"?api-version=2024-10-21&key=s%2Fcret%201234567890 HTTP/1.1",
        b"POST /v1/chat/completions HTTP/1.1",
    ]


def test_further_headers_are_sent(monkeypatch):
    monkeypatch.setenv("RAPID_TEST_HEADERS", "api-key: planted-0123456789\n\nX-Title: a b\n")
    with serving(lambda connection: connection.sendall(whole(GOOD))) as server:
        Endpoint(config_for(server.url, headers_env="RAPID_TEST_HEADERS")).ask(QUESTION)
    assert b"\r\napi-key: planted-0123456789\r\nx-title: a b\r\n" in server.requests[0]


@pytest.mark.parametrize(
    "value", ["", "no header", "a b: c", "Host: other", "Content-Length: 0", "x: \u20ac", "x: a\x1bb", ": y"]
)
def test_what_is_no_header_is_refused(monkeypatch, value):
    monkeypatch.setenv("RAPID_TEST_HEADERS", value)
    with pytest.raises(RapidError, match="RAPID_TEST_HEADERS"):
        Endpoint(config_for("http://127.0.0.1:9/v1", headers_env="RAPID_TEST_HEADERS"))


def test_a_key_that_no_header_can_carry_is_refused(monkeypatch):
    monkeypatch.setenv("RAPID_TEST_KEY", "sk-\u20ac-planted")
    with pytest.raises(RapidError, match="RAPID_TEST_KEY holds characters") as caught:
        Endpoint(config_for("http://127.0.0.1:9/v1"))
    assert "planted" not in str(caught.value)


def test_loopback_never_goes_through_a_proxy(monkeypatch):
    for name in ("HTTP_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, "socks5://192.0.2.1:1080")
    with serving(lambda connection: connection.sendall(whole(GOOD))) as server:
        for host in ("127.0.0.1", "localhost"):
            assert Endpoint(config_for(server.url.replace("127.0.0.1", host))).ask(QUESTION).text == "keep"


@pytest.mark.parametrize("variable", ["ALL_PROXY", "all_proxy", "HTTP_PROXY", "http_proxy"])
def test_a_proxy_of_another_kind_is_named(monkeypatch, variable):
    monkeypatch.setenv(variable, "socks5://127.0.0.1:1080")
    with pytest.raises(RapidError, match=f"{variable} asks for a proxy of the kind 'socks5'"):
        Endpoint(config_for("http://model.invalid/v1"))
    monkeypatch.setenv("NO_PROXY", "model.invalid")
    Endpoint(config_for("http://model.invalid/v1"))


def test_a_proxy_is_asked_for_the_whole_address_and_its_password_is_kept(monkeypatch):
    def act(connection: socket.socket) -> None:
        connection.sendall(whole(json.dumps(completion("dXNlcjpwLTAxMjM0NTY3 p-01234567 keep")).encode()))

    with serving(act) as server:
        monkeypatch.setenv("HTTP_PROXY", f"http://user:p-01234567@127.0.0.1:{server.port}")
        reply = Endpoint(config_for("http://model.invalid/v1")).ask(QUESTION)
    assert server.requests[0].startswith(b"POST http://model.invalid:80/v1/chat/completions HTTP/1.1\r\n")
    assert b"proxy-authorization: Basic dXNlcjpwLTAxMjM0NTY3\r\n" in server.requests[0]
    assert reply.text == "[key] [key] keep"


def test_a_fault_on_the_way_names_the_proxy(monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    with pytest.raises(ChatError, match=r"connection refused \(through the proxy of HTTP_PROXY\)"):
        Endpoint(config_for("http://model.invalid/v1")).ask(QUESTION)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Make a certificate for this machine, which no authority signed."""
    folder = tmp_path_factory.mktemp("tls")
    names = "subjectAltName=IP:127.0.0.1,DNS:localhost"
    made = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost", "-addext", names]
    try:
        subprocess.run(
            ["openssl", *made, "-keyout", folder / "key", "-out", folder / "cert"], check=True, capture_output=True
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs the program openssl")
    return folder / "cert", folder / "key"


@pytest.fixture
def trusted(certificate, monkeypatch):
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    _context.cache_clear()
    yield certificate
    _context.cache_clear()


def encrypted(certificate, then):
    """Serve `then` behind a handshake."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)

    def serve(connection: socket.socket) -> None:
        with context.wrap_socket(connection, server_side=True) as inside:
            inside.settimeout(10)
            read_request(inside)
            then(inside)

    return serve


class Direct:
    """A listening socket whose connections go to `serve` unread."""

    def __init__(self, serve) -> None:
        self._listening, self._serve = socket.create_server(("127.0.0.1", 0)), serve
        self.port = self._listening.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            threading.Thread(target=self._one, args=(connection,), daemon=True).start()

    def _one(self, connection) -> None:
        try:
            self._serve(connection)
        except OSError:
            pass
        finally:
            connection.close()

    def close(self) -> None:
        self._listening.close()


def test_an_encrypted_connection(trusted):
    server = Direct(encrypted(trusted, lambda inside: inside.sendall(whole(GOOD))))
    assert Endpoint(config_for(f"https://127.0.0.1:{server.port}/v1", timeout_s=5.0)).ask(QUESTION).text == "keep"
    server.close()


def test_an_encrypted_connection_that_drips(trusted):
    server = Direct(encrypted(trusted, drip(HEAD + b"Content-Length: 100000\r\n\r\n", b" ")))
    start = time.monotonic()
    with pytest.raises(ChatError, match="no whole answer"):
        Endpoint(config_for(f"https://127.0.0.1:{server.port}/v1")).ask(QUESTION)
    assert time.monotonic() - start < 3
    server.close()


def test_a_handshake_that_never_ends(trusted):
    server = Direct(lambda connection: time.sleep(5))
    start = time.monotonic()
    with pytest.raises(ChatError, match="no whole answer"):
        Endpoint(config_for(f"https://127.0.0.1:{server.port}/v1")).ask(QUESTION)
    assert time.monotonic() - start < 3
    server.close()


def test_a_certificate_that_nobody_signed_is_refused_without_a_retry(certificate):
    met: list[int] = []

    def serve(connection) -> None:
        met.append(1)
        encrypted(certificate, lambda inside: inside.sendall(whole(GOOD)))(connection)

    server = Direct(serve)
    with pytest.raises(ChatError, match="its certificate is refused") as caught:
        Endpoint(config_for(f"https://127.0.0.1:{server.port}/v1", timeout_s=5.0, max_retries=3), 0.01).ask(QUESTION)
    assert caught.value.retries == 0
    assert len(met) == 1
    server.close()


def test_https_to_a_server_that_speaks_http_says_so():
    server = Direct(lambda connection: connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n"))
    with pytest.raises(ChatError, match="does it speak http:// only"):
        Endpoint(config_for(f"https://127.0.0.1:{server.port}/v1", timeout_s=5.0)).ask(QUESTION)
    server.close()


def test_a_tunnel_through_a_proxy(trusted, monkeypatch):
    asked: list[bytes] = []
    inner = encrypted(trusted, lambda inside: inside.sendall(whole(GOOD)))

    def serve(connection) -> None:
        asked.append(connection.recv(4096))
        connection.sendall(b"HTTP/1.1 200 Connection established\r\n\r\n")
        inner(connection)

    proxy = Direct(serve)
    monkeypatch.setenv("HTTPS_PROXY", f"http://127.0.0.1:{proxy.port}")
    monkeypatch.setattr("rapid.teacher.address.is_loopback", lambda host: False)
    assert Endpoint(config_for("https://localhost:8443/v1", timeout_s=5.0)).ask(QUESTION).text == "keep"
    assert asked[0].startswith(b"CONNECT localhost:8443 HTTP/1.1\r\nHost: localhost:8443\r\n")
    proxy.close()
    refusing = Direct(lambda connection: connection.sendall(b"HTTP/1.1 403 No\r\n\r\n"))
    monkeypatch.setenv("HTTPS_PROXY", f"http://127.0.0.1:{refusing.port}")
    with pytest.raises(ChatError, match=r"the proxy opens no way: HTTP 403 No \(through the proxy of HTTPS_PROXY\)"):
        Endpoint(config_for("https://localhost:8443/v1", timeout_s=5.0)).ask(QUESTION)
    refusing.close()


def test_connections_are_closed():
    before = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    with serving(lambda connection: connection.sendall(whole(GOOD))) as server:
        endpoint = Endpoint(config_for(server.url))
        for _ in range(30):
            endpoint.ask(QUESTION)
        time.sleep(0.2)
        if before:
            assert len(os.listdir("/proc/self/fd")) < before + 10


def test_an_exchange_tells_apart_what_lasts():
    with serving(lambda connection: connection.sendall(whole(b" " * (1 << 21)))) as server:
        with pytest.raises(WireError) as caught:
            exchanged(server.url, Patience())
        assert caught.value.lasting
    with pytest.raises(WireError, match="connection refused") as caught:
        exchanged("http://127.0.0.1:9/v1", Patience())
    assert not caught.value.lasting
