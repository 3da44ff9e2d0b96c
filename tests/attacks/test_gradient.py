"""Gradient attacks: inside the ball, as strong as they claim, against an independent implementation."""

import math

import pytest
import torch
import torch.nn.functional as functional

from rapid.attacks.gradient import maximize_loss
from rapid.config import NetworkConfig, RobustConfig
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import build_network

SCALE = feature_scale(3)


@pytest.fixture(params=["rapid", "mlp"])
def network(request):
    return build_network(NetworkConfig(kind=request.param, width=16, heads=2, feedforward=32, hidden=(32, 32)), 3, 2)


def labels_of(network, obs):
    return functional.one_hot(network(obs).argmax(1), 5).float()


def loss_of(network, obs, labels):
    return -(labels * network(obs).log_softmax(1)).sum(1).detach()


def length(offset, norm):
    return offset.abs().amax((1, 2)) if norm == "linf" else offset.square().sum((1, 2)).sqrt()


def naive_pgd(network, obs, labels, norm, radius, steps, size, mask):
    """PGD written for clarity: one observation at a time, in normalised features."""
    found = []
    for row, label in zip(obs, labels, strict=True):
        origin = row / SCALE
        point = origin.clone()
        for _ in range(steps):
            point = point.detach().requires_grad_()
            loss = -(label * torch.log_softmax(network((point * SCALE)[None])[0], 0)).sum()
            loss.backward()
            gradient = point.grad * mask
            with torch.no_grad():
                if norm == "linf":
                    point = point + size * torch.sign(gradient)
                    point = torch.maximum(torch.minimum(point, origin + radius), origin - radius)
                else:
                    point = point + size * gradient / gradient.norm().clamp_min(1e-12)
                    away = point - origin
                    if away.norm() > radius:
                        point = origin + away * (radius / away.norm())
        found.append(point.detach() * SCALE)
    return torch.stack(found)


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("random_start", [False, True])
@pytest.mark.parametrize("presence", [False, True])
def test_attacked_observations_lie_inside_the_ball_after_float32_metres(roads, network, norm, random_start, presence):
    obs = roads(16)
    obs[..., 1] *= 4  # up to 2.4 km down the road, where float32 metres are coarse
    config = RobustConfig(norm, 0.1, 10, 0.05, random_start, presence)
    before = obs.clone()
    attacked = maximize_loss(network, obs, labels_of(network, obs), SCALE, config, 1.0, torch.Generator())
    assert torch.equal(obs, before)
    assert not attacked.requires_grad
    offset = (attacked.double() - obs.double()) / SCALE.double()
    assert (length(offset, norm) <= 0.1).all()
    assert (length(offset, norm) > 0.099).all()
    assert bool(offset[..., 0].any()) is presence
    if not presence:
        assert torch.equal(attacked[..., 0], obs[..., 0])


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("presence", [False, True])
def test_no_weaker_than_an_independent_implementation(roads, network, norm, presence):
    obs = roads(12)
    labels = labels_of(network, obs)
    config = RobustConfig(norm, 0.1, 10, 0.01, random_start=False, attack_presence=presence)
    ours = loss_of(network, maximize_loss(network, obs, labels, SCALE, config), labels)
    mask = torch.ones(5) if presence else torch.tensor([0.0, 1, 1, 1, 1])
    naive = loss_of(network, naive_pgd(network, obs, labels, norm, 0.1, 10, 0.01, mask), labels)
    assert ours.mean() > loss_of(network, obs, labels).mean()
    assert ours.mean() >= naive.mean() - 1e-3
    assert torch.allclose(ours, naive, atol=1e-2)


def test_pgd_is_at_least_as_strong_as_fgsm_on_average(roads, network):
    obs = roads(64)
    labels = labels_of(network, obs)
    fgsm = maximize_loss(network, obs, labels, SCALE, RobustConfig("linf", 0.1, 1, 0.1, random_start=False))
    pgd = maximize_loss(network, obs, labels, SCALE, RobustConfig("linf", 0.1, 10, 0.025, random_start=False))
    clean, weak, strong = (loss_of(network, x, labels).mean() for x in (obs, fgsm, pgd))
    assert clean < weak <= strong


