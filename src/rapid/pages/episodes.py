"""An episode as the player reads it: plain lists, one entry per decision, and the vehicles as they move."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.evaluation.recording import Recording
from rapid.evaluation.summary import label_of
from rapid.pages.markup import plain
from rapid.scenarios import ACTIONS, get_scenario

ACTION_WORDS = tuple(name.replace("LANE_", "").lower() for name in ACTIONS)
"""What the five actions are called on a page."""


def moving_picture(recording: Recording) -> dict[str, Any]:
    """Return a recorded episode for the player.

    ``frames`` holds for each of the T + 1 moments the vehicles as [track, row, x, y, vx, vy] (m, m/s); ``seen`` for
    each decision what the agent was made to see instead, as [row, x, y, vx, vy], None where that was the truth.
    """
    tracks = recording.tracks()
    reward = float(np.nansum(recording.reward_T))
    attacked = "" if recording.attack == "none" else f" under {recording.attack}"
    ending = "crash" if recording.crashed else "no crash"
    agent = label_of(recording.agent)
    return {
        "label": f"{agent}{attacked}, spawn {recording.seed}: return {reward:.1f}, {ending}",
        "agent": agent,
        "scenario": recording.scenario,
        "spawn": recording.seed,
        "attack": recording.attack,
        "lanes": get_scenario(recording.scenario).lanes,
        "vehicles": recording.obs_TVF.shape[1],
        "human": False,
        "ended": True,
        "crashed": recording.crashed,
        "frames": [frame(scene, tracks[t]) for t, scene in enumerate(recording.obs_TVF)],
        "seen": None if recording.seen_TVF is None else list(map(seen, recording.seen_TVF, recording.obs_TVF[:-1])),
        "actions": recording.action_T.tolist(),
        "rewards": [rounded(value) for value in recording.reward_T],
        "q": None if recording.q_TA is None else rounded(recording.q_TA),
        "routing": None if recording.weights_TVN is None else rounded(recording.weights_TVN, 3),
        "attention": None if recording.attention_TV is None else rounded(recording.attention_TV, 3),
        "told": list(recording.told),
        "answered": list(recording.answered),
        "odds": None if recording.odds_TA is None else [_odds(row_A) for row_A in recording.odds_TA],
        "computed": list(recording.computed),
    }


def _odds(row_A: NDArray[np.float32]) -> list[float] | None:
    return None if np.isnan(row_A).any() else rounded(row_A)


def frame(scene_VF: NDArray[np.float32], tracks_V: NDArray[np.int64]) -> list[list[float]]:
    """Return the vehicles of one observation as [track, row, x, y, vx, vy]."""
    return [
        [int(tracks_V[row]), row, *(round(float(value), 2) for value in scene_VF[row, 1:5])]
        for row in np.flatnonzero(tracks_V >= 0).tolist()
    ]


def seen(seen_VF: NDArray[np.float32], true_VF: NDArray[np.float32]) -> list[list[float]] | None:
    """Return the vehicles that the agent was made to see as [row, x, y, vx, vy]; None where it saw the truth."""
    if np.array_equal(seen_VF, true_VF[: len(seen_VF)]):
        return None
    return [
        [row, *(round(float(value), 2) for value in seen_VF[row, 1:5])]
        for row in np.flatnonzero(seen_VF[:, 0] >= 0.5).tolist()
    ]


def rounded(values: Any, digits: int = 4) -> Any:
    """Return numbers, in whatever lists, with so many decimals; None where there is none, as JSON has no NaN."""
    return plain(np.round(np.asarray(values, np.float64), digits))


def in_order(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the episodes that there is something of to see: those without an attack first, in the order given."""
    return sorted((each for each in recordings if len(each.action_T)), key=lambda each: each.attack != "none")


def side_by_side(recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """Return recorded episodes for the player, ordered by :func:`in_order`."""
    return [moving_picture(recording) for recording in in_order(recordings)]
