"""Planners that know less: plans are the best of all on average, nothing is read that is not known, and it pays."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rapid.agents.open import PLANNERS, kind_of, open_agent
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.scenarios import IDLE, LANE_RIGHT, NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES, SLOWER
from rapid.simulator import make_vec
from rapid.simulator.belief import CarsPlanner, ObservationPlanner, search_belief
from rapid.simulator.drawn import UNSEEN, from_observation, within_reach
from rapid.simulator.search import tries_of
from rapid.simulator.state import EXPONENT, ORDER, RANK, SPEED, TARGET_LANE, TARGET_SPEED, TIMER, X, Y
from rapid.simulator.vector_env import CompiledVectorEnv

SCENARIO = "lane-3-density-2-fast"
SMALL = {"draws": 2, "width": 3, "depth": 4}


def worlds(seeds: list[int], scenario: str = SCENARIO) -> CompiledVectorEnv:
    env = make_vec(scenario, len(seeds), autoreset=False)
    assert isinstance(env, CompiledVectorEnv)
    env.reset(seed=seeds)
    return env


def redraw(env: CompiledVectorEnv, world: int, seed: int) -> None:
    """Give every driver of a world but the ego other wishes."""
    rng, others = np.random.default_rng(seed), env.state.cars.shape[2] - 1
    env.state.cars[world, TIMER, 1:] = rng.random(others)
    env.state.cars[world, EXPONENT, 1:] = rng.uniform(3.5, 4.5, others)
    env.state.cars[world, TARGET_SPEED, 1:] = rng.uniform(21, 24, others)


@pytest.mark.parametrize("seed", [0, 4, 7])
def test_the_value_of_an_action_is_that_of_the_best_of_all_plans_in_the_mean_of_the_worlds(seed: int) -> None:
    env, depth, crash = worlds([seed, seed], "lane-3-density-3-fast"), 3, 20.0
    redraw(env, 1, seed)
    sequences = np.array(list(product(range(NUM_ACTIONS), repeat=depth)))
    worth = np.zeros(len(sequences))
    for world in (0, 1):
        ahead = env.forecast(sequences, worlds=[world] * len(sequences))
        before = np.cumsum(ahead.terminated, 1) - ahead.terminated == 0
        worth += np.where(before, ahead.rewards - crash * ahead.terminated, 0.0).sum(1) / 2
    found = np.empty(NUM_ACTIONS)
    state = env.state.copy()
    endless = env.settings._replace(duration=np.inf)
    width = NUM_ACTIONS**depth
    search_belief(*state[:3], tries_of(env.settings), endless, width, depth, 0.0, crash, found)
    for action in range(NUM_ACTIONS):
        assert found[action] == pytest.approx(worth[sequences[:, 0] == action].max(), abs=1e-9)
    assert all((now == then).all() for now, then in zip(state, env.state, strict=True)), "the worlds stay as they are"


def test_who_knows_the_cars_does_not_know_their_drivers() -> None:
    env = worlds([1, 2, 3])
    agent, unread = CarsPlanner(**SMALL).bind(env), np.zeros(0, np.float32)
    for step in range(4):
        actions = agent.act(unread)
        saved = [env.snapshot(world) for world in range(3)]
        for world in range(3):
            redraw(env, world, 10 * step + world)
        assert agent.act(unread).tolist() == actions.tolist()
        for world in range(3):
            env.restore(world, saved[world])
        env.step(actions)


def test_all_cars_that_can_matter_are_copied_and_ordered() -> None:
    env = worlds([1], "lane-3-density-2")
    cars, tags, _ = within_reach(env.state.cars[0], env.state.tags[0], env.state.world[0], 2)
    ahead = env.state.cars[0, X] - env.state.cars[0, X, 0]
    near = (ahead >= -60) & (ahead <= 200)
    assert NUM_VEHICLES < near.sum() < len(near), "more than an observation shows, and not all"
    assert cars[0, X].tolist() == cars[1, X].tolist() == env.state.cars[0, X, near].tolist()
    assert (np.diff(cars[0, X, tags[0, ORDER]]) >= 0).all()
    assert tags[0, RANK, tags[0, ORDER]].tolist() == list(range(near.sum()))


def test_an_observation_is_reconstructed_as_the_world_is() -> None:
    env = worlds([5], "lane-3-density-2")
    for action in (IDLE, SLOWER, LANE_RIGHT):
        obs_BVF = env.step(np.array([action]))[0]
    rng = np.random.default_rng(0)
    cars, tags, world = from_observation(obs_BVF[0].astype(float), env.settings, 2, rng)
    true = env.state.cars[0]
    nearest = np.argsort(np.abs(true[X] - true[X, 0]), kind="stable")[:NUM_VEHICLES]
    for row, limit in ((Y, 1e-5), (SPEED, 1e-4)):
        np.testing.assert_allclose(cars[:, row, :NUM_VEHICLES], np.tile(true[row, nearest], (2, 1)), atol=limit)
    ahead = cars[:, X] - cars[:, X, :1]
    np.testing.assert_allclose(ahead[0, :NUM_VEHICLES], true[X, nearest] - true[X, 0], atol=1e-3)
    assert tags[0, TARGET_LANE, :NUM_VEHICLES].tolist() == env.state.tags[0, TARGET_LANE, nearest].tolist()
    assert (cars[0, TARGET_SPEED, 0], world[0, 2]) == (true[TARGET_SPEED, 0], env.state.world[0, 2])
    # What there was no room for lies beyond, on lanes, and differs from draw to draw.
    unseen = slice(NUM_VEHICLES, NUM_VEHICLES + UNSEEN)
    assert cars.shape[2] == NUM_VEHICLES + UNSEEN
    assert (ahead[:, unseen] >= np.abs(ahead[:, :NUM_VEHICLES]).max()).all()
    assert set(cars[:, Y, unseen].ravel()) <= {0.0, 4.0, 8.0}
    assert (ahead[0, unseen] != ahead[1, unseen]).any()


@pytest.mark.parametrize("scenario", ["lane-3-density-2", "lane-5-density-3"])
def test_no_car_is_drawn_into_another(scenario: str) -> None:
    env, rng = worlds([7], scenario), np.random.default_rng(0)
    for _ in range(4):
        obs_BVF = env.step(np.array([SLOWER]))[0]
        cars, tags, _ = from_observation(obs_BVF[0].astype(float), env.settings, 20, rng)
        for own_cars, own_tags in zip(cars, tags, strict=True):
            for drawn in range(NUM_VEHICLES, own_cars.shape[1]):
                same_lane = own_tags[TARGET_LANE] == own_tags[TARGET_LANE, drawn]
                same_lane[drawn] = False
                assert (np.abs(own_cars[X, same_lane] - own_cars[X, drawn]) > 9.9).all()


def test_nothing_is_invented_where_everything_is_seen() -> None:
    obs_VF = np.zeros((NUM_VEHICLES, NUM_FEATURES))
    obs_VF[:2] = [1, 100, 4, 25, 0], [1, 150, 4, 20, 0]
    cars, _, _ = from_observation(obs_VF, worlds([0]).settings, 3, np.random.default_rng(0))
    assert cars.shape == (3, 15, 2)


@given(arrays(np.float32, (1, NUM_VEHICLES, NUM_FEATURES), elements=st.floats(-1e6, 1e6, width=32)))
@settings(max_examples=30, deadline=None)
def test_any_finite_observation_leads_to_an_action(obs_BVF: np.ndarray) -> None:
    assert ObservationPlanner(SCENARIO, draws=1, width=2, depth=3).act(obs_BVF)[0] in range(NUM_ACTIONS)


@pytest.mark.parametrize("name", ["planner-cars", "planner-observation"])
def test_an_episode_is_the_same_alone_and_among_others(name: str) -> None:
    def planner():
        return CarsPlanner(**SMALL) if name == "planner-cars" else ObservationPlanner(SCENARIO, **SMALL)

    together = run_episodes(planner(), SCENARIO, [11, 12, 13])
    alone = run_episodes(planner(), SCENARIO, [12])
    assert together.return_E[1] == alone.return_E[0]
    assert together.counts_EA[1].tolist() == alone.counts_EA[0].tolist()


def test_they_drive_farther_than_who_brakes_and_crash_less_than_who_looks_at_nothing() -> None:
    seeds = list(range(20, 26))
    braking, idle = (run_episodes(open_agent(name, SCENARIO), SCENARIO, seeds) for name in ("slower", "idle"))
    for agent in (CarsPlanner(**SMALL), ObservationPlanner(SCENARIO, **SMALL)):
        driven = run_episodes(agent, SCENARIO, seeds)
        assert driven.distance_E.mean() > 2 * braking.distance_E.mean()
        assert driven.crashed_E.sum() < idle.crashed_E.sum()


def test_they_are_planners_by_name() -> None:
    for name in PLANNERS:
        agent = open_agent(name, SCENARIO)
        assert (agent.name, kind_of(agent)) == (name, "planner")


def test_bad_input_is_told() -> None:
    for make in (lambda: CarsPlanner(draws=0), lambda: ObservationPlanner(SCENARIO, depth=0)):
        with pytest.raises(RapidError, match="at least 1"):
            make()
    agent = ObservationPlanner(SCENARIO, **SMALL)
    with pytest.raises(RapidError, match="shape"):
        agent.act(np.zeros((1, 3, 5), np.float32))
    with pytest.raises(RapidError, match="Observation 0 has nan as presence of row 0, which is not finite"):
        agent.act(np.full((1, NUM_VEHICLES, NUM_FEATURES), np.nan, np.float32))
    with pytest.raises(RapidError, match="planner-observation"):
        open_agent("planner-observations", SCENARIO)
