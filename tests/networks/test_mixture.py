"""The mixture of policies: routing, the zero gate, and what may be skipped without changing a bit."""

import pytest
import torch

from rapid.config import NetworkConfig
from rapid.networks.mixture import sinusoids
from rapid.networks.q_network import QNetwork, TokenHead, build_network, set_phase

SMALL = {"width": 16, "heads": 2, "feedforward": 32}


def make(seed: int = 0, **settings) -> QNetwork:
    return build_network(NetworkConfig(**{**SMALL, **settings}), lanes=3, seed=seed)


def mixture_of(network: QNetwork):
    assert isinstance(network.head, TokenHead)
    return network.head.mixture


def run_all(network: QNetwork) -> QNetwork:
    mixture = mixture_of(network)
    mixture._runs = lambda index, router_BVN: True
    return network


def open_gate(network: QNetwork, seed: int = 7) -> QNetwork:
    gate = mixture_of(network).gate_NV
    with torch.no_grad():
        gate.normal_(generator=torch.Generator().manual_seed(seed))
    return network


@pytest.mark.parametrize("gate", ["linear", "tanh"])
@pytest.mark.parametrize("sizes", [(2, 2), (3, 2), (4, 1), (4, 3), (4, 4)])
def test_in_phase_2_adapters_weigh_nothing_get_no_gradient_and_skipping_them_is_bit_equal(roads, gate, sizes):
    count, top_k = sizes
    network = make(gate=gate, num_policies=count, top_k=top_k)
    set_phase(network, "distill")
    obs = roads(8)
    skipped = network(obs)
    # Forced to compute, and asked for gradients that phase 2 would not take.
    mixture = mixture_of(run_all(network))
    mixture.policies.requires_grad_(True)
    forced = network(obs)
    assert torch.equal(skipped, forced)
    _, weights = mixture.weights(network.encoding(obs)[0])
    assert not weights[..., 1:].any()
    forced.square().sum().backward()
    for adapter in list(mixture.policies)[1:]:
        assert all(p.grad is not None and not p.grad.any() for p in adapter.parameters())
    assert all(p.grad.any() for p in mixture.policies[0].projection.parameters())


def test_in_phase_2_adapters_are_not_run_and_in_phase_3_they_are(roads):
    network = make(num_policies=3, top_k=3)
    calls = []
    for index, policy in enumerate(mixture_of(network).policies):
        policy.register_forward_hook(lambda *_, index=index: calls.append(index))
    set_phase(network, "distill")
    network(roads(4))
    assert calls == [0]
    set_phase(network, "adapt")
    network(roads(4))
    assert calls == [0, 0, 1, 2]
    calls.clear()
    with torch.no_grad():
        network(roads(4))
    assert calls == [0]


