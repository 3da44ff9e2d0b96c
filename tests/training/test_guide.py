"""What a policy is shown as it begins to learn under attack."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from test_adversary import ATTACKED, MIXTURE, SCALE, SCENARIO, adversary, linear, observations, train
from test_distill import Killed, lines, network, weights
from test_ppo import PPO, worlds

from rapid.agents.saved import save_agent
from rapid.config import AdaptConfig, Config, NetworkConfig
from rapid.config_io import least_steps, validate
from rapid.errors import RapidError
from rapid.networks.conversions import with_memory
from rapid.networks.memory import STEPS, initial_state
from rapid.networks.q_network import QNetwork, build_network
from rapid.phases.adapt import adapt_agent
from rapid.phases.checks import check, shown_plan
from rapid.presets import preset
from rapid.scenarios import FASTER, IDLE, LANE_RIGHT, SLOWER
from rapid.teacher.scripted import plan_for
from rapid.training import adapt_by_ppo
from rapid.training.collector import Collector
from rapid.training.machinery.adversary import CLEAN
from rapid.training.machinery.guide import CERTAINTY, Guide
from rapid.training.machinery.worlds import Drive
from rapid.training.ppo_learner import PpoLearner

PLAN = [SLOWER, SLOWER, LANE_RIGHT, FASTER]
GUIDED = replace(ATTACKED, adversary=replace(MIXTURE, guided=0.5))
"""Of four rollouts the first two are guided."""


def guide(net: QNetwork, count: int = 6) -> Guide:
    return Guide(net, PLAN, replace(PPO, num_envs=count), torch.Generator().manual_seed(0))


def states(steps: list[int]) -> torch.Tensor:
    state_WS = initial_state(len(steps), 3)
    state_WS[:, STEPS] = steps
    return torch.from_numpy(state_WS)


def test_it_shows_the_plan_under_attack_and_what_the_policy_did_before_elsewhere():
    net, obs, state_WS = with_memory(network()), observations(6), states([0, 2, 3, 4, 29, 1])
    shows = guide(net)
    attacked_W = torch.tensor([True, True, True, True, True, False])
    before_WA = (net(obs, state_WS) / PPO.temperature).softmax(1).detach()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.3)
    shown_WA = shows(obs, state_WS, attacked_W)
    torch.testing.assert_close(shown_WA.sum(1), torch.ones(6))
    assert shown_WA[:5].argmax(1).tolist() == [SLOWER, LANE_RIGHT, FASTER, IDLE, IDLE]
    assert shown_WA[0, SLOWER].item() == pytest.approx(CERTAINTY + (1 - CERTAINTY) / 5)
    # What has been learned since does not matter.
    torch.testing.assert_close(shown_WA[5], before_WA[5])
    assert not torch.allclose(shown_WA[5], (net(obs, state_WS) / PPO.temperature).softmax(1)[5])


def test_it_leads_every_episode_at_first_and_none_in_the_second_half_of_its_time():
    shows, all_W = guide(with_memory(network()), 4_000), np.ones(4_000, bool)
    assert shows.leads_W.all()
    for left, share in ((1.0, 1.0), (0.75, 0.5), (0.5, 0.0), (0.1, 0.0)):
        shows.left = left
        shows.begin(all_W)
        assert shows.leads_W.float().mean().item() == pytest.approx(share, abs=0.03)
    shows.left = 1.0
    shows.begin(np.arange(4_000) < 1_000)
    assert shows.leads_W.sum() == 1_000
    shown_WA = torch.eye(5)[torch.full((4_000,), FASTER)]
    taken_W = shows.drive(torch.zeros(4_000, dtype=torch.long), shown_WA)
    assert torch.equal(taken_W == FASTER, shows.leads_W)


def test_the_policy_learns_from_what_it_sees_what_was_shown_for_the_truth():
    net = with_memory(network())
    config = replace(PPO, rollout=20, num_envs=4)
    learner, drive = PpoLearner(net, config, 1.0, False, 0, 4), Drive(worlds, 4, 1, lanes=3)
    mixture = replace(MIXTURE, gradient_share=0.6, guided=0.5)
    collector = Collector(drive, config, mixture, SCALE, 0, "cpu", lambda: guide(net, 4))
    true, kinds, step = list[torch.Tensor](), list[torch.Tensor](), drive.step

    def watched(action_W: Any) -> Any:
        true.append(torch.from_numpy(drive.obs_WVF.copy()))
        kinds.append(collector.adversary.kind_W.clone())
        return step(action_W)

    drive.step = watched  # pyright: ignore[reportAttributeAccessIssue]
    rollout = collector.collect(learner, 0, 2)
    assert rollout.shown_NA is not None
    assert rollout.state_NS is not None
    assert collector.guide is not None
    truth, kind = torch.cat(true), torch.cat(kinds)
    assert len(kind.unique()) > 2
    expected_NA = collector.guide(learner.as_seen(truth), rollout.state_NS, kind != CLEAN)
    torch.testing.assert_close(rollout.shown_NA, expected_NA)
    seen_N = (rollout.seen_NVF == learner.as_seen(truth)).all(-1).all(-1)
    assert torch.equal(seen_N, kind == CLEAN)
    # It leads everywhere at first, so that the plan is driven, and its time ends.
    followed_N = rollout.action_N == rollout.shown_NA.argmax(1)
    assert followed_N[kind != CLEAN].float().mean() > 0.9
    assert collector.collect(learner, 1, 2).shown_NA is None
    assert collector.guide is None


def test_what_is_shown_is_learned_and_the_critic_and_the_first_policy_left_alone(tmp_path: Path):
    # All of the time, and always under attack.
    mixture = replace(MIXTURE, gradient_share=0.6, noise_share=0.4, guided=1.0)
    long = replace(PPO, steps=24 * 24, epochs=8, guide_rate=1e-2)
    before = with_memory(network())
    net = train(tmp_path, replace(GUIDED, adversary=mixture, ppo=long), plan=PLAN)
    rows = lines(tmp_path)
    assert rows[0]["shown"] > 1.0 > 0.5 > rows[-1]["shown"]
    assert rows[0]["follows"] < 0.8
    assert rows[-1]["follows"] > 0.9
    assert all("value" not in row and "policy" not in row for row in rows)
    for name, value in net.state_dict().items():
        if name.startswith("head.mixture.policies.0."):
            assert torch.equal(value, before.state_dict()[name])
    shown_T = [net(observations(1), states([step])).argmax(1).item() for step in range(5)]
    assert shown_T == [*PLAN, IDLE]


def test_who_begins_to_squeeze_features_is_shown_what_it_did_by_all_of_them(tmp_path: Path, monkeypatch: Any):
    shown: list[QNetwork] = []

    class Watched(Guide):
        def __init__(self, network: QNetwork, *given: Any) -> None:
            super().__init__(network, *given)
            shown.append(self.network)

    monkeypatch.setattr("rapid.training.ppo.Guide", Watched)
    usual = preset("strong", "tiny", "squeezed")
    small = replace(usual.adapt.ppo, steps=480, critic_steps=0, num_envs=8, batch_size=60, attention="torch")
    first = replace(usual.adapt.adversary, begin=0.0, ramp=0.0, guided=1.0)
    config = replace(usual, adapt=replace(usual.adapt, steps=0, ppo=small, adversary=first, evaluate_every=0))
    distilled = network()
    save_agent(tmp_path / "agent", distilled, {"scenario": SCENARIO})
    agent = adapt_agent(config, tmp_path / "agent", None, tmp_path / "out")
    (teacher,) = shown
    assert (teacher.config.squeeze, agent.network.config.squeeze) == (False, True)
    kept = teacher.state_dict()
    assert all(torch.equal(kept[name], value) for name, value in distilled.state_dict().items())
    # Who squeezed already goes on from what it did itself, and so does who has learned by the time the guide begins.
    adapt_agent(config, tmp_path / "out" / "agent", None, tmp_path / "on")
    late = replace(config, adapt=replace(config.adapt, adversary=replace(first, begin=0.5, guided=0.5)))
    adapt_agent(late, tmp_path / "agent", None, tmp_path / "late")
    assert [teacher.config.squeeze for teacher in shown] == [False, True, True]


def test_after_the_guide_comes_the_return(tmp_path: Path):
    train(tmp_path, GUIDED, plan=PLAN)
    rows = lines(tmp_path)
    assert ["shown" in row for row in rows] == [True, True, False, False]
    assert ["value" in row for row in rows] == [False, False, True, True]
    # From what a guide shows the critic learns nothing: the steps that are its own are counted after it.
    for steps, learns in ((0, True), (GUIDED.ppo.num_envs * GUIDED.ppo.rollout, False)):
        train(tmp_path / f"{steps}", replace(GUIDED, ppo=replace(GUIDED.ppo, critic_steps=steps)), plan=PLAN)
        assert ["policy" in row for row in lines(tmp_path / f"{steps}")] == [False, False, learns, True]


@pytest.mark.parametrize(("attention", "squeeze"), [("torch", False), ("compiled", False), ("compiled", True)])
@pytest.mark.parametrize("stop", [1, 2, 3])
def test_a_guided_training_that_was_killed_ends_as_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int, attention: Literal["torch", "compiled"], squeeze: bool
):
    # The second and the third of four rollouts are guided; the checkpoint before the third holds a guide. Who begins to
    # squeeze features is guided from the first on, by what it was.
    begin, guided = (0.0, 0.75) if squeeze else (0.25, 0.5)
    config = replace(GUIDED, adversary=replace(MIXTURE, begin=begin, guided=guided))
    config = replace(config, ppo=replace(config.ppo, attention=attention))

    def train(directory: Path, config: AdaptConfig, **options: Any) -> QNetwork:
        # As wide as what is compiled is made for.
        seeing = with_memory(build_network(NetworkConfig(width=32, feedforward=32, vehicles=4), 3, 0))
        origin, net = (seeing, with_memory(seeing, squeeze=True)) if squeeze else (None, seeing)
        return adapt_by_ppo(net, config, SCENARIO, directory, 3, make_worlds=worlds, origin=origin, **options)

    whole = train(tmp_path / "whole", config, plan=PLAN)
    count, update = itertools.count(), PpoLearner.update

    def dying(self: PpoLearner, *given: Any) -> None:
        if next(count) == stop:
            raise Killed
        update(self, *given)

    with monkeypatch.context() as patch:
        patch.setattr(PpoLearner, "update", dying)
        with pytest.raises(Killed):
            train(tmp_path / "cut", config, checkpoint_seconds=0, plan=PLAN)
    assert weights(train(tmp_path / "cut", config, plan=PLAN)) == weights(whole)
    assert lines(tmp_path / "cut") == lines(tmp_path / "whole")
    with pytest.raises(RapidError, match="another"):
        train(tmp_path / "whole", config, plan=[FASTER])


def test_an_attack_may_leave_the_egos_own_row_alone():
    weight, obs = torch.ones(2, 5, 5) * torch.arange(5.0), torch.ones(1, 2, 5) * SCALE
    config = replace(MIXTURE, gradient_share=1.0, noise_share=0.0, spared_share=0.5, near_share=0.25, steps=3)
    moved = (adversary(config, 2_000)(linear(weight), obs.expand(2_000, 2, 5), None, 1.0) / SCALE - 1).abs()
    spared = (moved[:, 0] == 0).all(1)
    assert spared.float().mean().item() == pytest.approx(0.5, abs=0.05)
    assert (moved[:, 1, 1:] > 0).all()
    assert moved.max() <= config.radius + 1e-4
    # Who climbs from the truth by a linear network ends in a corner; the others hardly ever do in as few steps.
    corner = (moved[:, 1, 1:] > config.radius - 1e-4).all(1)
    assert corner.float().mean().item() == pytest.approx(0.25, abs=0.08)


def test_bad_guides_are_refused(tmp_path: Path):
    with pytest.raises(RapidError, match="needs a network with a memory"):
        adapt_by_ppo(network(), GUIDED, SCENARIO, tmp_path / "a", 3, make_worlds=worlds, plan=PLAN)
    with pytest.raises(RapidError, match="and that plan"):
        train(tmp_path / "b", GUIDED)
    usual = Config()
    long = replace(usual.adapt, ppo=replace(usual.adapt.ppo, steps=100_000), adversary=GUIDED.adversary)
    with pytest.raises(RapidError, match=r"guided' is 0\.5, but must be 0 where adapt\.memory is false"):
        validate(replace(usual, adapt=long))
    late = replace(long, memory=True, adversary=replace(GUIDED.adversary, begin=0.6))
    with pytest.raises(
        RapidError, match=r"guided' is 0\.5, but must be at most 1 together with adapt\.adversary\.begin"
    ):
        validate(replace(usual, adapt=late))
    guided = replace(long, memory=True, adversary=replace(GUIDED.adversary, plan="13,2"))
    save_agent(tmp_path / "agent", network(), {"name": "x", "scenario": SCENARIO})
    with pytest.raises(RapidError, match="blind:5,2,4"):
        adapt_agent(replace(usual, adapt=replace(guided, steps=0)), tmp_path / "agent", None, tmp_path / "out")
    assert not (tmp_path / "out" / "ppo").exists()
    # Before any work of a run, which would collect and distil first.
    with pytest.raises(RapidError, match="A plan is written 5,2,4"):
        check(replace(usual, adapt=guided))
    # A guide teaches from the first rollout on; the critic's steps alone do not come before it.
    rollout = long.ppo.num_envs * long.ppo.rollout
    at_once = replace(GUIDED.adversary, begin=0.0, guided=1.0)
    short = replace(long, memory=True, ppo=replace(long.ppo, steps=rollout), adversary=at_once)
    later = replace(long, adversary=replace(at_once, begin=0.5, guided=0.5))
    assert least_steps(short) == rollout < short.ppo.critic_steps < least_steps(later)
    validate(replace(usual, adapt=short))
    # A guide whose time is less than a rollout never begins.
    for steps, share in ((rollout, 0.5), (4 * rollout, 0.1)):
        none = replace(short, ppo=replace(long.ppo, steps=steps), adversary=replace(at_once, guided=share))
        with pytest.raises(RapidError, match="until the policy learns"):
            validate(replace(usual, adapt=none))
    unattacked = replace(long, memory=True, adversary=replace(GUIDED.adversary, gradient_share=0.0, noise_share=0.0))
    with pytest.raises(RapidError, match="a plan is shown in attacked episodes"):
        validate(replace(usual, adapt=unattacked))


def test_the_plan_guided_adapts_an_agent_on_disk(tmp_path: Path):
    usual = preset("strong", "tiny", "guided")
    small = replace(usual.adapt.ppo, steps=480, critic_steps=120, num_envs=8, rollout=15, batch_size=60)
    config = replace(usual, adapt=replace(usual.adapt, steps=0, ppo=small, evaluate_every=0))
    validate(config)
    save_agent(tmp_path / "agent", network(), {"name": "x", "scenario": SCENARIO})
    agent = adapt_agent(config, tmp_path / "agent", None, tmp_path / "out")
    assert ["shown" in row for row in lines(tmp_path / "out" / "ppo")] == [False, False, False, True]
    assert agent.has_memory
    before, after = network().state_dict(), agent.network.state_dict()
    frozen = [name for name in before if name.startswith("head.mixture.policies.0.")]
    assert all(before[name].equal(after[name]) for name in frozen)
    assert any(not before[name].equal(after[name]) for name in before)


def test_the_plan_is_that_of_blind_unless_one_is_named():
    slower, right, faster = plan_for(SCENARIO)
    assert shown_plan(GUIDED, SCENARIO) == [SLOWER] * slower + [LANE_RIGHT] * right + [FASTER] * faster
    assert shown_plan(replace(GUIDED, adversary=replace(MIXTURE, guided=1.0, plan="2,1,1")), SCENARIO) == PLAN
    assert shown_plan(ATTACKED, "lane-6-density-2") == []
    with pytest.raises(RapidError, match="no plan for lane-6-density-2"):
        shown_plan(GUIDED, "lane-6-density-2")
