import copy
import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_distill import DATA, Killed, lines, network, weights
from torch import Tensor

from fake_worlds import FakeWorlds
from rapid.agents.saved import QAgent
from rapid.config import AdaptConfig, AdversaryConfig, NetworkConfig, PpoConfig
from rapid.errors import RapidError
from rapid.losses import policy_gradient_loss
from rapid.networks.blocks import Block
from rapid.networks.q_network import QNetwork, build_network, set_phase
from rapid.scenarios import FASTER
from rapid.simulator import make_vec
from rapid.training import adapt_by_ppo, ppo, ppo_learner
from rapid.training.collector import Collector, Rollout, advantages
from rapid.training.machinery.diagnostics import Forgetting
from rapid.training.machinery.worlds import Drive
from rapid.training.ppo_learner import PpoLearner, without_clock

SCENARIO = "lane-3-density-2"
PPO = PpoConfig(steps=100, num_envs=3, rollout=8, epochs=2, batch_size=10, critic_steps=24)
CONFIG = AdaptConfig(steps=50, num_envs=10, evaluate_every=48, ppo=PPO)
"""Four rollouts of 24 steps, of which the first is the critic's alone."""


class TimedWorlds(FakeWorlds):
    """The same worlds with the time in the ego's presence."""

    def _obs(self) -> np.ndarray:
        obs = super()._obs()
        obs[:, 0, 0] += self.state[:, 2] / 30
        return obs


class PaidWorlds(TimedWorlds):
    """FASTER alone is paid, and nobody crashes."""

    def step(self, actions: np.ndarray):
        # What the sum of actions would have to be before this step to be 0 after it: 673 is 1/3 modulo 1009.
        self.state[:, 3] = -673 * (actions + 1 + self.state[:, 0])
        obs, _, crashed, late, info = super().step(actions)
        return obs, (actions == FASTER).astype(float), crashed, late, info


def worlds(count: int) -> FakeWorlds:
    return TimedWorlds(count, autoreset=True)


def train(
    directory: Path,
    config: AdaptConfig = CONFIG,
    kind: str = "rapid",
    seed: int = 3,
    net: QNetwork | None = None,
    make_worlds: Callable[[int], Any] | None = worlds,
    **options: Any,
) -> QNetwork:
    torch.set_num_threads(1)
    net = network(kind) if net is None else net
    return adapt_by_ppo(net, config, SCENARIO, directory, seed, make_worlds=make_worlds, **options)


def collect(learner: PpoLearner, drive: Drive, config: PpoConfig) -> Rollout:
    """One rollout, as it is at the end of a training."""
    return Collector(drive, config, AdversaryConfig(), learner.network.scale_F, 0, "cpu").collect(learner)


def test_advantages_are_those_counted_by_hand():
    reward_TW = torch.tensor([[1.0], [2.0], [3.0]])
    value_TW = torch.tensor([[0.5], [1.0], [2.0], [4.0]])
    going_on = torch.zeros(3, 1, dtype=torch.bool)
    # Errors 1 + 0.5 * 1 - 0.5, 2 + 0.5 * 2 - 1 and 3 + 0.5 * 4 - 2, each later one worth 0.5 * 0.8 of the one before.
    expected = [[1 + 0.4 * (2 + 0.4 * 3)], [2 + 0.4 * 3], [3.0]]
    torch.testing.assert_close(advantages(reward_TW, value_TW, going_on, 0.5, 0.8), torch.tensor(expected))
    ends = torch.tensor([[False], [True], [False]])
    # Nothing comes after the second step: its error is 2 - 1, and the first one's sum stops there.
    expected = [[1 + 0.4 * 1], [1.0], [3.0]]
    torch.testing.assert_close(advantages(reward_TW, value_TW, ends, 0.5, 0.8), torch.tensor(expected))


