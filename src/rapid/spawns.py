"""Named, disjoint sets of spawn seeds: what a policy was made from is never what it is measured on.

A spawn seed fixes the traffic of one episode. All are below one million: 800,000 to make data and train (`train`),
100,000 to choose settings and draw learning curves (`tune`), 100,000 to measure (`test`).
"""

from typing import Literal, get_args

from rapid.errors import RapidError, did_you_mean

SpawnSet = Literal["train", "tune", "test"]
TrainPart = Literal["teacher", "random", "online"]

_SETS = {"train": range(0, 800_000), "tune": range(800_000, 900_000), "test": range(900_000, 1_000_000)}
# The two collections and the online phase meet different traffic, so no comparison is paired by chance.
_PARTS = {"teacher": range(0, 200_000), "random": range(200_000, 400_000), "online": range(400_000, 800_000)}


def spawn_seeds(name: SpawnSet, count: int, start: int = 0) -> list[int]:
    """Return `count` seeds of the set `name`, leaving out its first `start`.

    Raises:
        RapidError: there is no such set, or it has fewer seeds.
    """
    if name not in _SETS:
        raise RapidError(
            f"Unknown set of spawn seeds '{name}'{did_you_mean(name, _SETS)} "
            f"Choose one of {', '.join(get_args(SpawnSet))}."
        )
    seeds = _SETS[name]
    if start < 0 or count < 0 or start + count > len(seeds):
        raise RapidError(
            f"The set '{name}' has {len(seeds)} spawn seeds; seeds {start} to {start + count} were asked for. "
            "Ask for fewer."
        )
    return list(seeds[start : start + count])


def train_part(name: TrainPart) -> range:
    """Return the part of the set `train` that belongs to the teacher's data, the random data or online training."""
    return _PARTS[name]
