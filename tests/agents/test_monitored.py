"""A monitor between two policies: the calm one is not disturbed, lies are noticed, and clear errors."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rapid import hub
from rapid.agents.monitored import MonitoredAgent, load_monitored, save_monitored
from rapid.agents.onnx import OnnxAgent, driven_observations, export_onnx
from rapid.agents.open import check_road, exportable_agent, network_agent, open_agent
from rapid.agents.saved import CONFIG_FILE, load_agent, moved_on
from rapid.agents.specs import monitored_parts, own_scenario
from rapid.attacks import get_attack
from rapid.attacks.attack import values_of
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.files import sha256
from rapid.monitor import (
    ASIDE,
    ASIDE_SPEED,
    COMING,
    CRUISE,
    FASTER_BY,
    FIRST_ERROR,
    FIRST_SPEEDS,
    OFF_LANE,
    SLOWER_BY,
    SPEED_ERROR,
    STRAIGHT,
    STRAY,
    contradicts,
    own_next,
    own_start,
)
from rapid.networks.memory import STATE_SIZE, initial_state
from rapid.phases.adversary import train
from rapid.road import LANE_WIDTH, SIGHT
from rapid.scenarios import FEATURES, PAPER_SCENARIOS, SLOWER, get_scenario
from rapid.simulator import make_vec
from rapid.spawns import spawn_seeds

SCENARIO = "lane-3-density-2"
CALM, WARY = f"shipped:{SCENARIO}/rapid", f"shipped:{SCENARIO}/squeezed"
SPEC = f"monitored:{CALM},{WARY}"


@pytest.fixture(scope="module")
def driven() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of twelve worlds that a policy drives: what is seen, what the car knows, and what was seen before."""
    agent, met = open_agent(SPEC, SCENARIO), []
    env = make_vec(SCENARIO, 12, autoreset=False)
    obs, _ = env.reset(seed=spawn_seeds("tune", 12))
    state, alive = agent.start(12), np.ones(12, np.bool_)
    for _ in range(30):
        parts = agent.network.parts(torch.from_numpy(state))
        met.append((obs[alive].copy(), parts.own_BS.numpy()[alive], parts.before_BVF.numpy()[alive].copy()))
        action = agent.act(obs, state)
        state = moved_on(agent, obs, state, action)
        obs, _, terminated, truncated, _ = env.step(action)
        alive &= ~(terminated | truncated)
        if not alive.any():
            break
    return met


def doubted(obs: np.ndarray, own: np.ndarray, before: np.ndarray) -> np.ndarray:
    return contradicts(*map(torch.from_numpy, (obs, own, before)), 3).numpy()


@pytest.mark.parametrize("scenario", PAPER_SCENARIOS)
def test_where_nobody_lies_the_calm_policy_drives_alone(scenario: str):
    seeds = spawn_seeds("tune", 10)
    calm, wary = f"shipped:{scenario}/rapid", f"shipped:{scenario}/squeezed"
    both = run_episodes(open_agent(f"monitored:{calm},{wary}", scenario), scenario, seeds)
    alone = run_episodes(open_agent(calm, scenario), scenario, seeds)
    assert [row.episode_return for row in both.rows()] == [row.episode_return for row in alone.rows()]


def test_under_noise_the_wary_policy_drives_from_the_first_decision():
    """The noise moves the ego's own speed, which the car knows, so that every episode is the wary policy's own."""
    seeds = spawn_seeds("tune", 12)
    both = run_episodes(open_agent(SPEC, SCENARIO), SCENARIO, seeds, get_attack("uniform"))
    alone = run_episodes(open_agent(WARY, SCENARIO), SCENARIO, seeds, get_attack("uniform"))
    same = [a.episode_return == b.episode_return for a, b in zip(both.rows(), alone.rows(), strict=True)]
    assert np.mean(same) > 0.8


