"""Pictures: their shape, what is where on them, windows, and videos."""

import subprocess
import sys
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from rapid.errors import RapidError
from rapid.scenarios import IDLE, LANE_LEFT, LANE_RIGHT
from rapid.simulator import make_vec
from rapid.simulator.env import CompiledHighwayEnv
from rapid.simulator.render import CRASH, EGO
from rapid.simulator.state import CRASHED

FAST = "lane-3-density-2-fast"


def _rows(frame: Any, color: tuple[int, int, int]) -> Any:
    """Return the rows, below the header, in which a colour is found, with their counts."""
    return np.argwhere((frame[30:] == color).all(-1))


def test_pictures_show_the_ego_where_it_is() -> None:
    env = CompiledHighwayEnv(FAST, "rgb_array", config={"initial_lane_id": 1})
    env.reset(seed=0)
    start = env.render()
    assert start is not None
    assert start.dtype == np.uint8
    assert start.ndim == 3
    assert start.shape[2] == 3
    assert start.shape[0] % 2 == start.shape[1] % 2 == 0
    before = _rows(start, EGO).mean(0)
    assert before[1] == pytest.approx(0.3 * start.shape[1], abs=3)
    env.step(LANE_RIGHT)
    env.step(IDLE)
    later = env.render()
    assert later is not None
    after = _rows(later, EGO).mean(0)
    assert after[0] - before[0] == pytest.approx(24, abs=5)  # a lane lower
    assert after[1] == pytest.approx(before[1], abs=3)  # the view goes with it
    assert (start != later).any()
    assert (env.render() == later).all()


def test_a_crashed_vehicle_is_red() -> None:
    env = CompiledHighwayEnv(FAST, "rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert frame is not None
    assert not len(_rows(frame, CRASH))
    env.state.tags[0, CRASHED, 0] = 1
    frame = env.render()
    assert frame is not None
    assert len(_rows(frame, CRASH)) > 20


def test_the_size_can_be_chosen() -> None:
    config = {"screen_width": 601, "screen_height": 150, "scaling": 5.5, "centering_position": [0.5, 0.5]}
    env = CompiledHighwayEnv("lane-5-density-3", "rgb_array", config)
    env.reset(seed=0)
    frame = env.render()
    assert frame is not None
    assert frame.shape == (150, 602, 3)
    assert _rows(frame, EGO)[:, 1].mean() == pytest.approx(301, abs=3)
    for wrong in ({"screen_width": 0}, {"scaling": -1}, {"centering_position": ["left", 0.5]}):
        with pytest.raises(RapidError, match=next(iter(wrong))):
            CompiledHighwayEnv(FAST, "rgb_array", wrong)


def test_a_window_is_fed_frame_by_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = CompiledHighwayEnv(FAST, "human", {"simulation_frequency": 50, "policy_frequency": 10})
    twin = CompiledHighwayEnv(FAST, None, {"simulation_frequency": 50, "policy_frequency": 10})
    assert (env.reset(seed=0)[0] == twin.reset(seed=0)[0]).all()
    window = env._window
    assert window is not None
    shown: list[Any] = []
    show = window.show
    monkeypatch.setattr(window, "show", lambda frame: (shown.append(frame), show(frame)))
    for action in (LANE_LEFT, IDLE):
        assert (env.step(action)[0] == twin.step(action)[0]).all()
    assert len(shown) == 10
    assert all((one != other).any() for one, other in pairwise(shown))
    assert env.render() is None
    env.close()
    env.close()


class _Recorder:
    """What ``gymnasium.wrappers.RecordVideo`` does, as far as the environment can tell."""

    def __init__(self, env: CompiledHighwayEnv) -> None:
        self.env, self.frames_per_sec, self.recording, self.frames = env, 1, True, list[Any]()

    def _capture_frame(self) -> None:
        self.frames.append(self.env.render())


def test_videos_can_hold_every_frame() -> None:
    env = CompiledHighwayEnv(FAST, "rgb_array")
    assert env.metadata["render_fps"] == 1
    recorder = _Recorder(env)
    env.set_record_video_wrapper(recorder)
    assert recorder.frames_per_sec == env.metadata["render_fps"] == 5
    env.reset(seed=0)
    snap = env.snapshot()
    env.step(LANE_LEFT)
    assert len(recorder.frames) == 4  # the fifth is the one that the wrapper itself takes after the step
    last = env.render()
    for frame in recorder.frames:
        assert (frame != last).any()
    recorder.recording = False
    env.restore(snap)
    env.step(LANE_LEFT)
    assert len(recorder.frames) == 4
    assert (env.render() == last).all()


def test_the_frames_between_lead_to_the_step() -> None:
    from rapid.simulator.env import _frames_between
    from rapid.simulator.step import step_worlds

    env = CompiledHighwayEnv("lane-4-density-2.5")
    env.reset(seed=3)
    before = env.state.copy()
    env.step(LANE_LEFT)
    *_, last = _frames_between(before, LANE_LEFT, env.settings)
    assert not (last.cars == env.state.cars[0]).all()
    single = env.settings._replace(frames=1, decision_time=env.settings.dt)
    step_worlds(before, np.array([IDLE]), single, 0, env._out)
    assert (before.cars == env.state.cars).all()


def test_many_worlds_give_pictures_of_the_first() -> None:
    env = make_vec(FAST, 20, seed=0, render_mode="rgb_array")
    env.reset()
    frames = env.render()
    assert isinstance(frames, tuple)
    assert len(frames) == 16
    single = CompiledHighwayEnv(FAST, "rgb_array")
    single.reset(seed=3)
    assert (np.asarray(frames[3]) == np.asarray(single.render())).all()


def test_mistakes_are_explained() -> None:
    env = CompiledHighwayEnv(FAST)
    env.reset(seed=0)
    with pytest.raises(RapidError, match="rgb_array"):
        env.render()
    with pytest.raises(RapidError, match="render mode"):
        CompiledHighwayEnv(FAST, "ansi")
    with pytest.raises(RapidError, match="render mode"):
        make_vec(FAST, 2, render_mode="human")
    with pytest.raises(RapidError, match="render_mode"):
        make_vec(FAST, 2, "highway-env", render_mode="rgb_array")
    with pytest.raises(RapidError, match="reset"):
        CompiledHighwayEnv(FAST, "rgb_array").render()


def test_neither_pygame_nor_pillow_is_imported_for_driving() -> None:
    code = (
        "import sys; from rapid.simulator.env import CompiledHighwayEnv as E; "
        "e = E('lane-3-density-2-fast', {mode!r}); "
        "e.reset(seed=0); e.step(1); {render}; sys.exit(sum(name in sys.modules for name in ('pygame', 'PIL')))"
    )
    for mode, render, expected in ((None, "0", 0), ("rgb_array", "e.render()", 1)):
        ran = subprocess.run([sys.executable, "-c", code.format(mode=mode, render=render)], timeout=120)
        assert ran.returncode == expected
