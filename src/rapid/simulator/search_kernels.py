# pyright: basic
# Kernels: the types that matter here are numba's, which pyright does not know.
"""The kernels of searches with a perfect model: beam search for the best plan, depth first for a way past a crash.

Both drive copies of a world, of which nothing is drawn at random, and leave the world itself as it is.
"""

import numpy as np

from rapid.simulator.behavior import command_ego
from rapid.simulator.compile import kernel
from rapid.simulator.observation import INFO_COLUMNS
from rapid.simulator.spawn import nearest_speed_index
from rapid.simulator.state import CRASHED, RANK, SPEED, SPEED_INDEX, TARGET_LANE, TARGET_SPEED, TERMINATED, TRUNCATED
from rapid.simulator.step import step_world


@kernel
def _commanded(cars, tags, world, action, settings):
    """Return the target lane and speed that a meta-action would set; all that it does to a world."""
    lane, speed, index = tags[TARGET_LANE, 0], cars[TARGET_SPEED, 0], world[SPEED_INDEX]
    command_ego(cars, tags, world, action, settings)
    commanded = tags[TARGET_LANE, 0], cars[TARGET_SPEED, 0]
    tags[TARGET_LANE, 0], cars[TARGET_SPEED, 0], world[SPEED_INDEX] = lane, speed, index
    return commanded


@kernel
def distinct(cars, tags, world, tries, settings, found):
    """Write those of the actions `tries` that command different things into `found` and return how many they are."""
    lanes = np.empty(len(tries), np.int64)
    speeds = np.empty(len(tries))
    count = 0
    for action in tries:
        lane, speed = _commanded(cars, tags, world, settings.actions[action], settings)
        known = False
        for k in range(count):
            known = known or (lanes[k] == lane and speeds[k] == speed)
        if not known:
            lanes[count], speeds[count], found[count] = lane, speed, action
            count += 1
    return count


@kernel
def select(returns, kinds, alive, counts, beam):
    """Write the nodes to go on from into `beam` and return how many they are.

    If they are too many: the best of each kind, then the next best of each kind, then the next two, and so on, the
    higher return first. Without kinds, the beam fills with one car's ways through one gap.
    """
    best_first = np.argsort(-returns, kind="mergesort")  # stable, so that ties are broken alike everywhere
    chosen = np.zeros(len(returns), np.bool_)
    room = min(len(beam), alive.sum())
    quota = 1 if alive.sum() > room else len(returns)
    counts[:] = 0
    kept = 0
    while kept < room:
        for node in best_first:
            if kept < room and alive[node] and not chosen[node] and counts[kinds[node]] < quota:
                chosen[node] = True
                counts[kinds[node]] += 1
                beam[kept] = node
                kept += 1
        quota *= 2
    return kept