def test_fgsm_steps_by_the_radius_along_the_sign_of_the_gradient(roads, network):
    obs = roads(5)
    labels = labels_of(network, obs)
    point = (obs / SCALE).requires_grad_()
    (gradient,) = torch.autograd.grad(-(labels * network(point * SCALE).log_softmax(1)).sum(), point)
    gradient[..., 0] = 0
    config = RobustConfig("linf", 0.1, 1, 0.1, random_start=False)
    moved = (maximize_loss(network, obs, labels, SCALE, config) - obs) / SCALE
    assert torch.allclose(moved, 0.1 * gradient.sign(), atol=1e-5)


def test_a_sure_network_is_attacked_with_full_steps(roads):
    # Its probability rounds to 1 in float32, where the textbook cross-entropy has no gradient.
    obs = roads(4)

    def confident(x):
        return torch.stack([60 + x[:, 0, 3], 0 * x[:, 0, 3], 0 * x[:, 0, 3]], 1)

    labels = torch.eye(3)[[0, 0, 0, 0]]
    for norm in ("linf", "l2"):
        config = RobustConfig(norm, 0.1, 4, 0.025, random_start=False)
        moved = (maximize_loss(confident, obs, labels, SCALE, config) - obs) / SCALE
        assert torch.allclose(moved[:, 0, 3], torch.tensor(-0.1), atol=1e-5)
        assert moved.abs().sum() == pytest.approx(0.4, abs=1e-4)


def test_where_the_gradient_is_zero_nothing_moves_and_nothing_is_nan(roads):
    obs = roads(3)
    for norm in ("linf", "l2"):
        attacked = maximize_loss(
            lambda x: x[:, :5, 0] * 0, obs, torch.eye(5)[:3], SCALE, RobustConfig(norm, random_start=False)
        )
        assert torch.equal(attacked, obs)


def test_radius_zero_changes_nothing(roads, network):
    obs = roads(3)
    for norm in ("linf", "l2"):
        attacked = maximize_loss(network, obs, torch.eye(5)[:3], SCALE, RobustConfig(norm, radius=0.0))
        assert torch.equal(attacked, obs)


def test_random_starts_are_uniform_in_the_ball(roads):
    obs = roads(2000)
    flat = lambda x: x[:, :5, 0] * 0  # noqa: E731
    labels = torch.eye(5)[:1].expand(2000, 5)
    generator = torch.Generator().manual_seed(0)
    cube = (maximize_loss(flat, obs, labels, SCALE, RobustConfig("linf", 0.1), 1.0, generator) - obs) / SCALE
    assert cube[..., 1:].mean().abs() < 1e-3
    assert cube[..., 1:].std() == pytest.approx(0.1 / math.sqrt(3), rel=0.02)
    ball = (maximize_loss(flat, obs, labels, SCALE, RobustConfig("l2", 0.1), 1.0, generator) - obs) / SCALE
    # In 60 dimensions the share of the volume within radius r is r^60.
    inside = (length(ball, "l2") / 0.1) ** 60
    assert inside.mean() == pytest.approx(0.5, abs=0.03)
    assert inside.std() == pytest.approx(1 / math.sqrt(12), abs=0.02)


def test_the_same_generator_gives_the_same_attack_and_no_parameter_gets_a_gradient(roads, network):
    obs = roads(6)
    config = RobustConfig()
    runs = []
    for mode in (torch.enable_grad, torch.no_grad, torch.inference_mode):
        with mode():
            seen = roads(6)
            runs.append(
                maximize_loss(
                    network, seen, torch.eye(5)[[0] * 6], SCALE, config, 1.0, torch.Generator().manual_seed(4)
                )
            )
    assert torch.equal(runs[0], runs[1])
    assert torch.equal(runs[0], runs[2])
    assert not torch.equal(runs[0], obs)
    assert all(p.grad is None and p.requires_grad for p in network.parameters())


def test_soft_labels_and_temperature_enter_the_loss(roads, network):
    obs = roads(8)
    soft = torch.full((8, 5), 0.2)
    config = RobustConfig("linf", 0.1, 5, 0.02, random_start=False)
    attacked = maximize_loss(network, obs, soft, SCALE, config, 0.5)
    before = -(soft * (network(obs) / 0.5).log_softmax(1)).sum(1).mean()
    assert -(soft * (network(attacked) / 0.5).log_softmax(1)).sum(1).mean() > before
