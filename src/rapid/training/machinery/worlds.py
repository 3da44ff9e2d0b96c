"""The worlds that phase 3 drives in, and how it chooses actions there."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rapid.networks.memory import initial_state, next_state
from rapid.networks.q_network import QNetwork
from rapid.scenarios import NUM_ACTIONS, Scenario, seeing
from rapid.seeding import stream_seed
from rapid.spawns import train_part

MakeWorlds = Callable[[int], Any]
"""Gives a vector environment of so many worlds with SAME_STEP autoreset."""


def default_worlds(scenario: str | Scenario, vehicles: int) -> MakeWorlds:
    """Return what makes compiled worlds of a scenario whose observations have so many rows."""
    from rapid.simulator import make_vec

    return lambda count: make_vec(scenario, count, config=seeing(vehicles))


class Explorer:
    """Epsilon-greedy, whose random actions may be held for a while ("temporally extended", Dabney et al., 2021).

    A car that creeps at 8 m/s is paid for speeding up after four decisions in a row; chosen one by one at random, they
    hardly ever come together once epsilon is small. An action is held into the next episode, too.

    Args:
        num_envs: worlds that are driven together.
        longest: a random action is held for 1 to so many steps, each as likely; 1 is plain epsilon-greedy.
    """

    def __init__(self, num_envs: int, longest: int = 1) -> None:
        self._longest = longest
        self.held_W = np.zeros(num_envs, np.int64)
        # Steps for which the action is still held.
        self._left_W = np.zeros(num_envs, np.int64)

    def act(
        self, network: QNetwork, obs_WVF: NDArray[np.float32], epsilon: float, rng: np.random.Generator, device: str
    ) -> NDArray[np.int64]:
        """Return the greedy action of each world or, in a share `epsilon` of all steps, a random or held one."""
        explores_W = self.begin(epsilon, rng)
        if explores_W.all():
            return self.held_W
        with torch.inference_mode():
            greedy_W = network(torch.from_numpy(obs_WVF).to(device)).argmax(1).cpu().numpy()
        return np.where(explores_W, self.held_W, greedy_W)

    def begin(self, epsilon: float, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Begin random actions in some worlds and return in which there is one now; they are in `held_W`."""
        count = len(self.held_W)
        # Runs of m steps in the mean fill that share if, whenever nothing is held, one begins with this probability.
        begin = epsilon / (epsilon + (1 - epsilon) * (1 + self._longest) / 2)
        begins_W = (rng.random(count) < begin) & (self._left_W == 0)
        action_W = rng.integers(NUM_ACTIONS, size=count)
        length_W = rng.integers(1, self._longest, size=count, endpoint=True) if self._longest > 1 else 1
        self.held_W = np.where(begins_W, action_W, self.held_W)
        self._left_W = np.where(begins_W, length_W, self._left_W)
        explores_W = self._left_W > 0
        self._left_W = np.maximum(self._left_W - 1, 0)
        return explores_W

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs."""
        return {"held": self.held_W, "left": self._left_W}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Hold what was held."""
        self.held_W, self._left_W = state["held"], state["left"]


class Drive:
    """The worlds that are driven in, with the returns of the episodes that end in them.

    Args:
        make_worlds: gives the worlds.
        count: how many.
        seed: of the traffic.
        lanes: on roads with so many lanes the driver has a memory (:mod:`rapid.networks.memory`); None: it has none.
    """

    def __init__(self, make_worlds: MakeWorlds, count: int, seed: int, lanes: int | None = None) -> None:
        self._worlds = make_worlds(count)
        part = train_part("online")
        # Each training begins elsewhere in the set; later episodes go on with each world's own stream.
        first = stream_seed(seed, "adapt/traffic") % (len(part) - count)
        obs_WVF, _ = self._worlds.reset(seed=list(part[first : first + count]))
        self.obs_WVF: NDArray[np.float32] = np.asarray(obs_WVF, np.float32)
        self._lanes = lanes
        self.state_WS = initial_state(count, lanes) if lanes is not None else None
        self.ended_W = np.zeros(count, np.bool_)
        self._return_W = np.zeros(count)
        self._ended: list[tuple[float, bool]] = []

    def step(self, action_W: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
        """Step every world once; return what `ReplayBuffer.add` takes."""
        before_WVF = self.obs_WVF
        after_WVF, reward_W, terminated_W, truncated_W, info = self._worlds.step(action_W)
        self.obs_WVF = np.asarray(after_WVF, np.float32)
        self._return_W += reward_W
        next_WVF = self.obs_WVF
        self.ended_W = np.asarray(terminated_W | truncated_W, np.bool_)
        ended = np.flatnonzero(self.ended_W)
        if self.state_WS is not None and self._lanes is not None:
            self.state_WS = next_state(self.state_WS, action_W, self._lanes)
            self.state_WS[ended] = initial_state(len(ended), self._lanes)
        if len(ended):
            # There the observation is already the first of the next episode.
            next_WVF = self.obs_WVF.copy()
            for world in ended:
                next_WVF[world] = info["final_obs"][world]
                self._ended.append((float(self._return_W[world]), bool(terminated_W[world])))
            self._return_W[ended] = 0
        return before_WVF, action_W, reward_W, next_WVF, terminated_W, truncated_W

    def means(self) -> dict[str, float | None]:
        """Return the episodes that ended since the last call, their mean return and crash share, and forget them."""
        ended = self._ended
        self._ended = []
        if not ended:
            return {"episodes": 0, "return": None, "crash_share": None}
        returns, crashes = zip(*ended, strict=True)
        return {"episodes": len(ended), "return": float(np.mean(returns)), "crash_share": float(np.mean(crashes))}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs; call `means` first.

        A simulator without snapshots gives none; its worlds then begin new episodes on resuming.
        """
        can = hasattr(self._worlds, "snapshot")
        snapshots = [tuple(self._worlds.snapshot(world)) for world in range(len(self.obs_WVF))] if can else None
        return {"worlds": snapshots, "obs": self.obs_WVF, "returns": self._return_W, "state": self.state_WS}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put every world back where it was."""
        if state["worlds"] is None:
            return
        for world, saved in enumerate(state["worlds"]):
            kind = type(self._worlds.snapshot(world))
            self._worlds.restore(world, kind(*saved))
        self.obs_WVF, self._return_W, self.state_WS = state["obs"], state["returns"], state["state"]

    def close(self) -> None:
        """Close the worlds."""
        self._worlds.close()
