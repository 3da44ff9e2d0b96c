"""Bounds of numbers, declared where a setting is: `steps: Count = 10`, checked by walking the tree of settings."""

import dataclasses
import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

from rapid.errors import RapidError


@dataclass(frozen=True)
class Bounds:
    """The numbers from `low` to `high`; an end that is `open` is not among them."""

    low: float
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False

    def hold(self, number: float) -> bool:
        """Whether `number` is finite and within."""
        above = number > self.low if self.open_low else number >= self.low
        below = number < self.high if self.open_high else number <= self.high
        return math.isfinite(number) and above and below

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"{'above' if self.open_low else 'at least'} {self.low:g}"
        if not (self.open_low or self.open_high):
            return f"between {_whole(self.low)} and {_whole(self.high)}"
        return f"in {'(' if self.open_low else '['}{self.low:g}, {self.high:g}{')' if self.open_high else ']'}"


def _whole(number: float) -> str:
    return str(int(number)) if number == int(number) else f"{number:g}"


Count = Annotated[int, Bounds(0)]
"""How many; perhaps none."""
Positive = Annotated[int, Bounds(1)]
"""How many; at least one."""
Width = Annotated[int, Bounds(1, 16_384)]
"""Numbers in a row of a network."""
Depth = Annotated[int, Bounds(1, 256)]
"""Layers or other parts of a network."""
Side = Annotated[int, Bounds(1, 100_000)]
"""How many are under way side by side in this process, each with memory of its own."""
SideOrNone = Annotated[int, Bounds(0, 100_000)]
"""The same; perhaps none."""
Rows = Annotated[int, Bounds(1, 10_000_000)]
"""Transitions that are held in memory, at about 600 bytes each."""
RowsOrNone = Annotated[int, Bounds(0, 10_000_000)]
"""The same; perhaps none."""
Workers = Annotated[int, Bounds(1, 1000)]
"""Processes or threads."""
Amount = Annotated[float, Bounds(0)]
"""How much; perhaps nothing."""
AboveZero = Annotated[float, Bounds(0, open_low=True)]
"""How much; more than nothing."""
Share = Annotated[float, Bounds(0, 1)]
"""A share or a probability."""
ShareBelowOne = Annotated[float, Bounds(0, 1, open_high=True)]
"""A share, not the whole."""
ShareAboveZero = Annotated[float, Bounds(0, 1, open_low=True)]
"""A share, not nothing."""
Seed = Annotated[int, Bounds(0, 2**32 - 1)]
"""A seed from which random streams are derived."""


def numbers(settings: Any, where: str = "") -> Iterator[tuple[str, float, Bounds | None]]:
    """Walk a tree of dataclasses and yield (dotted name, value, bounds or None) of every number in it."""
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for item in dataclasses.fields(settings):
        value, name = getattr(settings, item.name), f"{where}{item.name}"
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{name}.")
            continue
        bounds = _bounds(hints[item.name])
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not isinstance(number, bool):
                yield name, number, bounds


def _bounds(hint: Any) -> Bounds | None:
    """The bounds in `Annotated[int, Bounds(...)]`, or in `tuple[Annotated[...], ...]`."""
    for part in (hint, *typing.get_args(hint)[:1]):
        found = next((each for each in getattr(part, "__metadata__", ()) if isinstance(each, Bounds)), None)
        if found is not None:
            return found
    return None


def check_bounds(settings: Any, where: str = "") -> None:
    """Raise RapidError for the first number of the tree that is out of its bounds, naming both."""
    for name, number, bounds in numbers(settings, where):
        if not math.isfinite(number):
            raise RapidError(f"Setting '{name}' is {number}, but must be a finite number.")
        if bounds is not None and not bounds.hold(number):
            raise RapidError(f"Setting '{name}' is {number}, but must be {bounds}.")
