from dataclasses import replace

import numpy as np
import pytest
import torch
from test_distill import DATA, LOSS, Killed, lines, network, weights

from fake_worlds import FakeWorlds, fake_transitions
from rapid.config import AdaptConfig, OptimizerConfig
from rapid.data.transitions import RANDOM
from rapid.errors import RapidError
from rapid.training import adapt, online
from rapid.training.learner import Learner
from rapid.training.machinery.worlds import Explorer
from rapid.training.online import exploration

SCENARIO = "lane-3-density-2"
CONFIG = AdaptConfig(
    offline_share=0.0,
    steps=60,
    num_envs=3,
    updates_per_step=0.5,
    buffer_size=60,
    learning_starts=20,
    evaluate_every=30,
    exploration_start=0.7,
    exploration_end=0.7,
    exploration_hold=3,
    loss=replace(LOSS, conservative_weight=0.0, robust_weight=0.0, n_step=2),
    optimizer=OptimizerConfig(batch_size=8),
)
MIXED = replace(CONFIG, offline_share=0.5, loss=replace(CONFIG.loss, robust_weight=0.5, robust_labels="soft"))


def worlds(count: int) -> FakeWorlds:
    return FakeWorlds(count, autoreset=True)


@pytest.fixture(autouse=True)
def _often(monkeypatch):
    monkeypatch.setattr(online, "LOG_EVERY", 15)
    torch.set_num_threads(1)


def train(directory, config=CONFIG, kind="rapid", offline=DATA, seed=3, net=None, **options):
    net = network(kind) if net is None else net
    return adapt(net, config, SCENARIO, directory, seed, offline, make_worlds=worlds, **options)


@pytest.mark.parametrize("config", [CONFIG, MIXED], ids=["online", "mixed"])
def test_training_twice_is_bit_equal(tmp_path, config):
    first, second = (train(tmp_path / f"{i}", config) for i in (1, 2))
    assert weights(first) == weights(second) != weights(network())
    assert lines(tmp_path / "1") == lines(tmp_path / "2")
    assert weights(train(tmp_path / "3", config, seed=4)) != weights(first)


@pytest.mark.parametrize(("scenario", "ends"), [(SCENARIO, False), (f"{SCENARIO}:clock", True)])
def test_the_time_limit_is_an_end_for_who_sees_the_clock(tmp_path, monkeypatch, scenario, ends):
    added = []

    class Watched(online.ReplayBuffer):
        def add(self, *columns):
            added.append([column.copy() for column in columns[-2:]])
            super().add(*columns)

    monkeypatch.setattr(online, "ReplayBuffer", Watched)
    short = replace(CONFIG, evaluate_every=0)
    adapt(network("rapid"), short, scenario, tmp_path, 3, make_worlds=lambda count: FakeWorlds(count, True, duration=4))
    terminated, truncated = (np.concatenate(flags) for flags in zip(*added, strict=True))
    assert truncated.any()
    assert (terminated & truncated).any() == ends
    assert not ends or terminated[truncated].all()
    assert (terminated & ~truncated).any()  # crashes


def test_offline_transitions_are_taken_over_one_step(tmp_path, monkeypatch):
    taken = []

    class Watched(online.OfflineSampler):
        def sample(self, count, rng):
            taken.append(super().sample(count, rng))
            return taken[-1]

    monkeypatch.setattr(online, "OfflineSampler", Watched)
    train(tmp_path, MIXED)
    once = set(DATA.reward_N.astype(np.float32).tolist())
    assert MIXED.loss.n_step > 1
    assert set(torch.cat([batch.reward_B for batch in taken]).tolist()) <= once


@pytest.mark.parametrize("share", [None, 0.25])
def test_batches_keep_the_mixtures_share_of_the_teacher(tmp_path, monkeypatch, share):
    taken = []

    class Watched(online.OfflineSampler):
        def sample(self, count, rng):
            taken.append(super().sample(count, rng))
            return taken[-1]

    monkeypatch.setattr(online, "OfflineSampler", Watched)
    train(tmp_path, MIXED, teacher_share=share)
    shares = {round(float(batch.teacher_B.float().mean()), 6) for batch in taken}
    count = len(taken[0].teacher_B)
    assert len(taken) > 5
    if share is None:
        assert len(shares) > 1
    else:
        assert shares == {round(np.floor(share * count + 0.5) / count, 6)}
    # The same training with other batches is another training.
    with pytest.raises(RapidError, match="teacher_share"):
        train(tmp_path, MIXED, teacher_share=0.75)


