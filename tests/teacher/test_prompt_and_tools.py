"""Prompts, tools and the reading of answers."""

import json

import pytest

from rapid.scenarios import ACTIONS, FASTER, IDLE
from rapid.teacher.answers import read_choice
from rapid.teacher.briefing import briefing
from rapid.teacher.calls import is_finished, read_call
from rapid.teacher.decision import Decision
from rapid.teacher.facts import gather
from rapid.teacher.prompt import WORDS, calibration, digest, digest_system, prompt_version
from rapid.teacher.scene import read_scenes
from rapid.teacher.tools import TOOL_NAMES, action_named, call_tool, tool_help, tool_specifications


@pytest.fixture
def facts(world):
    return gather(read_scenes(world(cars=((30, 1, 20), (-20, 2, 25))), 3)[0])


def test_the_digest_offers_every_possible_action_once(crowd):
    for scene in read_scenes(crowd, 3):
        facts = gather(scene)
        prompt = digest(facts)
        words = [word.strip(" .") for part in prompt.user.split(":")[1:] for word in part.split(".")[0].split(",")]
        assert sorted(set(words) - {"none"}) == sorted(WORDS[action] for action in facts.available)
        assert prompt.system == digest_system(3)


def test_the_digest_sorts_actions_as_the_facts_do(crowd):
    for scene in read_scenes(crowd, 3):
        facts = gather(scene)
        safe, tight, unsafe = (part.split(": ")[1] for part in digest(facts).user.rstrip(".").split(". "))
        for action in facts.available:
            if facts.is_open(action):
                assert WORDS[action] in (safe if facts.survives(action) else tight)
            else:
                assert WORDS[action] in (tight if facts.survives(action) else unsafe)


def test_calibration_names_every_action_in_every_place():
    prompts = calibration(3)
    assert {prompt.system for prompt in prompts} == {digest_system(3)}
    for word in WORDS.values():
        assert sum(word in prompt.user.split(".")[0] for prompt in prompts) == 1
        assert all(prompt.user.count(word) == 1 for prompt in prompts)


def test_the_prompt_version_follows_the_road(facts):
    assert prompt_version(3) == prompt_version(3) != prompt_version(4)


def test_the_briefing_feeds_back_the_previous_decision(facts):
    last = Decision(FASTER, explanation="the road was free")
    assert "faster. the road was free" in briefing(facts, last, "react", True).user
    assert "previous" not in briefing(facts, None, "react", True).user


def test_tools_stand_in_the_text_only_if_the_server_has_no_calls(facts):
    assert all(name in briefing(facts, None, "react", False).system for name in TOOL_NAMES)
    assert not any(name in briefing(facts, None, "react", True).system for name in TOOL_NAMES)
    assert {tool["function"]["name"] for tool in tool_specifications()} == set(TOOL_NAMES)
    assert all(name in tool_help() for name in TOOL_NAMES)


def test_tools_answer_from_the_facts(facts):
    assert call_tool(facts, "available_lanes", "{}") == "lane 1, lane 2 (yours), lane 3"
    assert "car 2: lane 2, 25.0 m ahead, 20.0 m/s" in call_tool(facts, "cars_on_lane", '{"lane": 2}')
    assert "in conflict with car 2" in call_tool(facts, "check_action", '{"action": "faster"}')
    assert call_tool(facts, "check_action", '{"action": "slower"}') == "slower: by distance and speed safe."
    assert call_tool(facts, "forecast_action", '{"action": "keep"}').startswith("keep: tight")


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("fly", "{}"),
        ("cars_on_lane", "{}"),
        ("cars_on_lane", '{"lane": 9}'),
        ("cars_on_lane", '{"lane": "two"}'),
        ("cars_on_lane", '{"lane": true}'),
        ("check_action", '{"action": 3}'),
        ("check_action", "not json"),
        ("forecast_action", '["keep"]'),
    ],
)
def test_wrong_calls_are_told_what_is_right(facts, name, arguments):
    assert call_tool(facts, name, arguments).startswith("Error: ")


def test_action_names():
    assert [action_named(name) for name in ACTIONS] == [0, 1, 2, 3, 4]
    assert [action_named(word.upper()) for word in WORDS.values()] == list(WORDS)
    assert action_named("brake") is action_named(None) is action_named(["left"]) is None


