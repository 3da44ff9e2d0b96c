"""Where batches come from: offline data at random, and a ring of what was just driven. Both know n-step returns."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.data.batch import TransitionBatch, with_rows
from rapid.data.transitions import TEACHER, Transitions
from rapid.errors import RapidError
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES


def n_step(
    transitions: Transitions, steps: int, discount: float
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Return the n-step rewards, the row whose next observation ends each, and what the value there is multiplied by.

    The sum runs over up to `steps` rows and stops early at the end of an episode or where the next step of the
    episode is not the next row (a mixture by transition drops some); the weight is then discount to fewer steps.

    Returns:
        reward_N, last_N (row indices) and bootstrap_N (0 where the episode terminated).
    """
    reward_N = transitions.reward_N.astype(np.float64)
    last_N = np.arange(len(transitions))
    factor_N = np.full(len(transitions), discount)
    follows_N = transitions.follows_N()
    alive_N = np.ones(len(transitions), np.bool_)
    for _ in range(1, steps):
        alive_N &= follows_N[last_N]
        last_N = last_N + alive_N
        reward_N += np.where(alive_N, factor_N * transitions.reward_N[last_N], 0)
        factor_N = np.where(alive_N, factor_N * discount, factor_N)
    bootstrap_N = np.where(transitions.terminated_N[last_N], 0, factor_N)
    return reward_N.astype(np.float32), last_N, bootstrap_N.astype(np.float32)


def _take(store: TransitionBatch, index_B: Tensor) -> TransitionBatch:
    """Return the rows of `store` at `index_B`."""
    return TransitionBatch(
        store.obs_BVF.index_select(0, index_B),
        store.action_B.index_select(0, index_B),
        store.reward_B.index_select(0, index_B),
        store.next_obs_BVF.index_select(0, index_B),
        store.bootstrap_B.index_select(0, index_B),
        store.teacher_B.index_select(0, index_B),
        None if store.soft_BA is None else store.soft_BA.index_select(0, index_B),
    )


class OfflineSampler:
    """Uniform batches of a fixed dataset, or batches with a fixed share of teacher transitions.

    Of `vehicles` other than the data has, those that it lacks are absent, and the farthest left out.

    Raises:
        RapidError: there are no transitions, or a share is asked of a source that has none.
    """

    def __init__(
        self,
        transitions: Transitions,
        discount: float,
        steps: int = 1,
        device: str = "cpu",
        teacher_share: float | None = None,
        vehicles: int = NUM_VEHICLES,
    ) -> None:
        if not len(transitions):
            raise RapidError("The dataset is empty. Collect transitions first.")
        reward_N, last_N, bootstrap_N = n_step(transitions, steps, discount)
        soft = transitions.probabilities_NA
        teacher_N = transitions.source_N == TEACHER

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device)

        self.store = TransitionBatch(
            with_rows(tensor(transitions.obs_NVF), vehicles),
            tensor(transitions.action_N),
            tensor(reward_N),
            with_rows(tensor(transitions.next_obs_NVF[last_N]), vehicles),
            tensor(bootstrap_N),
            tensor(teacher_N),
            None if np.isnan(soft).all() else tensor(soft),
        )
        self._device = device
        # Rows and how many of every batch come from them, as a share.
        self._groups: list[tuple[NDArray[np.intp], float]] = [(np.arange(len(transitions)), 1.0)]
        if teacher_share is not None:
            wanted = ((teacher_N, teacher_share), (~teacher_N, 1 - teacher_share))
            self._groups = [(np.flatnonzero(rows_N), share) for rows_N, share in wanted if share > 0]
            if any(not len(rows) for rows, _ in self._groups):
                raise RapidError(
                    f"Batches with a share {teacher_share:g} of teacher transitions need transitions of both sources. "
                    "Mix at the level of the transition, or collect the source that is missing."
                )

    def __len__(self) -> int:
        return len(self.store.action_B)

    def sample(self, size: int, *rngs: np.random.Generator) -> TransitionBatch:
        """Return `size` transitions for each generator, in their order, drawn with replacement."""
        # The first group gets its share, rounded; the other one, if there is one, the rest.
        count = int(np.floor(self._groups[0][1] * size + 0.5))
        counts = (count, size - count)
        drawn = [
            rows[rng.integers(len(rows), size=part)]
            for rng in rngs
            for (rows, _), part in zip(self._groups, counts, strict=False)
        ]
        return _take(self.store, torch.from_numpy(np.concatenate(drawn)).to(self._device))


