# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""NumPy's PCG64 generator and its seeding, compiled, so that a spawn equals highway-env's draw for draw.

A stream is a row of ``STREAM_WORDS`` unsigned 64-bit words: state (high, low), increment (high, low), whether half of
a 64-bit draw is left over for the next 32-bit draw, and that half. The algorithms are those that NumPy documents:
O'Neill's PCG XSL-RR 128/64 and seed_seq_fe, and Lemire's bounded integers.
"""

from typing import Any, cast

import numpy as np

from rapid.simulator.compile import kernel

STREAM_WORDS = 6

_MULTIPLIER_HIGH = np.uint64(0x2360ED051FC65DA4)
_MULTIPLIER_LOW = np.uint64(0x4385DF649FCCF645)
_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_ZERO = np.uint64(0)
_ONE = np.uint64(1)
_TO_UNIT = 1.0 / 9007199254740992.0

_INIT_A, _MULTIPLIER_A = np.uint64(0x43B0D7E5), np.uint64(0x931E8875)
_INIT_B, _MULTIPLIER_B = np.uint64(0x8B51F9DD), np.uint64(0x58F38DED)
_MIX_LEFT, _MIX_RIGHT = np.uint64(0xCA01F9DD), np.uint64(0x4973F715)
_SHIFT = np.uint64(16)
_POOL = 4


@kernel
def _multiply_high(a, b):
    """Return the upper 64 bits of the product of two 64-bit numbers."""
    a_low, a_high, b_low, b_high = a & _MASK, a >> _HALF, b & _MASK, b >> _HALF
    cross_1, cross_2 = a_low * b_high, a_high * b_low
    middle = ((a_low * b_low) >> _HALF) + (cross_1 & _MASK) + (cross_2 & _MASK)
    return a_high * b_high + (cross_1 >> _HALF) + (cross_2 >> _HALF) + (middle >> _HALF)


@kernel
def _advance(stream):
    low = stream[1] * _MULTIPLIER_LOW + stream[3]
    carry = _ONE if low < stream[3] else _ZERO
    stream[0] = (
        _multiply_high(stream[1], _MULTIPLIER_LOW)
        + stream[0] * _MULTIPLIER_LOW
        + stream[1] * _MULTIPLIER_HIGH
        + stream[2]
        + carry
    )
    stream[1] = low


@kernel
def next_uint64(stream):
    """Return the next 64 random bits of `stream` and advance it."""
    _advance(stream)
    bits = stream[0] ^ stream[1]
    turn = stream[0] >> np.uint64(58)
    return (bits >> turn) | (bits << ((np.uint64(64) - turn) & np.uint64(63)))


@kernel
def next_uint32(stream):
    """Return the next 32 random bits: the low half of a fresh draw, and next time its high half."""
    if stream[4] != _ZERO:
        stream[4] = _ZERO
        return stream[5]
    bits = next_uint64(stream)
    stream[4] = _ONE
    stream[5] = bits >> _HALF
    return bits & _MASK


@kernel
def uniform(stream, low, high):
    """Return a double from [low, high), as ``Generator.uniform(low, high)`` does."""
    return low + (high - low) * (np.float64(next_uint64(stream) >> np.uint64(11)) * _TO_UNIT)


@kernel
def integer_below(stream, bound):
    """Return an integer from [0, bound), as ``Generator.integers(0, bound)`` does; one choice costs no draw."""
    if bound <= 1:
        return 0
    exclusive = np.uint64(bound)
    product = next_uint32(stream) * exclusive
    if (product & _MASK) < exclusive:
        threshold = (_MASK - (exclusive - _ONE)) % exclusive
        while (product & _MASK) < threshold:
            product = next_uint32(stream) * exclusive
    return np.int64(product >> _HALF)


@kernel
def seed_stream(stream, seed):
    """Set `stream` to ``Generator(PCG64(SeedSequence(seed)))`` for a seed of at most 64 bits."""
    pool = np.zeros(_POOL, np.uint64)
    pool[0] = seed & _MASK
    pool[1] = seed >> _HALF
    constant = _INIT_A
    for i in range(_POOL):
        value = pool[i] ^ constant
        constant = (constant * _MULTIPLIER_A) & _MASK
        value = (value * constant) & _MASK
        pool[i] = value ^ (value >> _SHIFT)
    for source in range(_POOL):
        for target in range(_POOL):
            if source != target:
                value = pool[source] ^ constant
                constant = (constant * _MULTIPLIER_A) & _MASK
                value = (value * constant) & _MASK
                value ^= value >> _SHIFT
                mixed = (_MIX_LEFT * pool[target] - _MIX_RIGHT * value) & _MASK
                pool[target] = mixed ^ (mixed >> _SHIFT)
    words = np.zeros(4, np.uint64)
    constant = _INIT_B
    for i in range(8):
        value = pool[i % _POOL] ^ constant
        constant = (constant * _MULTIPLIER_B) & _MASK
        value = (value * constant) & _MASK
        value ^= value >> _SHIFT
        words[i // 2] |= value << (_HALF * np.uint64(i % 2))
    stream[2] = (words[2] << _ONE) | (words[3] >> np.uint64(63))
    stream[3] = (words[3] << _ONE) | _ONE
    stream[0] = _ZERO
    stream[1] = _ZERO
    _advance(stream)
    low = stream[1] + words[1]
    stream[0] += words[0] + (_ONE if low < words[1] else _ZERO)
    stream[1] = low
    _advance(stream)
    stream[4] = _ZERO
    stream[5] = _ZERO


def stream_of(generator: np.random.Generator) -> np.ndarray:
    """Return the state of a NumPy generator over PCG64 as a stream row, uint64 of shape (STREAM_WORDS,)."""
    state = cast(dict[str, Any], generator.bit_generator.state)
    words = [*divmod(state["state"]["state"], 1 << 64), *divmod(state["state"]["inc"], 1 << 64)]
    return np.array([*words, state["has_uint32"], state["uinteger"]], np.uint64)


def set_generator(generator: np.random.Generator, stream: np.ndarray) -> None:
    """Set a NumPy generator over PCG64 to the state of a stream row."""
    high, low, increment_high, increment_low, has_half, half = (int(word) for word in stream)
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": high << 64 | low, "inc": increment_high << 64 | increment_low},
        "has_uint32": has_half,
        "uinteger": half,
    }
