"""From highway-env's configuration dict to the numbers that the kernels read."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError, did_you_mean
from rapid.road import LANE_WIDTH, SIGHT
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER, Dynamics

IDM = "highway_env.vehicle.behavior.IDMVehicle"

DEFAULTS: dict[Dynamics, dict[str, Any]] = {
    "v0": {
        "observation": {"type": "Kinematics"},
        "action": {"type": "DiscreteMetaAction"},
        "simulation_frequency": 15,
        "policy_frequency": 1,
        "other_vehicles_type": IDM,
        "manual_control": False,
        "lanes_count": 4,
        "vehicles_count": 50,
        "controlled_vehicles": 1,
        "initial_lane_id": None,
        "duration": 40,
        "ego_spacing": 2,
        "vehicles_density": 1,
        "collision_reward": -1,
        "right_lane_reward": 0.1,
        "high_speed_reward": 0.4,
        "reward_speed_range": [20, 30],
        "normalize_reward": True,
        "offroad_terminal": False,
    },
}
DEFAULTS["fast"] = DEFAULTS["v0"] | {
    "simulation_frequency": 5,
    "lanes_count": 3,
    "vehicles_count": 20,
    "duration": 30,
    "ego_spacing": 1.5,
}
"""highway-env 1.12.1's defaults for ``highway-v0`` and ``highway-fast-v0``, of the keys that have an effect here."""

WITHOUT_EFFECT = frozenset(
    {
        # drawing
        *("screen_width", "screen_height", "centering_position", "scaling", "show_trajectories", "render_agent"),
        *("offscreen_rendering", "real_time_rendering"),
        # a straight road has no connected lanes, and HighwayEnv never reads the weight of a lane change
        *("neighbour_vehicles_connected_lanes", "lane_change_reward"),
    }
)
"""Keys that do not change what happens on a straight highway."""

