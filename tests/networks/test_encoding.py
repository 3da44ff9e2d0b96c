"""What networks read: ranges, ego-relative features, absent rows."""

import math

import pytest
import torch

from rapid.networks.encoding import Encoding, feature_scale, normalize


@pytest.mark.parametrize("lanes", [3, 5])
def test_the_ranges_are_those_by_which_highway_env_normalises(lanes):
    observation = pytest.importorskip("highway_env.envs.common.observation")
    vehicle = pytest.importorskip("highway_env.vehicle.kinematics").Vehicle
    lane = pytest.importorskip("highway_env.road.lane").AbstractLane
    assert observation is not None
    _, x, y, vx, vy = feature_scale(lanes).tolist()
    assert (x, y) == (5 * vehicle.MAX_SPEED, lane.DEFAULT_WIDTH * lanes)
    assert vx == vy == 2 * vehicle.MAX_SPEED


def test_normalize_is_not_clipped_and_is_undone(roads):
    scale = feature_scale(3)
    obs = roads(4)
    obs[0, 0, 1] = 900.0
    normalized = normalize(obs, scale)
    assert normalized[0, 0, 1] == 4.5
    assert torch.equal(normalized[..., 0], obs[..., 0])
    assert torch.allclose(normalized * scale, obs, rtol=1e-6, atol=0)


def test_ego_relative_features_by_hand():
    obs = torch.zeros(1, 15, 5)
    obs[0, 0] = torch.tensor([1, 300, 4, 20, 1])
    obs[0, 1] = torch.tensor([1, 350, 8, 15, 0])
    features, mask = Encoding("ego", lanes=3, mask_absent=True)(obs)
    assert features[0, 0].tolist() == pytest.approx([1, 0, 1, 2, 0.2])
    assert features[0, 1].tolist() == pytest.approx([1, 1, 1, -0.5, -0.2])
    assert features[0, 2].tolist() == [0] * 5
    assert mask is not None
    assert mask[0, 0, 0].tolist() == [0.0, 0.0] + [-torch.inf] * 13


def test_near_features_by_hand():
    obs = torch.zeros(1, 15, 5)
    obs[0, 0] = torch.tensor([1, 300, 4, 20, 1])
    obs[0, 1] = torch.tensor([1, 340, 7, 15, 0])
    features, _ = Encoding("near", lanes=3, mask_absent=True)(obs)
    plain, _ = Encoding("ego", lanes=3, mask_absent=True)(obs)
    assert torch.equal(features[..., :5], plain)
    assert features[0, 1, 5:].tolist() == pytest.approx([40 / 50, math.exp(-1), -5 / 50])
    assert features[0, 2].tolist() == [0] * 8


def test_the_mirror_by_hand():
    obs = torch.zeros(1, 15, 5)
    # With a clock the ego's presence is more than 1.
    obs[0, 0] = torch.tensor([1.5, 300, 4, 20, 1])
    obs[0, 1] = torch.tensor([1, 350, 12, 15, 0])
    encoding = Encoding("near", lanes=4, mask_absent=True)
    mirrored = encoding.mirrored(obs)
    assert mirrored[0, 0].tolist() == [1.5, 300, 8, 20, -1]
    assert mirrored[0, 1].tolist() == [1, 350, 0, 15, 0]
    assert torch.equal(mirrored[0, 2:], obs[0, 2:])
    assert torch.equal(encoding.mirrored(mirrored), obs)


def test_ego_relative_features_do_not_depend_on_where_along_the_road(roads):
    obs = roads(3, absent=0)
    moved = obs.clone()
    moved[..., 1] += 128
    encoding = Encoding("ego", 3, mask_absent=True)
    assert torch.allclose(encoding(obs)[0], encoding(moved)[0], atol=1e-5)


def test_raw_is_raw_and_the_ego_is_never_hidden(roads):
    obs = roads(2)
    features, mask = Encoding("raw", 3, mask_absent=False)(obs)
    assert torch.equal(features, obs)
    assert mask is None
    _, mask = Encoding("raw", 3, mask_absent=True)(torch.zeros(1, 15, 5))
    assert mask is not None
    assert mask[0, 0, 0, 0] == 0
