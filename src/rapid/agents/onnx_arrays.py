"""Formulas as ONNX nodes: arrays that note what is done to them instead of doing it.

A formula that is written for NumPy arrays and torch tensors, such as the interval filter's (:mod:`rapid.safety`), is
called once with these and leaves the nodes that compute it. So there is one text of it.
"""

from typing import Any, cast

import numpy as np


class Arrays:
    """What stands for the module `numpy` or `torch`; `graph` is a :class:`rapid.agents.onnx_graph.Graph`."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph

    def of(self, name: str) -> "Noted":
        """Return the array of a node's output."""
        return Noted(self, name)

    def node(self, kind: str, *inputs: Any, **attributes: Any) -> "Noted":
        """Return what a new node makes of arrays and numbers."""
        names = [item.name if isinstance(item, Noted) else item for item in inputs]
        return Noted(self, self.graph.node(kind, *names, **attributes))

    def where(self, condition: "Noted", this: Any, that: Any) -> "Noted":
        """Return `this` where the condition holds, else `that`."""
        return self.node("Where", condition, this, that)

    def minimum(self, left: Any, right: Any) -> "Noted":
        """Return the smaller of each two."""
        return self.node("Min", left, right)

    def maximum(self, left: Any, right: Any) -> "Noted":
        """Return the larger of each two."""
        return self.node("Max", left, right)

    def sqrt(self, value: "Noted") -> "Noted":
        """Return the square root."""
        return self.node("Sqrt", value)

    def floor(self, value: "Noted") -> "Noted":
        """Return the next whole number below."""
        return self.node("Floor", value)

    def amin(self, value: "Noted", axis: int) -> "Noted":
        """Return the smallest along an axis."""
        return self.node("ReduceMin", value, axes=[axis], keepdims=0)

    def amax(self, value: "Noted", axis: int) -> "Noted":
        """Return the largest along an axis."""
        return self.node("ReduceMax", value, axes=[axis], keepdims=0)

    def full_like(self, value: "Noted", number: float) -> "Noted":
        """Return an array of this shape that is `number` everywhere."""
        return self.node("Where", self.node("Equal", value, value), number, number)

    def stack(self, values: list["Noted"], axis: int) -> "Noted":
        """Return the arrays side by side along a new axis."""
        axes = self.graph.constant([axis], np.int64)
        return self.node("Concat", *(self.node("Unsqueeze", value, axes) for value in values), axis=axis)


class Noted:
    """An array that notes as a node what is done to it; `name` is that of the node's output."""

    def __init__(self, arrays: Arrays, name: str) -> None:
        self.arrays, self.name = arrays, name

    def __add__(self, other: Any) -> "Noted":
        return self.arrays.node("Add", self, other)

    def __radd__(self, other: Any) -> "Noted":
        return self.arrays.node("Add", other, self)

    def __sub__(self, other: Any) -> "Noted":
        return self.arrays.node("Sub", self, other)

    def __mul__(self, other: Any) -> "Noted":
        return self.arrays.node("Mul", self, other)

    def __rmul__(self, other: Any) -> "Noted":
        return self.arrays.node("Mul", other, self)

    def __truediv__(self, other: Any) -> "Noted":
        return self.arrays.node("Div", self, other)

    def __neg__(self) -> "Noted":
        return self.arrays.node("Neg", self)

    def __abs__(self) -> "Noted":
        return self.arrays.node("Abs", self)

    def __gt__(self, other: Any) -> "Noted":
        return self.arrays.node("Greater", self, other)

    def __lt__(self, other: Any) -> "Noted":
        return self.arrays.node("Less", self, other)

    def __ge__(self, other: Any) -> "Noted":
        return self.arrays.node("GreaterOrEqual", self, other)

    def __and__(self, other: Any) -> "Noted":
        return self.arrays.node("And", self, other)

    def __or__(self, other: Any) -> "Noted":
        return self.arrays.node("Or", self, other)

    def clip(self, min: float | None = None, max: float | None = None) -> "Noted":
        """Return the values limited to [min, max]."""
        found = self if min is None else self.arrays.node("Max", self, float(min))
        return found if max is None else self.arrays.node("Min", found, float(max))

    def all(self, axis: int) -> "Noted":
        """Return whether all hold along an axis."""
        as_numbers = self.arrays.where(self, 1.0, 0.0)
        return self.arrays.node("ReduceMin", as_numbers, axes=[axis], keepdims=0) > 0.5

    def __getitem__(self, index: Any) -> "Noted":
        """Return a part: slices of step 1, single entries, ``...`` in front of the last axis, and None behind all."""
        entries = cast("tuple[Any, ...]", index if isinstance(index, tuple) else (index,))
        found, axis, from_behind = self, 0, False
        graph = self.arrays.graph
        for entry in entries:
            if entry is Ellipsis:
                from_behind = True
            elif entry is None:
                found = self.arrays.node("Unsqueeze", found, graph.constant([axis], np.int64))
                axis += 1
            elif isinstance(entry, int):
                place = graph.constant(entry, np.int64)
                found = self.arrays.node("Gather", found, place, axis=-1 if from_behind else axis)
            else:
                if entry != slice(None):
                    end = np.iinfo(np.int64).max if entry.stop is None else entry.stop
                    found = Noted(self.arrays, graph.cut(found.name, entry.start or 0, end, axis))
                axis += 1
        return found