@given(
    st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.booleans()), min_size=1, max_size=12),
    st.floats(0, 1),
    st.floats(-5, 5),
)
def test_with_every_trace_kept_an_advantage_is_the_return_less_the_value(
    steps: list[tuple[float, float, bool]], discount: float, last: float
):
    reward_TW, value_TW, ended_TW = (
        torch.tensor(column, dtype=torch.float64)[:, None] for column in zip(*steps, strict=True)
    )
    ended_TW = ended_TW.bool()
    value_TW = torch.cat([value_TW, torch.tensor([[last]], dtype=torch.float64)])
    found = advantages(reward_TW, value_TW, ended_TW, discount, 1.0)
    after = last
    for step in range(len(steps) - 1, -1, -1):
        after = steps[step][0] + (0 if steps[step][2] else discount * after)
        assert found[step, 0].item() == pytest.approx(after - steps[step][1], abs=1e-9)


def test_the_policy_loss_is_that_counted_by_hand():
    ratio = torch.tensor([1.5, 0.5, 1.1, 0.5])
    # Of mean 0 and standard deviation 1 as they are.
    advantage = torch.tensor([1.0, 1.0, -1.0, -1.0])
    log_prob = ratio.log().requires_grad_()
    loss = policy_gradient_loss(log_prob, torch.zeros(4), advantage, 0.2)
    # 1.2 for 1.5: no more is gained by going further. 0.5 stays: it may come back. -1.1 stays, -0.8 for -0.5.
    assert loss.item() == pytest.approx(-(1.2 + 0.5 - 1.1 - 0.8) / 4)
    (gradient,) = torch.autograd.grad(loss, log_prob)
    torch.testing.assert_close(gradient, torch.tensor([0.0, -0.5 / 4, 1.1 / 4, 0.0]))
    # The scale of the advantages does not matter, nor where they lie.
    assert policy_gradient_loss(log_prob, torch.zeros(4), 30 * advantage + 7, 0.2).item() == pytest.approx(loss.item())
    # Alike, they say nothing.
    assert policy_gradient_loss(log_prob, torch.zeros(4), torch.full((4,), 3.0), 0.2).item() == 0


@pytest.mark.parametrize("kind", ["rapid", "mlp"])
def test_training_twice_is_bit_equal(tmp_path: Path, kind: str):
    config = CONFIG if kind == "rapid" else replace(CONFIG, train="all")
    first, second = (train(tmp_path / f"{i}", config, kind) for i in (1, 2))
    assert weights(first) == weights(second) != weights(network(kind))
    assert lines(tmp_path / "1") == lines(tmp_path / "2")
    assert weights(train(tmp_path / "3", config, kind, seed=4)) != weights(first)


@pytest.mark.parametrize("make_worlds", [worlds, None], ids=["fake", "compiled"])
@pytest.mark.parametrize("stop", [1, 9, 18])
def test_resumed_equals_uninterrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int, make_worlds: Any):
    whole = train(tmp_path / "whole", make_worlds=make_worlds)
    step, count = PpoLearner._take_step, itertools.count(1)  # pyright: ignore[reportPrivateUsage]

    def dying(self: PpoLearner, batch: Rollout, rate: float) -> bool:
        if next(count) == stop:
            raise Killed
        return step(self, batch, rate)

    with monkeypatch.context() as patch:
        patch.setattr(PpoLearner, "_take_step", dying)
        with pytest.raises(Killed):
            train(tmp_path / "cut", make_worlds=make_worlds, checkpoint_seconds=0)
    resumed = train(tmp_path / "cut", make_worlds=make_worlds)
    assert weights(resumed) == weights(whole)
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")


def test_the_distilled_policy_stays_bit_equal_and_the_gate_opens(tmp_path: Path):
    trained, fresh = train(tmp_path).state_dict(), network().state_dict()
    same = {name for name, value in trained.items() if torch.equal(value, fresh[name])}
    assert {name for name in fresh if "policies.0" in name} <= same
    assert any("gate" in name for name in set(fresh) - same)
    assert lines(tmp_path)[-1]["gate"] > 0


