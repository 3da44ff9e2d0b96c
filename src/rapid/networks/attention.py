# pyright: basic
# Numba's arrays have types of their own, which pyright does not know.
"""Self-attention over as few tokens as there are vehicles, compiled: for a CPU, where torch is slow at it.

Torch's own kernel takes numbers in sixteens, which 15 tokens never fill: it spends more time on the attention than on
all the rest of a layer. Here a sample's tokens are the sixteen numbers that the processor takes at once. The results
are those of torch but for rounding (:mod:`rapid.simulator.compile`: no fast-math, so the same on every call).

Shapes: B batch, T tokens, H heads, D width of a head; L in place of T where rows are filled up with zeros.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rapid.simulator.compile import kernel

LANES, WIDTH = 16, 32
"""L, the numbers that are taken at once and the most tokens; and D. The compiler must know both to make fast code."""
_SCALE = np.float32(1 / math.sqrt(WIDTH))
_CLAMP = np.float32(-87)
"""Least exponent whose exponential is no denormal number."""
_PER_LN2, _LN2_HIGH, _LN2_LOW = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
_EXP = tuple(np.float32(c) for c in (1.98756915e-4, 1.39819995e-3, 8.33345191e-3, 4.16657959e-2, 1.66666655e-1, 0.5))
"""Polynomial of the exponential within +-ln(2)/2 (Moshier, Cephes: expf)."""
_ZERO, _HALF, _ONE, _BIAS, _PLACES = np.float32(0), np.float32(0.5), np.float32(1), np.int32(127), np.int32(23)


def can_attend(rows: Tensor, length: int, heads: int) -> bool:
    """Whether :func:`attend` is made for samples of so many of these tokens (B*T, H*D)."""
    small = length <= LANES and rows.shape[1] == heads * WIDTH
    return small and rows.device.type == "cpu" and rows.dtype == torch.float32


def attend(rows: Tensor, length: int, heads: int, mask_B11T: Tensor | None) -> Tensor:
    """Return softmax(Q K' / sqrt(D) + mask) V for every head, side by side (B*T, H*D); it can be differentiated.

    Args:
        rows: query, key and value of every token, each of all heads (B*T, 3*H*D).
        length: T.
        heads: H.
        mask_B11T: 0 where a key may be read, -inf where not.
    """
    batch = len(rows) // length
    if mask_B11T is None:
        mask_B11T = rows.new_zeros(1, 1, 1, 1)
    return _Attention.apply(rows, mask_B11T.expand(batch, 1, 1, length), heads)


class _Attention(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, mask_B11T: Tensor, heads: int) -> Tensor:
        batch, length = mask_B11T.shape[0], mask_B11T.shape[3]
        rows = rows.detach().contiguous()
        out = rows.new_empty(len(rows), heads * WIDTH)
        share_BHLL = rows.new_empty(batch, heads, LANES, LANES)
        given = rows.view(batch, length, 3, heads, WIDTH).numpy()
        read_BT = mask_B11T[:, 0, 0].numpy() == 0
        _attend(given, read_BT, out.view(batch, length, heads, WIDTH).numpy(), share_BHLL.numpy())
        ctx.save_for_backward(rows, share_BHLL)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        rows, share_BHLL = ctx.saved_tensors
        found, (batch, heads) = torch.empty_like(rows), share_BHLL.shape[:2]
        given, wanted = (each.view(batch, -1, 3, heads, WIDTH).numpy() for each in (rows, found))
        gradient = gradients[0].detach().contiguous().view(batch, -1, heads, WIDTH).numpy()
        _differentiate(given, share_BHLL.numpy(), gradient, wanted)
        return found, None, None


@kernel
def _attend(given, read_BT, out_BTHD, share_BHLL):
    """Write the attention and, for its gradient, how much each key (first L) is read by each query (second L)."""
    batch, length, _, heads, _ = given.shape
    query_DL, key_LD = np.zeros((WIDTH, LANES), np.float32), np.zeros((LANES, WIDTH), np.float32)
    value_LD, found_LD = np.zeros((LANES, WIDTH), np.float32), np.zeros((LANES, WIDTH), np.float32)
    most_L, total_L = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    power_L = np.zeros(LANES, np.int32)
    two_L = power_L.view(np.float32)
    for sample in range(batch):
        for head in range(heads):
            share_LL = share_BHLL[sample, head]
            for token in range(length):
                _copy(key_LD[token], given[sample, token, 1, head])
                _copy(value_LD[token], given[sample, token, 2, head])
                for d in range(WIDTH):
                    query_DL[d, token] = given[sample, token, 0, head, d] * _SCALE
            _over_width(key_LD, query_DL, share_LL)
            for i in range(LANES):
                most_L[i] = -np.inf
                total_L[i] = _ZERO
            for key in range(length):
                if read_BT[sample, key]:
                    row_L = share_LL[key]
                    for i in range(LANES):
                        most_L[i] = row_L[i] if row_L[i] > most_L[i] else most_L[i]
            for key in range(LANES):
                row_L = share_LL[key]
                if key >= length or not read_BT[sample, key]:
                    for i in range(LANES):
                        row_L[i] = _ZERO
                    continue
                for i in range(LANES):
                    # exp(x) = 2^n * exp(the rest), the power put together from its bits.
                    x = row_L[i] - most_L[i]
                    x = x if x > _CLAMP else _CLAMP
                    n = np.int32(x * _PER_LN2 - _HALF)
                    power_L[i] = (n + _BIAS) << _PLACES
                    rest = x - np.float32(n) * _LN2_HIGH - np.float32(n) * _LN2_LOW
                    series = _EXP[0] * rest + _EXP[1]
                    series = series * rest + _EXP[2]
                    series = series * rest + _EXP[3]
                    series = series * rest + _EXP[4]
                    series = series * rest + _EXP[5]
                    row_L[i] = series * (rest * rest) + rest + _ONE
                for i in range(LANES):
                    row_L[i] *= two_L[i]
                    total_L[i] += row_L[i]
            for i in range(LANES):
                total_L[i] = _ONE / total_L[i]
            for key in range(length):
                row_L = share_LL[key]
                for i in range(LANES):
                    row_L[i] *= total_L[i]
            _over_tokens(share_LL.T, value_LD, found_LD)
            for token in range(length):
                _copy(out_BTHD[sample, token, head], found_LD[token])


@kernel
def _differentiate(given, share_BHLL, gradient_BTHD, found):
    """Write the gradient of query, key and value."""
    batch, length, _, heads, _ = given.shape
    query_LD, key_LD = np.zeros((LANES, WIDTH), np.float32), np.zeros((LANES, WIDTH), np.float32)
    value_LD, out_LD = np.zeros((LANES, WIDTH), np.float32), np.zeros((LANES, WIDTH), np.float32)
    out_DL, score_LL = np.zeros((WIDTH, LANES), np.float32), np.zeros((LANES, LANES), np.float32)
    wanted = np.zeros((3, LANES, WIDTH), np.float32)
    mean_L = np.empty(LANES, np.float32)
    for sample in range(batch):
        for head in range(heads):
            share_LL = share_BHLL[sample, head]
            for token in range(length):
                _copy(query_LD[token], given[sample, token, 0, head])
                _copy(key_LD[token], given[sample, token, 1, head])
                _copy(value_LD[token], given[sample, token, 2, head])
                _copy(out_LD[token], gradient_BTHD[sample, token, head])
                for d in range(WIDTH):
                    out_DL[d, token] = gradient_BTHD[sample, token, head, d]
            # Of the shares, then of the scores before the softmax.
            _over_width(value_LD, out_DL, score_LL)
            for i in range(LANES):
                mean_L[i] = _ZERO
            for key in range(length):
                row_L, shown_L = score_LL[key], share_LL[key]
                for i in range(LANES):
                    mean_L[i] += shown_L[i] * row_L[i]
            for key in range(length):
                row_L, shown_L = score_LL[key], share_LL[key]
                for i in range(LANES):
                    row_L[i] = shown_L[i] * (row_L[i] - mean_L[i]) * _SCALE
            _over_tokens(score_LL.T, key_LD, wanted[0])
            _over_tokens(score_LL, query_LD, wanted[1])
            _over_tokens(share_LL, out_LD, wanted[2])
            for token in range(length):
                for part in range(3):
                    _copy(found[sample, token, part, head], wanted[part, token])


@kernel
def _copy(into_D, from_D):
    for d in range(WIDTH):
        into_D[d] = from_D[d]


@kernel
def _over_width(left_LD, right_DL, out_LL):
    """Write the product of two matrices, eight terms at a time: so the sums are seldom read and written."""
    for row in range(LANES):
        out_L = out_LL[row]
        for i in range(LANES):
            out_L[i] = _ZERO
        for k in range(0, WIDTH, 8):
            a, b, c, d = left_LD[row, k], left_LD[row, k + 1], left_LD[row, k + 2], left_LD[row, k + 3]
            e, f, g, h = left_LD[row, k + 4], left_LD[row, k + 5], left_LD[row, k + 6], left_LD[row, k + 7]
            for i in range(LANES):
                out_L[i] += (
                    (a * right_DL[k, i] + b * right_DL[k + 1, i]) + (c * right_DL[k + 2, i] + d * right_DL[k + 3, i])
                ) + (
                    (e * right_DL[k + 4, i] + f * right_DL[k + 5, i])
                    + (g * right_DL[k + 6, i] + h * right_DL[k + 7, i])
                )


@kernel
def _over_tokens(left_LL, right_LD, out_LD):
    """Write the product of two matrices; the same again, for sizes that the compiler knows are the faster."""
    for row in range(LANES):
        out_D = out_LD[row]
        for i in range(WIDTH):
            out_D[i] = _ZERO
        for k in range(0, LANES, 8):
            a, b, c, d = left_LL[row, k], left_LL[row, k + 1], left_LL[row, k + 2], left_LL[row, k + 3]
            e, f, g, h = left_LL[row, k + 4], left_LL[row, k + 5], left_LL[row, k + 6], left_LL[row, k + 7]
            for i in range(WIDTH):
                out_D[i] += (
                    (a * right_LD[k, i] + b * right_LD[k + 1, i]) + (c * right_LD[k + 2, i] + d * right_LD[k + 3, i])
                ) + (
                    (e * right_LD[k + 4, i] + f * right_LD[k + 5, i])
                    + (g * right_LD[k + 6, i] + h * right_LD[k + 7, i])
                )
