"""The command line is told to end: by Ctrl-C, by SIGTERM, by a disk that is full; never with a traceback."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rapid import cli, engines, termination
from rapid.errors import RapidError
from rapid.progress import task

COLLECT = ("collect", "--teacher.backend", "scripted", "--teacher.model", "rule", "--scenario", "lane-3-density-2")


@pytest.fixture(autouse=True)
def _usual_handler():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def start(*words: str, directory: Path) -> "subprocess.Popen[str]":
    """Start the command as a terminal does, in a group of its own; return once it notices signals."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rapid.cli", *words],
        cwd=directory,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Where the tests themselves run in the background, the shell has them ignore Ctrl-C, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while not _catches(process.pid, signal.SIGTERM):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return process


def _catches(pid: int, number: int) -> bool:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("SigCgt:"):
            return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def press(process: "subprocess.Popen[str]", number: int = signal.SIGINT) -> tuple[int, str]:
    """Send a signal to the whole group and return how the command ended and what it said."""
    os.killpg(process.pid, number)
    _, said = process.communicate(timeout=120)
    return process.returncode, said


@pytest.mark.parametrize(
    ("seconds", "workers"),
    [
        (0.0, "1"),
        (1.0, "1"),
        (2.0, "2"),
        *(pytest.param(seconds, "2", marks=pytest.mark.slow) for seconds in (0.5, 3.0, 4.5, 7.0)),
    ],
)
def test_ctrl_c_is_one_sentence_whenever_it_comes(tmp_path: Path, seconds: float, workers: str):
    process = start(*COLLECT, "--teacher-transitions", "500000", "--workers", workers, directory=tmp_path)
    time.sleep(seconds)
    code, said = press(process)
    # Python itself ends by the signal if it came while C code ran text as Python; to a shell that is 130 as well.
    assert code in (130, -signal.SIGINT)
    assert "rapid: interrupted; what is done is kept. The same command goes on." in said
    assert "Traceback" not in said
    assert "Error" not in said


@pytest.mark.slow
def test_a_training_that_is_told_to_end_goes_on_as_if_it_had_not(tmp_path: Path):
    words = ("distill", "shipped:lane-3-density-2/rule", "--iterations", "500", "--evaluate-every", "0")
    words += ("--optimizer.batch-size", "8", "--network.kind", "mlp", "--loss.robust-weight", "0")
    whole = [sys.executable, "-m", "rapid.cli", *words, "--out", "whole"]
    subprocess.run(whole, cwd=tmp_path, check=True, capture_output=True)
    process = start(*words, "--out", "cut", directory=tmp_path)
    metrics = tmp_path / "cut" / "metrics.jsonl"
    while not _size(metrics):
        assert process.poll() is None
        time.sleep(0.001)
    code, said = press(process, signal.SIGTERM)
    assert code == 143
    assert "told to end; a last checkpoint is in" in said
    assert "Traceback" not in said
    done = metrics.read_text().count("\n")
    assert done < 5
    subprocess.run([*whole[:-1], "cut"], cwd=tmp_path, check=True, capture_output=True)
    ours, theirs = ((tmp_path / out / "agent" / "weights.safetensors").read_bytes() for out in ("cut", "whole"))
    assert ours == theirs


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "--scale", "tiny"), "; what is done is kept. The same command, without --from, goes on."),
        (("distill", "data"), "; what is done is kept. The same command goes on."),
        (("evaluate", "agent", "--out", "x"), "; what is done is kept. The same command goes on."),
        (("evaluate", "agent", "--out=x"), "; what is done is kept. The same command goes on."),
        (("evaluate", "agent"), "."),
        (("adversary", "agent"), "."),
        (("play",), "."),
        (("doctor",), "."),
    ],
)
@pytest.mark.parametrize(
    ("stop", "begins"),
    [
        (KeyboardInterrupt(), "\nrapid: interrupted"),
        (termination.StoppedError("what is done is kept"), "rapid: told to end"),
    ],
)
def test_only_what_goes_on_is_said_to(monkeypatch, capsys, words, says: str, stop: BaseException, begins: str):
    def end(words: list[str]) -> int:
        raise stop

    monkeypatch.setattr(cli, "_call", end)
    with pytest.raises(SystemExit):
        cli.main(words)
    assert capsys.readouterr().err == f"{begins}{says}\n"


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def full(argument: int, report: engines.Report) -> None:
    """A job for which the disk is full."""
    raise OSError(28, "No space left on device", f"part-{argument}")


