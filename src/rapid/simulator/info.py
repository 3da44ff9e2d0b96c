"""What Gymnasium calls the info of a step: of one world, and of many."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.simulator.observation import (
    INFO_COLLISION,
    INFO_CRASHED,
    INFO_DISTANCE,
    INFO_FAST,
    INFO_LANE,
    INFO_ON_ROAD,
    INFO_RIGHT,
    INFO_SPEED,
)

Mask = NDArray[np.bool_]


def info_of(info: NDArray[np.float64]) -> dict[str, Any]:
    """Return the info dict of one world from its row of INFO_COLUMNS numbers."""
    values = info.tolist()
    return {
        "speed": values[INFO_SPEED],
        "lane": int(values[INFO_LANE]),
        "distance": values[INFO_DISTANCE],
        "crashed": values[INFO_CRASHED] != 0.0,
        "rewards": {
            "collision_reward": values[INFO_COLLISION],
            "right_lane_reward": values[INFO_RIGHT],
            "high_speed_reward": values[INFO_FAST],
            "on_road_reward": values[INFO_ON_ROAD],
        },
    }


def info_of_all(info: NDArray[np.float64], mask: Mask) -> dict[str, Any]:
    """Return the (B, INFO_COLUMNS) numbers as Gymnasium's vector info, valid where `mask` holds and zero elsewhere."""
    columns = np.where(mask[:, None], info, 0.0).T

    def masked(entries: dict[str, Any]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key, value in entries.items():
            result[key] = value
            result["_" + key] = mask.copy()
        return result

    terms = masked(
        {
            "collision_reward": columns[INFO_COLLISION],
            "right_lane_reward": columns[INFO_RIGHT],
            "high_speed_reward": columns[INFO_FAST],
            "on_road_reward": columns[INFO_ON_ROAD],
        }
    )
    return masked(
        {
            "speed": columns[INFO_SPEED],
            "lane": columns[INFO_LANE].astype(np.int64),
            "distance": columns[INFO_DISTANCE],
            "crashed": columns[INFO_CRASHED] != 0.0,
            "rewards": terms,
        }
    )


def acted(actions: NDArray[np.int64], mask: Mask) -> dict[str, Any]:
    """Return the actions (B,) as an entry of that info, if there is one that a world's episode took."""
    return {"action": np.where(mask, actions, 0), "_action": mask} if mask.any() else {}
