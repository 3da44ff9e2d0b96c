"""Scene, facts and forecast: what follows from an observation, and that nothing in it can break them."""

import dataclasses
import math

import numpy as np
import pytest

from rapid.errors import RapidError
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.teacher.facts import MINIMUM_GAP, check, gather, safest
from rapid.teacher.forecast import NO_CAR
from rapid.teacher.foresight import DEPTH
from rapid.teacher.prompt import digest
from rapid.teacher.scene import read_scenes


def scene_of(obs_BVF, lanes=3):
    return read_scenes(obs_BVF, lanes)[0]


def test_names_do_not_depend_on_the_order_of_rows(crowd):
    generator = np.random.default_rng(0)
    for obs_VF in crowd:
        shuffled_VF = np.concatenate([obs_VF[:1], generator.permutation(obs_VF[1:])])
        assert scene_of(obs_VF[None]) == scene_of(shuffled_VF[None])
        assert digest(gather(scene_of(obs_VF[None]))) == digest(gather(scene_of(shuffled_VF[None])))


def test_where_the_road_begins_does_not_matter(world):
    obs_BVF = world(cars=((30, 1, 20), (-20, 2, 25)))
    moved_BVF = obs_BVF.copy()
    moved_BVF[0, :, 1] += 512
    assert gather(scene_of(obs_BVF)) == gather(scene_of(moved_BVF))


def test_lateral_speed_shows_where_a_car_is_going(world):
    scene = scene_of(world(cars=((30, 0, 22, 4.0), (50, 2, 22, 0.0))))
    assert scene.cars[0].lanes == (0, 1)
    assert scene.lead(1) == scene.cars[0]
    assert scene.cars[1].lanes == (2,)


def test_actions_that_are_possible(world):
    assert scene_of(world(lane=0)).available() == (IDLE, LANE_RIGHT, FASTER, SLOWER)
    assert scene_of(world(lane=2, speed=0)).available() == (LANE_LEFT, IDLE, FASTER)
    assert scene_of(world(lane=1, speed=32)).available() == (LANE_LEFT, IDLE, LANE_RIGHT, SLOWER)
    assert scene_of(world(lane=0), lanes=1).available() == (IDLE, FASTER, SLOWER)


def test_speeds_step_from_the_target_nearest_to_the_current_speed(world):
    scene = scene_of(world(speed=27.2))
    assert [scene.speed_after(action) for action in (SLOWER, IDLE, FASTER)] == [24, 28, 32]


@pytest.mark.parametrize(
    ("action", "needed"),
    [(LANE_LEFT, 5 + 3 * 4), (FASTER, 10 + 5 * 8), (IDLE, 10 + 5 * 4), (SLOWER, 5 + 3 * 1)],
)
def test_closed_form_checks_pass_just_beyond_the_printed_distance(world, action, needed):
    lane = 0 if action == LANE_LEFT else 1
    for beyond in (-0.1, 0.1):
        verdict = check(scene_of(world(cars=((needed + beyond, lane, 20),))), action)
        assert verdict.safe == (beyond > 0)
        assert (verdict.car is None) == verdict.safe


def test_closed_form_checks_look_back_when_changing_lane_only(world):
    scene = scene_of(world(cars=((-10, 0, 30), (-6, 1, 30))))
    assert not check(scene, LANE_LEFT).safe
    assert check(scene, IDLE).safe


def test_a_faster_car_just_ahead_is_not_safe(world):
    scene = scene_of(world(cars=((5 + MINIMUM_GAP / 2, 0, 32), (5 + MINIMUM_GAP / 2, 1, 32))))
    for action in (LANE_LEFT, IDLE, FASTER, SLOWER):
        assert not check(scene, action).safe


def test_an_empty_road_is_safe(world):
    facts = gather(scene_of(world()))
    assert all(facts.safe(action) and facts.checks[action].safe for action in facts.available)
    assert all(future.hold_gap == NO_CAR and future.brake_crash == math.inf for future in facts.forecasts)


