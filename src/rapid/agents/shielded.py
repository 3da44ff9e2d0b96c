"""The interval filter around any agent: networks, models of other origin, teachers and planners."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.agents.monitored import MonitoredAgent
from rapid.agents.open import kind_of
from rapid.agents.q_agent import QAgent
from rapid.agents.watchable import Watchable
from rapid.evaluation.metrics import Kind
from rapid.safety import IntervalFilter
from rapid.scenarios import SLOWER


def shielded(agent: Any, box: str, lanes: int) -> Any:
    """Return the agent behind the interval filter, called ``shield:BOX:NAME``; `agent` itself is left as it is.

    A network gets the filter behind its Q-values, so that gradients and exports see it, and of two with a monitor
    between them both do. So does whoever tells its
    Q-values: the best action that passes is taken. Of all others, an action that does not pass becomes SLOWER.

    Args:
        agent: anything that drives: it has ``act``, ``decide`` or ``bind``.
        box: what :func:`rapid.safety.read_box` reads, such as ``0.1`` or ``1m,0.5``; of a network that has a filter,
            this takes its place.
        lanes: lanes of the road; a network's own are taken instead.

    Raises:
        RapidError: there is no such box.
    """
    name = f"shield:{box}:{getattr(agent, 'name', type(agent).__name__)}"
    if isinstance(agent, QAgent):
        IntervalFilter(agent.network.lanes, box)
        network = copy.copy(agent.network)  # the weights are shared
        network.config = replace(network.config, shield=box)
        return QAgent(network, name, agent.metadata)
    filter_ = IntervalFilter(lanes, box)
    if isinstance(agent, MonitoredAgent):
        calm, wary = (shielded(each, box, lanes) for each in (agent.calm, agent.wary))
        return MonitoredAgent(calm, wary, agent.scenario, {**agent.metadata, "name": name})
    if callable(getattr(agent, "bind", None)):
        return ShieldedPlanner(agent, filter_, name)
    if callable(getattr(agent, "act", None)):
        return ShieldedAgent(agent, filter_, name)
    return ShieldedTeacher(agent, filter_, name)


class _Shielded(Watchable):
    """What all share; whatever else the agent has is found too."""

    def __init__(self, agent: Any, filter_: IntervalFilter, name: str) -> None:
        self.agent, self.filter, self.name = agent, filter_, name

    @property
    def kind(self) -> Kind:
        """What kind of agent it is."""
        return kind_of(self.agent)

    @property
    def shielded_lanes(self) -> int:
        """For roads with how many lanes the filter is."""
        return self.filter.lanes

    def __getattr__(self, name: str) -> Any:
        if name in ("agent", "network", "bind", "act", "decide", "q_values", "explain"):
            raise AttributeError(name)
        return getattr(self.agent, name)


class ShieldedAgent(_Shielded):
    """An agent with ``act`` behind the filter; with Q-values, if it tells them, that are filtered."""

    def __init__(self, agent: Any, filter_: IntervalFilter, name: str) -> None:
        super().__init__(agent, filter_, name)
        if callable(getattr(agent, "q_values", None)):
            self.q_values = self._filtered

    def act(self, obs_BVF: NDArray[np.float32], *state: Any) -> NDArray[np.int64]:
        """Return actions (B,) that pass."""
        if hasattr(self, "q_values"):
            return self._filtered(obs_BVF, *state).argmax(1)
        return self.filter.choose(np.asarray(self.agent.act(obs_BVF, *state), np.int64), obs_BVF)

    def _filtered(self, obs_BVF: NDArray[np.float32], *state: Any) -> NDArray[np.floating]:
        return self.filter.filtered(np.asarray(self.agent.q_values(obs_BVF, *state)), obs_BVF)


class ShieldedPlanner(_Shielded):
    """An agent that is bound to the worlds, behind the filter, which reads the observations."""

    def bind(self, env: Any) -> ShieldedAgent:
        """Return the agent of these worlds."""
        return ShieldedAgent(self.agent.bind(env), self.filter, self.name)


class ShieldedTeacher(_Shielded):
    """A teacher behind the filter; where it says otherwise, the decision tells so."""

    def decide(self, obs_BVF: NDArray[np.float32], previous: Sequence[Any], keys_B: Any = None) -> list[Any]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`."""
        decisions = self.agent.decide(obs_BVF, previous, keys_B)
        passes_BA = self.filter.passes(obs_BVF)
        return [
            decision if passes_BA[world, decision.action] else _overruled(decision)
            for world, decision in enumerate(decisions)
        ]


def _overruled(decision: Any) -> Any:
    words = f"{decision.explanation} " if decision.explanation else ""
    return replace(
        decision, action=SLOWER, explanation=f"{words}[The filter brakes: this is not safe.]", probabilities=None
    )
