"""Affine forms: where the values of a layer lie, with how they hang together through the input.

A form is c + G e + r: a centre, a linear part in the input's errors e, each between -1 and 1, and an error that knows
nothing, within +-r (zonotopes with a box: Singh et al., 2018, "Fast and Effective Robustness Certification"; through
attention: Bonaert et al., 2021). Whatever is linear is exact, and what the rest loses is of second order in the size
of the input's box. All is sound for real numbers and computed in double precision.

Shapes: E errors of the input in front of G; any other axes, the batch first.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn


class Form(NamedTuple):
    """Values that depend on the input's errors."""

    centre: Tensor
    linear: Tensor
    """(E, ...)"""
    rest: Tensor
    """At least 0."""

    @property
    def radius(self) -> Tensor:
        """How far the values can be from the centre."""
        return self.linear.abs().sum(0) + self.rest

    @property
    def low(self) -> Tensor:
        """The least that the values can be."""
        return self.centre - self.radius

    @property
    def high(self) -> Tensor:
        """The most that the values can be."""
        return self.centre + self.radius

    def named(self) -> "Form":
        """Return the same form with the rest of each entry as an error of its own, so that it can cancel later on.

        The errors are per entry of the last two axes, and new: forms that are joined afterwards must have been made
        from one with as many (:meth:`padded`), lest two take the same error for different things.
        """
        size, entries = self.rest.shape, self.rest.shape[-2] * self.rest.shape[-1]
        each = torch.eye(entries, dtype=self.rest.dtype).view(entries, *[1] * (len(size) - 2), *size[-2:])
        return Form(self.centre, torch.cat([self.linear, each * self.rest]), torch.zeros_like(self.rest))

    def padded(self, errors: int) -> "Form":
        """Return the same form, which knows of so many errors."""
        missing = errors - len(self.linear)
        if missing <= 0:
            return self
        return self._replace(linear=torch.cat([self.linear, self.linear.new_zeros(missing, *self.centre.shape)]))

    def map(self, change: Callable[[Tensor], Tensor]) -> "Form":
        """Return the form with its entries moved: `change` is linear, adds nothing, and counts axes from behind."""
        return Form(change(self.centre), change(self.linear), change(self.rest))

    def plus(self, other: "Form | Tensor | float") -> "Form":
        """Return the sum."""
        if isinstance(other, Form):
            linear = self.padded(len(other.linear)).linear + other.padded(len(self.linear)).linear
            return Form(self.centre + other.centre, linear, self.rest + other.rest)
        return Form(self.centre + other, self.linear, self.rest)

    def minus(self, other: "Form") -> "Form":
        """Return the difference."""
        return Form(self.centre - other.centre, self.linear - other.linear, self.rest + other.rest)

    def scaled(self, factor: Tensor | float) -> "Form":
        """Return the form times numbers."""
        size = factor.abs() if isinstance(factor, Tensor) else abs(factor)
        return Form(self.centre * factor, self.linear * factor, self.rest * size)

    def times(self, other: "Form") -> "Form":
        """Return the product: what is of second order becomes part of the rest."""
        mine, theirs = self.padded(len(other.linear)).linear, other.padded(len(self.linear)).linear
        return Form(
            self.centre * other.centre,
            self.centre * theirs + mine * other.centre,
            self.centre.abs() * other.rest + self.rest * other.centre.abs() + self.radius * other.radius,
        )

    def summed(self, axis: int) -> "Form":
        """Return the sum along an axis, counted from behind."""
        return self.map(lambda part: part.sum(axis))

    def where(self, condition: Tensor, other: float) -> "Form":
        """Return this where the condition holds, else a number."""
        return Form(
            torch.where(condition, self.centre, other),
            torch.where(condition, self.linear, 0.0),
            torch.where(condition, self.rest, 0.0),
        )

    def curved(self, function: Callable[[Tensor], Tensor], least: Tensor, most: Tensor) -> "Form":
        """Return a function of the form whose slope lies between `least` and `most` wherever the values can be."""
        slope, off = (least + most) / 2, (most - least) / 2
        return Form(function(self.centre), self.linear * slope, self.rest * slope.abs() + off * self.radius)

    def relu(self) -> "Form":
        """Return max(0, x): where x can be both, what lies between the chord and its parallel through 0."""
        low, high = self.low, self.high
        crosses = (low < 0) & (high > 0)
        slope = torch.where(crosses, high / (high - low).clamp_min(1e-300), (low >= 0).to(low))
        off = torch.where(crosses, -low * slope / 2, 0.0)
        return Form(self.centre * slope + off, self.linear * slope, self.rest * slope + off)

    def exp(self) -> "Form":
        """Return e to this."""
        return self.curved(torch.exp, self.low.exp(), self.high.exp())


