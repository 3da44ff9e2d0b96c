"""Which answers count as a decision: those in which a careful reader finds one action, and no others."""

import json

import pytest

from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.teacher.answers import content_of, read_choice, spoken
from rapid.teacher.calls import read_call
from rapid.teacher.chat import Reply
from rapid.teacher.facts import Facts, gather
from rapid.teacher.logprobs import Token, action_probabilities
from rapid.teacher.scene import read_scenes

L, K, R, F, S = LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER

# The answer; what it decides where a word does (digest, and react once the decision was asked for); and what it decides
# in react before that, where only the object that the prompt describes does.
TABLE: list[tuple[str, int | None, int | None]] = [
    # A word, however it is dressed.
    ("keep", K, None),
    (" Keep.\n", K, None),
    ("FASTER", F, None),
    ("faster!", F, None),
    ("[slower]", S, None),
    ("(left)", L, None),
    ("{right}", R, None),
    ("<faster>", F, None),
    ("**keep**", K, None),
    ("`keep`", K, None),
    ("_left_", L, None),
    ("'slower'", S, None),
    ("“right”", R, None),
    ("- faster", F, None),
    ("> keep", K, None),
    ("# Keep", K, None),
    ("• left", L, None),
    ("faster ✅", F, None),
    ("faster…", F, None),
    ("```\nkeep\n```", K, None),
    ("```text\nslower\n```", S, None),
    ("\\boxed{faster}", F, None),
    ("$\\boxed{\\text{keep}}$", K, None),
    ("<answer>left</answer>", L, None),
    ("<action> Faster </action>", F, None),
    ("idle", K, None),
    ("LANE_LEFT", L, None),
    ("lane_right", R, None),
    ("lane left", L, None),
    ("Lane-Right", R, None),
    ("faster\n\n\n", F, None),
    ("keep\nkeep", K, None),
    # Marks of a chat template.
    ("slower</s>", S, None),
    ("<s> slower</s>", S, None),
    ("keep<|im_end|>", K, None),
    ("keep<|eot_id|>", K, None),
    ("keep<|end|>\n<|user|>\nfaster", K, None),
    ("faster<end_of_turn>", F, None),
    ("left<|endoftext|>Human: slower", L, None),
    ("<|im_start|>assistant\nright<|im_end|>", R, None),
    ("<|start_header_id|>assistant<|end_header_id|>\n\nkeep", K, None),
    ("[/INST] keep", K, None),
    ("keep[INST] faster [/INST]", K, None),
    ("keep<｜end▁of▁sentence｜>", K, None),
    ("<|im_end|>", None, None),
    ("</s>faster", None, None),
    ('{"explanation": "free", "action": "faster"}</s>', F, F),
    # A label before it.
    ("Action: faster", F, None),
    ("action: Faster.", F, None),
    ("**Action:** keep", K, None),
    ("**Action**: keep", K, None),
    ("Action = slower", S, None),
    ("Action -> left", L, None),
    ("Action: 3", F, None),
    ("Action: 0", L, None),
    ("Action ID: 4", S, None),
    ("action_id: 1", K, None),
    ("Action: [right]", R, None),
    ("Decision: slower", S, None),
    ("Final decision: slower", S, None),
    ("Final Answer: keep", K, None),
    ("My choice is left.", L, None),
    ("The action is: right", R, None),
    ("The best action is keep.", K, None),
    ("### Final Answer\nfaster", F, None),
    ("Decision:\nfaster", F, None),
    ("I choose faster.", F, None),
    ("I'll go with keep.", K, None),
    ("I will choose to go slower.", S, None),
    ("Therefore, my final answer is right.", R, None),
    ("So I choose left.", L, None),
    # With a reason.
    ("Let me see.\n\nkeep", K, None),
    ("The road ahead is free.\nfaster", F, None),
    ("There is no car ahead.\nfaster", F, None),
    ("Faster is unsafe.\nkeep", K, None),
    ("Faster is tight and left is unsafe.\nDecision: keep", K, None),
    ("Options:\n- faster\n- keep\nFinal decision: keep", K, None),
    ("faster: the road is free", F, None),
    ("keep - there is enough room", K, None),
    ("Faster. No car is ahead.", F, None),
    ("Slower, to avoid a collision.", S, None),
    ("keep because the left lane is full", K, None),
    ("Action: faster because the road is free", F, None),
    ("Action: slower (the lead car is slower)", S, None),
    ("Decision: keep\nReason: the gap is large.", K, None),
    ("keep\n\nThe gap is large.", K, None),
    # Thinking.
    ("<think>faster?</think>keep", K, None),
    ("<think>\nfaster\n</think>\n\nkeep", K, None),
    ("<thinking>left or right</thinking>\nslower", S, None),
    ("faster would be nice</think>\nkeep", K, None),
    ("[THINK]faster[/THINK]slower", S, None),
    ("◁think▷left◁/think▷right", R, None),
    ("<reasoning>no</reasoning>Action: left", L, None),
    ("<think></think>faster", F, None),
    ("<think>a</think><think>left</think>keep", K, None),
    ('<think>{"action": "faster"}</think>{"explanation": "calm", "action": "keep"}', K, K),
    ("<|channel|>analysis<|message|>left?<|end|><|start|>assistant<|channel|>final<|message|>keep<|return|>", K, None),
    ("<think>The road is free.\nfaster", None, None),
    ("<think>faster", None, None),
    ("<THINK>\nkeep", None, None),
    ("<think>a<think>b</think>keep", None, None),
    ("<think>keep</think>", None, None),
    ("keep<think>or rather faster", None, None),
    ('<think>{"explanation": "free", "action": "faster"}', None, None),
    ("<|channel|>analysis<|message|>I take faster", None, None),
    ("[THINK]\nslower", None, None),
    # Objects.
    ('{"action": "keep"}', K, None),
    ('{"explanation": "calm", "action": "keep"}', K, K),
    ('{"explanation": "", "action": "keep"}', K, K),
    ('{"action": "keep", "explanation": "calm"}', K, K),
    ('```json\n{"explanation": "calm", "action": "keep"}\n```', K, K),
    ('Thought: I hold on.\n{"explanation": "calm", "action": "keep"}', K, K),
    ('{"explanation": "calm", "action": " Keep. "}', K, K),
    ('{"explanation": "calm", "action": "LANE_LEFT"}', L, L),
    ('{"explanation": "calm", "action": 3}', F, F),
    ('{"explanation": "calm", "action": "3"}', F, F),
    ('{"explanation": "calm", "Action": "faster"}', F, F),
    ('{"explanation": "calm", "decision": "faster"}', F, F),
    ('[{"explanation": "calm", "action": "keep"}]', K, K),
    ('{"explanation": "c", "action": "keep"} {"explanation": "c", "action": "keep"}', K, K),
    ('As forecast_action said: {"explanation": "forecast_action says safe", "action": "faster"}', F, F),
    ('{"explanation": "faster is tight", "action": "keep"}\nI hope that helps.', K, K),
    ('{"explanation": "c", "action": "keep"} {"explanation": "d", "action": "faster"}', None, None),
    ('{"action": "keep", "action": "faster"}', None, None),
    ('{"explanation": "c", "action": "keep"}\nWait, faster is better.', None, None),
    ('{"explanation": "c", "action": "keep"}\nfaster', None, None),
    ('Final decision: left\n{"explanation": "c", "action": "keep"}', None, None),
    ('{"action": "keep or slower"}', None, None),
    ('{"action": "not faster"}', None, None),
    ('{"action": ["keep", "faster"]}', None, None),
    ('{"action": {"name": "keep"}}', None, None),
    ('{"action": "ACTION"}', None, None),
    ('{"action": ""}', None, None),
    ('{"action": null}', None, None),
    ('{"action": true}', None, None),
    ('{"action": 3.0}', None, None),
    ('{"action": 5}', None, None),
    ('{"action": -1}', None, None),
    ('{"action": "brake"}', None, None),
    ('{"explanation": "the action is keep"}', None, None),
    ('{"action": "keep"', None, None),
    ('{"explanation": "x",\n"action": "keep"', None, None),
    ("{}", None, None),
    ("[1]", None, None),
    # Calls: what stands in them is no decision.
    ('forecast_action {"action": "faster"}', None, None),
    ('CALL forecast_action {"action": "faster"}', None, None),
    ('CALL predict {"action": "faster"}', None, None),
    ('Action: forecast_action\nAction Input: {"action": "faster"}', None, None),
    ('Action: simulate\nAction Input: {"action": "faster"}', None, None),
    ('{"name": "forecast_action", "arguments": {"action": "faster"}}', None, None),
    ('{"arguments": {"action": "faster"}, "name": "forecast_action"}', None, None),
    ('{"name": "forecast_action", "arguments": "{\\"action\\": \\"faster\\"}"}', None, None),
    ('{"action": "forecast_action", "action_input": {"action": "faster"}}', None, None),
    ('{"tool": "forecast_action", "action": "faster"}', None, None),
    ('{"forecast_action": {"action": "faster"}}', None, None),
    ('{"function": {"name": "check_action", "arguments": {"action": "left"}}}', None, None),
    ('{"tool_calls": [{"name": "check_action", "arguments": {"action": "left"}}]}', None, None),
    ('<tool_call>\n{"name": "look", "arguments": {}, "action": "faster"}\n</tool_call>', None, None),
    ('<function=look>{"action": "faster"}</function>', None, None),
    ('[TOOL_CALLS] [{"action": "faster"}]', None, None),
    ('forecast_action(action="faster")', None, None),
    ('[forecast_action(action="faster")]', None, None),
    ('<|python_tag|>{"action": "faster"}', None, None),
    ('forecast_action with {"action": "faster"}', None, None),
    # None, or more than one, or doubtful.
    ("", None, None),
    ("  \n ", None, None),
    ("no idea", None, None),
    ("I cannot help with driving.", None, None),
    ("3", None, None),
    ("lane 2", None, None),
    ("brake", None, None),
    ("not\nfaster", None, None),
    ("I would not go\nfaster", None, None),
    ("I must not do this.\nfaster", None, None),
    ("Unsafe:\nfaster", None, None),
    ("Never choose:\n\nfaster", None, None),
    ("not faster", None, None),
    ("!faster", None, None),
    ("~~faster~~", None, None),
    ("❌ faster", None, None),
    ("faster?", None, None),
    ("Should I go faster?", None, None),
    ("faster or slower", None, None),
    ("keep/slower", None, None),
    ("faster, slower", None, None),
    ("faster\nslower", None, None),
    ("faster then right", None, None),
    ("faster, then right", None, None),
    ("left and faster", None, None),
    ("- faster\n- keep", None, None),
    ("faster\nwould be unsafe", None, None),
    ("Faster. That would be unsafe.", None, None),
    ("Faster: a crash after 2 s.", None, None),
    ("keep, or faster if the lane is free", None, None),
    ("faster if the road is free", None, None),
    ("Action: faster or slower", None, None),
    ("Action: not faster", None, None),
    ("Action: faster\nAction: keep", None, None),
    ("Action: faster\nFinal decision: keep", None, None),
    ("Action: 5", None, None),
    ("Action: 3 m/s", None, None),
    ("Action: 30", None, None),
    ("Action: left lane change is unsafe", None, None),
    ("If the gap closes, I choose slower.", None, None),
    ("I do not choose faster.", None, None),
    ("I choose faster. Wait, slower is better.", None, None),
    ("I choose faster.\nkeep", None, None),
    ("The car is going faster", None, None),
    ("The lead car is slower than me", None, None),
    ("I would keep the lane", None, None),
    ("fasterslower", None, None),
    ("keeping", None, None),
    ("rightmost", None, None),
    ("Safe: right. Tight: keep. Unsafe: faster.", None, None),
    ("left, keep, right, faster, slower", None, None),
    ("One of: left, keep, right", None, None),
    ("Which action?\nfaster", None, None),
]