@pytest.mark.parametrize(("feature", "moved"), [(1, 40.0), (1, -40.0), (3, 0.5), (3, -0.5), (4, 10.0)])
def test_a_lie_about_the_ego_is_noticed_at_once(driven: list, feature: int, moved: float):
    for obs, own, before in driven:
        seen = obs.copy()
        seen[:, 0, feature] += moved
        still = (own[:, 2] < 1) if feature == 3 else np.zeros(len(obs), np.bool_)  # at rest, -0.5 m/s is as fast as 0.5
        assert (doubted(seen, own, before) | still).all()


def test_a_hundredth_of_the_paper_s_attack_is_noticed(driven: list):
    """An attack moves every number that it may by all of its size: at 0.001, the ego's speed by 0.08 m/s."""
    obs, own, before = driven[3]
    seen = obs.copy()
    seen[:, 0, 3] += 0.001 * 80
    assert SPEED_ERROR < 0.001 * 80
    assert doubted(seen, own, before).all()


def impossible(now: np.ndarray, before: np.ndarray) -> bool:
    """What the monitor asks of the other cars of one world, car by car."""

    def edge(rows: np.ndarray) -> float:
        others = rows[1:]
        full = (others[:, 0] > 0.5).all()
        return float(np.abs(others[:, 1] - rows[0, 1]).max() if full else SIGHT) - COMING

    def off_lane(car: np.ndarray) -> float:
        return float(np.abs(car[2] - LANE_WIDTH * np.arange(-9, 20)).min())

    def may_be(car: np.ndarray, earlier: np.ndarray) -> bool:
        faster = car[3] - earlier[3]
        way = car[1] - earlier[1]
        slow, fast = sorted((car[3], earlier[3]))
        driven = slow - STRAY <= way <= fast + STRAY
        return driven and -SLOWER_BY <= faster <= FASTER_BY and abs(car[2] - earlier[2]) <= ASIDE

    here, there = ([car for car in rows[1:] if car[0] > 0.5] for rows in (now, before))
    for car in here:
        if abs(car[4]) > ASIDE_SPEED or (car[3] > CRUISE and abs(car[4]) < STRAIGHT and off_lane(car) > OFF_LANE):
            return True
    if before[0, 0] < 0.5:
        least, most = FIRST_SPEEDS[0] - FIRST_ERROR, FIRST_SPEEDS[1] + FIRST_ERROR
        return any(not least <= car[3] <= most or max(abs(car[4]), off_lane(car)) > FIRST_ERROR for car in here)
    for car in here:
        in_view = abs(car[1] - car[3] - before[0, 1]) < edge(before)
        if in_view and not any(may_be(car, earlier) for earlier in there):
            return True
    for earlier in there:
        in_view = abs(earlier[1] + earlier[3] - now[0, 1]) < edge(now)
        if in_view and not any(may_be(car, earlier) for car in here):
            return True
    return False


@settings(max_examples=60, deadline=None)
@given(moment=st.integers(0, 29), seed=st.integers(0, 2**32 - 1), size=st.floats(0, 0.1), share=st.floats(0, 1))
def test_the_cars_are_judged_as_one_by_one(driven: list, moment: int, seed: int, size: float, share: float):
    obs, own, before = driven[min(moment, len(driven) - 1)]
    rng = np.random.default_rng(seed)

    def wrong(true: np.ndarray) -> np.ndarray:
        moved = rng.uniform(-size, size, true.shape).astype(np.float32) * np.array([0, 200, 12, 80, 80], np.float32)
        moved *= (true[..., :1] > 0.5) & (rng.random(true.shape[:2])[..., None] < share)
        moved[:, 0] = 0
        return true + moved

    seen, remembered = wrong(obs), wrong(before)
    expected = [impossible(*both) for both in zip(seen, remembered, strict=True)]
    assert doubted(seen, own, remembered).tolist() == expected


