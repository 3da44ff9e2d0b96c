"""The attacker that drives copies of the true world on."""

import numpy as np
import pytest
import torch

from rapid.agents.saved import QAgent
from rapid.attacks import get_attack
from rapid.attacks.world import drive_on
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.rollouts import is_applicable, run_episodes
from rapid.networks.q_network import build_network
from rapid.scenarios import FASTER, SLOWER
from rapid.simulator import make_vec
from rapid.spawns import spawn_seeds

SCENARIO = "lane-3-density-2"
SEEDS = spawn_seeds("tune", 6)
CHEAP = "steps=5,horizon=5"


@pytest.fixture(scope="module")
def agent() -> QAgent:
    """Give an agent that prefers now this action, now that one."""
    network = build_network(NetworkConfig(width=16, heads=2, feedforward=32), 3, 2)
    env = make_vec(SCENARIO, 64, autoreset=False)
    obs, _ = env.reset(seed=0)
    with torch.no_grad():
        network.head.decoder.head.bias -= network(torch.from_numpy(obs)).mean(0)
    return QAgent(network, "undecided")


class Constant:
    name = "constant"

    def __init__(self, action):
        self.action = action

    def act(self, obs):
        return np.full(len(obs), self.action)


class Counting:
    """Speeds up from its third decision on: it counts them in its memory."""

    name, has_memory = "counting", True

    def start(self, worlds):
        return np.zeros((worlds, 1), np.float32)

    def act(self, obs, state):
        assert len(obs) == len(state)
        return np.where(state[:, 0] >= 2, FASTER, SLOWER)

    def remember(self, state, action):
        return state + 1


def alone(actions):
    """Return what worlds earn when they are driven so, one decision after the other."""
    env = make_vec(SCENARIO, len(SEEDS), autoreset=False)
    env.reset(seed=SEEDS)
    return sum(env.step(np.full(len(SEEDS), action))[1] for action in actions)


def test_driving_on_earns_what_the_worlds_pay_and_leaves_them_as_they_are():
    env = make_vec(SCENARIO, len(SEEDS), autoreset=False)
    env.reset(seed=SEEDS)
    before = env.state.copy()
    worlds = np.arange(len(SEEDS))
    first = np.full(len(SEEDS), SLOWER)
    earned = drive_on(Constant(FASTER), env.state, env.settings, worlds, first, 30)
    assert all(np.array_equal(a, b) for a, b in zip(env.state, before, strict=True))
    assert earned == pytest.approx(alone([SLOWER] + [FASTER] * 29))
    twice = drive_on(Constant(FASTER), env.state, env.settings, worlds[[3, 3]], np.array([SLOWER, FASTER]), 30)
    assert twice[0] == pytest.approx(earned[3])
    counted = drive_on(
        Counting(), env.state, env.settings, worlds, np.full(len(SEEDS), SLOWER), 6, Counting().start(len(SEEDS))
    )
    assert counted == pytest.approx(alone([SLOWER, SLOWER, FASTER, FASTER, FASTER, FASTER]))


def test_knowing_the_world_hurts_more_than_guessing_and_one_step_less_than_all(agent):
    clean, all_steps, one_step, twice = (
        run_episodes(agent, SCENARIO, SEEDS, attack, record=True)
        for attack in (None, f"world:{CHEAP}", f"world:budget=1,{CHEAP}", f"world:budget=1,{CHEAP}")
    )
    assert all_steps.return_E.mean() < one_step.return_E.mean() + 1e-9
    assert one_step.return_E.mean() < clean.return_E.mean()
    assert np.array_equal(one_step.return_E, twice.return_E)
    for attacked, calm in zip(one_step.recordings, clean.recordings, strict=True):
        # Until the one step that is attacked the episode is the same; after it the agent is left alone.
        same = np.flatnonzero(attacked.action_T[: len(calm.action_T)] != calm.action_T[: len(attacked.action_T)])
        at = same[0] if len(same) else len(calm.action_T)
        assert np.array_equal(attacked.obs_TVF[: at + 1], calm.obs_TVF[: at + 1])
        following = agent.act(attacked.obs_TVF[at + 1 : -1]) if at + 1 < len(attacked.action_T) else np.zeros(0)
        assert np.array_equal(following, attacked.action_T[at + 1 :])


def test_an_agent_without_gradients_is_attacked_as_well(agent):
    class Valued:
        name = "valued"

        def act(self, obs):
            return agent.act(obs)

        def q_values(self, obs):
            return agent.q_values(obs)

    assert is_applicable(Valued(), "world")
    clean, attacked = (run_episodes(Valued(), SCENARIO, SEEDS[:3], text) for text in ("none", "world:horizon=3"))
    assert attacked.return_E.mean() < clean.return_E.mean()


def test_what_cannot_be_is_refused(agent, roads):
    with pytest.raises(RapidError, match="compiled worlds"):
        run_episodes(agent, SCENARIO, SEEDS[:1], "world", simulator="highway-env")
    with pytest.raises(RapidError, match="needs more than observations"):
        get_attack("world")(agent.network, roads(1), torch.Generator())
    assert not is_applicable(Constant(SLOWER), "world")
