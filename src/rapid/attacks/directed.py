"""Attacks towards actions: not any wrong one, but the one that is wanted, wherever some point of the ball reaches it.

An untargeted attack leads to whichever action lies nearest, and that is often SLOWER, which harms little. Leading all
cars to speed up, or to change lanes, harms much more.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from rapid.attacks.draws import Source, chosen
from rapid.attacks.search import Aim, Ball, Runs, Values, ascend, own_action, values_at
from rapid.attacks.spec import Target
from rapid.attacks.square import squares
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, SLOWER

ORDERS: dict[Target, tuple[int, ...]] = {
    "faster": (FASTER, IDLE, LANE_RIGHT, LANE_LEFT, SLOWER),
    "idle": (IDLE, FASTER, LANE_RIGHT, LANE_LEFT, SLOWER),
    "sideways": (LANE_LEFT, LANE_RIGHT, FASTER, IDLE, SLOWER),
    "slower": (SLOWER, IDLE, LANE_RIGHT, LANE_LEFT, FASTER),
}
"""The actions in the order in which an attack wants them."""


def direct(values: Values, obs_BVF: Tensor, order: Sequence[int], ball: Ball, runs: Runs, source: Source) -> Tensor:
    """Return observations (B, V, F) at which the agent takes the first action of `order` that is found to be in reach.

    Where no action before the agent's own is found, the observation stays true.

    Args:
        values: the network that is attacked.
        obs_BVF: the true observations, metres and m/s.
        order: all actions, the one that is wanted most first.
        ball: what may be shown.
        runs: how hard is searched for each action.
        source: of random starts.
    """
    own = own_action(values, obs_BVF, "toward")
    seen_BVF = obs_BVF.clone()
    open_B = torch.ones(len(obs_BVF), dtype=torch.bool, device=obs_BVF.device)
    for action in order:
        open_B &= own.action_B != action
        rows_R = open_B.nonzero().squeeze(1)
        if not len(rows_R):
            break
        aim = Aim("toward", torch.full_like(rows_R, action), own.true_q_BA[rows_R])
        some = values_at(values, rows_R)
        found_RVF = ascend(some, obs_BVF[rows_R], aim, ball, runs, chosen(source, rows_R.tolist()))
        reached_R = _taken(some, found_RVF) == action
        seen_BVF[rows_R[reached_R]] = found_RVF[reached_R]
        open_B[rows_R[reached_R]] = False
    return seen_BVF


def reachable(values: Values, obs_BVF: Tensor, ball: Ball, runs: Runs, source: Source) -> tuple[Tensor, Tensor]:
    """Return which actions the agent is found to take somewhere in the ball (B, A), and such points (B, A, V, F).

    What is not found may be in reach all the same: this is a lower bound of what an attacker can do.
    """

    def search(some: Values, true_RVF: Tensor, aim: Aim, source: Source) -> Tensor:
        return ascend(some, true_RVF, aim, ball, runs, source)

    return _reach(values, obs_BVF, search, source)


def reachable_without_gradients(
    values: Values, obs_BVF: Tensor, ball: Ball, queries: int, source: Source
) -> tuple[Tensor, Tensor]:
    """Return what :func:`reachable` does, by random search with so many points for each action."""

    def search(some: Values, true_RVF: Tensor, aim: Aim, source: Source) -> Tensor:
        return squares(some, true_RVF, aim, ball, queries, source)

    return _reach(values, obs_BVF, search, source)


def _reach(
    values: Values, obs_BVF: Tensor, search: Callable[[Values, Tensor, Aim, Source], Tensor], source: Source
) -> tuple[Tensor, Tensor]:
    own = own_action(values, obs_BVF, "toward")
    within_BA = torch.nn.functional.one_hot(own.action_B, NUM_ACTIONS).bool()
    points_BAVF = obs_BVF[:, None].repeat(1, NUM_ACTIONS, 1, 1)
    others_R2 = (~within_BA).nonzero()
    rows_R, action_R = others_R2[:, 0], others_R2[:, 1]
    aim = Aim("toward", action_R, own.true_q_BA[rows_R])
    some = values_at(values, rows_R)
    found_RVF = search(some, obs_BVF[rows_R], aim, chosen(source, rows_R.tolist()))
    within_BA[rows_R, action_R] = _taken(some, found_RVF) == action_R
    points_BAVF[rows_R, action_R] = found_RVF
    return within_BA, points_BAVF


@torch.no_grad()
def _taken(values: Values, obs_BVF: Tensor) -> Tensor:
    return values(obs_BVF).argmax(1)
