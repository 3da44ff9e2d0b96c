import json
from dataclasses import replace

import pytest
import torch

from fake_worlds import fake_transitions
from rapid.agents.saved import QAgent, save_agent
from rapid.config import AdaptConfig, DistillConfig, LossConfig, NetworkConfig, OptimizerConfig
from rapid.data.transitions import RANDOM, concatenate
from rapid.errors import RapidError
from rapid.networks.q_network import build_network, set_phase
from rapid.networks.stack import stack_networks, unstack_networks
from rapid.training import adapt, distill, offline
from rapid.training.learner import Learner
from rapid.training.machinery.adam import clip_norm

MLP = NetworkConfig(kind="mlp", hidden=(16, 8))
DATA = concatenate([fake_transitions(10), fake_transitions(10, RANDOM, seed=1)])
PLAIN = LossConfig(robust_weight=0.0, robust_on="all")
SEEDS = (3, 7, 11)


def networks(config: NetworkConfig = MLP):
    return [build_network(config, 3, seed) for seed in SEEDS]


def test_every_member_reads_its_own_part(roads):
    parts = [roads(4, seed) for seed in SEEDS]
    stack = stack_networks(networks())
    expected = [network(part) for network, part in zip(networks(), parts, strict=True)]
    torch.testing.assert_close(stack(torch.cat(parts)), torch.cat(expected))
    assert stack.members == 3
    assert networks()[0].members == 1


def test_stacking_leaves_the_global_random_stream():
    before = torch.get_rng_state()
    unstack_networks(stack_networks(networks()))
    assert torch.equal(torch.get_rng_state(), before)


def test_unstacked_networks_are_those_that_were_stacked():
    for before, after in zip(networks(), unstack_networks(stack_networks(networks())), strict=True):
        weights = after.state_dict()
        assert all(torch.equal(weight, weights[name]) for name, weight in before.state_dict().items())


LOSSES = {
    "dqn": replace(PLAIN, double=False, conservative_weight=0.0, td_error="huber"),
    "ddqn": replace(PLAIN, double=True, conservative_weight=0.0),
    "cql": replace(PLAIN, n_step=3),
}


@pytest.mark.parametrize("kind", [*LOSSES, "bc"])
@pytest.mark.parametrize(("clip", "teacher_share"), [(0.0, None), (0.5, 0.25)])
def test_a_stack_learns_what_its_members_learn_alone(tmp_path, kind, clip, teacher_share):
    algorithm = "bc" if kind == "bc" else "dqn"
    optimizer = OptimizerConfig(batch_size=8, max_grad_norm=clip, algorithm=algorithm)
    loss = LOSSES.get(kind, PLAIN)
    config = DistillConfig(iterations=25, evaluate_every=0, loss=loss, optimizer=optimizer)
    stack, share = stack_networks(networks()), {"teacher_share": teacher_share}
    distill(DATA, stack, config, tmp_path / "stack", SEEDS, **share)
    for seed, alone, together in zip(SEEDS, networks(), unstack_networks(stack), strict=True):
        distill(DATA, alone, config, tmp_path / f"{seed}", seed, **share)
        weights = together.state_dict()
        for name, weight in alone.state_dict().items():
            # Sums in another order differ in the last bits, which Adam's division makes larger.
            torch.testing.assert_close(weights[name], weight, rtol=1e-3, atol=1e-5)


def test_each_member_is_clipped_by_its_own_norm():
    gradients = [torch.tensor([[[3.0], [0.0]], [[0.3], [0.0]]]), torch.tensor([[[4.0]], [[0.4]]])]
    norm_S = clip_norm(gradients, 1.0, members=2)
    torch.testing.assert_close(norm_S, torch.tensor([5.0, 0.5]))
    torch.testing.assert_close(gradients[0].flatten(), torch.tensor([0.6, 0.0, 0.3, 0.0]))
    torch.testing.assert_close(gradients[1].flatten(), torch.tensor([0.8, 0.4]))


def test_a_killed_stack_goes_on_where_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(offline, "LOG_EVERY", 5)
    config = DistillConfig(iterations=20, evaluate_every=10, loss=PLAIN, optimizer=OptimizerConfig(batch_size=8))

    def train(home, **options):
        return distill(DATA, stack_networks(networks()), config, tmp_path / home, SEEDS, **options)

    seen = []
    whole = train("whole", evaluate=lambda network, step: seen.append((network.members, step)) or {"return": 1.0})
    assert seen == [(1, 10)] * 3 + [(1, 20)] * 3
    last = json.loads((tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["evaluation"] == {f"member-{index}": {"return": 1.0} for index in range(3)}
    update = Learner.update

    def dying(self, batch):
        if self.updates == 12:
            raise KeyboardInterrupt
        update(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", dying)
        with pytest.raises(KeyboardInterrupt):
            train("cut", checkpoint_seconds=0)
    resumed = train("cut").state_dict()
    assert all(torch.equal(weight, resumed[name]) for name, weight in whole.state_dict().items())


def test_what_cannot_be_stacked_is_refused(tmp_path):
    config = DistillConfig(iterations=1, evaluate_every=0, loss=PLAIN)
    stack = stack_networks(networks())
    with pytest.raises(RapidError, match="at least one"):
        stack_networks([])
    with pytest.raises(RapidError, match="same settings"):
        stack_networks([*networks(), build_network(replace(MLP, hidden=(4,)), 3, 0)])
    for kind in ("rapid", "attentive", "mlp-mixture"):
        with pytest.raises(RapidError, match=f"kind '{kind}'"):
            stack_networks(networks(NetworkConfig(kind=kind, width=8, feedforward=8, hidden=(16,))))
    with pytest.raises(RapidError, match="no stack"):
        unstack_networks(networks()[0])
    with pytest.raises(RapidError, match="2 seeds for 3 networks"):
        distill(DATA, stack, config, tmp_path, (1, 2))
    with pytest.raises(RapidError, match="3 seeds for 1 networks"):
        distill(DATA, networks()[0], config, tmp_path, SEEDS)
    for term in ("robust_weight", "munchausen_weight"):
        with pytest.raises(RapidError, match="no robust and no Munchausen term"):
            distill(DATA, stack, replace(config, loss=replace(PLAIN, **{term: 0.1})), tmp_path, SEEDS)
    cloning = replace(config.optimizer, algorithm="bc")
    with pytest.raises(RapidError, match="does not clone"):
        distill(
            DATA, stack, replace(config, loss=replace(PLAIN, robust_on="teacher"), optimizer=cloning), tmp_path, SEEDS
        )
    for other in (stack, stack_networks(networks()[:1])):
        with pytest.raises(RapidError, match="several agents"):
            save_agent(tmp_path / "agent", other, {})
        with pytest.raises(RapidError, match="several agents"):
            QAgent(other)
        with pytest.raises(RapidError, match="cannot drive"):
            adapt(other, AdaptConfig(train="all"), "lane-3-density-2", tmp_path, 0)
    with pytest.raises(RapidError, match="trains every weight"):
        set_phase(stack, "adapt")
    assert not list(tmp_path.iterdir())
