"""The decision loop against scripted answers: tools, repair, fallback, accounts."""
# pyright: basic

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher.chat import ChatError, Conversation, Reply, Request, ToolCall, converse
from rapid.teacher.conversation import ConversingTeacher
from rapid.teacher.decision import Decision, UnreachableError, to_record
from rapid.teacher.facts import gather, safest
from rapid.teacher.prompt import WORDS, outcome
from rapid.teacher.replay import Replay
from rapid.teacher.scene import read_scenes

KEEP = '{"explanation": "calm road", "action": "keep"}'


class Script:
    """A chat that says the lines it is given, then the last one for ever."""

    def __init__(self, *lines: Reply | Exception, native_tools: bool = True) -> None:
        self.lines, self.native_tools = list(lines), native_tools
        self.heard: list[list[dict]] = []

    def ask(self, request: Request) -> Reply:
        self.heard.append(list(request.messages))
        line = self.lines.pop(0) if len(self.lines) > 1 else self.lines[0]
        if isinstance(line, Exception):
            raise line
        return line


def teacher(script, style: Any = "digest", **settings):
    config = TeacherConfig(backend="endpoint", model="m", style=style, concurrency=1, **settings)
    return ConversingTeacher(script, config, {"model": "m"}, 3)


def decide(script, world, style="digest", **settings):
    return teacher(script, style, **settings).decide(world(cars=((30, 1, 20),)), [None])[0]


def test_a_good_answer_is_taken_with_its_account(world):
    decision = decide(Script(Reply(KEEP, (), 100, 20, 1)), world, price_in=2.0, price_out=10.0)
    assert (decision.action, decision.explanation, decision.status) == (1, "calm road", "ok")
    assert (decision.tokens_in, decision.tokens_out, decision.retries) == (100, 20, 1)
    assert decision.cost == pytest.approx((100 * 2 + 20 * 10) / 1e6)
    assert json.loads(decision.turns) == [{"role": "assistant", "content": KEEP}]


@pytest.mark.parametrize("bad", ["", "no idea", '{"action": "jump"}', '{"action"', "I cannot help with driving."])
def test_a_bad_answer_is_repaired_once(world, bad):
    script = Script(Reply(bad, (), 10, 5), Reply(KEEP, (), 10, 5))
    decision = decide(script, world)
    assert (decision.action, decision.status, decision.tokens_in) == (1, "repaired", 20)
    assert decision.error
    assert "Possible actions" in script.heard[1][-1]["content"]


@pytest.mark.parametrize("bad", ["", "no idea", '{"action": "jump"}'])
def test_two_bad_answers_fall_back_and_are_counted(world, bad):
    script = Script(Reply(bad))
    decision = decide(script, world)
    facts = gather(read_scenes(world(cars=((30, 1, 20),)), 3)[0])
    assert (decision.action, decision.status) == (safest(facts), "fallback")
    assert len(script.heard) == 2


def test_impossible_actions_are_repaired(world):
    script = Script(Reply('{"action": "left"}'), Reply(KEEP))
    decision = teacher(script).decide(world(lane=0), [None])[0]
    assert (decision.action, decision.status) == (1, "repaired")


def test_native_tools_are_called_in_turns(world):
    calls = (ToolCall("1", "available_actions", "{}"), ToolCall("2", "cars_on_lane", '{"lane": 77}'))
    script = Script(Reply("", calls), Reply("Thought.\n" + KEEP))
    decision = decide(script, world, "react")
    results = [message for message in script.heard[1] if message["role"] == "tool"]
    assert [message["tool_call_id"] for message in results] == ["1", "2"]
    assert results[1]["content"].startswith("Error")
    assert decision.status == "ok"


def test_tools_are_called_in_plain_text(world):
    script = Script(Reply('CALL check_action {"action": "keep"}'), Reply(KEEP), native_tools=False)
    assert decide(script, world, "react").status == "ok"
    assert script.heard[1][-1]["content"].startswith("RESULT keep:")


class Choir:
    """A chat that answers together: each world calls as many tools as the lane it is in says, then decides."""

    native_tools = False

    def __init__(self):
        self.asked, self.ended = [], 0

    def ask_together(self, requests: Sequence[Request]) -> list[Reply]:
        self.asked.append(len(requests))
        return [self.reply(request.messages) for request in requests]

    def end(self) -> None:
        self.ended += 1

    def ask(self, request: Request) -> Reply:
        return self.reply(request.messages)

    def reply(self, messages):
        lane = int(messages[1]["content"].split("in lane ")[1][0])
        called = sum(message["content"].startswith("RESULT") for message in messages)
        text = "CALL available_lanes" if called < lane else KEEP.replace("calm road", f"lane {lane}")
        return Reply(text, (), len(messages), 1)