def test_the_frozen_policys_tokens_are_computed_once_a_rollout_and_change_no_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    net, calls = network(), list[int]()
    cast(Any, net.head.mixture).policies[0].register_forward_hook(lambda *_: calls.append(1))
    kept = train(tmp_path / "kept", net=net)
    # Four rollouts of eight decisions; three minibatches of each but the critic's own, for both passes.
    assert len(calls) == 4 * 8 + 3 * 3
    monkeypatch.setattr(QNetwork, "frozen_tokens", lambda *_: None)
    assert weights(train(tmp_path / "anew")) == weights(kept)


def test_policy_and_critic_learn_beside_each_other_with_the_same_result():
    found: list[tuple[bytes, bytes]] = []
    for threads in (1, 2):
        try:
            torch.set_num_threads(threads)
            learner = PpoLearner(network(), PPO, 1.0, False, 0, 4)
            learner.rollouts = learner.taught = 1
            with learner.computing():
                assert torch.get_num_threads() == 1
                learner.update(collect(learner, Drive(worlds, PPO.num_envs, 1), PPO))
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(1)
        found.append((weights(learner.network), weights(learner.critic)))
    assert found[0] == found[1] != (weights(network()), weights(learner.critic))


def test_with_compiled_layers_it_learns_the_same_but_for_rounding(tmp_path: Path):
    compiled = replace(CONFIG, ppo=replace(PPO, attention="compiled"))
    net = build_network(NetworkConfig(), 3, 0)
    ours, torchs = (train(tmp_path / c.ppo.attention, c, net=copy.deepcopy(net)) for c in (compiled, CONFIG))
    assert weights(ours) != weights(torchs) != weights(net)
    moved = False
    for mine, other, before in zip(ours.parameters(), torchs.parameters(), net.parameters(), strict=True):
        # Adam's steps are as long as the step size, whichever sign a gradient near 0 has.
        torch.testing.assert_close(mine, other, rtol=0, atol=1e-4)
        moved |= bool((other - before).abs().max() > 1e-3)
    assert moved
    for first, second in zip(lines(tmp_path / "compiled"), lines(tmp_path / "torch"), strict=True):
        assert first["value"] == pytest.approx(second["value"], rel=1e-3)
    assert weights(train(tmp_path / "again", compiled, net=net)) == weights(ours)
    # Whoever uses the network afterwards has torch's layers.
    assert not any(module.compiled for module in ours.modules() if isinstance(module, Block))


def test_an_attack_on_compiled_layers_has_the_gradient_of_what_is_seen_alone_and_bit_for_bit_the_same():
    net = build_network(NetworkConfig(), 3, 0)
    torch.nn.init.constant_(cast(Any, net.gate), 0.3)
    set_phase(net, "adapt")
    learner = PpoLearner(net, replace(PPO, attention="compiled"), 1.0, True, 0, 4)
    trained = [parameter for parameter in net.parameters() if parameter.requires_grad]
    seen = torch.from_numpy(make_vec(SCENARIO, num_envs=6).reset(seed=0)[0]).float().requires_grad_()
    with learner.computing():
        attacked, whole = learner.q_values(seen), net(seen)
        assert torch.equal(attacked, whole)
        ours = torch.autograd.grad(attacked.sum(), [seen, *trained], allow_unused=True, retain_graph=True)
        theirs = torch.autograd.grad(whole.sum(), [seen, *trained], materialize_grads=True)
    assert torch.equal(ours[0], theirs[0])
    assert all(gradient is None for gradient in ours[1:])
    assert any(bool(gradient.any()) for gradient in theirs[1:])
    assert trained == [parameter for parameter in net.parameters() if parameter.requires_grad]


def test_the_policy_waits_until_the_critic_has_learned(tmp_path: Path):
    seen = []
    patient = replace(CONFIG, evaluate_every=24, ppo=replace(PPO, critic_steps=60))
    train(tmp_path, patient, evaluate=lambda net, steps: seen.append(weights(net)) or {})
    assert len(seen) == 4
    assert set(seen[:3]) == {weights(network())}
    assert seen[3] != seen[0]
    rows = lines(tmp_path)
    assert [row["learning_rate"] for row in rows] == [0, 0, PPO.learning_rate * 0.25, 0]
    assert all(row["value"] > 0 for row in rows)
    assert ["policy" in row for row in rows] == [False, False, False, True]


