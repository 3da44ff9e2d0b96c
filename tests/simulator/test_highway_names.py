"""What scripts written for HighwayEnv use, held against highway-env itself."""

import copy
import multiprocessing
import pickle
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

import rapid
from rapid.errors import RapidError
from rapid.scenarios import HIGHWAY_ENV_IDS, get_scenario
from rapid.simulator import make_env, make_vec, time_limits
from rapid.simulator.env import CompiledHighwayEnv
from rapid.simulator.time_limits import compare_time_limits
from rapid.simulator.verify import Case, Verification, compare

FAST = "lane-3-density-2-fast"
ACTIONS = [3, 0, 2, 1, 4, 2, 3, 3, 0, 3, 1, 2]


def _original(name: str, **options: Any) -> Any:
    import highway_env  # noqa: F401

    return gymnasium.make(name, disable_env_checker=True, **options).unwrapped


@pytest.mark.parametrize("name", HIGHWAY_ENV_IDS)
def test_an_id_is_highway_envs_task_with_its_own_defaults(name: str) -> None:
    ours, theirs = make_env(name), _original(name)
    assert ours.config == theirs.config
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    seen, _ = ours.reset(seed=5)
    expected, _ = theirs.reset(seed=5)
    assert seen.shape == (5, 5)
    assert (seen == expected).all()
    for action in ACTIONS[: 4 if "fast" in name else 1]:
        seen, reward, *ends, info = ours.step(action)
        expected, expected_reward, *expected_ends, expected_info = theirs.step(action)
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-6)
        assert reward == pytest.approx(expected_reward, abs=1e-9)
        assert ends == expected_ends
        assert info["action"] == expected_info["action"] == action


@pytest.mark.parametrize("name", HIGHWAY_ENV_IDS)
def test_the_task_of_an_id_is_equal_throughout(name: str) -> None:
    for seed, driver in enumerate(("random", "faster") if "fast" in name else ("random",)):
        found = compare(Case(name, {}, seed, driver, False, 15 if "fast" in name else 2))
        assert found.equal, found.verdict()
        assert not found.mismatches


def test_both_vector_environments_of_an_id_are_the_same() -> None:
    config = {"observation": {"vehicles_count": 6}}
    ours = make_vec("highway-fast-v0", 2, seed=3, config=config)
    theirs = make_vec("highway-fast-v0", 2, "highway-env", seed=3, config=config)
    assert ours.observation_space == theirs.observation_space
    assert (ours.reset()[0] == theirs.reset()[0]).all()


def test_a_run_does_not_take_an_id_for_a_scenario() -> None:
    with pytest.raises(RapidError, match="lane-3-density-1-fast"):
        get_scenario("highway-fast-v0")
    with pytest.raises(RapidError, match="highway-fast-v0"):
        make_env("highway-fast")


@pytest.mark.parametrize(
    "imports", ["import rapid, gymnasium", "import gymnasium, rapid", "import gymnasium; import rapid.simulator"]
)
def test_gymnasium_knows_the_ids_in_whatever_order_both_are_imported(imports: str) -> None:
    code = (
        f"{imports}\n"
        "env = gymnasium.make('rapid/highway-fast-v0', config={'duration': 7})\n"
        "print(env.unwrapped.config['duration'], env.observation_space.shape, env.spec.id)\n"
        "worlds = gymnasium.make_vec('rapid/highway-v0', num_envs=3, config={'lanes_count': 5})\n"
        "print(type(worlds.unwrapped).__name__, worlds.unwrapped.settings.lanes, worlds.num_envs)\n"
        "print(gymnasium.__spec__.loader.__class__.__name__, gymnasium.__loader__.__class__.__name__)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert ran.stdout.splitlines() == [
        "7 (5, 5) rapid/highway-fast-v0",
        "CompiledVectorEnv 5 3",
        "SourceFileLoader SourceFileLoader",
    ], ran.stderr


def test_importing_rapid_imports_neither_gymnasium_nor_numpy() -> None:
    code = "import sys, rapid; print({'gymnasium', 'numpy', 'numba', 'torch'} & {*sys.modules})"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert ran.stdout.strip() == "set()", ran.stderr


