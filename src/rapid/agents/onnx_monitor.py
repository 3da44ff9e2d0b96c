"""Two policies and the monitor between them as one ONNX graph (:mod:`rapid.monitor`).

Shapes: B batch, V vehicles, F features, A actions, S entries of a state.
"""

from typing import Any

import numpy as np

from rapid.agents.onnx_graph import Graph
from rapid.agents.onnx_memory import next_state
from rapid.agents.onnx_network import q_values
from rapid.defences import CAR_UNITS
from rapid.errors import RapidError
from rapid.monitor import BEHIND, BEYOND, CARS, PLACE_ERROR, SPEED_ERROR, MonitoredNetwork
from rapid.networks.memory import DELAY, DISTANCE, SPEED, START_TOLERANCE, STATE_SIZE, STEPS, start_x
from rapid.networks.q_network import QNetwork
from rapid.scenarios import NUM_FEATURES

PRESENCE, X, VX, VY = 0, 1, 3, 4
NOWHERE = 1e30
"""How far apart two rows are that do not belong together."""


def build_monitored_model(network: MonitoredNetwork) -> Any:
    """Return the `onnx.ModelProto` from `obs` (B, V, F) and `state` (B, S) to `q` (B, A) and `next_state`.

    Raises:
        ImportError: onnx is not installed.
        RapidError: one of the two is behind a defence.
    """
    import onnx

    calm, wary = network.calm, network.wary
    if not (isinstance(calm, QNetwork) and isinstance(wary, QNetwork)):
        raise RapidError(
            "A monitored agent of which one is behind a defence cannot be exported. Give two saved agents, alone or "
            "with shield:BOX: before them."
        )
    graph, own = Graph(onnx, network.vehicles), network.own_size
    memory = graph.cut("state", 1, 1 + STATE_SIZE, 1)
    states = [
        graph.cut("state", own, own + network.calm_size, 1),
        graph.cut("state", own + network.calm_size, own + network.calm_size + STATE_SIZE, 1),
    ]
    before = graph.reshape(graph.cut("state", 1 + STATE_SIZE, own, 1), -1, network.vehicles, NUM_FEATURES)
    doubted = graph.node("Greater", graph.cut("state", 0, 1, 1), 0.5)
    doubts = graph.node("Or", doubted, _contradicts(graph, memory, before, network.lanes))
    calm_q, wary_q = q_values(graph, calm, states[0]), q_values(graph, wary, states[1])
    graph.node("Where", doubts, wary_q, calm_q)
    graph.nodes[-1].output[0] = "q"
    after = [next_state(graph, network.lanes, memory, "q"), graph.reshape("obs", -1, network.vehicles * NUM_FEATURES)]
    for policy, state in zip((calm, wary), states, strict=True):
        after += [next_state(graph, network.lanes, state, "q")] if policy.memory is not None else []
    graph.node("Concat", graph.number(doubts), *after, axis=1)
    graph.nodes[-1].output[0] = "next_state"
    return graph.model(own + sum(STATE_SIZE for policy in (calm, wary) if policy.memory is not None))


def _contradicts(graph: Graph, memory: str, before: str, lanes: int) -> str:
    """Return whether what is seen cannot be true (B, 1); see :func:`rapid.monitor.contradicts`."""

    def known(index: int) -> str:
        return graph.cut(memory, index, index + 1, 1)

    def feature(rows: str, index: int) -> str:
        return graph.node("Squeeze", graph.cut(rows, index, index + 1, 2), graph.constant([2], np.int64))

    def outside(value: str, least: float | str, most: float | str) -> str:
        return graph.node("Or", graph.node("Less", value, least), graph.node("Greater", value, most))

    ego = graph.reshape(graph.cut("obs", 0, 1, 1), -1, NUM_FEATURES)
    along, across = graph.cut(ego, VX, VX + 1, 1), graph.cut(ego, VY, VY + 1, 1)
    squares = graph.node("Add", graph.node("Mul", along, along), graph.node("Mul", across, across))
    faster = graph.node("Sub", graph.node("Sqrt", squares), known(SPEED))
    place = graph.node("Add", known(DISTANCE), start_x(lanes))
    late = graph.node("Sub", place, graph.node("Mul", known(STEPS), DELAY))
    room = START_TOLERANCE + PLACE_ERROR
    ego_wrong = graph.node(
        "Or",
        outside(faster, -SPEED_ERROR, SPEED_ERROR),
        outside(graph.cut(ego, X, X + 1, 1), graph.node("Sub", late, room), graph.node("Add", place, room)),
    )
    there, fast = graph.node("Add", feature(before, X), feature(before, VX)), feature(before, VX)
    row, belongs = _matched(graph, before)
    ahead = graph.node("Sub", feature("obs", X), graph.node("GatherElements", there, row, axis=1))
    quicker = graph.node("Sub", feature("obs", VX), graph.node("GatherElements", fast, row, axis=1))
    far = graph.node("Or", outside(ahead, -BEHIND[0], BEYOND[0]), outside(quicker, -BEHIND[1], BEYOND[1]))
    wrong = graph.number(graph.node("And", far, belongs))
    cars = graph.node("ReduceSum", wrong, graph.constant([1], np.int64), keepdims=1)
    return graph.node("Or", ego_wrong, graph.node("GreaterOrEqual", cars, float(CARS)))


def _matched(graph: Graph, before: str) -> tuple[str, str]:
    """Return for each car seen the nearest that was expected (B, V), and whether they are each other's nearest."""
    vehicles = graph.vehicles
    place, speed = graph.cut(before, 1, 3, 2), graph.cut(before, 3, 5, 2)
    moved = graph.node("Concat", graph.node("Add", place, speed), speed, axis=2)
    seen = graph.reshape(graph.cut("obs", 1, NUM_FEATURES, 2), -1, vehicles, 1, NUM_FEATURES - 1)
    apart = graph.node("Sub", seen, graph.reshape(moved, -1, 1, vehicles, NUM_FEATURES - 1))
    apart = graph.node("Abs", graph.node("Mul", apart, np.array([1 / unit for unit in CAR_UNITS], np.float32)))
    away = graph.node("ReduceSum", apart, graph.constant([3], np.int64), keepdims=0)
    present = [
        graph.reshape(graph.node("Greater", graph.cut(rows, PRESENCE, PRESENCE + 1, 2), 0.5), -1, *shape)
        for rows, shape in (("obs", (vehicles, 1)), (before, (1, vehicles)))
    ]
    # The ego is left out: what is known of it is looked at by itself.
    others = np.ones((vehicles, vehicles), np.bool_)
    others[0], others[:, 0] = False, False
    both = graph.node("And", graph.node("And", *present), graph.constant(others, np.bool_))
    away = graph.node("Where", both, away, NOWHERE)
    row = graph.node("ArgMin", away, axis=2, keepdims=0)
    back = graph.node("GatherElements", graph.node("ArgMin", away, axis=1, keepdims=0), row, axis=1)
    mutual = graph.node("Equal", back, graph.constant(np.arange(vehicles)[None], np.int64))
    near = graph.node("Less", graph.node("ReduceMin", away, axes=[2], keepdims=0), NOWHERE / 2)
    return row, graph.node("And", mutual, near)
