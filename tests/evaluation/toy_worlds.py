"""A toy vector environment with the interface of `rapid.make_vec`: what happens is plain arithmetic."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class ToyWorlds:
    """The ego drives 20 m a step (24 after FASTER); world `seed` ends at step 3 + seed % 5; odd seeds crash there."""

    def __init__(self, count: int, lanes: int = 3) -> None:
        self.count, self.lanes = count, lanes
        self.closed = False
        self.seen: list[NDArray[np.int64]] = []

    def reset(self, seed: list[int]) -> tuple[NDArray[np.float32], dict[str, Any]]:
        self.seed = np.array(seed)
        self.t = np.zeros(self.count, int)
        self.x = np.full(self.count, 100.0)
        self.lane = np.zeros(self.count, int)
        self.done = np.zeros(self.count, bool)
        self.speed = np.full(self.count, 20.0)
        return self._obs(), {}

    def _obs(self) -> NDArray[np.float32]:
        obs = np.zeros((self.count, 15, 5), np.float32)
        obs[:, 0] = np.stack([np.ones(self.count), self.x, 4.0 * self.lane, self.speed, np.zeros(self.count)], 1)
        # A slower vehicle that stays 45 m ahead on lane 0: the gap is 40 m, closing at 4 m/s, so 10 s.
        obs[:, 1] = np.stack(
            [np.ones(self.count), self.x + 45, np.zeros(self.count), self.speed - 4, np.zeros(self.count)], 1
        )
        return obs

    def step(self, action: NDArray[np.int64]) -> tuple[Any, ...]:
        self.seen.append(action.copy())
        live = ~self.done
        self.speed = np.where(live & (action == 3), 24.0, np.where(live, 20.0, self.speed))
        self.x += np.where(live, self.speed, 0)
        self.lane = np.where(live, np.clip(self.lane + (action == 2) - 1 * (action == 0), 0, self.lanes - 1), self.lane)
        self.t += live
        end = live & (self.t >= 3 + self.seed % 5)
        crashed = (end | self.done) & (self.seed % 2 == 1)
        self.done = self.done | end
        reward = np.where(live, 1.0, 99.0)  # a finished world's reward must not count
        info = {"crashed": crashed, "speed": self.speed.copy(), "lane": self.lane, "distance": self.x - 100}
        return self._obs(), reward, self.done & crashed, self.done & ~crashed, info

    def close(self) -> None:
        self.closed = True