def test_dir_lists_what_the_package_offers() -> None:
    assert set(rapid.__all__) == {name for name in dir(rapid) if not name.startswith("__")} | {"__version__"}
    assert {"make_env", "make_vec", "make_sb3_vec", "load_agent", "load_dataset"} <= set(dir(rapid))


def _change_item(env: Any, changes: dict[str, Any]) -> dict[str, Any] | None:
    for key, value in changes.items():
        env.unwrapped.config[key] = value
    return None


def _change_by_configure(env: Any, changes: dict[str, Any]) -> dict[str, Any] | None:
    env.unwrapped.configure(changes)
    return None


def _change_by_options(env: Any, changes: dict[str, Any]) -> dict[str, Any] | None:
    return {"config": changes}


WAYS = [_change_item, _change_by_configure, _change_by_options]


@pytest.mark.parametrize("change", WAYS)
@pytest.mark.parametrize("vector", [False, True])
def test_a_changed_configuration_holds_from_the_next_reset_on(change: Any, vector: bool) -> None:
    changes = {
        "lanes_count": 5,
        "vehicles_count": 7,
        "duration": 3,
        "observation": {"type": "Kinematics", "vehicles_count": 9, "features": ["x", "y", "vx"]},
        "action": {"type": "DiscreteMetaAction", "lateral": False},
    }
    env: Any = make_vec(FAST, 2) if vector else make_env(FAST)
    fresh: Any = make_vec(FAST, 2, config=changes) if vector else make_env(FAST, config=changes)
    env.reset(seed=1)
    options = change(env, changes)
    taken = [0, 0] if vector else 0
    assert env.step(taken)[0].shape[-2:] == (15, 5)  # the episode under way is not touched
    seen, _ = env.reset(seed=8, options=options)
    assert seen.tolist() == fresh.reset(seed=8)[0].tolist()
    assert env.observation_space == fresh.observation_space
    assert env.action_space == fresh.action_space
    for _ in range(4):
        ours, theirs = env.step(taken), fresh.step(taken)
        assert pickle.dumps(ours) == pickle.dumps(theirs)
    assert env.reset()[0].tolist() == fresh.reset()[0].tolist()  # and stays so


@pytest.mark.parametrize("change", WAYS)
@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"controlled_vehicles": 2}, "controlled_vehicles"),
        ({"lane_count": 4}, "did you mean 'lanes_count'"),
        ({"observation": {"type": "OccupancyGrid"}}, "observation.type"),
        ({"duration": -1}, "duration"),
    ],
)
def test_what_the_twin_does_not_cover_is_refused_and_nothing_is_lost(
    change: Any, vector: bool, changes: dict[str, Any], named: str
) -> None:
    env: Any = make_vec(FAST, 2) if vector else make_env(FAST)
    env.reset(seed=1)
    with pytest.raises(RapidError, match=named.replace(".", r"\.")) as caught:
        env.reset(seed=2, options=change(env, changes))
    assert named == "duration" or "highway-env" in str(caught.value)
    env.step([1, 1] if vector else 1)  # the episode under way goes on
    if change is _change_item:  # what was assigned stays, until it is mended
        with pytest.raises(RapidError):
            env.reset()
        for key in changes:
            if key in make_env(FAST).config:
                env.config[key] = make_env(FAST).config[key]
            else:
                del env.config[key]
    expected = make_vec(FAST, 2).reset(seed=2)[0] if vector else make_env(FAST).reset(seed=2)[0]
    assert env.reset(seed=2)[0].tolist() == expected.tolist()


def test_configuring_an_environment_changes_nobody_elses() -> None:
    mine = {"observation": {"vehicles_count": 6}}
    one, other = make_env(FAST, config=mine), make_env(FAST, config=mine)
    one.config["observation"]["vehicles_count"] = 9
    assert one.reset(seed=0)[0].shape == (9, 5)
    assert other.reset(seed=0)[0].shape == (6, 5)
    assert mine == {"observation": {"vehicles_count": 6}}


