import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from fake_worlds import fake_transitions
from rapid.config import DistillConfig, LossConfig, NetworkConfig, OptimizerConfig, RobustConfig
from rapid.data.replay import OfflineSampler
from rapid.data.transitions import RANDOM, Transitions, concatenate, empty
from rapid.errors import RapidError
from rapid.networks import layer
from rapid.networks.q_network import QNetwork, build_network
from rapid.training import distill, offline
from rapid.training.learner import Learner

SMALL = NetworkConfig(width=8, heads=2, layers=1, feedforward=8, hidden=(16,))
LOSS = LossConfig(robust=RobustConfig(steps=1))
CONFIG = DistillConfig(iterations=30, evaluate_every=12, loss=LOSS, optimizer=OptimizerConfig(batch_size=8))
DATA = concatenate([fake_transitions(10), fake_transitions(10, RANDOM, seed=1)])


@pytest.fixture(autouse=True)
def _often(monkeypatch):
    monkeypatch.setattr(offline, "LOG_EVERY", 5)
    torch.set_num_threads(1)


def network(kind: str = "rapid", seed: int = 0) -> QNetwork:
    return build_network(replace(SMALL, kind=kind), 3, seed)


def weights(net: QNetwork) -> bytes:
    return b"".join(value.numpy().tobytes() for value in net.state_dict().values())


def lines(directory) -> list[dict]:
    rows = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    for row in rows:
        row.pop("seconds")
    return rows


@pytest.mark.parametrize("kind", ["rapid", "attentive", "mlp", "mlp-mixture"])
@pytest.mark.parametrize("algorithm", ["dqn", "bc"])
def test_training_twice_is_bit_equal(tmp_path, kind, algorithm):
    config = replace(CONFIG, optimizer=replace(CONFIG.optimizer, algorithm=algorithm))
    first, second = (distill(DATA, network(kind), config, tmp_path / f"{i}", seed=3) for i in (1, 2))
    assert weights(first) == weights(second) != weights(network(kind))
    assert lines(tmp_path / "1") == lines(tmp_path / "2")
    other = distill(DATA, network(kind), config, tmp_path / "3", seed=4)
    assert weights(other) != weights(first)


def test_layers_are_compiled_in_a_step_and_the_inner_attack_takes_no_gradient_by_weights(monkeypatch):
    """Of a step with five steps of an inner attack only the loss itself is differentiated by the weights."""
    learned: list[bool] = []
    original = layer._backward
    monkeypatch.setattr(layer, "_backward", lambda *args: learned.append(bool(args[-1])) or original(*args))
    small = replace(SMALL, width=16, heads=1, feedforward=16)
    learner = Learner(
        build_network(small, 3, 0), CONFIG.optimizer, replace(LOSS, robust=RobustConfig(steps=5)), 1, torch.Generator()
    )
    sampler = OfflineSampler(DATA, LOSS.discount, 1, "cpu", None)
    learner.update(sampler.sample(8, np.random.default_rng(0)))
    layers = small.layers + small.decoder_layers
    assert learned.count(False) == 5 * layers
    assert layers <= learned.count(True) <= 2 * layers
    assert not any(getattr(module, "compiled", False) for module in learner.network.modules())
    assert all(parameter.requires_grad for parameter in learner.network.parameters())


class Killed(BaseException):
    pass


