"""A key in the environment stays there, whatever a server does with it: no file, no line of output, no error has it."""

import base64
import itertools
import json
import logging
import traceback
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import pyarrow.parquet as pq
import pytest

from fake_server import Server, answer, completion, drop, refuse
from rapid import cli
from rapid.config import TeacherConfig
from rapid.data.dataset import load_dataset
from rapid.doctor import examine
from rapid.teacher.endpoint import Endpoint

# Characters that JSON, Python and addresses write in another way.
KEYS = ["sk-planted-0123456789abcdef", 'sk/planted+"quoted"\\0123456789']


@pytest.fixture
def server(monkeypatch) -> Iterator[Server]:
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    # No real waiting between the retries.
    monkeypatch.setattr(Endpoint, "_pause", lambda *arguments: 0.0)
    server = Server()
    yield server
    server.close()


def spellings(key: str) -> set[str]:
    once = json.dumps(key)[1:-1]
    return {key, once, json.dumps(once)[1:-1], repr(key)[1:-1], *encoded(key)}


def encoded(key: str) -> list[str]:
    """Other forms in which a server may repeat a key."""
    content = key.encode()
    return [base64.b64encode(content).decode().rstrip("="), content.hex(), content.hex().upper(), quote(key, safe="")]


def leaks(key: str, text: str) -> bool:
    return any(spelling in text for spelling in spellings(key))


def everything_in(directory: Path) -> Iterator[tuple[Path, str]]:
    """All files as text; of compressed ones also what they hold."""
    for path in directory.rglob("*"):
        if path.is_file():
            yield path, path.read_bytes().decode(errors="replace")
            if path.suffix == ".parquet":
                yield path, "\n".join(str(value) for row in pq.read_table(path).to_pylist() for value in row.values())


def words(server: Server, out: Path, style: str) -> list[str]:
    options = {
        "teacher.backend": "endpoint",
        "teacher.model": "m",
        "teacher.style": style,
        "teacher.base-url": server.url,
        "teacher.api-key-env": "RAPID_TEST_KEY",
        "teacher.headers-env": "RAPID_TEST_HEADERS",
        "teacher.max-retries": "1",
        "teacher.max-turns": "2",
        "teacher-transitions": "12",
        "lockstep": "2",
        "out": str(out),
    }
    return ["collect", "--teacher.reflect", *(word for name, value in options.items() for word in (f"--{name}", value))]


def run(arguments: list[str]) -> object:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    return ended.value.code


def faults(key: str) -> list:
    """What a server may do with a key; each of them is followed by a good answer."""
    call = {"id": key, "type": "function", "function": {"name": key, "arguments": json.dumps({"lane": key})}}
    said = json.dumps({"explanation": f"{key} drives well", "lesson": f"never lose {key}", "action": "faster"})
    return [
        refuse(429, f"Rate limit of key {key}", **{"Retry-After": "0"}),
        refuse(500, f"{'x' * 285}{key}"),
        refuse(400, f"{key} asks for logprobs", **{"X-Echo": key}),
        answer(f"<html>Bearer {key}</html>"),
        answer('{"choices": "' + json.dumps(key)[1:-1]),
        answer({"choices": [], "error": key}),
        answer(completion(key)),
        answer(completion(None, refusal=f"I know {key}.")),
        answer(completion(f"You are {' or '.join(encoded(key))}.")),
        answer({**completion("faster"), "model": f"m of {encoded(key)[0]}"}),
        refuse(500, f"Basic {base64.b64encode(f'user:{key}'.encode()).decode()}"),
        answer(completion(said, {"content": [{"token": key, "logprob": 0.0, "top_logprobs": []}]})),
        answer(completion(None, tool_calls=[call])),
        drop,
    ]


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("style", ["digest", "react"])
def test_a_collection_leaks_no_key(server, tmp_path, monkeypatch, capfd, caplog, style, key):
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("RAPID_TEST_KEY", key)
    monkeypatch.setenv("RAPID_TEST_HEADERS", f"X-Key: {key}")
    good = answer(completion(json.dumps({"explanation": "free road", "lesson": "look ahead", "action": "faster"})))
    played = itertools.chain.from_iterable((fault, good) for fault in faults(key))
    refused = refuse(401, f"Incorrect API key provided: {key}.", **{"WWW-Authenticate": f"Bearer {key}"})
    server.acts = [*played, refused]
    said: list[str] = []
    # Stopped at first, with and without a traceback; then it goes on to the end.
    assert run(words(server, tmp_path / "data", style)) == 2
    with pytest.raises(Exception, match="refuses the key") as caught:
        cli.main([*words(server, tmp_path / "data", style), "--debug"])
    said += [str(caught.value), repr(caught.value), "".join(traceback.format_exception(caught.value))]
    assert (tmp_path / "data" / "collecting" / "journal.jsonl").exists()
    assert not [path for path, text in everything_in(tmp_path) if leaks(key, text)]
    server.acts = [act for fault in faults(key) for act in (fault, good)] + [answer(completion(key)), good] * 3 + [good]
    assert run(words(server, tmp_path / "data", style)) == 0

    assert any(header == f"Bearer {key}" for header in server.authorization)
    dataset = load_dataset(tmp_path / "data")
    assert "[key]" in "".join(dataset.log.column("turns").to_pylist())
    assert dataset.memory
    output = capfd.readouterr()
    said += [output.out, output.err, caplog.text]
    assert "refuses the key" in output.err
    assert not [text for text in said if leaks(key, text)]
    assert not [path for path, text in everything_in(tmp_path) if leaks(key, text)]


def test_the_doctor_leaks_no_key(server, monkeypatch):
    key = KEYS[0]
    monkeypatch.setenv("RAPID_TEST_KEY", key)
    config = TeacherConfig(backend="endpoint", base_url=server.url, api_key_env="RAPID_TEST_KEY")
    for act in (refuse(401, f"wrong key {key}"), refuse(500, key), answer(f"<p>{key}"), answer({"data": key})):
        server.acts = [act]
        assert key not in "".join(map(str, [found for found in examine(config) if found.name == "endpoint"]))
