"""The attacker that has the true world: of the actions in reach it takes the one after which driving on ends worst.

Each action that some point of the ball reaches is tried in a copy of the world, in which the agent then drives on
unattacked for some seconds. Under a budget of k steps an episode only those are attacked where it hurts most: an
attack waits for a step that costs as much as the k-th worst step of the same episode driven without attack (for k = 1
that is the one step that costs most).
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.agents.saved import moved_on, noticed, remembers
from rapid.attacks.attack import Base, Field, Moment, Needs, Shown, network_of, values_of
from rapid.attacks.directed import reachable, reachable_without_gradients
from rapid.attacks.draws import Source
from rapid.attacks.search import Runs
from rapid.errors import RapidError
from rapid.scenarios import NUM_VEHICLES, seeing
from rapid.simulator.settings import Settings
from rapid.simulator.state import State
from rapid.simulator.step import FREEZE, allocate_outputs, step_worlds

QUERIES = 100
"""Points tried for each action where the agent has no gradient."""


class WorldAttack(Base):
    """The reachable action that is worst for the agent in its true world."""

    needs: Needs = "values"

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Refuse: observations alone do not tell what comes of them.

        Raises:
            RapidError: always.
        """
        raise RapidError(
            f"The attack '{self.name}' drives copies of the true world on, so it needs more than observations: give it "
            "to run_episodes or `rapid evaluate`."
        )

    def begin(self, field: Field) -> Shown:
        """Return what is shown in these episodes; under a budget they are first driven without attack.

        Raises:
            RapidError: the worlds are not those of the compiled simulator.
        """
        if self.spec.budget == 0:
            return lambda now: self._worst(field, now)[0]
        left_B = np.full(len(field.streams), self.spec.budget)
        threshold_B = self._thresholds(field)

        def shown(now: Moment) -> Tensor:
            seen_BVF, cost_B = self._worst(field, now)
            attacked_B = (cost_B > 0) & (cost_B >= threshold_B[now.worlds]) & (left_B[now.worlds] > 0)
            left_B[now.worlds[attacked_B]] -= 1
            attacked_B11 = torch.from_numpy(attacked_B).to(seen_BVF.device)[:, None, None]
            return torch.where(attacked_B11, seen_BVF, now.obs_BVF)

        return shown

    def _worst(self, field: Field, now: Moment) -> tuple[Tensor, NDArray[np.float64]]:
        """Return what shows the worst action in reach, and by how much less it earns than the agent's own (B,)."""
        state = getattr(now.env, "state", None)
        if not isinstance(state, State):
            raise RapidError(f"The attack '{self.name}' copies compiled worlds. Leave out --simulator, or the attack.")
        within, points_BAVF = self._reach(field, now)
        within_BA = within.cpu().numpy()
        row_M, action_M = np.nonzero(within_BA)
        memory_MS = None
        if now.state_BS is not None:
            memory_MS = noticed(field.agent, points_BAVF[row_M, action_M].cpu().numpy(), now.state_BS[row_M])
        copies = drive_on(
            field.agent, state, now.env.settings, now.worlds[row_M], action_M, self.spec.horizon, memory_MS
        )
        earned_BA = np.full(within_BA.shape, np.inf)
        earned_BA[row_M, action_M] = copies
        with torch.no_grad():
            own_B = self.network(now.values)(now.obs_BVF).argmax(1).cpu().numpy()
        rows_B = np.arange(len(own_B))
        own_earned_B = earned_BA[rows_B, own_B]
        worst_B = np.where(earned_BA.min(1) < own_earned_B, earned_BA.argmin(1), own_B)
        return points_BAVF[rows_B, worst_B], own_earned_B - earned_BA[rows_B, worst_B]

    def _reach(self, field: Field, now: Moment) -> tuple[Tensor, Tensor]:
        values, ball, source = self.network(now.values), self.ball(now.values, now.obs_BVF), field.sources(now.worlds)
        if network_of(field.agent) is None:
            return reachable_without_gradients(values, now.obs_BVF, ball, QUERIES, source)
        spec = self.spec
        runs = Runs(spec.steps, spec.step, spec.restarts, spec.start, stop=True)
        return reachable(values, now.obs_BVF, ball, runs, source)

    def _thresholds(self, field: Field) -> NDArray[np.float64]:
        """Return for each episode the k-th largest cost of a step, as it is driven without attack (B,)."""
        from rapid.simulator import make_vec

        agent, count = field.agent, len(field.seeds)
        vehicles, network = getattr(agent, "vehicles", NUM_VEHICLES), network_of(agent)
        device = next(network.parameters()).device if network is not None else torch.device("cpu")
        env: Any = make_vec(field.scenario, count, autoreset=False, config=seeing(max(vehicles, NUM_VEHICLES)))
        obs_BVF, _ = env.reset(seed=list(field.seeds))
        memory_BS = np.array(agent.start(count), np.float32) if remembers(agent) else None
        alive_B, costs = np.ones(count, np.bool_), list[NDArray[np.float64]]()
        while alive_B.any():
            worlds = np.flatnonzero(alive_B)
            seen_RVF = np.ascontiguousarray(obs_BVF[worlds, :vehicles])
            memory_RS = None if memory_BS is None else memory_BS[worlds]
            obs_RVF = torch.from_numpy(seen_RVF).to(device)
            now = Moment(obs_RVF, worlds, values_of(agent, memory_RS), memory_RS, env)
            cost_B = np.full(count, -np.inf)
            cost_B[worlds] = self._worst(field, now)[1]
            costs.append(cost_B)
            action_B = np.zeros(count, np.int64)
            action_B[worlds], memory_RS = act_on(agent, seen_RVF, memory_RS)
            if memory_BS is not None:
                memory_BS[worlds] = memory_RS
            obs_BVF, _, terminated_B, truncated_B, _ = env.step(action_B)
            alive_B &= ~(terminated_B | truncated_B)
        env.close()
        ordered_BT = -np.sort(-np.stack(costs, 1), 1)
        return ordered_BT[:, min(self.spec.budget, ordered_BT.shape[1]) - 1]


