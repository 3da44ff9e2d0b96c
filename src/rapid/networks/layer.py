# pyright: basic, reportCallIssue=false
# Numba's arrays have types of their own, which pyright does not know, and passes the first argument of an intrinsic.
"""One whole layer of a transformer, compiled: for a CPU, where torch is slow at layers as small as these.

Torch computes a layer as some twenty operations, and the gradient as sixty; each reads and writes all tokens, which do
not stay in the processor's nearer caches, and the products take less than half of the time. Here the layer is computed
for some 128 tokens at a time, from the first norm to the last sum. The results are those of torch but for rounding,
and the same on every call.

Shapes: B batch, T tokens, H heads, D width, F width of the feed-forward network, R = B*T rows, and Q queries of a
sample: T, or 1 where only its first token is wanted; so there are B*Q rows of results. Kernels take matrices as
:mod:`rapid.networks.lanes` does. There `parameters` are all of them one behind another, and `kept` is what the gradient
needs, one kind behind another.
"""

import weakref
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch._utils import _flatten_dense_tensors
from torch.autograd.function import once_differentiable
from torch.nn import functional

from rapid.networks.lanes import (
    LANES,
    add_columns,
    load,
    multiply,
    rectified,
    store,
    transpose,
    where_positive,
)
from rapid.networks.layer_kernels import add_bias, attend, norm, norm_back, unattend
from rapid.simulator.compile import kernel

ROWS = 128
"""Tokens that are computed together: their numbers stay in a processor's second cache."""


def can_compute(rows: Tensor, length: int, heads: int, weight: Tensor) -> bool:
    """Whether :func:`compute` is made for samples of so many of these tokens (B*T, D), and such a layer.

    `weight` is that of the first layer of its feed-forward network (F, D).
    """
    fits = length <= LANES and rows.shape[1] % (LANES * heads) == 0 and len(weight) % LANES == 0
    return fits and is_plain(rows) and is_plain(weight)


def is_plain(rows: Tensor) -> bool:
    """Whether it is a tensor of 32 bits a number on a CPU, and not within a transform as of `torch.func`."""
    return rows.device.type == "cpu" and rows.dtype == torch.float32 and not is_functorch_wrapped_tensor(rows)


def compute(
    rows: Tensor, length: int, heads: int, mask_B11T: Tensor | None, first_only: bool, parameters: Sequence[Tensor]
) -> Tensor:
    """Return the rows after a layer (B*T, D), or of each sample the first (B, D); it can be differentiated once.

    Args:
        rows: the tokens (B*T, D).
        length: T.
        heads: H.
        mask_B11T: 0 where a key may be read, -inf where not.
        first_only: whether only each sample's first token is wanted.
        parameters: weight and bias of the norm before the attention; of query, key and value; of what is made of the
            attention; of the second norm; of both layers of the feed-forward network; and, if there is one, of a norm
            that closes the transformer.
    """
    batch = len(rows) // length
    if mask_B11T is None:
        read_BT = torch.ones(batch, length, dtype=torch.bool)
    else:
        read_BT = (mask_B11T[:, 0, 0] == 0).expand(batch, length).contiguous()
    sizes = (1 if first_only else length, heads, rows.shape[1], len(parameters[8]), len(parameters) > 12)
    if torch.is_grad_enabled():
        return _Layer.apply(rows, read_BT, sizes, *parameters)
    return _computed(rows, read_BT, sizes, parameters, False)[0]


