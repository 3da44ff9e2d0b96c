"""The differential check itself, in small; ``rapid verify-simulator`` runs it in full."""

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rapid.errors import RapidError
from rapid.scenarios import FASTER
from rapid.simulator.env import CompiledHighwayEnv
from rapid.simulator.verify import DRIVERS, VARIANTS, Case, Verification, compare, plan_cases, verify


def _assert_equal(found: Verification) -> None:
    assert found.equal, found.verdict()
    assert not found.mismatches


def test_the_fast_variants_are_equal() -> None:
    names = [name for name, config in VARIANTS if "-fast" in name and not config]
    _assert_equal(verify(names, 10, max_steps=15))


def test_the_full_dynamics_are_equal() -> None:
    _assert_equal(verify(["lane-3-density-2", "lane-5-density-3"], 2, max_steps=4))


def test_with_the_c_librarys_functions_states_are_identical_even_after_crashes() -> None:
    found = verify(["lane-5-density-3-fast"], 5, seed=4, plain_math=True)
    _assert_equal(found)
    assert found.crashes > 0
    assert found.steps_identical == found.steps


ranges = st.tuples(st.floats(-10, 20), st.floats(21, 40)).map(list)
features = (
    "presence",
    "x",
    "y",
    "vx",
    "vy",
    "heading",
    "cos_h",
    "sin_h",
    "cos_d",
    "sin_d",
    "long_off",
    "lat_off",
    "ang_off",
)
observations = st.fixed_dictionaries(
    {
        "type": st.just("Kinematics"),
        "vehicles_count": st.integers(2, 20),
        "features": st.lists(st.sampled_from(features), min_size=1, max_size=8, unique=True),
    },
    optional={
        "absolute": st.booleans(),
        "normalize": st.booleans(),
        "clip": st.booleans(),
        "see_behind": st.booleans(),
        "features_range": st.dictionaries(st.sampled_from(features[1:]), ranges, min_size=1, max_size=3),
        "observe_intentions": st.booleans(),
        "include_obstacles": st.booleans(),
    },
)
configs = st.fixed_dictionaries(
    {"vehicles_count": st.integers(0, 14), "observation": observations},
    optional={
        "ego_spacing": st.floats(0, 4),
        "duration": st.integers(1, 5),
        "simulation_frequency": st.integers(2, 16),
        "policy_frequency": st.sampled_from([1, 2, 0.5]),
        "action": st.fixed_dictionaries(
            {
                "type": st.just("DiscreteMetaAction"),
                "target_speeds": st.lists(st.floats(-10, 60), min_size=2, max_size=6).filter(lambda s: s[0] != s[-1]),
            }
        ),
        "collision_reward": st.floats(-5, 0),
        "right_lane_reward": st.floats(0.1, 2),
        "high_speed_reward": st.floats(0, 2),
        "on_road_reward": st.floats(0, 2),
        "reward_speed_range": ranges,
        "normalize_reward": st.booleans(),
        "offroad_terminal": st.booleans(),
    },
)


@settings(max_examples=25, suppress_health_check=list(HealthCheck))
@given(
    lanes=st.integers(1, 6),
    density=st.sampled_from(["0.05", "0.5", "1.5", "3", "6"]),
    fast=st.sampled_from(["", "-fast"]),
    config=configs,
    seed=st.integers(0, 2**32),
    driver=st.sampled_from(DRIVERS),
)
def test_any_configuration_is_equal(
    lanes: int, density: str, fast: str, config: dict[str, Any], seed: int, driver: str
) -> None:
    _assert_equal(compare(Case(f"lane-{lanes}-density-{density}{fast}", config, seed, driver, True, 5)))


def test_a_difference_is_found_counted_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    step = CompiledHighwayEnv.step
    # A simulator that goes faster whatever it is told.
    monkeypatch.setattr(CompiledHighwayEnv, "step", lambda self, action: step(self, FASTER))
    found = verify(["lane-3-density-1-fast"], 1, seed=1, max_steps=3)
    assert not found.equal
    assert "NOT EQUAL" in found.verdict()
    assert "target speed" in found.verdict()


def test_cases_go_round_scenarios_and_drivers() -> None:
    cases = plan_cases(None, 300, seed=9)
    assert [case.seed for case in cases] == list(range(9, 309))
    assert {case.scenario for case in cases} == {name for name, _ in VARIANTS}
    assert {case.driver for case in cases} == set(DRIVERS)
    assert {case.drive_on for case in cases} == {True, False}


def test_mistakes_are_explained() -> None:
    with pytest.raises(RapidError, match="episodes"):
        verify(episodes=0)
    with pytest.raises(RapidError, match="Unknown scenario"):
        verify(["lane-three"], 1)