@pytest.mark.parametrize("stop", [1, 6, 17, 30])
def test_resumed_equals_uninterrupted(tmp_path, monkeypatch, stop):
    whole = distill(DATA, network(), CONFIG, tmp_path / "whole", seed=3)
    update = Learner.update

    def dying(self, batch):
        if self.updates == stop - 1:
            raise Killed
        update(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", dying)
        with pytest.raises(Killed):
            distill(DATA, network(), CONFIG, tmp_path / "cut", seed=3, checkpoint_seconds=0)
    resumed = distill(DATA, network(), CONFIG, tmp_path / "cut", seed=3)
    assert weights(resumed) == weights(whole)
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")


def test_a_finished_training_is_not_repeated(tmp_path):
    whole = distill(DATA, network(), CONFIG, tmp_path, seed=3)
    before = lines(tmp_path)
    assert weights(distill(DATA, network(), CONFIG, tmp_path, seed=3)) == weights(whole)
    assert lines(tmp_path) == before
    for changed in (
        {"config": replace(CONFIG, iterations=31)},
        {"seed": 4},
        {"network": network(seed=1)},
        {"transitions": DATA.select(slice(100))},
    ):
        arguments = {"transitions": DATA, "network": network(), "config": CONFIG, "directory": tmp_path, "seed": 3}
        with pytest.raises(RapidError, match="training with other settings"):
            distill(**(arguments | changed))


def test_evaluation_changes_nothing_and_comes_when_asked(tmp_path):
    seen = []

    def evaluate(net: QNetwork, iteration: int) -> dict[str, float]:
        seen.append(iteration)
        return {"return": float("nan"), "crash_share": np.float64(0.5)}

    measured = distill(DATA, network(), CONFIG, tmp_path / "1", 3, evaluate)
    plain = distill(DATA, network(), CONFIG, tmp_path / "2", 3)
    assert weights(measured) == weights(plain)
    assert seen == [12, 24, 30]
    rows = {row["iteration"]: row for row in lines(tmp_path / "1")}
    assert sorted(rows) == [5, 10, 12, 15, 20, 24, 25, 30]
    assert rows[12]["evaluation"] == {"return": None, "crash_share": 0.5}
    assert rows[30]["learning_rate"] == 0
    assert rows[15]["learning_rate"] == pytest.approx(CONFIG.optimizer.learning_rate / 2)


def test_only_what_phase_two_trains_changes(tmp_path):
    trained, fresh = distill(DATA, network(), CONFIG, tmp_path, seed=0), network()
    same = {name for name, value in trained.state_dict().items() if torch.equal(value, fresh.state_dict()[name])}
    frozen = {name for name, parameter in trained.named_parameters() if not parameter.requires_grad}
    assert any("policies.1" in name for name in frozen)
    assert any("gate" in name for name in frozen)
    assert frozen <= same
    assert not any("policies.0" in name and "weight" in name for name in same)


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_good_checkpoint(tmp_path, monkeypatch):
    update = Learner.update

    def poisoned(self, batch):
        update(self, batch._replace(reward_B=batch.reward_B / 0) if self.updates == 12 else batch)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", poisoned)
        with pytest.raises(RapidError, match=r"stopped at update 13: td, total"):
            distill(DATA, network("mlp"), CONFIG, tmp_path / "bad", seed=3, checkpoint_seconds=0)
    # The checkpoint of update 12 is good, so without the poison the training ends as it should.
    resumed = distill(DATA, network("mlp"), CONFIG, tmp_path / "bad", seed=3)
    assert weights(resumed) == weights(distill(DATA, network("mlp"), CONFIG, tmp_path / "good", seed=3))


def test_data_that_the_loss_cannot_use_is_refused(tmp_path):
    random = fake_transitions(5, RANDOM)
    hard = replace(DATA, probabilities_NA=np.full_like(DATA.probabilities_NA, np.nan))
    soft = replace(CONFIG, loss=replace(LOSS, robust_labels="soft"))
    cloning = replace(
        CONFIG, optimizer=replace(CONFIG.optimizer, algorithm="bc"), loss=replace(LOSS, robust_weight=0.0)
    )
    for data, config, message in (
        (empty(), CONFIG, "dataset is empty"),
        (random, CONFIG, "needs transitions of the teacher"),
        (random, cloning, "needs transitions of the teacher"),
        (hard, soft, "needs the teacher's action probabilities"),
    ):
        with pytest.raises(RapidError, match=message):
            distill(data, network(), config, tmp_path, seed=0)
    distill(random, network("mlp"), replace(CONFIG, loss=replace(LOSS, robust_on="all")), tmp_path / "all", seed=0)


def chain(length: int = 5) -> tuple[Transitions, np.ndarray]:
    """A corridor of states, action 1 steps on and earns 1, all others step on for nothing; the last step terminates."""
    state_N, action_N = (grid.ravel() for grid in np.meshgrid(np.arange(length), np.arange(5), indexing="ij"))
    states = np.random.default_rng(0).normal(0, 1, (length + 1, 15, 5)).astype(np.float32) * (0, 60, 4, 30, 30)
    states[..., 0] = 1
    states = states.astype(np.float32)
    count = len(state_N)
    rows = Transitions(
        obs_NVF=states[state_N],
        action_N=action_N,
        reward_N=(action_N == 1).astype(np.float32),
        next_obs_NVF=states[state_N + 1],
        terminated_N=state_N == length - 1,
        truncated_N=np.zeros(count, np.bool_),
        source_N=np.zeros(count, np.int8),
        episode_N=np.arange(count),
        step_N=state_N,
        spawn_seed_N=np.arange(count),
        probabilities_NA=np.full((count, 5), np.nan, np.float32),
    )
    return rows.validate(), states[:-1]


@pytest.mark.parametrize(("double", "rate", "every"), [(True, 0.05, 1), (False, 1.0, 20)])
def test_temporal_differences_converge_to_the_values_of_a_known_process(tmp_path, double, rate, every):
    rows, states = chain()
    loss = LossConfig(discount=0.5, double=double, conservative_weight=0.0, robust_weight=0.0)
    optimizer = OptimizerConfig(learning_rate=3e-3, batch_size=50, target_rate=rate, target_update=every)
    config = DistillConfig(iterations=700, loss=loss, optimizer=optimizer)
    net = build_network(NetworkConfig(kind="mlp", hidden=(64,), input="normalized"), 3, 0)
    q_SA = distill(rows, net, config, tmp_path, seed=0)(torch.from_numpy(states)).detach().numpy()
    value_S = np.array([2 - 0.5 ** (left - 1) for left in (5, 4, 3, 2, 1)])
    np.testing.assert_allclose(q_SA[:, 1], value_S, atol=0.05)
    np.testing.assert_allclose(q_SA[:, [0, 2, 3, 4]], np.repeat(value_S[:, None] - 1, 4, 1), atol=0.05)


@pytest.mark.parametrize(("rate", "every"), [(1.0, 3), (0.25, 1)])
def test_the_target_follows_at_its_rate_and_pace(rate, every):
    config = OptimizerConfig(batch_size=4, target_rate=rate, target_update=every, linear_decay=False)
    net = network("mlp")
    learner = Learner(net, config, replace(LOSS, robust_weight=0.0), 100, torch.Generator())
    sampler, rng = OfflineSampler(DATA, 0.9), np.random.default_rng(0)
    for step in range(1, 8):
        before = [value.clone() for value in learner.target.state_dict().values()]
        learner.update(sampler.sample(4, rng))
        pairs = zip(before, learner.target.state_dict().values(), net.state_dict().values(), strict=True)
        for old, new, online in pairs:
            expected = old.lerp(online, rate) if step % every == 0 else old
            torch.testing.assert_close(new, expected, rtol=0, atol=0 if rate == 1 or step % every else 1e-7)


def test_a_checkpoint_of_another_kind_of_device_is_refused():
    learner = Learner(network(), CONFIG.optimizer, LOSS, 1, torch.Generator())
    state = learner.state_dict() | {"generator": torch.zeros(16, dtype=torch.uint8)}
    with pytest.raises(RapidError, match="--device that the training began"):
        learner.load_state_dict(state)
