"""Configurations: what is read, what is refused and how."""

import math
from typing import Any

import pytest

from rapid.errors import RapidError
from rapid.scenarios import SCENARIOS, Dynamics, get_scenario
from rapid.simulator.configuration import merge_config
from rapid.simulator.settings import DEFAULTS, WITHOUT_EFFECT, read_settings


@pytest.mark.parametrize("dynamics", ["v0", "fast"])
def test_defaults_are_those_of_the_installed_highway_env(dynamics: Dynamics) -> None:
    from highway_env.envs.highway_env import HighwayEnv, HighwayEnvFast

    theirs = (HighwayEnvFast if dynamics == "fast" else HighwayEnv).default_config()
    assert {key: theirs[key] for key in DEFAULTS[dynamics]} == DEFAULTS[dynamics]
    assert set(theirs) == set(DEFAULTS[dynamics]) | (WITHOUT_EFFECT & set(theirs))
    read_settings(theirs, dynamics)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_listed_scenario_is_covered(name: str) -> None:
    scenario = get_scenario(name)
    settings = read_settings(scenario.config(), scenario.dynamics)
    assert settings.lanes == scenario.lanes
    assert settings.frames == (5 if scenario.dynamics == "fast" else 15)


@pytest.mark.parametrize(
    ("config", "named"),
    [
        ({"lanes_count": 0}, "lanes_count"),
        ({"lanes_count": 2.5}, "lanes_count"),
        ({"lanes_count": True}, "lanes_count"),
        ({"vehicles_density": 0}, "vehicles_density"),
        ({"vehicles_density": -1}, "vehicles_density"),
        ({"vehicles_density": math.nan}, "vehicles_density"),
        ({"vehicles_density": "2"}, "vehicles_density"),
        ({"duration": -1}, "duration"),
        ({"collision_reward": math.inf}, "collision_reward"),
        ({"initial_lane_id": 4}, "initial_lane_id"),
        ({"reward_speed_range": [20, 20]}, "reward_speed_range"),
        ({"reward_speed_range": [20]}, "reward_speed_range"),
        ({"normalize_reward": 1}, "normalize_reward"),
        ({"collision_reward": 0.5}, "normalize_reward"),
        ({"controlled_vehicles": 2}, "controlled_vehicles"),
        ({"other_vehicles_type": "highway_env.vehicle.behavior.AggressiveVehicle"}, "other_vehicles_type"),
        ({"manual_control": True}, "manual_control"),
        ({"vehicle_density": 2}, "did you mean 'vehicles_density'"),
        ({"observation": {"type": "LidarObservation"}}, "observation.type"),
        ({"observation": {"type": "Kinematics", "order": "shuffled"}}, "observation.order"),
        ({"observation": {"type": "Kinematics", "features": ["x", "speed"]}}, "'speed'"),
        ({"observation": {"type": "Kinematics", "features": ["x", "x"]}}, "twice"),
        ({"observation": {"type": "Kinematics", "vehicles_count": 1}}, "observation.vehicles_count"),
        ({"observation": {"type": "Kinematics", "features": ["x"], "clock": True}}, "observation.clock"),
        ({"observation": {"type": "Kinematics", "vehicle_count": 9}}, "observation.vehicle_count"),
        ({"observation": {"type": "Kinematics", "features_range": {"x": [1, 1]}}}, "features_range.x"),
        ({"action": {"type": "ContinuousAction"}}, "action.type"),
        ({"action": {"type": "DiscreteMetaAction", "target_speeds": [20]}}, "target_speeds"),
        ({"action": {"type": "DiscreteMetaAction", "target_speeds": [20, math.nan]}}, "target_speeds"),
        ({"action": {"type": "DiscreteMetaAction", "longitudinal": False, "lateral": False}}, "longitudinal"),
    ],
)
def test_what_is_not_covered_or_makes_no_sense_is_named(config: dict[str, Any], named: str) -> None:
    with pytest.raises(RapidError, match=named.replace("[", r"\[")):
        read_settings(config)


def test_what_only_highway_env_can_do_is_offered_there() -> None:
    with pytest.raises(RapidError, match='simulator="highway-env"'):
        read_settings({"action": {"type": "ContinuousAction"}})


def test_overrides_are_merged_into_parts_unless_they_name_a_type() -> None:
    base = {"observation": {"type": "Kinematics", "vehicles_count": 15}, "duration": 30}
    assert merge_config(base, {"observation": {"absolute": True}}) == {
        "observation": {"type": "Kinematics", "vehicles_count": 15, "absolute": True},
        "duration": 30,
    }
    assert merge_config(base, {"observation": {"type": "Kinematics"}})["observation"] == {"type": "Kinematics"}
    assert merge_config(base, None) == base
