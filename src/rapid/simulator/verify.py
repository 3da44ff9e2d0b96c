"""The differential check: the compiled simulator against the installed highway-env, step by step.

Both drive the same episodes with the same seeds and actions. Lanes, target lanes, crashes, the ego's target speed and
the ends of episodes must be equal; numbers must be equal up to rounding. After a mismatch the compiled world is set to
highway-env's, so that one event is counted once.
"""

import math
import multiprocessing
import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.scenarios import FASTER, HIGHWAY_ENV_IDS, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER, get_task
from rapid.simulator.env import CompiledHighwayEnv
from rapid.simulator.reference import copy_world, make_reference_env
from rapid.simulator.state import CRASHED, HEADING, LANE, SPEED, SPEED_INDEX, TARGET_LANE, X, Y
from rapid.simulator.thresholds import nearest_threshold
from rapid.simulator.time_limits import TimeLimits, compare_time_limits

REWARD_TOLERANCE = 1e-9
STATE_TOLERANCE = 1e-6
THRESHOLD_TOLERANCE = 1e-9
STEPS_PER_MISMATCH = 100_000

DRIVERS = ("random", "idle", "faster", "slower", "flapping")
"""How the ego acts: at random, or one action throughout, or a lane change to and fro every decision."""

Progress = Callable[[int, int, "Verification"], None]
"""Called after each episode with the episodes done, their total, and the findings so far."""


class Case(NamedTuple):
    """One episode to compare."""

    scenario: str
    config: Mapping[str, Any]
    seed: int
    driver: str
    drive_on: bool
    """Whether to go on after a crash, to the end of the time."""
    max_steps: int | None


VARIANTS: tuple[tuple[str, dict[str, Any]], ...] = (
    *((f"{name}{fast}", {}) for fast in ("", "-fast") for name in ("lane-3-density-2", "lane-4-density-2.5")),
    *((f"lane-5-density-3{fast}", {}) for fast in ("", "-fast")),
    *((f"lane-{lanes}-density-1.5-fast", {}) for lanes in (1, 2, 6)),
    ("lane-2-density-1", {"simulation_frequency": 10, "policy_frequency": 2}),
    ("lane-6-density-3:progress", {}),
    ("lane-4-density-0.5-fast:progress", {"vehicles_count": 40}),
    ("lane-3-density-4-fast", {"ego_spacing": 1, "offroad_terminal": True, "initial_lane_id": 1}),
    ("lane-4-density-2-fast", {"action": {"target_speeds": [20, 25, 30]}, "normalize_reward": False}),
    *((name, {}) for name in HIGHWAY_ENV_IDS),
    ("highway-fast-v0", {"policy_frequency": 5, "simulation_frequency": 15, "duration": 8}),
    (
        "lane-3-density-1-fast",
        {"observation": {"absolute": False, "normalize": True, "see_behind": False, "vehicles_count": 8}},
    ),
)
"""What is compared unless scenarios are named: the paper's, and others that reach the rest of the configuration."""


@dataclass(frozen=True)
class Mismatch:
    """A discrete difference after one step."""

    case: Case
    step: int
    what: str
    """Such as "target lane of vehicle 7: 1, highway-env 2"."""
    margin: float
    """How far the nearest decision of those vehicles was from its threshold in that step, NaN if unknown."""


