"""What is secret is cut out of whatever comes from outside, and is refused where it would be written down."""

import base64
import html
import json
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from rapid.config import Config, TeacherConfig
from rapid.config_io import apply_overrides, validate
from rapid.errors import RapidError
from rapid.teacher.address import check_names, open_access
from rapid.teacher.secrets import Secrets

KEYS = ["sk-planted-0123456789abcdef", 'sk/planted+"quoted"\\0123', "0123456789abcdef0123456789abcdef"]

SPELLINGS = {
    "plain": lambda key: key,
    "JSON": json.dumps,
    "JSON in JSON": lambda key: json.dumps(json.dumps(key)),
    "Python": repr,
    "HTML": html.escape,
    "percent": lambda key: quote(key, safe=""),
    "percent throughout": lambda key: "".join(f"%{byte:02X}" for byte in key.encode()),
    "hexadecimal": lambda key: key.encode().hex(),
    "HEXADECIMAL": lambda key: key.encode().hex().upper(),
    "hexadecimal with colons": lambda key: key.encode().hex(":"),
    "base64": lambda key: base64.b64encode(key.encode()).decode(),
    "base64 for addresses": lambda key: base64.urlsafe_b64encode(key.encode()).decode(),
    "base64 with a byte before": lambda key: base64.b64encode(b":" + key.encode()).decode(),
    "base64 with two bytes before": lambda key: base64.b64encode(b"u:" + key.encode() + b"\n").decode(),
    "base64 of the header": lambda key: base64.b64encode(b"Authorization: Bearer " + key.encode() + b"!").decode(),
}


def core(spelled: str) -> str:
    """Return the middle of a spelling, which no part of it may survive in."""
    return spelled[len(spelled) // 4 : len(spelled) * 3 // 4]


@pytest.mark.parametrize("spell", SPELLINGS.values(), ids=SPELLINGS)
@pytest.mark.parametrize("key", KEYS)
def test_a_key_is_found_in_any_spelling(key, spell):
    spelled = spell(key)
    cleaned = Secrets([key]).clean(f"<{spelled}> and <{spelled}>")
    assert cleaned.count("[key]") == 2
    assert core(spelled) not in cleaned


@hypothesis_settings(max_examples=200, deadline=None)
@given(key=st.text(st.characters(codec="utf-8"), min_size=8, max_size=40), before=st.text(max_size=9), after=st.text())
def test_any_key_is_found_in_any_text(key, before, after):
    cleaned = Secrets([key]).clean(before + key + after)
    assert "[key]" in cleaned
    assert Secrets(["other-secret"]).clean(before) == before.replace("other-secret", "[key]")


def test_what_hides_nothing_is_left():
    assert Secrets(["", "x", "EMPTY"]).clean("x EMPTY") == "x EMPTY"


def test_the_longer_of_two_secrets_is_cut_out_whole():
    assert Secrets(["planted-0123", "planted-0123-and-more"]).clean("planted-0123-and-more") == "[key]"


@pytest.mark.parametrize(
    "change",
    [
        {"api_key_env": "sk-proj-planted0123456789"},
        {"api_key_env": "gsk_planted0123456789abcdef"},
        {"api_key_env": "planted0123456789abcdef0123456789"},
        {"headers_env": "api-key: planted0123456789"},
        {"base_url": "https://user:planted0123@host/v1"},
        {"base_url": "https://host/v1?key=planted"},
        {"base_url": "https://host/v1?api_key=planted0123456789abcdef"},
        {"base_url": "https://host/v1?x=planted0123456789abcdef"},
        {"base_url": "https://host/planted0123456789abcdef/v1"},
        {"base_url": "https://host/v1/sk-planted0123/openai"},
        {"base_url": "https://host/%70lanted0123456789abcdef/v1"},
    ],
)
def test_a_secret_among_the_settings_is_refused_and_not_repeated(change):
    with pytest.raises(RapidError) as caught:
        validate(apply_overrides(Config(), {"teacher": change}))
    assert "planted" not in str(caught.value)
    assert "environment variable" in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"api_key_env": ""},
        {"api_key_env": "AZURE_OPENAI_API_KEY_2"},
        {"headers_env": "MY_HEADERS"},
        {"base_url": "https://x.openai.azure.com/openai/deployments/gpt-4o-mini-2024-07-18?api-version=2024-10-21"},
        {"base_url": "http://[::1]:8000/v1"},
        {"base_url": "https://host/v1?key=${MY_KEY}"},
        {"base_url": "https://gateway.host/v1/${ACCOUNT}/openai"},
    ],
)
def test_what_is_no_secret_is_not_refused(change):
    check_names(TeacherConfig(backend="endpoint", **change))


def test_everything_that_opens_a_server_is_secret(monkeypatch):
    monkeypatch.setenv("A_KEY", "planted-key-0123")
    monkeypatch.setenv("A_PART", "planted part/0123")
    monkeypatch.setenv("SOME_HEADERS", "api-key: planted-header-0123\nX-Auth: Token planted-token-0123")
    url = "https://127.0.0.1/${A_PART}?k=${A_PART}"
    config = TeacherConfig(backend="endpoint", base_url=url, api_key_env="A_KEY", headers_env="SOME_HEADERS")
    access = open_access(config)
    assert access.address.target("models") == "/planted%20part%2F0123/models?k=planted%20part%2F0123"
    assert "planted" not in repr(access)
    clean = Secrets(access.secrets).clean
    for secret in ("planted-key-0123", "planted part/0123", "planted-header-0123", "planted-token-0123"):
        assert clean(f"a {secret} b") == "a [key] b"


def test_a_variable_that_is_not_set_is_named(monkeypatch):
    monkeypatch.delenv("NOT_SET_AT_ALL", raising=False)
    with pytest.raises(RapidError, match="names the environment variable NOT_SET_AT_ALL, which is not set"):
        open_access(TeacherConfig(backend="endpoint", base_url="https://127.0.0.1/${NOT_SET_AT_ALL}"))
