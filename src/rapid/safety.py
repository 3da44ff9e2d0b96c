"""The interval filter: an action passes only if it is safe in every true state that can lie behind what is seen.

An observation is off by at most a box in every feature, except that presence, rounded, is right. Behind it lies a box
of true states; an action is safe in one of them if the ego, having taken it and from then on braking as hard as it
can, stops before it reaches anything ahead. SLOWER always passes: it is what the others are measured by. So whoever
drives through the filter meets no crash that always braking from the same state would not have met, as far as the other
cars keep to what is assumed of them:

* whoever is ahead in the ego's lane or in a lane beside it, and on any lane whoever is slower than :data:`SLOW`, brakes
  with at most the larger of 6 m/s² and its speed per second, which is how a wreck comes to rest; who drives backwards
  goes on for at most :data:`REVERSING`; and what else they give up, pushed or beginning to reverse, is no more than
  :data:`CLEARANCE`;
* whoever else enters the ego's lane ahead does so with room to spare, as MOBIL has it;
* whoever is behind in the ego's lane keeps clear of a car that brakes, and while the ego changes lanes every car behind
  that has its own desired distance (IDM's) to the ego keeps clear as well;
* beyond what is seen, 200 m or the farthest of the rows if all are taken, a wreck may stand on any lane.

`docs/safety.md` says what of this is proven and what was measured. The formulas below are written once, for NumPy
arrays and for torch tensors; the network inside which they filter Q-values is differentiable through them.

Shapes: B batch, V vehicles, N others (V-1), F features, A actions. Metres, m/s, seconds.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.road import CAR_LENGTH, LANE_WIDTH, RANGES, SIGHT
from rapid.scenarios import FASTER, IDLE, NUM_ACTIONS, NUM_FEATURES, SLOWER, TARGET_SPEEDS

SPEED_STEP, TOP_SPEED = TARGET_SPEEDS[1] - TARGET_SPEEDS[0], TARGET_SPEEDS[-1]
LAG = 0.6
"""Seconds: the ego accelerates by (target speed - speed) / LAG."""
DRIFT = 1.03
"""By how much [m/s] an unknown target speed can lie above the speed when a decision is due: FASTER and SLOWER set it at
most 1.5 steps away, and a decision's second leaves 17 % of that (15 frames of 1/15 s; 13 % with 5 of 1/5 s)."""
SIDEWAYS = 6.0
"""The ego's largest speed across the road when a decision is due."""
BRAKING = 6.0
"""m/s²: the hardest that a driver brakes."""
REVERSING = 3.0
"""Seconds for which a car that drives backwards may go on. IDM's drivers do where they stand too close to another."""
CLEARANCE = 10.0
"""Metres between bumpers that are left when both have come to rest: room for a push, or to reverse into."""
NEARBY, NEARBY_SLOW, SLOW = 6.0, 12.0, 8.0
"""Metres across: whose lane is this near to the ego can be in its way, that is cars in the lane it is in or comes into
and in those beside it. Below SLOW m/s a lane change may have begun that has two lanes to go; and other cars that are so
slow may be on their way across the road, forwards or backwards, so they are in the way on whatever lane they are."""
MEMBER = 2.0
"""Metres across from the centre of a lane within which a car belongs to it; beside the road, to the outermost lane."""
TIME_GAP, REAR_GAP, COMFORT = 1.5, 10.0, 2 * float(np.sqrt(15.0))
"""What a driver wants between itself and the car ahead (IDM): 10 m + 1.5 s · v + v · closing speed / COMFORT."""
PENALTY = 0.5
"""How much a Q-value falls for each metre that its action lacks."""


class Box(NamedTuple):
    """How far what is seen may be off in each feature of each row."""

    along: float
    """Metres along the road."""
    across: float
    """Metres across it."""
    speed: float
    """m/s, along and across."""


