"""Q-networks of every kind: symmetries, determinism, phases, explanations."""

from dataclasses import replace

import pytest
import torch

from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.conversions import widened
from rapid.networks.mlp import MlpHead
from rapid.networks.q_network import TokenHead, build_network, set_phase

SMALL = {"width": 16, "heads": 2, "feedforward": 32, "hidden": (24, 24)}
KINDS = ("rapid", "attentive", "mlp", "mlp-mixture")


def make(seed: int = 0, **settings):
    return build_network(NetworkConfig(**{**SMALL, **settings}), lanes=3, seed=seed)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reading", ["raw", "normalized", "ego", "near"])
@pytest.mark.parametrize("position", ["learned", "sinusoidal", "ego", "none"])
@pytest.mark.parametrize("token", ["prepend", "ego"])
def test_every_combination_gives_finite_q_values_and_gradients(roads, kind, reading, position, token):
    network = make(kind=kind, input=reading, position=position, action_token=token)
    q = network(roads(4))
    assert q.shape == (4, 5)
    q.sum().backward()
    assert q.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_weights_depend_on_the_seed_alone(kind):
    torch.manual_seed(1)
    state = torch.random.get_rng_state()
    first = make(kind=kind, seed=3).state_dict()
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.manual_seed(2)
    again, other = make(kind=kind, seed=3).state_dict(), make(kind=kind, seed=4).state_dict()
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


