"""What a car knows by itself, whatever is done to its eyes: a network's memory, and how it reaches the network.

The state is dead-reckoned from the car's own actions alone: how many steps it has driven, the speed that it keeps to
and has, the lanes that it can be on, how far it has come. No attack on observations moves it. It begins anew with every
episode, and each world has its own.

Shapes: B batch, V vehicles, F features, S entries of a state, M entries of knowledge, D width, N policies.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rapid.config_learning import NetworkConfig
from rapid.road import LANE_WIDTH, START_SPEED
from rapid.scenarios import FASTER, LANE_LEFT, LANE_RIGHT, SLOWER, TARGET_SPEEDS

STEPS, SPEED_INDEX, SPEED, LEFTMOST, RIGHTMOST, DISTANCE = range(6)
STATE_SIZE = 6
"""S: steps driven, index of the speed kept to, speed [m/s], the lanes it can be on, distance driven [m]."""
HIDDEN = 32
"""Width of the layer behind what is known."""
EPISODE = 30
"""Decisions of an episode."""
START_INDEX = 6
"""Of the target speed nearest to that with which an episode begins."""
KNOWN = EPISODE + len(TARGET_SPEEDS) + 6
"""M: what is known at a decision (:meth:`Memory.knowledge`)."""
START_TOLERANCE = 5.5
"""Metres before or behind its place that it may begin."""
DELAY, SLANT = 0.4, 1.5
"""Metres a decision and m/s that it may lose along the road by driving across it."""
ROUNDING = 0.01
"""m/s."""
SPEED_STEP = TARGET_SPEEDS[1] - TARGET_SPEEDS[0]
LAG = (1 - 1 / 9) ** 15
"""Share of a difference in speed that is left after a decision: 15 frames, each of which takes off a ninth."""
LAG_DISTANCE = (1 - LAG) / (15 / 9)
"""Metres driven more in a decision for each m/s above the speed kept to."""
TRAFFIC_SPEED = 21.0
"""m/s that every other car is taken to drive where features are squeezed."""


def initial_state(count: int, lanes: int) -> NDArray[np.float32]:
    """Return the states (B, S) with which episodes begin: nothing done yet, any lane possible."""
    return np.tile(np.array([0, START_INDEX, START_SPEED, 0, lanes - 1, 0], np.float32), (count, 1))


def next_state(state_BS: NDArray[np.float32], action_B: NDArray[np.int64], lanes: int) -> NDArray[np.float32]:
    """Return the states (B, S) after these actions.

    The speed is exact on a free road with the dynamics of ``highway-v0``: a target speed is kept to by a known law. Of
    the lane, a range is known: an action moves both its ends, until the edge of the road.
    """
    index_B, speed_B = state_BS[:, SPEED_INDEX], state_BS[:, SPEED]
    nearest_B = np.rint(speed_B / SPEED_STEP)
    change_B = (action_B == FASTER).astype(np.float32) - (action_B == SLOWER)
    index_B = np.where(change_B != 0, np.clip(nearest_B + change_B, 0, len(TARGET_SPEEDS) - 1), index_B)
    target_B = index_B * SPEED_STEP
    above_B = speed_B - target_B
    moved_B = (action_B == LANE_RIGHT).astype(np.float32) - (action_B == LANE_LEFT)
    return np.stack(
        [
            state_BS[:, STEPS] + 1,
            index_B,
            target_B + LAG * above_B,
            np.clip(state_BS[:, LEFTMOST] + moved_B, 0, lanes - 1),
            np.clip(state_BS[:, RIGHTMOST] + moved_B, 0, lanes - 1),
            state_BS[:, DISTANCE] + target_B + LAG_DISTANCE * above_B,
        ],
        1,
    ).astype(np.float32)


def start_x(lanes: int) -> float:
    """Return where along the road highway-env places the ego, within 2.5 % [m]: four gaps of twice the usual length."""
    return 4 * 2 * (12 + START_SPEED) * math.exp(-lanes / 8)


def ego_bounds(state_BS: Tensor, lanes: int) -> tuple[Tensor, Tensor]:
    """Return the least and the most that x, y, vx and vy of the ego can be (B, 4), by what is known of it.

    Its place along the road is that of its start and what it drove, its speed its own; of y nothing is said.
    """
    place_B, speed_B = start_x(lanes) + state_BS[:, DISTANCE], state_BS[:, SPEED]
    late_B = place_B - START_TOLERANCE - DELAY * state_BS[:, STEPS]
    any_B, most_B = torch.full_like(late_B, torch.inf), speed_B + ROUNDING
    lowest_B4 = torch.stack([late_B, -any_B, speed_B - SLANT, -most_B], 1)
    return lowest_B4, torch.stack([place_B + START_TOLERANCE, any_B, most_B, most_B], 1)


class Recalled(NamedTuple):
    """What memory adds inside the network; zeros as long as it has learned nothing."""

    token_BD: Tensor
    """To every token of the adapters."""
    action_BD: Tensor
    """To the token that the Q-values are read from."""
    router_BN: Tensor
    """To the router's scores."""