def test_only_the_critic_is_told_the_time():
    net = network()
    set_phase(net, "adapt")
    obs_BVF = torch.from_numpy(DATA.obs_NVF[:6])
    late_BVF = obs_BVF.clone()
    late_BVF[:, 0, 0] = 1.7
    blind, seeing = (PpoLearner(net, PPO, 1.0, sees_clock, 0, 4) for sees_clock in (False, True))
    assert torch.equal(blind.as_seen(late_BVF), without_clock(late_BVF))
    assert torch.equal(blind.as_seen(late_BVF), obs_BVF)
    assert torch.equal(seeing.as_seen(late_BVF), late_BVF)
    assert not torch.equal(seeing.log_probs(late_BVF), seeing.log_probs(obs_BVF))
    assert not torch.equal(blind.values(late_BVF), blind.values(obs_BVF))
    # The policy that drives is that of the agent, whose greedy action is the likeliest.
    greedy_B = QAgent(net, "RAPID").act(obs_BVF.numpy())
    np.testing.assert_array_equal(greedy_B, blind.log_probs(blind.as_seen(late_BVF)).argmax(1))
    assert late_BVF[0, 0, 0] == pytest.approx(1.7)


def test_the_clock_is_kept_from_the_policy_wherever_the_scenario_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    told, seen = [], []

    class Watched(PpoLearner):
        def values(self, obs_BVF: Tensor):
            told.append(obs_BVF[:, 0, 0])
            return super().values(obs_BVF)

        def log_probs(self, seen_BVF: Tensor, state_BS: Tensor | None = None, first_BVD: Tensor | None = None):
            handle = self.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][:, 0, 0]))
            try:
                return super().log_probs(seen_BVF, state_BS, first_BVD)
            finally:
                handle.remove()

    monkeypatch.setattr(ppo, "PpoLearner", Watched)
    for scenario, largest in ((SCENARIO, 1.0), (f"{SCENARIO}:clock", 1.1)):
        told.clear()
        seen.clear()
        adapt_by_ppo(network(), CONFIG, scenario, tmp_path / scenario, 3)
        assert torch.cat(told).max() > 1.1
        assert torch.cat(told).min() == 1
        assert torch.cat(seen).min() == 1
        assert (torch.cat(seen).max() > largest) == ("clock" in scenario)


def test_without_its_clock_a_world_looks_as_one_without():
    plain, timed = (make_vec(name, 4, autoreset=False) for name in (SCENARIO, f"{SCENARIO}:clock"))
    seeds = list(range(4))
    pairs = [(plain.reset(seed=seeds)[0], timed.reset(seed=seeds)[0])]
    for action in (FASTER, 0, 2):
        actions = np.full(4, action)
        pairs.append((plain.step(actions)[0], timed.step(actions)[0]))
    for first, second in pairs:
        np.testing.assert_array_equal(first, without_clock(torch.from_numpy(second)).numpy())
    assert (pairs[-1][1][:, 0, 0] > 1).all()


def test_nothing_comes_after_the_time_limit():
    net = network()
    set_phase(net, "adapt")
    config = replace(PPO, rollout=8, num_envs=2)
    learner = PpoLearner(net, config, 1.0, False, 0, 4)
    drive = Drive(lambda count: PaidWorlds(count, True, duration=5), 2, 1)
    rollout = collect(learner, drive, config)
    paid_TW = (rollout.action_N == FASTER).float().view(8, 2)
    # Both worlds end with their fifth step: its target is what it paid and no more.
    torch.testing.assert_close(rollout.return_N.view(8, 2)[4], paid_TW[4])
    assert (rollout.return_N.view(8, 2)[3] != paid_TW[3]).all()


