"""The tools that a model may call in `react` style: each answers from the facts; a wrong call is told what is right."""

import json
from collections.abc import Callable
from typing import Any

from rapid.road import CAR_LENGTH
from rapid.scenarios import IDLE, LANE_LEFT, LANE_RIGHT
from rapid.teacher.facts import Facts
from rapid.teacher.prompt import WORDS, outcome
from rapid.teacher.scene import Car

ALIASES = {word: action for action, word in WORDS.items()} | {
    "lane_left": LANE_LEFT,
    "lane_right": LANE_RIGHT,
    "idle": IDLE,
}


def action_named(name: object) -> int | None:
    """Return the action that a model means by a word, or `None`; the paper's names count too."""
    return ALIASES.get(name.strip().lower()) if isinstance(name, str) else None


def describe_car(car: Car) -> str:
    """Return one line about a car: name, lane, gap bumper to bumper, speed."""
    gap = max(abs(car.ahead) - CAR_LENGTH, 0.0)
    where = "ahead" if car.ahead >= 0 else "behind"
    changing = f", moving to lane {car.toward + 1}" if car.toward != car.lane else ""
    return f"{car.name}: lane {car.lane + 1}{changing}, {gap:.1f} m {where}, {car.speed:.1f} m/s"


def _available_actions(facts: Facts, arguments: dict[str, Any]) -> str:
    return ", ".join(WORDS[action] for action in facts.available)


def _available_lanes(facts: Facts, arguments: dict[str, Any]) -> str:
    scene = facts.scene
    lanes = sorted({scene.lane_after(action) for action in facts.available})
    names = [f"lane {lane + 1}" + (" (yours)" if lane == scene.lane else "") for lane in lanes]
    return ", ".join(names)


def _cars_on_lane(facts: Facts, arguments: dict[str, Any]) -> str:
    lane, lanes = arguments.get("lane"), facts.scene.lanes
    if type(lane) is not int or not 1 <= lane <= lanes:
        return f"Error: `lane` must be a whole number from 1 to {lanes}."
    lead, rear = facts.scene.lead(lane - 1), facts.scene.rear(lane - 1)
    lines = [describe_car(lead) if lead else "no car ahead", describe_car(rear) if rear else "no car behind"]
    return "; ".join(lines)


def _check_action(facts: Facts, arguments: dict[str, Any]) -> str:
    action = action_named(arguments.get("action"))
    if action is None:
        return f"Error: `action` must be one of {', '.join(WORDS.values())}."
    if action not in facts.available:
        return f"{WORDS[action]} is not possible here."
    check = facts.checks[action]
    verdict = "safe" if check.safe or check.car is None else f"in conflict with {describe_car(check.car)}"
    return f"{WORDS[action]}: by distance and speed {verdict}."


def _forecast_action(facts: Facts, arguments: dict[str, Any]) -> str:
    action = action_named(arguments.get("action"))
    if action is None:
        return f"Error: `action` must be one of {', '.join(WORDS.values())}."
    return f"{WORDS[action]}: {outcome(facts, action)}."


_ACTION = {"action": {"type": "string", "enum": list(WORDS.values())}}
_LANE = {"lane": {"type": "integer", "description": "1 is the leftmost"}}
_TOOLS: dict[str, tuple[Callable[[Facts, dict[str, Any]], str], str, dict[str, Any]]] = {
    "available_actions": (_available_actions, "List the actions that are possible now.", {}),
    "available_lanes": (_available_lanes, "List the lanes that can be reached with one action.", {}),
    "cars_on_lane": (_cars_on_lane, "Tell the nearest car ahead and behind on a lane.", _LANE),
    "check_action": (_check_action, "Check an action against gaps and closing speeds.", _ACTION),
    "forecast_action": (
        _forecast_action,
        "Look six seconds ahead for the best way to drive on.",
        _ACTION,
    ),
}
TOOL_NAMES = tuple(_TOOLS)


def call_tool(facts: Facts, name: str, arguments: str) -> str:
    """Answer one call; `arguments` is a JSON object as text. A wrong call gets a sentence saying what is right."""
    if name not in _TOOLS:
        return f"Error: there is no tool '{name}'. The tools are {', '.join(_TOOLS)}."
    try:
        parsed = json.loads(arguments or "{}")
    except ValueError:
        parsed = None
    if not isinstance(parsed, dict):
        return 'Error: the arguments must be a JSON object, for example {"lane": 1}.'
    return _TOOLS[name][0](facts, parsed)


def tool_specifications() -> list[dict[str, Any]]:
    """Return the tools in the form that OpenAI-compatible servers take."""
    return [
        {
            "type": "function",
            "function": {
                "name": name,
                "description": description,
                "parameters": {"type": "object", "properties": fields, "required": list(fields)},
            },
        }
        for name, (_, description, fields) in _TOOLS.items()
    ]


def tool_help() -> str:
    """Return the calls as text, for servers without native tool calling."""
    lines: list[str] = []
    for name, (_, description, fields) in _TOOLS.items():
        arguments = f" {{{', '.join(f'{json.dumps(field)}: {field.upper()}' for field in fields)}}}" if fields else ""
        lines.append(f"CALL {name}{arguments} - {description}")
    return "\n".join(lines)