def _computed(
    rows: Tensor, read_BT: Tensor, sizes: tuple[int, ...], parameters: Sequence[Tensor], keeps: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows after the layer, all parameters one behind another, and what the gradient needs of the rest."""
    joined = _flatten_dense_tensors(parameters)
    (batch, length), queries, width = read_BT.shape, sizes[0], sizes[2]
    # Without a gradient, room for the tokens that are computed together.
    samples = batch if keeps else min(batch, _together(length))
    kept = _room(_kept(samples, length, *sizes[:4])[-1])
    out = joined.new_empty(batch * queries * width)
    _forward(*(each.numpy() for each in (_flat(rows), read_BT, joined.detach(), kept, out)), *sizes, keeps)
    return out.view(-1, width), joined, kept


def _room(size: int) -> Tensor:
    """Return memory for so many numbers, which may have been used before; when no tensor needs it, it is again.

    The operating system clears the pages of what it gives out, which takes a tenth as long as the layer.
    """
    try:
        held = _spare.pop()
    except IndexError:
        held = np.empty(size, np.float32)
    if len(held) < size:
        held = np.empty(size, np.float32)
    lent = held[:size]
    if held.nbytes <= MOST_SPARE:
        weakref.finalize(lent, _spare.append, held).atexit = False
    return torch.from_numpy(lent)


MOST_SPARE = 1 << 25
"""Bytes of the largest memory that is held for the next call: some 2,000 samples of the usual layer."""
_spare: deque[NDArray[np.float32]] = deque(maxlen=4)
"""Memory that no tensor needs; taking and giving back are safe from several threads."""


def _flat(rows: Tensor) -> Tensor:
    # What is expanded, such as the gradient of a sum, is no row of numbers in memory.
    return rows.detach().reshape(-1).contiguous()


class _Layer(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, read_BT: Tensor, sizes: tuple[int, ...], *parameters: Tensor) -> Tensor:
        out, joined, kept = _computed(rows, read_BT, sizes, parameters, any(ctx.needs_input_grad))
        ctx.save_for_backward(rows, read_BT, joined, kept)
        ctx.sizes, ctx.shapes = sizes, [each.shape for each in parameters]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        rows, read_BT, joined, kept = ctx.saved_tensors
        learns, found = any(ctx.needs_input_grad[3:]), joined.new_empty(rows.shape)
        learned = torch.zeros_like(joined) if learns else joined[:0]
        given = (_flat(rows), read_BT, joined, kept, _flat(gradients[0]), found.view(-1), learned)
        _backward(*(each.numpy() for each in given), *ctx.sizes, learns)
        if not learns:
            return found, None, None, *(None for _ in ctx.shapes)
        parts = zip(learned.split([shape.numel() for shape in ctx.shapes]), ctx.shapes, strict=True)
        return found, None, None, *(part if len(shape) == 1 else part.view(shape) for part, shape in parts)


def project(rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return what a linear layer makes of rows of a few features; the gradient of its weight is faster than torch's.

    Torch asks for a product whose result has as few columns as there are features. MKL takes up to eight times as long
    for it as for the transpose.
    """
    return _Projection.apply(rows, weight, bias) if torch.is_grad_enabled() else functional.linear(rows, weight, bias)


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weight)
        return functional.linear(rows, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        rows, weight = ctx.saved_tensors
        gradient = gradients[0].flatten(0, -2)
        back = (gradient @ weight).view(rows.shape) if ctx.needs_input_grad[0] else None
        if not any(ctx.needs_input_grad[1:]):
            return back, None, None
        return back, (rows.flatten(0, -2).T @ gradient).T.contiguous(), gradient.sum(0)


@kernel
def _together(length):
    """Return how many samples are computed together; in fours, as the products take rows."""
    return max(4, ROWS // length // 4 * 4)


@kernel
def _parameters(width, inner):
    """Return where each matrix and each later norm begins; its bias stands behind it."""
    read = 2 * width
    give = read + 3 * width * (width + 1)
    norm = give + width * (width + 1)
    into = norm + 2 * width
    back = into + inner * (width + 1)
    return read, give, norm, into, back, back + width * (inner + 1)


@kernel
def _kept(samples, length, queries, heads, width, inner):
    """Return where each part of what is kept begins, and the end.

    These are query, key and value; the shares of the attention; what is attended to; its sum with the tokens; the
    hidden units; the sum after the feed-forward network; and for each of three norms means and 1/deviations.
    """
    rows, results = samples * length, samples * queries
    share = rows * 3 * width
    attended = share + rows * heads * LANES
    between = attended + results * width
    hidden = between + results * width
    after = hidden + results * inner
    first = after + results * width
    second = first + rows * 2
    last = second + results * 2
    return 0, share, attended, between, hidden, after, first, second, last, last + results * 2


@kernel
def _forward(rows, read_BT, parameters, kept, out, queries, heads, width, inner, closes, keeps):
    """Write the rows after the layer and, for the gradient, what it needs."""
    batch, length = read_BT.shape
    together, step, wide = _together(length), length // queries, 3 * width
    read_p, give_p, norm_p, into_p, back_p, close_p = _parameters(width, inner)
    triple_k, share_k, attended_k, between_k, hidden_k, after_k, first_k, second_k, last_k, _ = _kept(
        batch if keeps else min(batch, together), length, queries, heads, width, inner
    )
    turned = np.empty(close_p, np.float32)
    transpose(turned, read_p, wide, parameters, read_p, width, wide, width)
    transpose(turned, give_p, width, parameters, give_p, width, width, width)
    transpose(turned, into_p, inner, parameters, into_p, width, inner, width)
    transpose(turned, back_p, width, parameters, back_p, inner, width, inner)
    normed = np.empty(together * length * width, np.float32)
    for sample in range(0, batch, together):
        samples = min(together, batch - sample)
        many, results, row, result = samples * length, samples * queries, sample * length, sample * queries
        row_k, result_k = (row, result) if keeps else (0, 0)
        triple, share, attended = (
            triple_k + row_k * wide,
            share_k + row_k * heads * LANES,
            attended_k + result_k * width,
        )
        between, hidden = between_k + result_k * width, hidden_k + result_k * inner

        norm(normed, 0, rows, row * width, many, width, parameters, 0, kept, first_k + row_k * 2)
        bias = read_p + wide * width
        multiply(kept, triple, step * wide, parameters, bias, 0, normed, 0, step * width, 1, turned, read_p, wide,
                 results, width, width)  # fmt: skip
        multiply(kept, triple + width, wide, parameters, bias + width, 0, normed, 0, width, 1, turned, read_p + width,
                 wide, many, 2 * width, width)  # fmt: skip
        attend(kept, triple, kept, share, kept, attended, read_BT, sample, samples, queries, heads, width)
        add_bias(kept, between, rows, row * width, step * width, parameters, give_p + width * width, results, width)
        multiply(kept, between, width, kept, between, width, kept, attended, width, 1, turned, give_p, width,
                 results, width, width)  # fmt: skip

        norm(normed, 0, kept, between, results, width, parameters, norm_p, kept, second_k + result_k * 2)
        multiply(kept, hidden, inner, parameters, into_p + width * inner, 0, normed, 0, width, 1, turned, into_p, inner,
                 results, inner, width)  # fmt: skip
        for at in range(hidden, hidden + results * inner, LANES):
            store(kept, at, rectified(load(kept, at)))
        after, after_at = (kept, after_k + result_k * width) if closes else (out, result * width)
        add_bias(after, after_at, kept, between, width, parameters, back_p + width * inner, results, width)
        multiply(after, after_at, width, after, after_at, width, kept, hidden, inner, 1, turned, back_p, width,
                 results, width, inner)  # fmt: skip
        if closes:
            norm(out, result * width, kept, after_at, results, width, parameters, close_p, kept, last_k + result_k * 2)


@kernel
def _backward(rows, read_BT, parameters, kept, gradient, found, learned, queries, heads, width, inner, closes, learns):
    """Write the gradient of the rows and, if the layer learns, add that of every parameter."""
    batch, length = read_BT.shape
    together, step, wide = _together(length), length // queries, 3 * width
    read_p, give_p, norm_p, into_p, back_p, close_p = _parameters(width, inner)
    triple_k, share_k, attended_k, between_k, hidden_k, after_k, first_k, second_k, last_k, _ = _kept(
        batch, length, queries, heads, width, inner
    )
    most, zeros = together * length, np.zeros(max(2 * width, inner), np.float32)
    flow, middle, back = (
        np.empty(most * width, np.float32),
        np.empty(most * width, np.float32),
        np.empty(most * width, np.float32),
    )
    normed, inside, triple = (
        np.empty(most * width, np.float32),
        np.empty(most * inner, np.float32),
        np.empty(most * wide, np.float32),
    )
    for sample in range(0, batch, together):
        samples = min(together, batch - sample)
        many, results, row, result = samples * length, samples * queries, sample * length, sample * queries
        hidden, between, attended = hidden_k + result * inner, between_k + result * width, attended_k + result * width

        if closes:
            norm_back(flow, 0, gradient, result * width, kept, after_k + result * width, results, width, parameters,
                       close_p, kept, last_k + result * 2, zeros, 0, learned, learns)  # fmt: skip
        else:
            for at in range(0, results * width, LANES):
                store(flow, at, load(gradient, result * width + at))
        multiply(inside, 0, inner, zeros, 0, 0, flow, 0, width, 1, parameters, back_p, inner, results, inner, width)
        for at in range(0, results * inner, LANES):
            store(inside, at, where_positive(load(kept, hidden + at), load(inside, at)))
        multiply(back, 0, width, zeros, 0, 0, inside, 0, inner, 1, parameters, into_p, width, results, width, inner)
        if learns:
            add_columns(learned, back_p + width * inner, flow, 0, width, results, width)
            multiply(learned, back_p, inner, learned, back_p, inner, flow, 0, 1, width, kept, hidden, inner,
                     width, inner, results)  # fmt: skip
            norm(normed, 0, kept, between, results, width, parameters, norm_p, kept, second_k + result * 2)
            add_columns(learned, into_p + width * inner, inside, 0, inner, results, inner)
            multiply(learned, into_p, width, learned, into_p, width, inside, 0, 1, inner, normed, 0, width,
                     inner, width, results)  # fmt: skip
        norm_back(middle, 0, back, 0, kept, between, results, width, parameters, norm_p, kept, second_k + result * 2,
                   flow, 1, learned, learns)  # fmt: skip

        multiply(back, 0, width, zeros, 0, 0, middle, 0, width, 1, parameters, give_p, width, results, width, width)
        unattend(triple, kept, triple_k + row * wide, kept, share_k + row * heads * LANES, back, 0, samples, length,
                 queries, heads, width)  # fmt: skip
        multiply(back, 0, width, zeros, 0, 0, triple, width, wide, 1, parameters, read_p + width * width, width,
                 many, width, 2 * width)  # fmt: skip
        multiply(back, 0, step * width, back, 0, step * width, triple, 0, step * wide, 1, parameters, read_p, width,
                 results, width, width)  # fmt: skip
        if learns:
            add_columns(learned, give_p + width * width, middle, 0, width, results, width)
            multiply(learned, give_p, width, learned, give_p, width, middle, 0, 1, width, kept, attended, width,
                     width, width, results)  # fmt: skip
            norm(normed, 0, rows, row * width, many, width, parameters, 0, kept, first_k + row * 2)
            bias, keys = read_p + wide * width, read_p + width * width
            add_columns(learned, bias, triple, 0, step * wide, results, width)
            add_columns(learned, bias + width, triple, width, wide, many, 2 * width)
            multiply(learned, read_p, width, learned, read_p, width, triple, 0, 1, step * wide, normed, 0, step * width,
                     width, width, results)  # fmt: skip
            multiply(learned, keys, width, learned, keys, width, triple, width, 1, wide, normed, 0, width,
                     2 * width, width, many)  # fmt: skip
        norm_back(found, row * width, back, 0, rows, row * width, many, width, parameters, 0, kept, first_k + row * 2,
                   middle, step, learned, learns)  # fmt: skip
