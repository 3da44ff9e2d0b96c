"""The conversation shown as the paper shows one: the prefix prompt and an interaction, as they really were."""

import hashlib

import pytest

from rapid.data.dataset import load_dataset
from rapid.errors import RapidError
from rapid.teacher.decision import Decision, Turn, answer_in_words, turns_of
from rapid.teacher.exhibit import SHOWN, prompt_exhibit
from rapid.teacher.tools import TOOL_NAMES


def test_the_prompt_is_the_one_that_the_model_was_given():
    shown = prompt_exhibit()
    rows = load_dataset(SHOWN).log.to_pylist()
    row = next(row for row in rows if (row["spawn_seed"], row["step"]) == (shown.spawn_seed, shown.step))
    assert hashlib.sha256(f"{shown.prefix}\0{shown.scene}".encode()).hexdigest() == row["prompt_hash"]
    # What the paper says that it holds: task, common-sense rules, form of the answer, scene, the previous decision.
    for part in ("You are a careful, experienced driver", "Rules: ", "Give your decision as JSON", *TOOL_NAMES):
        assert part in shown.prefix
    for part in ("You are in lane", "Your previous decision: ", "Possible actions: "):
        assert part in shown.scene


def test_the_interaction_goes_from_thoughts_and_tools_to_a_decision_with_a_reason():
    shown = prompt_exhibit()
    roles = [turn.role for turn in shown.turns]
    assert (roles[0], roles[-1], "tool" in roles) == ("model", "model", True)
    assert len(roles) >= 5
    assert shown.reason in shown.turns[-1].text
    assert len(shown.reason.split()) > 5
    text = shown.markdown()
    for part in ("**Prefix prompt**", "**Interaction**", "The model:", "A tool:", f"**Decision**: {shown.action}"):
        assert part in text
    for turn in shown.turns:
        assert all(f"    {line}" in text for line in turn.text.splitlines())


def test_any_decision_can_be_shown():
    assert (prompt_exhibit(spawn_seed=0, step=0).spawn_seed, prompt_exhibit(spawn_seed=0, step=0).step) == (0, 0)
    with pytest.raises(RapidError, match="no such conversation"):
        prompt_exhibit(spawn_seed=0, step=29)
    with pytest.raises(RapidError, match="no such conversation"):
        prompt_exhibit("shipped:lane-3-density-2/rule")
    with pytest.raises(RapidError, match="not those of this version"):
        prompt_exhibit("shipped:lane-3-density-2/teacher", spawn_seed=0, step=0)


def test_turns_in_words():
    talk = (
        '[{"role": "assistant", "content": null, "tool_calls": [{"function": {"name": "f", "arguments": "{}"}}]},'
        ' {"role": "tool", "content": "free"}, {"role": "user", "content": "Possible actions: keep."},'
        ' {"role": "assistant", "content": "keep"}]'
    )
    expected = (Turn("model", "f {}"), Turn("tool", "free"), Turn("driver", "Possible actions: keep."))
    assert turns_of(talk) == (*expected, Turn("model", "keep"))
    said = answer_in_words(Decision(1, answer="keep", turns=talk))
    assert said == "model: f {}\ntool: free\ndriver: Possible actions: keep.\nmodel: keep"
    assert answer_in_words(Decision(1, answer="keep", turns=talk[talk.rindex("{") - 1 :])) == "keep"
    assert [turns_of(text) for text in ("", "{", "7", "[7]")] == [()] * 4