@pytest.fixture
def facts(world) -> Facts:
    facts = gather(read_scenes(world(cars=((30, 1, 20), (-20, 2, 25))), 3)[0])
    assert facts.available == (L, K, R, F, S)
    return facts


def test_the_table_is_long_and_has_no_answer_twice():
    assert len(TABLE) >= 200
    assert len({text for text, _, _ in TABLE}) == len(TABLE)


@pytest.mark.parametrize(("text", "word", "described"), TABLE)
def test_an_answer_counts_only_if_a_careful_reader_finds_one_decision(facts, text, word, described):
    choice = read_choice(text, facts)
    assert choice.action == word, choice.fault
    assert (choice.action is None) == bool(choice.fault)
    assert read_choice(text, facts, words=False).action == described


@pytest.mark.parametrize(("text", "word", "described"), [row for row in TABLE if row[1] is not None])
def test_what_is_not_possible_is_never_decided(facts, text, word, described):
    without = Facts(facts.scene, tuple(action for action in facts.available if action != word))
    for words in (True, False):
        assert read_choice(text, without, words=words).action is None
    assert "not possible" in read_choice(text, without).fault


@pytest.mark.parametrize(("text", "word", "described"), TABLE)
def test_of_an_answer_that_was_cut_off_only_a_whole_object_counts(facts, text, word, described):
    cut = read_choice(text, facts, cut=True).action
    assert cut is None or (cut == word and "{" in text and text.count("{") == text.count("}"))


