"""Several processes: the same results bit for bit, and no process left behind however it ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rapid.errors import RapidError
from rapid.simulator import make_vec
from rapid.simulator.pool import _work, shared_memory_layout
from rapid.simulator.vector_env import CompiledVectorEnv

FAST = "lane-3-density-2-fast"
BRIEF = {"vehicles_count": 6, "duration": 4}


def _make(worlds: int, processes: int, **options: Any) -> CompiledVectorEnv:
    env = make_vec(FAST, worlds, config=BRIEF, processes=processes, **options)
    assert isinstance(env, CompiledVectorEnv)
    return env


def _workers(env: CompiledVectorEnv) -> list[Any]:
    assert env._pool is not None
    return env._pool._workers


def _flat(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [part for key in sorted(value) for part in _flat(value[key])]
    if isinstance(value, (tuple, list)) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [part for item in value for part in _flat(item)]
    return [value if value is None else (value.dtype, value.tobytes())]


def _gone(pid: int) -> bool:
    """Whether a process has ended; one that nobody waited for yet counts as ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def _wait_until_gone(pids: list[int]) -> None:
    end = time.monotonic() + 20
    while not all(_gone(pid) for pid in pids):
        assert time.monotonic() < end, "a process was left behind"
        time.sleep(0.02)


@pytest.mark.parametrize("autoreset", [True, False])
def test_three_processes_do_what_one_does_bit_for_bit(autoreset: bool) -> None:
    one, three = _make(7, 1, autoreset=autoreset), _make(7, 3, autoreset=autoreset)
    try:
        generator = np.random.default_rng(0)
        assert _flat(one.reset(seed=3)) == _flat(three.reset(seed=3))
        for step in range(13):
            actions = generator.integers(0, 5, 7)
            assert _flat(one.step(actions)) == _flat(three.step(actions))
            if step == 6:
                mask = {"reset_mask": np.arange(7) % 2 == 0}
                assert _flat(one.reset(options=mask)) == _flat(three.reset(options=mask))
                for env in (one, three):
                    env.restore(5, env.snapshot(1))
                ahead = [env.forecast(np.full((7, 2), 3)) for env in (one, three)]
                assert _flat(ahead[0]) == _flat(ahead[1])
        assert _flat(one.state) == _flat(three.state)
    finally:
        three.close()


def test_results_are_copies_and_closing_ends_the_processes() -> None:
    env = _make(2, 8)  # at most one process per world
    env.reset(seed=0)
    first = env.step([1, 1])
    kept = _flat(first)
    env.step([2, 0])
    assert _flat(first) == kept
    pids = [worker.pid for worker in _workers(env)]
    assert len(pids) == 1
    env.close()
    _wait_until_gone(pids)
    with pytest.raises(RapidError, match="closed"):
        env.step([1, 1])
    env.close()


def test_a_forgotten_environment_ends_its_processes() -> None:
    env = _make(2, 2)
    pids = [worker.pid for worker in _workers(env)]
    del env
    _wait_until_gone(pids)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_dead_process_is_reported() -> None:
    env = _make(4, 3)
    env.reset(seed=0)
    pids = [worker.pid for worker in _workers(env)]
    os.kill(pids[0], signal.SIGKILL)
    with pytest.raises(RapidError, match="killed by signal 9"):
        env.step([1] * 4)
    _wait_until_gone(pids)
    with pytest.raises(RapidError, match="failed earlier"):
        env.step([1] * 4)


class _Line:
    """One end of a connection, read from a list."""

    def __init__(self, *received: bytes) -> None:
        self.received, self.sent = list(received), list[bytes]()

    def recv_bytes(self) -> bytes:
        if not self.received:
            raise EOFError
        return self.received.pop(0)

    def send_bytes(self, message: bytes) -> None:
        self.sent.append(message)


def test_an_exception_in_a_process_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise MemoryError("no room for scratch")

    env = _make(2, 2)
    try:
        env.reset(seed=0)
        pool, line = env._pool, _Line(b"step")
        assert pool is not None
        monkeypatch.setattr("signal.signal", lambda *_: None)
        with monkeypatch.context() as patch:
            patch.setattr("rapid.simulator.pool.step_worlds", fail)
            memory = bytearray(shared_memory_layout(2, env.settings)[1])
            _work(line, memory, 2, env.settings, 1, (0, 1))  # type: ignore[arg-type]
        pool._connections[0] = _Line(line.sent[1])  # type: ignore[assignment]
        pool._connections[0].close = lambda: None  # type: ignore[method-assign]
        with pytest.raises(RapidError, match="no room for scratch"):
            env.step([1, 1])
    finally:
        env.close()


def test_a_process_that_goes_is_reported() -> None:
    env = _make(2, 2)
    env.reset(seed=0)
    pool = env._pool
    assert pool is not None
    pool._connections[0].send_bytes(b"nothing that it knows")  # it ends
    with pytest.raises(RapidError, match="ended with code 0"):
        env.step([1, 1])


def test_an_interrupted_step_closes_the_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    env = _make(2, 2)
    env.reset(seed=0)
    pids = [worker.pid for worker in _workers(env)]
    monkeypatch.setattr("rapid.simulator.pool.step_worlds", interrupt)
    with pytest.raises(KeyboardInterrupt):
        env.step([1, 1])
    with pytest.raises(RapidError, match="interrupted"):
        env.step([1, 1])
    _wait_until_gone(pids)


SCRIPT = """
import os
from rapid.simulator import make_vec
env = make_vec("lane-3-density-2-fast", 2, seed=0, processes=2)
env.reset()
env.step([1, 1])
print(*(worker.pid for worker in env._pool._workers), flush=True)
{end}
"""


@pytest.mark.parametrize("end", ["", "raise SystemExit(3)", "os.kill(os.getpid(), 9)"])
def test_nothing_is_left_however_a_program_ends(end: str) -> None:
    before = set(os.listdir("/dev/shm")) if os.path.isdir("/dev/shm") else set()
    ran = subprocess.run([sys.executable, "-c", SCRIPT.format(end=end)], capture_output=True, text=True, timeout=120)
    assert ran.stdout, ran.stderr
    _wait_until_gone([int(pid) for pid in ran.stdout.split()])
    assert "leaked" not in ran.stderr
    if os.path.isdir("/dev/shm"):
        assert set(os.listdir("/dev/shm")) <= before


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(end=""))
    ran = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120)
    assert ran.returncode != 0
    assert "__main__" in ran.stderr.strip().splitlines()[-1]


def test_wrong_numbers_of_processes_are_refused() -> None:
    for processes in (0, -1, 1.5, True):
        with pytest.raises(RapidError, match="processes"):
            make_vec(FAST, 2, processes=processes)  # type: ignore[arg-type]
    with pytest.raises(RapidError, match="compiled"):
        make_vec(FAST, 2, "highway-env", processes=2)


def test_shared_arrays_do_not_overlap() -> None:
    settings = CompiledVectorEnv(FAST, 1).settings
    entries, total = shared_memory_layout(5, settings)
    ends = [offset + int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype, offset in entries]
    starts = [offset for _, _, offset in entries]
    assert all(end <= start for end, start in zip(ends, [*starts[1:], total], strict=True))
