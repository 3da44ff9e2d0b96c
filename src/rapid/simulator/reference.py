"""highway-env itself behind the same interface: what the compiled simulator is proven against and falls back to."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from rapid.errors import RapidError
from rapid.scenarios import Scenario, get_task
from rapid.simulator.configuration import merge_config
from rapid.simulator.settings import DEFAULTS, clock_column, read_integer
from rapid.simulator.state import (
    CAR_ROWS,
    CRASHED,
    LANE,
    ORDER,
    PUSHED,
    RANK,
    SPEED_INDEX,
    START_X,
    TAG_ROWS,
    TARGET_LANE,
    TIME,
    WORLD_ENTRIES,
    Snapshot,
    X,
)
from rapid.simulator.stream import stream_of


class ReferenceHighwayEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """``highway-v0`` or ``highway-fast-v0`` with the info of the compiled simulator.

    ``info["action"]`` is left out at reset, where highway-env fills it with an unseeded sample that nobody took.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], clock: int = -1) -> None:
        """Wrap an environment; `clock` is the column of the ego's row that tells the time, -1 for none."""
        super().__init__(env)
        self._start, self._clock = 0.0, clock

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._start = float(self._ego.position[0])
        return self._timed(observation), self._info(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one decision."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        told = self._info(info) | {"action": int(action) if _is_whole(action) else action}
        return self._timed(observation), float(reward), bool(terminated), bool(truncated), told

    def _timed(self, observation: Any) -> Any:
        if self._clock >= 0:
            highway: Any = self.env.unwrapped
            # Added in double precision, as the compiled simulator does.
            observation[0, self._clock] += np.float64(highway.time / highway.config["duration"])
        return observation

    @property
    def _ego(self) -> Any:
        highway: Any = self.env.unwrapped
        return highway.vehicle

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        return {
            "speed": float(info["speed"]),
            "lane": int(self._ego.lane_index[2]),
            "distance": float(self._ego.position[0]) - self._start,
            "crashed": bool(info["crashed"]),
            "rewards": {name: float(value) for name, value in info["rewards"].items()},
        }


def _is_whole(action: Any) -> bool:
    array = np.asarray(action)
    return array.ndim == 0 and array.dtype.kind in "iu"


class _StandStill(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keep an ended world as it is, with a reward of 0, until it is reset."""

    _last: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._last = None
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._last is not None:
            observation, terminated, truncated, info = self._last
            return observation, 0.0, terminated, truncated, info
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            standing = {key: value for key, value in info.items() if key != "action"}
            self._last = observation, terminated, truncated, standing
        return observation, float(reward), terminated, truncated, info


class ReferenceVectorEnv(SyncVectorEnv[Any, Any]):
    """Worlds of highway-env, stepped one after the other, with the interface of ``CompiledVectorEnv``."""

    def __init__(
        self, env_fns: Sequence[Callable[[], gymnasium.Env[Any, Any]]], seed: int | None, autoreset: bool
    ) -> None:
        mode = AutoresetMode.SAME_STEP if autoreset else AutoresetMode.DISABLED
        super().__init__(env_fns, autoreset_mode=mode)
        self._first_seed = seed

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every world."""
        if seed is None:
            seed = self._first_seed
        self._first_seed = None
        return super().reset(seed=seed, options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Take one decision in every world."""
        if self.autoreset_mode == AutoresetMode.DISABLED:
            self._autoreset_envs[:] = False  # ended worlds stand still instead of being an error
        return super().step(actions)


def make_reference_env(
    scenario: str | Scenario, render_mode: str | None = None, config: Mapping[str, Any] | None = None
) -> gymnasium.Env[Any, Any]:
    """Return highway-env's own environment for a scenario.

    Raises:
        RapidError: an unknown scenario, or highway-env is not installed.
    """
    chosen = get_task(scenario) if isinstance(scenario, str) else scenario
    try:
        import highway_env  # noqa: F401 - registers the ids  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise RapidError("highway-env is not installed. Run: pip install highway-env") from error
    parts = {key: DEFAULTS[chosen.dynamics][key] for key in ("observation", "action")}
    merged = merge_config(parts | chosen.config(), config)
    made = gymnasium.make(
        chosen.env_id,
        render_mode=render_mode,
        config=merged,
        disable_env_checker=True,  # it would step and reset once more, at highway-env's price
    )
    return ReferenceHighwayEnv(made, clock_column(merged["observation"]))


def make_reference_vec(
    scenario: str | Scenario,
    num_envs: int,
    seed: int | None = None,
    config: Mapping[str, Any] | None = None,
    autoreset: bool = True,
) -> ReferenceVectorEnv:
    """Return `num_envs` environments of highway-env as one vector environment."""
    count = read_integer({"num_envs": num_envs}, "num_envs", 1, 1_000_000)

    def make() -> gymnasium.Env[Any, Any]:
        env = make_reference_env(scenario, None, config)
        return env if autoreset else _StandStill(env)

    return ReferenceVectorEnv([make] * count, seed, autoreset)


def copy_world(highway: Any) -> Snapshot:
    """Return the state of a highway-env ``HighwayEnv`` as a world of the compiled simulator.

    The distance counts from here, and the random stream is the environment's.
    """
    vehicles = highway.road.vehicles
    cars = np.zeros((CAR_ROWS, len(vehicles)))
    tags = np.zeros((TAG_ROWS, len(vehicles)), np.int64)
    world = np.zeros(WORLD_ENTRIES)
    for i, vehicle in enumerate(vehicles):
        push = (0.0, 0.0) if vehicle.impact is None else vehicle.impact
        cars[:, i] = (
            *vehicle.position,
            vehicle.heading,
            vehicle.speed,
            *vehicle.direction,
            *vehicle.velocity,
            vehicle.target_speed,
            # The ego has neither, and what stands there is never read.
            getattr(vehicle, "timer", (vehicle.position.sum() * np.pi) % 1.0),
            getattr(vehicle, "DELTA", 4.0),
            0.0,  # the command is chosen anew in every frame
            0.0,
            *push,
        )
        tags[LANE, i] = vehicle.lane_index[2]
        tags[TARGET_LANE, i] = vehicle.target_lane_index[2]
        tags[CRASHED, i] = vehicle.crashed
        tags[PUSHED, i] = vehicle.impact is not None
    tags[ORDER] = np.argsort(cars[X], kind="stable")
    tags[RANK, tags[ORDER]] = np.arange(len(vehicles))
    world[TIME] = highway.time
    world[START_X] = cars[X, 0]
    world[SPEED_INDEX] = highway.vehicle.speed_index
    return Snapshot(cars, tags, world, stream_of(highway.np_random))
