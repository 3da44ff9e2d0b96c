"""The terms of the loss, against numbers worked out by hand and against formulas."""

import math
from dataclasses import replace

import pytest
import torch

from rapid import losses
from rapid.config import LossConfig, NetworkConfig, RobustConfig
from rapid.errors import RapidError
from rapid.losses import (
    TransitionBatch,
    behavior_cloning_loss,
    conservative_loss,
    cross_entropy,
    munchausen_target,
    q_loss,
    td_loss,
    td_target,
)
from rapid.networks.q_network import build_network, set_phase

CONFIG = NetworkConfig(width=16, heads=2, feedforward=32, hidden=(24,))


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def batch(roads, generator):
    return TransitionBatch(
        roads(12),
        torch.randint(0, 5, (12,), generator=generator),
        torch.rand(12, generator=generator),
        roads(12, seed=1),
        torch.full((12,), 0.9),
        torch.arange(12) % 3 == 0,
        None,
    )


def networks(**settings):
    config = replace(CONFIG, **settings)
    return build_network(config, 3, 0), build_network(config, 3, 1)


def by_table(rows):
    """A network that answers observation number i (its ego's x) with row i."""
    table = torch.tensor(rows)
    return lambda obs: table[obs[:, 0, 1].long()]


def scene(*numbers: int) -> torch.Tensor:
    obs = torch.zeros(len(numbers), 15, 5)
    obs[:, 0, 1] = torch.tensor([float(n) for n in numbers])
    return obs


def test_targets_by_hand():
    online = by_table([[0.0, 5, 1, 0, 0], [9.0, 0, 0, 0, 0]])
    target = by_table([[1.0, 2, 7, 0, 0], [3.0, 4, 0, 0, 0]])
    batch = TransitionBatch(
        scene(0, 0, 1),
        torch.zeros(3, dtype=torch.int64),
        torch.tensor([1.0, 0.5, -1.0]),
        scene(0, 1, 1),
        # One step with discount 0.9, three steps, and a termination.
        torch.tensor([0.9, 0.9**3, 0.0]),
        torch.zeros(3, dtype=torch.bool),
        None,
    )
    assert td_target(online, target, batch, double=False).tolist() == pytest.approx([7.3, 0.5 + 0.729 * 4, -1])
    assert td_target(online, target, batch, double=True).tolist() == pytest.approx([2.8, 0.5 + 0.729 * 3, -1])


def test_munchausen_targets_by_hand():
    # Q/T = ln 8 and ln 2 beside three zeros: probabilities 8/13 and 2/13. In the second state one action is all.
    temperature = 0.5
    network = by_table([[math.log(8) / 2, math.log(2) / 2, 0.0, 0, 0], [50.0, 0, 0, 0, 0]])
    batch = TransitionBatch(
        scene(0, 1, 0),
        torch.tensor([1, 0, 0]),
        torch.tensor([1.0, 0.5, -1.0]),
        scene(1, 0, 0),
        torch.tensor([0.9, 0.9**3, 0.0]),
        torch.zeros(3, dtype=torch.bool),
        None,
    )
    soft_value = math.log(13) / 2
    expected = [
        1 + 0.9 * 0.5 * math.log(2 / 13) + 0.9 * 50,
        0.5 + 0.729 * soft_value,
        -1 + 0.9 * 0.5 * math.log(8 / 13),
    ]
    assert munchausen_target(network, batch, 0.9, temperature).tolist() == pytest.approx(expected)
    # logsumexp is the expectation of Q - T log pi under pi.
    q = torch.tensor([math.log(8) / 2, math.log(2) / 2, 0, 0, 0])
    log_pi = (q / temperature).log_softmax(0)
    assert (log_pi.exp() * (q - temperature * log_pi)).sum().item() == pytest.approx(soft_value)
    # An action that the target would never take costs no more than the floor.
    unlikely = batch._replace(obs_BVF=scene(1, 1, 1), action_B=torch.tensor([3, 3, 3]))
    assert munchausen_target(network, unlikely, 0.9, temperature)[2].item() == pytest.approx(-1 - 0.9)


def test_munchausen_reaches_the_loss_and_near_zero_temperature_is_dqn(batch):
    network, target = networks()
    generator = torch.Generator()
    plain = LossConfig(double=False, conservative_weight=0.0, robust_weight=0.0)
    dqn = q_loss(network, target, batch, plain, generator)
    cold = replace(plain, munchausen_weight=1e-6, munchausen_temperature=1e-5)
    assert q_loss(network, target, batch, cold, generator).td.item() == pytest.approx(dqn.td.item(), rel=1e-4)
    warm = replace(plain, munchausen_weight=0.9, munchausen_temperature=0.5)
    assert q_loss(network, target, batch, warm, generator).td.item() != pytest.approx(dqn.td.item(), rel=1e-2)


