"""Any JSON in any place of an answer: what comes of it can be printed, kept and read back."""

import json
import math

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from fake_server import completion
from rapid.config import TeacherConfig
from rapid.data.journal import Journal
from rapid.teacher import from_record, to_record
from rapid.teacher.chat import ChatError
from rapid.teacher.completion import FormError, decode, find_refusal, read_names, read_refusal, read_reply
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.patience import Patience
from rapid.text import printable

ANY_TEXT = st.text(st.characters(exclude_categories=()), max_size=12) | st.sampled_from(
    ["keep", "\ud800", "\x1b[2J", "\u202e", "NaN", "\x00", "</s>", '{"action": "keep"}', "sk-planted-0123456789"]
)
NUMBERS = (
    st.integers()
    | st.floats()
    | st.sampled_from([2**63, -(2**63) - 1, 10**400, math.inf, -math.inf, math.nan, 1e308, True, False])
)
LEAVES = st.none() | NUMBERS | ANY_TEXT
ANYTHING = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(ANY_TEXT, inner, max_size=3), max_leaves=6
)
CALL = {"id": "c", "type": "function", "function": {"name": "cars_on_lane", "arguments": '{"lane": 1}'}}
TOKEN = {"token": "keep", "logprob": -0.1, "top_logprobs": [{"token": "keep", "logprob": -0.1}]}


def whole() -> dict:
    return completion("keep", {"content": [TOKEN]}, tool_calls=[CALL], reasoning_content="why", refusal=None)


def places(value, path=()):
    """Give the path of every place in a JSON value."""
    yield path
    if isinstance(value, dict):
        for name in value:
            yield from places(value[name], (*path, name))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from places(item, (*path, index))


PLACES = [*places(whole()), ("error",), ("choices", 0, "error"), ("usage", "extra")]


def put(value, path, new):
    if not path:
        return new
    if isinstance(value, list):
        return [put(item, path[1:], new) if index == path[0] else item for index, item in enumerate(value)]
    return {**value, path[0]: put(value.get(path[0]), path[1:], new) if len(path) > 1 else new}


def clean(text: str) -> str:
    return text.replace("sk-planted-0123456789", "[key]")


class Fuzzed:
    """A chat that answers with what was made of any JSON; it calls a tool at most once in a conversation."""

    native_tools = True

    def __init__(self, body: bytes) -> None:
        self.body, self.patience = body, Patience()

    def ask(self, request):
        offered = bool(request.tools) and all(message["role"] != "tool" for message in request.messages)
        try:
            answered = decode(self.body, "", clean)
            refusal = find_refusal(answered, {}, clean)
            if refusal is not None:
                raise ChatError(refusal.said)
            return read_reply(answered, 100, 400, offered, clean)
        except FormError as error:
            raise ChatError(str(error)) from None


@pytest.mark.parametrize("style", ["digest", "react"])
@hypothesis_settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
@given(path=st.sampled_from(PLACES), value=ANYTHING)
def test_any_value_in_any_place_makes_a_decision_that_can_be_read_back(world, tmp_path_factory, style, path, value):
    body = json.dumps(put(whole(), path, value)).encode()
    config = TeacherConfig(backend="endpoint", model="m", style=style, max_turns=2, price_in=1.0, price_out=1.0)
    obs_BVF = world()
    [decision] = ConversingTeacher(Fuzzed(body), config, {}, 3).decide(obs_BVF, [None])
    record = json.dumps(to_record(decision), allow_nan=False)
    assert from_record(json.loads(record)) == decision
    assert "sk-planted" not in record
    for text in (decision.answer, decision.error, decision.explanation):
        assert text == printable(text)
    assert 0 <= decision.tokens_in < 2**31
    assert 0 <= decision.tokens_out < 2**31
    assert math.isfinite(decision.cost)
    if decision.probabilities is not None:
        assert math.isclose(sum(decision.probabilities), 1.0, rel_tol=1e-6)
    path = tmp_path_factory.mktemp("fuzz") / "journal.jsonl"
    journal = Journal(path, 0)
    journal.begin(0, [1])
    journal.append(obs_BVF, [decision])
    journal.close()
    again = Journal(path, 0)
    assert again.recall(obs_BVF) == [decision]
    again.close()


@hypothesis_settings(max_examples=150, deadline=None)
@given(body=st.binary(max_size=40) | ANYTHING.map(lambda value: json.dumps(value).encode()), after=ANY_TEXT)
def test_any_bytes_make_a_sentence_at_worst(body, after):
    refusal = read_refusal(500, {"retry-after": after}, body, clean)
    assert refusal.said == printable(refusal.said)
    assert len(refusal.said) <= 300
    assert refusal.after is None or (math.isfinite(refusal.after) and refusal.after >= 0)
    try:
        said = read_names(decode(body, "application/json", clean), clean)
    except FormError as error:
        said = (str(error),)
    assert all(text == printable(text) for text in said)


@pytest.mark.parametrize("path", PLACES, ids=str)
@pytest.mark.parametrize(
    "value",
    [None, True, 7, -(2**70), math.nan, math.inf, "", "\ud800\x1b", [], [[]], {}, {"a": {}}, [None], "x" * 100_000],
    ids=lambda value: repr(value)[:12],
)
def test_hostile_values(world, path, value):
    body = json.dumps(put(whole(), path, value)).encode()
    for style in ("digest", "react"):
        config = TeacherConfig(backend="endpoint", model="m", style=style, max_turns=2)
        [decision] = ConversingTeacher(Fuzzed(body), config, {}, 3).decide(world(), [None])
        json.dumps(to_record(decision), allow_nan=False, ensure_ascii=False).encode()
