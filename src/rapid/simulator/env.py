"""One compiled world as a Gymnasium environment."""

from collections.abc import Generator, Mapping, Sequence
from typing import Any, NamedTuple, SupportsInt, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.scenarios import ACTIONS, IDLE, Scenario
from rapid.simulator import startup
from rapid.simulator.configuration import Configuration, split_options
from rapid.simulator.info import info_of
from rapid.simulator.render import RENDER_MODES, Frame, Window, draw
from rapid.simulator.settings import Settings
from rapid.simulator.state import Snapshot, State, allocate, restore, snapshot
from rapid.simulator.step import (
    CONTINUE,
    allocate_outputs,
    forecast_worlds,
    reset_worlds,
    step_worlds,
)
from rapid.simulator.stream import set_generator, stream_of
from rapid.simulator.views import HighwayViews, RoadView

startup.load_numba()


class Forecast(NamedTuple):
    """What T actions would lead to. With one world the arrays start at T, with several at (M, T)."""

    observations: NDArray[np.float32]
    """(T, V, F)"""
    rewards: NDArray[np.float64]
    """(T,)"""
    terminated: NDArray[np.bool_]
    """(T,)"""
    truncated: NDArray[np.bool_]
    """(T,)"""


class CompiledHighwayEnv(HighwayViews, gymnasium.Env[NDArray[np.float32], np.int64]):
    """highway-env's ``HighwayEnv``, compiled: same spawns, decisions and rewards, states equal up to rounding.

    ``info`` holds ``speed`` [m/s], ``lane``, ``distance`` [m since reset], ``crashed``, ``rewards`` (the terms) and,
    after a step, ``action``. As in highway-env, a step after the end of an episode drives on.

    ``config`` is highway-env's configuration dict, complete. What is changed in it, by ``config[key] = value``, by
    :meth:`configure` or by ``reset(options={"config": {...}})``, holds from the next reset on. Copies and pickles go on
    as the original does; windows and recorders are not copied.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 1}  # noqa: RUF012 - as Gymnasium has it

    def __init__(
        self,
        scenario: str | Scenario = "lane-3-density-2",
        render_mode: str | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        """Prepare the environment; the first traffic comes with ``reset``.

        Args:
            scenario: a name such as ``lane-3-density-2``, or a :class:`~rapid.scenarios.Scenario`.
            render_mode: None; "rgb_array", for pictures and videos; or "human", which shows each decision frame by
                frame in a window.
            config: keys of highway-env's configuration to override.

        Raises:
            RapidError: an unknown scenario or render mode, or a configuration that the compiled simulator does not
                cover.
        """
        self.render_mode = check_render_mode(render_mode, RENDER_MODES)
        self._configuration = Configuration(scenario, config, render_mode)
        self.scenario = self._configuration.task
        self._window: Window | None = None
        self._film: Any = None
        self._shown: Snapshot | None = None
        self._build()

    def _build(self) -> None:
        """Make everything that follows from the settings; traffic comes with the next reset."""
        self.settings = self._configuration.settings
        self.observation_space, self.action_space = spaces_of(self.settings)
        self.state: State = allocate(1, self.settings)
        self._out = allocate_outputs(1, self.settings)
        self._road: RoadView | None = None
        self._ready = False
        if self._window is not None:
            self._window.close()
            self._window = None
        self._tell_frames_per_second()

    def _tell_frames_per_second(self) -> None:
        seconds = self.settings.decision_time if self._film is None else self.settings.dt
        self.metadata = self.metadata | {"render_fps": max(round(1 / seconds), 1)}
        if self._film is not None and hasattr(self._film, "frames_per_sec"):
            self._film.frames_per_sec = self.metadata["render_fps"]

    @property
    def config(self) -> dict[str, Any]:
        """highway-env's configuration; changes hold from the next reset on."""
        return self._configuration.values

    @config.setter
    def config(self, values: dict[str, Any]) -> None:
        self._configuration.values = values

    def configure(self, config: Mapping[str, Any] | None) -> None:
        """Change keys of the configuration, from the next reset on.

        Raises:
            RapidError: a key or a value that the compiled simulator does not cover; then nothing has changed.
        """
        self._configuration.configure(config)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode: the one that highway-env begins for `seed`, or, without one, the next of this stream.

        Args:
            seed: as Gymnasium has it.
            options: ``{"config": {...}}`` changes keys of the configuration, for this and the following episodes.

        Raises:
            RapidError: an unknown option, or a configuration that the compiled simulator does not cover.
        """
        if options:
            self._configuration.configure(split_options(options, ("config",)).get("config"))
        if self._configuration.refresh():
            self._build()
        super().reset(seed=seed)
        self.state.stream[0] = stream_of(self.np_random)
        reset_worlds(self.state, np.ones(1, np.bool_), self.settings, self._out)
        set_generator(self.np_random, self.state.stream[0])
        self._ready = True
        if self.render_mode == "human":
            self._show()
        return self._out.observations[0].copy(), info_of(self._out.info[0])

    def step(self, action: SupportsInt) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one decision and let its seconds pass.

        Returns:
            observation float32 (V, F), reward, terminated (crashed), truncated (time is up), info.

        Raises:
            RapidError: no episode has begun, or the action is not one of the action space.
        """
        self._require_reset()
        actions = check_actions(action, self.settings, ())
        out, before = self._out, None
        if self.render_mode == "human" or self._film is not None:
            before = self.state.copy()
        step_worlds(self.state, actions.reshape(1), self.settings, CONTINUE, out)
        if before is not None:
            self._play(before, int(actions.reshape(1)[0]))
        info = info_of(out.info[0])
        info["action"] = actions.item()
        return (
            out.observations[0].copy(),
            float(out.rewards[0]),
            bool(out.terminated[0]),
            bool(out.truncated[0]),
            info,
        )

    def snapshot(self) -> Snapshot:
        """Return a copy of the whole world, its random stream included.

        Raises:
            RapidError: no episode has begun.
        """
        self._require_reset()
        self.state.stream[0] = stream_of(self.np_random)
        return snapshot(self.state, 0)

    def restore(self, snap: Snapshot) -> None:
        """Put the world back as it was at a snapshot of an environment of this scenario.

        Raises:
            RapidError: the snapshot comes from another kind of world.
        """
        restore(self.state, 0, snap)
        set_generator(self.np_random, self.state.stream[0])
        self._ready = True

    def forecast(self, actions: Sequence[int] | NDArray[np.integer]) -> Forecast:
        """Return what T actions would lead to, without touching this world; it drives on after an end.

        Raises:
            RapidError: no episode has begun, or an action is not one of the action space.
        """
        self._require_reset()
        chosen = check_actions(actions, self.settings, (None,))
        several = forecast(self.state.copy(), chosen.reshape(1, -1), self.settings)
        return Forecast(*(array[0] for array in several))

    def render(self) -> Frame | None:  # type: ignore[override]  # Gymnasium's type of a frame is free
        """Return a picture of the world from above, uint8 (height, width, 3); None in a window.

        Raises:
            RapidError: no render mode was chosen, or no episode has begun.
        """
        self._require_reset()
        if self._configuration.view is None:
            raise RapidError('This environment draws nothing. Make it with render_mode="rgb_array" or "human".')
        if self.render_mode == "human":
            return self._show()
        return draw(self._shown or snapshot(self.state, 0), self.settings, self._configuration.view)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_window": None, "_film": None, "_road": None}

    def __repr__(self) -> str:
        under_way = f", {self.time:g} s driven" if self._ready else ""
        return (
            f"<CompiledHighwayEnv {self.scenario.name}: {self.settings.lanes} lanes, {self.settings.traffic + 1} "
            f"vehicles, observations {self.observation_space.shape}, {len(self.settings.actions)} actions{under_way}>"
        )

    def set_record_video_wrapper(self, wrapper: Any) -> None:
        """Let a ``gymnasium.wrappers.RecordVideo`` around this environment film every frame of a decision.

        Without this its videos have one picture per decision.
        """
        self._film = wrapper
        self._tell_frames_per_second()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _show(self, world: Snapshot | None = None) -> None:
        assert self._configuration.view is not None
        if self._window is None:
            self._window = Window(self._configuration.view, 1 / self.settings.dt)
        self._window.show(draw(world or snapshot(self.state, 0), self.settings, self._configuration.view))

    def _play(self, before: State, action: int) -> None:
        """Show or film the decision that was just driven."""
        for world in _frames_between(before, action, self.settings):
            self._shown = world
            if self.render_mode == "human":
                self._show(world)
            elif getattr(self._film, "recording", True):
                self._film._capture_frame()
        self._shown = None
        if self.render_mode == "human":
            self._show()