@pytest.mark.parametrize("workers", [1, 2])
def test_a_workers_own_error_is_shown(workers: int):
    with pytest.raises((RapidError, OSError), match="No space left on device"):
        list(engines.run_jobs(full, [1, 2], workers=workers))


def leaves(argument: int, report: engines.Report) -> None:
    """A job that ends its process."""
    os._exit(3)


def test_a_worker_that_ended_by_itself_is_not_said_to_lack_memory():
    with pytest.raises(RapidError, match=r"ended by itself \(exit code 3\)") as error:
        list(engines.run_jobs(leaves, [1, 2], workers=2))
    assert "memory" not in str(error.value)


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(28, "No space left on device", "/x"), "The system refused: .* No space left on device"),
        (MemoryError(), "not enough memory"),
        (RapidError("The agent '\x1b[31mred\x07' is wrong."), "'\ufffd.31mred\ufffd' is wrong"),
    ],
)
def test_errors_are_one_paragraph_without_control_characters(monkeypatch, capsys, error: Exception, says: str):
    def fail(words: list[str]) -> int:
        raise error

    monkeypatch.setattr(cli, "_call", fail)
    with pytest.raises(SystemExit) as stop:
        cli.main(["run"])
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert "Traceback" not in said
    assert "\x1b" not in said
    assert re.search(says, said)


def test_what_c_code_makes_of_an_interrupt_is_one(monkeypatch, capsys):
    def swallow(words: list[str]) -> int:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error
        return 0

    monkeypatch.setattr(cli, "_call", swallow)
    with pytest.raises(SystemExit) as stop:
        cli.main(["run"])
    assert stop.value.code == 130
    assert "interrupted" in capsys.readouterr().err


def test_an_interrupt_that_python_could_raise_nowhere_is_not_lost(monkeypatch, capsys):
    class Noisy:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)

    def lose(words: list[str]) -> int:
        noisy = Noisy()
        del noisy
        time.sleep(10)
        return 0

    monkeypatch.setattr(cli, "_call", lose)
    with pytest.raises(SystemExit) as stop:
        cli.main(["run"])
    assert stop.value.code == 130
    assert "Exception ignored" not in capsys.readouterr().err


def test_an_interrupt_that_somebody_swallowed_comes_again(monkeypatch):
    def swallow(words: list[str]) -> int:
        with contextlib.suppress(KeyboardInterrupt):  # as imports of large packages do
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        with task("collect", 10, "transitions") as work:
            work.advance()
        return 0

    monkeypatch.setattr(cli, "_call", swallow)
    with pytest.raises(SystemExit) as stop:
        cli.main(["run"])
    assert stop.value.code == 130


def test_the_parent_hears_ctrl_c_once_its_child_is_known():
    started = []
    with pytest.raises(KeyboardInterrupt), termination.deaf_children():  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        child = subprocess.run(["sh", "-c", "kill -INT $$; echo alive"], capture_output=True, text=True, check=False)
        started.append(child.stdout)
    assert started == ["alive\n"]


def test_a_path_that_is_no_text_is_explained(tmp_path: Path):
    name = b"d\xffta"
    (tmp_path / os.fsdecode(name)).mkdir()
    command = [sys.executable.encode(), b"-m", b"rapid.cli", b"distill", name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 2
    assert b"is not text in UTF-8" in done.stderr
    assert b"Traceback" not in done.stderr