CALL = ("forecast_action", {"action": "faster"})


@pytest.mark.parametrize(
    "text",
    [text for text, word, _ in TABLE if word is None and "forecast_action" in text],
)
def test_a_call_is_understood_however_it_is_spelled(text):
    call = read_call(text)
    assert call is not None
    assert (call[0], json.loads(call[1])) == CALL


@pytest.mark.parametrize(
    ("text", "explanation"),
    [
        ("keep", ""),
        ("faster: the road is free", "the road is free"),
        ("Decision: keep\nReason: the gap is large.", "Reason: the gap is large."),
        ('{"explanation": "calm\\nroad", "action": "keep"}', "calm road"),
        ('{"explanation": "at most ten words", "action": "keep"}', ""),
        ('{"explanation": "One sentence.", "action": "keep"}', ""),
        ('{"explanation": 7, "action": "keep"}', ""),
    ],
)
def test_the_reason_is_the_models_own(facts, text, explanation):
    assert read_choice(text, facts).explanation == explanation


@pytest.mark.parametrize(
    ("content", "said", "thought"),
    [
        ("faster", "faster", ""),
        (None, "", ""),
        (7, "", ""),
        ([], "", ""),
        ([{"type": "text", "text": "keep"}], "keep", ""),
        ({"type": "text", "text": "keep"}, "keep", ""),
        (["ke", "ep"], "keep", ""),
        ([{"text": "keep"}], "keep", ""),
        ([{"type": "output_text", "text": {"value": "keep"}}], "keep", ""),
        ([{"type": "thinking", "thinking": "faster"}, {"type": "text", "text": "keep"}], "keep", "faster"),
        ([{"type": "thinking", "thinking": [{"type": "text", "text": "faster"}]}], "", "faster"),
        ([{"type": "reasoning", "text": "faster"}, {"type": "text", "text": "keep"}], "keep", "faster"),
        ([{"type": "image_url", "image_url": "faster"}], "", ""),
        ([{"type": "tool_use", "input": {"action": "faster"}}], "", ""),
        ([{"type": "text", "text": None}, {"type": "text"}, {"type": 3}, None, 1.5], "", ""),
    ],
)
def test_typed_chunks(content, said, thought):
    assert content_of(content) == (said, thought)


def test_thinking_and_template_marks_are_taken_off():
    assert spoken("a</think> b<|im_end|> c") == ("b", True)
    assert spoken("<think>a") == ("", False)
    assert spoken("") == ("", True)


def _tokens(*parts: str, **shares: float) -> tuple[Token, ...]:
    return tuple(Token(part, ((part, -0.1), ("slower", -3.0))) for part in parts)


def test_a_soft_label_is_taken_only_where_the_decision_fell():
    available = (L, K, R, F, S)
    assert action_probabilities(_tokens("keep"), K, available) is not None
    assert action_probabilities(_tokens("<think>", "keep", "</think>", "keep"), K, available) is not None
    # Which of the two was the decision?
    assert action_probabilities(_tokens("keep", ": the others ", "keep", " too"), K, available) is None


def test_a_reply_keeps_thinking_apart():
    assert Reply("keep", reasoning="faster").text == "keep"
