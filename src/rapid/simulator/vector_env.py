"""Many compiled worlds as one Gymnasium vector environment: one compiled call steps them all, resets included."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.scenarios import Scenario
from rapid.simulator.configuration import Configuration, split_options
from rapid.simulator.env import Forecast, check_actions, check_render_mode, forecast, spaces_of
from rapid.simulator.info import Mask, acted, info_of_all
from rapid.simulator.pool import WorldPool
from rapid.simulator.render import Frame, draw
from rapid.simulator.settings import read_integer
from rapid.simulator.state import TERMINATED, TRUNCATED, Snapshot, State, allocate, restore, snapshot
from rapid.simulator.step import AUTORESET, FREEZE, allocate_outputs, reset_worlds, seed_worlds, step_worlds
from rapid.simulator.stream import stream_of

RENDERED = 16
"""Worlds that are drawn at most."""


class CompiledVectorEnv(gymnasium.vector.VectorEnv[NDArray[np.float32], NDArray[np.int64], NDArray[Any]]):
    """B compiled worlds. With ``autoreset`` (SAME_STEP) an ended episode is followed by the next in the same step.

    A step returns observations float32 (B, V, F), rewards float64 (B,), terminated and truncated bool (B,), and
    ``info`` with the arrays ``speed`` [m/s], ``lane``, ``distance`` [m since reset], ``crashed`` and the dict
    ``rewards`` of the terms. Where a world was reset, these describe its new episode, ``final_obs`` (an object array,
    None elsewhere) holds the last observation of the old one and ``final_info`` its info. Every entry has a mask with
    a leading underscore, as Gymnasium defines it. ``action`` is the action that a world's episode took.

    Without ``autoreset`` an ended world stands still: it keeps its observation and flags and earns 0, until it is
    chosen by ``reset(options={"reset_mask": mask})`` or everything is reset.

    ``config`` is highway-env's configuration dict, complete, and the same for all worlds. What is changed in it holds
    from the next reset of all worlds on. Copies and pickles go on as the original does, with processes of their own.
    """

    def __init__(
        self,
        scenario: str | Scenario,
        num_envs: int,
        seed: int | None = None,
        config: Mapping[str, Any] | None = None,
        autoreset: bool = True,
        processes: int = 1,
        render_mode: str | None = None,
    ) -> None:
        """Prepare the worlds; the first traffic comes with ``reset``.

        Args:
            scenario: a name such as ``lane-3-density-2``, or a :class:`~rapid.scenarios.Scenario`.
            num_envs: B.
            seed: seeds the first ``reset()`` that is called without one.
            config: keys of highway-env's configuration to override.
            autoreset: whether an ended world begins its next episode within the same step.
            processes: among how many processes the worlds are divided; the results are the same.
            render_mode: None, or "rgb_array" for pictures of the first worlds.

        Raises:
            RapidError: an unknown scenario, a configuration that the compiled simulator does not cover, no worlds, or
                processes that cannot be started.
        """
        self.render_mode = check_render_mode(render_mode, ("rgb_array",))
        self._configuration = Configuration(scenario, config, render_mode)
        self.scenario = self._configuration.task
        self.num_envs = read_integer({"num_envs": num_envs}, "num_envs", 1, 1_000_000)
        self._mode = AUTORESET if autoreset else FREEZE
        self._processes = read_integer({"processes": processes}, "processes", 1, 1024)
        self._pool: WorldPool | None = None
        self._first_seed = seed
        self._seeded = np.zeros(self.num_envs, np.bool_)
        self._build()

    def _build(self) -> None:
        """Make everything that follows from the settings; traffic comes with the next reset."""
        self.settings = self._configuration.settings
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": max(round(1 / self.settings.decision_time), 1),
            "autoreset_mode": AutoresetMode.SAME_STEP if self._mode == AUTORESET else AutoresetMode.DISABLED,
        }
        self.single_observation_space, self.single_action_space = spaces_of(self.settings)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        if self._pool is not None:
            self._pool.close()
        several = self._processes > 1
        self._pool = WorldPool(self.num_envs, self.settings, self._mode, self._processes) if several else None
        self.state: State = self._pool.state if self._pool else allocate(self.num_envs, self.settings)
        self._ready = np.zeros(self.num_envs, np.bool_)
        self._observations = np.zeros((self.num_envs, self.settings.rows, len(self.settings.features)), np.float32)

    @property
    def config(self) -> dict[str, Any]:
        """highway-env's configuration; changes hold from the next reset of all worlds on."""
        return self._configuration.values

    @config.setter
    def config(self, values: dict[str, Any]) -> None:
        self._configuration.values = values

    def configure(self, config: Mapping[str, Any] | None) -> None:
        """Change keys of the configuration, from the next reset of all worlds on.

        Raises:
            RapidError: a key or a value that the compiled simulator does not cover; then nothing has changed.
        """
        self._configuration.configure(config)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every world, or in those of ``options["reset_mask"]`` (bool, (B,)).

        Args:
            seed: with a whole number, world i is seeded with ``seed + i``; with a list, each world with its own.
                Without one, or where the list says None, the world's stream goes on.
            options: ``reset_mask``, and ``config`` with keys of the configuration to change.

        Raises:
            RapidError: a seed below 0, a list or a mask of another length, an unknown option, or a configuration that
                the compiled simulator does not cover or that was changed while some worlds go on.
        """
        given = split_options(options, ("reset_mask", "config"))
        chosen = self._chosen(given.get("reset_mask"))
        self._configure(given.get("config"), chosen)
        if seed is None and self._first_seed is not None:
            seed = self._first_seed
        self._first_seed = None
        self._seed(seed, chosen)
        out = allocate_outputs(self.num_envs, self.settings)
        out.observations[:] = self._observations
        reset_worlds(self.state, chosen, self.settings, out)
        self._ready |= chosen
        self._observations = out.observations
        return out.observations.copy(), info_of_all(out.info, chosen)

    def step(
        self, actions: NDArray[np.integer] | Sequence[int]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], Mask, Mask, dict[str, Any]]:
        """Take one decision in every world and let its seconds pass.

        Raises:
            RapidError: a world has not begun, actions of another shape, type or range than the action space, or a
                process that died.
        """
        self._require_reset()
        checked = check_actions(actions, self.settings, (self.num_envs,))
        still = (self.state.world[:, TERMINATED] != 0.0) | (self.state.world[:, TRUNCATED] != 0.0)  # before the step
        if self._pool is not None:
            out = self._pool.step(checked)
        else:
            out = allocate_outputs(self.num_envs, self.settings)
            step_worlds(self.state, checked, self.settings, self._mode, out)
        info: dict[str, Any] = {}
        ended = out.terminated | out.truncated
        if self._mode == AUTORESET and ended.any():
            finals = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):  # Gymnasium wants an array of arrays; only the worlds that just ended
                finals[i] = out.final_observations[i]
            info = {
                "final_obs": finals,
                "_final_obs": ended.copy(),
                "final_info": info_of_all(out.final_info, ended) | acted(checked, ended),
                "_final_info": ended.copy(),
            }
        took = ~ended if self._mode == AUTORESET else ~still
        info |= info_of_all(out.info, np.ones(self.num_envs, np.bool_)) | acted(checked, took)
        self._observations = out.observations
        return out.observations.copy(), out.rewards, out.terminated, out.truncated, info

    def snapshot(self, index: int) -> Snapshot:
        """Return a copy of one world, its random stream included.

        Raises:
            RapidError: no such world, or it has not begun.
        """
        self._check_index(index)
        self._require_reset()
        return snapshot(self.state, index)

    def restore(self, index: int, snap: Snapshot) -> None:
        """Put one world back as it was at a snapshot of a world of this scenario.

        Raises:
            RapidError: no such world, or the snapshot comes from another kind of world.
        """
        self._check_index(index)
        restore(self.state, index, snap)
        self._seeded[index] = self._ready[index] = True

    def forecast(
        self, actions: NDArray[np.integer] | Sequence[Sequence[int]], worlds: Sequence[int] | None = None
    ) -> Forecast:
        """Return what (M, T) actions would lead to, without touching the worlds; they drive on after an end.

        Args:
            actions: one row of T actions for each world to look ahead from.
            worlds: the world of each row, any number of times each; None: every world once.

        Raises:
            RapidError: a world has not begun, no such world, or actions of another shape, type or range.
        """
        self._require_reset()
        chosen = list(range(self.num_envs)) if worlds is None else list(worlds)
        for index in chosen:
            self._check_index(index)
        checked = check_actions(actions, self.settings, (len(chosen), None))
        return forecast(self.state.take(chosen), checked, self.settings)

    def render(self) -> tuple[Frame, ...]:  # type: ignore[override]  # Gymnasium's type of a frame is free
        """Return pictures of the first worlds, at most :data:`RENDERED`, each uint8 (height, width, 3).

        Raises:
            RapidError: no render mode was chosen, or a world has not begun.
        """
        self._require_reset()
        if self._configuration.view is None:
            raise RapidError('This environment draws nothing. Make it with render_mode="rgb_array".')
        count = min(self.num_envs, RENDERED)
        return tuple(draw(snapshot(self.state, i), self.settings, self._configuration.view) for i in range(count))

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes, if there are several. Forgetting the environment does the same."""
        if self._pool is not None:
            self._pool.close()

    def __getstate__(self) -> dict[str, Any]:
        # Processes and the memory that they share stay with the original.
        return self.__dict__ | {"_pool": None, "state": self.state.copy()}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self.__dict__.update(kept)
        if self._processes > 1:
            self._pool = WorldPool(self.num_envs, self.settings, self._mode, self._processes)
            for memory, array in zip(self._pool.state, self.state, strict=True):
                memory[:] = array
            self.state = self._pool.state

    def __repr__(self) -> str:
        shape = self.single_observation_space.shape
        return (
            f"<CompiledVectorEnv of {self.num_envs} worlds of {self.scenario.name}: {self.settings.lanes} lanes, "
            f"{self.settings.traffic + 1} vehicles each, observations {shape}, {len(self.settings.actions)} actions>"
        )

    def _seed(self, seed: int | Sequence[int | None] | None, chosen: Mask) -> None:
        if seed is None:
            seeds: list[int | None] = [None] * self.num_envs
        elif isinstance(seed, (int, np.integer)):
            seeds = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise RapidError(f"A list of seeds needs one per world, {self.num_envs}; got {len(seeds)}.")
        for value in seeds:
            if value is not None and (not isinstance(cast(Any, value), (int, np.integer)) or value < 0):
                raise RapidError(f"Seeds must be whole numbers of at least 0; got {value!r}.")
        given = np.array([value is not None for value in seeds]) & chosen
        fresh = ~given & ~self._seeded & chosen
        words = np.zeros(self.num_envs, np.uint64)
        words[fresh] = np.random.SeedSequence().generate_state(self.num_envs, np.uint64)[fresh]
        words[given] = [value % (1 << 64) for value, use in zip(seeds, given, strict=True) if use and value is not None]
        seed_worlds(self.state, given | fresh, words)
        for i in np.flatnonzero(given):
            value = seeds[i]
            if value is not None and value >= 1 << 64:  # the compiled seeding takes 64 bits
                self.state.stream[i] = stream_of(np.random.Generator(np.random.PCG64(value)))
        self._seeded |= chosen

    def _configure(self, changes: Mapping[str, Any] | None, chosen: Mask) -> None:
        self._configuration.configure(changes)
        if chosen.all():
            if self._configuration.refresh():
                streams = self.state.stream.copy()
                self._build()
                self.state.stream[:] = streams
        elif self._configuration.changed:
            raise RapidError(
                "The configuration was changed, but only some worlds are reset, and all have the same one. Reset all "
                "worlds once, without a reset_mask."
            )

    def _chosen(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        array = np.asarray(mask)
        if array.dtype != np.bool_ or array.shape != (self.num_envs,) or not array.any():
            raise RapidError(
                f"reset_mask must be a bool array of shape ({self.num_envs},) with at least one True; got "
                f"{array.dtype} of shape {array.shape}."
            )
        return array.copy()

    def begun(self, index: int) -> bool:
        """Return whether a world has begun an episode."""
        return bool(self._ready[index])

    def _check_index(self, index: int) -> None:
        if not 0 <= index < self.num_envs:
            raise RapidError(f"There is no world {index}; expected 0 to {self.num_envs - 1}.")

    def _require_reset(self) -> None:
        if not self._ready.all():
            raise RapidError("No episode has begun in some worlds. Call reset() first.")
