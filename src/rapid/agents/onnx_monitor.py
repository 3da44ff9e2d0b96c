"""Two policies and the monitor between them as one ONNX graph (:mod:`rapid.monitor`).

Shapes: B batch, V vehicles, F features, A actions, S entries of a state.
"""

from typing import Any

import numpy as np

from rapid.agents.onnx_graph import Graph
from rapid.agents.onnx_memory import next_state
from rapid.agents.onnx_network import q_values
from rapid.errors import RapidError
from rapid.monitor import (
    ASIDE,
    ASIDE_SPEED,
    COMING,
    CRUISE,
    FASTER_BY,
    FIRST_ERROR,
    FIRST_SPEEDS,
    OFF_LANE,
    PLACE_ERROR,
    SLOWER_BY,
    SPEED_ERROR,
    STRAIGHT,
    STRAY,
    MonitoredNetwork,
)
from rapid.networks.memory import DELAY, DISTANCE, SPEED, START_TOLERANCE, STATE_SIZE, STEPS, start_x
from rapid.networks.q_network import QNetwork
from rapid.road import LANE_WIDTH, SIGHT
from rapid.scenarios import NUM_FEATURES

PRESENCE, X, Y, VX, VY = range(NUM_FEATURES)


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
    others = _Others(graph, before)
    return graph.node("Or", graph.node("Or", ego_wrong, others.impossible_sight()), others.impossible_since())


class _Others:
    """The rules on other cars, each as in :mod:`rapid.monitor`, for what is seen and what was seen before."""

    def __init__(self, graph: Graph, before: str) -> None:
        self.graph, self.before, self.cars = graph, before, graph.vehicles - 1

    def impossible_sight(self) -> str:
        """Return whether another car drives as none does (B, 1)."""
        straight = self._both(self._above(self._seen(VX), CRUISE), self._below(self._aside(), STRAIGHT))
        between = self._both(straight, self._above(self._off_lane(), OFF_LANE))
        return self._any_car(
            self._both(self._here("obs"), self._either(between, self._above(self._aside(), ASIDE_SPEED)))
        )

    def impossible_since(self) -> str:
        """Return whether it is where none begins, or where none can be a second later (B, 1)."""
        ego = self.graph.reshape(self.graph.cut(self.before, 0, 1, 1), -1, NUM_FEATURES)
        begun = self._above(self.graph.cut(ego, PRESENCE, PRESENCE + 1, 1), 0.5)
        # onnxruntime has no Where for conditions.
        first = self._both(self.graph.node("Not", begun), self._impossible_start())
        return self._either(first, self._both(begun, self._impossible_move()))

    def _impossible_start(self) -> str:
        speed, (least, most) = self._seen(VX), FIRST_SPEEDS
        wrong_speed = self._either(self._below(speed, least - FIRST_ERROR), self._above(speed, most + FIRST_ERROR))
        wrong = self._either(wrong_speed, self._above(self._aside(), FIRST_ERROR))
        return self._any_car(
            self._both(self._here("obs"), self._either(wrong, self._above(self._off_lane(), FIRST_ERROR)))
        )

    def _impossible_move(self) -> str:
        graph, before = self.graph, self.before
        here, there = self._here("obs"), self._here(before)
        expected = graph.node("Add", self._column(before, X), self._column(before, VX))
        along = graph.node("Sub", self._now(self._seen(X)), self._was(expected))
        across = graph.node("Sub", self._now(self._seen(Y)), self._was(self._column(before, Y)))
        faster = graph.node("Sub", self._now(self._seen(VX)), self._was(self._column(before, VX)))
        least = graph.node("Sub", graph.node("Min", faster, 0.0), STRAY)
        most = graph.node("Add", graph.node("Max", faster, 0.0), STRAY)
        possible = self._both(
            self._within(along, least, most),
            self._within(faster, -SLOWER_BY, FASTER_BY),
            self._within(across, -ASIDE, ASIDE),
            self._now(here),
            self._was(there),
        )
        origin = graph.node("Sub", self._seen(X), self._seen(VX))
        came = self._both(here, graph.node("Not", self._some(possible, 2)), self._well_in_view(origin, before))
        went = self._both(there, graph.node("Not", self._some(possible, 1)), self._well_in_view(expected, "obs"))
        return self._any_car(self._either(came, went))

    def _well_in_view(self, x: str, rows: str) -> str:
        graph = self.graph
        ego_x = graph.reshape(graph.cut(graph.cut(rows, 0, 1, 1), X, X + 1, 2), -1, 1)
        away = graph.node("Abs", graph.node("Sub", self._column(rows, X), ego_x))
        farthest = graph.node("ReduceMax", away, axes=[1], keepdims=1)
        some_absent = self._any_car(graph.node("Not", self._here(rows)))
        edge = graph.node("Sub", graph.node("Where", some_absent, SIGHT, farthest), COMING)
        return graph.node("Less", graph.node("Abs", graph.node("Sub", x, ego_x)), edge)

    def _off_lane(self) -> str:
        lane = self.graph.node("Round", self.graph.node("Mul", self._seen(Y), 1 / LANE_WIDTH))
        return self.graph.node("Abs", self.graph.node("Sub", self._seen(Y), self.graph.node("Mul", lane, LANE_WIDTH)))

    def _aside(self) -> str:
        return self.graph.node("Abs", self._seen(VY))

    def _seen(self, index: int) -> str:
        return self._column("obs", index)

    def _column(self, rows: str, index: int) -> str:
        """Return a feature of every car but the ego (B, V - 1)."""
        others = self.graph.cut(rows, 1, self.cars + 1, 1)
        return self.graph.reshape(self.graph.cut(others, index, index + 1, 2), -1, self.cars)

    def _here(self, rows: str) -> str:
        return self._above(self._column(rows, PRESENCE), 0.5)

    def _now(self, values: str) -> str:
        return self.graph.reshape(values, -1, self.cars, 1)

    def _was(self, values: str) -> str:
        return self.graph.reshape(values, -1, 1, self.cars)

    def _above(self, value: str, least: float) -> str:
        return self.graph.node("Greater", value, least)

    def _below(self, value: str, most: float) -> str:
        return self.graph.node("Less", value, most)

    def _within(self, value: str, least: str | float, most: str | float) -> str:
        return self._both(self.graph.node("GreaterOrEqual", value, least), self.graph.node("LessOrEqual", value, most))

    def _both(self, first: str, *others: str) -> str:
        for other in others:
            first = self.graph.node("And", first, other)
        return first

    def _either(self, first: str, second: str) -> str:
        return self.graph.node("Or", first, second)

    def _some(self, tests: str, axis: int) -> str:
        axes = self.graph.constant([axis], np.int64)
        return self._above(self.graph.node("ReduceSum", self.graph.number(tests), axes, keepdims=0), 0.5)

    def _any_car(self, tests: str) -> str:
        return self.graph.reshape(self._some(tests, 1), -1, 1)