@pytest.mark.parametrize(
    ("config", "stop"), [(CONFIG, 1), (CONFIG, 9), (CONFIG, 20), (MIXED, 12)], ids=["first", "early", "last", "mixed"]
)
def test_resumed_equals_uninterrupted(tmp_path, monkeypatch, stop, config):
    whole = train(tmp_path / "whole", config)
    update = Learner.update

    def dying(self, batch):
        if self.updates == stop - 1:
            raise Killed
        update(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", dying)
        with pytest.raises(Killed):
            train(tmp_path / "cut", config, checkpoint_seconds=0)
    resumed = train(tmp_path / "cut", config)
    assert weights(resumed) == weights(whole)
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")


def test_resuming_in_the_compiled_simulator_is_bit_equal(tmp_path, monkeypatch):
    def drive(directory):
        return adapt(network(), CONFIG, SCENARIO, directory, 3, DATA, checkpoint_seconds=0)

    whole = drive(tmp_path / "whole")
    update = Learner.update

    def dying(self, batch):
        if self.updates == 12:
            raise Killed
        update(self, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", dying)
        with pytest.raises(Killed):
            drive(tmp_path / "cut")
    assert weights(drive(tmp_path / "cut")) == weights(whole)
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")


@pytest.mark.parametrize("kind", ["rapid", "mlp-mixture"])
@pytest.mark.parametrize("freeze_decoder", [False, True])
def test_the_distilled_policy_stays_bit_equal(tmp_path, kind, freeze_decoder):
    if kind == "mlp-mixture" and freeze_decoder:
        pytest.skip("a mixture of actions has no decoder")
    trained, fresh = train(tmp_path, replace(CONFIG, freeze_decoder=freeze_decoder), kind), network(kind)
    same = {name for name, value in trained.state_dict().items() if torch.equal(value, fresh.state_dict()[name])}
    first = {name for name in fresh.state_dict() if "policies.0" in name or "mlps.0" in name}
    assert first
    assert first <= same
    assert any("gate" in name or "weights_N" in name for name in set(fresh.state_dict()) - same)
    assert freeze_decoder == ({name for name in fresh.state_dict() if "decoder" in name} <= same and kind == "rapid")


def test_all_and_scratch_train_every_weight(tmp_path):
    fresh = network("mlp")
    for mode in ("all", "scratch"):
        trained = train(tmp_path / mode, replace(CONFIG, train=mode), "mlp")
        changed = [
            not torch.equal(value, old) for value, old in zip(trained.parameters(), fresh.parameters(), strict=True)
        ]
        assert all(changed)
    with pytest.raises(RapidError, match="no adapter to train"):
        train(tmp_path / "adapter", kind="mlp")


def test_metrics_say_how_much_was_forgotten_and_how_far_the_gate_opened(tmp_path):
    seen = []
    train(tmp_path, evaluate=lambda net, steps: {"at": seen.append(steps) or steps})
    rows = {row["step"]: row for row in lines(tmp_path)}
    assert sorted(rows) == [15, 30, 45, 60]
    assert seen == [30, 60]
    assert rows[60]["evaluation"] == {"at": 60}
    assert rows[15]["gate"] == 0
    assert rows[60]["gate"] > 0
    assert all(0 <= rows[step]["agreement"] <= 1 for step in seen)
    assert rows[60]["updates"] == 20
    assert rows[60]["learning_rate"] == 0
    assert rows[45]["episodes"] >= 1
    # Nothing is forgotten where nothing can change.
    still = replace(CONFIG, learning_starts=1_000)
    train(tmp_path / "still", still)
    assert lines(tmp_path / "still")[-1]["agreement"] == 1
    assert "agreement" not in lines(tmp_path / "still")[0]
    train(tmp_path / "none", offline=None)
    assert lines(tmp_path / "none")[-1]["agreement"] is None


def test_exploration_falls_from_end_to_end():
    config = AdaptConfig(steps=1_000, exploration_start=0.9, exploration_end=0.1, exploration_share=0.5)
    assert exploration(config, 0) == 0.9
    assert exploration(config, 250) == pytest.approx(0.5)
    assert exploration(config, 500) == exploration(config, 1_000) == pytest.approx(0.1)
    values = [exploration(config, step) for step in range(0, 1_001, 10)]
    assert values == sorted(values, reverse=True)
    assert exploration(replace(config, exploration_share=0.0), 0) == pytest.approx(0.1)


def test_epsilon_is_the_share_of_random_actions():
    net = network("mlp")
    obs = fake_transitions(20).obs_NVF
    rng = np.random.default_rng(0)
    greedy = Explorer(200).act(net, obs, 0.0, rng, "cpu")
    np.testing.assert_array_equal(greedy, net(torch.from_numpy(obs)).argmax(1))
    other = Explorer(200).act(net, obs, 1.0, rng, "cpu")
    assert np.bincount(other, minlength=5).min() > 20
    for longest in (1, 5):
        explorer = Explorer(200, longest)
        some = np.stack([explorer.act(net, obs, 0.25, rng, "cpu") for _ in range(100)])
        assert (some != greedy).mean() == pytest.approx(0.25 * 0.8, abs=0.02)


def test_random_actions_are_held_for_every_number_of_steps_up_to_the_longest():
    net = network("mlp")
    obs = fake_transitions(40).obs_NVF
    greedy = Explorer(400).act(net, obs, 0.0, np.random.default_rng(0), "cpu")
    explorer, rng = Explorer(400, 4), np.random.default_rng(1)
    strange = np.stack([explorer.act(net, obs, 0.02, rng, "cpu") for _ in range(200)])
    lengths = []
    for world in range(400):
        column = strange[:, world]
        edges = np.flatnonzero(np.diff(column)) + 1
        lengths += [len(run) for run in np.split(column, edges)[1:-1] if run[0] != greedy[world]]
    counts = np.bincount(lengths, minlength=5)[1:5] / len(lengths)
    # Two runs of the same action now and then follow each other at once.
    assert counts.sum() > 0.98
    assert counts == pytest.approx(0.25, abs=0.05)


def test_denormal_numbers_are_zero_while_training_and_never_after(tmp_path):
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such mode")
    tiny, seen = torch.full((1,), 1e-40), []

    def measured(net, steps):
        seen.append((tiny * 1).item())
        if steps == 60:
            raise Killed
        return {}

    with pytest.raises(Killed):
        train(tmp_path, evaluate=measured)
    assert seen == [0, 0]
    assert (tiny * 1).item() > 0


def test_a_saved_explorer_goes_on_holding():
    net, rng = network("mlp"), np.random.default_rng(0)
    obs = fake_transitions(2).obs_NVF
    explorer = Explorer(20, 6)
    for _ in range(5):
        explorer.act(net, obs, 0.5, rng, "cpu")
    state = {name: value.copy() for name, value in explorer.state_dict().items()}
    assert state["left"].max() > 1
    other = Explorer(20, 6)
    other.load_state_dict(state)
    first, second = (each.act(net, obs, 0.5, np.random.default_rng(1), "cpu") for each in (explorer, other))
    np.testing.assert_array_equal(first, second)
    fresh = Explorer(20, 6).act(net, obs, 0.5, np.random.default_rng(1), "cpu")
    assert (fresh != first).any()


def test_settings_that_do_not_fit_are_refused(tmp_path):
    robust = replace(CONFIG, loss=replace(CONFIG.loss, robust_weight=0.5))
    for config, offline, message in (
        (replace(CONFIG, offline_share=0.5), None, "needs the offline data"),
        (robust, DATA, "no teacher transitions are in the batches"),
        (replace(robust, offline_share=0.5), fake_transitions(5, RANDOM), "needs transitions of the teacher"),
        (replace(CONFIG, optimizer=OptimizerConfig(algorithm="bc")), DATA, "Cloning has nothing to learn"),
    ):
        with pytest.raises(RapidError, match=message):
            train(tmp_path, config, offline=offline)
    train(tmp_path)
    with pytest.raises(RapidError, match=r"other settings: weights: "):
        train(tmp_path, net=network(seed=9))