def test_calls_in_plain_text():
    assert read_call('I look.\nCALL cars_on_lane {"lane": 2}\n') == ("cars_on_lane", '{"lane": 2}')
    assert read_call("CALL available_actions") == ("available_actions", "{}")
    assert read_call("I could CALL a friend") is None
    assert read_call('CALL forecast_action({"action": "right"})\nCALL b') == ("forecast_action", '{"action": "right"}')
    assert read_call('Well.\nforecast_action {"action": "faster"}') == ("forecast_action", '{"action": "faster"}')
    assert read_call("available_lanes") == ("available_lanes", "{}")
    assert read_call("available_lanes are 1 and 2") is None
    assert read_call("CALL cars_on_lane(2)") == ("cars_on_lane", "2")
    assert read_call("CALL available_actions()") == ("available_actions", "{}")


ARGUMENTS = '{"action": "faster"}'


@pytest.mark.parametrize(
    "text",
    [
        f"forecast_action {ARGUMENTS}",
        f"- forecast_action {ARGUMENTS}",
        f"**forecast_action {ARGUMENTS}**",
        f"`forecast_action` {ARGUMENTS}",
        f"forecast_action: {ARGUMENTS}",
        f"CALL forecast_action: {ARGUMENTS}",
        f"I call forecast_action {ARGUMENTS}.",
        f"First forecast_action:\n```json\n{ARGUMENTS}\n```",
        f'{{"tool": "forecast_action", {ARGUMENTS}',
        f'{{"forecast_action": {ARGUMENTS}}}',
    ],
)
def test_an_object_after_the_name_of_a_tool_is_no_decision(facts, text):
    assert read_call(text) == ("forecast_action", ARGUMENTS)
    assert read_choice(text, facts, words=False).fault == "That was a call, not a decision."
    assert is_finished(text)


def test_a_decision_may_name_a_tool(facts):
    text = 'As forecast_action said: {"explanation": "forecast_action says safe", "action": "faster"}'
    assert read_call(text) is None
    assert read_choice(text, facts, words=False).action == FASTER


@pytest.mark.parametrize(
    ("text", "done"),
    [
        ("I look.\nCALL cars_on", False),
        ("CALL available_lanes", False),
        ("CALL available_lanes\n", True),
        ('CALL check_action {"action": "keep"', False),
        ('CALL check_action {"action": "keep"}', True),
        ('CALL check_action({"action": "keep"}', True),
        ('{"explanation": "calm", "action": "ke', False),
        ('{"explanation": "calm", "action": "keep"}', True),
        ('Lane {"lane": 2} is free.', False),
        ("", False),
    ],
)
def test_a_whole_call_or_decision_is_noticed_while_it_is_written(text, done):
    assert is_finished(text) == done


def test_in_react_style_the_cars_are_to_be_asked_for(facts):
    told, asked = (briefing(facts, None, style, False).user for style in ("digest", "react"))
    assert all(car.name in told for car in facts.scene.cars)
    assert [car.name for car in facts.scene.cars if car.name in asked] == ["car 2"]
    assert asked.endswith("Possible actions: left, keep, right, faster, slower. Which do you forecast first?")


@pytest.mark.parametrize(
    "form", ["{}", "```json\n{}\n```", 'First {{"a": 1}} then {}', "Thought: braces {{ and }} {} done"]
)
def test_answers_are_found_wherever_they_stand(facts, form):
    answer = json.dumps({"explanation": "calm", "action": "keep"})
    choice = read_choice(form.format(answer), facts, words=False)
    assert (choice.action, choice.explanation) == (IDLE, "calm")


@pytest.mark.parametrize(
    "text", ["", "  ", "keep", '{"action": "keep"', '{"action": "hover"}', '{"action": null}', "[1]", "{" * 3000, "{}"]
)
def test_unusable_answers_have_a_fault(facts, text):
    choice = read_choice(text, facts, words=False)
    assert choice.action is None
    assert choice.fault


@pytest.mark.parametrize("text", ["keep", " Keep.\n", "**keep**", "Let me see.\n\nkeep", '{"action": "keep"}'])
def test_one_word_does_in_digest_style(facts, text):
    assert read_choice(text, facts).action == IDLE
    assert read_choice("keep or slower", facts).fault.startswith("The answer is neither")


def test_impossible_actions_have_a_fault(world):
    facts = gather(read_scenes(world(lane=0), 3)[0])
    assert "not possible" in read_choice('{"action": "left"}', facts).fault