@dataclass
class Verification:
    """The findings over some episodes; ``verdict()`` says them in words."""

    episodes: int = 0
    steps: int = 0
    vehicle_steps: int = 0
    crashes: int = 0
    resets_identical: int = 0
    steps_identical: int = 0
    """Steps after which position, heading and speed of every vehicle are equal to the last bit."""
    mismatches: list[Mismatch] = field(default_factory=list[Mismatch])
    max_reward_difference: float = 0.0
    max_state_difference: float = 0.0
    time_limits: TimeLimits | None = None
    """Episodes' ends at many frequencies, if they were compared."""
    max_observation_ulps: float = 0.0
    """Largest difference between observations, in units of the last place of the larger float32."""

    def add(self, other: "Verification") -> None:
        """Take over the findings of other episodes."""
        for name in ("episodes", "steps", "vehicle_steps", "crashes", "resets_identical", "steps_identical"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("max_reward_difference", "max_state_difference", "max_observation_ulps"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        self.mismatches += other.mismatches

    @property
    def equal(self) -> bool:
        """Whether the compiled simulator counts as equal: the bounds of this module's constants hold."""
        return (
            self.resets_identical == self.episodes
            and len(self.mismatches) <= math.ceil(self.steps / STEPS_PER_MISMATCH)
            and all(mismatch.margin <= THRESHOLD_TOLERANCE for mismatch in self.mismatches)
            and self.max_reward_difference <= REWARD_TOLERANCE
            and self.max_state_difference <= STATE_TOLERANCE
            and not (self.time_limits and self.time_limits.differences)
        )

    def verdict(self) -> str:
        """Return the findings as a few lines for people."""
        lines = [
            f"{'EQUAL' if self.equal else 'NOT EQUAL'}: the compiled simulator against highway-env over "
            f"{self.episodes} episodes, {self.steps} decisions, {self.vehicle_steps} vehicle states, "
            f"{self.crashes} crashes.",
            f"  resets identical to the last bit   {self.resets_identical} of {self.episodes}",
            f"  states identical to the last bit   after {self.steps_identical} of {self.steps} decisions",
            f"  mismatches of lanes, target lanes, crashes, target speeds, ends   {len(self.mismatches)}"
            f" (allowed: 1 per {STEPS_PER_MISMATCH} decisions, each within {THRESHOLD_TOLERANCE:g} of a threshold)",
            f"  largest difference of rewards      {self.max_reward_difference:.2g} (allowed {REWARD_TOLERANCE:g})",
            f"  largest difference of states       {self.max_state_difference:.2g} (allowed {STATE_TOLERANCE:g};"
            " m, rad, m/s)",
            f"  largest difference of observations {self.max_observation_ulps:.0f} float32 roundings",
        ]
        if self.time_limits:
            compared, differences = self.time_limits
            said = f"at {compared} pairs of frequencies" + (f", {len(differences)} differ" if differences else ", all")
            lines.append(f"  time limits equal to highway-env's {said}")
            lines += [f"  time limit: {words}" for words in differences[:20]]
        for mismatch in self.mismatches[:20]:
            case = mismatch.case
            lines.append(
                f"  mismatch: {case.scenario} {dict(case.config) or ''} seed {case.seed}, {case.driver}, "
                f"decision {mismatch.step}: {mismatch.what}; nearest threshold {mismatch.margin:.2g} away"
            )
        return "\n".join(lines)


def plan_cases(
    scenarios: Sequence[str] | None = None, episodes: int = 300, seed: int = 0, max_steps: int | None = None
) -> list[Case]:
    """Return `episodes` cases round the scenarios, then the drivers; every other one drives on after a crash."""
    variants: Sequence[tuple[str, Mapping[str, Any]]] = VARIANTS
    if scenarios:
        variants = [(get_task(name).name, {}) for name in scenarios]
    rounds = product(range(episodes), DRIVERS, variants)
    return [
        Case(name, config, seed + number, driver, number % 2 == 0, max_steps)
        for number, (_, driver, (name, config)) in zip(range(episodes), rounds, strict=False)
    ]


def verify(
    scenarios: Sequence[str] | None = None,
    episodes: int = 300,
    *,
    seed: int = 0,
    max_steps: int | None = None,
    processes: int = 1,
    plain_math: bool = False,
    time_limits: bool = False,
    progress: Progress | None = None,
) -> Verification:
    """Compare the compiled simulator with the installed highway-env.

    On processors with AVX-512, NumPy rounds sines, arc functions and powers otherwise than the C library does, which
    both simulators use elsewhere. The last bit matters little until cars almost stand still: there highway-env's
    steering is unstable and multiplies a rounding error a hundredfold per frame. With `plain_math` NumPy's extensions
    are switched off in the processes that run highway-env, and the states are expected to be identical throughout.

    Args:
        scenarios: names; None for :data:`VARIANTS`.
        episodes: how many in all, spread over the scenarios and :data:`DRIVERS`.
        seed: of the first episode; the following ones count up.
        max_steps: cut episodes after so many decisions.
        processes: highway-env makes a few decisions a second, so more processes help.
        plain_math: let NumPy use the C library's functions, in processes of their own.
        time_limits: also compare when episodes end, at many frequencies.
        progress: called after each episode.

    Raises:
        RapidError: an unknown scenario, no episodes, or highway-env is not installed.
    """
    if episodes < 1 or processes < 1:
        raise RapidError(f"episodes and processes must be at least 1; got {episodes} and {processes}.")
    cases = plan_cases(scenarios, episodes, seed, max_steps)
    total = Verification()

    def gather(findings: Iterable[Verification]) -> None:
        for done, finding in enumerate(findings, 1):
            total.add(finding)
            if progress is not None:
                progress(done, len(cases), total)

    if processes == 1 and not plain_math:
        gather(map(compare, cases))
    else:
        environment = {_DISABLE: " ".join(_numpy_extensions())} if plain_math else {}
        with _environment(environment), ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
            gather(pool.map(compare, cases))
    if time_limits:
        total.time_limits = compare_time_limits()
    return total


_DISABLE = "NPY_DISABLE_CPU_FEATURES"


def _numpy_extensions() -> list[str]:
    """Return the processor features beyond its baseline that NumPy uses here."""
    core: Any = import_module("numpy._core._multiarray_umath")  # no public name tells them
    in_use: dict[str, bool] = getattr(core, "__cpu_features__", {})
    return [name for name in getattr(core, "__cpu_dispatch__", []) if in_use.get(name)]


@contextmanager
def _environment(variables: Mapping[str, str]) -> Generator[None]:
    """Set environment variables for the processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def compare(case: Case) -> Verification:
    """Drive one episode in both simulators and return what differed."""
    compiled = CompiledHighwayEnv(case.scenario, config=case.config)
    # Trajectories are only drawn, but recording them takes highway-env a good part of its time.
    reference = make_reference_env(case.scenario, config={**case.config, "show_trajectories": False})
    highway: Any = reference.unwrapped
    actions = _actions(case, len(compiled.settings.actions))
    found = Verification(episodes=1)

    seen, expected = compiled.reset(seed=case.seed)[0], reference.reset(seed=case.seed)[0]
    ours, theirs = compiled.snapshot(), copy_world(highway)
    found.resets_identical = int(
        bool((ours.cars == theirs.cars).all())
        and bool((ours.tags[: CRASHED + 1] == theirs.tags[: CRASHED + 1]).all())
        and bool((seen == expected).all())
    )
    step = 0
    while case.max_steps is None or step < case.max_steps:
        before = ours
        action = actions(step)
        seen, earned, terminated, truncated, _ = compiled.step(action)
        expected, expected_reward, expected_end, expected_cut, _ = reference.step(action)
        ours, theirs = compiled.snapshot(), copy_world(highway)
        found.steps += 1
        found.vehicle_steps += ours.cars.shape[1]
        found.max_reward_difference = max(found.max_reward_difference, abs(float(earned) - float(expected_reward)))
        differing = _discrete_differences(ours, theirs)
        if (terminated, truncated) != (expected_end, expected_cut):
            differing[f"end: {(terminated, truncated)}, highway-env {(expected_end, expected_cut)}"] = 0
        if differing:
            meta = int(compiled.settings.actions[action])
            margin = nearest_threshold(before, meta, compiled.settings, sorted(set(differing.values())))
            found.mismatches.append(Mismatch(case, step, "; ".join(differing), margin))
            compiled.restore(theirs._replace(stream=ours.stream))
            ours = compiled.snapshot()
        else:
            rows = [X, Y, HEADING, SPEED]
            state_difference = float(np.abs(ours.cars[rows] - theirs.cars[rows]).max())
            found.steps_identical += state_difference == 0
            found.max_state_difference = max(found.max_state_difference, state_difference)
            found.max_observation_ulps = max(found.max_observation_ulps, _ulps(seen, expected))
        step += 1
        if expected_cut or (expected_end and not case.drive_on):
            break
    found.crashes = int(bool(highway.vehicle.crashed))
    reference.close()
    return found


def _actions(case: Case, count: int) -> Callable[[int], int]:
    """Return the action of each step."""
    if count < 5 and case.driver != "random":
        raise RapidError(f"The driver {case.driver!r} needs the five meta-actions.")
    steady = {"idle": IDLE, "faster": FASTER, "slower": SLOWER}
    if case.driver in steady:
        return lambda step: steady[case.driver]
    if case.driver == "flapping":
        return lambda step: LANE_RIGHT if step % 2 else LANE_LEFT
    generator = np.random.default_rng([case.seed, 1])
    return lambda step: int(generator.integers(count))


def _discrete_differences(ours: Any, theirs: Any) -> dict[str, int]:
    """Return each difference in words, with the vehicle concerned."""
    found: dict[str, int] = {}
    for row, name in ((LANE, "lane"), (TARGET_LANE, "target lane"), (CRASHED, "crash")):
        for i in np.flatnonzero(ours.tags[row] != theirs.tags[row]):
            found[f"{name} of vehicle {i}: {ours.tags[row, i]}, highway-env {theirs.tags[row, i]}"] = int(i)
    if ours.world[SPEED_INDEX] != theirs.world[SPEED_INDEX]:
        found[f"target speed: {ours.world[SPEED_INDEX]:.0f}, highway-env {theirs.world[SPEED_INDEX]:.0f}"] = 0
    return found


def _ulps(seen: NDArray[np.float32], expected: NDArray[np.float32]) -> float:
    # Below 1e-6 a rounding of float32 is finer than the rounding of the states, which are float64.
    unit = np.spacing(np.maximum(np.maximum(np.abs(seen), np.abs(expected)), np.float32(1e-6)))
    return float(np.max(np.abs(seen.astype(np.float64) - expected) / unit))
