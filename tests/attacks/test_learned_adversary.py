"""The learned adversary: trained against one agent, saved like an agent, refused against others."""

import numpy as np
import pytest
import torch

from rapid.agents.saved import QAgent, load_agent, save_agent
from rapid.attacks import get_attack, parse_attack
from rapid.attacks.adversary import (
    EPISODE,
    AdversaryAttack,
    fingerprint,
    save_adversary,
    train_adversary,
    with_clock,
)
from rapid.attacks.attack import Field, Moment
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.scenarios import FASTER, NUM_ACTIONS
from rapid.simulator import make_vec
from rapid.spawns import spawn_seeds

SCENARIO = "lane-3-density-2"
SPEC = parse_attack("adversary:steps=3")


@pytest.fixture(scope="module")
def agent() -> QAgent:
    """Give an agent that prefers now this action, now that one."""
    network = build_network(NetworkConfig(kind="mlp", hidden=(32,)), 3, 2)
    env = make_vec(SCENARIO, 64, autoreset=False)
    obs, _ = env.reset(seed=0)
    with torch.no_grad():
        network.head.mlps[0][-1].bias -= network(torch.from_numpy(obs)).mean(0)
    return QAgent(network, "undecided")


@pytest.fixture(scope="module")
def trained(agent, tmp_path_factory):
    rounds = []
    director = train_adversary(agent, SCENARIO, SPEC, 9_000, progress=lambda done, mean: rounds.append((done, mean)))
    folder = tmp_path_factory.mktemp("adversary") / "of-undecided"
    save_adversary(folder, director, agent, SCENARIO, SPEC, 9_000)
    return folder, rounds, director


def test_training_changes_no_weight_of_the_agent_and_hurts_it(agent, trained):
    folder, rounds, director = trained
    seeds = spawn_seeds("tune", 40)
    clean, attacked = (run_episodes(agent, SCENARIO, seeds, text) for text in ("none", f"adversary:{folder},steps=3"))
    assert attacked.return_E.mean() < clean.return_E.mean() - 1
    assert sum(done for done, _ in rounds) == 9_000
    # What it learned is worth more than the same search without it: a network that has learned nothing.
    untrained = build_network(director.config, 3, 5)
    chance = AdversaryAttack(SPEC, 3, untrained)
    assert attacked.return_E.mean() < run_episodes(agent, SCENARIO, seeds, chance).return_E.mean()
    loaded = load_agent(folder)
    assert loaded.metadata["adversary_of"] == fingerprint(agent.network)
    assert loaded.metadata["attack"] == "adversary:steps=3"


def test_it_takes_the_action_of_least_value_in_reach(agent, roads):
    director = build_network(NetworkConfig(kind="mlp", hidden=(8,)), 3, 0)
    with torch.no_grad():
        for parameter in director.parameters():
            parameter.zero_()
        director.head.mlps[0][-1].bias[FASTER] = -1
    attack, obs = AdversaryAttack(parse_attack("adversary:steps=10"), 3, director), roads(24)
    sources = [torch.Generator().manual_seed(i) for i in range(24)]
    within, _ = attack.reach(agent.network, obs, sources)
    seen = attack.begin(Field(agent, sources))(Moment(obs, np.arange(24), agent.network))
    taken = agent.network(seen).argmax(1)
    assert within[:, FASTER].any()
    assert (taken[within[:, FASTER]] == FASTER).all()


def test_the_clock_runs_with_the_episode(roads):
    clocked = with_clock(roads(2), torch.tensor([0, EPISODE]))
    assert clocked[:, 0, 0].tolist() == [1, 2]
    assert torch.equal(clocked[:, 1:], roads(2)[:, 1:])


def test_it_is_refused_against_another_agent_and_without_one(agent, trained, tmp_path):
    folder, _, _ = trained
    other = QAgent(build_network(NetworkConfig(kind="mlp", hidden=(32,)), 3, 7), "other")
    with pytest.raises(RapidError, match=r"trained against another agent than 'other'"):
        run_episodes(other, SCENARIO, [0], f"adversary:{folder}")
    with pytest.raises(RapidError, match="names no adversary"):
        run_episodes(agent, SCENARIO, [0], "adversary")
    save_agent(tmp_path / "plain", other.network, {})
    with pytest.raises(RapidError, match="is an agent and no adversary"):
        get_attack(f"adversary:{tmp_path / 'plain'}", 3)

    class Without:
        name = "without"

        def act(self, obs):
            return np.zeros(len(obs), int)

    with pytest.raises(RapidError, match="has no network"):
        train_adversary(Without(), SCENARIO, SPEC, 100)
    assert len(agent.network(torch.zeros(1, 15, 5))[0]) == NUM_ACTIONS