@pytest.mark.parametrize("token", ["prepend", "ego"])
@pytest.mark.parametrize("num_policies", [1, 3])
def test_without_positions_the_order_of_the_other_vehicles_does_not_matter(roads, token, num_policies):
    network = make(position="none", action_token=token, num_policies=num_policies, top_k=min(2, num_policies))
    obs = roads(6)
    order = torch.cat([torch.tensor([0]), 1 + torch.randperm(14, generator=torch.Generator().manual_seed(0))])
    assert torch.allclose(network(obs), network(obs[:, order]), atol=1e-5)
    if num_policies > 1:
        # The gate has an entry for each slot; open alike for all other vehicles, it keeps the symmetry.
        with torch.no_grad():
            network.head.mixture.gate_NV[:] = 0.7
            network.head.mixture.gate_NV[:, 0] = -0.4
        opened = network(obs)
        assert not torch.allclose(opened[0], opened[1])
        assert torch.allclose(opened, network(obs[:, order]), atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reading", ["raw", "near"])
def test_with_the_mirror_left_is_as_good_as_right(roads, kind, reading):
    obs, plain = roads(6), make(kind=kind, input=reading)
    network = make(kind=kind, input=reading, mirror=True)
    assert all(torch.equal(value, plain.state_dict()[key]) for key, value in network.state_dict().items())
    seen = network.encoding.mirrored(obs)
    left, idle, right, faster, slower = network(obs).unbind(1)
    assert torch.allclose(network(seen), torch.stack([right, idle, left, faster, slower], 1), rtol=1e-5, atol=1e-5)
    expected = (plain(obs)[:, 0] + plain(seen)[:, 2]) / 2
    assert torch.allclose(left, expected, rtol=1e-5, atol=1e-5)
    assert not torch.allclose(left, plain(obs)[:, 0])


def test_positions_tell_slots_apart(roads):
    obs = roads(3, absent=0)
    order = torch.tensor([0, *range(14, 0, -1)])
    for position in ("learned", "sinusoidal"):
        network = make(position=position)
        assert not torch.allclose(network(obs), network(obs[:, order]), atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("reading", ["raw", "normalized", "ego", "near"])
def test_absent_rows_never_matter_when_masked(roads, kind, reading):
    network = make(kind=kind, input=reading, position="ego", mask_absent=True)
    if kind == "rapid":
        with torch.no_grad():
            network.head.mixture.gate_NV.normal_(generator=torch.Generator().manual_seed(0))
    obs = roads(8, absent=0.5)
    absent = obs[..., 0] == 0
    junk = obs.clone()
    junk[absent] = torch.randn(int(absent.sum()), 5) * 1e3
    junk[..., 0] = obs[..., 0]
    assert torch.equal(network(obs), network(junk))
    junk = junk.requires_grad_()
    (gradient,) = torch.autograd.grad(network(junk).sum(), junk)
    assert not gradient[absent].any()
    assert gradient[~absent].any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("position", ["ego", "none", "sinusoidal"])
def test_rows_that_are_not_there_are_absent_and_more_are_not_read(roads, kind, position):
    network, obs = make(kind=kind, position=position, vehicles=31), roads(4)
    padded = torch.nn.functional.pad(obs, (0, 0, 0, 16))
    assert torch.equal(network(obs), network(padded))
    assert torch.equal(network.explain(obs).q_BA, network.explain(padded).q_BA)
    short = make(kind=kind, position=position, vehicles=8)
    assert torch.equal(short(obs), short(obs[:, :8]))


@pytest.mark.parametrize("position", ["ego", "none", "sinusoidal"])
@pytest.mark.parametrize("mirror", [False, True])
def test_a_widened_network_is_the_same_until_there_is_more_to_see(roads, position, mirror):
    network = make(position=position, num_policies=3, mirror=mirror)
    with torch.no_grad():
        network.head.mixture.gate_NV.normal_(generator=torch.Generator().manual_seed(0))
    wide, obs = widened(network, 31), roads(6, absent=0.3)
    assert wide.config == replace(network.config, vehicles=31)
    assert torch.allclose(wide(obs), network(obs), rtol=1e-5, atol=1e-6)
    gate_NV = network.head.mixture.gate_NV
    assert torch.equal(wide.head.mixture.gate_NV[:, :15], gate_NV)
    assert torch.equal(wide.head.mixture.gate_NV[:, 15:], gate_NV[:, -1:].expand(-1, 16))
    more = torch.cat([obs, roads(6, seed=1)], 1)
    assert not torch.allclose(wide(more), wide(obs), atol=1e-4)
    assert widened(network, 15) is network


@pytest.mark.parametrize(
    ("settings", "vehicles", "says"),
    [
        ({"kind": "mlp"}, 31, "weights for each of its 15 vehicles"),
        ({"position": "learned"}, 31, "weights for each of its 15 vehicles"),
        ({}, 14, "reads 15 vehicles"),
        ({"mask_absent": False}, 31, "attends to rows of absent vehicles"),
        ({}, 52, "between 2 and 51"),
    ],
)
def test_what_cannot_be_widened_says_why(settings, vehicles, says):
    with pytest.raises(RapidError, match=says):
        widened(make(**settings), vehicles)


def test_the_ego_is_distinguished_by_default(roads):
    network, obs = make(), roads(4, absent=0)
    swapped = obs[:, [1, 0, *range(2, 15)]]
    assert not torch.allclose(network(obs), network(swapped), atol=1e-5)


def test_a_mixture_with_one_policy_is_the_attentive_network(roads):
    attentive, rapid = make(kind="attentive"), make(kind="rapid", num_policies=1, top_k=1)
    assert attentive.state_dict().keys() == rapid.state_dict().keys()
    assert torch.equal(attentive(roads(4)), rapid(roads(4)))


def test_the_mlp_is_the_papers(roads):
    network = build_network(NetworkConfig(kind="mlp", input="raw", mask_absent=False), 3, 0)
    assert isinstance(network.head, MlpHead)
    weights = list(network.head.parameters())
    assert [tuple(w.shape) for w in weights] == [(256, 75), (256,), (256, 256), (256,), (5, 256), (5,)]
    obs = roads(4)
    hidden = (obs.flatten(1) @ weights[0].T + weights[1]).relu()
    hidden = (hidden @ weights[2].T + weights[3]).relu()
    assert torch.allclose(network(obs), hidden @ weights[4].T + weights[5], rtol=1e-4, atol=1e-4)


def test_the_mixture_of_actions_starts_as_its_first_mlp_and_adds_the_others_by_weight(roads):
    network, obs = make(kind="mlp-mixture", num_policies=3, top_k=3), roads(4)
    features, _ = network.encoding(obs)
    assert torch.equal(network(obs), network.head.mlps[0](features))
    with torch.no_grad():
        network.head.weights_N.copy_(torch.tensor([0.5, -2.0, 0.25]))
    expected = sum(w * mlp(features) for w, mlp in zip((0.5, -2.0, 0.25), network.head.mlps, strict=True))
    assert torch.allclose(network(obs), expected, atol=1e-6)


def trained(network) -> set[str]:
    return {name for name, p in network.named_parameters() if p.requires_grad}


def test_phases_train_what_the_paper_says():
    network = make(num_policies=3, top_k=2)
    names = {name for name, _ in network.named_parameters()}
    first = {name for name in names if name.startswith("head.mixture.policies.0.")}
    adapters = {name for name in names if name.startswith(("head.mixture.policies.1.", "head.mixture.policies.2."))}
    decoder = {name for name in names if name.startswith("head.decoder.")}
    gate = {"head.mixture.gate_NV"}
    assert first
    assert adapters
    assert decoder
    assert trained(network) == names
    set_phase(network, "distill")
    assert trained(network) == names - adapters - gate
    set_phase(network, "adapt")
    assert trained(network) == names - first
    set_phase(network, "adapt", freeze_decoder=True)
    assert trained(network) == names - first - decoder
    set_phase(network, "all")
    assert trained(network) == names


def test_phases_of_the_baselines():
    mixture = make(kind="mlp-mixture")
    set_phase(mixture, "distill")
    assert trained(mixture) == {name for name, _ in mixture.named_parameters() if name.startswith("head.mlps.0.")}
    set_phase(mixture, "adapt")
    assert not any(name.startswith("head.mlps.0.") for name in trained(mixture))
    for kind in ("mlp", "attentive"):
        network = make(kind=kind)
        set_phase(network, "distill")
        with pytest.raises(RapidError, match="no adapter"):
            set_phase(network, "adapt")
    with pytest.raises(RapidError, match="no decoder"):
        set_phase(make(kind="mlp"), "all", freeze_decoder=True)


@pytest.mark.parametrize(
    "bad",
    [
        {"num_policies": 0},
        {"top_k": 3},
        {"top_k": 0},
        {"heads": 3},
        {"layers": 0},
        {"decoder_layers": 0},
        {"vehicles": 1},
        {"vehicles": 52},
    ],
)
def test_impossible_networks_are_refused(bad):
    with pytest.raises(RapidError):
        make(**bad)


def test_explaining_costs_no_pass_for_each_vehicle(roads):
    network, scenes = make(), 0

    def count(module, given, result):
        nonlocal scenes
        scenes += len(given[0])

    network.encoding.register_forward_hook(count)
    network.explain(roads(4))
    assert scenes <= 2 * 4


def test_explain_gives_signed_weights_gate_and_attention(roads):
    network, obs = make(num_policies=3, top_k=2), roads(4)
    with torch.no_grad():
        network.head.mixture.gate_NV.normal_(generator=torch.Generator().manual_seed(0))
    seen = network.explain(obs)
    assert torch.equal(seen.q_BA, network(obs))
    assert seen.weights_BVN.shape == seen.router_BVN.shape == (4, 15, 3)
    assert (seen.weights_BVN < 0).any()
    assert torch.equal(seen.gate_NV, network.head.mixture.gate_NV)
    assert seen.attention_BLHV.shape == (4, network.config.decoder_layers, 2, 15)
    absent = obs[..., 0] == 0
    attention = seen.attention_BLHV.permute(0, 3, 1, 2)
    assert not attention[absent].any()
    assert (attention.sum(1) < 1).all()
    assert not any(value.requires_grad for value in seen)


def test_explain_of_other_kinds(roads):
    attentive = make(kind="attentive", action_token="ego").explain(roads(2))
    assert (attentive.weights_BVN == 1).all()
    assert attentive.gate_NV.shape == (0, 15)
    assert torch.allclose(attentive.attention_BLHV.sum(-1), torch.ones(2, 1, 2))
    assert make(kind="mlp").explain(roads(2)).weights_BVN is None


def test_the_kinds_have_the_heads_they_should():
    assert isinstance(make(kind="attentive").head, TokenHead)
    assert isinstance(make(kind="mlp-mixture").head, MlpHead)