def test_a_configuration_may_hold_arrays() -> None:
    speeds = np.array([10.0, 20.0, 30.0])
    env = make_env(FAST, config={"action": {"target_speeds": speeds}})
    env.reset(seed=0)
    state = env.state
    env.reset(seed=0)
    assert env.state is state  # nothing changed, nothing is built anew
    env.config["action"]["target_speeds"] = speeds + 1
    env.reset(seed=0)
    assert env.settings.target_speeds.tolist() == [11.0, 21.0, 31.0]


def test_some_worlds_cannot_be_configured_alone() -> None:
    worlds = make_vec(FAST, 2, autoreset=False)
    worlds.reset(seed=0)
    worlds.config["lanes_count"] = 5
    with pytest.raises(RapidError, match="Reset all"):
        worlds.reset(options={"reset_mask": np.array([True, False])})
    worlds.reset()
    assert worlds.settings.lanes == 5


@pytest.mark.parametrize("name", ["highway-fast-v0", "highway-v0"])
def test_views_show_what_highway_envs_objects_hold(name: str) -> None:
    ours, theirs = make_env(name), _original(name)
    for seed in (0, 1):
        ours.reset(seed=seed)
        theirs.reset(seed=seed)
        for action in ACTIONS[: 12 if "fast" in name else 2]:
            assert ours.get_available_actions() == theirs.get_available_actions()
            assert ours.action_masks().nonzero()[0].tolist() == sorted(theirs.get_available_actions())
            assert len(ours.road.vehicles) == len(theirs.road.vehicles)
            assert ours.road.vehicles[0] is ours.vehicle is ours.controlled_vehicles[0]
            assert ours.time == theirs.time
            assert ours.vehicle.speed_index == theirs.vehicle.speed_index
            assert (ours.vehicle.target_speeds == theirs.vehicle.target_speeds).all()
            for one, other in zip(ours.road.vehicles, theirs.road.vehicles, strict=True):
                for attribute in ("lane_index", "target_lane_index", "crashed", "LENGTH", "WIDTH", "MAX_SPEED"):
                    assert getattr(one, attribute) == getattr(other, attribute)
                assert bool(one.on_road) == bool(other.on_road)
                for attribute in ("speed", "position", "heading", "velocity", "direction", "target_speed"):
                    ours_now, theirs_now = getattr(one, attribute), getattr(other, attribute)
                    np.testing.assert_allclose(ours_now, theirs_now, rtol=0, atol=1e-9)
            ours.step(action)
            theirs.step(action)
    assert ours.action_type.actions_indexes == theirs.action_type.actions_indexes
    assert ours.action_type.actions == theirs.action_type.actions


@pytest.mark.parametrize("axes", [{"lateral": False}, {"longitudinal": False}])
def test_available_actions_of_fewer_axes_are_highway_envs(axes: dict[str, bool]) -> None:
    config = {"action": {"type": "DiscreteMetaAction", **axes}}
    ours, theirs = make_env("highway-fast-v0", config=config), _original("highway-fast-v0", config=config)
    ours.reset(seed=3)
    theirs.reset(seed=3)
    for action in (2, 2, 0, 0, 0):
        assert ours.get_available_actions() == theirs.get_available_actions()
        ours.step(action)
        theirs.step(action)


def test_views_cannot_be_written_and_say_what_they_show() -> None:
    env = make_env("highway-fast-v0")
    for look in (lambda: env.vehicle, lambda: env.road, env.get_available_actions):
        with pytest.raises(RapidError, match="reset"):
            look()
    env.reset(seed=0)
    place = env.vehicle.position
    place[:] = 0
    assert env.vehicle.position[0] > 0
    with pytest.raises(RapidError, match="can only be read"):
        env.vehicle.speed = 3.0  # type: ignore[misc]
    with pytest.raises(AttributeError, match=r"no 'route'.*highway-env"):
        _ = env.vehicle.route
    with pytest.raises(AttributeError, match="highway-env"):
        _ = env.road.network
    with pytest.raises(AttributeError, match="ego"):
        _ = env.road.vehicles[1].speed_index
    assert not hasattr(env.vehicle, "plan_route_to")
    copied = copy.deepcopy(env.vehicle)  # with a world of its own
    env.step(3)
    assert copied.position[0] < env.vehicle.position[0]


