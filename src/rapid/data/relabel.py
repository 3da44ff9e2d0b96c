"""The same driving under another reward: recorded episodes are driven again in the simulator, action by action."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.data.dataset import Dataset
from rapid.data.transitions import Transitions
from rapid.errors import RapidError
from rapid.progress import Task
from rapid.scenarios import IDLE, Reward, get_scenario

WORLDS = 64
"""Episodes that are driven at once."""
TOLERANCE = 1e-3
"""Metres and m/s by which what is seen may differ from the record: another processor may round otherwise."""


def relabel(dataset: Dataset, reward: Reward, progress: Task | None = None) -> Dataset:
    """Return the dataset with the rewards that its driving earns under `reward`; nothing else changes.

    Teachers do not see the reward, so one collection serves every reward. Spawn seeds and actions give every episode
    again, and what is seen on the way is compared with the record.

    Args:
        dataset: episodes without gaps, as they were collected.
        reward: which one is wanted.
        progress: counts transitions.

    Raises:
        RapidError: a mixture or another dataset with steps missing, or a record that the simulator does not give again.
    """
    before = get_scenario(dataset.scenario)
    after = replace(before, reward=reward)
    rows = dataset.transitions
    episodes = _episodes(rows)
    reward_N = np.empty_like(rows.reward_N)
    for first in range(0, len(episodes), WORLDS):
        chosen = episodes[first : first + WORLDS]
        _drive(rows, chosen, after.name, reward_N)
        if progress:
            progress.advance(sum(map(len, chosen)))
    collection: dict[str, Any] = {**(dataset.collection or {}), "relabelled_from": before.name}
    if settings := collection.get("settings"):
        # A collection that goes on from here goes on under this reward.
        collection["settings"] = {**settings, "scenario": after.name}
    return replace(dataset, scenario=after.name, transitions=replace(rows, reward_N=reward_N), collection=collection)


def _episodes(rows: Transitions) -> list[NDArray[np.int64]]:
    """Return the rows of every episode, from its first step on without a gap."""
    starts = np.flatnonzero(rows.step_N == 0)
    ends = np.append(starts[1:], len(rows))
    follows_N = rows.follows_N()
    if (
        not len(starts)
        or starts[0]
        or not all(follows_N[start : end - 1].all() for start, end in zip(starts, ends, strict=True))
    ):
        raise RapidError(
            "The dataset lacks steps of its episodes, so they cannot be driven again; a mixture does. "
            "Relabel what was collected, then mix."
        )
    return [np.arange(start, end) for start, end in zip(starts, ends, strict=True)]


def _drive(rows: Transitions, episodes: list[NDArray[np.int64]], scenario: str, reward_N: NDArray[np.float32]) -> None:
    """Drive some episodes again and write what they earn."""
    from rapid.simulator import CompiledVectorEnv

    env = CompiledVectorEnv(scenario, len(episodes), autoreset=False)
    obs_WVF, _ = env.reset(seed=[int(rows.spawn_seed_N[of[0]]) for of in episodes])
    for step in range(max(map(len, episodes))):
        worlds = np.array([world for world, of in enumerate(episodes) if step < len(of)])
        now = np.array([of[step] for of in episodes if step < len(of)])
        _compare(rows.obs_NVF[now], obs_WVF[worlds], scenario)
        action_W = np.full(len(episodes), IDLE)
        action_W[worlds] = rows.action_N[now]
        obs_WVF, reward_W, terminated_W, truncated_W, _ = env.step(action_W)
        _compare(rows.next_obs_NVF[now], obs_WVF[worlds], scenario)
        _compare(rows.terminated_N[now], terminated_W[worlds], scenario)
        # A crash in the last second is a crash: the record keeps one of the two.
        _compare(rows.truncated_N[now], (truncated_W & ~terminated_W)[worlds], scenario)
        reward_N[now] = reward_W[worlds]


def _compare(recorded: NDArray[np.generic], seen: NDArray[np.generic], scenario: str) -> None:
    if not np.allclose(recorded.astype(np.float32), seen.astype(np.float32), rtol=0, atol=TOLERANCE):
        raise RapidError(
            f"The simulator does not give the recorded episodes again in '{scenario}': they were driven in another "
            "simulator or version, or the record was edited. Collect in that scenario instead."
        )