def test_td_error_by_hand():
    q = torch.tensor([[1.0, 2, 0, 0, 0], [0, 0, 0, 5, 0]])
    action, target = torch.tensor([1, 3]), torch.tensor([2.5, 2.0])
    assert td_loss(q, action, target, "squared").item() == pytest.approx((0.25 + 9) / 2)
    assert td_loss(q, action, target, "huber").item() == pytest.approx((0.125 + 2.5) / 2)


def test_conservative_term_by_formula():
    q = torch.tensor([[1.0, 2, -1, 0.5, 3], [0, 0, 0, 0, 0]])
    first = math.log(sum(math.exp(x) for x in (1, 2, -1, 0.5, 3))) - 2
    assert conservative_loss(q, torch.tensor([1, 4])).item() == pytest.approx((first + math.log(5)) / 2)
    # Its gradient is softmax(Q) - onehot(a).
    q.requires_grad_()
    (gradient,) = torch.autograd.grad(conservative_loss(q, torch.tensor([1, 4])) * 2, q)
    assert torch.allclose(gradient, q.softmax(1) - torch.eye(5)[[1, 4]], atol=1e-6)


def test_cross_entropy_by_hand_and_the_uniform_policy_pays_ln_5():
    assert cross_entropy(torch.full((3, 5), 2.0), torch.eye(5)[:3]).item() == pytest.approx(math.log(5))
    q, soft = torch.tensor([[2.0, 0, 0, 0, 0]]), torch.tensor([[0.5, 0.5, 0, 0, 0]])
    norm = math.exp(1) + 4
    assert cross_entropy(q, soft, temperature=2).item() == pytest.approx(-0.5 * (1 - 2 * math.log(norm)))
    one_hot, probs = torch.eye(5)[:1], q.softmax(1)
    assert cross_entropy(q, one_hot).item() == pytest.approx(-probs[0, 0].log().item())


def test_the_total_is_the_weighted_sum_and_terms_without_weight_are_zero(batch):
    network, target = networks()
    config = LossConfig(conservative_weight=0.7, robust_weight=0.3)
    loss = q_loss(network, target, batch, config, torch.Generator().manual_seed(0))
    assert min(loss.td.item(), loss.conservative.item(), loss.robust.item()) > 0
    assert loss.total.item() == pytest.approx((loss.td + 0.7 * loss.conservative + 0.3 * loss.robust).item())
    plain = q_loss(
        network, target, batch, replace(config, conservative_weight=0.0, robust_weight=0.0), torch.Generator()
    )
    assert plain.conservative == plain.robust == 0
    assert plain.total == plain.td
    assert plain.td.item() == pytest.approx(loss.td.item(), rel=1e-5)


def test_td_term_of_a_network_is_the_formula(batch):
    network, target = networks(kind="mlp")
    config = LossConfig(double=True, td_error="squared", conservative_weight=0.0, robust_weight=0.0)
    loss = q_loss(network, target, batch, config, torch.Generator())
    best = network(batch.next_obs_BVF).argmax(1)
    value = torch.stack([q[a] for q, a in zip(target(batch.next_obs_BVF), best, strict=True)])
    taken = torch.stack([q[a] for q, a in zip(network(batch.obs_BVF), batch.action_B, strict=True)])
    assert loss.td.item() == pytest.approx((taken - batch.reward_B - 0.9 * value).square().mean().item(), rel=1e-5)


@pytest.mark.parametrize("on", ["teacher", "all"])
def test_the_robust_term_is_the_cross_entropy_on_the_attacked_states(batch, monkeypatch, on):
    network, target = networks()
    attacked = []
    original = losses.maximize_loss

    def spy(*args):
        attacked.append((args[1], args[2], original(*args)))
        return attacked[-1][2]

    monkeypatch.setattr(losses, "maximize_loss", spy)
    loss = q_loss(network, target, batch, LossConfig(robust_on=on, temperature=0.5), torch.Generator())
    ((obs, labels, adversarial),) = attacked
    chosen = batch.teacher_B if on == "teacher" else torch.ones(12, dtype=torch.bool)
    assert torch.equal(obs, batch.obs_BVF[chosen])
    assert torch.equal(labels.argmax(1), batch.action_B[chosen])
    expected = torch.nn.functional.cross_entropy(network(adversarial) / 0.5, batch.action_B[chosen])
    assert loss.robust.item() == pytest.approx(expected.item(), rel=1e-5)
    clean = torch.nn.functional.cross_entropy(network(obs) / 0.5, batch.action_B[chosen])
    assert loss.robust > clean


