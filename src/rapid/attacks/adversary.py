"""A learned adversary: it knows one agent, and which of the actions in reach costs that agent most in the long run.

What an attack does to an agent without a memory it does through the action that is taken. So the adversary learns what
each action leads to if it goes on attacking: Q(s, a), the return that is left to the agent, by Monte Carlo control in
the compiled simulator; at every step it shows a point at which the agent takes the action of least value among those
that some point of the ball reaches. This splits the problem as Sun et al. (2022) do, "Who Is the Strongest Enemy?
Towards Optimal and Efficient Evasion Attacks in Deep RL": a director that learns, and an actor that searches.

Shapes: W worlds, T steps.
"""

import hashlib
import math
import os
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.agents.saved import load_agent, remembers, save_agent
from rapid.attacks.attack import Base, Field, Moment, Needs, Shown, network_of, values_of
from rapid.attacks.directed import reachable
from rapid.attacks.draws import Source
from rapid.attacks.search import Runs, Values
from rapid.attacks.spec import AttackSpec
from rapid.attacks.world import act_on
from rapid.config_learning import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.q_network import QNetwork, build_network
from rapid.scenarios import NUM_VEHICLES, get_scenario, seeing
from rapid.seeding import numpy_stream, torch_stream
from rapid.spawns import train_part

EPISODE = 30
"""Decisions of an episode: the adversary counts them, for what is left depends on it."""
SCALE = 10.0
"""Return that the network's output of 1 stands for."""
WORLDS, KEPT, UPDATES, BATCH, RATE = 64, 8, 150, 256, 1e-3
"""Worlds driven at once; rounds of episodes that are learned from; gradient steps after each round, their batch, and
Adam's step size."""
LEAST_EXPLORATION = 0.1
"""Share of steps with an action drawn from those in reach; it falls from 1 over the first half of the training."""


class AdversaryAttack(Base):
    """Shows what leads to the reachable action of least value, as an adversary has learned it."""

    needs: Needs = "gradient"

    def __init__(self, spec: AttackSpec, lanes: int | None, network: QNetwork | None = None) -> None:
        super().__init__(spec, lanes)
        self.director, self.victim = network, ""
        if network is None and spec.source:
            adversary = load_agent(spec.source)
            self.director, self.victim = adversary.network, str(adversary.metadata.get("adversary_of", ""))
            if not self.victim:
                raise RapidError(
                    f"'{spec.source}' is an agent and no adversary. Train one with `rapid adversary`, or attack with "
                    f"transfer:{spec.source}."
                )

    def check(self, agent: Any) -> None:
        """Check that this adversary was trained against the agent.

        Raises:
            RapidError: there is none, or it was trained against another agent.
        """
        if self.director is None:
            raise RapidError(
                f"The attack '{self.name}' names no adversary. Train one with `rapid adversary AGENT --out DIRECTORY` "
                "and write adversary:DIRECTORY."
            )
        if self.victim and (network := network_of(agent)) is not None and fingerprint(network) != self.victim:
            raise RapidError(
                f"The adversary '{self.spec.source}' was trained against another agent than "
                f"'{getattr(agent, 'name', 'this one')}' (or other weights of it). Train one against it: "
                "`rapid adversary AGENT --out DIRECTORY`."
            )

    def begin(self, field: Field) -> Shown:
        """Return what is shown in these episodes, whose steps are counted."""
        self.check(field.agent)
        steps_B = np.zeros(len(field.streams), np.int64)

        def shown(now: Moment) -> Tensor:
            values, source = self.network(now.values), field.sources(now.worlds)
            within_BA, points_BAVF = self.reach(values, now.obs_BVF, source)
            action_B = self.prefer(now.obs_BVF, steps_B[now.worlds], within_BA).argmin(1)
            steps_B[now.worlds] += 1
            return points_BAVF[torch.arange(len(action_B), device=action_B.device), action_B]

        return shown

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return what is shown in a first step."""
        within_BA, points_BAVF = self.reach(self.network(network), obs_BVF, source)
        action_B = self.prefer(obs_BVF, np.zeros(len(obs_BVF), np.int64), within_BA).argmin(1)
        return points_BAVF[torch.arange(len(action_B), device=action_B.device), action_B]

    def reach(self, values: Values, obs_BVF: Tensor, source: Source) -> tuple[Tensor, Tensor]:
        """Return which actions are in reach (B, A), and where (B, A, V, F)."""
        spec = self.spec
        runs = Runs(spec.steps, spec.step, spec.restarts, spec.start, stop=True)
        return reachable(values, obs_BVF, self.ball(values, obs_BVF), runs, source)

    @torch.no_grad()
    def prefer(self, obs_BVF: Tensor, steps_B: NDArray[np.int64], within_BA: Tensor) -> Tensor:
        """Return what each action leaves the agent (B, A); infinite where it is out of reach."""
        assert self.director is not None
        director = self.director.to(obs_BVF.device)
        q_BA = director(with_clock(obs_BVF, torch.from_numpy(steps_B).to(obs_BVF.device)))
        return torch.where(within_BA, q_BA, torch.inf)


def with_clock(obs_BVF: Tensor, steps_B: Tensor) -> Tensor:
    """Return observations whose ego's presence grows from 1 to 2 with the episode, as in scenarios with a clock."""
    clocked_BVF = obs_BVF.clone()
    clocked_BVF[:, 0, 0] = 1 + steps_B / EPISODE
    return clocked_BVF


