import contextlib
import multiprocessing
import os
import signal
import socket
import sys
import time
from types import SimpleNamespace

import pytest

from rapid import engines
from rapid.engines import run_jobs
from rapid.errors import RapidError


def job(argument: int, report: engines.Report) -> tuple[int, int]:
    """Report, then square; some arguments go wrong."""
    report(("begun", argument))
    if argument == -1:
        raise RapidError("no such thing")
    if argument == -2:
        os.kill(os.getpid(), signal.SIGKILL)
    if argument == -3:
        time.sleep(600)
    if argument == -4:
        raise KeyError("slip")
    return argument**2, os.getpid()


def run(arguments: list[int], **options) -> tuple[dict[int, int], list, set[int]]:
    heard: list = []
    results = dict(run_jobs(job, arguments, receive=lambda index, value: heard.append((index, value)), **options))
    return {index: value for index, (value, _) in results.items()}, heard, {pid for _, pid in results.values()}


def test_one_worker_is_this_process():
    results, heard, pids = run([3, 4])
    assert results == {0: 9, 1: 16}
    assert heard == [(0, ("begun", 3)), (1, ("begun", 4))]
    assert pids == {os.getpid()}


def test_processes_do_the_same():
    results, heard, pids = run([1, 2, 3], workers=2)
    assert results == {0: 1, 1: 4, 2: 9}
    assert sorted(heard) == [(0, ("begun", 1)), (1, ("begun", 2)), (2, ("begun", 3))]
    assert 1 <= len(pids) <= 2, "a process takes the next job when it is free"
    assert os.getpid() not in pids
    assert not multiprocessing.active_children()


def test_a_process_goes_on_with_what_its_own_result_made_ready():
    ready, pids = [[1]], []
    for index, (value, pid) in run_jobs(job, (), workers=2, more=lambda: ready.pop() if ready else []):
        pids.append(pid)
        assert value == (index + 1) ** 2
        if index < 3:
            ready.append([index + 2])
    assert len(pids) == 4
    assert len(set(pids)) == 1, "starting a process takes longer than most jobs"
    assert not multiprocessing.active_children()


def test_a_lost_process_is_replaced():
    results = dict(run_jobs(job, [-2, 2, -2, 3, 4], workers=2, lost=lambda index, why: (f"job {index}: {why}", 0)))
    assert [results[index][0] for index in (1, 3, 4)] == [4, 9, 16]
    assert all(f"job {index}: its process was ended from outside" in results[index][0] for index in (0, 2))
    assert not multiprocessing.active_children()


def test_the_end_of_a_process_that_had_nothing_to_do_is_no_jobs_end():
    given = iter([[2], [3]])
    results: dict[int, int] = {}
    for index, (value, pid) in run_jobs(job, [1], workers=2, more=lambda: next(given, [])):
        results[index] = value
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    assert results == {0: 1, 1: 4, 2: 9}


@pytest.mark.parametrize(
    ("argument", "error", "says"),
    [
        (-1, RapidError, "no such thing"),
        (-2, RapidError, "ended from outside .signal 9."),
        (-4, RuntimeError, "slip"),
    ],
)
def test_the_first_failure_ends_the_others(argument, error, says):
    start = time.monotonic()
    with pytest.raises(error, match=says):
        run([-3, argument], workers=2)
    assert time.monotonic() - start < 60


def test_engines_that_cannot_be_had(monkeypatch):
    with pytest.raises(RapidError, match="did you mean 'ray'"):
        list(run_jobs(job, [1], engine="rax"))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RapidError, match=r"-e '\.\[ray\]'.*; or use --engine local"):
        list(run_jobs(job, [1], engine="ray"))


def test_a_cluster_that_does_not_answer_is_told_before_work_starts(monkeypatch):
    # Without Ray, which may not be installed: only what is asked of it before it starts.
    begun = False
    monkeypatch.setattr(engines, "_need_ray", lambda: SimpleNamespace(is_initialized=lambda: begun))
    with socket.socket() as closed, socket.socket() as head:
        closed.bind(("127.0.0.1", 0))  # nobody listens
        head.bind(("127.0.0.1", 0))
        head.listen()
        nobody, somebody = (f"127.0.0.1:{each.getsockname()[1]}" for each in (closed, head))
        for address in (nobody, f"ray://{nobody}", "127.0.0.1:99999", "no.host.invalid:6379"):
            monkeypatch.setenv("RAY_ADDRESS", address)
            start = time.monotonic()
            with pytest.raises(RapidError, match=rf"'{address}', and no Ray cluster answers.*--engine local"):
                engines.check_engine("ray")
            assert time.monotonic() - start < 30
        with pytest.raises(RapidError, match="no Ray cluster answers"):
            list(run_jobs(job, [1], engine="ray"))
        engines.check_engine("local")
        for address in (somebody, "auto", "local", ""):
            monkeypatch.setenv("RAY_ADDRESS", address)
            engines.check_engine("ray")
        begun = True  # what runs already is used, wherever RAY_ADDRESS points
        monkeypatch.setenv("RAY_ADDRESS", nobody)
        engines.check_engine("ray")


def test_another_version_is_refused():
    kind, says = engines._attempt("0.0.0", job, 1, print)
    assert kind == "refusal"
    assert "the command 0.0.0" in says