def check_render_mode(mode: str | None, modes: Sequence[str]) -> str | None:
    """Return a render mode.

    Raises:
        RapidError: it is none of these.
    """
    if mode is not None and mode not in modes:
        raise RapidError(f"Unknown render mode {mode!r}; expected None or one of: {', '.join(modes)}.")
    return mode


def _frames_between(before: State, action: int, settings: Settings) -> Generator[Snapshot]:
    """Drive a copy of one world through a decision frame by frame, and yield it after each frame but the last."""
    single = settings._replace(frames=1, decision_time=settings.dt)
    out = allocate_outputs(1, settings)
    idle = int(np.flatnonzero(settings.actions == IDLE)[0])  # the action is taken on the first frame only
    for frame in range(settings.frames - 1):
        step_worlds(before, np.array([idle if frame else action]), single, CONTINUE, out)
        yield snapshot(before, 0)


def spaces_of(settings: Settings) -> tuple["gymnasium.Space[NDArray[np.float32]]", "gymnasium.Space[np.int64]"]:
    """Return the observation and the action space of one world, equal to highway-env's."""
    shape = (settings.rows, len(settings.features))
    box = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
    return cast("gymnasium.Space[NDArray[np.float32]]", box), gymnasium.spaces.Discrete(len(settings.actions))


