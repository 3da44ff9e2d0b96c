# pyright: basic, reportCallIssue=false
# Numba's arrays have types of their own, which pyright does not know, and passes the first argument of an intrinsic.
"""The parts of a compiled layer that are no products: LayerNorm, and attention over the few tokens that vehicles are.

Torch's own attention takes keys in sixteens, which 15 tokens never fill: it spends more time on the attention than on
all the rest of a layer. Here a sample's queries stand side by side in one vector.

Shapes: B batch, T tokens, H heads, D width of all heads, E of one, Q queries of a sample, R = B*T rows. Matrices are
given as in :mod:`rapid.networks.lanes`: query, key and value stand side by side (R, 3*D), with Q = 1 the query in each
sample's first row alone; of each sample and head, `share` has a vector for every key: how much each query reads it.
"""

import numpy as np

from rapid.networks.lanes import (
    LANES,
    fma,
    larger,
    load,
    multiply,
    power_of_two,
    repeat,
    rounded,
    spread,
    store,
    total,
    transpose,
)
from rapid.simulator.compile import kernel

_CLAMP = np.float32(-87)
"""Least exponent whose exponential is no denormal number."""
_PER_LN2, _LN2_HIGH, _LN2_LOW = np.float32(1.44269504), np.float32(-0.693359375), np.float32(2.12194440e-4)
_EXP = tuple(np.float32(c) for c in (1.98756915e-4, 1.39819995e-3, 8.33345191e-3, 4.16657959e-2, 1.66666655e-1, 0.5))
"""Polynomial of the exponential within +-ln(2)/2 (Moshier, Cephes: expf)."""
_EPSILON = np.float32(1e-5)
"""What torch's LayerNorm adds to a variance."""
_ZERO, _ONE = np.float32(0), np.float32(1)


@kernel
def attend(triple, at, share, share_at, out, out_at, read_BT, sample, samples, queries, heads, width):
    """Write softmax(Q K' / sqrt(E) + mask) V of every head, side by side (B*Q, D), and the shares.

    So many samples are taken, the first of which is `sample` in `read_BT`, which tells what keys may be read.
    """
    length, head = read_BT.shape[1], width // heads
    turned, zeros = np.zeros(head * LANES, np.float32), np.zeros(head, np.float32)
    scale = np.float32(1 / np.sqrt(head))
    for s in range(samples):
        for h in range(heads):
            query = at + s * length * 3 * width + h * head
            key, value = query + width, query + 2 * width
            _score(
                share, share_at, triple, key, 3 * width, length, triple, query, 3 * width, queries, head, turned, zeros
            )
            _share(share, share_at, read_BT, sample + s, scale)
            multiply(out, out_at + s * queries * width + h * head, width, zeros, 0, 0, share, share_at, 1, LANES,
                     triple, value, 3 * width, queries, head, length)  # fmt: skip
            share_at += length * LANES


@kernel
def unattend(
    found, triple, at, share, share_at, gradient, gradient_at, samples, length, queries, heads, width
):  # fmt: skip
    """Write into `found` the gradient of query, key and value (R, 3*D), of what `attend` wrote (B*Q, D)."""
    head, wide = width // heads, 3 * width
    turned, zeros, score = (
        np.zeros(head * LANES, np.float32),
        np.zeros(head, np.float32),
        np.zeros(LANES * LANES, np.float32),
    )
    scale = spread(np.float32(1 / np.sqrt(head)))
    for s in range(samples):
        for h in range(heads):
            place = s * length * wide + h * head
            query, given = at + place, gradient_at + s * queries * width + h * head
            key, value = query + width, query + 2 * width
            # Of the shares, then of the scores before the softmax.
            _score(score, 0, triple, value, wide, length, gradient, given, width, queries, head, turned, zeros)
            mean = spread(_ZERO)
            for k in range(0, length * LANES, LANES):
                mean = fma(load(share, share_at + k), load(score, k), mean)
            for k in range(0, length * LANES, LANES):
                store(score, k, load(share, share_at + k) * (load(score, k) - mean) * scale)
            multiply(found, place, wide, zeros, 0, 0, score, 0, 1, LANES, triple, key, wide, queries, head, length)
            multiply(found, place + width, wide, zeros, 0, 0, score, 0, LANES, 1, triple, query, wide,
                     length, head, queries)  # fmt: skip
            multiply(found, place + 2 * width, wide, zeros, 0, 0, share, share_at, LANES, 1, gradient, given, width,
                     length, head, queries)  # fmt: skip
            share_at += length * LANES