def with_one_car(rows: np.ndarray, ahead: float, **changes: float) -> np.ndarray:
    """The ego and one car `ahead` m of it in the middle of a lane, 22 m/s, but for the changes; nobody else."""
    rows = np.where(np.arange(15)[:, None] < 1, rows, 0).astype(np.float32)
    rows[:, 1] = np.stack([np.array([1, x + ahead, 4, 22, 0]) for x in rows[:, 0, 1]])
    for feature, value in changes.items():
        rows[:, 1, FEATURES.index(feature)] = value
    return rows


@pytest.mark.parametrize(
    ("moved", "changes", "strange"),
    [
        (0, {}, False),
        (STRAY - 0.5, {}, False),
        (STRAY + 0.5, {}, True),
        (-STRAY - 0.5, {}, True),
        # It brakes by 6 m/s, and comes 3 m less far; or is said to brake, and has come as far as it could not.
        (-3, {"vx": 16}, False),
        (STRAY + 0.5, {"vx": 16}, True),
        (0, {"vx": 22 + FASTER_BY + 1}, True),
        (0, {"vx": -1}, True),
        (0, {"y": 5.5, "vy": 1}, False),
        (0, {"y": 5.5}, True),
        (0, {"y": 10, "vy": 1}, True),
        (0, {"vy": ASIDE_SPEED + 1}, True),
    ],
)
def test_one_car_that_does_what_none_can_is_noticed(driven: list, moved: float, changes: dict, strange: bool):
    obs, own, before = driven[5]
    remembered = with_one_car(before, 60)
    way = before[:, 0, 1] + 60 + 22 + moved - obs[:, 0, 1]
    seen = np.concatenate([with_one_car(obs[w : w + 1], ahead, **changes) for w, ahead in enumerate(way)])
    assert (doubted(seen, own, remembered) == strange).all()


@pytest.mark.parametrize(
    ("changes", "strange"), [({}, False), ({"y": 4.5}, True), ({"vy": 0.5}, True), ({"vx": 25}, True)]
)
def test_where_an_episode_begins_cars_drive_straight_on_in_their_lanes(driven: list, changes: dict, strange: bool):
    obs, own, before = driven[0]
    assert not before.any()
    assert (doubted(with_one_car(obs, 50, **changes), own, before) == strange).all()


def test_a_car_that_vanishes_or_appears_in_full_view_is_noticed_and_one_at_the_edge_is_not(driven: list):
    obs, own, before = driven[5]
    alone = [np.where(np.arange(15)[:, None] < 1, rows, 0) for rows in (obs, before)]
    for ahead, strange in ((50, True), (5 - SIGHT, False), (SIGHT - 5, False)):
        assert (doubted(with_one_car(obs, ahead), own, alone[1]) == strange).all()
        assert (doubted(alone[0], own, with_one_car(before, ahead)) == strange).all()


@pytest.mark.parametrize("driver", ["robust", "monitored"])
@pytest.mark.parametrize("scenario", PAPER_SCENARIOS)
def test_no_traffic_that_the_simulator_has_is_taken_for_a_lie(scenario: str, driver: str):
    """Where roads are crowded from the start, cars brake as hard as they can and crash into each other."""
    agent, lanes, worlds = open_agent(f"shipped:{scenario}/{driver}", scenario), get_scenario(scenario).lanes, 100
    env = make_vec(scenario, worlds, autoreset=False)
    obs, _ = env.reset(seed=spawn_seeds("tune", worlds))
    state, own = agent.start(worlds) if agent.has_memory else None, own_start(worlds, 15, lanes)
    before, alive = np.zeros_like(obs), np.ones(worlds, np.bool_)
    for _ in range(30):
        memory = own[:, 1 : 1 + STATE_SIZE]
        lies = contradicts(*map(torch.from_numpy, (obs, memory, before)), lanes).numpy()
        assert not (lies & alive).any()
        action = agent.act(obs, state) if agent.has_memory else agent.act(obs)
        before, own = obs.copy(), own_next(own, action, lanes)
        state = moved_on(agent, obs, state, action) if agent.has_memory else None
        obs, _, terminated, truncated, _ = env.step(action)
        alive &= ~(terminated | truncated)


