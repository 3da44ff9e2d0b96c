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

from rapid.defences import matched
from rapid.networks.memory import SPEED, STATE_SIZE, ego_bounds, initial_state, next_state
from rapid.scenarios import NUM_FEATURES

SPEED_ERROR = 0.05
"""m/s by which the ego's speed may be seen wrong: what it knows of its own is exact but for rounding."""
PLACE_ERROR = 2.0
"""Metres by which its place may lie outside of what is known of it, which is not known exactly."""
BEHIND, BEYOND = (9.0, 14.0), (4.75, 5.5)
"""How much less and more than was expected a second before another car's place [m] and speed [m/s] along the road may
be. So hard do drivers brake where episodes begin too dense."""
CARS = 2
"""Cars that must be where none could be; one alone may be another that has come into view beside it."""


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

    That is: the ego is seen elsewhere, or at another speed, than its own actions brought it to; or several cars that
    were seen before are where, or as fast as, no car could be now.
    """
    lowest_B4, highest_B4 = ego_bounds(own_BS, lanes)
    ego_BF = obs_BVF[:, 0]
    x_B, least_B, most_B = ego_BF[:, 1], lowest_B4[:, 0] - PLACE_ERROR, highest_B4[:, 0] + PLACE_ERROR
    wrong_speed_B = (torch.hypot(ego_BF[:, 3], ego_BF[:, 4]) - own_BS[:, SPEED]).abs() > SPEED_ERROR
    ego_B = wrong_speed_B | (x_B < least_B) | (x_B > most_B)

    moved_BV2 = before_BVF[..., 1:3] + before_BVF[..., 3:5]
    expected_BVF = torch.cat([before_BVF[..., :1], moved_BV2, before_BVF[..., 3:]], -1)
    row_BV, known_BV = matched(obs_BVF, expected_BVF)
    known_BV[:, 0] = False
    away_BVF = obs_BVF - expected_BVF.gather(1, row_BV[..., None].expand_as(expected_BVF))
    along_BV, faster_BV = away_BVF[..., 1], away_BVF[..., 3]
    far_BV = (along_BV < -BEHIND[0]) | (along_BV > BEYOND[0]) | (faster_BV < -BEHIND[1]) | (faster_BV > BEYOND[1])
    return ego_B | ((known_BV & far_BV).sum(1) >= CARS)


def _values(network: nn.Module, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
    return network(obs_BVF, state_BS) if state_BS.shape[1] else network(obs_BVF)