def test_a_recording_leaves_out_adapters_whose_gate_stays_closed_alone(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    network = make()
    mixture, weights = mixture_of(network), type("OnAGpu", (), {"is_cuda": True})()

    def recorded(phase: str) -> bool:
        set_phase(network, phase)
        return mixture._runs(1, weights)

    # A gate that is trained may open while the recording is replayed.
    assert [recorded(phase) for phase in ("distill", "adapt", "all", "distill")] == [False, True, True, False]
    open_gate(network)
    assert recorded("distill")
    assert mixture._runs(0, weights)


def test_a_policy_that_no_vehicle_chose_is_skipped_bit_equally(roads):
    network = open_gate(make(num_policies=4, top_k=2))
    mixture = mixture_of(network)
    assert mixture.router is not None
    with torch.no_grad():
        mixture.router[-1].bias[2] -= 1e4
    calls = []
    mixture.policies[2].register_forward_hook(lambda *_: calls.append(2))
    obs = roads(6)
    skipped = network(obs)
    assert not calls
    assert torch.equal(skipped, run_all(network)(obs))
    assert calls


@pytest.mark.parametrize("sizes", [(1, 1), (2, 1), (3, 2), (4, 3), (4, 4)])
def test_the_router_is_a_softmax_over_the_k_best_with_policy_1_always_among_them(roads, sizes):
    count, top_k = sizes
    network = make(num_policies=count, top_k=top_k)
    mixture = mixture_of(network)
    features, _ = network.encoding(roads(16))
    router, _ = mixture.weights(features)
    assert router.shape == (16, 15, count)
    assert ((router > 0).sum(-1) == top_k).all()
    assert (router[..., 0] > 0).all()
    assert torch.allclose(router.sum(-1), torch.ones(16, 15))
    if 1 < top_k < count:
        logits = mixture.router(features)
        for b, v in [(0, 0), (3, 5), (15, 14)]:
            best = set(logits[b, v, 1:].topk(top_k - 1).indices.add(1).tolist()) | {0}
            assert set(router[b, v].nonzero().flatten().tolist()) == best


def test_gate_weights_by_hand(roads):
    for kind in ("linear", "tanh"):
        network = open_gate(make(gate=kind, num_policies=3, top_k=3))
        mixture = mixture_of(network)
        router, weights = mixture.weights(network.encoding(roads(2))[0])
        gate = mixture.gate_NV.T
        if kind == "linear":
            expected = torch.cat([router[..., :1], gate * router[..., 1:]], -1)
        else:
            others = torch.tanh(gate) * router[..., 1:]
            expected = torch.cat([1 - others.sum(-1, keepdim=True), others], -1)
        assert torch.allclose(weights, expected, atol=1e-6)
        assert (weights < 0).any()


def test_the_mixture_is_the_weighted_sum_of_the_policies(roads):
    network = open_gate(make(num_policies=3, top_k=2))
    mixture = mixture_of(network)
    features, mask = network.encoding(roads(5))
    _, weights = mixture.weights(features)
    expected = sum(weights[..., i, None] * policy(features, mask) for i, policy in enumerate(mixture.policies))
    assert torch.allclose(mixture(features, mask), expected, atol=1e-5)


@pytest.mark.parametrize("gate", ["linear", "tanh"])
@pytest.mark.parametrize("training", [True, False])
def test_phase_3_keeps_policy_1_and_moves_the_gate_first_and_the_adapter_once_the_gate_is_open(roads, gate, training):
    network = make(gate=gate).train(training)
    set_phase(network, "adapt")
    first, adapter = mixture_of(network).policies
    before = {name: p.clone() for name, p in first.named_parameters()}
    adapter_before = [p.clone() for p in adapter.parameters()]
    gate_parameter = mixture_of(network).gate_NV
    optimizer = torch.optim.Adam([p for p in network.parameters() if p.requires_grad], 1e-2)
    obs, target = roads(8), torch.randn(8, 5)

    def step():
        optimizer.zero_grad()
        (network(obs) - target).square().mean().backward()
        optimizer.step()

    step()
    assert gate_parameter.any()
    assert all(torch.equal(a, b) for a, b in zip(adapter_before, adapter.parameters(), strict=True))
    step()
    assert not all(torch.equal(a, b) for a, b in zip(adapter_before, adapter.parameters(), strict=True))
    for _ in range(3):
        step()
    assert all(torch.equal(before[name], p) for name, p in first.named_parameters())


def test_the_router_learns_in_phase_2_with_the_linear_gate_and_not_with_tanh(roads):
    for kind, learns in (("linear", True), ("tanh", False)):
        network = make(gate=kind)
        set_phase(network, "distill")
        network(roads(8)).square().sum().backward()
        router = mixture_of(network).router
        assert router is not None
        gradients = [p.grad for p in router.parameters()]
        assert any(g is not None and bool(g.any()) for g in gradients) is learns


def test_adapters_are_not_copies_of_policy_1():
    first, second, third = mixture_of(make(num_policies=3, top_k=3)).policies
    for a, b, c in zip(first.parameters(), second.parameters(), third.parameters(), strict=True):
        if a.dim() == 2:
            assert not torch.equal(a, b)
            assert not torch.equal(b, c)


def test_sinusoids():
    table = sinusoids(15, 16)
    assert table.shape == (15, 16)
    assert table[3, 0] == pytest.approx(torch.tensor(3.0).sin().item())
    assert table[3, 5] == pytest.approx(torch.tensor(3 / 10_000 ** (4 / 16)).cos().item())