def test_the_forecast_sees_a_wall_of_standing_cars(world):
    facts = gather(scene_of(world(speed=24, cars=((30, 0, 0), (30, 1, 0), (30, 2, 0)))))
    assert not any(facts.safe(action) for action in facts.available)
    assert facts.forecasts[FASTER].hold_crash <= facts.forecasts[IDLE].hold_crash <= 2


def test_the_forecast_sees_a_car_beside(world):
    facts = gather(scene_of(world(cars=((1, 0, 24),))))
    assert facts.forecasts[LANE_LEFT].brake_gap == 0
    assert facts.safe(LANE_RIGHT)
    assert facts.safe(IDLE)


def test_the_forecast_sees_a_car_moving_in(world):
    staying = gather(scene_of(world(cars=((9, 0, 22, 0.0),))))
    moving = gather(scene_of(world(cars=((9, 0, 22, 5.0),))))
    assert moving.forecasts[FASTER].hold_gap < staying.forecasts[FASTER].hold_gap == NO_CAR


def test_braking_never_leaves_less_room_to_a_slower_car_ahead(world):
    for gap in (15, 25, 40, 60):
        for future in gather(scene_of(world(cars=((gap, 1, 18),)))).forecasts:
            assert future.brake_gap >= future.hold_gap
            assert future.brake_crash >= future.hold_crash


def test_on_an_empty_road_nothing_crashes_and_faster_goes_farther(world):
    ways = gather(scene_of(world(speed=20))).ways
    assert all(way.seconds == DEPTH for way in ways)
    assert ways[FASTER].distance > ways[IDLE].distance > ways[SLOWER].distance
    assert ways[FASTER].value > ways[SLOWER].value


def test_foresight_sees_a_wall_that_braking_does_not_avoid(world):
    facts = gather(scene_of(world(speed=28, cars=((30, 0, 0), (30, 1, 0), (30, 2, 0)))))
    assert not any(facts.survives(action) for action in facts.available)
    assert facts.is_open(safest(facts))


def test_foresight_sees_a_car_beside(world):
    facts = gather(scene_of(world(cars=((1, 0, 24),))))
    assert facts.ways[LANE_LEFT].seconds == 0
    assert facts.survives(LANE_RIGHT)


def test_unseen_traffic_is_feared_where_the_observation_is_full(world):
    cars = tuple((-6.0 - 2.5 * i, i % 3, 20.0) for i in range(14))
    full, one_less = (gather(scene_of(world(speed=28, cars=part))) for part in (cars, cars[1:]))
    assert full.ways[IDLE].value < one_less.ways[IDLE].value


def test_shuffled_facts_are_told_of_other_actions(world):
    facts = gather(scene_of(world(cars=((20, 1, 10),))))
    told = (2, 0, 1, 4, 3)
    shuffled = dataclasses.replace(facts, told=told)
    assert shuffled.ways == tuple(facts.ways[action] for action in told)
    assert shuffled.forecasts == tuple(facts.forecasts[action] for action in told)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(world, value):
    obs_BVF = world(cars=((30, 1, 20),))
    obs_BVF[0, 1, 3] = value
    with pytest.raises(RapidError, match="vx of row 1"):
        read_scenes(obs_BVF, 3)


@pytest.mark.parametrize("shape", [(15, 5), (2, 15, 4), (2, 0, 5)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(RapidError, match="shape"):
        read_scenes(np.zeros(shape, np.float32), 3)


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0, 1e4, 1e20, 3e38])
def test_garbage_never_crashes(crowd, scale):
    noise = np.random.default_rng(1).uniform(-scale, scale, crowd.shape)
    with np.errstate(over="ignore"):
        garbage_BVF = np.clip(crowd + noise, -3.4e38, 3.4e38).astype(np.float32)
    for scene in read_scenes(garbage_BVF, 3):
        facts = gather(scene)
        assert safest(facts) in facts.available
        assert digest(facts).user


def test_a_row_counts_from_presence_one_half(world):
    obs_BVF = world(cars=((30, 1, 20), (60, 1, 20)))
    obs_BVF[0, 1:3, 0] = 0.49, 0.5
    assert [round(car.ahead) for car in scene_of(obs_BVF).cars] == [60]
