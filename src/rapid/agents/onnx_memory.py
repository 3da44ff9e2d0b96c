"""A network's memory as ONNX nodes (:mod:`rapid.networks.memory`): what is believed, what is recalled, what comes next.

Most of it is affine in the state and in the ego's row, and so is one matrix each here.

Shapes: B batch, V vehicles, F features, S entries of a state, K numbers, D width, N policies.
"""

import itertools
from typing import NamedTuple

import numpy as np

from rapid.agents.onnx_graph import Graph, array
from rapid.networks.memory import (
    DELAY,
    DISTANCE,
    EPISODE,
    LAG,
    LAG_DISTANCE,
    LEFTMOST,
    RIGHTMOST,
    ROUNDING,
    SLANT,
    SPEED,
    SPEED_INDEX,
    SPEED_STEP,
    START_TOLERANCE,
    STATE_SIZE,
    STEPS,
    TRAFFIC_SPEED,
    Memory,
)
from rapid.road import LANE_WIDTH
from rapid.scenarios import FASTER, LANE_LEFT, LANE_RIGHT, NUM_FEATURES, SLOWER, TARGET_SPEEDS

FREE = 1e30
"""A bound that nothing reaches."""
X, Y, VX, VY = 1, 2, 3, 4


class Names(NamedTuple):
    """The nodes of what memory adds inside the network."""

    token: str
    action: str
    router: str


def believed(graph: Graph, memory: Memory, obs: str, state: str) -> str:
    """Return the observations with the ego's row within what is known of it, or with all rows squeezed."""
    if memory.squeeze:
        return _squeezed(graph, memory, obs, state)
    low_SF, high_SF = np.zeros((STATE_SIZE, NUM_FEATURES)), np.zeros((STATE_SIZE, NUM_FEATURES))
    low_F, high_F = np.full(NUM_FEATURES, -FREE), np.full(NUM_FEATURES, FREE)
    low_SF[DISTANCE, X] = high_SF[DISTANCE, X] = 1
    low_SF[STEPS, X] = -DELAY
    low_F[X], high_F[X] = memory.start_x - START_TOLERANCE, memory.start_x + START_TOLERANCE
    low_SF[SPEED, VX] = high_SF[SPEED, VX] = high_SF[SPEED, VY] = 1
    low_SF[SPEED, VY] = -1
    low_F[VX], low_F[VY], high_F[VX], high_F[VY] = -SLANT, -ROUNDING, ROUNDING, ROUNDING
    low = graph.reshape(_affine(graph, state, low_SF, low_F), -1, 1, NUM_FEATURES)
    high = graph.reshape(_affine(graph, state, high_SF, high_F), -1, 1, NUM_FEATURES)
    ego = graph.node("Min", graph.node("Max", graph.cut(obs, 0, 1, 1), low), high)
    return graph.node("Concat", ego, graph.cut(obs, 1, graph.vehicles, 1), axis=1)


def recalled(graph: Graph, memory: Memory, obs: str, state: str) -> Names:
    """Return what is added inside the network."""
    most = max(memory.lanes - 1, 1)
    state_SK, ego_FK = np.zeros((STATE_SIZE, 6)), np.zeros((NUM_FEATURES, 6))
    state_SK[SPEED, 0] = 1 / TARGET_SPEEDS[-1]
    state_SK[LEFTMOST, 1] = state_SK[RIGHTMOST, 2] = 1 / most
    start = 0.0
    if not memory.squeeze:
        state_SK[SPEED, 4], ego_FK[VX, 4] = -1 / 4, 1 / 4
        state_SK[DISTANCE, 5], ego_FK[X, 5] = -1 / 20, 1 / 20
        start = -memory.start_x / 20
    ego = graph.reshape(graph.cut(obs, 0, 1, 1), -1, NUM_FEATURES)
    numbers = _affine(graph, state, state_SK, np.array([0, 0, 0, 0, 0, start]))
    numbers = graph.node("Add", numbers, _affine(graph, ego, ego_FK, np.zeros(6)))
    seen = graph.number(graph.node("Greater", graph.cut(obs, 0, 1, 2), 0.5))
    present = graph.node("ReduceSum", seen, graph.constant([1, 2], np.int64), keepdims=0)
    share_K = np.array([[0, 0, 0, 1 / graph.vehicles, 0, 0]], np.float32)
    numbers = graph.node("Add", numbers, graph.node("Mul", graph.reshape(present, -1, 1), share_K))
    known = graph.node(
        "Concat",
        _one_of(graph, graph.cut(state, STEPS, STEPS + 1, 1), EPISODE),
        _one_of(graph, graph.cut(state, SPEED_INDEX, SPEED_INDEX + 1, 1), len(TARGET_SPEEDS)),
        numbers,
        axis=1,
    )
    hidden = graph.node("Relu", graph.linear(known, memory.hidden))
    out = graph.node("MatMul", hidden, array(memory.out.weight).T)
    ends = np.cumsum([0, *memory.sizes]).tolist()
    return Names(*(graph.cut(out, start, end, 1) for start, end in itertools.pairwise(ends)))


