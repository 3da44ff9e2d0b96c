"""Our gradient attack against foolbox's, an implementation by others, on observations that a teacher met."""

import pytest
import torch
from torch import nn

from rapid.attacks.attack import Base
from rapid.attacks.search import Aim, Runs, ascend
from rapid.attacks.spec import parse_attack
from rapid.config import NetworkConfig
from rapid.data.dataset import load_dataset
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import QNetwork, build_network

foolbox = pytest.importorskip("foolbox")

SCALE = feature_scale(3)
OBSERVATIONS, RADIUS = 512, 0.1
ROOM = 40.0
"""Foolbox wants inputs between 0 and 1 and clips them there: normalised features within half of this fit, with room."""


class ForFoolbox(nn.Module):
    """A network as foolbox takes it: inputs between 0 and 1."""

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return self.network((inputs - 0.5) * ROOM * SCALE)


class Everything(Base):
    """What a ball is for a spec: only used for its ball."""

    def __call__(self, network, obs_BVF, source):
        return obs_BVF


@pytest.fixture(scope="module")
def data():
    transitions = load_dataset("shipped:lane-3-density-2/teacher").transitions
    obs = torch.from_numpy(transitions.obs_NVF).float()
    obs = obs[obs[:, 0, 1] < ROOM / 2 * 200 * 0.9]
    actions = torch.from_numpy(transitions.action_N)[: len(obs)]
    return obs[:4096], actions[:4096]


@pytest.fixture(scope="module", params=["rapid", "mlp"])
def network(request, data):
    """Give a network that has learned something of the data, so that its gradients are those of a policy."""
    obs, actions = data
    settings = NetworkConfig(kind=request.param, width=16, heads=2, feedforward=32, hidden=(64, 64))
    network = build_network(settings, 3, 0)
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(120):
        rows = torch.randint(len(obs), (128,), generator=generator)
        loss = nn.functional.cross_entropy(network(obs[rows]), actions[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network.eval()


@pytest.mark.parametrize(("steps", "step"), [(1, RADIUS), (10, 0.01), (20, 0.01)])
def test_the_loss_at_adversarial_points_agrees_within_a_percent(network, data, steps, step):
    obs = data[0][:OBSERVATIONS]
    assert len(obs) == OBSERVATIONS
    with torch.no_grad():
        q = network(obs)
    aim = Aim("ce", q.argmax(1), q)
    ball = Everything(parse_attack(f"pgd:radius={RADIUS},presence=free"), 3).ball(network, obs)
    ours = ascend(network, obs, aim, ball, Runs(steps, step, keep="last"), torch.Generator())

    inputs = obs / SCALE / ROOM + 0.5
    attack = foolbox.attacks.LinfPGD(rel_stepsize=step / RADIUS, steps=steps, random_start=False)
    model = foolbox.PyTorchModel(ForFoolbox(network).eval(), bounds=(0, 1), device="cpu")
    _, clipped, _ = attack(model, inputs, aim.action_B, epsilons=RADIUS / ROOM)
    theirs = (clipped - 0.5) * ROOM * SCALE

    with torch.no_grad():
        clean, own, other = (aim(network(points)).mean().item() for points in (obs, ours, theirs))
    assert own > clean * 1.05
    assert own == pytest.approx(other, rel=0.01)
    best = ascend(network, obs, aim, ball, Runs(steps, step, keep="best"), torch.Generator())
    with torch.no_grad():
        assert aim(network(best)).mean().item() >= other * 0.999
