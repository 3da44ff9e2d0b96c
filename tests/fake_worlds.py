"""Stand-ins that are fast and deterministic: worlds with the simulator's interface, and a driver."""

from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from rapid.data.transitions import TEACHER, Transitions
from rapid.teacher.decision import Decision


class Snap(NamedTuple):
    state: np.ndarray


class FakeWorlds:
    """Worlds whose next state is arithmetic of seed, episode, time and actions; about one step in eleven crashes."""

    def __init__(self, num_envs: int, autoreset: bool = False, duration: int = 30) -> None:
        self.num_envs, self.autoreset, self.duration = num_envs, autoreset, duration
        # Columns: seed, episode, time, accumulated actions, finished.
        self.state = np.zeros((num_envs, 5), np.int64)

    def _obs(self) -> np.ndarray:
        rows = [np.random.default_rng(tuple(row[:4])).normal(0, 20, (15, 5)) for row in self.state]
        obs = np.array(rows, np.float32)
        obs[..., 0] = 1
        return obs

    def reset(self, seed: list[int]) -> tuple[np.ndarray, dict[str, Any]]:
        self.state[:] = 0
        self.state[:, 0] = seed
        return self._obs(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        state = self.state
        live = state[:, 4] == 0
        state[live, 2] += 1
        state[live, 3] = (3 * state[live, 3] + actions[live] + 1 + state[live, 0]) % 1009
        crashed = state[:, 3] % 11 == 5
        late = (state[:, 2] >= self.duration) & ~crashed
        reward = np.where(live, np.where(crashed, 0.0, state[:, 3] % 10 / 10), 0.0)
        info: dict[str, Any] = {}
        obs = self._obs()
        ended = crashed | late
        if not self.autoreset:
            state[:, 4] = ended
        elif ended.any():
            info["final_obs"] = np.full(self.num_envs, None, object)
            for world in np.flatnonzero(ended):
                info["final_obs"][world] = obs[world]
            state[ended, 1] += 1
            state[ended, 2:4] = 0
            obs = self._obs()
        return obs, reward, crashed, late, info

    def snapshot(self, index: int) -> Snap:
        return Snap(self.state[index].copy())

    def restore(self, index: int, snap: Snap) -> None:
        self.state[index] = snap.state

    def close(self) -> None:
        pass


class FakeTeacher:
    """Decides by its keys; `fail_after` decisions it is interrupted."""

    name = "fake"

    def __init__(self, fail_after: int | None = None, **identity: Any) -> None:
        self.asked, self.fail_after, self.identity = 0, fail_after, identity

    def describe(self) -> dict[str, Any]:
        return {"model": "fake", "tuple": (1, 2), **self.identity}

    def decide(self, obs_BVF: np.ndarray, previous: list[Decision | None], keys_B: np.ndarray) -> list[Decision]:
        if self.fail_after is not None and self.asked >= self.fail_after:
            raise KeyboardInterrupt
        self.asked += len(obs_BVF)
        decisions: list[Decision] = []
        for before, key in zip(previous, keys_B, strict=True):
            draw = np.random.default_rng(key)
            action = int(draw.integers(5))
            soft = tuple(float(value) for value in np.eye(5)[action]) if key % 3 else None
            told = f"nach {before.action if before else 'nichts'} – “{action}”\n"
            decisions.append(Decision(action, told, str(action), soft, "ab", "ok", "", 0, 100, 3, 0.25, 0.001, "[]"))
        return decisions


def fake_transitions(episodes: int = 20, source: int = TEACHER, seed: int = 0, length: int = 10) -> Transitions:
    """Return random transitions of whole episodes; every third one crashes."""
    rng = np.random.default_rng(seed)
    count = episodes * length
    obs = rng.normal(0, 20, (episodes, length + 1, 15, 5)).astype(np.float32)
    obs[..., 0] = 1
    last_N = np.tile(np.arange(length) == length - 1, episodes)
    episode_N = np.repeat(np.arange(episodes), length)
    soft = rng.dirichlet(np.ones(5), count).astype(np.float32)
    soft[rng.random(count) < 0.3] = np.nan
    return Transitions(
        obs_NVF=obs[:, :-1].reshape(count, 15, 5),
        action_N=rng.integers(0, 5, count),
        reward_N=rng.random(count).astype(np.float32),
        next_obs_NVF=obs[:, 1:].reshape(count, 15, 5),
        terminated_N=last_N & (episode_N % 3 == 0),
        truncated_N=last_N & (episode_N % 3 != 0),
        source_N=np.full(count, source, np.int8),
        episode_N=episode_N,
        step_N=np.tile(np.arange(length), episodes),
        spawn_seed_N=episode_N + 1000 * (1 + source),
        probabilities_NA=soft,
    ).validate()


def assert_equal(first: Transitions, second: Transitions) -> None:
    """Check that two sets of transitions are the same, bit for bit."""
    for field in fields(Transitions):
        one, other = getattr(first, field.name), getattr(second, field.name)
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes(), field.name