@kernel
def _score(out, out_at, keys, at, row, length, queries, queries_at, queries_row, count, head, turned, zeros):
    """Write the inner products of every key with every query, a vector for each key."""
    if count == 1:
        for key in range(length):
            product = spread(_ZERO)
            for j in range(0, head, LANES):
                product = fma(load(keys, at + key * row + j), load(queries, queries_at + j), product)
            store(out, out_at + key * LANES, spread(total(product)))
    else:
        transpose(turned, 0, LANES, queries, queries_at, queries_row, count, head)
        multiply(out, out_at, LANES, zeros, 0, 0, keys, at, row, 1, turned, 0, LANES, length, LANES, head)


@kernel
def _share(share, at, read_BT, sample, scale):
    """Replace scores by their softmax over the keys that may be read, and by 0 for the others."""
    length, scale_L = read_BT.shape[1], spread(scale)
    most, sums = spread(np.float32(-np.inf)), spread(_ZERO)
    for key in range(length):
        if read_BT[sample, key]:
            most = larger(load(share, at + key * LANES), most)
    for key in range(length):
        if read_BT[sample, key]:
            # exp(x) = 2^n * exp(the rest).
            x = larger(spread(_CLAMP), (load(share, at + key * LANES) - most) * scale_L)
            n = rounded(x * spread(_PER_LN2))
            rest = fma(n, spread(_LN2_LOW), fma(n, spread(_LN2_HIGH), x))
            series = fma(spread(_EXP[0]), rest, spread(_EXP[1]))
            series = fma(series, rest, spread(_EXP[2]))
            series = fma(series, rest, spread(_EXP[3]))
            series = fma(series, rest, spread(_EXP[4]))
            series = fma(series, rest, spread(_EXP[5]))
            series = fma(series, rest * rest, rest + spread(_ONE)) * power_of_two(n)
            store(share, at + key * LANES, series)
            sums = sums + series
        else:
            store(share, at + key * LANES, spread(_ZERO))
    part = spread(_ONE) / sums
    for key in range(length):
        store(share, at + key * LANES, load(share, at + key * LANES) * part)


@kernel
def add_bias(out, out_at, given, at, row, bias, bias_at, rows, columns):
    """Write a bias added to so many rows."""
    for i in range(rows):
        for j in range(0, columns, LANES):
            store(out, out_at + i * columns + j, load(given, at + i * row + j) + load(bias, bias_at + j))


@kernel
def norm(out, out_at, given, at, rows, width, parameters, weight, moments, moments_at):
    """Write normed rows, and of each its mean and 1/deviation."""
    for i in range(rows):
        line, sums = at + i * width, spread(_ZERO)
        for j in range(0, width, LANES):
            sums = sums + load(given, line + j)
        mean = total(sums) / np.float32(width)
        mean_L, squares = spread(mean), spread(_ZERO)
        for j in range(0, width, LANES):
            away = load(given, line + j) - mean_L
            squares = fma(away, away, squares)
        factor = _ONE / np.sqrt(total(squares) / np.float32(width) + _EPSILON)
        moments[moments_at + 2 * i], moments[moments_at + 2 * i + 1] = mean, factor
        factor_L = spread(factor)
        for j in range(0, width, LANES):
            unit = (load(given, line + j) - mean_L) * factor_L
            result = fma(unit, load(parameters, weight + j), load(parameters, weight + width + j))
            store(out, out_at + i * width + j, result)


@kernel
def norm_back(
    out, out_at, gradient, gradient_at, given, at, rows, width, parameters, weight, moments, moments_at, beside, step,
    learned, learns,
):  # fmt: skip
    """Write the gradient of normed rows and, if the norm learns, add that of its weight and bias.

    To every row that is a multiple of `step`, unless that is 0, the next row of `beside` is added.
    """
    part = spread(_ONE / np.float32(width))
    for i in range(rows):
        line, flow, mean, factor = at + i * width, gradient_at + i * width, moments_at + 2 * i, moments_at + 2 * i + 1
        mean_L, factor_L = repeat(moments, mean), repeat(moments, factor)
        sums, turns = spread(_ZERO), spread(_ZERO)
        for j in range(0, width, LANES):
            unit, change = (load(given, line + j) - mean_L) * factor_L, load(gradient, flow + j)
            if learns:
                store(learned, weight + j, fma(change, unit, load(learned, weight + j)))
                store(learned, weight + width + j, load(learned, weight + width + j) + change)
            change = change * load(parameters, weight + j)
            sums, turns = sums + change, fma(change, unit, turns)
        sums, turns = spread(total(sums)) * part, spread(total(turns)) * part
        adds = step > 0 and i % step == 0
        for j in range(0, width, LANES):
            unit = (load(given, line + j) - mean_L) * factor_L
            change = load(gradient, flow + j) * load(parameters, weight + j)
            result = (change - sums - unit * turns) * factor_L
            if adds:
                result = result + load(beside, i // step * width + j)
            store(out, out_at + i * width + j, result)