def between(low: Tensor, high: Tensor, errors: int) -> Form:
    """Return values between two others of which no more is known."""
    middle = (low + high) / 2
    return Form(middle, torch.zeros(errors, *middle.shape, dtype=middle.dtype), (high - low) / 2)


def joined(forms: list[Form], axis: int) -> Form:
    """Return the forms next to each other along an axis, counted from behind."""
    return Form(*(torch.cat(parts, axis) for parts in zip(*forms, strict=True)))


def affine(form: Form, weight: Tensor, bias: Tensor | float = 0.0) -> Form:
    """Return x W' + b."""
    return Form(form.centre @ weight.T + bias, form.linear @ weight.T, form.rest @ weight.abs().T)


def linear(form: Form, layer: nn.Linear) -> Form:
    """Return the output of a linear layer."""
    return affine(form, layer.weight, layer.bias)


def layer_norm(form: Form, layer: nn.LayerNorm) -> Form:
    """Return the output of a LayerNorm; no entry of D that is normalised is larger than sqrt(D - 1)."""
    size = form.centre.shape[-1]
    centred = affine(form, torch.eye(size, dtype=form.centre.dtype) - 1 / size)
    # x² - c² = 2 c (x - c) + (x - c)², and the last is between 0 and radius².
    half = centred.radius.square() / 2
    rest = 2 * centred.centre.abs() * centred.rest + half
    squares = Form(centred.centre.square() + half, 2 * centred.centre * centred.linear, rest)
    spread = squares.map(lambda part: part.mean(-1, keepdim=True)).plus(layer.eps)
    # Never less than epsilon, whatever the form, which does not know what a square is, allows.
    least = spread.low.clamp_min(layer.eps)
    slopes = -0.5 * least.pow(-1.5), -0.5 * spread.high.pow(-1.5)
    whole = between(spread.high.rsqrt(), least.rsqrt(), len(form.linear))
    normed = centred.times(_tighter(spread.curved(torch.rsqrt, *slopes), whole))
    most = torch.full_like(normed.rest, (size - 1) ** 0.5)
    normed = _tighter(normed, between(-most, most, len(form.linear)))
    return normed.scaled(layer.weight).plus(layer.bias)


def _tighter(one: Form, other: Form) -> Form:
    """Return of two forms for the same values the one that is worth more, entry by entry.

    `one` knows how its values hang together and `other` does not, so it must be far tighter to be taken.
    """
    better = one.radius <= 2 * other.radius
    return Form(*(torch.where(better, mine, theirs) for mine, theirs in zip(one, other, strict=True)))


def products(rows: Form, columns: Form) -> Form:
    """Return the matrix product of (B, M, D) and (B, N, D)', entry by entry (B, M, N)."""
    turned = columns.map(lambda part: part.transpose(-1, -2))
    return Form(
        rows.centre @ turned.centre,
        rows.centre @ turned.linear + rows.linear @ turned.centre,
        rows.centre.abs() @ turned.rest + rows.rest @ turned.centre.abs() + rows.radius @ turned.radius,
    )


def softmax(scores: Form, seen: Tensor) -> Form:
    """Return the softmax over the last axis of scores (..., N) among the entries that are `seen` (..., N), else 0.

    Each share is 1 / sum_j exp(s_j - s_i), of differences, in which what all scores have in common is gone.
    """
    differences = scores.map(lambda part: part[..., None, :]).minus(scores.map(lambda part: part[..., None]))
    differences = differences.where(seen[..., None, :] & seen[..., :, None], -torch.inf)
    found = _exponents(differences)
    total = found.summed(-1).where(seen, 1.0)
    least, most = total.low.nan_to_num(1.0).clamp_min(1.0), total.high.nan_to_num(torch.inf)  # one term is e to 0
    shares = total.curved(torch.reciprocal, -least.square().reciprocal(), -most.square().reciprocal())
    return _tighter(shares, between(1 / most, 1 / least, len(total.linear))).where(seen, 0.0)


def averaged(shares: Form, values: Form) -> Form:
    """Return means of values (B, N, D) weighted by shares (B, M, N) that sum to 1: (B, M, D)."""
    # What is common to all values may be taken off before and put back, which leaves less to be uncertain about.
    common = values.centre.mean(-2, keepdim=True)
    return products(shares, values.plus(-common).map(lambda part: part.transpose(-1, -2))).plus(common)


def _exponents(form: Form) -> Form:
    finite = form.centre > -torch.inf
    return form.where(finite, 0.0).exp().where(finite, 0.0)
