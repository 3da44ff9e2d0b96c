"""Gradient ascent that keeps what it finds: inside the ball, nested, and what each loss is."""

import itertools

import pytest
import torch

from rapid.attacks import get_attack
from rapid.attacks.search import TEMPERATURE, Aim, Ball, Runs, ascend, own_action
from rapid.config import NetworkConfig
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import build_network

LOSSES = ("ce", "margin", "dlr", "min-q", "mad")


@pytest.fixture(params=["rapid", "mlp"])
def network(request):
    return build_network(NetworkConfig(kind=request.param, width=16, heads=2, feedforward=32, hidden=(32, 32)), 3, 2)


def sources(count):
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


def attacked(network, obs, text):
    return get_attack(text)(network, obs, sources(len(obs)))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_more_is_never_less_for_any_observation(roads, network, loss, norm):
    obs = roads(48)
    aim = own_action(network, obs, loss)
    texts = (f"fgsm:loss={loss},norm={norm}", *(f"pgd:steps={n},restarts=1,loss={loss},norm={norm}" for n in (10, 50)))
    texts += (f"pgd:steps=50,restarts=5,loss={loss},norm={norm}",)
    with torch.no_grad():
        found = [aim(network(obs))] + [aim(network(attacked(network, obs, text))) for text in texts]
    for weak, strong in itertools.pairwise(found):
        assert (strong >= weak - 1e-5 * (1 + weak.abs())).all()
    assert found[1].mean() > found[0].mean()
    assert found[2].mean() > found[1].mean()


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("options", ["", ",presence=free", ",ego=trusted", ",start=random"])
def test_everything_shown_lies_in_the_ball(roads, network, norm, options):
    obs = roads(12)
    obs[..., 1] *= 4
    seen = attacked(network, obs, f"pgd:steps=6,step=0.05,restarts=3,norm={norm}{options}")
    offset = (seen.double() - obs.double()) / feature_scale(3).double()
    length = offset.abs().amax((1, 2)) if norm == "linf" else offset.square().sum((1, 2)).sqrt()
    assert (length <= 0.1).all()
    assert (length > 0.05).all()


def test_losses_are_what_their_papers_say(roads, network):
    obs = roads(16)
    q, after = network(obs).detach(), network(roads(32)[16:]).detach()
    own = q.argmax(1)
    rows = torch.arange(16)
    others = after.clone()
    others[rows, own] = -torch.inf
    margin = others.amax(1) - after[rows, own]
    ordered = after.sort(1, descending=True).values
    p, p_after = (q / TEMPERATURE).softmax(1), (after / TEMPERATURE).softmax(1)
    expected = {
        "ce": torch.nn.functional.cross_entropy(after, own, reduction="none"),
        "margin": margin,
        "dlr": margin / (ordered[:, 0] - ordered[:, 2]),
        "min-q": -(p_after * q).sum(1),
        "mad": (p * (p / p_after).log()).sum(1),
    }
    for loss in LOSSES:
        assert torch.allclose(Aim(loss, own, q)(after), expected[loss], rtol=1e-4, atol=1e-5), loss
    reached = Aim("toward", own, q)
    assert torch.equal(reached(after) > 0, after.argmax(1) == own)
    assert torch.equal(reached.reached(after), ~Aim("ce", own, q).reached(after))


def test_an_observation_is_left_alone_once_its_aim_is_reached(roads):
    obs = roads(32)
    obs[:, 0, 3] = torch.linspace(0, 40, 32)
    calls = []

    def brakes_from_20_m_per_s_on(x):  # within reach of 8 m/s for some
        calls.append(len(x))
        speed = x[:, 0, 3]
        return torch.stack([0 * speed, 20 - speed, speed - 20], 1)

    aim = own_action(brakes_from_20_m_per_s_on, obs, "margin")
    runs = Runs(20, 0.0, restarts=2, stop=True)
    seen = ascend(
        brakes_from_20_m_per_s_on, obs, aim, Ball("linf", 0.1, feature_scale(3).repeat(15, 1)), runs, sources(32)
    )
    within = (obs[:, 0, 3] - 20).abs() < 7.99
    assert torch.equal(aim.reached(brakes_from_20_m_per_s_on(seen)), within)
    assert calls[1] == 32
    assert calls[-2] == int((~within).sum())  # the last is the line above


def test_weights_get_no_gradient_and_can_be_trained_afterwards(roads, network):
    frozen = next(network.parameters())
    frozen.requires_grad_(False)
    with torch.inference_mode():
        attacked(network, roads(4), "pgd:steps=2")
    assert not frozen.requires_grad
    assert sum(p.requires_grad for p in network.parameters()) == len(list(network.parameters())) - 1
    assert all(p.grad is None for p in network.parameters())
