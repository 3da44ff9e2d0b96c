"""One tab of the live page: its two episodes, and the messages by which it drives them."""

import json
import threading
import time
from collections.abc import Callable
from typing import Any

from rapid.errors import RapidError
from rapid.evaluation.rollouts import is_applicable, run_episodes
from rapid.play.ride import ALONG, MOST_METRES, Ride, attack_spec
from rapid.play.roster import YOU, Roster
from rapid.scenarios import get_scenario

PANES = 2
MOST_SPAWN = 2**63 - 1
SEARCHED, AT_ONCE, SECONDS = 512, 32, 20.0
"""Spawns that are driven to find a crash, how many side by side, and for how long."""


class Session:
    """Answers the messages of one tab.

    A message is a JSON object with a ``type``: ``open`` begins an episode in a pane, ``step`` takes its next decision,
    ``find`` looks for a spawn on which the driver crashes. Every answer names the pane and the tab's own number of the
    episode, so that the page can tell late answers.

    Args:
        roster: who can be chosen.
        lock: held while anything is driven, since all tabs share agents and cores.
        seed: decides the noise of attacks.
    """

    def __init__(self, roster: Roster, lock: threading.Lock, seed: int = 0) -> None:
        self._roster, self._lock, self._seed = roster, lock, seed
        self._rides: list[Ride | None] = [None] * PANES
        self._answers: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "open": self._open,
            "step": self._step,
            "find": self._find,
        }

    def answer(self, text: str) -> str:
        """Return the answer to a message; what is wrong with it is an answer too."""
        pane: Any = None
        ride: Any = None
        try:
            message = _read(text)
            pane, ride = message.get("pane"), message.get("ride")
            kind = message.get("type")
            answer = self._answers.get(kind) if isinstance(kind, str) else None
            if answer is None:
                raise RapidError(f"Unknown message {kind!r:.80}; expected one of {', '.join(self._answers)}.")
            _whole(message, "pane", PANES - 1)
            with self._lock:
                found = answer(message)
        except RapidError as error:
            found = {"type": "error", "message": str(error)}
        return json.dumps({"pane": pane, "ride": ride} | found, allow_nan=False)

    def _open(self, message: dict[str, Any]) -> dict[str, Any]:
        pane, scenario = message["pane"], _word(message, "scenario")
        agent = self._roster.open(_word(message, "agent"), get_scenario(scenario).name)
        # The old episode stays until the new one stands.
        ride = Ride(agent, scenario, _whole(message, "spawn", MOST_SPAWN), self._seed)
        self._rides[pane] = ride
        return {"type": "opened", "episode": ride.opening()}

    def _step(self, message: dict[str, Any]) -> dict[str, Any]:
        ride = self._rides[message["pane"]]
        if ride is None:
            raise RapidError("No episode has begun in this pane. Choose who drives.")
        attack, metres = _attack(message)
        return {"type": "stepped"} | ride.step(message.get("action"), attack, min(metres / ALONG, 0.49))

    def _find(self, message: dict[str, Any]) -> dict[str, Any]:
        """Drive spawns until one ends in a crash."""
        scenario, key = _word(message, "scenario"), _word(message, "agent")
        if key == YOU:
            raise RapidError("Only you know where you crash. Choose another driver.")
        agent, first = (
            self._roster.open(key, get_scenario(scenario).name),
            _whole(message, "spawn", MOST_SPAWN - SEARCHED),
        )
        attack, _ = _attack(message)
        attack = attack if is_applicable(agent, attack) else "none"
        began = time.monotonic()
        driven = 0
        while driven < SEARCHED and time.monotonic() - began < SECONDS:
            spawns = range(first + 1 + driven, first + 1 + driven + AT_ONCE)
            episodes = run_episodes(agent, scenario, spawns, attack, self._seed)
            driven += AT_ONCE
            if episodes.crashed_E.any():
                return {"type": "found", "spawn": int(episodes.seed_E[episodes.crashed_E.argmax()]), "driven": driven}
        return {"type": "found", "spawn": None, "driven": driven}


def _read(text: str) -> dict[str, Any]:
    try:
        message = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RapidError(f"A message must be JSON: {error}.") from error
    if not isinstance(message, dict):
        raise RapidError("A message must be a JSON object.")
    return message


def _word(message: dict[str, Any], name: str) -> str:
    value = message.get(name)
    if not isinstance(value, str) or not value or len(value) > 1000:
        raise RapidError(f"A message's '{name}' must be a word, got {value!r:.80}.")
    return value


def _whole(message: dict[str, Any], name: str, most: int) -> int:
    value = message.get(name)
    if type(value) is not int or not 0 <= value <= most:
        raise RapidError(f"A message's '{name}' must be a whole number from 0 to {most}, got {value!r:.80}.")
    return value


def _attack(message: dict[str, Any]) -> tuple[str, float]:
    """Return the attack's text and its size in metres."""
    kind, metres = message.get("attack", "none"), message.get("metres", 0)
    if not isinstance(kind, str) or isinstance(metres, bool) or not isinstance(metres, (int, float)):
        raise RapidError(f"An attack is a kind and its metres, up to {MOST_METRES:g}; got {kind!r:.40} {metres!r:.40}.")
    return attack_spec(kind, float(metres)), float(metres)