def test_worlds_are_led_in_lockstep_as_each_would_be_alone(crowd):
    choir = Choir()
    together = teacher(choir, "react").decide(crowd, [None] * len(crowd))
    assert choir.asked[:2] == [24, 24]
    assert choir.ended == 1
    assert choir.asked == sorted(choir.asked, reverse=True)
    assert len({decision.explanation for decision in together}) == len(choir.asked) - 1 == 3
    assert len({decision.seconds for decision in together}) == 1
    alone = [teacher(Choir(), "react").decide(crowd[i : i + 1], [None])[0] for i in range(len(crowd))]
    assert [replace(d, seconds=0) for d in together] == [replace(d, seconds=0) for d in alone]


def test_what_came_of_a_conversation_does_not_wait_for_those_after_it():
    def conversation(turns: int) -> Conversation[int]:
        for _ in range(turns):
            yield Request([{"content": "in lane 3"}] * 2, [], None)
        return turns

    choir, turns = Choir(), [1, 2, 1, 3, 0]
    seen = [(result, len(choir.asked), choir.ended) for result in converse([*map(conversation, turns)], choir, 1)]
    assert seen == [(1, 1, 0), (2, 2, 0), (1, 2, 0), (3, 3, 0), (0, 3, 0)]
    assert (choir.asked, choir.ended) == ([4, 2, 1], 1)


def test_endless_tool_calls_end(world):
    script = Script(Reply("", (ToolCall("1", "available_actions", "{}"),)))
    decision = decide(script, world, "react", max_turns=3)
    assert decision.status == "fallback"
    assert len(script.heard) == 3 + 1 + 1


@pytest.mark.parametrize("form", ["{}", "- {}", "**{}**", "I call {}", "CALL {}"])
def test_a_call_on_the_forced_turn_is_no_decision(world, form):
    call = Reply(form.format('forecast_action {"action": "faster"}'))
    script = Script(call, call, Reply(KEEP), native_tools=False)
    decision = decide(script, world, "react", max_turns=1)
    assert (decision.action, decision.status) == (1, "repaired")
    last = [messages[-1]["content"] for messages in script.heard[1:]]
    assert last[0].startswith("No more tool calls.")
    assert last[1].startswith("That was a call, not a decision.")
    assert decide(Script(call, native_tools=False), world, "react", max_turns=1).status == "fallback"


def test_a_server_that_goes_down_falls_back_then_stops(world):
    driver = teacher(Script(Reply(KEEP), ChatError("APIConnectionError: gone.", 4)))
    obs_BVF = world()
    assert driver.decide(obs_BVF, [None])[0].status == "ok"
    for _ in range(4):
        decision = driver.decide(obs_BVF, [None])[0]
        assert (decision.status, decision.retries, decision.unanswered) == ("fallback", 4, True)
        assert "gone" in decision.error
    with pytest.raises(UnreachableError, match=r"5 decisions in a row; the last time: no answer: .* gone\. Is it"):
        driver.decide(obs_BVF, [None])


@pytest.mark.parametrize("style", ["digest", "react"])
def test_the_last_decision_and_its_reason_are_told(world, style):
    script = Script(Reply(KEEP))
    before = Decision(4, explanation="the lead car brakes", status="ok")
    teacher(script, style).decide(world(), [before])
    assert "Your previous decision: slower. the lead car brakes" in script.heard[0][1]["content"]


def test_what_was_told_answered_and_computed_are_three_things(world):
    decision = decide(Script(Reply("keep", (), 100, 1)), world)
    assert (decision.action, decision.status, decision.answer, decision.explanation) == (1, "ok", "keep", "")
    assert f"\nkeep: {decision.computed}" in decision.told
    assert json.loads(decision.turns) == [{"role": "assistant", "content": "keep"}]
    assert decision.probabilities is None


@pytest.mark.parametrize("style", ["digest", "react"])
@pytest.mark.parametrize("answer", ["no idea", "", '{"explanation": "x", "action": "fly"}'])
def test_nothing_internal_enters_a_prompt(world, style, answer):
    before = decide(Script(Reply(answer)), world, style)
    assert before.status == "fallback"
    assert before.computed.startswith("the rule's choice")
    assert (before.explanation, decide(Script(Reply("keep")), world, style).explanation) == ("", "")
    script = Script(Reply("keep"))
    teacher(script, style).decide(world(), [before])
    told = json.dumps(script.heard)
    assert f"The car's last action: {WORDS[before.action]}." in told
    assert "previous decision" not in told
    assert "rule" not in told.replace("Rules", "")
    assert "usable" not in told
    # A word gives no reason, and ours is not put into its mouth.
    script = Script(Reply("keep"))
    teacher(script, style).decide(world(), [Decision(1, answer="keep", computed="safe, 9 m", status="ok")])
    assert "Your previous decision: keep.\n" in script.heard[0][1]["content"]


