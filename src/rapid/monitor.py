"""A monitor over two policies: one drives while what is seen can be true, the other once it cannot.

A car knows its speed and place from its own actions (:mod:`rapid.networks.memory`), and other cars move no faster than
cars can. While what is seen agrees with both, the *calm* policy drives; from the first contradiction to the end of the
episode the *wary* one does, which was trained under attack. It is the Simplex architecture (Sha, 2001: "Using
simplicity to control complexity"): a rule decides between a controller that performs and one that endures.

The rule itself is not differentiated: an attack that follows gradients sees the policy that drives. Nothing here is a
guarantee: a lie that contradicts neither the car's memory nor the way cars move is not noticed. And it is for exact
sensors, as a simulator's are: one that errs by more than this is taken for a lie, and the wary policy drives.

Shapes: B batch, V vehicles, F features, A actions, S entries of a state, R some rows of a batch.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rapid.networks.memory import SPEED, STATE_SIZE, ego_bounds, initial_state, next_state
from rapid.road import LANE_WIDTH, SIGHT
from rapid.scenarios import NUM_FEATURES

SPEED_ERROR = 0.05
"""m/s by which the ego's speed may be seen wrong: what it knows of its own is exact but for rounding."""
PLACE_ERROR = 8.0
"""Metres by which its place may lie outside of what is known of it, which is not known exactly."""
SLOWER_BY, FASTER_BY = 22.0, 6.5
"""m/s by which another car's speed may have changed within a second: a driver brakes or speeds up by 6 at most, and a
car that crashes keeps a third of its speed."""
STRAY = 2.5
"""Metres by which its way may differ from what both speeds, the one before and the one now, would have made of it."""
ASIDE, ASIDE_SPEED = 5.0, 6.5
"""Metres that it may move across the road within a second, or be pushed by a crash, and m/s."""
COMING = 22.0
"""Metres from the edge of what is seen within which a car may have come or gone since."""
CRUISE, STRAIGHT, OFF_LANE = 8.0, 0.02, 1.0
"""A car that is faster than this along the road and slower than this across it [m/s] is at most so far from the middle
of a lane [m]."""
FIRST_SPEEDS, FIRST_ERROR = (21.0, 24.0), 0.05
"""Where an episode begins, other cars drive in the middle of lanes and straight on, so fast [m/s], but for this."""


def own_size(vehicles: int) -> int:
    """Return S of what the monitor itself remembers: the doubt, what the car knows, and what was seen before."""
    return 1 + STATE_SIZE + vehicles * NUM_FEATURES


def own_start(worlds: int, vehicles: int, lanes: int) -> NDArray[np.float32]:
    """Return what the monitor itself remembers (B, S) where an episode begins."""
    own_BS = np.zeros((worlds, own_size(vehicles)), np.float32)
    own_BS[:, 1 : 1 + STATE_SIZE] = initial_state(worlds, lanes)
    return own_BS


def own_next(own_BS: NDArray[np.float32], action_B: NDArray[np.int64], lanes: int) -> NDArray[np.float32]:
    """Return what the monitor itself remembers (B, S) after these actions."""
    moved_BS = own_BS.copy()
    moved_BS[:, 1 : 1 + STATE_SIZE] = next_state(own_BS[:, 1 : 1 + STATE_SIZE], action_B, lanes)
    return moved_BS


class MonitorState(NamedTuple):
    """What a monitored agent remembers of an episode, taken apart."""

    doubted_B: Tensor
    """Whether anything that was seen was a contradiction."""
    own_BS: Tensor
    """What the car knows by itself."""
    before_BVF: Tensor
    """What was seen at the decision before; zeros, where nobody is present, at the first."""
    calm_BS: Tensor
    """The state of the calm policy, without entries if it has no memory."""
    wary_BS: Tensor
    """That of the wary one."""


