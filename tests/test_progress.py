import io

import pytest

from rapid import progress


def test_plain_lines_carry_count_eta_and_note(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with progress.task("distil", 100, "iterations", stream) as work:
        work.note("loss 0.5")
        for _ in range(10):
            now[0] += 1
            work.advance(5)
    lines = stream.getvalue().splitlines()
    # 25 of 100 after 5 s: 15 s to go; then once more at 10 s, then the closing line.
    assert lines[0] == "distil: 25/100 iterations  ETA 15 s  loss 0.5"
    assert lines[1] == "distil: 50/100 iterations  ETA 10 s  loss 0.5"
    assert lines[2] == "distil: 50 iterations in 10 s  loss 0.5"


def test_work_of_an_earlier_run_does_not_enter_the_estimate(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with progress.task("collect", 100, "steps", stream) as work:
        work.skip(90)
        now[0] = 6
        work.advance(5)
    assert "95/100 steps  ETA 6.0 s" in stream.getvalue()


def test_a_bar_forgets_the_pace_of_an_earlier_run():
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    with progress.task("collect", 100, "steps", Terminal()) as work:
        work.skip(90)
        assert work._bar is not None
        (bar,) = work._bar.tasks
        assert (bar.completed, bar.speed) == (90, None)


def test_a_failed_task_prints_no_closing_line():
    stream = io.StringIO()
    with pytest.raises(ValueError, match="x"), progress.task("t", 1, "u", stream):
        raise ValueError("x")
    assert stream.getvalue() == ""


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.04, "0.0 s"), (8.26, "8.3 s"), (59, "59 s"), (185, "3 min 5 s"), (7440, "2 h 4 min")]
)
def test_durations(seconds: float, text: str):
    assert progress.format_seconds(seconds) == text


@pytest.mark.parametrize(
    ("done", "total", "text"), [(1_234_567, 2e6, "1234567/2000000 MB"), (3.25, 144.0, "3.2/144 MB")]
)
def test_counts_stand_in_full(monkeypatch: pytest.MonkeyPatch, done: float, total: float, text: str):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with progress.task("t", total, "MB", stream) as work:
        now[0] = 6
        work.advance(done)
    assert text in stream.getvalue()


def test_more_than_was_asked_for_is_no_negative_time(monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with progress.task("collect", 20, "steps", stream) as work:
        for _ in range(3):
            now[0] += 6
            work.advance(7)
    lines = stream.getvalue().splitlines()
    assert lines[1] == "collect: 14/20 steps  ETA 5.1 s"
    assert lines[2] == "collect: 21/21 steps  ETA 0.0 s"
