"""What an agent is, whatever it is called: a driver of this package, or trained by it and by which method."""

import math
from typing import Any

from rapid.agents.open import kind_of
from rapid.agents.q_agent import QAgent

OTHER = "other"
"""What all others are: models of other origin, teachers, and agents behind a filter, a monitor or a defence."""


def origin_of(agent: Any) -> str:
    """Return what an agent is: the spec of a scripted driver or planner, the method of what was trained, or `other`.

    What wraps an agent is not that agent, though it finds all that the agent has.
    """
    from rapid.teacher.scripted import Scripted

    if isinstance(agent, Scripted):
        return agent.driver
    if isinstance(agent, QAgent):
        method = _method(agent.network.config.kind, agent.metadata)
        return method + "+shield" * bool(method != OTHER and agent.network.config.shield)
    if kind_of(agent) != "planner":
        return OTHER
    from rapid.simulator.belief import CarsPlanner, ObservationPlanner
    from rapid.simulator.search import PlannerAgent

    planners = {PlannerAgent: "planner", CarsPlanner: "planner-cars", ObservationPlanner: "planner-observation"}
    return planners.get(type(agent), OTHER)


def _method(kind: str, metadata: Any) -> str:
    """Return the method by which a network was trained, by the ids of :mod:`rapid.experiments.methods`.

    Told from the settings that were saved with it, so that no name counts.
    """
    if at(metadata, "phase") == "distill":
        return _offline(kind, at(metadata, "config", "distill"))
    if at(metadata, "phase") == "adapt":
        return _online(kind, at(metadata, "config", "adapt"), metadata)
    return OTHER


def _offline(kind: str, settings: Any) -> str:
    robust, conservative = (_number(settings, "loss", f"{name}_weight") for name in ("robust", "conservative"))
    algorithm = at(settings, "optimizer", "algorithm")
    if algorithm == "bc":
        return "bc" if kind == "mlp" else OTHER
    if kind == "rapid" and conservative > 0:
        return "distilled" if robust > 0 else "distilled-without-robust"
    if kind == "mlp" and algorithm == "dqn" and robust == 0:
        is_double = at(settings, "loss", "double") is True
        return "cql" if conservative > 0 else "offline-ddqn" if is_double else "offline-dqn"
    return OTHER


def _online(kind: str, settings: Any, metadata: Any) -> str:
    if kind == "rapid" and at(settings, "train") in ("adapter", "all"):
        lied_to = [_number(settings, "adversary", name) for name in ("gradient_share", "noise_share")]
        if any(share > 0 for share in lied_to):
            return "rapid-robust"
        return "rapid-without-robust" if _number(metadata, "robust_weight") == 0 else "rapid"
    plain = at(settings, "loss", "double") is False and _number(settings, "loss", "munchausen_weight") == 0
    if kind == "mlp" and at(settings, "train") == "scratch" and plain and _number(settings, "ppo", "steps") == 0:
        return "online-dqn"
    return OTHER


def at(value: Any, *names: str) -> Any:
    """Return what stands under these names in nested dictionaries that somebody wrote; None if nothing does."""
    for name in names:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _number(value: Any, *names: str) -> float:
    found = at(value, *names)
    return float(found) if isinstance(found, int | float) else math.nan
