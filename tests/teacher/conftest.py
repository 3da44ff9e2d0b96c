"""Hand-made worlds for the teacher's tests."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

Obs = NDArray[np.float32]


@pytest.fixture
def world() -> Callable[..., Obs]:
    """Build one observation (1 x 15 x 5): the ego at x = 1000, others as (ahead, lane, speed[, drift])."""

    def build(lane: int = 1, speed: float = 24.0, cars: tuple[tuple[float, ...], ...] = ()) -> Obs:
        obs_BVF = np.zeros((1, 15, 5), np.float32)
        obs_BVF[0, 0] = (1, 1000, 4 * lane, speed, 0)
        for row, (ahead, car_lane, car_speed, *drift) in enumerate(cars, 1):
            obs_BVF[0, row] = (1, 1000 + ahead, 4 * car_lane, car_speed, drift[0] if drift else 0)
        return obs_BVF

    return build


@pytest.fixture
def crowd() -> Obs:
    """Return 24 random worlds on three lanes."""
    generator = np.random.default_rng(7)
    obs_BVF = np.ones((24, 15, 5), np.float32)
    obs_BVF[:, :, 1] = 1000 + generator.uniform(-60, 120, (24, 15))
    obs_BVF[:, 0, 1] = 1000
    obs_BVF[:, :, 2] = 4 * generator.integers(0, 3, (24, 15))
    obs_BVF[:, :, 3] = generator.uniform(15, 28, (24, 15))
    obs_BVF[:, :, 4] = 0
    return obs_BVF