def test_a_crash_costs_more_in_learning_than_in_what_is_reported():
    net = network()
    set_phase(net, "adapt")
    found = []
    for penalty in (0.0, 3.0):
        config = replace(PPO, crash_penalty=penalty, rollout=30, trace=1.0)
        drive = Drive(worlds, 3, 1)
        learner = PpoLearner(net, config, 1.0, False, 0, 4)
        rollout = collect(learner, drive, config)
        found.append((rollout, drive.means()))
    (plain, means), (dear, same) = found
    assert means == same
    assert means["crash_share"] > 0
    # With every trace kept, the target is the return itself: it falls by the penalty wherever a crash follows.
    lost_N = plain.return_N - dear.return_N
    assert torch.equal(lost_N.round(decimals=4), 3.0 * (lost_N > 1).float())
    assert (lost_N > 1).any()


def test_it_learns_what_is_paid(tmp_path: Path):
    sizes = {"steps": 12_000, "num_envs": 20, "rollout": 15, "batch_size": 100, "learning_rate": 3e-3}
    config = replace(CONFIG, evaluate_every=0, train="all", ppo=replace(PPO, **sizes))
    trained = train(tmp_path, config, net=network("mlp"), make_worlds=lambda count: PaidWorlds(count, True))
    rows = lines(tmp_path)
    returns = [row["return"] for row in rows if row["return"] is not None]
    assert np.mean(returns[:2]) < 12
    assert np.mean(returns[-2:]) > 20
    obs_BVF = torch.from_numpy(DATA.obs_NVF)
    assert (trained(obs_BVF).argmax(1) == FASTER).double().mean() > 0.6


def test_metrics_go_on_where_q_learning_ended(tmp_path: Path):
    seen = []
    forgetting = Forgetting(network(), DATA, 3)
    seldom = replace(CONFIG, evaluate_every=70)
    train(tmp_path, seldom, evaluate=lambda net, steps: {"at": seen.append(steps) or steps}, forgetting=forgetting)
    rows = lines(tmp_path)
    assert [row["step"] for row in rows] == [50 + 24 * count for count in range(1, 5)]
    # Where a multiple of 70 was passed, and at the end.
    assert seen == [74, 146]
    assert [row["updates"] for row in rows] == [6, 12, 18, 24]
    assert 0 <= rows[-1]["agreement"] <= 1
    assert "agreement" not in rows[1]
    assert rows[-1]["entropy"] > 0
    train(tmp_path / "none")
    assert lines(tmp_path / "none")[-1]["agreement"] is None


def test_what_is_not_finite_stops_it_and_the_last_good_checkpoint_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    loss, count = ppo_learner.policy_gradient_loss, itertools.count(1)

    def broken(*arguments: Any):
        return loss(*arguments) * (float("nan") if next(count) == 9 else 1)

    with monkeypatch.context() as patch:
        patch.setattr(ppo_learner, "policy_gradient_loss", broken)
        with pytest.raises(RapidError, match=r"by update 18 of PPO: a loss or a weight is not finite. Lower"):
            train(tmp_path, checkpoint_seconds=0)
    assert [row["updates"] for row in lines(tmp_path)] == [6, 12]
    assert weights(train(tmp_path)) == weights(train(tmp_path / "whole"))


def test_an_observation_that_is_not_finite_stops_it(tmp_path: Path):
    class Broken(TimedWorlds):
        def _obs(self):
            obs = super()._obs()
            obs[self.state[:, 2] == 5] = np.nan
            return obs

    with pytest.raises(RapidError, match="after update 0 of PPO: an observation or a Q-value is not finite"):
        train(tmp_path, make_worlds=lambda count: Broken(count, autoreset=True))


def test_what_does_not_fit_is_refused(tmp_path: Path):
    train(tmp_path)
    with pytest.raises(RapidError, match=r"other settings: config.ppo.clip: 0.2 there, 0.1 now"):
        train(tmp_path, replace(CONFIG, ppo=replace(PPO, clip=0.1)))
    for few in ({"steps": 23}, {"critic_steps": 80}):
        with pytest.raises(RapidError, match="the policy learns nothing in less than"):
            train(tmp_path / "few", replace(CONFIG, ppo=replace(PPO, **few)))
    with pytest.raises(RapidError, match="no adapter to train"):
        train(tmp_path / "adapter", kind="mlp")
