"""One world: Gymnasium's contract, equality with highway-env, snapshots, forecasts, bad input."""

import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rapid.errors import RapidError
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, SLOWER
from rapid.simulator import make_env
from rapid.simulator.env import CompiledHighwayEnv

FAST = "lane-3-density-2-fast"


def _drive(env: CompiledHighwayEnv, actions: list[int]) -> list[Any]:
    return [env.step(action) for action in actions]


def _same(one: Any, other: Any) -> bool:
    return pickle.dumps(one) == pickle.dumps(other)


@pytest.mark.parametrize("config", [None, {"observation": {"normalize": True, "absolute": False}}])
def test_gymnasiums_own_check_passes(config: dict[str, Any] | None) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the unbounded observation space, which is highway-env's
        check_env(CompiledHighwayEnv(FAST, config=config))


def test_it_is_registered() -> None:
    env = gymnasium.make("rapid.simulator:rapid/Highway-v0", scenario="lane-4-density-2.5")
    assert env.unwrapped.scenario.name == "lane-4-density-2.5"  # type: ignore[attr-defined]
    assert gymnasium.make_vec("rapid/Highway-v0", num_envs=3, scenario=FAST).num_envs == 3


@pytest.mark.parametrize("name", [FAST, "lane-4-density-2.5"])
def test_spaces_spawns_and_info_are_highway_envs(name: str) -> None:
    ours, theirs = make_env(name), make_env(name, "highway-env")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for seed in (0, None, 2**40 + 1, None, 2**90):  # None: both streams go on
        seen, info = ours.reset(seed=seed)
        expected, expected_info = theirs.reset(seed=seed)
        assert seen.dtype == expected.dtype
        assert (seen == expected).all()
        assert info == expected_info


def test_an_episode_is_highway_envs() -> None:
    ours, theirs = make_env(FAST), make_env(FAST, "highway-env")
    ours.reset(seed=11)
    theirs.reset(seed=11)
    for action in [IDLE, LANE_LEFT, FASTER, SLOWER, 2, 2, IDLE, IDLE, FASTER, FASTER]:
        seen, reward, terminated, truncated, info = ours.step(action)
        expected, expected_reward, expected_end, expected_cut, expected_info = theirs.step(action)
        np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=1e-6)
        assert reward == pytest.approx(expected_reward, abs=1e-9)
        assert (terminated, truncated) == (expected_end, expected_cut)
        assert {key: info[key] for key in ("lane", "crashed")} == {
            key: expected_info[key] for key in ("lane", "crashed")
        }
        assert info["speed"] == pytest.approx(expected_info["speed"], abs=1e-9)
        assert info["distance"] == pytest.approx(expected_info["distance"], abs=1e-9)
        assert info["rewards"] == pytest.approx(expected_info["rewards"], abs=1e-9)


def test_two_runs_are_bit_identical() -> None:
    runs = []
    for _ in range(2):
        env = CompiledHighwayEnv(FAST)
        env.reset(seed=5)
        runs.append((_drive(env, [0, 1, 2, 3, 4] * 6), env.snapshot()))
    assert _same(*runs)


def test_a_restored_world_goes_on_as_the_original_did() -> None:
    env = CompiledHighwayEnv(FAST)
    env.reset(seed=5)
    _drive(env, [2, 3])
    snap = env.snapshot()
    first = [_drive(env, [0, 1, 3]), env.reset(), _drive(env, [1])]
    env.restore(snap)
    assert _same(first, [_drive(env, [0, 1, 3]), env.reset(), _drive(env, [1])])
    other = CompiledHighwayEnv(FAST)
    other.restore(pickle.loads(pickle.dumps(snap)))
    assert _same(first[0], _drive(other, [0, 1, 3]))


def test_a_forecast_is_what_then_happens_and_touches_nothing() -> None:
    env = CompiledHighwayEnv(FAST)
    env.reset(seed=1)
    before = env.snapshot()
    actions = [3, 3, 0, 1, 3, 3, 3, 2]
    ahead = env.forecast(actions)
    assert _same(before, env.snapshot())
    assert ahead.observations.shape == (8, 15, 5)
    for t, (seen, reward, terminated, truncated, _) in enumerate(_drive(env, actions)):
        assert (ahead.observations[t] == seen).all()
        assert (ahead.rewards[t], ahead.terminated[t], ahead.truncated[t]) == (reward, terminated, truncated)


def test_an_episode_is_cut_when_its_time_is_up() -> None:
    env = CompiledHighwayEnv("lane-3-density-1-fast", config={"duration": 3, "vehicles_count": 0})
    env.reset(seed=0)
    assert [step[2:4] for step in _drive(env, [1, 1, 1])] == [(False, False), (False, False), (False, True)]


def test_a_clock_is_told_in_the_egos_presence_and_nowhere_else() -> None:
    timed, theirs, plain = make_env(f"{FAST}:clock"), make_env(f"{FAST}:clock", "highway-env"), make_env(FAST)
    envs = (timed, theirs, plain)
    seen, expected, without = (env.reset(seed=3)[0] for env in envs)
    for second in range(31):
        assert seen[0, 0] == expected[0, 0] == np.float32(1 + second / 30)
        seen[0, 0] = 1
        assert (seen == without).all()
        if second < 30:
            (seen, *rest), (expected, *_), (without, *others) = (env.step(SLOWER) for env in envs)
            assert _same(rest, others)
    assert rest[2]  # the time is up
    for simulator in ("compiled", "highway-env"):
        config = {"observation": {"features": ["x"], "clock": True}}
        with pytest.raises(RapidError, match=r"observation\.clock"):
            make_env(FAST, simulator, config=config)


@pytest.mark.parametrize("action", [5, -1, 1.0, "1", True, None, [1], np.array([1]), np.float32(1)])
def test_a_wrong_action_is_refused_before_anything_moves(action: Any) -> None:
    env = CompiledHighwayEnv(FAST)
    env.reset(seed=0)
    before = env.snapshot()
    with pytest.raises(RapidError, match=r"(?i)action"):
        env.step(action)
    assert _same(before, env.snapshot())


def test_other_mistakes_are_explained() -> None:
    env = CompiledHighwayEnv(FAST)
    for call in (lambda: env.step(1), env.snapshot, lambda: env.forecast([1])):
        with pytest.raises(RapidError, match="reset"):
            call()
    with pytest.raises(RapidError, match="options"):
        env.reset(options={"configuration": {}})
    env.reset(seed=0)
    with pytest.raises(RapidError, match="vehicles"):
        CompiledHighwayEnv("lane-3-density-2").restore(env.snapshot())
    with pytest.raises(RapidError, match="shape"):
        env.forecast([[1, 2]])
    with pytest.raises(RapidError, match="did you mean 'compiled'"):
        make_env(FAST, "complied")  # type: ignore[arg-type]