class ReplayBuffer:
    """A ring of the last `capacity` (n-step) transitions of W worlds that are stepped together."""

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        discount: float,
        steps: int = 1,
        device: str = "cpu",
        vehicles: int = NUM_VEHICLES,
    ) -> None:
        shape = (capacity, vehicles, NUM_FEATURES)
        self.capacity, self.device = capacity, device
        self._discount, self._steps = discount, steps
        self._store = TransitionBatch(
            torch.zeros(shape, device=device),
            torch.zeros(capacity, dtype=torch.int64, device=device),
            torch.zeros(capacity, device=device),
            torch.zeros(shape, device=device),
            torch.zeros(capacity, device=device),
            torch.zeros(capacity, dtype=torch.bool, device=device),
        )
        self._next = self._size = 0
        # Steps that still wait for later rewards, a ring for every world: the slot of step t is t modulo n.
        self._obs_KWVF = np.zeros((steps, num_envs, *shape[1:]), np.float32)
        self._action_KW = np.zeros((steps, num_envs), np.int64)
        self._reward_KW = np.zeros((steps, num_envs))
        self._age_KW = np.zeros((steps, num_envs), np.int64)
        self._slot = 0

    def __len__(self) -> int:
        return self._size

    def add(
        self,
        obs_WVF: NDArray[np.float32],
        action_W: NDArray[np.int64],
        reward_W: NDArray[np.floating[Any]],
        next_obs_WVF: NDArray[np.float32],
        terminated_W: NDArray[np.bool_],
        truncated_W: NDArray[np.bool_],
    ) -> None:
        """Add one step of every world; `next_obs_WVF` is the real next observation, also where an episode ended."""
        slot = self._slot
        self._obs_KWVF[slot], self._action_KW[slot] = obs_WVF, action_W
        self._reward_KW[slot], self._age_KW[slot] = 0, 1
        # From the oldest step to the newest. An age of 0 is an empty slot; otherwise it counts rewards summed.
        done_W = terminated_W | truncated_W
        for back in range(self._steps - 1, -1, -1):
            place = (slot - back) % self._steps
            age_W = self._age_KW[place]
            waiting_W = age_W > 0
            weight_W = self._discount ** np.maximum(age_W - 1.0, 0.0)  # an empty slot has no weight to be computed
            self._reward_KW[place] += np.where(waiting_W, weight_W * reward_W, 0)
            ready = np.flatnonzero(waiting_W & (done_W | (age_W == self._steps)))
            bootstrap = np.where(terminated_W[ready], 0, self._discount ** age_W[ready].astype(np.float64))
            self._append(
                self._obs_KWVF[place, ready],
                self._action_KW[place, ready],
                self._reward_KW[place, ready],
                next_obs_WVF[ready],
                bootstrap,
            )
            self._age_KW[place] = np.where(waiting_W, age_W + 1, 0)
            self._age_KW[place, ready] = 0
        self._slot = (slot + 1) % self._steps

    def _append(self, *columns: NDArray[Any]) -> None:
        """Write rows at the ring's head, over the oldest."""
        count = len(columns[0])
        if not count:
            return
        index = torch.from_numpy((self._next + np.arange(count)) % self.capacity)
        for array, rows in zip(self._store, columns, strict=False):
            assert array is not None
            array[index] = torch.from_numpy(rows).to(array)
        self._next = (self._next + count) % self.capacity
        self._size = min(self._size + count, self.capacity)

    def sample(self, size: int, rng: np.random.Generator) -> TransitionBatch:
        """Return `size` transitions, drawn uniformly with replacement.

        Raises:
            RapidError: the buffer is empty.
        """
        if not self._size:
            raise RapidError("The replay buffer is empty: no step was complete yet. Raise `learning_starts`.")
        return _take(self._store, torch.from_numpy(rng.integers(self._size, size=size)).to(self.device))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs; only the filled part of the ring."""
        return {
            "store": [array[: self._size] for array in self._store if array is not None],
            "next": self._next,
            "pending": [self._obs_KWVF, self._action_KW, self._reward_KW, self._age_KW],
            "slot": self._slot,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Become as the buffer was whose `state_dict` this is.

        Raises:
            RapidError: it had another capacity, number of worlds or n.
        """
        pending = (self._obs_KWVF, self._action_KW, self._reward_KW, self._age_KW)
        size = len(state["store"][0])
        if size > self.capacity or any(
            mine.shape != old.shape for mine, old in zip(pending, state["pending"], strict=True)
        ):
            raise RapidError(
                "The checkpoint's replay buffer has another size, number of worlds or n. Resume with the settings that "
                "the training began with."
            )
        for mine, old in zip(pending, state["pending"], strict=True):
            mine[...] = old
        for mine, old in zip(self._store, state["store"], strict=False):
            assert mine is not None
            mine[:size] = old
        self._next, self._size, self._slot = state["next"], size, state["slot"]


def join_batches(first: TransitionBatch, second: TransitionBatch) -> TransitionBatch:
    """Return two batches as one; where only one has soft labels, the other's rows are NaN."""
    soft: Tensor | None = None
    if first.soft_BA is not None or second.soft_BA is not None:
        soft = torch.cat([_soft_labels(first), _soft_labels(second)])
    return TransitionBatch(
        torch.cat([first.obs_BVF, second.obs_BVF]),
        torch.cat([first.action_B, second.action_B]),
        torch.cat([first.reward_B, second.reward_B]),
        torch.cat([first.next_obs_BVF, second.next_obs_BVF]),
        torch.cat([first.bootstrap_B, second.bootstrap_B]),
        torch.cat([first.teacher_B, second.teacher_B]),
        soft,
    )


def _soft_labels(batch: TransitionBatch) -> Tensor:
    if batch.soft_BA is not None:
        return batch.soft_BA
    return batch.reward_B.new_full((len(batch.reward_B), NUM_ACTIONS), torch.nan)
