"""One way to ask all that can drive: agents, teachers that hear their last decision, planners in the world."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast, get_args

import numpy as np
from numpy.typing import NDArray

import rapid
from rapid.agents.saved import load_agent, moved_on, remembers
from rapid.agents.shipped import is_shipped
from rapid.agents.specs import MONITORED, SHIELD, monitored_parts, own_scenario
from rapid.defences import is_defence, unwrapped
from rapid.errors import RapidError, did_you_mean
from rapid.evaluation.metrics import Kind
from rapid.safety import read_box
from rapid.scenarios import get_scenario
from rapid.seeding import stream_seed
from rapid.teacher.decision import Decision

if TYPE_CHECKING:
    from rapid.agents.monitored import MonitoredAgent
    from rapid.agents.q_agent import QAgent

PLANNERS = ("planner", "planner-cars", "planner-observation")
"""Searches in the simulator: with perfect knowledge, of all cars but not of their drivers, and of what is observed."""

Said = tuple[NDArray[np.float32] | None, Decision | None]
"""The values of the actions, if the driver has any, and its decision, if it is one that speaks."""


class Driver(Protocol):
    """Whoever drives B worlds; only those in `worlds` are still under way."""

    def choose(
        self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64], seed_B: NDArray[np.int64], step: int
    ) -> NDArray[np.int64]:
        """Return one action for each of `worlds`, in their order."""
        ...

    def commentary(self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64]) -> Sequence[Said]:
        """Return what there is to say about the choice just made, for each of `worlds`."""
        ...

    def memory(self, worlds: NDArray[np.int64], count: int) -> NDArray[np.float32] | None:
        """Return the states of `worlds`, of `count` in all, before the next choice; None for who has no memory."""
        ...


def open_agent(spec: str, scenario: str, seed: int = 0, device: str = "cpu") -> Any:
    """Return the agent that `spec` names: a saved agent's directory, an ONNX file, or a driver's name.

    Before any of them may stand ``shield:BOX:``, which puts the interval filter around it (:mod:`rapid.safety`), with
    a radius such as 0.1 or metres and m/s such as 1m,0.5; before one with Q-values a defence (:mod:`rapid.defences`).
    ``monitored:CALM,WARY`` is two agents with a monitor between them (:mod:`rapid.monitor`).

    `seed` is for drivers that draw; `scenario` tells scripted drivers how many lanes there are; `device` is where a
    saved agent's network goes.

    Raises:
        RapidError: `spec` is none of them.
    """
    from rapid.teacher.scripted import SCRIPTED, Scripted

    if spec.startswith(SHIELD):
        from rapid.agents.shielded import shielded

        box, colon, inner = spec[len(SHIELD) :].partition(":")
        if not colon or not inner:
            raise RapidError(
                f"'{spec}' does not say what is shielded. Expected shield:BOX:AGENT, such as shield:0.1:slower."
            )
        lanes = get_scenario(scenario).lanes
        read_box(box, lanes)
        return shielded(open_agent(inner, scenario, seed, device), box, lanes)
    if spec.startswith(MONITORED):
        from rapid.agents.monitored import MonitoredAgent

        calm, wary = (open_agent(each, scenario, seed, device) for each in monitored_parts(spec))
        return MonitoredAgent(calm, wary, scenario)
    if is_defence(spec):
        from rapid.agents.defended import defended

        members, inner = unwrapped(spec)
        return defended(open_agent(inner, scenario, seed, device), members, scenario, seed)
    if spec in SCRIPTED or spec.startswith("blind:"):
        return Scripted(spec, get_scenario(scenario).lanes, seed, scenario)
    if spec in PLANNERS:
        from rapid.simulator.belief import CarsPlanner, ObservationPlanner
        from rapid.simulator.search import PlannerAgent

        if spec == "planner":
            return PlannerAgent()
        return CarsPlanner(seed=seed) if spec == "planner-cars" else ObservationPlanner(scenario, seed=seed)
    if is_shipped(spec) or Path(spec).is_dir():
        agent = rapid.load_agent(spec, device)
        if agent.metadata.get("adversary_of"):
            raise RapidError(
                f"'{spec}' is an adversary, which attacks a driver and drives nothing itself. Give the agent that it "
                f"was trained against, with --attacks adversary:{spec}."
            )
        return agent
    if Path(spec).suffix == ".onnx":
        from rapid.agents.onnx import OnnxAgent

        return OnnxAgent(spec)
    raise RapidError(
        f"There is no agent '{spec}'{did_you_mean(spec, (*SCRIPTED, *PLANNERS))} Give the directory of an agent that "
        f"`rapid distill` or `rapid adapt` wrote, an ONNX file, a scripted driver "
        f"({', '.join(SCRIPTED)}), or a planner ({', '.join(PLANNERS)})."
    )


def network_agent(spec: str, device: str = "cpu") -> "QAgent":
    """Return the agent with a network that `spec` names: a saved agent's directory, perhaps behind ``shield:BOX:``.

    Raises:
        RapidError: `spec` names none, or another kind of agent.
    """
    from rapid.agents.shielded import shielded

    if is_defence(spec):
        raise RapidError(
            f"'{spec}' is an agent behind a defence without training, which is neither exported nor certified. Give "
            "the agent alone, or with shield:BOX: before it."
        )
    if spec.startswith(MONITORED):
        raise RapidError(
            f"'{spec}' is two policies with a monitor between them, and nothing is certified of the monitor. Give one "
            f"of the two: {' or '.join(monitored_parts(spec))}."
        )
    if spec.startswith(SHIELD):
        box, _, inner = spec[len(SHIELD) :].partition(":")
        agent = network_agent(inner, device)
        return shielded(agent, box, agent.network.lanes)
    return load_agent(spec, device)


def exportable_agent(spec: str) -> "QAgent | MonitoredAgent":
    """Return the agent that `spec` names, if it can be exported: of one network, or of two with a monitor between them.

    Raises:
        RapidError: `spec` names none, or another kind of agent.
    """
    from rapid.agents.monitored import MonitoredAgent, is_monitored, load_monitored
    from rapid.agents.shielded import shielded

    box, colon, inner = spec.removeprefix(SHIELD).partition(":")
    if spec.startswith(SHIELD) and colon:
        agent = exportable_agent(inner)
        return shielded(agent, box, agent.network.lanes)
    if spec.startswith(MONITORED):
        calm, wary = map(network_agent, monitored_parts(spec))
        scenario = own_scenario([spec])
        return MonitoredAgent(calm, wary, scenario, {"scenario": scenario})
    return load_monitored(spec) if is_monitored(spec) else network_agent(spec)


def check_road(agent: Any, scenario: str) -> None:
    """Check that what an agent takes for the mirror image of the road is that, and the road its memory or filter knows.

    Raises:
        RapidError: it was made alike to left and right, remembers, or has a filter, on a road with other lanes.
    """
    lanes, own = get_scenario(scenario).lanes, getattr(agent, "mirrored_lanes", None)
    if own is not None and own != lanes:
        raise RapidError(
            f"'{getattr(agent, 'name', 'The agent')}' averages what it sees with its mirror image on {own} lanes "
            f"(network.mirror), but {scenario} has {lanes}. Drive it on {own} lanes, or train it without."
        )
    known = getattr(agent, "remembered_lanes", None)
    if known is not None and known != lanes:
        raise RapidError(
            f"'{getattr(agent, 'name', 'The agent')}' has a memory that knows a road of {known} lanes and where "
            f"episodes begin there, but {scenario} has {lanes}. Drive it on {known} lanes, or let it go on learning "
            f"with `rapid adapt AGENT --scenario {scenario} --steps 0` and steps of PPO."
        )
    own = getattr(agent, "shielded_lanes", None)
    if own is not None and own != lanes:
        raise RapidError(
            f"'{getattr(agent, 'name', 'The agent')}' has a safety filter for roads with {own} lanes, but {scenario} "
            f"has {lanes}. Drive it on {own} lanes."
        )


def kind_of(agent: Any) -> Kind:
    """Return what kind of agent this is: its own `kind` if it has one, else by what it offers."""
    own = getattr(agent, "kind", None)
    if own in get_args(Kind):
        return cast(Kind, own)
    if callable(getattr(agent, "decide", None)):
        return "teacher"
    return "planner" if callable(getattr(agent, "bind", None)) else "learned"


def driver_for(agent: Any, env: Any, generator_seed: int) -> Driver:
    """Return the driver that asks `agent`; `env` is for agents that need the worlds themselves.

    Raises:
        RapidError: `agent` is nothing that can drive.
    """
    if callable(getattr(agent, "bind", None)):
        return _AgentDriver(agent.bind(env), everywhere=True)
    if callable(getattr(agent, "act", None)):
        return _AgentDriver(agent, everywhere=False)
    if callable(getattr(agent, "decide", None)):
        return _TeacherDriver(agent, generator_seed)
    raise RapidError(
        f"{type(agent).__name__} cannot drive. Expected an agent with act(obs_BVF), a teacher with decide(...), or an "
        "agent with bind(env)."
    )


class _AgentDriver:
    """An agent with ``act``; one that was bound to the worlds gets all of them, so that its rows are theirs."""

    def __init__(self, agent: Any, everywhere: bool) -> None:
        self._agent, self._everywhere = agent, everywhere
        self._state_BS: NDArray[np.float32] | None = None
        self._before_BS: NDArray[np.float32] | None = None

    def memory(self, worlds: NDArray[np.int64], count: int) -> NDArray[np.float32] | None:
        if not remembers(self._agent):
            return None
        if self._state_BS is None:
            self._state_BS = np.array(self._agent.start(count), np.float32)
        return self._state_BS[worlds]

    def choose(
        self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64], seed_B: NDArray[np.int64], step: int
    ) -> NDArray[np.int64]:
        if (state_BS := self.memory(worlds, len(seen_BVF))) is not None and self._state_BS is not None:
            action_B = np.asarray(self._agent.act(seen_BVF[worlds], state_BS), np.int64)
            self._before_BS = state_BS
            self._state_BS[worlds] = moved_on(self._agent, seen_BVF[worlds], state_BS, action_B)
            return action_B
        if self._everywhere:
            return np.asarray(self._agent.act(seen_BVF), np.int64)[worlds]
        return np.asarray(self._agent.act(seen_BVF[worlds]), np.int64)

    def commentary(self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64]) -> Sequence[Said]:
        values = getattr(self._agent, "q_values", None)
        if not callable(values):
            return [(None, None)] * len(worlds)
        if self._before_BS is not None:
            return [(q_A, None) for q_A in np.asarray(values(seen_BVF[worlds], self._before_BS), np.float32)]
        q_BA = np.asarray(values(seen_BVF if self._everywhere else seen_BVF[worlds]), np.float32)
        return [(q_A, None) for q_A in (q_BA[worlds] if self._everywhere else q_BA)]


class _TeacherDriver:
    """A teacher, asked for the worlds under way only; it gets its own last decision of each world."""

    def __init__(self, teacher: Any, generator_seed: int) -> None:
        self._teacher, self._seed = teacher, generator_seed
        self.previous: dict[int, Any] = {}
        """Each world's last decision."""

    def memory(self, worlds: NDArray[np.int64], count: int) -> NDArray[np.float32] | None:
        return None

    def choose(
        self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64], seed_B: NDArray[np.int64], step: int
    ) -> NDArray[np.int64]:
        # A key names one decision, whatever else is asked beside it, so that a driver's chance does not depend on that.
        keys = [stream_seed(self._seed, f"decision/{seed_B[world]}/{step}") for world in worlds]
        previous = [self.previous.get(int(world)) for world in worlds]
        decisions = self._teacher.decide(seen_BVF[worlds], previous, np.array(keys, np.int64))
        for world, decision in zip(worlds, decisions, strict=True):
            self.previous[int(world)] = decision
        return np.array([int(decision.action) for decision in decisions], np.int64)

    def commentary(self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64]) -> Sequence[Said]:
        decisions = [self.previous[int(world)] for world in worlds]
        return [(None, decision if isinstance(decision, Decision) else None) for decision in decisions]