class Memory(nn.Module):
    """Reads the state and how far what is seen of the ego differs from it; no policy 1 ever hears of it.

    Where features are squeezed it reads the state alone, and all policies read less (:meth:`squeezed`).

    Args:
        config: the network's settings.
        lanes: lanes of the road.
    """

    def __init__(self, config: NetworkConfig, lanes: int) -> None:
        super().__init__()
        self.lanes, self.squeeze = lanes, config.squeeze
        policies = config.num_policies if config.kind == "rapid" else 1
        self.hidden = nn.Linear(KNOWN, HIDDEN)
        self.out = nn.Linear(HIDDEN, 2 * config.width + policies, bias=False)
        self.sizes = [config.width, config.width, policies]
        self.start_x = start_x(lanes)

    def believed(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return the observations (B, V, F) with the ego's own row within what is known of it.

        Its place along the road is that of its start and what it drove, its speed its own. What is true lies within, so
        that without an attack nothing changes; and an attack on this row hardly moves how near the others seem.

        Where features are squeezed (:meth:`squeezed`) that goes for every row.
        """
        if self.squeeze:
            return self.squeezed(obs_BVF, state_BS)
        lowest_B4, highest_B4 = ego_bounds(state_BS, self.lanes)
        ego_B4 = torch.minimum(torch.maximum(obs_BVF[:, 0, 1:], lowest_B4), highest_B4)
        return torch.cat([torch.cat([obs_BVF[:, 0, :1], ego_B4], 1)[:, None], obs_BVF[:, 1:]], 1)

    def squeezed(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return the observations (B, V, F) with nothing in them that an attack within 0.1 could bend far.

        "Feature squeezing" (Xu et al., 2018), with what is known of roads and cars. Of the ego, place and speed are its
        own; its lane is one that it can be on. Of the others, place and presence are read as they are, y as the middle
        of the nearest lane, and speeds as those of usual traffic. A car in the middle of its lane is read the same
        unless y is moved by 2 m. An attack of 0.1 moves it by 1.2 and 1.6 m on three and four lanes, so there it can
        move cars along the road and mislead about who is changing lanes. On five lanes 0.1 are those 2 m, and noise of
        0.2 reaches farther on every road.

        Gradients pass where y is rounded, as if it were not: an attack that follows them is not misled (BPDA; Athalye
        et al., 2018).
        """
        present_BV, x_BV, y_BV, *_ = obs_BVF.unbind(-1)
        # The ego's row is the first, and is known to be within these lanes; the others are on one of the road's.
        least_BV, most_BV = torch.zeros_like(y_BV), torch.full_like(y_BV, self.lanes - 1)
        least_BV[:, 0], most_BV[:, 0] = state_BS[:, LEFTMOST], state_BS[:, RIGHTMOST]
        lane_BV = torch.minimum(torch.maximum((y_BV / LANE_WIDTH).round(), least_BV), most_BV)
        middle_BV = (lane_BV * LANE_WIDTH).detach() + (y_BV - y_BV.detach())
        ahead_BV, speed_BV = x_BV.clone(), torch.where(present_BV > 0.5, TRAFFIC_SPEED, 0.0)
        ahead_BV[:, 0], speed_BV[:, 0] = self.start_x + state_BS[:, DISTANCE], state_BS[:, SPEED]
        return torch.stack([present_BV, ahead_BV, middle_BV, speed_BV, torch.zeros_like(x_BV)], -1)

    def knowledge(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what is known (B, M), scaled to about +-1.

        That is the step and the speed kept to, each as one of so many, so that each can have a plan of its own; the
        speed had, the lanes possible and how many cars are present; none of which an attack that leaves presence alone
        can move. And by how much the ego's seen speed and place differ from what is known; 0 where features are
        squeezed.
        """
        if self.squeeze:
            faster_B = farther_B = torch.zeros_like(state_BS[:, SPEED])
        else:
            faster_B = obs_BVF[:, 0, 3] - state_BS[:, SPEED]
            farther_B = obs_BVF[:, 0, 1] - state_BS[:, DISTANCE] - self.start_x
        most = max(self.lanes - 1, 1)
        present_B = (obs_BVF[..., 0] > 0.5).sum(1) / obs_BVF.shape[1]
        numbers_BK = torch.stack(
            [
                state_BS[:, SPEED] / TARGET_SPEEDS[-1],
                state_BS[:, LEFTMOST] / most,
                state_BS[:, RIGHTMOST] / most,
                present_B,
                faster_B / 4,
                farther_B / 20,
            ],
            1,
        )
        step_BT = _one_of(state_BS[:, STEPS], EPISODE)
        return torch.cat([step_BT, _one_of(state_BS[:, SPEED_INDEX], len(TARGET_SPEEDS)), numbers_BK], 1)

    def forward(self, obs_BVF: Tensor, state_BS: Tensor) -> Recalled:
        """Return what is added inside the network."""
        hidden_BH = nn.functional.relu(self.hidden(self.knowledge(obs_BVF, state_BS)))
        return Recalled(*self.out(hidden_BH).split(self.sizes, 1))


def _one_of(value_B: Tensor, count: int) -> Tensor:
    """Return (B, count): 1 at the value, or at the last if it is beyond; else 0."""
    places = torch.arange(count, device=value_B.device)
    return (value_B.clamp(max=count - 1)[:, None] == places).to(value_B.dtype)