@lru_cache
def read_box(text: str, lanes: int) -> Box:
    """Return the box that `text` names: a radius such as ``0.1``, or metres and m/s such as ``1m,0.5``.

    A radius is in features scaled to +-1 by highway-env's ranges on a road with `lanes` lanes: 0.1 is 20 m along the
    road, 0.4 m times the number of lanes across it, and 8 m/s.

    Raises:
        RapidError: it is neither, or so large that it could not be told how many cars there are.
    """
    metres, comma, speed = text.partition("m,")
    try:
        values = [float(metres), float(speed)] if comma else [float(text)]
    except ValueError:
        values = [math.nan]
    if not all(0 <= value < math.inf for value in values) or (not comma and values[0] >= 0.5):
        raise RapidError(
            f"The interval filter cannot allow for '{text}'. Expected a radius from 0 to below 0.5 in features scaled "
            "to +-1, such as 0.1, or metres and m/s of at least 0, such as 1m,0.5. From 0.5 on presence, and so the "
            "number of cars, could not be told."
        )
    if comma:
        return Box(values[0], values[0], values[1])
    (radius,) = values
    along, across, speed = RANGES
    return Box(along * radius, across * lanes * radius, speed * radius)


class IntervalFilter:
    """Which actions are safe whatever true state lies in the box around what is seen.

    Args:
        lanes: lanes of the road.
        box: what :func:`read_box` reads; "0" trusts what is seen.

    Raises:
        RapidError: there is no such box.
    """

    def __init__(self, lanes: int, box: str) -> None:
        self.lanes, self.box = lanes, read_box(box, lanes)

    def margins(self, obs_BVF: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the metres to spare after each action in the worst of the true states (B, A); SLOWER has infinitely.

        Raises:
            RapidError: the observations have another shape or are not finite.
        """
        obs_BVF = np.asarray(obs_BVF, np.float64)
        if obs_BVF.ndim != 3 or obs_BVF.shape[2] != NUM_FEATURES or obs_BVF.shape[1] < 2:
            raise RapidError(
                f"The interval filter reads observations (batch, vehicles, {NUM_FEATURES}), raw as a scenario gives "
                f"them; got {obs_BVF.shape}."
            )
        if not np.isfinite(obs_BVF).all():
            raise RapidError("The interval filter was given an observation that is not finite. Check what feeds it.")
        return margins(np, obs_BVF, self.lanes, self.box)

    def passes(self, obs_BVF: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which actions are safe (B, A)."""
        return self.margins(obs_BVF) >= 0

    def filtered(self, q_BA: NDArray[np.floating], obs_BVF: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return Q-values whose greedy action passes (B, A): the best of those that do."""
        return filter_values(np, q_BA, self.margins(obs_BVF)).astype(q_BA.dtype)

    def choose(self, action_B: NDArray[np.integer], obs_BVF: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the actions where they pass and SLOWER elsewhere (B,)."""
        passes_B = np.take_along_axis(self.passes(obs_BVF), action_B[:, None], 1)[:, 0]
        return np.where(passes_B, action_B, SLOWER)


def stopping_distance(xp: Any, speed: Any, action: int) -> Any:
    """Return how far the ego comes if it takes `action` for a decision and then SLOWER for good; an upper bound.

    Under a target speed u the speed obeys dv/dt = (u - v) / LAG, so that a second covers u - LAG * (change of v), to
    the last digit of the simulator's Euler steps too; summed until standstill that is LAG * v and the target speeds.
    SLOWER takes the multiple of 4 m/s below the nearest one.

    Args:
        xp: numpy or torch.
        speed: m/s, at most :data:`TOP_SPEED`.
        action: a meta-action; of those that keep the target speed, which is not seen, the worst is assumed.
    """
    if action == FASTER:
        place = (xp.floor(speed / SPEED_STEP + 0.5) + 1).clip(max=TOP_SPEED / SPEED_STEP)
        first, then = place * SPEED_STEP, place
    elif action == SLOWER:
        first, then = 0.0, xp.floor(speed / SPEED_STEP + 0.5)
    else:
        first = (speed + DRIFT).clip(max=TOP_SPEED)
        then = xp.floor(first / SPEED_STEP + 0.5)
    return LAG * speed + first + SPEED_STEP / 2 * then * (then - 1)


def margins(xp: Any, obs_BVF: Any, lanes: int, box: Box) -> Any:
    """Return :meth:`IntervalFilter.margins` for numpy arrays or torch tensors; `xp` is the module.

    The larger the box, the less the room: it falls by no more than a box says, if what is seen moves within that box.
    So with a box that is taken off, sizes below 0 included, these are upper bounds.
    """
    along, across, faster = box
    ego_BF, others_BNF = obs_BVF[:, 0], obs_BVF[:, 1:]
    present_BN = others_BNF[..., 0] > 0.5
    # Both positions are off.
    distance_BN = others_BNF[..., 1] - obs_BVF[:, :1, 1]
    least_BN, most_BN = distance_BN - 2 * along, distance_BN + 2 * along
    slowest_BN, fastest_BN = others_BNF[..., 3] - faster, (others_BNF[..., 3] + faster).clip(min=0)
    ahead_B, slow_B = (abs(ego_BF[:, 3]) + faster).clip(min=0), (ego_BF[:, 3] - faster).clip(min=0, max=TOP_SPEED)
    aside_B = xp.minimum(abs(ego_BF[:, 4]) + faster, ahead_B).clip(min=0, max=SIDEWAYS)
    speed_B = xp.sqrt(ahead_B * ahead_B + aside_B * aside_B + 1e-6).clip(max=TOP_SPEED)

    nearby_B1 = xp.where(slow_B < SLOW, NEARBY_SLOW, NEARBY)[:, None] + across
    in_way_BN = _on_lanes_nearby(obs_BVF, lanes, MEMBER + across, nearby_B1) | (slowest_BN < SLOW)
    in_way_BN = in_way_BN & present_BN & (most_BN > -CAR_LENGTH)
    # A driver brakes by 6 m/s², a wreck by its speed per second, and who drives backwards may go on.
    halt_BN = xp.where(slowest_BN > BRAKING, slowest_BN - BRAKING / 2, slowest_BN * slowest_BN / (2 * BRAKING))
    halt_BN = xp.where(slowest_BN < 0, REVERSING * slowest_BN, halt_BN)
    room_BN = least_BN - CAR_LENGTH - CLEARANCE
    # Rows are sorted by distance, so what has no row is no nearer than any row. Without a free row that is all.
    nearest_BN = xp.where(present_BN, xp.maximum(least_BN, -most_BN), SIGHT).clip(min=0, max=SIGHT)
    beyond_B = xp.where(present_BN.all(-1), xp.amax(nearest_BN, 1), SIGHT) - CAR_LENGTH - CLEARANCE
    wanted_BN = REAR_GAP + TIME_GAP * fastest_BN + fastest_BN * (fastest_BN - slow_B[:, None]).clip(min=0) / COMFORT
    behind_BN = -most_BN - CAR_LENGTH - wanted_BN

    found: list[Any] = []
    for action in range(NUM_ACTIONS):
        if action == SLOWER:
            found.append(xp.full_like(beyond_B, np.inf))
            continue
        stop_B = stopping_distance(xp, speed_B, action)
        ahead_BN = xp.minimum(room_BN - stop_B[:, None] + halt_BN, room_BN)
        if action in (FASTER, IDLE):
            room = xp.where(in_way_BN, ahead_BN, np.inf)
        else:
            # All lanes are taken: which one is meant is not known while the ego is between two. And who may be ahead
            # or behind must leave room both ways.
            either_BN = xp.minimum(xp.where(most_BN > 0, ahead_BN, np.inf), xp.where(least_BN < 0, behind_BN, np.inf))
            room = xp.where(present_BN, either_BN, np.inf)
        found.append(xp.minimum(xp.amin(room, 1), beyond_B - stop_B))
    return xp.stack(found, 1)


def _on_lanes_nearby(obs_BVF: Any, lanes: int, member: float, nearby_B1: Any) -> Any:
    """Return which of the others may be on a lane that the ego may be on or beside (B, N)."""
    ego_B1, others_BN = obs_BVF[:, :1, 2], obs_BVF[:, 1:, 2].clip(min=0, max=LANE_WIDTH * (lanes - 1))
    found = None
    for lane in range(lanes):
        centre = LANE_WIDTH * lane
        both_BN = (abs(others_BN - centre) < member) & (abs(ego_B1 - centre) < nearby_B1)
        found = both_BN if found is None else found | both_BN
    return found


def filter_values(xp: Any, q_BA: Any, margins_BA: Any) -> Any:
    """Return Q-values (B, A) by which no action that lacks room is the best: SLOWER always lies above those.

    What an action lacks is taken off its value, so that a gradient knows where the boundary is.
    """
    lacking_BA = margins_BA.clip(max=0)
    blocked_BA = xp.minimum(q_BA, q_BA[:, SLOWER:]) - 1 + PENALTY * lacking_BA
    return xp.where(margins_BA >= 0, q_BA, blocked_BA)
