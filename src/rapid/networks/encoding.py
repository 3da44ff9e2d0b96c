"""What a network reads: the raw observation, turned into features inside the network.

Observations arrive as the environment gives them: (B, V, F), float32, metres and m/s, absolute, the ego in row 0.
"""

from typing import Literal

import torch
from torch import Tensor, nn

from rapid.road import LANE_WIDTH, RANGES
from rapid.scenarios import NUM_FEATURES, NUM_VEHICLES

EGO_UNITS = (1.0, 50.0, LANE_WIDTH, 10.0, 5.0)
"""The units of ego-relative features: 50 m along the road, one lane, 10 m/s along, 5 m/s across."""
NEAR = 10.0
"""Metres along the road within which `near` tells distances apart best."""
BESIDE = 3.0
"""Metres across beyond which a car is hardly in the way."""
NEAR_FEATURES = 3
"""Features that `near` adds."""


def num_inputs(kind: str) -> int:
    """Return how many features of a vehicle a network with this encoding reads."""
    return NUM_FEATURES + NEAR_FEATURES if kind == "near" else NUM_FEATURES


def feature_scale(lanes: int) -> Tensor:
    """Return what 1 means in each normalised feature (F,): 1, 200 m, 4*lanes m, 80 m/s, 80 m/s.

    These are the ranges by which highway-env itself normalises observations of a road with `lanes` lanes.
    """
    along, across, speed = RANGES
    return torch.tensor([1.0, along, across * lanes, speed, speed])


def normalize(obs_BVF: Tensor, scale_F: Tensor) -> Tensor:
    """Map the ranges to +-1, without clipping; presence stays as it is."""
    return obs_BVF / scale_F


class Encoding(nn.Module):
    """Observation to features (B, V, F) and an attention mask.

    Args:
        kind: `raw` as it is; `normalized` scaled by :func:`feature_scale`; `ego` relative to the ego in
            :data:`EGO_UNITS`: the ego keeps its lane and speed and loses its x, for the road looks the same everywhere;
            `near` the same and, for each vehicle, x/(|x| + 10 m), how much it is in the ego's way, and how fast it
            closes in for its distance: what decides in traffic lies within some metres of 400.
        lanes: lanes of the road, for the ranges.
        mask_absent: hide rows with presence below one half, apart from the ego's: their features read 0, and
            attention cannot see them.
        vehicles: V, rows of an observation.
    """

    scale_F: Tensor
    unit_F: Tensor
    absent_V1: Tensor
    """Presence up to which a row is absent."""
    relative_VF: Tensor
    """1 where the ego's feature is taken off, in `ego`."""
    far_side_F: Tensor
    """What is added to a feature in the mirror: to y that of the last lane."""
    turned_F: Tensor
    """The sign of a feature in the mirror: y and vy are turned round."""

    def __init__(
        self,
        kind: Literal["raw", "normalized", "ego", "near"],
        lanes: int,
        mask_absent: bool,
        vehicles: int = NUM_VEHICLES,
    ) -> None:
        super().__init__()
        self.kind, self.mask_absent = kind, mask_absent
        self.register_buffer("scale_F", feature_scale(lanes))
        self.register_buffer("unit_F", torch.tensor(EGO_UNITS))
        is_ego_V1 = (torch.arange(vehicles) == 0)[:, None]
        # Row 0 is always the ego, whatever its presence says, and there must be something to attend to.
        self.register_buffer("absent_V1", torch.where(is_ego_V1, -torch.inf, 0.5), persistent=False)
        # Which of the ego's features are taken off: from the others all but presence, from itself x alone.
        kept_VF = torch.tensor([1.0, 0.0, 1.0, 1.0, 1.0]).where(is_ego_V1, torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0]))
        self.register_buffer("relative_VF", 1 - kept_VF, persistent=False)
        self.register_buffer("far_side_F", torch.tensor([0, 0, LANE_WIDTH * (lanes - 1), 0, 0]), persistent=False)
        self.register_buffer("turned_F", torch.tensor([1.0, 1.0, -1.0, 1.0, -1.0]), persistent=False)

    def forward(self, obs_BVF: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the features (B, V, F), with `near` three more, and the mask (B, 1, 1, V) to add to attention scores.

        Without `mask_absent` there is no mask: None.
        """
        features_BVF = self._features(obs_BVF)
        if not self.mask_absent:
            return features_BVF, None
        present_BV1 = obs_BVF[..., :1] > self.absent_V1
        mask_BV = torch.where(present_BV1, 0.0, -torch.inf).squeeze(-1)
        return torch.where(present_BV1, features_BVF, 0.0), mask_BV[:, None, None, :]

    def mirrored(self, obs_BVF: Tensor) -> Tensor:
        """Return the observations as they would be were left right: y from the other side, and vy turned round.

        Rows of absent vehicles stay as they are.
        """
        return torch.where(obs_BVF[..., :1] > self.absent_V1, self.far_side_F + self.turned_F * obs_BVF, obs_BVF)

    def _features(self, obs_BVF: Tensor) -> Tensor:
        if self.kind == "raw":
            return obs_BVF
        if self.kind == "normalized":
            return normalize(obs_BVF, self.scale_F)
        relative_BVF = obs_BVF - obs_BVF[:, :1] * self.relative_VF
        if self.kind == "ego":
            return relative_BVF / self.unit_F
        _, ahead, aside, faster, _ = relative_BVF.split(1, -1)
        distance = ahead.abs() + NEAR
        beside = (-(aside / BESIDE).square()).exp()
        return torch.cat([relative_BVF / self.unit_F, ahead / distance, beside, faster / distance], -1)
