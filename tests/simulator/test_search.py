"""Search: plans come true to the last bit, small searches are exhaustive, and the planner beats what never looks."""

from itertools import product

import numpy as np
import pytest

from rapid.agents.open import driver_for, open_agent
from rapid.errors import RapidError
from rapid.scenarios import FASTER, IDLE, NUM_ACTIONS, SLOWER
from rapid.simulator import make_env, make_vec
from rapid.simulator.search import PlannerAgent, plan, unavoidable
from rapid.simulator.state import CRASHED
from rapid.simulator.vector_env import CompiledVectorEnv

DENSE = "lane-3-density-3-fast"
SPARSE = {"vehicles_count": 8, "duration": 8}


def worlds(scenario: str, seeds: list[int], config: dict | None = None, autoreset: bool = False) -> CompiledVectorEnv:
    env = make_vec(scenario, len(seeds), config=config, autoreset=autoreset)
    assert isinstance(env, CompiledVectorEnv)
    env.reset(seed=seeds)
    return env


def drive(env: CompiledVectorEnv, act) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the returns, the lengths and the crashes of one episode in every world."""
    returns, lengths, ended = np.zeros(env.num_envs), np.zeros(env.num_envs, int), np.zeros(env.num_envs, bool)
    while not ended.all():
        _, reward, terminated, truncated, _ = env.step(act())
        returns += reward
        lengths += ~ended
        ended = terminated | truncated
    return returns, lengths, terminated


@pytest.mark.parametrize("scenario", ["lane-4-density-2.5", f"{DENSE}:progress"])
def test_the_planner_gets_the_return_that_it_foresaw(scenario: str) -> None:
    env = worlds(scenario, [3, 4, 5], {"duration": 10})
    made: list[int] = []
    foreseen = plan(env, width=8)
    agent = PlannerAgent(width=8, progress=made.append).bind(env)
    returns, lengths, _ = drive(env, lambda: agent.act(np.zeros((3, 15, 5), np.float32)))
    assert returns.tolist() == foreseen.returns.tolist()
    assert lengths.tolist() == foreseen.lengths.tolist()
    assert sum(made) == 3, "a plan that comes true is made once"


@pytest.mark.parametrize("seed", [0, 7])
def test_a_wide_beam_finds_what_trying_everything_finds(seed: int) -> None:
    env, depth = worlds(DENSE, [seed]), 3
    sequences = np.array(list(product(range(NUM_ACTIONS), repeat=depth)))
    ahead = env.forecast(sequences, worlds=[0] * len(sequences))
    over = ahead.terminated | ahead.truncated
    earning = np.cumsum(over, 1) - over == 0  # up to and with the step that ends the episode
    best = np.where(earning, ahead.rewards, 0.0).sum(1).max()
    found = plan(env, width=NUM_ACTIONS**depth, depth=depth)
    assert found.returns[0] == pytest.approx(best, abs=1e-12)
    assert plan(env, width=2, depth=depth).returns[0] <= best + 1e-12


def test_the_planner_beats_every_constant_action() -> None:
    seeds = list(range(20, 26))
    env = worlds(DENSE, seeds)
    agent = PlannerAgent(width=12).bind(env)
    planned, _, crashed = drive(env, lambda: agent.act(np.zeros(0, np.float32)))
    for action in range(NUM_ACTIONS):
        constant, _, _ = drive(worlds(DENSE, seeds), lambda action=action: np.full(len(seeds), action))
        assert planned.mean() > constant.mean() + 1.0
    assert crashed.mean() < 0.5


def test_plans_do_not_depend_on_the_worlds_beside_them_and_touch_nothing() -> None:
    env = worlds(DENSE, [1, 2, 3], SPARSE)
    before = env.state.copy()
    together, again = plan(env, width=6), plan(env, width=6)
    assert all((a == b).all() for a, b in zip(before, env.state, strict=True))
    assert all((a == b).all() for a, b in zip(together, again, strict=True))
    alone = plan(worlds(DENSE, [3], SPARSE), width=6)
    assert (alone.actions[0] == together.actions[2]).all()
    assert alone.returns[0] == together.returns[2]
    assert (plan(env, [2], width=6).actions[0] == together.actions[2]).all()


def test_it_plans_anew_after_a_deviation_and_after_an_automatic_reset() -> None:
    env = worlds(DENSE, [1, 2], SPARSE, autoreset=True)
    made: list[int] = []
    agent = PlannerAgent(width=4, progress=made.append).bind(env)
    actions = agent.act(np.zeros(0))
    assert len(made) == 2
    env.step([(actions[0] + 1) % NUM_ACTIONS, actions[1]])
    differs = not (env.state.cars[0] == agent._foreseen.cars[0]).all()
    agent.act(np.zeros(0))
    assert differs
    assert len(made) == 3
    for _ in range(8):
        env.step(agent.act(np.zeros(0)))
    assert len(made) >= 5


def test_a_plan_shorter_than_the_episode_is_followed_half_way() -> None:
    env = worlds(DENSE, [1], SPARSE)
    made: list[int] = []
    agent = PlannerAgent(width=4, depth=4, progress=made.append).bind(env)
    _, lengths, _ = drive(env, lambda: agent.act(np.zeros(0)))
    assert lengths[0] == 8
    assert len(made) == 4


def test_of_equal_plans_it_keeps_the_wheel_still() -> None:
    env = worlds("lane-1-density-0.1-fast:progress", [5], {"vehicles_count": 1, "duration": 12})
    actions = plan(env, width=16)
    assert set(actions.actions[0, : actions.lengths[0]].tolist()) <= {IDLE, FASTER, SLOWER}, (
        "one lane: nowhere to change to"
    )


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_unavoidable_agrees_with_trying_everything(depth: int) -> None:
    seeds = list(range(900_000, 900_060))
    config = {"vehicles_density": 4, "ego_spacing": 1}
    found = unavoidable(worlds("lane-5-density-3-fast", seeds, config), depth)
    env = make_env("lane-5-density-3-fast", config=config)
    for world, seed in enumerate(seeds):
        env.reset(seed=seed)
        assert found[world] == (not survives(env, depth)), f"seed {seed}"
    assert 0 < found.sum() < len(seeds)


def survives(env, depth: int) -> bool:
    """Try everything, with snapshots."""
    if depth == 0:
        return True
    here = env.snapshot()
    for action in range(NUM_ACTIONS):
        _, _, crashed, _, _ = env.step(action)
        through = not crashed and survives(env, depth - 1)
        env.restore(here)
        if through:
            return True
    return False


def test_ended_worlds_are_left_alone() -> None:
    env = worlds(DENSE, [1, 2], {"duration": 1})
    env.step([1, 1])
    crashed = env.state.tags[:, CRASHED, 0] != 0
    assert unavoidable(env, 2).tolist() == crashed.tolist()
    assert PlannerAgent(width=2).bind(env).act(np.zeros(0)).tolist() == [IDLE, IDLE]


def test_the_planner_needs_the_compiled_simulator() -> None:
    env = make_vec("lane-3-density-2-fast", 1, simulator="highway-env", autoreset=False)
    with pytest.raises(RapidError, match="needs the compiled simulator"):
        driver_for(open_agent("planner", "lane-3-density-2-fast"), env, 0)
    env.close()


def test_bad_numbers_are_refused() -> None:
    env = worlds(DENSE, [1], SPARSE)
    for options in ({"width": 0}, {"depth": 0}, {"worlds": [1]}):
        with pytest.raises(RapidError):
            plan(env, **options)
    with pytest.raises(RapidError, match="at least 1"):
        unavoidable(env, 0)
    with pytest.raises(RapidError, match="reset"):
        plan(make_vec(DENSE, 1))


def test_the_planner_opens_by_name_and_drives_the_rollouts() -> None:
    from rapid.evaluation.rollouts import run_episodes

    agent = open_agent("planner", "lane-2-density-1-fast")
    agent.width = 2
    episodes = run_episodes(agent, "lane-2-density-1-fast", [1, 2])
    foreseen = plan(worlds("lane-2-density-1-fast", [1, 2]), width=2)
    assert episodes.agent == "planner"
    assert episodes.return_E.tolist() == foreseen.returns.tolist()
    assert episodes.length_E.tolist() == foreseen.lengths.tolist()
