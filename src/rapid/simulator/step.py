# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""The compiled step: of one world, for whoever searches or plans, and of many worlds in one call.

Everything below works in place on slices of :class:`~rapid.simulator.state.State` and allocates only scratch.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.simulator.behavior import act, command_ego
from rapid.simulator.compile import kernel
from rapid.simulator.dynamics import collide, move, sort_by_x
from rapid.simulator.observation import INFO_COLUMNS, INFO_ON_ROAD, describe, observe, reward
from rapid.simulator.settings import Settings
from rapid.simulator.spawn import spawn_world
from rapid.simulator.state import CRASHED, TERMINATED, TIME, TRUNCATED
from rapid.simulator.stream import seed_stream

CONTINUE, AUTORESET, FREEZE = range(3)
"""What a step does with a world whose episode has ended: drive on, begin the next episode at once, stand still."""


class Outputs(NamedTuple):
    """What a step of B worlds returns; the kernels write into these arrays."""

    observations: NDArray[np.float32]
    """(B, V, F); after an automatic reset those of the new episode."""
    rewards: NDArray[np.float64]
    """(B,)"""
    terminated: NDArray[np.bool_]
    """(B,)"""
    truncated: NDArray[np.bool_]
    """(B,)"""
    info: NDArray[np.float64]
    """(B, INFO_COLUMNS)"""
    final_observations: NDArray[np.float32]
    """(B, V, F): where this step ended an episode and began the next, the last observation of the old one."""
    final_info: NDArray[np.float64]
    """(B, INFO_COLUMNS)"""


def allocate_outputs(worlds: int, settings: Settings) -> Outputs:
    """Return memory for the results of one step of `worlds` worlds."""
    seen = (worlds, settings.rows, len(settings.features))
    return Outputs(
        np.zeros(seen, np.float32),
        np.zeros(worlds),
        np.zeros(worlds, np.bool_),
        np.zeros(worlds, np.bool_),
        np.zeros((worlds, INFO_COLUMNS)),
        np.zeros(seen, np.float32),
        np.zeros((worlds, INFO_COLUMNS)),
    )


@kernel
def advance_world(cars, tags, world, action, settings):
    """Drive one world through one decision, in place: ``settings.frames`` frames, the action taken on the first.

    Args:
        cars: float64 (CAR_ROWS, N).
        tags: int64 (TAG_ROWS, N).
        world: float64 (WORLD_ENTRIES,).
        action: a meta-action, an index of ``rapid.scenarios.ACTIONS``.
        settings: the configuration.
    """
    world[TIME] += settings.decision_time
    if settings.frames > 0:
        command_ego(cars, tags, world, action, settings)
    for _ in range(settings.frames):
        act(cars, tags, settings)
        move(cars, tags, settings)
        sort_by_x(cars, tags)
        collide(cars, tags, settings)


@kernel
def step_world(cars, tags, world, action, settings, info):
    """Drive one world through one decision and judge it, in place.

    The arguments are those of :func:`advance_world` and `info`, float64 (INFO_COLUMNS,), which is overwritten with
    speed, lane, distance, crash and the terms of the reward.

    Returns:
        reward, terminated, truncated.
    """
    advance_world(cars, tags, world, action, settings)
    earned = reward(cars, tags, settings, info)
    describe(cars, tags, world, info)
    terminated = tags[CRASHED, 0] != 0 or (settings.offroad_terminal and info[INFO_ON_ROAD] == 0.0)
    truncated = world[TIME] >= settings.duration
    world[TERMINATED] = 1.0 if terminated else 0.0
    world[TRUNCATED] = 1.0 if truncated else 0.0
    return earned, terminated, truncated


@kernel
def reset_world(cars, tags, world, stream, settings, observation, info):
    """Spawn one world from its stream and write what the ego sees and the info of the first moment."""
    spawn_world(cars, tags, world, stream, settings)
    reward(cars, tags, settings, info)
    describe(cars, tags, world, info)
    observe(cars, tags, world, settings, observation)


@kernel
def step_worlds(state, actions, settings, mode, out):
    """Step every world once.

    Args:
        state: B worlds, changed in place.
        actions: int64 (B,), indices into ``settings.actions``; the caller has checked their range.
        settings: the configuration.
        mode: CONTINUE, AUTORESET or FREEZE.
        out: overwritten. Under FREEZE, ended worlds keep their observation and flags and earn 0.
    """
    for i in range(len(actions)):
        cars, tags, world = state.cars[i], state.tags[i], state.world[i]
        if mode == FREEZE and (world[TERMINATED] != 0.0 or world[TRUNCATED] != 0.0):
            reward(cars, tags, settings, out.info[i])
            describe(cars, tags, world, out.info[i])
            observe(cars, tags, world, settings, out.observations[i])
            out.rewards[i] = 0.0
            out.terminated[i] = world[TERMINATED] != 0.0
            out.truncated[i] = world[TRUNCATED] != 0.0
            continue
        action = settings.actions[actions[i]]
        earned, terminated, truncated = step_world(cars, tags, world, action, settings, out.info[i])
        out.rewards[i] = earned
        out.terminated[i] = terminated
        out.truncated[i] = truncated
        if mode == AUTORESET and (terminated or truncated):
            out.final_info[i] = out.info[i]
            observe(cars, tags, world, settings, out.final_observations[i])
            reset_world(cars, tags, world, state.stream[i], settings, out.observations[i], out.info[i])
        else:
            observe(cars, tags, world, settings, out.observations[i])


@kernel
def reset_worlds(state, chosen, settings, out):
    """Begin a new episode in the worlds where `chosen` (bool, (B,)) holds, each from its own stream."""
    for i in range(len(chosen)):
        if chosen[i]:
            reset_world(
                state.cars[i],
                state.tags[i],
                state.world[i],
                state.stream[i],
                settings,
                out.observations[i],
                out.info[i],
            )


@kernel
def seed_worlds(state, chosen, seeds):
    """Set the streams of the worlds where `chosen` holds from 64-bit `seeds`, as NumPy seeds PCG64."""
    for i in range(len(chosen)):
        if chosen[i]:
            seed_stream(state.stream[i], seeds[i])


@kernel
def forecast_worlds(state, actions, settings, observations, rewards, terminated, truncated):
    """Drive M worlds (already copies: they are changed) through T actions each.

    Of the arrays that are overwritten, `observations` is (M, T, V, F); `actions` and the others are (M, T).
    """
    info = np.zeros(INFO_COLUMNS)
    for i in range(actions.shape[0]):
        cars, tags, world = state.cars[i], state.tags[i], state.world[i]
        for t in range(actions.shape[1]):
            action = settings.actions[actions[i, t]]
            rewards[i, t], terminated[i, t], truncated[i, t] = step_world(cars, tags, world, action, settings, info)
            observe(cars, tags, world, settings, observations[i, t])