def test_lies_about_the_others_alone_are_noticed_at_once():
    agent, worlds = open_agent(SPEC, SCENARIO), 20
    attack = get_attack("uniform:ego=trusted,radius=0.02", 3)
    obs, _ = make_vec(SCENARIO, worlds, autoreset=False).reset(seed=spawn_seeds("tune", worlds))
    seen = attack(None, torch.from_numpy(obs), torch.Generator().manual_seed(0)).numpy()
    np.testing.assert_array_equal(seen[:, 0], obs[:, 0])
    assert agent.doubts(seen, agent.start(worlds)).all()


def test_a_doubt_lasts_until_the_episode_ends_and_rows_go_to_their_policies(driven: list):
    agent = open_agent(SPEC, SCENARIO)
    calm, wary = load_agent(CALM), load_agent(WARY)
    obs, _, _ = driven[0]
    state, memory = agent.start(len(obs)), wary.start(len(obs))
    lied = obs.copy()
    lied[::2, 0, 3] -= 8
    expected = np.where(np.arange(len(obs))[:, None] % 2 == 0, wary.q_values(lied, memory), calm.q_values(lied))
    np.testing.assert_allclose(agent.q_values(lied, state), expected, atol=1e-5)
    action = agent.act(lied, state)
    state, memory = moved_on(agent, lied, state, action), wary.remember(memory, action)
    obs = driven[1][0]
    agreed = agent.doubts(obs, state)
    assert agreed[::2].all()
    np.testing.assert_allclose(agent.q_values(obs, state)[::2], wary.q_values(obs, memory)[::2], atol=1e-5)
    assert not agent.doubts(driven[0][0], agent.start(len(obs))).any()


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("monitored:a,b", ("a", "b")),
        ("monitored:shield:1m,0.5:a,b", ("shield:1m,0.5:a", "b")),
        ("monitored:a,shield:1m,0.5:b", ("a", "shield:1m,0.5:b")),
    ],
)
def test_the_comma_of_a_box_parts_no_agents(spec: str, parts: tuple[str, str]):
    assert monitored_parts(spec) == parts


def test_a_filter_before_it_is_a_filter_before_both_and_knows_its_scenario(driven: list):
    spec = f"shield:0.1:{SPEC}"
    agent = open_agent(spec, SCENARIO)
    assert isinstance(agent, MonitoredAgent)
    assert agent.network.calm.config.shield == agent.network.wary.config.shield == "0.1"
    assert own_scenario([spec]) == SCENARIO
    assert exportable_agent(spec).metadata["scenario"] == SCENARIO


def test_two_without_a_memory_are_exported_too(tmp_path: Path):
    agent = exportable_agent(f"monitored:{CALM},shipped:{SCENARIO}/distilled")
    export_onnx(agent, tmp_path / "both.onnx", *driven_observations(agent, SCENARIO, spawn_seeds("tune", 2)))
    exported, seeds = OnnxAgent(tmp_path / "both.onnx"), spawn_seeds("tune", 3)
    ours, theirs = (run_episodes(each, SCENARIO, seeds).rows() for each in (agent, exported))
    assert [row.episode_return for row in ours] == pytest.approx([row.episode_return for row in theirs])


def test_policies_may_be_swapped_in_place_and_another_pair_is_another_agent(tmp_path: Path):
    folder = tmp_path / "agent"
    save_monitored(folder, Path(CALM), Path(WARY), {"scenario": SCENARIO})
    first = sha256(folder / CONFIG_FILE)
    save_monitored(folder, folder / "wary", folder / "calm", {"scenario": SCENARIO})
    swapped = load_monitored(folder)
    assert swapped.calm.network.config.squeeze
    assert not swapped.wary.network.config.squeeze
    # What was measured is kept by this hash.
    assert sha256(folder / CONFIG_FILE) != first


