"""Named driving scenarios, as data (paper: section 4.1 and the table "Highway Environment Configuration").

A name reads ``lane-N-density-D[-fast][:progress][:clock]``: N lanes, traffic density D, the dynamics of ``highway-v0``
or, with ``-fast``, of ``highway-fast-v0``, one of two rewards, and whether the observation tells the time. This module
imports nothing heavy.
"""

import re
from dataclasses import dataclass
from typing import Any, Literal

from rapid.errors import RapidError, did_you_mean

Dynamics = Literal["v0", "fast"]
Reward = Literal["normalized", "progress"]

ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""The five meta-actions, at their index in the action space of ``DiscreteMetaAction``."""
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)

FEATURES = ("presence", "x", "y", "vx", "vy")
"""The columns of an observation row; a row is a vehicle, the first row is the ego."""
NUM_VEHICLES = 15
"""Rows of an observation, unless an agent wants more."""
MIN_VEHICLES, MAX_VEHICLES = 2, 51
"""Rows that an observation may have; 51 are all vehicles of ``highway-v0``, of ``highway-fast-v0`` 21 are."""
NUM_FEATURES = len(FEATURES)
NUM_ACTIONS = len(ACTIONS)

TARGET_SPEEDS = tuple(4.0 * i for i in range(9))
"""``linspace(0, 32, 9)`` m/s, the speeds that FASTER and SLOWER step through."""

PROGRESS_SPEED, PROGRESS_CRASH = 32, -5.0
"""The reward `progress` of a step is the speed along the road over so many m/s; a crash costs the other."""

PAPER_SCENARIOS = ("lane-3-density-2", "lane-4-density-2.5", "lane-5-density-3")

_NAME = re.compile(r"lane-(\d+)-density-(\d+(?:\.\d+)?)(-fast)?(?::(normalized|progress))?(:clock)?")


@dataclass(frozen=True)
class Scenario:
    """One driving task: the road, the traffic, the physics, the reward and what is seen of it."""

    lanes: int
    density: float
    dynamics: Dynamics = "v0"
    reward: Reward = "normalized"
    clock: bool = False
    """Whether the ego's presence, otherwise always 1, grows to 2 while the episode's time passes. What an episode still
    pays depends on the time left, so without it the observation is not a state; for who sees it, the time limit is an
    end like any other (Pardo et al., 2018, "Time Limits in Reinforcement Learning")."""

    @property
    def name(self) -> str:
        """The name that :func:`get_scenario` reads back."""
        fast = "-fast" if self.dynamics == "fast" else ""
        reward = "" if self.reward == "normalized" else f":{self.reward}"
        return f"lane-{self.lanes}-density-{self.density:g}{fast}{reward}{':clock' if self.clock else ''}"

    @property
    def env_id(self) -> str:
        """The id under which highway-env registers these dynamics."""
        return "highway-fast-v0" if self.dynamics == "fast" else "highway-v0"

    def config(self) -> dict[str, Any]:
        """Return the configuration as highway-env takes it, on top of the defaults of :attr:`env_id`."""
        config: dict[str, Any] = {
            "observation": {
                "type": "Kinematics",
                "features": list(FEATURES),
                "absolute": True,
                "normalize": False,
                "vehicles_count": NUM_VEHICLES,
                "see_behind": True,
            },
            "action": {"type": "DiscreteMetaAction", "target_speeds": list(TARGET_SPEEDS)},
            "lanes_count": self.lanes,
            "vehicles_density": self.density,
            "duration": 30,
            "show_trajectories": True,
        }
        if self.clock:
            config["observation"]["clock"] = True
        if self.reward == "progress":
            # The paper's reward pays a parked car 0.67 a step; here only distance and not crashing count.
            config |= {
                "reward_speed_range": [0, PROGRESS_SPEED],
                "high_speed_reward": 1.0,
                "right_lane_reward": 0.0,
                "collision_reward": PROGRESS_CRASH,
                "normalize_reward": False,
            }
        return config


HIGHWAY_ENV_IDS: dict[str, tuple[int, float, Dynamics]] = {
    "highway-v0": (4, 1.0, "v0"),
    "highway-fast-v0": (3, 1.0, "fast"),
}
"""Lanes, density and dynamics of the environments that highway-env registers."""


@dataclass(frozen=True)
class HighwayEnvTask(Scenario):
    """HighwayEnv's own task, known by its id: its defaults and nothing on top.

    Its observation is HighwayEnv's (five vehicles, relative and normalised), which no agent, teacher or attack of RAPID
    reads; so it is a task for :func:`rapid.make_env` and its like, and no scenario of a run.
    """

    @property
    def name(self) -> str:
        """HighwayEnv's id."""
        return self.env_id

    def config(self) -> dict[str, Any]:
        """Return the keys that :data:`rapid.simulator.settings.DEFAULTS` leaves out, with HighwayEnv's values."""
        return {
            "screen_width": 600,
            "screen_height": 150,
            "centering_position": [0.3, 0.5],
            "scaling": 5.5,
            "show_trajectories": False,
            "render_agent": True,
            "offscreen_rendering": None,
            "real_time_rendering": False,
            "neighbour_vehicles_connected_lanes": False,
            "lane_change_reward": 0,
        }