def next_state(graph: Graph, lanes: int, state: str, q: str) -> str:
    """Return the states (B, S) after the greedy actions, on a road with so many lanes."""
    action = graph.node("ArgMax", q, axis=1, keepdims=1)

    def taken(index: int) -> str:
        return graph.number(graph.node("Equal", action, graph.constant(index, np.int64)))

    def entry(index: int) -> str:
        return graph.cut(state, index, index + 1, 1)

    change = graph.node("Sub", taken(FASTER), taken(SLOWER))
    nearest = graph.node("Round", graph.node("Mul", entry(SPEED), 1 / SPEED_STEP))
    changed = _clipped(graph, graph.node("Add", nearest, change), len(TARGET_SPEEDS) - 1)
    kept = graph.node("Equal", change, 0.0)
    index = graph.node("Where", kept, entry(SPEED_INDEX), changed)
    target = graph.node("Mul", index, SPEED_STEP)
    above = graph.node("Sub", entry(SPEED), target)
    moved = graph.node("Sub", taken(LANE_RIGHT), taken(LANE_LEFT))
    driven = graph.node("Add", target, graph.node("Mul", above, LAG_DISTANCE))
    return graph.node(
        "Concat",
        graph.node("Add", entry(STEPS), 1.0),
        index,
        graph.node("Add", target, graph.node("Mul", above, LAG)),
        _clipped(graph, graph.node("Add", entry(LEFTMOST), moved), lanes - 1),
        _clipped(graph, graph.node("Add", entry(RIGHTMOST), moved), lanes - 1),
        graph.node("Add", entry(DISTANCE), driven),
        axis=1,
    )


def _squeezed(graph: Graph, memory: Memory, obs: str, state: str) -> str:
    """Return the observations with features squeezed (:meth:`rapid.networks.memory.Memory.squeezed`)."""

    def entry(index: int) -> str:
        return graph.reshape(graph.cut(state, index, index + 1, 1), -1, 1, 1)

    def row(first: int, end: int, ahead: str, least: str | float, most: str | float, speed: str) -> str:
        rows = graph.cut(obs, first, end, 1)
        present, y = graph.cut(rows, 0, 1, 2), graph.cut(rows, Y, Y + 1, 2)
        lane = graph.node("Round", graph.node("Mul", y, 1 / LANE_WIDTH))
        middle = graph.node("Mul", graph.node("Min", graph.node("Max", lane, least), most), LANE_WIDTH)
        return graph.node("Concat", present, ahead, middle, speed, graph.node("Mul", y, 0.0), axis=2)

    place = graph.node("Add", entry(DISTANCE), memory.start_x)
    ego = row(0, 1, place, entry(LEFTMOST), entry(RIGHTMOST), entry(SPEED))
    others = graph.cut(obs, 1, graph.vehicles, 1)
    seen = graph.number(graph.node("Greater", graph.cut(others, 0, 1, 2), 0.5))
    speed = graph.node("Mul", seen, TRAFFIC_SPEED)
    rest = row(1, graph.vehicles, graph.cut(others, X, X + 1, 2), 0.0, float(memory.lanes - 1), speed)
    return graph.node("Concat", ego, rest, axis=1)


def _affine(graph: Graph, rows: str, matrix: np.ndarray, bias: np.ndarray) -> str:
    return graph.node("Gemm", rows, matrix.astype(np.float32), bias.astype(np.float32))


def _clipped(graph: Graph, value: str, most: float) -> str:
    return graph.node("Min", graph.node("Max", value, 0.0), float(most))


def _one_of(graph: Graph, value: str, count: int) -> str:
    """Return (B, count): 1 at the value, or at the last if it is beyond; else 0."""
    places = np.arange(count, dtype=np.float32)[None]
    return graph.number(graph.node("Equal", graph.node("Min", value, float(count - 1)), places))
