"""Phase 3 under attack: what the adversary does, and who sees what."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_distill import DATA, Killed, lines, network, weights
from test_ppo import CONFIG, PPO, TimedWorlds, worlds

from rapid.agents.open import check_road
from rapid.agents.saved import load_agent, remembers, save_agent
from rapid.config import AdversaryConfig, Config
from rapid.config_io import validate
from rapid.errors import RapidError
from rapid.networks.conversions import with_memory
from rapid.networks.encoding import feature_scale
from rapid.networks.memory import RIGHTMOST, initial_state, next_state
from rapid.networks.q_network import set_phase
from rapid.phases.adapt import adapt_agent
from rapid.presets import preset
from rapid.seeding import numpy_stream
from rapid.simulator import make_vec
from rapid.training import adapt_by_ppo
from rapid.training.collector import Collector
from rapid.training.machinery.adversary import AWAY, CLEAN, NOISE, TOWARDS, Adversary
from rapid.training.machinery.diagnostics import Forgetting
from rapid.training.machinery.worlds import Drive, Explorer
from rapid.training.ppo_learner import PpoLearner

SCENARIO = "lane-3-density-2"
MIXTURE = AdversaryConfig(gradient_share=0.5, noise_share=0.25, steps=2)
ATTACKED = replace(CONFIG, memory=True, adversary=MIXTURE, ppo=replace(PPO, exploration=0.2))
SCALE = feature_scale(3)


def adversary(config, count=6, seed=0):
    return Adversary(config, count, SCALE, 0.1, torch.Generator().manual_seed(seed))


def linear(weight_VFA):
    """Q-values that are linear in the normalised observation."""
    return lambda obs_BVF, state_BS: torch.einsum("bvf,vfa->ba", obs_BVF / SCALE, weight_VFA)


def train(directory, config=ATTACKED, seed=3, make_worlds=worlds, **options):
    torch.set_num_threads(1)
    return adapt_by_ppo(with_memory(network()), config, SCENARIO, directory, seed, make_worlds=make_worlds, **options)


def observations(count=6):
    env = TimedWorlds(count, autoreset=True)
    return torch.from_numpy(np.array(env.reset(seed=list(range(count)))[0], np.float32))


@pytest.mark.parametrize("size", [1.0, 0.25])
def test_it_stays_in_the_ball_and_leaves_presence_and_the_truth_alone(size):
    obs = observations(40)
    before, net = obs.clone(), network()
    bold = replace(MIXTURE, steps=3, step_size=1.0)
    liar = adversary(bold, 40)
    seen = liar(lambda o, s: net(o), obs, None, size)
    assert torch.equal(obs, before)
    moved = ((seen - obs) / SCALE).abs()
    assert (moved[..., 0] == 0).all()
    assert {kind.item() for kind in liar.kind_W.unique()} == {CLEAN, NOISE, AWAY, TOWARDS}
    for kind, most in ((CLEAN, 0), (NOISE, bold.noise), (AWAY, bold.radius), (TOWARDS, bold.radius)):
        part = moved[liar.kind_W == kind]
        assert part.max() <= most * size * (1 + 1e-4) + 1e-6
        assert part.max() >= 0.9 * most * size
    # Steps as long as this end in a corner of the ball, where the gradient is not 0.
    assert (moved[liar.kind_W >= AWAY][..., 1:] >= 0.99 * bold.radius * size).float().mean() > 0.5


def test_its_gradient_steps_are_those_counted_by_hand():
    weight = torch.zeros(2, 5, 5)
    weight[1, 1] = torch.tensor([3.0, 1.0, 0.0, 0.0, 0.0])
    obs = torch.ones(1, 2, 5) * SCALE
    config = AdversaryConfig(gradient_share=1.0, targeted_share=0.0, radius=0.1, steps=1, step_size=0.05)
    liar = adversary(config, 300)
    # Action 0 leads, more so the further ahead car 1 is: away from it is backwards. No other feature matters.
    moved = liar(linear(weight), obs.expand(300, 2, 5), None, 1.0) / SCALE - 1
    ahead = moved[:, 1, 1]
    # From the truth, one step that just reaches the edge; from a random point, one of 0.05, or to the edge.
    near = (moved.abs().sum((1, 2)) - 0.1).abs() < 1e-4
    assert 0.35 < near.float().mean() < 0.65
    torch.testing.assert_close(ahead[near], torch.full_like(ahead[near], -0.1), atol=1e-4, rtol=0)
    far = ahead[~near]
    assert far.max() <= 0.05 + 1e-4
    assert (far < -0.0999).float().mean() == pytest.approx(0.25, abs=0.1)
    others = moved[~near][:, 0, 1:]
    assert others.abs().max() <= 0.1 + 1e-4
    assert others.std() == pytest.approx(0.1 / 3**0.5, rel=0.1)
    # Towards an action drawn by chance: whichever it is, its share grows.
    towards = adversary(replace(config, targeted_share=1.0, steps=8), 200)
    many = obs.expand(200, 2, 5)
    moved = (towards(linear(weight), many, None, 1.0) / SCALE - 1)[:, 1, 1]
    # Three actions of five gain by the car falling back, action 0 by its being ahead; 1 has its best in between or at
    # an end.
    assert 0.1 < (moved > 0.099).float().mean() < 0.5
    assert 0.4 < (moved < -0.099).float().mean() < 0.9


def test_an_episode_is_under_one_attack_to_its_end():
    liar = adversary(MIXTURE, 50)
    before = liar.kind_W.clone()
    liar.begin(np.zeros(50, bool))
    assert torch.equal(liar.kind_W, before)
    ended = np.arange(50) < 25
    liar.begin(ended)
    assert torch.equal(liar.kind_W[25:], before[25:])
    assert not torch.equal(liar.kind_W[:25], before[:25])
    many = adversary(MIXTURE, 20_000).kind_W
    shares = [(many == kind).float().mean().item() for kind in (CLEAN, NOISE, AWAY, TOWARDS)]
    assert shares == pytest.approx([0.25] * 4, abs=0.02)


def test_the_critic_has_the_truth_and_the_policy_what_is_left_of_it():
    net = with_memory(network())
    set_phase(net, "adapt")
    config = replace(PPO, rollout=40, num_envs=3)
    learner = PpoLearner(net, config, 1.0, False, 0, 4)
    drive = Drive(worlds, 3, 1, lanes=3)
    collector = Collector(drive, config, replace(MIXTURE, gradient_share=0.6), SCALE, 0, "cpu")
    liar = collector.adversary
    true, kinds, states, step = [], [], [], drive.step

    def watched(action_W):
        true.append(torch.from_numpy(drive.obs_WVF.copy()))
        kinds.append(liar.kind_W.clone())
        states.append(drive.state_WS.copy())
        after = step(action_W)
        # A memory moves on with the action, whatever was seen, and begins anew with the episode.
        expected = next_state(states[-1], action_W, 3)
        expected[drive.ended_W] = initial_state(int(drive.ended_W.sum()), 3)
        np.testing.assert_array_equal(drive.state_WS, expected)
        return after

    drive.step = watched
    rollout = collector.collect(learner)
    truth, kind = torch.cat(true), torch.cat(kinds)
    assert len(kind.unique()) > 2
    told = rollout.obs_NVF.clone()
    told[:, 0, 0] -= 2.0 * (kind != CLEAN)
    torch.testing.assert_close(told, truth)
    np.testing.assert_array_equal(rollout.state_NS, np.concatenate(states))
    same_N = (rollout.seen_NVF == learner.as_seen(truth)).all(-1).all(-1)
    assert torch.equal(same_N, kind == CLEAN)
    # What is learned from is what drove: the same probabilities.
    log_prob_NA = learner.log_probs(rollout.seen_NVF, rollout.state_NS)
    chosen_N = log_prob_NA.gather(1, rollout.action_N[:, None]).squeeze(1)
    torch.testing.assert_close(chosen_N, rollout.log_prob_N, rtol=1e-4, atol=1e-4)


def test_the_attack_grows_over_its_ramp_and_exploration_falls_until_half_is_done(tmp_path, monkeypatch):
    sizes, shares, attack, explore = [], [], Adversary.__call__, Explorer.begin

    def attacked(self, q_of, obs, state, size):
        sizes.append(size)
        return attack(self, q_of, obs, state, size)

    def explored(self, epsilon, rng):
        shares.append(epsilon)
        return explore(self, epsilon, rng)

    monkeypatch.setattr(Adversary, "__call__", attacked)
    monkeypatch.setattr(Explorer, "begin", explored)
    bold = replace(PPO, exploration=0.4, exploration_hold=3)
    train(tmp_path, replace(ATTACKED, ppo=bold, adversary=replace(MIXTURE, ramp=0.5)))
    # Four rollouts of eight steps.
    assert sizes == [0] * 8 + [0.5] * 8 + [1] * 16
    assert shares == pytest.approx([0.4] * 8 + [0.2] * 8)


def test_who_explores_takes_what_was_drawn_and_learns_from_it_as_its_own():
    net = network()
    set_phase(net, "adapt")
    config = replace(PPO, rollout=40, num_envs=3, exploration=0.6, exploration_hold=4)
    drive = Drive(worlds, 3, 1)
    learner = PpoLearner(net, config, 1.0, False, 0, 4)
    rollout = Collector(drive, config, AdversaryConfig(), SCALE, 0, "cpu").collect(learner, 0.0)
    explorer, rng = Explorer(3, 4), numpy_stream(0, "ppo/exploration")
    explores, held = zip(*((explorer.begin(0.6, rng), explorer.held_W.copy()) for _ in range(40)), strict=True)
    explores, held = np.concatenate(explores), np.concatenate(held)
    assert 0.4 < explores.mean() < 0.8
    np.testing.assert_array_equal(rollout.action_N.numpy()[explores], held[explores])
    log_prob_NA = learner.log_probs(rollout.seen_NVF)
    chosen_N = log_prob_NA.gather(1, rollout.action_N[:, None]).squeeze(1)
    torch.testing.assert_close(chosen_N, rollout.log_prob_N, rtol=1e-4, atol=1e-4)


def test_the_distilled_policy_stays_bit_equal_under_attack_and_the_memory_learns(tmp_path):
    trained, fresh = train(tmp_path).state_dict(), with_memory(network()).state_dict()
    same = {name for name, value in trained.items() if torch.equal(value, fresh[name])}
    assert {name for name in fresh if "policies.0" in name} <= same
    assert "memory.out.weight" not in same


@pytest.mark.parametrize("make_worlds", [worlds, None], ids=["fake", "compiled"])
@pytest.mark.parametrize("stop", [1, 14])
def test_resumed_equals_uninterrupted_with_attack_and_memory(tmp_path, monkeypatch, stop, make_worlds):
    whole = train(tmp_path / "whole", make_worlds=make_worlds)
    step, count = PpoLearner._take_step, itertools.count(1)

    def dying(self, batch, rate):
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
    other = train(tmp_path / "other", replace(ATTACKED, adversary=AdversaryConfig()), make_worlds=make_worlds)
    assert weights(other) != weights(whole)


def test_offline_data_holds_no_memory_to_compare_with():
    forgetting = Forgetting(network(), DATA, 3)
    assert forgetting.agreement(network()) == 1
    assert forgetting.agreement(with_memory(network())) is None
    assert Forgetting(with_memory(network()), DATA, 3).agreement(with_memory(network())) is None


def test_bad_settings_are_refused():
    usual = Config()
    learning = replace(usual.adapt, ppo=replace(usual.adapt.ppo, steps=100_000))

    def refused(match, adapt=learning, network=usual.network):
        with pytest.raises(RapidError, match=match):
            validate(replace(usual, adapt=adapt, network=network))

    def attacked(**values):
        return replace(learning, adversary=AdversaryConfig(**values))

    validate(replace(usual, adapt=replace(attacked(gradient_share=0.5, noise_share=0.5), memory=True)))
    refused("gradient_share' is 0.6, but must be at most 1 together", attacked(gradient_share=0.6, noise_share=0.5))
    refused("radius' is 0.0, but must be above 0", attacked(radius=0.0))
    refused("noise' is nan", attacked(noise=float("nan")))
    refused("steps' is 0, but must be at least 1", attacked(steps=0))
    refused("ramp' is 1.5, but must be between 0 and 1", attacked(ramp=1.5))
    refused("adapt.memory' is True, but must be false where adapt.ppo.steps is 0", replace(usual.adapt, memory=True))
    refused("adapt.memory' is True, but must be false where the road", replace(learning, memory=True, mirror=True))
    mlp = replace(usual.network, kind="mlp")
    refused("which has no tokens", replace(learning, memory=True), mlp)
    refused("network.memory' is True, but must be false", network=replace(usual.network, memory=True))
    quiet = replace(usual.adapt, adversary=AdversaryConfig(noise_share=0.2))
    refused("Q-learning is not attacked", quiet)


def test_the_plan_robust_adapts_an_agent_on_disk(tmp_path):
    usual = preset("strong", "tiny", "robust")
    small = replace(usual.adapt.ppo, steps=480, critic_steps=240, num_envs=8, batch_size=60)
    config = replace(
        usual,
        adapt=replace(usual.adapt, ppo=small, evaluate_every=480),
        evaluate=replace(usual.evaluate, curve_spawns=2),
    )
    validate(config)
    assert config.adapt.adversary.gradient_share > 0.5
    distilled = network()
    save_agent(tmp_path / "distilled", distilled, {"scenario": SCENARIO})
    agent = adapt_agent(config, tmp_path / "distilled", None, tmp_path / "out")
    (row, last) = lines(tmp_path / "out" / "ppo")
    assert "policy" not in row
    assert "policy" in last
    assert last["evaluation"]["return"] > 0
    loaded = load_agent(tmp_path / "out" / "agent")
    assert remembers(loaded)
    assert weights(loaded.network) == weights(agent.network)
    # On another road it begins elsewhere, and other lanes are possible.
    wider = replace(config, adapt=replace(config.adapt, scenario="lane-4-density-2.5"))
    elsewhere = adapt_agent(wider, tmp_path / "out" / "agent", None, tmp_path / "wider")
    assert elsewhere.network.lanes == 4
    assert elsewhere.start(1)[0, RIGHTMOST] == 3
    assert elsewhere.network.memory.start_x < agent.network.memory.start_x
    with pytest.raises(RapidError, match=r"knows a road of 4 lanes .* but lane-3-density-2 has 3"):
        check_road(elsewhere, SCENARIO)
    # Who has a memory goes on by PPO, and by nothing that would forget it.
    with pytest.raises(RapidError, match=r"has a memory, and Q-learning keeps none. Set adapt.steps to 0"):
        adapt_agent(preset("strong", "tiny", "bold"), tmp_path / "out" / "agent", None, tmp_path / "on")
    mirrored = replace(
        usual, adapt=replace(usual.adapt, memory=False, steps=0, mirror=True, ppo=replace(small, steps=0))
    )
    with pytest.raises(RapidError, match="left from right"):
        adapt_agent(mirrored, tmp_path / "out" / "agent", None, tmp_path / "mirrored")


def test_the_plan_squeezed_reads_squeezed_features_from_ppo_on_and_may_leave_policy_1_frozen(tmp_path):
    usual = preset("strong", "tiny", "squeezed")
    usual = replace(usual, adapt=replace(usual.adapt, train="adapter"))
    small = replace(usual.adapt.ppo, steps=960, critic_steps=240, num_envs=8, batch_size=60)
    config = replace(usual, adapt=replace(usual.adapt, steps=0, ppo=small, evaluate_every=0))
    validate(config)
    distilled = network()
    save_agent(tmp_path / "distilled", distilled, {"scenario": SCENARIO})
    agent = adapt_agent(config, tmp_path / "distilled", None, tmp_path / "out")
    loaded = load_agent(tmp_path / "out" / "agent")
    assert loaded.network.config.squeeze
    assert weights(loaded.network) == weights(agent.network)
    first, before = loaded.network.head.mixture.policies[0], distilled.head.mixture.policies[0]
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), before.parameters(), strict=True))
    # Who goes on without the setting still reads as it learned to.
    plain = replace(usual.adapt, memory=False, squeeze=False, steps=0, ppo=small, evaluate_every=0)
    on = adapt_agent(replace(usual, adapt=plain), tmp_path / "out" / "agent", None, tmp_path / "on")
    assert on.network.config.squeeze

    def refused(message, **changes):
        with pytest.raises(RapidError, match=message):
            validate(replace(usual, **changes))

    refused("adapt.squeeze' is True, but must be false where", adapt=replace(usual.adapt, memory=False))
    refused("network.squeeze' is True, but must be false", network=replace(usual.network, squeeze=True))


def test_as_many_processes_step_the_worlds_as_threads_are_allowed_and_no_weight_differs(tmp_path, monkeypatch):
    usual = preset("strong", "tiny", "robust")
    small = replace(usual.adapt.ppo, steps=480, critic_steps=240, num_envs=8, batch_size=60)
    save_agent(tmp_path / "distilled", network(), {"scenario": SCENARIO})
    asked: list[int] = []

    def counted(*given, processes=1, **named):
        asked.append(processes)
        return make_vec(*given, processes=processes, **named)

    monkeypatch.setattr("rapid.phases.adapt.make_vec", counted)
    found = []
    for threads in (1, 2):
        config = replace(usual, threads=threads, adapt=replace(usual.adapt, ppo=small, evaluate_every=0))
        found.append(weights(adapt_agent(config, tmp_path / "distilled", None, tmp_path / f"{threads}").network))
    assert asked == [1, 2]
    assert found[0] == found[1]