FEATURES = (
    *("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "cos_d", "sin_d"),
    *("long_off", "lat_off", "ang_off"),
)
"""The features of a KinematicObservation; their place here is their code in the kernels."""

_OBSERVATION_KEYS = (
    *("type", "features", "vehicles_count", "features_range", "absolute", "order", "normalize", "clip", "see_behind"),
    *("observe_intentions", "include_obstacles"),
    "clock",  # ours: highway-env takes it and does nothing
)
_ACTION_KEYS = ("type", "longitudinal", "lateral", "target_speeds")
_DEFAULT_TARGET_SPEEDS = (20.0, 25.0, 30.0)
_TOP_SPEED = 40.0

USE_REFERENCE = 'Make the environment with simulator="highway-env" to run it as it is.'


class Settings(NamedTuple):
    """One configuration as the kernels read it."""

    lanes: int
    traffic: int
    """Vehicles besides the ego."""
    ego_spacing: float
    traffic_spacing: float
    spacing_factor: float
    """How much closer the vehicles stand because there are several lanes."""
    initial_lane: int
    """The ego's lane at reset, or -1 to draw it."""
    target_speeds: NDArray[np.float64]
    actions: NDArray[np.int64]
    """The meta-action (an index of ``rapid.scenarios.ACTIONS``) behind each action."""
    frames: int
    """Frames per decision."""
    dt: float
    """Seconds per frame."""
    decision_time: float
    """Seconds per decision."""
    duration: float
    all_collide: bool
    """Whether every pair of vehicles is checked, or only pairs with the ego."""
    collision_reward: float
    right_lane_reward: float
    high_speed_reward: float
    on_road_reward: float
    reward_low_speed: float
    reward_high_speed: float
    normalize_reward: bool
    offroad_terminal: bool
    rows: int
    """Vehicles in an observation, the ego included."""
    absolute: bool
    see_behind: bool
    clip: bool
    features: NDArray[np.int64]
    scaled: NDArray[np.bool_]
    """Which features are mapped from [low, high] to [-1, 1]."""
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    clock: int
    """The column to which, in the ego's row, the share of the time that has passed is added; -1 for none."""


def read_settings(config: Mapping[str, Any], dynamics: Dynamics = "v0") -> Settings:
    """Return the numbers behind a configuration of ``highway-v0`` or (``dynamics="fast"``) ``highway-fast-v0``.

    Args:
        config: what highway-env takes as ``config``; missing keys have the defaults of the environment.
        dynamics: which defaults hold, and whether all pairs of vehicles collide ("v0") or only pairs with the ego.

    Raises:
        RapidError: a key or a value that this simulator does not cover, or one that makes no sense. Names it.
    """
    if dynamics not in DEFAULTS:
        raise RapidError(f"Unknown dynamics {dynamics!r}; expected 'v0' or 'fast'.")
    defaults = DEFAULTS[dynamics]
    known = {*defaults, "on_road_reward", *WITHOUT_EFFECT}
    for key in config:
        if key not in known:
            raise RapidError(
                f"The compiled simulator does not know the configuration key {key!r}{did_you_mean(str(key), known)} "
                f"{USE_REFERENCE}"
            )
    full = defaults | dict(config)
    for key, covered in (("controlled_vehicles", 1), ("other_vehicles_type", IDM), ("manual_control", False)):
        if full[key] != covered:
            raise RapidError(
                f"The compiled simulator covers {key}={covered!r} only, not {full[key]!r}. {USE_REFERENCE}"
            )

    lanes = read_integer(full, "lanes_count", 1, 1000)
    initial_lane = -1 if full["initial_lane_id"] is None else read_integer(full, "initial_lane_id", 0, lanes - 1)
    simulation_frequency = _number(full, "simulation_frequency", above=0)
    policy_frequency = _number(full, "policy_frequency", above=0)
    frames = int(simulation_frequency // policy_frequency)
    if frames < 1:
        warnings.warn(
            f"simulation_frequency={simulation_frequency:g} Hz is below policy_frequency={policy_frequency:g} Hz, so "
            "no frame passes between decisions and nothing moves, as in highway-env. Make it at least as high.",
            stacklevel=2,
        )
    low_speed, high_speed = _interval(full["reward_speed_range"], "reward_speed_range")
    weights = {key: _number(full, key) for key in ("collision_reward", "right_lane_reward", "high_speed_reward")}
    normalize = _flag(full, "normalize_reward")
    if normalize and weights["high_speed_reward"] + weights["right_lane_reward"] == weights["collision_reward"]:
        raise RapidError(
            "normalize_reward divides by high_speed_reward + right_lane_reward - collision_reward, which is 0. "
            "Choose other weights or set normalize_reward to False."
        )
    return Settings(
        lanes=lanes,
        traffic=read_integer(full, "vehicles_count", 0, 100_000),
        ego_spacing=_number(full, "ego_spacing", least=0),
        traffic_spacing=1 / _number(full, "vehicles_density", above=0),
        spacing_factor=float(np.exp(-5 / 40 * lanes)),
        initial_lane=initial_lane,
        frames=frames,
        dt=1 / simulation_frequency,
        decision_time=1 / policy_frequency,
        duration=_number(full, "duration", above=0, infinite=True),
        all_collide=dynamics == "v0",
        on_road_reward=_number({"on_road_reward": full.get("on_road_reward", 0)}, "on_road_reward"),
        reward_low_speed=low_speed,
        reward_high_speed=high_speed,
        normalize_reward=normalize,
        offroad_terminal=_flag(full, "offroad_terminal"),
        **weights,
        **_read_action(full["action"]),
        **_read_observation(full["observation"], lanes),
    )


def _read_action(action: Any) -> dict[str, Any]:
    _check_part(action, "action", "DiscreteMetaAction", _ACTION_KEYS)
    longitudinal = _flag(action, "longitudinal", True)
    lateral = _flag(action, "lateral", True)
    if longitudinal and lateral:
        actions = (LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER)
    elif longitudinal:
        actions = (SLOWER, IDLE, FASTER)
    elif lateral:
        actions = (LANE_LEFT, IDLE, LANE_RIGHT)
    else:
        raise RapidError("action: longitudinal and lateral are both False, so there is no action. Set one to True.")
    given = action.get("target_speeds")
    speeds = _numbers(_DEFAULT_TARGET_SPEEDS if given is None else given, "action.target_speeds")
    if len(speeds) < 2 or speeds[0] == speeds[-1]:
        raise RapidError(
            f"action.target_speeds must hold at least two speeds, the first and the last different; got {given!r}."
        )
    return {"actions": np.array(actions, np.int64), "target_speeds": speeds}


def _read_observation(observation: Any, lanes: int) -> dict[str, Any]:
    _check_part(observation, "observation", "Kinematics", _OBSERVATION_KEYS)
    order = observation.get("order", "sorted")
    if order != "sorted":
        raise RapidError(
            f"The compiled simulator covers observation.order='sorted' only, not {order!r}. {USE_REFERENCE}"
        )
    names = list(cast(Sequence[str], observation.get("features") or FEATURES[:5]))
    for name in names:
        if name not in FEATURES:
            raise RapidError(
                f"Unknown feature {name!r} in observation.features{did_you_mean(str(name), FEATURES)} "
                f"Expected some of: {', '.join(FEATURES)}."
            )
    if len(set(names)) < len(names):
        raise RapidError(f"observation.features names a feature twice: {names}. Name each once.")
    ranges: dict[str, tuple[float, float]] = {}
    if _flag(observation, "normalize", True):
        road = LANE_WIDTH * lanes
        given = observation.get("features_range") or {
            "x": [-SIGHT, SIGHT],
            "y": [-road, road],
            "vx": [-2 * _TOP_SPEED, 2 * _TOP_SPEED],
            "vy": [-2 * _TOP_SPEED, 2 * _TOP_SPEED],
        }
        if not isinstance(given, Mapping):
            raise RapidError(f"observation.features_range must map feature names to [low, high]; got {given!r}.")
        ranges = {name: _interval(pair, f"observation.features_range.{name}") for name, pair in given.items()}
    low, high = np.array([ranges.get(name, (-1.0, 1.0)) for name in names]).T
    return {
        # One row would mean no room for traffic; highway-env then returns more rows than its space says.
        "rows": read_integer({"observation.vehicles_count": observation.get("vehicles_count", 5)},
                         "observation.vehicles_count", 2, 100_000),
        "absolute": _flag(observation, "absolute", False),
        "see_behind": _flag(observation, "see_behind", False),
        "clip": _flag(observation, "clip", True),
        "features": np.array([FEATURES.index(name) for name in names], np.int64),
        "scaled": np.array([name in ranges for name in names]),
        "low": np.ascontiguousarray(low),
        "high": np.ascontiguousarray(high),
        "clock": clock_column(observation),
    }  # fmt: skip


def clock_column(observation: Mapping[str, Any]) -> int:
    """Return the column of a Kinematics observation that tells the time in the ego's row, or -1 for none.

    Raises:
        RapidError: a clock without the feature that it is told in.
    """
    if not _flag(observation, "clock", False):
        return -1
    names = list(observation.get("features") or FEATURES[:5])
    if "presence" not in names:
        raise RapidError(
            "observation.clock adds the time to the ego's presence, which is not in observation.features. Add it."
        )
    return names.index("presence")


def _check_part(part: Any, name: str, kind: str, keys: Sequence[str]) -> None:
    if not isinstance(part, Mapping):
        raise RapidError(f"{name} must be a dict with a type; got {part!r}.")
    if part.get("type") != kind:
        raise RapidError(
            f"The compiled simulator covers {name}.type={kind!r} only, not {part.get('type')!r}. {USE_REFERENCE}"
        )
    for key in part:
        if key not in keys:
            raise RapidError(
                f"The compiled simulator does not know the configuration key '{name}.{key}'"
                f"{did_you_mean(str(key), keys)} {USE_REFERENCE}"
            )


def _number(
    config: Mapping[str, Any],
    key: str,
    *,
    above: float | None = None,
    least: float | None = None,
    infinite: bool = False,
) -> float:
    value = config[key]
    wanted = "a number" if infinite else "a finite number"
    wanted += f" above {above:g}" if above is not None else f" of at least {least:g}" if least is not None else ""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise RapidError(f"{key} must be {wanted}; got {value!r}.")
    number = float(value)
    if (
        math.isnan(number)
        or (math.isinf(number) and not infinite)
        or (above is not None and number <= above)
        or (least is not None and number < least)
    ):
        raise RapidError(f"{key} must be {wanted}; got {value!r}.")
    return number


def read_integer(config: Mapping[str, Any], key: str, least: int, most: int) -> int:
    """Return ``config[key]`` if it is a whole number from `least` to `most`, and raise a RapidError otherwise."""
    value = config[key]
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
        raise RapidError(f"{key} must be a whole number from {least} to {most}; got {value!r}.")
    return int(value)


def _flag(config: Mapping[str, Any], key: str, default: bool = False) -> bool:
    value = config.get(key, default)
    if not isinstance(value, (bool, np.bool_)):
        raise RapidError(f"{key} must be True or False; got {value!r}.")
    return bool(value)


def _numbers(values: Any, key: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        array = np.empty((0, 0))
    if array.ndim != 1 or not np.isfinite(array).all():
        raise RapidError(f"{key} must be a list of finite numbers; got {values!r}.")
    return np.ascontiguousarray(array)


def _interval(values: Any, key: str) -> tuple[float, float]:
    pair = _numbers(values, key)
    if len(pair) != 2 or pair[0] == pair[1]:
        raise RapidError(f"{key} must be two different numbers [low, high]; got {values!r}.")
    return float(pair[0]), float(pair[1])
