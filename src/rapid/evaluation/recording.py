"""An episode kept step by step, so that it can be watched again."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rapid.errors import RapidError
from rapid.files import read_json, write_json
from rapid.scenarios import NUM_FEATURES

_FORMAT = 1
_GATE = 12.0
"""Metres between where a vehicle should be after a step and where one is, above which they are two vehicles."""


@dataclass(frozen=True)
class Recording:
    """One episode of T decisions: T + 1 observations, and what happened between them."""

    agent: str
    scenario: str
    seed: int
    """The spawn seed."""
    attack: str
    obs_TVF: NDArray[np.float32]
    """The true observations, T + 1 of them; the last is the one after the last decision."""
    action_T: NDArray[np.int64]
    reward_T: NDArray[np.float64]
    crashed: bool
    q_TA: NDArray[np.float32] | None = None
    """The agent's values of the actions, if it has any."""
    explanations: tuple[str, ...] = ()
    """What a teacher said at each decision."""

    def tracks(self) -> NDArray[np.int64]:
        """Return a number for the vehicle in every row of every observation (T + 1 × V), -1 where there is none.

        A row of an observation holds another vehicle from step to step, as rows are sorted by distance. The same
        vehicle is found again by where its velocity should have brought it. The ego is 0.
        """
        tracks = np.full(self.obs_TVF.shape[:2], -1, np.int64)
        tracks[:, 0] = 0
        born = 1
        for step, scene in enumerate(np.asarray(self.obs_TVF, np.float64)):
            here = np.flatnonzero(scene[1:, 0] > 0.5) + 1
            if step and len(here):
                before = np.asarray(self.obs_TVF[step - 1], np.float64)
                known = np.flatnonzero(tracks[step - 1, 1:] > 0) + 1
                expected = before[known][:, 1:3] + before[known][:, 3:5]
                # Lanes are 4 m apart and a change takes about a second: sideways counts less than its metres.
                delta = (scene[here][:, None, 1:3] - expected[None]) * (1.0, 0.75)
                cost = np.hypot(delta[..., 0], delta[..., 1])
                for i, j in zip(*linear_sum_assignment(np.minimum(cost, 2 * _GATE)), strict=True):
                    if cost[i, j] <= _GATE:
                        tracks[step, here[i]] = tracks[step - 1, known[j]]
            for row in here:
                if tracks[step, row] < 0:
                    tracks[step, row] = born
                    born += 1
        return tracks


def save_recordings(path: str | os.PathLike[str], recordings: Sequence[Recording]) -> None:
    """Write recordings as JSON, atomically."""
    write_json(path, {"format": _FORMAT, "episodes": [_to_dict(recording) for recording in recordings]})


def load_recordings(path: str | os.PathLike[str]) -> list[Recording]:
    """Read what :func:`save_recordings` wrote.

    Raises:
        RapidError: the file is missing, damaged, or of another format.
    """
    content = read_json(path, "file of recorded episodes")
    try:
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']}, expected {_FORMAT}")
        return [_from_dict(episode) for episode in content["episodes"]]
    except (KeyError, TypeError, ValueError) as error:
        raise RapidError(f"'{path}' is not a file of recorded episodes ({error}). Record them again.") from error


def explained(recording: Recording, explanations: Sequence[str]) -> Recording:
    """Return the recording with what a teacher said at each decision."""
    return replace(recording, explanations=tuple(explanations))


def _to_dict(recording: Recording) -> dict[str, Any]:
    # float32 needs nine digits to come back as it was; JSON has no NaN, so a missing value is null.
    q = None if recording.q_TA is None else [[_number(v) for v in row] for row in recording.q_TA]
    return {
        "agent": recording.agent,
        "scenario": recording.scenario,
        "seed": int(recording.seed),
        "attack": recording.attack,
        "crashed": bool(recording.crashed),
        "actions": recording.action_T.tolist(),
        "rewards": [_number(reward) for reward in recording.reward_T],
        "q": q,
        "explanations": list(recording.explanations),
        "observations": [[_number(v) for v in scene.ravel()] for scene in recording.obs_TVF],
    }


def _number(value: Any) -> float | None:
    number = float(value)
    return float(f"{number:.9g}") if math.isfinite(number) else None


def _from_dict(episode: dict[str, Any]) -> Recording:
    def array(values: Any) -> NDArray[np.float32]:
        return np.array([[math.nan if v is None else v for v in row] for row in values], np.float32)

    return Recording(
        agent=episode["agent"],
        scenario=episode["scenario"],
        seed=episode["seed"],
        attack=episode["attack"],
        crashed=episode["crashed"],
        obs_TVF=array(episode["observations"]).reshape(len(episode["observations"]), -1, NUM_FEATURES),
        action_T=np.array(episode["actions"], np.int64),
        reward_T=np.array([math.nan if v is None else v for v in episode["rewards"]], np.float64),
        q_TA=None if episode["q"] is None else array(episode["q"]),
        explanations=tuple(episode["explanations"]),
    )
