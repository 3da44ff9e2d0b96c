"""The worlds as arrays: B worlds of N vehicles, vehicle 0 is the ego, in the order in which highway-env lists them.

One world is the slice ``cars[i], tags[i], world[i], stream[i]``; every kernel that works on one world takes these
slices. To copy a world, copy the four slices.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.simulator.settings import Settings
from rapid.simulator.stream import STREAM_WORDS

# Rows of `cars` (float64): position [m], heading [rad], speed [m/s], direction and velocity (both follow from heading
# and speed and are kept because neighbours read them), the driver (speed it wants [m/s], time since it last considered
# a lane change [s], IDM exponent), the command (steering [rad], acceleration [m/s²]) and the displacement that
# a predicted collision applies in the next frame [m].
X, Y, HEADING, SPEED, COS, SIN, VX, VY, TARGET_SPEED, TIMER, EXPONENT, STEERING, ACCELERATION, PUSH_X, PUSH_Y = range(
    15
)
CAR_ROWS = 15

# Rows of `tags` (int64): lane, lane aimed at, crashed, push pending, vehicle at each rank when sorted by x, rank of
# each vehicle, and, within a frame, the vehicle next ahead on the lane to the left, on the own, and to the right.
LANE, TARGET_LANE, CRASHED, PUSHED, ORDER, RANK, AHEAD_LEFT, AHEAD, AHEAD_RIGHT = range(9)
TAG_ROWS = 9

# Entries of `world` (float64): time since reset [s], the ego's x at reset [m], index of the ego's target speed, and
# whether the episode has ended.
TIME, START_X, SPEED_INDEX, TERMINATED, TRUNCATED = range(5)
WORLD_ENTRIES = 5


class State(NamedTuple):
    """B worlds."""

    cars: NDArray[np.float64]
    """(B, CAR_ROWS, N)."""
    tags: NDArray[np.int64]
    """(B, TAG_ROWS, N)."""
    world: NDArray[np.float64]
    """(B, WORLD_ENTRIES)."""
    stream: NDArray[np.uint64]
    """(B, STREAM_WORDS): one random stream per world."""

    def copy(self) -> "State":
        """Return a copy that shares no memory."""
        return State(self.cars.copy(), self.tags.copy(), self.world.copy(), self.stream.copy())

    def take(self, worlds: NDArray[np.integer] | list[int]) -> "State":
        """Return a copy of the worlds at the given indices, in that order."""
        return State(self.cars[worlds], self.tags[worlds], self.world[worlds], self.stream[worlds])

    def part(self, first: int, end: int) -> "State":
        """Return worlds `first` to `end`, in the same memory."""
        return State(self.cars[first:end], self.tags[first:end], self.world[first:end], self.stream[first:end])

    @property
    def bytes_per_world(self) -> int:
        """Memory that one world takes."""
        return sum(array[0].nbytes for array in self)


class Snapshot(NamedTuple):
    """One world at one moment: the four slices of :class:`State`, copied."""

    cars: NDArray[np.float64]
    tags: NDArray[np.int64]
    world: NDArray[np.float64]
    stream: NDArray[np.uint64]


def allocate(worlds: int, settings: Settings) -> State:
    """Return memory for `worlds` worlds; spawn each before use."""
    vehicles = settings.traffic + 1
    return State(
        np.zeros((worlds, CAR_ROWS, vehicles)),
        np.zeros((worlds, TAG_ROWS, vehicles), np.int64),
        np.zeros((worlds, WORLD_ENTRIES)),
        np.zeros((worlds, STREAM_WORDS), np.uint64),
    )


def snapshot(state: State, index: int) -> Snapshot:
    """Return a copy of one world."""
    return Snapshot(*(array[index].copy() for array in state))


def restore(state: State, index: int, snap: Snapshot) -> None:
    """Put a world back as it was when the snapshot was taken.

    Raises:
        RapidError: the snapshot comes from a simulator with another number of vehicles.
    """
    shapes = tuple(array.shape[1:] for array in state), tuple(array.shape for array in snap)
    if shapes[0] != shapes[1]:
        raise RapidError(
            f"The snapshot holds a world of {snap.cars.shape[-1]} vehicles, this simulator has {state.cars.shape[-1]}. "
            "Restore it into an environment of the scenario that it was taken from."
        )
    for array, saved in zip(state, snap, strict=True):
        array[index] = saved