def test_a_copied_example_is_no_reason(world):
    copied = Reply('{"explanation": "at most ten words", "action": "keep"}')
    assert decide(Script(copied), world, "react").explanation == ""
    script = Script(Reply("hm"), copied)
    assert decide(script, world, "react").status == "repaired"
    assert "{" not in script.heard[1][-1]["content"]


@pytest.mark.parametrize("style", ["digest", "react"])
@pytest.mark.parametrize("native", [True, False])
def test_what_a_prompt_says_is_no_decision_when_it_is_repeated(world, style, native):
    """A small model repeats what it reads: no example, sentence or list of ours may count as its decision."""
    script = Script(Reply("hm"), native_tools=native)
    told = [message["content"] for message in (decide(script, world, style), script.heard[-1])[1]]
    copies = {*told}
    for text in told:
        copies |= {line for line in text.splitlines() if line.strip()}
        copies |= {*re.split(r"(?<=\.)\s+", text), *re.findall(r"\{[^{}]*\}", text)}
    copies -= {"hm"}
    assert len(copies) > 15
    facts = gather(read_scenes(world(cars=((30, 1, 20),)), 3)[0])
    choices = [f"{WORDS[action]}: {outcome(facts, action)}" for action in facts.available]
    for copy in sorted(copies):
        decision = decide(Script(Reply(copy), native_tools=native), world, style, max_turns=1)
        if copy in choices:
            # One of the possibilities, picked: a decision, but the words are ours.
            assert not decision.explanation, copy
        else:
            assert decision.status == "fallback", copy


def test_an_answer_that_was_cut_off_says_what_to_raise(world):
    cut = Reply("I think that", finish_reason="length")
    decision = decide(Script(cut), world, max_answer_tokens=7)
    assert decision.status == "fallback"
    assert "cut off at --teacher.max-answer-tokens 7." in decision.error
    assert "--teacher" not in decision.turns
    # A word that was cut off may have been the beginning of another, or of a sentence; a whole object is whole.
    assert decide(Script(Reply("keep", finish_reason="length")), world).status == "fallback"
    assert decide(Script(Reply(KEEP + " As the", finish_reason="length")), world, "react").status == "ok"


@pytest.mark.parametrize("style", ["digest", "react"])
def test_thinking_without_an_answer_is_no_answer(world, style):
    decision = decide(Script(Reply("", reasoning="keep"), Reply(KEEP)), world, style)
    assert (decision.status, decision.error) == ("repaired", "The answer is thinking only, and holds no decision.")


def test_a_call_that_nobody_offered_is_no_decision(world):
    called = Reply("faster", (ToolCall("1", "forecast_action", '{"action": "faster"}'),))
    for style in ("digest", "react"):
        decision = decide(Script(called), world, style, max_turns=1)
        assert decision.status == "fallback", style
        assert "call" in decision.error


def test_a_word_before_any_forecast_says_what_to_forecast(world):
    """In react style the model is asked "Which do you forecast first?": a word is the answer to that."""
    script = Script(Reply("faster"), Reply(KEEP))
    decision = decide(script, world, "react")
    assert (decision.action, decision.status) == (1, "repaired")
    # Once it was asked for the decision, a word is one.
    assert decide(Script(Reply("faster")), world, "react").action == 3


def test_the_same_state_gives_the_same_prompt(world):
    first, second = (decide(Script(Reply(KEEP)), world) for _ in range(2))
    assert first.prompt_hash == second.prompt_hash
    last = decide(Script(Reply(KEEP)), world, "react")
    assert last.prompt_hash != first.prompt_hash


def test_recorded_answers_are_repeated(world, crowd, tmp_path):
    recorded = teacher(Script(Reply(KEEP, (), 9, 9))).decide(crowd, [None] * len(crowd))
    path = tmp_path / "answers.jsonl"
    path.write_text("\n".join(json.dumps(to_record(decision)) for decision in recorded))
    replay = Replay(TeacherConfig(backend="replay", replay_file=str(path)), 3)
    repeated = replay.decide(crowd, [None] * len(crowd))
    assert [d.action for d in repeated] == [d.action for d in recorded]
    assert {(d.tokens_in, d.cost) for d in repeated} == {(0, 0.0)}
    unknown = replay.decide(world(speed=11.0), [None])[0]
    assert (unknown.status, unknown.error) == ("fallback", "no recorded answer to this prompt")


@pytest.mark.parametrize("content", [None, "", "{", "[]", '{"action": 9}', "{}"])
def test_broken_recordings_are_refused(tmp_path, content):
    path = tmp_path / "answers.jsonl"
    if content is not None:
        path.write_text(content)
    with pytest.raises(RapidError, match="record"):
        Replay(TeacherConfig(backend="replay", replay_file=str(path)), 3)


def test_a_teacher_says_who_it_is():
    assert set(teacher(Script(Reply(KEEP))).describe()) == {"model", "style", "prompt"}
    assert teacher(Script(Reply(KEEP))).decide(np.zeros((0, 15, 5), np.float32), []) == []