def test_what_is_shown_in_a_notebook_says_what_it_is() -> None:
    env, worlds = make_env(FAST), make_vec("highway-v0", 3)
    assert "lane-3-density-2-fast: 3 lanes, 21 vehicles" in repr(env)
    env.reset(seed=0)
    env.step(1)
    assert "1 s driven" in repr(env)
    assert "the ego" in repr(env.vehicle)
    assert repr(env.road) == "<road with 21 vehicles>"
    assert "3 FASTER" in repr(env.action_type)
    assert "3 worlds of highway-v0" in repr(worlds)


def _drive(env: Any, actions: list[int]) -> bytes:
    return pickle.dumps([env.step(action) for action in actions] + [env.reset()] + [env.step(1)])


def _drive_pickled(pickled: bytes, actions: list[int]) -> bytes:
    return _drive(pickle.loads(pickled), actions)


def _made() -> list[Any]:
    return [
        make_env(FAST),
        gymnasium.make("rapid/highway-fast-v0"),
        make_env("highway-fast-v0", render_mode="rgb_array"),
    ]


@pytest.mark.parametrize("index", range(3))
def test_copies_and_pickles_go_on_as_the_original(index: int) -> None:
    env = _made()[index]
    env.reset(seed=4)
    env.step(3)
    _ = env.unwrapped.vehicle
    copied, pickled = copy.deepcopy(env), pickle.dumps(env)
    expected = _drive(env, ACTIONS)
    assert _drive(copied, ACTIONS) == expected
    assert _drive_pickled(pickled, ACTIONS) == expected
    assert copied.unwrapped.vehicle.speed == env.unwrapped.vehicle.speed
    copied.step(3)
    assert copied.unwrapped.vehicle.position[0] > env.unwrapped.vehicle.position[0]  # no memory is shared


def test_a_spawned_process_repeats_the_same_steps() -> None:
    env = make_env("highway-fast-v0")
    env.reset(seed=4)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(_drive_pickled, (pickle.dumps(env), ACTIONS))
    assert there == _drive(env, ACTIONS)


@pytest.mark.parametrize("processes", [1, 2])
def test_copies_of_many_worlds_go_on_as_the_original(processes: int) -> None:
    worlds = make_vec(FAST, 3, seed=0, processes=processes)
    worlds.reset()
    worlds.step([1, 2, 3])
    copied, pickled = copy.deepcopy(worlds), pickle.loads(pickle.dumps(worlds))
    runs = [pickle.dumps([each.step([3, 3, 3])[:4] for _ in range(35)]) for each in (worlds, copied, pickled)]
    assert runs[0] == runs[1] == runs[2]
    for each in (worlds, copied, pickled):
        each.close()


def test_time_limits_are_highway_envs_at_every_frequency() -> None:
    """Fractions included; `rapid verify-simulator` compares more durations."""
    found = compare_time_limits(durations=(2.0,))
    assert found.differences == []
    assert found.compared == 80


def test_other_time_limits_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    real = time_limits.CompiledHighwayEnv

    def longer(name: str, config: dict[str, Any]) -> CompiledHighwayEnv:
        return real(name, config=config | {"duration": config["duration"] + 0.5})

    monkeypatch.setattr(time_limits, "CompiledHighwayEnv", longer)
    found = compare_time_limits((15,), (3,), (1.0,))
    assert "after decision 3" in found.differences[0]
    findings = Verification(time_limits=found)
    assert not findings.equal
    assert "decision 3" in findings.verdict()


def test_a_world_in_which_nothing_can_move_is_told() -> None:
    with pytest.warns(UserWarning, match="nothing moves"):
        CompiledHighwayEnv("highway-fast-v0", config={"policy_frequency": 10})