def test_an_adversary_can_be_trained_against_it(tmp_path: Path):
    train(SPEC, SCENARIO, "adversary:steps=2", 60, tmp_path / "adversary")
    rows = run_episodes(
        open_agent(SPEC, SCENARIO), SCENARIO, spawn_seeds("tune", 2), get_attack(f"adversary:{tmp_path / 'adversary'}")
    ).rows()
    assert len(rows) == 2


def test_its_memory_is_that_of_the_car():
    agent = open_agent(SPEC, SCENARIO)
    state = agent.start(3)
    np.testing.assert_array_equal(state[:, 1 : 1 + STATE_SIZE], initial_state(3, 3))
    before = state.copy()
    moved = agent.remember(state, np.array([SLOWER] * 3))
    np.testing.assert_array_equal(state, before)  # what is given stays as it is
    np.testing.assert_array_equal(moved[:, -STATE_SIZE:], moved[:, 1 : 1 + STATE_SIZE])


def test_an_attack_differentiates_the_policy_that_drives(driven: list):
    agent = open_agent(SPEC, SCENARIO)
    obs, _, _ = driven[0]
    seen = torch.from_numpy(obs).requires_grad_()
    values = values_of(agent, agent.start(len(obs)))
    assert values is not None
    (gradient,) = torch.autograd.grad(values(seen).max(1).values.sum(), seen)
    own = torch.from_numpy(obs).requires_grad_()
    (expected,) = torch.autograd.grad(load_agent(CALM).network(own).max(1).values.sum(), own)
    torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("attack", ["world:horizon=2,steps=2", "world:horizon=2,steps=2,budget=1", "coupled:steps=2"])
def test_attacks_that_go_by_the_episode_can_be_made_on_it(attack: str):
    rows = run_episodes(open_agent(SPEC, SCENARIO), SCENARIO, spawn_seeds("tune", 2), get_attack(attack)).rows()
    assert len(rows) == 2


def test_it_is_saved_with_both_policies_and_drives_as_before(tmp_path: Path):
    made = {"scenario": SCENARIO, "name": "two of them"}
    save_monitored(tmp_path / "agent", Path(CALM), Path(WARY), made)
    agent = open_agent(str(tmp_path / "agent"), SCENARIO)
    assert isinstance(agent, MonitoredAgent)
    assert agent.name == "two of them"
    assert own_scenario([str(tmp_path / "agent")]) == own_scenario([SPEC]) == SCENARIO
    seeds = spawn_seeds("tune", 4)
    for attack in ("none", "fgsm"):
        ours = run_episodes(agent, SCENARIO, seeds, get_attack(attack)).rows()
        spec = run_episodes(open_agent(SPEC, SCENARIO), SCENARIO, seeds, get_attack(attack)).rows()
        assert [row.episode_return for row in ours] == [row.episode_return for row in spec]


@pytest.mark.parametrize("scenario", PAPER_SCENARIOS)
def test_as_one_onnx_file_it_notices_and_drives_as_before(tmp_path: Path, scenario: str):
    calm, wary = f"shipped:{scenario}/rapid", f"shipped:{scenario}/squeezed"
    agent = exportable_agent(f"monitored:{calm},{wary}")
    parity = export_onnx(agent, tmp_path / "both.onnx", *driven_observations(agent, scenario, spawn_seeds("tune", 4)))
    assert parity.difference < 1e-3
    exported, seeds, lanes = OnnxAgent(tmp_path / "both.onnx"), spawn_seeds("tune", 12), agent.network.lanes
    assert exported.remembered_lanes == agent.remembered_lanes
    np.testing.assert_array_equal(exported.start(2), agent.start(2))
    for attack in ("none", "uniform:radius=0.02", "gaussian"):
        ours = run_episodes(agent, scenario, seeds, get_attack(attack, lanes)).rows()
        theirs = run_episodes(exported, scenario, seeds, get_attack(attack, lanes)).rows()
        np.testing.assert_allclose(
            [row.episode_return for row in ours], [row.episode_return for row in theirs], err_msg=attack
        )