def test_the_robust_gradient_flows_to_the_weights_and_not_through_the_attacked_states(batch):
    network, target = networks()
    set_phase(network, "distill")
    config = LossConfig(robust_weight=1.0, conservative_weight=0.0, robust_on="all")
    obs = batch.obs_BVF.clone().requires_grad_()
    loss = q_loss(network, target, batch._replace(obs_BVF=obs), config, torch.Generator().manual_seed(5))
    (through,) = torch.autograd.grad(loss.robust, obs, allow_unused=True, retain_graph=True)
    assert through is None or not through.any()
    assert all(p.grad is None for p in network.parameters())
    loss.robust.backward()
    assert all(p.grad is not None and p.grad.any() for p in network.head.decoder.head.parameters())
    # The same gradient as with s~ as given data.
    adversarial = losses.maximize_loss(
        network, batch.obs_BVF, torch.eye(5)[batch.action_B], network.scale_F, config.robust, 1.0,
        torch.Generator().manual_seed(5),
    )  # fmt: skip
    expected = torch.autograd.grad(
        cross_entropy(network(adversarial), torch.eye(5)[batch.action_B]), network.head.decoder.head.weight
    )[0]
    assert torch.allclose(network.head.decoder.head.weight.grad, expected, atol=1e-6)
    assert all(p.grad is None for p in target.parameters())


def test_soft_labels_fall_back_to_the_action_where_none_were_recorded(batch, monkeypatch):
    network, target = networks()
    soft = torch.full((12, 5), 0.2)
    soft[3:] = torch.nan
    labels = []
    original = losses.maximize_loss
    monkeypatch.setattr(losses, "maximize_loss", lambda *a: labels.append(a[2]) or original(*a))
    config = LossConfig(robust_labels="soft", robust_on="all", robust=RobustConfig(steps=1))
    assert q_loss(network, target, batch._replace(soft_BA=soft), config, torch.Generator()).total.isfinite()
    assert torch.equal(labels[0][:3], soft[:3])
    assert torch.equal(labels[0][3:], torch.eye(5)[batch.action_B[3:]])
    with pytest.raises(RapidError, match="soft"):
        q_loss(network, target, batch, config, torch.Generator())


def test_without_teacher_transitions_the_robust_term_is_zero(batch):
    network, target = networks()
    loss = q_loss(
        network, target, batch._replace(teacher_B=torch.zeros(12, dtype=torch.bool)), LossConfig(), torch.Generator()
    )
    assert loss.robust == 0
    assert loss.total.item() == pytest.approx((loss.td + loss.conservative).item())


def test_training_on_the_robust_term_makes_the_attack_fail(batch):
    network, target = networks(kind="mlp")
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    config = LossConfig(
        robust_on="all", robust_weight=1.0, conservative_weight=0.0, robust=RobustConfig(radius=0.02, step_size=0.005)
    )
    generator = torch.Generator().manual_seed(0)
    history = []
    for _ in range(150):
        loss = q_loss(network, target, batch, config, generator)
        optimizer.zero_grad()
        loss.robust.backward()
        optimizer.step()
        history.append(loss.robust.item())
    assert history[-1] < 0.5 * history[0]


def test_behavior_cloning_by_formula(batch):
    network, _ = networks()
    log_probs = network(batch.obs_BVF).log_softmax(1)[torch.arange(12), batch.action_B]
    loss = behavior_cloning_loss(network, batch)
    assert loss.total.item() == pytest.approx(-log_probs.mean().item(), rel=1e-5)
    assert loss.td == loss.conservative == loss.robust == 0
    teacher = behavior_cloning_loss(network, batch, teacher_only=True)
    assert teacher.total.item() == pytest.approx(-log_probs[batch.teacher_B].mean().item(), rel=1e-5)
    nobody = batch._replace(teacher_B=torch.zeros(12, dtype=torch.bool))
    assert behavior_cloning_loss(network, nobody, teacher_only=True).total == 0


def test_weights_of_a_cross_entropy_pick_rows():
    q_BA, labels_BA = torch.randn(6, 5, generator=torch.Generator().manual_seed(0)), torch.eye(5)[[0, 1, 2, 3, 4, 0]]
    chosen_B = torch.tensor([True, False, True, True, False, False])
    weighted = cross_entropy(q_BA, labels_BA, 0.5, chosen_B.float())
    torch.testing.assert_close(weighted, cross_entropy(q_BA[chosen_B], labels_BA[chosen_B], 0.5))
    assert cross_entropy(q_BA, labels_BA, weights_B=torch.zeros(6)) == 0
