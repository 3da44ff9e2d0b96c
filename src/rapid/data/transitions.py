"""The transition: what was seen, done, earned and seen next, who chose the action and which episode it belongs to."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES

SOURCES = ("teacher", "random")
"""Who chose an action; `Transitions.source_N` holds the index."""
TEACHER, RANDOM = range(len(SOURCES))

_SHAPES: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
    "obs_NVF": ((NUM_VEHICLES, NUM_FEATURES), np.float32),
    "action_N": ((), np.int64),
    "reward_N": ((), np.float32),
    "next_obs_NVF": ((NUM_VEHICLES, NUM_FEATURES), np.float32),
    "terminated_N": ((), np.bool_),
    "truncated_N": ((), np.bool_),
    "source_N": ((), np.int8),
    "episode_N": ((), np.int64),
    "step_N": ((), np.int64),
    "spawn_seed_N": ((), np.int64),
    "probabilities_NA": ((NUM_ACTIONS,), np.float32),
}


@dataclass(frozen=True)
class Transitions:
    """N transitions as arrays; the steps of an episode need not be complete nor in order (a mixture drops some)."""

    obs_NVF: NDArray[np.float32]
    """What the driver saw, metres and m/s."""
    action_N: NDArray[np.int64]
    """What it did, an index of `scenarios.ACTIONS`."""
    reward_N: NDArray[np.float32]
    """What it earned."""
    next_obs_NVF: NDArray[np.float32]
    """What it saw next: always the real observation, also at the end of an episode."""
    terminated_N: NDArray[np.bool_]
    """The episode ended in a crash: nothing follows."""
    truncated_N: NDArray[np.bool_]
    """The clock ran out: something would have followed."""
    source_N: NDArray[np.int8]
    """Who chose the action, an index of `SOURCES`."""
    episode_N: NDArray[np.int64]
    """Number of the episode in its dataset."""
    step_N: NDArray[np.int64]
    """Decisions before this one in the episode."""
    spawn_seed_N: NDArray[np.int64]
    """Seed of the episode's traffic."""
    probabilities_NA: NDArray[np.float32]
    """The driver's probability of every action; rows of NaN where it gave none."""

    def __len__(self) -> int:
        return len(self.action_N)

    def select(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> "Transitions":
        """Return the transitions at `index`, in its order."""
        return Transitions(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    @property
    def done_N(self) -> NDArray[np.bool_]:
        """Whether the episode ended here, either way."""
        return self.terminated_N | self.truncated_N

    def follows_N(self) -> NDArray[np.bool_]:
        """Return whether row i + 1 is the next step of the same episode as row i; the last row is False."""
        same = np.zeros(len(self), np.bool_)
        same[:-1] = (
            (self.episode_N[1:] == self.episode_N[:-1])
            & (self.source_N[1:] == self.source_N[:-1])
            & (self.step_N[1:] == self.step_N[:-1] + 1)
            & ~self.done_N[:-1]
        )
        return same

    def timed(self) -> "Transitions":
        """Return the transitions with the time limit as an end like any other: for observations that tell the time."""
        return replace(self, terminated_N=self.done_N)

    def validate(self, what: str = "the transitions") -> "Transitions":
        """Return self if every array has its shape and type and every value makes sense.

        Raises:
            RapidError: the first fault, with the row where it is; `what` names the data in the message.
        """
        count = len(self.action_N)
        for name, (shape, dtype) in _SHAPES.items():
            array = getattr(self, name)
            if array.shape != (count, *shape) or array.dtype != dtype:
                raise RapidError(
                    f"In {what}, '{name}' has shape {array.shape} and type {array.dtype}; expected "
                    f"{(count, *shape)} and {np.dtype(dtype)}. The data was made for other spaces; collect it anew."
                )
        probabilities = self.probabilities_NA
        absent_N = np.isnan(probabilities).all(1)
        wrong = (
            ("a non-finite observation", ~np.isfinite(self.obs_NVF).all((1, 2))),
            ("a non-finite next observation", ~np.isfinite(self.next_obs_NVF).all((1, 2))),
            ("a non-finite reward", ~np.isfinite(self.reward_N)),
            (f"an action outside 0..{NUM_ACTIONS - 1}", (self.action_N < 0) | (self.action_N >= NUM_ACTIONS)),
            (f"a source outside 0..{len(SOURCES) - 1}", (self.source_N < 0) | (self.source_N >= len(SOURCES))),
            ("an episode both terminated and truncated", self.terminated_N & self.truncated_N),
            (
                "action probabilities that are no distribution",
                ~absent_N & ~(np.isclose(probabilities.sum(1), 1, atol=1e-3) & (probabilities >= 0).all(1)),
            ),
        )
        for fault, bad_N in wrong:
            if bad_N.any():
                raise RapidError(
                    f"In {what}, row {int(bad_N.argmax())} has {fault} ({int(bad_N.sum())} of {count} rows). "
                    "The data is damaged; collect or convert it again."
                )
        return self


def concatenate(parts: Sequence[Transitions]) -> Transitions:
    """Return all parts one after another; episode numbers are shifted so that no two parts share one."""
    shifted: list[Transitions] = []
    first = 0
    for part in parts:
        shifted.append(replace(part, episode_N=part.episode_N + first))
        first += int(part.episode_N.max()) + 1 if len(part) else 0
    names = [field.name for field in fields(Transitions)]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in shifted]) for name in names}
    return Transitions(**arrays)


def empty() -> Transitions:
    """Return no transitions."""
    arrays: dict[str, Any] = {name: np.zeros((0, *shape), dtype) for name, (shape, dtype) in _SHAPES.items()}
    return Transitions(**arrays)