def fingerprint(network: torch.nn.Module) -> str:
    """Return a digest of a network's weights, by which an adversary knows its agent again."""
    digest = hashlib.sha256()
    for name, weight in sorted(network.state_dict().items()):
        digest.update(name.encode() + b"\0" + weight.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def train_adversary(
    agent: Any,
    scenario: str,
    spec: AttackSpec,
    steps: int,
    seed: int = 0,
    progress: Callable[[float, float], None] | None = None,
) -> QNetwork:
    """Return the network of an adversary trained against an agent, which stays as it is.

    Args:
        agent: whom it attacks; it has a network.
        scenario: where.
        spec: of kind `adversary`: the ball, and how hard is searched in it.
        steps: decisions to learn from, in whole episodes; those that a crash cuts off count.
        seed: of traffic, exploration, weights and batches.
        progress: is called after each round with its share of the steps and the agent's mean return in it.

    Raises:
        RapidError: the agent has no network.
    """
    from rapid.simulator import make_vec

    if network_of(agent) is None:
        raise RapidError(
            f"'{getattr(agent, 'name', 'The agent')}' has no network, and an adversary searches by its gradient. "
            "Give the directory of a saved agent."
        )
    lanes, vehicles = get_scenario(scenario).lanes, getattr(agent, "vehicles", NUM_VEHICLES)
    settings = NetworkConfig(kind="mlp", input="near", hidden=(128, 128), vehicles=vehicles)
    director = build_network(settings, lanes, seed)
    attack = AdversaryAttack(spec, lanes, director)
    chance, source = numpy_stream(seed, "adversary"), torch_stream(seed, "adversary")
    optimizer = torch.optim.Adam(director.parameters(), RATE)
    worlds = min(WORLDS, math.ceil(steps / EPISODE))
    rounds = math.ceil(steps / (worlds * EPISODE))
    memory: deque[tuple[Tensor, Tensor, Tensor]] = deque(maxlen=KEPT)
    env: Any = make_vec(scenario, worlds, autoreset=False, config=seeing(max(vehicles, NUM_VEHICLES)))
    spawns = train_part("online")
    for number in range(rounds):
        exploration = max(1 - 2 * number / rounds, LEAST_EXPLORATION)
        seeds = chance.integers(spawns.start, spawns.stop, worlds).tolist()
        played, returns_W = _play(agent, attack, env, seeds, vehicles, exploration, chance, source)
        memory.append(played)
        _learn(director, optimizer, memory, source)
        if progress is not None:
            progress(steps / rounds, float(returns_W.mean()))
    env.close()
    return director


def _play(
    agent: Any,
    attack: AdversaryAttack,
    env: Any,
    seeds: list[int],
    vehicles: int,
    exploration: float,
    chance: np.random.Generator,
    source: torch.Generator,
) -> tuple[tuple[Tensor, Tensor, Tensor], NDArray[np.float64]]:
    """Drive one episode in each world; return observations with clock, actions and what was left, and the returns."""
    network = network_of(agent)
    device = next(network.parameters()).device if network is not None else torch.device("cpu")
    obs_WVF, _ = env.reset(seed=seeds)
    state_WS = np.array(agent.start(len(seeds)), np.float32) if remembers(agent) else None
    alive_W, rewards_TW = np.ones(len(seeds), np.bool_), list[NDArray[np.float64]]()
    steps: list[tuple[Tensor, NDArray[np.int64], NDArray[np.int64]]] = []
    while alive_W.any():
        worlds = np.flatnonzero(alive_W)
        obs_BVF = torch.from_numpy(np.ascontiguousarray(obs_WVF[worlds, :vehicles])).to(device)
        state_BS = None if state_WS is None else state_WS[worlds]
        values = values_of(agent, state_BS)
        assert values is not None
        within_BA, points_BAVF = attack.reach(values, obs_BVF, source)
        clock_B = np.full(len(worlds), len(steps))
        wanted_B = attack.prefer(obs_BVF, clock_B, within_BA).argmin(1).cpu().numpy()
        drawn_B = np.where(within_BA.cpu().numpy(), chance.random(within_BA.shape), -1).argmax(1)
        wanted_B = np.where(chance.random(len(worlds)) < exploration, drawn_B, wanted_B)
        seen_BVF = points_BAVF.cpu().numpy()[np.arange(len(worlds)), wanted_B]
        action_B, state_BS = act_on(agent, seen_BVF, state_BS)
        if state_WS is not None:
            state_WS[worlds] = state_BS
        action_W = np.zeros(len(seeds), np.int64)
        action_W[worlds] = action_B
        clocked_BVF = with_clock(obs_BVF.cpu(), torch.from_numpy(clock_B))
        steps.append((clocked_BVF, worlds, action_B))
        obs_WVF, reward_W, terminated_W, truncated_W, _ = env.step(action_W)
        rewards_TW.append(np.where(alive_W, reward_W, 0.0))
        alive_W &= ~(terminated_W | truncated_W)
    left_TW = np.cumsum(np.stack(rewards_TW)[::-1], 0)[::-1] / SCALE
    left = np.concatenate([left_TW[t, worlds] for t, (_, worlds, _) in enumerate(steps)])
    obs = torch.cat([obs_BVF for obs_BVF, _, _ in steps])
    actions = torch.from_numpy(np.concatenate([action_B for _, _, action_B in steps]))
    return (obs, actions, torch.from_numpy(left.astype(np.float32))), left_TW[0] * SCALE


def _learn(
    director: QNetwork,
    optimizer: torch.optim.Optimizer,
    memory: "deque[tuple[Tensor, Tensor, Tensor]]",
    source: torch.Generator,
) -> None:
    """Fit Q(s, a) to what was left after the actions taken."""
    obs, actions, left = (torch.cat(parts) for parts in zip(*memory, strict=True))
    for _ in range(UPDATES):
        rows = torch.randint(len(obs), (BATCH,), generator=source)
        values = director(obs[rows]).gather(1, actions[rows, None]).squeeze(1)
        loss = torch.nn.functional.mse_loss(values, left[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def save_adversary(
    directory: str | os.PathLike[str], director: QNetwork, agent: Any, scenario: str, spec: AttackSpec, steps: int
) -> None:
    """Write an adversary like an agent, with whom it was trained against.

    Raises:
        RapidError: the directory cannot be written.
    """
    victim = network_of(agent)
    assert victim is not None
    metadata = {
        "name": f"adversary of {getattr(agent, 'name', 'agent')}",
        "adversary_of": fingerprint(victim),
        "scenario": scenario,
        "attack": spec.name,
        "steps": steps,
    }
    save_agent(directory, director, metadata)
