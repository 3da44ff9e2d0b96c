"""Time limits against highway-env's: how many decisions an episode takes, at whatever frequencies.

highway-env adds 1 / policy_frequency per decision, drives simulation_frequency // policy_frequency frames in it, and
cuts the episode at the first time that is not below the duration; so rounding decides where a fraction adds up.
"""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium

from rapid.errors import RapidError
from rapid.scenarios import FASTER
from rapid.simulator.env import CompiledHighwayEnv

SIMULATION = (5.0, 10.0, 15.0, 30.0)
POLICY = (*(float(hertz) for hertz in range(1, 16)), 0.3, 0.5, 1.5, 2.5, 7.5)
DURATIONS = (1.0, 4.5, 12.0)
"""Hz, Hz, s."""

TOLERANCE = 1e-9


class TimeLimits(NamedTuple):
    """What a comparison found."""

    compared: int
    """Pairs of frequencies, each with every duration."""
    differences: list[str]
    """In words."""


def compare_time_limits(
    simulation: Sequence[float] = SIMULATION,
    policy: Sequence[float] = POLICY,
    durations: Sequence[float] = DURATIONS,
) -> TimeLimits:
    """Drive an empty road at every pair of frequencies until the time is up, in both simulators.

    After every decision the time, the end and the ego's place and target speed must be the same.

    Raises:
        RapidError: highway-env is not installed.
    """
    try:
        import highway_env  # noqa: F401 - registers the ids  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise RapidError("highway-env is not installed. Run: pip install highway-env") from error
    differences: list[str] = []
    pairs = [(frames, decisions) for frames in simulation for decisions in policy]
    for frames, decisions in pairs:
        for duration in durations:
            config = {
                "simulation_frequency": _number(frames),
                "policy_frequency": _number(decisions),
                "duration": duration,
                "vehicles_count": 0,
            }
            if found := _first_difference(config):
                differences.append(f"{frames:g} Hz, {decisions:g} decisions a second, {duration:g} s: {found}")
    return TimeLimits(len(pairs), differences)


def _number(value: float) -> int | float:
    """Return a whole number as one, since highway-env's own are."""
    return int(value) if value == int(value) else value


def _first_difference(config: dict[str, Any]) -> str:
    with warnings.catch_warnings():
        # Above the simulation frequency nothing moves, in both; and highway-env's own notes are not ours to tell.
        warnings.simplefilter("ignore")
        ours = CompiledHighwayEnv("highway-fast-v0", config=config)
        # What is observed does not matter, and a Kinematics observation takes highway-env most of its time.
        unseen = {"observation": {"type": "AttributesObservation", "attributes": ["time"]}}
        made = gymnasium.make("highway-fast-v0", config=config | unseen, disable_env_checker=True)
    theirs: Any = made.unwrapped
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for decision in range(1, round(config["duration"] * config["policy_frequency"]) + 10):
        *_, cut, _ = ours.step(FASTER)
        *_, expected, _ = theirs.step(FASTER)
        apart = abs(float(ours.vehicle.position[0]) - float(theirs.vehicle.position[0]))
        state = (ours.time, cut, ours.vehicle.speed_index)
        if state != (theirs.time, bool(expected), theirs.vehicle.speed_index) or apart > TOLERANCE:
            return (
                f"after decision {decision} at {ours.time!r} s, {'cut' if cut else 'under way'}; highway-env at "
                f"{theirs.time!r} s, {'cut' if expected else 'under way'}; {apart:.2g} m apart"
            )
        if cut:
            return ""
    return "no end in either simulator"
