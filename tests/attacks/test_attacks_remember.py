"""Every attack knows what an agent with a memory remembers, world by world, however many are still under way."""

import numpy as np
import pytest
import torch

from rapid.agents.saved import QAgent
from rapid.attacks.adversary import AdversaryAttack, train_adversary
from rapid.attacks.spec import KINDS, parse_attack
from rapid.config import NetworkConfig
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.spawns import spawn_seeds

SCENARIO = "lane-3-density-2"
SEEDS = spawn_seeds("tune", 5)
FEW = {"pgd": ":steps=3,restarts=3", "directed": ":steps=3", "square": ":queries=10", "coupled": ":steps=3,restarts=2"}
FEW |= {"world": ":steps=3,horizon=3", "none": ""}


@pytest.fixture(scope="module")
def agent() -> QAgent:
    """Give an agent whose memory tells: by the time alone it prefers now this action, now that one."""
    network = build_network(NetworkConfig(width=16, heads=2, feedforward=32, memory=True), 3, 2)
    with torch.no_grad():
        network.memory.out.weight.normal_(0, 0.5, generator=torch.Generator().manual_seed(1))
        obs, state = torch.zeros(30, 15, 5), torch.from_numpy(QAgent(network).start(30))
        state[:, 0] = torch.arange(30)
        network.head.decoder.head.bias -= network(obs, state).mean(0)
    return QAgent(network, "remembering")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("transfer", "adversary")])
def test_each_world_is_attacked_by_what_is_remembered_there(agent, kind):
    text = kind + FEW.get(kind, "")
    together = run_episodes(agent, SCENARIO, SEEDS, text)
    assert len(set(together.length_E.tolist())) > 1 or kind not in ("pgd", "world")  # some end before the others
    alone = [run_episodes(agent, SCENARIO, [seed], text).return_E[0] for seed in SEEDS[3:]]
    assert together.return_E[3:] == pytest.approx(alone)


def test_an_adversary_is_trained_against_it_and_a_budget_is_kept(agent):
    spec = parse_attack("adversary:steps=2")
    director = train_adversary(agent, SCENARIO, spec, 200)
    attacked = run_episodes(agent, SCENARIO, SEEDS, AdversaryAttack(spec, 3, director))
    assert np.isfinite(attacked.return_E).all()
    clean, once = (run_episodes(agent, SCENARIO, SEEDS[:2], t) for t in ("none", "world:budget=1,steps=3,horizon=30"))
    assert (once.return_E <= clean.return_E + 1e-9).all()