def test_the_state_that_its_onnx_file_returns_is_what_it_remembers(tmp_path: Path, driven: list):
    agent = exportable_agent(SPEC)
    export_onnx(agent, tmp_path / "both.onnx", *driven_observations(agent, SCENARIO, spawn_seeds("tune", 2)))
    exported = OnnxAgent(tmp_path / "both.onnx")
    rng = np.random.default_rng(0)
    obs = driven[0][0]
    state = agent.start(len(obs))
    for step in range(6):
        obs = driven[step][0][: len(state)]
        state = state[: len(obs)]
        # From the fourth step on every third world is lied to, about other cars alone.
        seen = obs.copy()
        seen[::3, 1:, 1] += (step >= 3) * rng.uniform(-40, 40, seen[::3, 1:, 1].shape).astype(np.float32)
        action = agent.act(seen, state)
        (returned,) = exported.session.run(["next_state"], exported.inputs(seen, state))
        np.testing.assert_array_equal(exported.notice(seen, state), agent.notice(seen, state))
        state = moved_on(agent, seen, state, action)
        np.testing.assert_allclose(returned, state, atol=1e-4)
        assert step < 3 or state[::3, 0].all()
        assert not state[1::3, 0].any()


def test_clear_errors_before_anything_is_driven(tmp_path: Path):
    for spec, words in (
        ("monitored:rapid", "does not name two agents"),
        ("monitored:,x", "does not name two agents"),
        (f"monitored:slower,{WARY}", "'slower' has no network"),
    ):
        with pytest.raises(RapidError, match=words):
            open_agent(spec, SCENARIO)
    with pytest.raises(RapidError, match="nothing is certified of the monitor"):
        network_agent(SPEC)
    with pytest.raises(RapidError, match="behind a defence"):
        exportable_agent(f"monitored:smooth:3:{CALM},{WARY}")
    with pytest.raises(RapidError, match="road of 3 lanes"):
        check_road(open_agent(SPEC, SCENARIO), PAPER_SCENARIOS[1])
    with pytest.raises(RapidError, match="road of 3 lanes"):
        open_agent(SPEC, PAPER_SCENARIOS[1])
    with pytest.raises(RapidError, match="dynamics of highway-v0"):
        open_agent(SPEC, f"{SCENARIO}-fast")
    with pytest.raises(RapidError, match="would take for a lie"):
        open_agent(f"smooth:3:{SPEC}", SCENARIO)
    with pytest.raises(RapidError, match="is an adversary"):
        save_monitored(tmp_path / "no", Path(CALM), Path(f"shipped:{SCENARIO}/adversary"), {"scenario": SCENARIO})
    with pytest.raises(RapidError, match="must tell its scenario"):
        save_monitored(tmp_path / "no", Path(CALM), Path(WARY), {})
    agent, obs = open_agent(SPEC, SCENARIO), np.zeros((2, 15, 5), np.float32)
    for state in ((), (np.zeros((2, 6), np.float32),)):
        with pytest.raises(RapidError, match="needs a state of shape"):
            agent.act(obs, *state)
    assert agent.act(obs[:0], agent.start(0)).shape == (0,)
    with pytest.raises(RapidError, match="lane-4"):
        own_scenario([f"monitored:{CALM},shipped:{PAPER_SCENARIOS[1]}/squeezed"])
    folder = tmp_path / "agent"
    save_monitored(folder, Path(CALM), Path(WARY), {"scenario": SCENARIO})
    with pytest.raises(RapidError, match="two policies with a monitor"):
        load_agent(folder)
    with pytest.raises(RapidError, match="one agent at a time"):
        hub._located(folder)
    config = json.loads((folder / CONFIG_FILE).read_text())
    for changes, words in (
        ({"version": 9}, "format version 9"),
        ({"metadata": {}}, "does not tell its scenario"),
        ({"weights_sha256": {}}, "saved with"),
    ):
        (folder / CONFIG_FILE).write_text(json.dumps(config | changes))
        with pytest.raises(RapidError, match=words):
            load_monitored(folder)
