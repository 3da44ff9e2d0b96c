import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rapid.agents.saved import QAgent, load_agent, remembers, save_agent
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.conversions import with_memory
from rapid.networks.encoding import feature_scale
from rapid.networks.memory import (
    DISTANCE,
    LEFTMOST,
    RIGHTMOST,
    SPEED,
    SPEED_INDEX,
    STEPS,
    initial_state,
    next_state,
)
from rapid.networks.q_network import build_network
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.simulator import make_vec

LANES = 3


def worlds(count, **options):
    return make_vec(f"lane-{LANES}-density-1", count, autoreset=False, **options)


def used(network):
    """The network with a memory that says something, and an adapter that is heard."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        network.memory.out.weight.normal_(0, 0.3, generator=generator)
        if network.gate is not None and network.gate.numel():
            network.gate.fill_(0.5)
    return network


@pytest.fixture(scope="module")
def observations():
    env = worlds(8)
    return torch.from_numpy(np.array(env.reset(seed=list(range(8)))[0]))


def test_the_first_steps_are_those_counted_by_hand():
    state = initial_state(1, LANES)
    assert state.tolist() == [[0, 6, 25, 0, 2, 0]]
    state = next_state(state, np.array([SLOWER]), LANES)
    # 25 m/s is nearest to 24: one less is 20, and (8/9)^15 of the 5 m/s too much are left after a second.
    lag = (8 / 9) ** 15
    assert state[0, [STEPS, SPEED_INDEX]].tolist() == [1, 5]
    assert state[0, SPEED] == pytest.approx(20 + 5 * lag, rel=1e-6)
    assert state[0, DISTANCE] == pytest.approx(20 + sum(5 * (8 / 9) ** k / 15 for k in range(15)), rel=1e-6)
    for action, lanes in ((LANE_LEFT, [0, 1]), (LANE_LEFT, [0, 0]), (IDLE, [0, 0]), (LANE_RIGHT, [1, 1])):
        state = next_state(state, np.array([action]), LANES)
        assert state[0, [LEFTMOST, RIGHTMOST]].tolist() == lanes
    assert state[0, SPEED_INDEX] == 5


@settings(max_examples=15, deadline=None)
@given(st.lists(st.sampled_from([IDLE, FASTER, SLOWER, FASTER, SLOWER]), min_size=1, max_size=29), st.integers(0, 99))
def test_on_its_lane_it_is_what_the_simulator_does(actions, seed):
    env = worlds(6)
    obs, _ = env.reset(seed=list(range(seed, seed + 6)))
    begin_W, state, running_W = obs[:, 0, 1].copy(), initial_state(6, LANES), np.ones(6, bool)
    for action in actions:
        chosen = np.full(6, action)
        obs, _, terminated_W, truncated_W, _ = env.step(chosen)
        state = next_state(state, chosen, LANES)
        running_W &= ~(terminated_W | truncated_W)
        np.testing.assert_allclose(state[running_W, SPEED], obs[running_W, 0, 3], atol=1e-3)
        np.testing.assert_allclose(state[running_W, DISTANCE], (obs[:, 0, 1] - begin_W)[running_W], atol=2e-2)


def test_whatever_it_does_its_lane_is_among_those_possible_and_its_speed_known():
    env, rng = worlds(64), np.random.default_rng(0)
    obs, _ = env.reset(seed=list(range(64)))
    state, running_W = initial_state(64, LANES), np.ones(64, bool)
    for _ in range(29):
        # It never stands: lanes are changed while it rolls.
        chosen = rng.choice([LANE_LEFT, IDLE, LANE_RIGHT, FASTER], 64)
        obs, _, terminated_W, truncated_W, _ = env.step(chosen)
        state = next_state(state, chosen, LANES)
        running_W &= ~(terminated_W | truncated_W)
        lane_W = obs[:, 0, 2] / 4
        assert (lane_W >= state[:, LEFTMOST] - 1)[running_W].all()
        assert (lane_W <= state[:, RIGHTMOST] + 1)[running_W].all()
        speed_W = np.hypot(obs[:, 0, 3], obs[:, 0, 4])
        np.testing.assert_allclose(state[running_W, SPEED], speed_W[running_W], atol=1e-3)
    # By now it has touched both edges of the road or nearly so.
    assert (state[:, RIGHTMOST] - state[:, LEFTMOST]).mean() < 0.5


@pytest.mark.parametrize("kind", ["rapid", "attentive"])
def test_until_it_has_learned_it_changes_no_bit(observations, kind):
    network = build_network(NetworkConfig(kind=kind), LANES, 3)
    if kind == "rapid":
        with torch.no_grad():
            network.gate.fill_(0.3)
    remembering, env, rng = with_memory(network), worlds(8), np.random.default_rng(0)
    obs, state = env.reset(seed=list(range(8)))[0], initial_state(8, LANES)
    running_W = np.ones(8, bool)
    for _ in range(29):
        seen, remembered = torch.from_numpy(np.array(obs)), torch.from_numpy(state)
        assert torch.equal(remembering(seen, remembered)[running_W], network(seen)[running_W])
        chosen = rng.integers(5, size=8)
        obs, _, terminated_W, truncated_W, _ = env.step(chosen)
        state = next_state(state, chosen, LANES)
        running_W &= ~(terminated_W | truncated_W)
    assert running_W.sum() >= 1
    assert with_memory(remembering) is remembering
    state = torch.from_numpy(initial_state(8, LANES))
    before = network(observations)
    changed = used(remembering)(observations, state)
    assert not torch.equal(changed, before)
    later = state.clone()
    later[:, STEPS] += 9
    assert not torch.equal(remembering(observations, later), changed)


def test_no_attack_moves_what_it_knows_but_for_how_the_ego_looks(observations):
    memory = used(with_memory(build_network(NetworkConfig(), LANES, 3))).memory
    state = torch.from_numpy(initial_state(8, LANES))
    noise = torch.rand(observations.shape, generator=torch.Generator().manual_seed(1)) * 2 - 1
    attacked = observations + noise * feature_scale(LANES) * 0.1
    true, seen = memory.knowledge(observations, state), memory.knowledge(attacked, state)
    # Presence too is moved here, by less than half.
    assert torch.equal(true[:, :-2], seen[:, :-2])
    assert not torch.equal(true[:, -2:], seen[:, -2:])
    assert (true[:, -2:].abs() < 0.5).all()


def test_an_attack_on_the_ego_is_bounded_by_what_is_known_of_it(observations):
    memory = with_memory(build_network(NetworkConfig(), LANES, 3)).memory
    state = torch.from_numpy(initial_state(8, LANES))
    assert torch.equal(memory.believed(observations, state), observations)
    attacked = observations + torch.tensor([0.4, 20, 1.2, 8, 8])
    believed = memory.believed(attacked, state)
    assert torch.equal(believed[:, 1:], attacked[:, 1:])
    assert torch.equal(believed[:, 0, [0, 2]], attacked[:, 0, [0, 2]])
    # Of 20 m no more than its start is uncertain by, of 8 m/s nothing.
    assert ((believed - observations)[:, 0, 1] < 11).all()
    assert ((believed - observations)[:, 0, 3] < 0.02).all()
    # Cars ahead that were moved with the ego seem as near as before, and are by as much farther.
    assert ((believed[:, 1:, 1] - believed[:, :1, 1]) - (observations[:, 1:, 1] - observations[:, :1, 1]) > 9).all()


@pytest.mark.parametrize("lanes", [3, 4])
def test_of_squeezed_features_an_attack_moves_nothing_but_where_along_the_road_the_others_are(lanes):
    env, rng = make_vec(f"lane-{lanes}-density-2", 16), np.random.default_rng(0)
    obs, state = env.reset(seed=list(range(16)))[0], initial_state(16, lanes)
    network = used(with_memory(build_network(NetworkConfig(), lanes, 3), squeeze=True))
    scale = feature_scale(lanes)
    moved = 0
    for _ in range(12):
        true, remembered = torch.from_numpy(np.array(obs)), torch.from_numpy(state)
        centred = (true[..., 2] / 4 - (true[..., 2] / 4).round()).abs() < 0.05
        offsets = torch.from_numpy(rng.uniform(-0.1, 0.1, true.shape).astype(np.float32)) * scale
        offsets[..., 2] *= centred
        # Most of them at the edge, where an attack ends.
        offsets = torch.where(torch.rand(offsets.shape) < 0.8, offsets.sign() * scale * 0.1 * (offsets != 0), offsets)
        seen = true + offsets
        before, after = (network.memory.squeezed(each, remembered) for each in (true, seen))
        assert torch.equal(after[:, 0, 1:], before[:, 0, 1:])
        assert torch.equal(after[:, 1:, 2:], before[:, 1:, 2:])
        assert torch.equal(after[:, 1:, :2], seen[:, 1:, :2])
        assert torch.equal(network.memory.knowledge(seen, remembered), network.memory.knowledge(true, remembered))
        seen[:, 1:, 1] = true[:, 1:, 1]
        seen[..., 0] = true[..., 0]
        assert torch.equal(network(seen, remembered), network(true, remembered))
        moved += int((seen != true).sum())
        # What is read is true of who is in the middle of its lane.
        present = (true[..., 0] > 0.5) & centred
        assert torch.allclose(before[..., 2][present], true[..., 2][present], atol=0.25)
        chosen = rng.integers(5, size=16)
        obs, _, terminated_W, truncated_W, _ = env.step(chosen)
        state = next_state(state, chosen, lanes)
        state[terminated_W | truncated_W] = initial_state(1, lanes)
    assert moved > 1000


def test_squeezed_features_by_hand_and_what_their_gradient_is():
    network = with_memory(build_network(NetworkConfig(vehicles=5), LANES, 3), squeeze=True)
    state = torch.tensor([[2.0, 5, 20.5, 1, 2, 44]])
    rows = [[1.0, 7, 0.4, 3, 3], [1, 250, 2.1, 30, 1], [1, 300, -9, 0, 0], [1, 300, 30, 0, 0], [0.0, 0, 0, 0, 0]]
    obs = torch.tensor([rows], requires_grad=True)
    squeezed = network.memory.squeezed(obs, state)
    start = network.memory.start_x
    expected = [[1.0, start + 44, 4, 20.5, 0], [1, 250, 4, 21, 0], [1, 300, 0, 21, 0], [1, 300, 8, 21, 0], [0.0] * 5]
    assert torch.equal(squeezed[0], torch.tensor(expected))
    (gradient,) = torch.autograd.grad(squeezed.sum(), obs)
    # It passes through the rounding of y, and is none where nothing is read.
    assert gradient[0].tolist() == [[1, 0, 1, 0, 0], *[[1, 1, 1, 0, 0]] * 4]


def test_policy_1_never_hears_it(observations):
    network = used(with_memory(build_network(NetworkConfig(), LANES, 3)))
    state = torch.from_numpy(initial_state(8, LANES))
    features, mask = network.encoding(network.memory.believed(observations, state))
    recalled = network.memory(observations, state)
    first = network.head.mixture.policies[0]
    seen = []
    handle = first.register_forward_hook(lambda _, inputs, out: seen.append((len(inputs) > 2 and inputs[2], out)))
    network(observations, state)
    handle.remove()
    ((recalled_by_first, tokens),) = seen
    assert recalled_by_first is None
    assert torch.equal(tokens, first(features, mask))
    assert not torch.equal(first(features, mask, recalled.token_BD), tokens)


def test_it_is_saved_and_loaded(tmp_path, observations):
    network = used(with_memory(build_network(NetworkConfig(), LANES, 3)))
    squeezing = used(with_memory(network, squeeze=True))
    save_agent(tmp_path / "squeezing", squeezing, {"name": "that"})
    other, first = load_agent(tmp_path / "squeezing"), torch.from_numpy(initial_state(8, LANES))
    moved = observations + torch.tensor([0, 0, 1.0, 5, 5])
    with torch.no_grad():
        expected = squeezing(moved, first)
        assert torch.equal(other.network(moved, first), expected)
        assert not torch.equal(network(moved, first), expected)
    save_agent(tmp_path, network, {"name": "it"})
    agent = load_agent(tmp_path)
    assert remembers(agent)
    assert not remembers(QAgent(build_network(NetworkConfig(), LANES, 3)))
    state = agent.start(8)
    with torch.no_grad():
        expected = network(observations, torch.from_numpy(state)).numpy()
    np.testing.assert_array_equal(agent.q_values(observations.numpy(), state), expected)
    assert agent.remember(state, np.full(8, SLOWER))[0, SPEED_INDEX] == 5
    explained = agent.explain(observations.numpy(), state)
    np.testing.assert_array_equal(explained.q_BA.numpy(), expected)


def test_what_does_not_fit_is_refused(observations):
    network = build_network(NetworkConfig(), LANES, 3)
    with pytest.raises(RapidError, match="needs its state beside the observations"):
        with_memory(network)(observations)
    with pytest.raises(RapidError, match="takes none"):
        network(observations, torch.from_numpy(initial_state(8, LANES)))
    with pytest.raises(RapidError, match="no tokens that a memory could speak to"):
        with_memory(build_network(NetworkConfig(kind="mlp"), LANES, 3))
    with pytest.raises(RapidError, match="Set memory as well, or unset squeeze"):
        build_network(NetworkConfig(squeeze=True), LANES, 3)
    with pytest.raises(RapidError, match="left from right, the mirror does not"):
        build_network(NetworkConfig(memory=True, mirror=True), LANES, 3)
