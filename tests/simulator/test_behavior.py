"""Neighbours: the quick searches against the plain reading of the rule."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rapid.simulator.behavior import look_ahead, vehicle_ahead, vehicle_behind
from rapid.simulator.dynamics import closest_lane, sort_by_x
from rapid.simulator.settings import read_settings
from rapid.simulator.state import AHEAD, AHEAD_LEFT, AHEAD_RIGHT, CAR_ROWS, LANE, ORDER, RANK, TAG_ROWS, X, Y

LANES = 4
SETTINGS = read_settings({"lanes_count": LANES})

# Few distinct places, so that vehicles are often level, beyond the road, and between lanes.
places = st.lists(
    st.tuples(
        st.sampled_from([-6.0, -5.0, -1.0, 0.0, 10.0, 20.0, 20.5, 30.0, 9999.0, 10004.9, 10005.0]),
        st.sampled_from([-4.0, -1.5, 0.0, 0.9, 1.0, 2.0, 2.9, 3.0, 4.0, 6.0, 8.0, 10.9, 12.0, 15.0, 16.0]),
    ),
    min_size=1,
    max_size=14,
)


def _world(vehicles: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    cars = np.zeros((CAR_ROWS, len(vehicles)))
    tags = np.zeros((TAG_ROWS, len(vehicles)), np.int64)
    cars[X], cars[Y] = np.array(vehicles).T
    tags[ORDER] = tags[RANK] = np.arange(len(vehicles))
    for i in range(len(vehicles)):
        tags[LANE, i] = closest_lane(cars[X, i], cars[Y, i], 0.0, 0, LANES)
    sort_by_x(cars, tags)
    return cars, tags


def _plain(cars: np.ndarray, i: int, lane: int) -> tuple[int, int]:
    """The rule as highway-env writes it: one pass in list order."""
    ahead = behind = -1
    for j in range(cars.shape[1]):
        if j == i or abs(cars[Y, j] - 4.0 * lane) > 3 or not -5 <= cars[X, j] < 10005:
            continue
        if cars[X, i] <= cars[X, j] and (ahead < 0 or cars[X, j] <= cars[X, ahead]):
            ahead = j
        if cars[X, j] < cars[X, i] and (behind < 0 or cars[X, j] > cars[X, behind]):
            behind = j
    return ahead, behind


@given(places)
def test_neighbours_are_those_of_the_plain_rule(vehicles: list[tuple[float, float]]) -> None:
    cars, tags = _world(vehicles)
    look_ahead(cars, tags, SETTINGS)
    for i in range(len(vehicles)):
        for lane in range(LANES):
            assert (vehicle_ahead(cars, tags, i, lane), vehicle_behind(cars, tags, i, lane)) == _plain(cars, i, lane)
        lane = int(tags[LANE, i])
        for row, side in ((AHEAD_LEFT, lane - 1), (AHEAD, lane), (AHEAD_RIGHT, lane + 1)):
            if 0 <= side < LANES:
                assert tags[row, i] == _plain(cars, i, side)[0]


@given(places)
def test_the_order_is_by_x_then_by_list(vehicles: list[tuple[float, float]]) -> None:
    cars, tags = _world(vehicles)
    assert tags[ORDER].tolist() == sorted(range(len(vehicles)), key=lambda i: (cars[X, i], i))
    assert (tags[RANK, tags[ORDER]] == np.arange(len(vehicles))).all()


@given(st.floats(-10, 30), st.floats(-100, 10100), st.floats(-4, 4), st.integers(0, LANES - 1))
def test_the_closest_lane_is_highway_envs(y: float, x: float, heading: float, before: int) -> None:
    from highway_env.road.road import RoadNetwork

    network = RoadNetwork.straight_road_network(LANES)
    expected = network.get_closest_lane_index(np.array([x, y]), heading)[2]
    assert closest_lane(x, y, heading, before, LANES) == expected