def get_task(name: str) -> Scenario:
    """Return the scenario called `name`, or HighwayEnv's own task if that is one of its ids.

    Raises:
        RapidError: it is neither.
    """
    if name in HIGHWAY_ENV_IDS:
        return HighwayEnvTask(*HIGHWAY_ENV_IDS[name])
    return get_scenario(name)


def seeing(vehicles: int) -> dict[str, Any]:
    """Return what to override of a scenario's configuration so that an observation has so many rows."""
    return {"observation": {"vehicles_count": vehicles}}


SCENARIOS: tuple[str, ...] = tuple(
    f"lane-{lanes}-density-{density}{fast}{reward}"
    for reward in ("", ":progress")
    for fast in ("", "-fast")
    for lanes in (3, 4, 5)
    for density in ("2", "2.5", "3")
)
"""The scenarios that are listed; any other ``lane-N-density-D`` works by name too."""


def get_scenario(name: str) -> Scenario:
    """Return the scenario called `name`.

    Raises:
        RapidError: the name does not follow the pattern, or asks for a road that cannot exist.
    """
    if name in HIGHWAY_ENV_IDS:
        lanes, density, dynamics = HIGHWAY_ENV_IDS[name]
        raise RapidError(
            f"'{name}' is HighwayEnv's task with HighwayEnv's observation, which RAPID's agents do not read: it is for "
            f"rapid.make_env, make_vec and make_sb3_vec. The same road is '{Scenario(lanes, density, dynamics).name}'."
        )
    match = _NAME.fullmatch(name.strip())
    if match is None:
        raise RapidError(
            f"Unknown scenario '{name}'{did_you_mean(name, SCENARIOS)} Expected lane-N-density-D with an optional "
            f"-fast, :progress and :clock, in this order. Listed scenarios: {', '.join(SCENARIOS[:9])}; each also with "
            "any of the three. Environments are also known by HighwayEnv's ids: "
            f"{', '.join(HIGHWAY_ENV_IDS)}."
        )
    lanes, density = int(match[1]), float(match[2])
    if not 1 <= lanes <= 20:
        raise RapidError(f"Impossible scenario '{name}': a road has 1 to 20 lanes, not {lanes}.")
    if not 0 < density <= 20:
        raise RapidError(f"Impossible scenario '{name}': the density must lie in (0, 20], not {match[2]}.")
    reward: Reward = "progress" if match[4] == "progress" else "normalized"
    return Scenario(lanes, density, "fast" if match[3] else "v0", reward, clock=match[5] is not None)