@kernel
def search_world(cars, tags, world, tries, settings, width, depth, plan):
    """Find a sequence of actions with a high sum of rewards for one world by beam search, leaving the world as it is.

    Every node is a copy of the world, two generations of them at a time: the beam's nodes are places in one array, and
    their successors are written to the other. What was taken where is kept for all generations to read the plan back.

    Args:
        cars: the world to start from, with the next two.
        tags: see `cars`.
        world: see `cars`.
        tries: int64, indices into ``settings.actions``; of equal plans the one that comes earlier here is taken.
        settings: the configuration.
        width: nodes kept per decision.
        depth: decisions to look ahead.
        plan: int64 (depth,), overwritten up to the plan's length.

    Returns:
        the return of the plan and its length.
    """
    places = width * len(tries)
    all_cars = np.empty((2, places, cars.shape[0], cars.shape[1]))
    all_tags = np.empty((2, places, tags.shape[0], tags.shape[1]), np.int64)
    all_world = np.empty((2, places, world.shape[0]))
    all_returns = np.zeros((2, places))
    parents = np.empty((depth, places), np.int64)
    taken = np.empty((depth, places), np.int64)
    kinds = np.empty(places, np.int64)
    alive = np.empty(places, np.bool_)
    beam = np.zeros(width, np.int64)
    found = np.empty(len(tries), np.int64)
    vehicles, speeds = cars.shape[1], len(settings.target_speeds)
    counts = np.empty(settings.lanes * vehicles * speeds, np.int64)
    info = np.empty(INFO_COLUMNS)

    all_cars[0, 0], all_tags[0, 0], all_world[0, 0] = cars, tags, world
    kept = 1
    best, best_length, best_node = -np.inf, 0, 0
    for t in range(depth):
        now, then = t % 2, (t + 1) % 2
        node = 0
        for parent in beam[:kept]:
            old_cars, old_tags, old_world = all_cars[now, parent], all_tags[now, parent], all_world[now, parent]
            for k in range(distinct(old_cars, old_tags, old_world, tries, settings, found)):
                new_cars, new_tags, new_world = all_cars[then, node], all_tags[then, node], all_world[then, node]
                new_cars[:], new_tags[:], new_world[:] = old_cars, old_tags, old_world
                action = settings.actions[found[k]]
                earned, terminated, truncated = step_world(new_cars, new_tags, new_world, action, settings, info)
                total = all_returns[now, parent] + earned
                all_returns[then, node] = total
                parents[t, node], taken[t, node] = parent, found[k]
                alive[node] = not (terminated or truncated)
                # Nodes are alike if the ego heads for the same lane, has as many vehicles behind it and is as fast.
                kinds[node] = new_tags[TARGET_LANE, 0] * vehicles + new_tags[RANK, 0]
                kinds[node] = kinds[node] * speeds + nearest_speed_index(new_cars[SPEED, 0], settings.target_speeds)
                if (not alive[node] or t == depth - 1) and total > best:
                    best, best_length, best_node = total, t + 1, node
                node += 1
        kept = select(all_returns[then, :node], kinds[:node], alive[:node], counts, beam)
        if kept == 0:
            break
    node = best_node
    for t in range(best_length - 1, -1, -1):
        plan[t] = taken[t, node]
        node = parents[t, node]
    return best, best_length


@kernel
def can_avoid_crash(cars, tags, world, tries, settings, depth):
    """Whether some sequence of `depth` actions keeps one world from crashing: depth first, up to the first that does.

    The arguments are those of :func:`search_world`.
    """
    if tags[CRASHED, 0]:
        return False
    if world[TERMINATED] != 0.0 or world[TRUNCATED] != 0.0:
        return True
    all_cars = np.empty((depth + 1, cars.shape[0], cars.shape[1]))
    all_tags = np.empty((depth + 1, tags.shape[0], tags.shape[1]), np.int64)
    all_world = np.empty((depth + 1, world.shape[0]))
    found = np.empty((depth, len(tries)), np.int64)
    left = np.zeros(depth, np.int64)
    info = np.empty(INFO_COLUMNS)
    all_cars[0], all_tags[0], all_world[0] = cars, tags, world
    left[0] = distinct(all_cars[0], all_tags[0], all_world[0], tries, settings, found[0])
    t = 0
    while t >= 0:
        if left[t] == 0:
            t -= 1
            continue
        left[t] -= 1
        action = settings.actions[found[t, left[t]]]
        new_cars, new_tags, new_world = all_cars[t + 1], all_tags[t + 1], all_world[t + 1]
        new_cars[:], new_tags[:], new_world[:] = all_cars[t], all_tags[t], all_world[t]
        _, terminated, truncated = step_world(new_cars, new_tags, new_world, action, settings, info)
        if new_tags[CRASHED, 0]:
            continue
        t += 1
        if t == depth or terminated or truncated:
            return True
        left[t] = distinct(new_cars, new_tags, new_world, tries, settings, found[t])
    return False


@kernel
def unavoidable_worlds(state, tries, settings, depth, doomed):
    """Overwrite `doomed`, bool (B,): whether every sequence of `depth` actions crashes the world."""
    for i in range(len(doomed)):
        doomed[i] = not can_avoid_crash(state.cars[i], state.tags[i], state.world[i], tries, settings, depth)