def check_actions(actions: Any, settings: Settings, shape: tuple[int | None, ...]) -> NDArray[np.int64]:
    """Return actions as an int64 array of the given shape (None: any length).

    Raises:
        RapidError: they are not whole numbers, have another shape or lie outside the action space.
    """
    array = np.asarray(actions)
    if array.dtype.kind not in "iu":
        raise RapidError(f"Actions must be whole numbers; got {array.dtype} ({actions!r:.60}). Convert them to int.")
    if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        wanted = str(tuple("any" if length is None else length for length in shape)).replace("'", "")
        raise RapidError(f"Actions must have the shape {wanted}, one per world and decision; got {array.shape}.")
    count = len(settings.actions)
    if array.size and (array.min() < 0 or array.max() >= count):
        wrong = array[(array < 0) | (array >= count)].flat[0]
        named = ", ".join(f"{i} {ACTIONS[meta]}" for i, meta in enumerate(settings.actions))
        raise RapidError(f"Unknown action {wrong}; expected one of: {named}.")
    return np.ascontiguousarray(array, np.int64)


def forecast(state: State, actions: NDArray[np.int64], settings: Settings) -> Forecast:
    """Drive M worlds through (M, T) checked actions; the worlds are changed, so pass copies."""
    shape = actions.shape
    result = Forecast(
        np.empty((*shape, settings.rows, len(settings.features)), np.float32),
        np.empty(shape),
        np.empty(shape, np.bool_),
        np.empty(shape, np.bool_),
    )
    forecast_worlds(state, actions, settings, *result)
    return result