class MonitoredNetwork(nn.Module):
    """Two networks and the rule between them: what a gradient attack differentiates.

    Args:
        calm: drives while nothing contradicts.
        wary: drives from then on.
        calm_size: S of the calm network's state, 0 without a memory.
        vehicles: V of both.
        lanes: lanes of the road.
    """

    def __init__(self, calm: nn.Module, wary: nn.Module, calm_size: int, vehicles: int, lanes: int) -> None:
        super().__init__()
        self.calm, self.wary = calm, wary
        self.calm_size, self.vehicles, self.lanes = calm_size, vehicles, lanes

    @property
    def own_size(self) -> int:
        """S of what the monitor itself remembers; the states of the two policies follow."""
        return own_size(self.vehicles)

    def parts(self, state_BS: Tensor) -> MonitorState:
        """Return the parts of a state (B, S)."""
        own_BS, calm_BS, wary_BS = state_BS.tensor_split([self.own_size, self.own_size + self.calm_size], 1)
        doubted_B1, memory_BS, before_BS = own_BS.tensor_split([1, 1 + STATE_SIZE], 1)
        before_BVF = before_BS.unflatten(1, (self.vehicles, NUM_FEATURES))
        return MonitorState(doubted_B1[:, 0] > 0.5, memory_BS, before_BVF, calm_BS, wary_BS)

    @torch.no_grad()
    def doubts(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return whether something that is seen, or was seen before in the episode, cannot be true (B,)."""
        state = self.parts(state_BS)
        return state.doubted_B | contradicts(obs_BVF, state.own_BS, state.before_BVF, self.lanes)

    def forward(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return the Q-values (B, A) of the policy that drives."""
        state, doubted_B = self.parts(state_BS), self.doubts(obs_BVF, state_BS)
        calm_R, wary_R = (~doubted_B).nonzero()[:, 0], doubted_B.nonzero()[:, 0]
        found = [
            _values(network, obs_BVF[rows_R], own_BS[rows_R])
            for network, own_BS, rows_R in ((self.calm, state.calm_BS, calm_R), (self.wary, state.wary_BS, wary_R))
            if len(rows_R) or not len(obs_BVF)
        ]
        # Back in the order of the batch.
        return torch.cat(found).index_select(0, torch.cat([calm_R, wary_R]).argsort())


def contradicts(obs_BVF: Tensor, own_BS: Tensor, before_BVF: Tensor, lanes: int) -> Tensor:
    """Return whether what is seen cannot be true (B,), given what the car knows and what was seen a second before.

    That is: the ego is seen elsewhere, or at another speed, than its own actions brought it to; or other cars are seen
    where, or as fast as, none can be.
    """
    lowest_B4, highest_B4 = ego_bounds(own_BS, lanes)
    ego_BF = obs_BVF[:, 0]
    x_B, least_B, most_B = ego_BF[:, 1], lowest_B4[:, 0] - PLACE_ERROR, highest_B4[:, 0] + PLACE_ERROR
    wrong_speed_B = (torch.hypot(ego_BF[:, 3], ego_BF[:, 4]) - own_BS[:, SPEED]).abs() > SPEED_ERROR
    ego_B = wrong_speed_B | (x_B < least_B) | (x_B > most_B)
    first_B = before_BVF[:, 0, 0] < 0.5
    others_B = torch.where(first_B, impossible_start(obs_BVF), impossible_move(obs_BVF, before_BVF))
    return ego_B | others_B | impossible_sight(obs_BVF)


def impossible_sight(obs_BVF: Tensor) -> Tensor:
    """Return whether another car drives as none does (B,): too fast across the road, or straight on between lanes."""
    here_BV, (_, across_BV, along_speed_BV, across_speed_BV) = obs_BVF[:, 1:, 0] > 0.5, obs_BVF[:, 1:, 1:].unbind(-1)
    straight_BV = (along_speed_BV > CRUISE) & (across_speed_BV.abs() < STRAIGHT)
    between_BV = straight_BV & (_off_lane(across_BV) > OFF_LANE)
    return (here_BV & (between_BV | (across_speed_BV.abs() > ASIDE_SPEED))).any(1)


def impossible_start(obs_BVF: Tensor) -> Tensor:
    """Return whether another car is seen as none is where an episode begins (B,)."""
    here_BV, (_, across_BV, along_speed_BV, across_speed_BV) = obs_BVF[:, 1:, 0] > 0.5, obs_BVF[:, 1:, 1:].unbind(-1)
    least, most = FIRST_SPEEDS[0] - FIRST_ERROR, FIRST_SPEEDS[1] + FIRST_ERROR
    wrong_speed_BV = (along_speed_BV < least) | (along_speed_BV > most) | (across_speed_BV.abs() > FIRST_ERROR)
    return (here_BV & (wrong_speed_BV | (_off_lane(across_BV) > FIRST_ERROR))).any(1)


def impossible_move(obs_BVF: Tensor, before_BVF: Tensor) -> Tensor:
    """Return whether other cars are seen that cannot be, given what was seen a second before (B,).

    Each car that is seen must be one that was seen before, as far and as fast as cars move, or have come into view; and
    each that was seen before must still be seen, or have left it.
    """
    now_BVF, was_BVF = obs_BVF[:, 1:], before_BVF[:, 1:]
    here_BV, there_BV = now_BVF[..., 0] > 0.5, was_BVF[..., 0] > 0.5
    expected_BV = was_BVF[..., 1] + was_BVF[..., 3]
    # (B, cars now, cars before)
    along_BVV = now_BVF[:, :, None, 1] - expected_BV[:, None]
    across_BVV = now_BVF[:, :, None, 2] - was_BVF[:, None, :, 2]
    faster_BVV = now_BVF[:, :, None, 3] - was_BVF[:, None, :, 3]
    possible_BVV = (
        (along_BVV >= faster_BVV.clamp(max=0) - STRAY)
        & (along_BVV <= faster_BVV.clamp(min=0) + STRAY)
        & (faster_BVV >= -SLOWER_BY)
        & (faster_BVV <= FASTER_BY)
        & (across_BVV.abs() <= ASIDE)
        & here_BV[:, :, None]
        & there_BV[:, None]
    )
    from_BV = now_BVF[..., 1] - now_BVF[..., 3]
    came_BV = here_BV & ~possible_BVV.any(2) & _well_in_view(from_BV, before_BVF)
    went_BV = there_BV & ~possible_BVV.any(1) & _well_in_view(expected_BV, obs_BVF)
    return (came_BV | went_BV).any(1)


def _off_lane(across_BV: Tensor) -> Tensor:
    """Return how far from the middle of the nearest lane that is [m]."""
    return (across_BV - (across_BV / LANE_WIDTH).round() * LANE_WIDTH).abs()


def _well_in_view(x_BV: Tensor, obs_BVF: Tensor) -> Tensor:
    """Return whether a car at these places [m] was surely among those seen: they are the nearest, or all in sight."""
    ego_B1 = obs_BVF[:, :1, 1]
    present_BV = obs_BVF[:, 1:, 0] > 0.5
    away_BV = (obs_BVF[:, 1:, 1] - ego_B1).abs()
    farthest_B = torch.where(present_BV.all(1), away_BV.amax(1), SIGHT)
    return (x_BV - ego_B1).abs() < farthest_B[:, None] - COMING


def _values(network: nn.Module, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
    return network(obs_BVF, state_BS) if state_BS.shape[1] else network(obs_BVF)
