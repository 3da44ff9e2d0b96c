"""``rapid doctor``: look at everything a run needs and say what to do about each failure."""

import importlib
import importlib.util
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

from rapid.config import TeacherConfig
from rapid.errors import RapidError, how_to_install
from rapid.files import atomic_path, cache_dir

Verdict = Literal["ok", "warning", "failed"]


@dataclass(frozen=True)
class Finding:
    """The outcome of one check."""

    name: str
    verdict: Verdict
    fact: str
    """What was seen."""
    fix: str = ""
    """What to do about it."""


def examine(teacher: TeacherConfig) -> Iterator[Finding]:
    """Run every check, one after another; a check that breaks is itself a failure, never an exception."""
    checks: list[tuple[str, Callable[[], Finding]]] = [
        ("Python", _python),
        ("torch", _torch),
        ("simulator", _simulator),
        ("highway-env", _reference),
        ("cache directory", _cache),
        ("model", lambda: _model(teacher)),
        ("extras", _extras),
    ]
    if teacher.backend == "endpoint":
        checks.append(("endpoint", lambda: _endpoint(teacher)))
    for name, check in checks:
        try:
            yield check()
        except RapidError as error:
            yield Finding(name, "failed", str(error))
        except Exception as error:
            yield Finding(name, "failed", f"{type(error).__name__}: {error}", "Install again: make clean install.")


def _python() -> Finding:
    fact = f"{platform.python_version()} on {platform.platform(terse=True)}, {os.cpu_count()} cores"
    return Finding("Python", "ok", fact)


def _torch() -> Finding:
    import torch

    threads, cores = torch.get_num_threads(), os.cpu_count() or 1
    fact = f"{torch.__version__}, {threads} thread{'s' * (threads != 1)}, CUDA {torch.cuda.is_available()}"
    if threads > cores:
        return Finding("torch", "warning", fact, f"More threads than the {cores} cores: set OMP_NUM_THREADS=1.")
    return Finding("torch", "ok", fact)


def _simulator() -> Finding:
    import numpy as np

    import rapid
    from rapid.simulator.compile import cache_folders, damaged_cache_files

    # Beside the simulator's, which others import, these have kernels of their own.
    for module in ("rapid.networks.layer", "rapid.teacher.foresight", "rapid.teacher.forecast"):
        importlib.import_module(module)
    damaged = [path for folder in cache_folders() for path in damaged_cache_files(folder)]
    start = time.perf_counter()
    env = rapid.make_vec("lane-3-density-2", 64, seed=0)
    env.reset(seed=0)
    actions = np.ones(64, np.int64)
    env.step(actions)
    first = time.perf_counter() - start
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < 1.0:
        env.step(actions)
        steps += 64
    speed = steps / (time.perf_counter() - start)
    fact = f"{speed:,.0f} decisions/s at 64 worlds, first step after {first:.1f} s"
    if damaged:
        folders = " and ".join(sorted({str(path.parent) for path in damaged}))
        fact += f"; {len(damaged)} damaged file{'s' * (len(damaged) > 1)} of machine code in {folders}"
        fix = "Each is compiled anew as soon as it is needed. If it happens again, look at the disk."
        return Finding("simulator", "warning", fact, fix)
    if speed < 500:
        return Finding(
            "simulator", "warning", fact, "Is the machine busy? Expected some thousands a second on one core."
        )
    return Finding("simulator", "ok", fact)


def _reference() -> Finding:
    import rapid

    env = rapid.make_env("lane-3-density-2-fast", simulator="highway-env")
    env.reset(seed=0)
    env.step(1)
    return Finding("highway-env", "ok", "the reference simulator resets and steps")


def _cache() -> Finding:
    directory = cache_dir()
    try:
        with atomic_path(directory / ".probe") as path:
            path.write_text("x")
        (directory / ".probe").unlink()
    except (RapidError, OSError) as error:
        return Finding("cache directory", "failed", str(error), "Set RAPID_CACHE to a directory you can write to.")
    free = shutil.disk_usage(directory).free / 1e9
    fact = f"{directory}, {free:.1f} GB free"
    if free < 2:
        return Finding("cache directory", "warning", fact, "Models need up to 2 GB: free some, or set RAPID_CACHE.")
    return Finding("cache directory", "ok", fact)


def _model(teacher: TeacherConfig) -> Finding:
    from rapid.teacher import models

    name = teacher.model if teacher.backend == "local" else TeacherConfig().model
    if models.is_present(name):
        return Finding("model", "ok", f"{name} is in the cache")
    return Finding(
        "model", "warning", f"{name} is not in the cache yet", f"A run fetches it; or: rapid models pull {name}"
    )


def _extras() -> Finding:
    extras = {"minari": "minari", "ray": "ray", "export": "onnxruntime", "tracking": "tensorboard"}
    state = {extra: importlib.util.find_spec(module) is not None for extra, module in extras.items()}
    missing = [extra for extra, present in state.items() if not present]
    fact = f"present: {', '.join(extra for extra in extras if state[extra]) or 'none'}"
    fix = f"Only if you want them: {how_to_install(*missing)}" if missing else ""
    return Finding("extras", "ok", fact, fix)


def _endpoint(teacher: TeacherConfig) -> Finding:
    from rapid.teacher.chat import ChatError
    from rapid.teacher.endpoint import Endpoint

    try:
        names = Endpoint(replace(teacher, timeout_s=min(teacher.timeout_s, 10.0), max_retries=0)).models()
    except ChatError as error:
        fix = "Is the server running, and does its address end in /v1? Set --teacher.base-url."
        return Finding("endpoint", "failed", f"{teacher.base_url}: {error}", fix)
    if not names:
        return Finding(
            "endpoint", "warning", f"{teacher.base_url} answers, but lists no models", "A run will show more."
        )
    if teacher.model not in names:
        fix = "Set --teacher.model to one of the server's models."
        some = ", ".join(names[:5])
        return Finding("endpoint", "warning", f"{teacher.base_url} lists no '{teacher.model}' (it has: {some})", fix)
    return Finding("endpoint", "ok", f"{teacher.base_url} serves {teacher.model}")
