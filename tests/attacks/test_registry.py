"""Attacks by name."""

import pytest
import torch

from rapid.attacks import NAMED, get_attack
from rapid.attacks.spec import with_options
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import build_network

NETWORK = build_network(NetworkConfig(width=16, heads=2, feedforward=32), 3, 0)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("name", NAMED)
def test_every_attack_keeps_its_input_its_shape_and_unless_asked_presence(roads, name):
    obs, attack = roads(8), get_attack(name)
    before = obs.clone()
    attacked = attack(NETWORK, obs, generator())
    assert torch.equal(obs, before)
    assert attacked.shape == obs.shape
    assert attacked.dtype == torch.float32
    assert torch.equal(attacked[..., 0], obs[..., 0])
    assert torch.equal(attacked, attack(NETWORK, obs, generator()))
    assert attack.name == name
    assert torch.equal(attacked, obs) is (name == "none")
    if name != "none":
        # The exact gradient by presence is zero for a network that only asks whether it is above one half.
        open_network = build_network(NetworkConfig(kind="mlp", mask_absent=False), 3, 0)
        assert (
            get_attack(with_options(NAMED[name], "presence=free"))(open_network, obs, generator())[..., 0]
            != obs[..., 0]
        ).any()


def test_noise_has_the_size_it_says(roads):
    obs = roads(4000)
    for name, spread in (("uniform", 0.4 / 12**0.5), ("gaussian", 0.2)):
        noise = (get_attack(name)(NETWORK, obs, generator()) - obs) / feature_scale(3)
        for feature in range(1, 5):
            assert noise[..., feature].std() == pytest.approx(spread, rel=0.02)
            assert noise[..., feature].mean() == pytest.approx(0, abs=0.004)
        if name == "uniform":
            assert noise.abs().max() <= 0.2 + 1e-5


@pytest.mark.parametrize("name", ["fgsm", "pgd"])
def test_gradient_attacks_go_against_the_agents_own_choice(roads, name):
    obs = roads(32)
    choice = NETWORK(obs).argmax(1)
    attacked = get_attack(name)(NETWORK, obs, generator())
    loss = torch.nn.functional.cross_entropy
    assert loss(NETWORK(attacked), choice) > loss(NETWORK(obs), choice)
    assert ((attacked - obs) / feature_scale(3)).abs().max() <= 0.1
    assert (NETWORK(attacked).argmax(1) != choice).any()


def test_the_lanes_of_the_road_can_be_given_so_that_every_agent_meets_the_same_attack(roads):
    obs = roads(16)
    own = (get_attack("fgsm")(NETWORK, obs, generator()) - obs)[..., 2].abs().max()
    given = (get_attack("fgsm", lanes=5)(NETWORK, obs, generator()) - obs)[..., 2].abs().max()
    assert own.item() == pytest.approx(1.2, abs=1e-3)
    assert given.item() == pytest.approx(2.0, abs=1e-3)
    assert get_attack("uniform", lanes=5)(None, obs, generator()).shape == obs.shape
    with pytest.raises(RapidError, match="number of lanes"):
        get_attack("uniform")(None, obs, generator())


def test_only_gradient_attacks_need_a_network():
    assert [name for name in NAMED if get_attack(name).needs_gradient] == ["fgsm", "pgd"]


def test_the_egos_own_row_stays_true_where_it_is_trusted(roads):
    obs = roads(8)
    for text in ("uniform:ego=trusted", "gaussian:ego=trusted", "fgsm:ego=trusted", "pgd:ego=trusted,steps=3"):
        seen = get_attack(text)(NETWORK, obs, generator())
        assert torch.equal(seen[:, 0], obs[:, 0])
        assert not torch.equal(seen[:, 1:], obs[:, 1:])


def test_a_box_in_metres_is_a_box_in_metres(roads):
    obs = roads(64)
    for text in ("uniform:metres=1,speed=0.5", "pgd:metres=1,speed=0.5,steps=3,restarts=3"):
        moved = (get_attack(text)(NETWORK, obs, generator()) - obs).abs().amax((0, 1))
        assert (moved <= torch.tensor([0, 1, 1, 0.5, 0.5]) + 1e-4).all()
        assert (moved[1:] > torch.tensor([0.9, 0.9, 0.45, 0.45])).all()


@pytest.mark.parametrize("text", ["uniform", "gaussian", "pgd:start=random,steps=2,restarts=4", "pgd:norm=l2,steps=2"])
def test_what_is_drawn_for_an_observation_does_not_depend_on_its_company(roads, text):
    obs, attack = roads(6), get_attack(text)
    sources = [torch.Generator().manual_seed(seed) for seed in range(6)]
    together = attack(NETWORK, obs, sources)
    for i in (5, 2):
        alone = attack(NETWORK, obs[i : i + 1], [torch.Generator().manual_seed(i)])
        assert torch.allclose(alone[0], together[i], atol=1e-3)


def test_mistakes_are_explained(roads):
    with pytest.raises(RapidError, match="did you mean 'fgsm'"):
        get_attack("fsgm")
    with pytest.raises(RapidError, match="needs the gradient"):
        get_attack("pgd")(None, roads(1), generator())
