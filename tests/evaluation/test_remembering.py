"""Agents with a memory, driven and attacked."""

import numpy as np
import pytest
import torch

from rapid.agents.saved import QAgent, remembered
from rapid.attacks import get_attack
from rapid.attacks.attack import values_of
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation import rollouts
from rapid.evaluation.recording import explained_by
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.conversions import with_memory
from rapid.networks.memory import STEPS, initial_state, next_state
from rapid.networks.q_network import build_network
from rapid.scenarios import FASTER, SLOWER
from rapid.simulator import make_vec

SCENARIO = "lane-3-density-2"


class Timer:
    """Drives by its memory alone: so many SLOWER, then FASTER."""

    name, has_memory = "timer", True

    def __init__(self, slower=20):
        self.slower, self.states = slower, []

    def start(self, worlds):
        return initial_state(worlds, 3)

    def remember(self, state_BS, action_B):
        return next_state(state_BS, action_B, 3)

    def act(self, obs_BVF, state_BS):
        assert len(obs_BVF) == len(state_BS)
        self.states.append(state_BS.copy())
        return np.where(state_BS[:, STEPS] < self.slower, SLOWER, FASTER)


def remembering():
    network = with_memory(build_network(NetworkConfig(), 3, 1))
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        network.gate.fill_(0.5)
        network.memory.out.weight.normal_(0, 0.3, generator=generator)
    return QAgent(network, "it")


def test_each_episode_begins_with_an_empty_memory(monkeypatch):
    monkeypatch.setattr(rollouts, "MAX_WORLDS", 3)
    timer = Timer()
    episodes = run_episodes(timer, SCENARIO, list(range(900_000, 900_008)))
    # Three turns of 3, 3 and 2 worlds; whoever has crashed is asked no more.
    assert [len(state) for state in timer.states if (state[:, STEPS] == 0).all()] == [3, 3, 2]
    assert all((state[:, STEPS] == state[0, STEPS]).all() for state in timer.states)
    late = episodes.length_E >= 21
    assert late.sum() > 4
    assert (episodes.counts_EA[late, SLOWER] == 20).all()
    assert (episodes.counts_EA[late, FASTER] == episodes.length_E[late] - 20).all()
    # No noise reaches a plan that only counts.
    noisy = run_episodes(Timer(), SCENARIO, list(range(900_000, 900_008)), "uniform")
    np.testing.assert_array_equal(noisy.return_E, episodes.return_E)


def test_an_episode_does_not_depend_on_those_beside_it():
    agent, seeds = remembering(), list(range(900_000, 900_006))
    for attack in (None, "uniform", "pgd"):
        together = run_episodes(agent, SCENARIO, seeds, attack)
        alone = [run_episodes(agent, SCENARIO, [seed], attack).return_E[0] for seed in seeds]
        np.testing.assert_allclose(together.return_E, alone, rtol=1e-6)


@pytest.mark.parametrize("name", ["fgsm", "pgd", "square", "directed"])
def test_an_attack_knows_the_memory_and_cannot_move_it(name):
    agent, env = remembering(), make_vec(SCENARIO, 5)
    obs, _ = env.reset(seed=list(range(5)))
    state, asked, forward = next_state(agent.start(5), np.array([0, 1, 2, 3, 4]), 3), [], agent.network.forward

    def watched(given_BVF, state_BS):
        asked.append(state_BS.clone())
        return forward(given_BVF, state_BS)

    agent.network.forward = watched
    values = values_of(agent, state)
    streams = [torch.Generator().manual_seed(i) for i in range(5)]
    seen = get_attack(name, 3)(values, torch.from_numpy(obs), streams)
    assert not torch.equal(seen, torch.from_numpy(obs))
    states = {tuple(row) for given in asked for row in given.tolist()}
    assert states == {tuple(row) for row in torch.from_numpy(state).tolist()}


def test_what_is_said_of_a_decision_is_of_the_state_it_was_made_in():
    agent = remembering()
    (recorded,) = run_episodes(agent, SCENARIO, [900_000], record=True).recordings
    state = agent.start(1)
    for step, action in enumerate(recorded.action_T):
        q_A = agent.q_values(recorded.obs_TVF[step : step + 1, :15], state)[0]
        np.testing.assert_allclose(recorded.q_TA[step], q_A, rtol=1e-5, atol=1e-6)
        assert q_A.argmax() == action
        state = agent.remember(state, np.array([action]))


def test_a_recording_is_explained_with_what_was_remembered():
    agent = remembering()
    (recorded,) = run_episodes(agent, SCENARIO, [900_000], record=True).recordings
    states = remembered(agent, recorded.action_T)
    assert states.shape == (len(recorded.action_T) + 1, 6)
    assert states[:, STEPS].tolist() == list(range(len(recorded.action_T) + 1))
    told = agent.explain(recorded.obs_TVF[:-1, :15], states[:-1])
    np.testing.assert_allclose(told.q_BA.numpy(), recorded.q_TA, rtol=1e-4, atol=1e-5)
    explained = explained_by(agent, recorded)
    np.testing.assert_allclose(explained.weights_TVN, told.weights_BVN.numpy(), rtol=1e-4, atol=1e-5)
    assert remembered(QAgent(build_network(NetworkConfig(), 3, 1)), recorded.action_T) is None


def test_who_forgets_the_state_is_told():
    agent = remembering()
    obs = np.array(make_vec(SCENARIO, 2).reset(seed=[1, 2])[0])
    with pytest.raises(RapidError, match=r"agent\.start"):
        agent.act(obs)
