"""Many compiled worlds as a vector environment of stable-baselines3 (Raffin et al., 2021).

Importing this module needs stable-baselines3; :func:`rapid.make_sb3_vec` says so where it is missing.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from rapid.errors import RapidError
from rapid.simulator.settings import Settings
from rapid.simulator.state import State
from rapid.simulator.vector_env import CompiledVectorEnv
from rapid.simulator.views import HighwayViews

Indices = None | int | Iterable[int]

SHARED = ("render_mode", "spec", "config", "scenario", "settings", "metadata")
"""What ``get_attr`` gives of the worlds together, the same for each."""


class Sb3Worlds(VecEnv):
    """B compiled worlds. An ended episode is followed by the next in the same step, as stable-baselines3 has it.

    A step returns observations float32 (B, V, F), rewards float32 (B,), dones bool (B,) and a list of B infos. The info
    of a world is that of the single environment; ``TimeLimit.truncated`` says that only the time was up, and where an
    episode ended ``terminal_observation`` holds its last observation and ``episode`` its return ``r``, its length ``l``
    and the seconds ``t`` since this object was made, as ``Monitor`` writes them.
    """

    def __init__(self, worlds: CompiledVectorEnv) -> None:
        """Take over `worlds`, which must reset themselves."""
        self.worlds = worlds
        self._views = [_World(worlds, i) for i in range(worlds.num_envs)]
        super().__init__(worlds.num_envs, worlds.single_observation_space, worlds.single_action_space)
        self.metadata = worlds.metadata
        self._actions: NDArray[np.integer] = np.zeros(0, np.int64)
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, np.int64)
        self._start = time.perf_counter()

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every world, with the seeds of ``seed()`` if it was called since the last reset.

        Raises:
            RapidError: ``set_options`` gave worlds different options, or options that are none.
        """
        options, *others = self._options
        if any(other != options for other in others):
            raise RapidError("The worlds share one configuration. Give set_options one dict for all of them.")
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, info = self.worlds.reset(seed=seeds, options=options or None)
        self.reset_infos = _infos(info)
        self.observation_space = self.worlds.single_observation_space
        self.action_space = self.worlds.single_action_space
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Take the actions; they are driven in :meth:`step_wait`."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive the decision.

        Raises:
            RapidError: actions of another shape, type or range, or no reset yet.
        """
        observations, rewards, terminated, truncated, info = self.worlds.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        infos = _infos(info)
        for i, cut in enumerate((truncated & ~terminated).tolist()):
            infos[i]["TimeLimit.truncated"] = cut
        dones = terminated | truncated
        if dones.any():
            finals = _infos(info["final_info"])
            seconds = round(time.perf_counter() - self._start, 6)
            for i in map(int, np.flatnonzero(dones)):
                self.reset_infos[i] = {key: value for key, value in infos[i].items() if key != "TimeLimit.truncated"}
                episode = {"r": round(float(self._returns[i]), 6), "l": int(self._lengths[i]), "t": seconds}
                infos[i] = finals[i] | {
                    "TimeLimit.truncated": infos[i]["TimeLimit.truncated"],
                    "terminal_observation": info["final_obs"][i].copy(),
                    "episode": episode,
                }
            self._returns[dones] = 0.0
            self._lengths[dones] = 0
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """End the processes, if there are several."""
        self.worlds.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture of each world; None of those beyond the first that are drawn.

        Raises:
            RapidError: the worlds were made without ``render_mode="rgb_array"``.
        """
        pictures: list[NDArray[np.uint8] | None] = list(self.worlds.render())
        return pictures + [None] * (self.num_envs - len(pictures))

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of each world: ``config``, ``render_mode``, or what a script reads, such as ``vehicle``.

        Raises:
            AttributeError: the worlds have no such attribute.
        """
        chosen = list(self._get_indices(cast(Any, indices)))
        if attr_name in SHARED:
            return [getattr(self.worlds, attr_name, None)] * len(chosen)
        return [getattr(self._views[i], attr_name) for i in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Refuse: nothing of a single world can be set.

        Raises:
            RapidError: always.
        """
        raise RapidError(
            f"'{attr_name}' cannot be set: compiled worlds have no attributes of their own. To change the "
            "configuration of all of them, call set_options({'config': {...}}) before a reset."
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Return what a method of each world returns, such as ``get_available_actions`` or ``action_masks``.

        Raises:
            AttributeError: the worlds have no such method.
        """
        methods = self.get_attr(method_name, indices)
        return [method(*method_args, **method_kwargs) for method in methods]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Say of ``Monitor`` that it is there, since episodes are told as it tells them, and of all others not."""
        chosen = list(self._get_indices(cast(Any, indices)))
        return [issubclass(Monitor, wrapper_class)] * len(chosen)

    def __repr__(self) -> str:
        return f"<Sb3Worlds over {self.worlds!r}>"


class _World(HighwayViews):
    """One of many worlds, as scripts read it."""

    def __init__(self, worlds: CompiledVectorEnv, index: int) -> None:
        self._worlds, self._index, self._road = worlds, index, None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_road": None}

    @property
    def state(self) -> State:  # pyright: ignore[reportIncompatibleVariableOverride]  # a view of many
        return self._worlds.state.part(self._index, self._index + 1)

    @property
    def settings(self) -> Settings:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self._worlds.settings

    @property
    def _ready(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self._worlds.begun(self._index)


def _infos(info: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a vector info as one dict per world, with Python's own numbers."""
    keys = [key for key in ("speed", "lane", "distance", "crashed", "action") if key in info]
    terms: dict[str, Any] = {key: value for key, value in info["rewards"].items() if not key.startswith("_")}
    columns = [info[key].tolist() for key in keys]
    rewards = [dict(zip(terms, row, strict=True)) for row in zip(*(v.tolist() for v in terms.values()), strict=True)]
    infos: list[dict[str, Any]] = [
        dict(zip(keys, row, strict=True)) | {"rewards": term}
        for row, term in zip(zip(*columns, strict=True), rewards, strict=True)
    ]
    if "action" in info and not info["_action"].all():
        for i in np.flatnonzero(~info["_action"]):
            del infos[i]["action"]
    return infos