def act_on(
    agent: Any, obs_BVF: NDArray[np.float32], memory_BS: NDArray[np.float32] | None
) -> tuple[NDArray[np.int64], NDArray[np.float32] | None]:
    """Return an agent's actions (B,), and what it remembers after them."""
    if memory_BS is None:
        return np.asarray(agent.act(obs_BVF), np.int64), None
    action_B = np.asarray(agent.act(obs_BVF, memory_BS), np.int64)
    return action_B, moved_on(agent, obs_BVF, memory_BS, action_B)


def drive_on(
    agent: Any,
    state: State,
    settings: Settings,
    worlds: NDArray[np.int64],
    actions_M: NDArray[np.int64],
    horizon: int,
    memory_MS: NDArray[np.float32] | None = None,
) -> NDArray[np.float64]:
    """Return what M copies of worlds earn in `horizon` decisions (M,): the first as given, the others the agent's.

    A world that ends earns nothing more.

    Args:
        agent: drives on; it has ``act`` and sees the true observations.
        state: the worlds, which are left as they are.
        settings: of their simulator.
        worlds: (M,), which of them; any number of times each.
        actions_M: the first decision of each copy.
        horizon: decisions.
        memory_MS: what the agent remembers at that decision, what it is shown there included, if it has a memory.
    """
    vehicles = getattr(agent, "vehicles", NUM_VEHICLES)
    state, earned_M, copies = state.take(worlds), np.zeros(len(actions_M)), np.arange(len(actions_M))
    if memory_MS is not None:
        memory_MS = agent.remember(memory_MS, actions_M)
    for step in range(horizon):
        out = allocate_outputs(len(copies), settings)
        step_worlds(state, np.ascontiguousarray(actions_M), settings, FREEZE, out)
        earned_M[copies] += out.rewards
        going = np.flatnonzero(~(out.terminated | out.truncated))
        if step == horizon - 1 or not len(going):
            break
        copies, state = copies[going], state.take(going)
        memory_MS = None if memory_MS is None else memory_MS[going]
        seen_MVF = np.ascontiguousarray(out.observations[going, :vehicles])
        actions_M, memory_MS = act_on(agent, seen_MVF, memory_MS)
    return earned_M
