"""An episode kept step by step, so that it can be watched again."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from rapid.agents.saved import remembered
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
    told: tuple[str, ...] = ()
    """What a model was told at each decision, without the part of the prompt that never changes."""
    answered: tuple[str, ...] = ()
    """What it answered; of a conversation the turns."""
    odds_TA: NDArray[np.float32] | None = None
    """Its probability of each action; rows of NaN where it gave none."""
    computed: tuple[str, ...] = ()
    """What RAPID computed about the action taken, or a rule's reason; no model said it."""
    seen_TVF: NDArray[np.float32] | None = None
    """What the agent was made to see at each of the T decisions; None where it saw the truth."""
    weights_TVN: NDArray[np.float32] | None = None
    """The signed weight of each policy for each vehicle, at each decision, if the agent mixes policies."""
    attention_TV: NDArray[np.float32] | None = None
    """How much the agent attended to each vehicle at each decision, if it attends."""

    def tracks(self) -> NDArray[np.int64]:
        """Return a number for the vehicle in every row of every observation (T + 1 × V), -1 where there is none.

        A row of an observation holds another vehicle from step to step, as rows are sorted by distance. The same
        vehicle is found again by where its velocity should have brought it. The ego is 0.
        """
        tracks = np.full(self.obs_TVF.shape[:2], -1, np.int64)
        for step, scene_VF in enumerate(self.obs_TVF):
            before = (self.obs_TVF[step - 1], tracks[step - 1]) if step else None
            tracks[step] = follow(scene_VF, before, int(tracks.max()) + 1)
        return tracks


def follow(
    scene_VF: NDArray[np.float32], before: tuple[NDArray[np.float32], NDArray[np.int64]] | None, born: int
) -> NDArray[np.int64]:
    """Return a number for the vehicle in every row of an observation, -1 where there is none; the ego is 0.

    Args:
        scene_VF: the observation.
        before: the observation a second before, and the numbers it was given; None for the first.
        born: the number of the next vehicle that comes into view, at least 1.
    """
    tracks_V = np.full(len(scene_VF), -1, np.int64)
    tracks_V[0] = 0
    here = np.flatnonzero(scene_VF[1:, 0] > 0.5) + 1
    if before is not None and len(here):
        last_VF, scene = np.asarray(before[0], np.float64), np.asarray(scene_VF, np.float64)
        known = np.flatnonzero(before[1][1:] > 0) + 1
        expected = last_VF[known][:, 1:3] + last_VF[known][:, 3:5]
        # Lanes are 4 m apart and a change takes about a second: sideways counts less than its metres.
        delta = (scene[here][:, None, 1:3] - expected[None]) * (1.0, 0.75)
        cost = np.hypot(delta[..., 0], delta[..., 1])
        for i, j in zip(*linear_sum_assignment(np.minimum(cost, 2 * _GATE)), strict=True):
            if cost[i, j] <= _GATE:
                tracks_V[here[i]] = before[1][known[j]]
    new = here[tracks_V[here] < 0]
    tracks_V[new] = max(born, 1) + np.arange(len(new))
    return tracks_V


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


def explained_by(agent: Any, recording: Recording) -> Recording:
    """Return the recording with how the agent's network weighs its policies and attends to vehicles, if it does."""
    explain = getattr(agent, "explain", None)
    if not callable(explain) or not len(recording.action_T):
        return recording
    seen_TVF = recording.obs_TVF[:-1] if recording.seen_TVF is None else recording.seen_TVF
    state_TS = remembered(agent, recording.action_T[:-1])
    given = () if state_TS is None else (state_TS,)
    found: Any = explain(seen_TVF[:, : agent.vehicles], *given)
    attention, weights = found.attention_BLHV, found.weights_BVN
    return replace(
        recording,
        weights_TVN=None if weights is None else weights.cpu().numpy(),
        # One number a vehicle: the mean over layers and heads.
        attention_TV=None if attention is None else attention.mean((1, 2)).cpu().numpy(),
    )


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
        "told": list(recording.told),
        "answered": list(recording.answered),
        "odds": _flat(recording.odds_TA),
        "computed": list(recording.computed),
        "observations": _flat(recording.obs_TVF),
        "seen": _flat(recording.seen_TVF),
        "policies": 1 if recording.weights_TVN is None else recording.weights_TVN.shape[-1],
        "weights": _flat(recording.weights_TVN),
        "attention": _flat(recording.attention_TV),
    }


def _flat(values: NDArray[np.float32] | None) -> list[list[float | None]] | None:
    return None if values is None else [[_number(value) for value in entry.ravel()] for entry in values]


def _number(value: Any) -> float | None:
    number = float(value)
    return float(f"{number:.9g}") if math.isfinite(number) else None


def _from_dict(episode: dict[str, Any]) -> Recording:
    def array(values: Any) -> NDArray[np.float32]:
        return np.array([[math.nan if v is None else v for v in row] for row in values], np.float32)

    def shaped(name: str, last: int = 0) -> NDArray[np.float32] | None:
        # Recordings of earlier versions lack what was added later.
        if episode.get(name) is None:
            return None
        values = array(episode[name])
        return values.reshape(len(values), -1, last) if last else values

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
        # What earlier versions called explanations mixed what was answered with what was computed: it is left out.
        told=tuple(episode.get("told", ())),
        answered=tuple(episode.get("answered", ())),
        odds_TA=shaped("odds"),
        computed=tuple(episode.get("computed", ())),
        seen_TVF=shaped("seen", NUM_FEATURES),
        weights_TVN=shaped("weights", episode.get("policies", 1)),
        attention_TV=shaped("attention"),
    )
