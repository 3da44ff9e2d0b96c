"""Many worlds: the same as single ones, and as highway-env under Gymnasium's own vector environment."""

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from rapid.errors import RapidError
from rapid.scenarios import SCENARIOS, seeing
from rapid.simulator import make_env, make_vec
from rapid.simulator.vector_env import CompiledVectorEnv

FAST = "lane-3-density-2-fast"
BRIEF = {"vehicles_count": 8, "duration": 3, "ego_spacing": 1}


def _assert_equal(ours: Any, theirs: Any, path: str = "") -> None:
    """Compare two infos or observations: the same structure, numbers up to rounding."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs), path
        for key in theirs:
            _assert_equal(ours[key], theirs[key], f"{path}/{key}")
    elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
        for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            _assert_equal(one, other, f"{path}[{i}]")
    elif theirs is None:
        assert ours is None, path
    else:
        assert ours.dtype == theirs.dtype, path
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6, err_msg=path)


@pytest.mark.parametrize("autoreset", [True, False])
def test_it_behaves_as_highway_env_under_gymnasium(autoreset: bool) -> None:
    ours = make_vec(FAST, 3, seed=4, config=BRIEF, autoreset=autoreset)
    theirs = make_vec(FAST, 3, "highway-env", seed=4, config=BRIEF, autoreset=autoreset)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    generator = np.random.default_rng(0)
    for one, other in zip(ours.reset(), theirs.reset(), strict=True):
        _assert_equal(one, other)
    ends = 0
    for _ in range(11):
        actions = generator.integers(0, 5, 3)
        step, expected = ours.step(actions), theirs.step(actions)
        for one, other in zip(step, expected, strict=True):
            _assert_equal(one, other)
        ends += int((step[2] | step[3]).sum())
    assert ends >= 6


def test_each_world_is_a_single_world() -> None:
    vec = CompiledVectorEnv(FAST, 4)
    vec.reset(seed=20)
    singles = [make_env(FAST) for _ in range(4)]
    for i, env in enumerate(singles):
        env.reset(seed=20 + i)
    generator = np.random.default_rng(1)
    for _ in range(40):
        actions = generator.integers(0, 5, 4)
        seen, rewards, terminated, truncated, info = vec.step(actions)
        for i, env in enumerate(singles):
            last, reward, end, cut, last_info = env.step(actions[i])
            assert (rewards[i], terminated[i], truncated[i]) == (reward, end, cut)
            if end or cut:
                assert (info["final_obs"][i] == last).all()
                assert info["final_info"]["distance"][i] == last_info["distance"]
                last, last_info = env.reset()
            assert (seen[i] == last).all()
            assert info["speed"][i] == last_info["speed"]


def test_seeds_may_be_given_one_by_one_and_streams_go_on() -> None:
    vec = CompiledVectorEnv(FAST, 3)
    seen, _ = vec.reset(seed=[7, 2**70, 7])
    assert (seen[0] == seen[2]).all()
    assert (seen[1] == make_env(FAST).reset(seed=2**70)[0]).all()
    following, _ = vec.reset(seed=[None, None, 7])
    assert (following[2] == seen[0]).all()
    assert not (following[0] == seen[0]).all()
    assert not (CompiledVectorEnv(FAST, 2).reset()[0] == CompiledVectorEnv(FAST, 2).reset()[0]).all()
    fresh, _ = CompiledVectorEnv(FAST, 2).reset()
    assert not (fresh[0] == fresh[1]).all()


def test_ended_worlds_stand_still_until_chosen() -> None:
    vec = CompiledVectorEnv(FAST, 2, config=BRIEF | {"vehicles_count": 0}, autoreset=False)
    assert vec.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    vec.reset(seed=0)
    for _ in range(3):
        seen, rewards, terminated, truncated, info = vec.step([1, 1])
    assert truncated.all()
    assert not terminated.any()
    assert (rewards > 0).all()
    again, nothing, _, still, same = vec.step([3, 0])
    assert (again == seen).all()
    assert (nothing == 0).all()
    assert still.all()
    assert (same["distance"] == info["distance"]).all()
    begun, _ = vec.reset(options={"reset_mask": np.array([False, True])})
    assert (begun[0] == seen[0]).all()
    assert not (begun[1] == seen[1]).all()
    _, rewards, _, truncated, _ = vec.step([1, 1])
    assert truncated.tolist() == [True, False]
    assert rewards[0] == 0 < rewards[1]


def test_snapshots_and_forecasts_of_any_world() -> None:
    vec = CompiledVectorEnv(FAST, 3)
    vec.reset(seed=0)
    vec.step([1, 2, 3])
    snap = vec.snapshot(1)
    ahead = vec.forecast([[3, 3, 3], [0, 1, 2], [3, 3, 3]], worlds=[1, 2, 1])
    assert ahead.observations.shape == (3, 3, 15, 5)
    assert (ahead.observations[0] == ahead.observations[2]).all()
    assert all((a == b).all() for a, b in zip(snap, vec.snapshot(1), strict=True))
    vec.restore(0, snap)
    for t in range(3):
        seen, rewards, terminated, *_ = vec.step([3, 3, 1])
        if terminated[:2].any():
            break
        assert (seen[0] == seen[1]).all()
        assert (seen[0] == ahead.observations[0, t]).all()
        assert rewards[0] == ahead.rewards[0, t]


def test_more_rows_are_farther_vehicles() -> None:
    scenario, seeds = "lane-5-density-3", list(range(20))
    near, far = (make_vec(scenario, 20, autoreset=False, config=seeing(count)) for count in (15, 31))
    ours, theirs = near.reset(seed=seeds)[0], far.reset(seed=seeds)[0]
    for _ in range(10):
        assert np.array_equal(ours, theirs[:, :15])
        shown = theirs[..., 0] == 1
        ahead = np.where(shown, np.abs(theirs[..., 1] - theirs[:, :1, 1]), np.inf)
        assert (ahead[:, 15:].min(1) >= ahead[:, 1:15].max(1)).all()
        assert shown[:, 15:].any()
        ours, theirs = (worlds.step(np.ones(20, np.int64))[0] for worlds in (near, far))


def test_what_a_step_returned_does_not_change_afterwards() -> None:
    vec = CompiledVectorEnv(FAST, 2)
    seen, _ = vec.reset(seed=0)
    kept = seen.copy()
    step = vec.step([1, 1])
    copies = [array.copy() for array in step[:4]]
    vec.step([2, 0])
    assert (seen == kept).all()
    assert all((a == b).all() for a, b in zip(step[:4], copies, strict=True))


@pytest.mark.parametrize("actions", [[1], [1, 1, 1], [1.0, 1.0], [[1, 1]], [5, 0], [0, -1], None, [True, False]])
def test_wrong_actions_are_refused_before_anything_moves(actions: Any) -> None:
    vec = CompiledVectorEnv(FAST, 2)
    vec.reset(seed=0)
    before = vec.state.copy()
    with pytest.raises(RapidError, match=r"(?i)action"):
        vec.step(actions)
    assert all((a == b).all() for a, b in zip(before, vec.state, strict=True))


def test_other_mistakes_are_explained() -> None:
    for count in (0, -1, 2.0, True):
        with pytest.raises(RapidError, match="num_envs"):
            make_vec(FAST, count)  # type: ignore[arg-type]
    vec = CompiledVectorEnv(FAST, 2)
    with pytest.raises(RapidError, match="reset"):
        vec.step([1, 1])
    for seed in (-1, [1], [1, -2], [1, "a"]):
        with pytest.raises(RapidError, match=r"[Ss]eeds"):
            vec.reset(seed=seed)  # type: ignore[arg-type]
    for mask in ([True, False, True], [1, 0], np.zeros(2, bool)):
        with pytest.raises(RapidError, match="reset_mask"):
            vec.reset(options={"reset_mask": mask})
    vec.reset(seed=0)
    for call in (lambda: vec.snapshot(2), lambda: vec.forecast([[1]], worlds=[-1])):
        with pytest.raises(RapidError, match="no world"):
            call()


def test_a_world_of_any_listed_scenario_takes_at_most_20_kb() -> None:
    assert max(CompiledVectorEnv(name, 1).state.bytes_per_world for name in SCENARIOS) <= 20 * 1024
