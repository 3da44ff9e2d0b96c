"""Collisions against highway-env's, on vehicles placed at random."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rapid.simulator.dynamics import collide, sort_by_x
from rapid.simulator.reference import copy_world
from rapid.simulator.settings import read_settings
from rapid.simulator.state import CRASHED, PUSH_X, PUSH_Y, PUSHED

vehicle = st.tuples(
    st.floats(100, 125),
    st.floats(0, 8),
    st.sampled_from([0.0, 0.0, 0.1, -0.4, 1.5]) | st.floats(-3, 3),
    st.floats(-5, 40),
)


class _Highway:
    """As much of an environment as ``copy_world`` reads."""

    def __init__(self, vehicles: list[tuple[float, float, float, float]], only_ego: bool) -> None:
        from highway_env.road.road import Road, RoadNetwork
        from highway_env.vehicle.behavior import IDMVehicle
        from highway_env.vehicle.controller import MDPVehicle

        self.road = Road(RoadNetwork.straight_road_network(3))
        for i, (x, y, heading, speed) in enumerate(vehicles):
            kind = IDMVehicle if i else MDPVehicle
            self.road.vehicles.append(kind(self.road, [x, y], heading, speed))
            self.road.vehicles[i].check_collisions = not only_ego or i == 0
        self.vehicle = self.road.vehicles[0]
        self.time = 0.0
        self.np_random = np.random.default_rng(0)


@pytest.mark.parametrize("dynamics", ["v0", "fast"])
@settings(deadline=None, max_examples=60)
@given(vehicles=st.lists(vehicle, min_size=2, max_size=16))
def test_crashes_and_pushes_equal_highway_envs(
    dynamics: str, vehicles: list[tuple[float, float, float, float]]
) -> None:
    highway = _Highway(vehicles, dynamics == "fast")
    ours = copy_world(highway)
    chosen = read_settings({"lanes_count": 3}, "fast" if dynamics == "fast" else "v0")
    sort_by_x(ours.cars, ours.tags)
    collide(ours.cars, ours.tags, chosen)
    for i, one in enumerate(highway.road.vehicles):
        for other in highway.road.vehicles[i + 1 :]:
            one.handle_collisions(other, chosen.dt)
    theirs = copy_world(highway)
    assert (ours.tags[[CRASHED, PUSHED]] == theirs.tags[[CRASHED, PUSHED]]).all()
    np.testing.assert_allclose(ours.cars[[PUSH_X, PUSH_Y]], theirs.cars[[PUSH_X, PUSH_Y]], rtol=0, atol=1e-9)


def test_more_contacts_than_are_kept_are_all_examined() -> None:
    heap = [(100.0 + 0.25 * i, 4.0, 0.0, 20.0) for i in range(20)]  # 190 pairs, most of them touching
    test = test_crashes_and_pushes_equal_highway_envs.hypothesis.inner_test  # type: ignore[attr-defined]
    test("v0", heap)
