"""Where a decision's time goes: the phases of a frame, timed one after the other on worlds on their way."""

import time
from typing import Any

import numba
import numpy as np

from rapid.simulator.behavior import act, command_ego, free_acceleration, look_ahead, steer_towards
from rapid.simulator.dynamics import collide, move, sort_by_x
from rapid.simulator.observation import describe, observe, reward
from rapid.simulator.state import TARGET_LANE, TIME, TIMER
from rapid.simulator.step import allocate_outputs, reset_worlds, step_worlds
from rapid.simulator.vector_env import CompiledVectorEnv

Phases = dict[str, float]


@numba.njit
def _command(state: Any, actions: Any, settings: Any) -> None:
    for i in range(len(actions)):
        state.world[i, TIME] += settings.decision_time
        command_ego(state.cars[i], state.tags[i], state.world[i], settings.actions[actions[i]], settings)


@numba.njit
def _neighbours(state: Any, settings: Any) -> None:
    for i in range(len(state.cars)):
        look_ahead(state.cars[i], state.tags[i], settings)


@numba.njit
def _act(state: Any, settings: Any) -> None:
    for i in range(len(state.cars)):
        act(state.cars[i], state.tags[i], settings)


@numba.njit
def _steer(state: Any) -> float:
    total = 0.0
    for i in range(len(state.cars)):
        for j in range(state.cars.shape[2]):
            total += steer_towards(state.cars[i], j, state.tags[i, TARGET_LANE, j])
    return total


@numba.njit
def _powers(state: Any) -> float:
    total = 0.0
    for i in range(len(state.cars)):
        for j in range(1, state.cars.shape[2]):
            total += free_acceleration(state.cars[i], j, 4.0 + 0.01 * (j % 7))
    return total


@numba.njit
def _move(state: Any, settings: Any) -> None:
    for i in range(len(state.cars)):
        move(state.cars[i], state.tags[i], settings)


@numba.njit
def _sort(state: Any) -> None:
    for i in range(len(state.cars)):
        sort_by_x(state.cars[i], state.tags[i])


@numba.njit
def _collide(state: Any, settings: Any) -> None:
    for i in range(len(state.cars)):
        collide(state.cars[i], state.tags[i], settings)


@numba.njit
def _judge(state: Any, settings: Any, out: Any) -> None:
    for i in range(len(state.cars)):
        out.rewards[i] = reward(state.cars[i], state.tags[i], settings, out.info[i])
        describe(state.cars[i], state.tags[i], state.world[i], out.info[i])


@numba.njit
def _observe(state: Any, settings: Any, out: Any) -> None:
    for i in range(len(state.cars)):
        observe(state.cars[i], state.tags[i], state.world[i], settings, out.observations[i])


def profile(scenario: str, worlds: int, decisions: int, warmup: int) -> tuple[Phases, float]:
    """Return CPU time per decision and world [µs] of each phase, and of whole steps of the same decisions.

    Each phase is one call over all worlds. That the phases together lead to the same states as the step is checked.
    """
    env = CompiledVectorEnv(scenario, worlds)
    env.reset(seed=0)
    settings, generator = env.settings, np.random.default_rng(0)
    out = allocate_outputs(worlds, settings)
    phases: Phases = {}
    counted = [0.0]

    def timed(name: str, function: Any, *arguments: Any) -> None:
        start = time.process_time_ns()
        function(*arguments)
        spent = (time.process_time_ns() - start) / 1000
        phases[name] = phases.get(name, 0.0) + spent * counted[0]

    whole = resets = 0.0
    for decision in range(warmup + 1 + decisions):
        actions = generator.integers(0, len(settings.actions), worlds)
        counted[0] = float(decision > warmup)  # the first round compiles
        state = env.state.copy()
        timed("actions", _command, state, actions, settings)
        for _ in range(settings.frames):
            idle = state.copy()
            idle.cars[:, TIMER] = 0.0
            for name, function, arguments in (
                ("neighbours", _neighbours, (idle, settings)),
                ("powers", _powers, (idle,)),
                ("steering", _steer, (idle,)),
                ("act without lane choice", _act, (idle, settings)),
                ("act", _act, (state, settings)),
                ("motion", _move, (state, settings)),
                ("sorting", _sort, (state,)),
                ("collisions", _collide, (state, settings)),
            ):
                timed(name, function, *arguments)
        timed("reward", _judge, state, settings, out)
        timed("observation", _observe, state, settings, out)
        straight = env.state.copy()
        start = time.process_time_ns()
        step_worlds(straight, actions, settings, 0, out)
        whole += (time.process_time_ns() - start) / 1000 * counted[0]
        if not (straight.cars == state.cars).all():
            raise AssertionError("The phases lead elsewhere than the step.")
        *_, terminated, truncated, _ = env.step(actions)
        ended = terminated | truncated
        again = env.state.copy()
        start = time.process_time_ns()
        reset_worlds(again, ended, settings, out)
        resets += (time.process_time_ns() - start) / 1000 * counted[0]

    def take(name: str) -> float:
        return phases.pop(name)

    act_time, steady = take("act"), take("act without lane choice")
    neighbours, powers, steering = take("neighbours"), take("powers"), take("steering")
    shown = {
        "neighbours ahead (one pass)": neighbours,
        "lane choices (MOBIL)": max(act_time - steady, 0.0),
        "IDM: powers": powers,
        "IDM: gaps and the rest": max(steady - neighbours - powers - steering, 0.0),
        "steering": steering,
        "motion": take("motion"),
        "sorting by x": take("sorting"),
        "collisions": take("collisions"),
        "actions, reward, info": take("actions") + take("reward"),
        "observation": take("observation"),
        "resets": resets,
    }
    count = worlds * decisions
    return {name: spent / count for name, spent in shown.items()}, (whole + resets) / count
