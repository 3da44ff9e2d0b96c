"""Compiled worlds under stable-baselines3."""

import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest

sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize  # noqa: E402

import rapid  # noqa: E402
from rapid.errors import RapidError  # noqa: E402

FAST = "highway-fast-v0"
BRIEF = {"duration": 4, "vehicles_count": 8, "ego_spacing": 1}


@pytest.mark.parametrize("name", [FAST, "lane-3-density-2-fast"])
def test_its_own_check_passes(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*image.*")  # that the rows might be meant as a picture
        check_env(rapid.make_env(name, render_mode="rgb_array"), warn=False, skip_render_check=False)


def test_steps_are_those_of_its_own_wrapper_around_single_worlds() -> None:
    """Observations, rewards, dones, terminal observations, cuts and episodes, against DummyVecEnv and Monitor."""
    ours = rapid.make_sb3_vec(FAST, 3, config=BRIEF)
    theirs = DummyVecEnv([lambda: Monitor(rapid.make_env(FAST, config=BRIEF))] * 3)
    ours.seed(7)
    theirs.seed(7)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert (ours.reset() == theirs.reset()).all()
    assert ours.reset_infos == theirs.reset_infos
    generator, ends, cuts = np.random.default_rng(0), 0, 0
    for _ in range(40):
        actions = generator.integers(0, 5, 3)
        seen, rewards, dones, infos = ours.step(actions)
        expected, expected_rewards, expected_dones, expected_infos = theirs.step(actions)
        assert seen.dtype == expected.dtype
        assert rewards.dtype == expected_rewards.dtype
        assert (seen == expected).all()
        assert (rewards == expected_rewards).all()
        assert (dones == expected_dones).all()
        for info, expected_info in zip(infos, expected_infos, strict=True):
            assert set(info) == set(expected_info)
            cuts += info["TimeLimit.truncated"]
            if "episode" in info:
                ends += 1
                assert info["episode"]["l"] == expected_info["episode"]["l"]
                assert info["episode"]["r"] == pytest.approx(expected_info["episode"]["r"], abs=2e-6)
                assert (info["terminal_observation"] == expected_info["terminal_observation"]).all()
            skipped = {"episode", "terminal_observation"}
            assert {k: v for k, v in info.items() if k not in skipped} == {
                k: v for k, v in expected_info.items() if k not in skipped
            }
        assert ours.reset_infos == theirs.reset_infos
    assert 0 < cuts < ends


def test_what_a_time_limit_cut_is_told_apart_from_a_crash() -> None:
    worlds = rapid.make_sb3_vec(FAST, 1, config={"vehicles_count": 0, "duration": 2})
    worlds.reset()
    worlds.step(np.array([1]))
    _, _, dones, infos = worlds.step(np.array([1]))
    assert dones.tolist() == [True]
    assert infos[0]["TimeLimit.truncated"] is True
    assert infos[0]["crashed"] is False


@pytest.mark.parametrize("algorithm", ["DQN", "PPO", "A2C"])
def test_its_algorithms_learn_on_them(algorithm: str) -> None:
    worlds = rapid.make_sb3_vec(FAST, 2, seed=0, config=BRIEF)
    brief: dict[str, Any] = {"n_steps": 16} if algorithm != "DQN" else {"learning_starts": 20, "buffer_size": 1000}
    if algorithm == "PPO":
        brief["batch_size"] = 32
    model = getattr(sb3, algorithm)("MlpPolicy", worlds, seed=0, device="cpu", **brief)
    model.learn(64)
    assert model.num_timesteps >= 64
    assert len(model.ep_info_buffer) > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as that there is no Monitor
        mean, _ = evaluate_policy(model, rapid.make_sb3_vec(FAST, 2, config=BRIEF), n_eval_episodes=3)
    assert 0 < mean < 5


def test_the_registered_id_trains_as_highway_envs_does() -> None:
    model = sb3.DQN(
        "MlpPolicy",
        gymnasium.make("rapid/highway-fast-v0", config=BRIEF),
        learning_starts=20,
        buffer_size=1000,
        device="cpu",
    )
    model.learn(50)
    assert model.num_timesteps >= 50


def test_worlds_can_be_wrapped_asked_pictured_and_pickled() -> None:
    worlds = rapid.make_sb3_vec(FAST, 2, seed=1, config=BRIEF, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that episodes are told already
        VecNormalize(VecMonitor(worlds)).reset()
    assert worlds.env_is_wrapped(Monitor) == [True, True]
    assert worlds.env_is_wrapped(gymnasium.wrappers.TimeLimit) == [False, False]
    assert [vehicle.lane_index[2] for vehicle in worlds.get_attr("vehicle")] == [
        info["lane"] for info in worlds.reset_infos
    ]
    assert worlds.env_method("get_available_actions", indices=1)[0][0] == 1
    assert worlds.env_method("action_masks")[0].shape == (5,)
    assert worlds.has_attr("action_masks")
    assert not worlds.has_attr("nothing_like_it")
    assert worlds.get_attr("config", 0)[0]["duration"] == 4
    picture: Any = worlds.render()
    assert picture.ndim == 3
    other = pickle.loads(pickle.dumps(worlds))
    assert (worlds.step(np.array([3, 3]))[0] == other.step(np.array([3, 3]))[0]).all()
    assert "2 worlds of highway-fast-v0" in repr(worlds)
    worlds.close()


def test_options_configure_all_worlds_and_nothing_else_can_be_set() -> None:
    worlds = rapid.make_sb3_vec(FAST, 2, seed=1)
    worlds.set_options({"config": {"observation": {"vehicles_count": 7}}})
    assert worlds.reset().shape == (2, 7, 5)
    assert worlds.observation_space.shape == (7, 5)
    assert worlds.reset().shape == (2, 7, 5)
    worlds.set_options([{"config": {"duration": 3}}, {}])
    with pytest.raises(RapidError, match="one dict"):
        worlds.reset()
    with pytest.raises(RapidError, match="set_options"):
        worlds.set_attr("speed", 3)


def test_without_it_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rapid.simulator.sb3", None)
    with pytest.raises(RapidError, match="pip install stable-baselines3"):
        rapid.make_sb3_vec(FAST, 1)
