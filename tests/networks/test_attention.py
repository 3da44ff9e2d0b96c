"""The compiled attention against torch's."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from rapid.config import NetworkConfig
from rapid.networks.attention import LANES, WIDTH, attend, can_attend
from rapid.networks.blocks import compiled_attention
from rapid.networks.q_network import build_network


def theirs(rows: Tensor, length: int, heads: int, mask: Tensor | None) -> Tensor:
    query, key, value = rows.view(-1, length, 3, heads, WIDTH).permute(2, 0, 3, 1, 4)
    attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
    return attended.transpose(1, 2).reshape(-1, heads * WIDTH)


def drawn(batch: int, length: int, heads: int, scale: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(length)
    rows = scale * torch.randn(batch * length, 3 * heads * WIDTH, generator=generator)
    present = torch.rand(batch, length, generator=generator) > 0.4
    present[:, 0] = True
    gradient = torch.randn(batch * length, heads * WIDTH, generator=generator)
    return rows, torch.where(present, 0.0, -torch.inf)[:, None, None], gradient


@pytest.mark.parametrize("length", [1, 2, 15, 16])
@pytest.mark.parametrize("heads", [1, 2])
@pytest.mark.parametrize("masked", [True, False])
def test_it_is_torchs_within_a_millionth_and_so_is_its_gradient(length: int, heads: int, masked: bool):
    rows, mask, gradient = drawn(33, length, heads)
    mask = mask if masked else None
    exact = rows.double().requires_grad_()
    expected = theirs(exact, length, heads, None if mask is None else mask.double())
    (wanted,) = torch.autograd.grad(expected, exact, gradient.double())
    rows.requires_grad_()
    found = attend(rows, length, heads, mask)
    (own,) = torch.autograd.grad(found, rows, gradient)
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=2e-6)
    torch.testing.assert_close(own.double(), wanted, rtol=1e-6, atol=4e-6)


def test_scores_far_apart_neither_overflow_nor_lose_the_sum():
    rows, mask, _ = drawn(16, 15, 1, scale=30.0)
    found, expected = attend(rows, 15, 1, mask), theirs(rows.double(), 15, 1, mask.double())
    assert found.isfinite().all()
    torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-3)


def test_what_is_hidden_changes_no_bit_and_what_is_no_number_shows():
    rows, mask, _ = drawn(8, 15, 1)
    hidden = (mask[:, 0, 0] != 0).flatten()
    other = rows.clone()
    other[hidden, WIDTH:] = 7.0
    same = attend(rows, 15, 1, mask) == attend(other, 15, 1, mask)
    assert same[~hidden].all()
    rows[0] = torch.nan
    assert attend(rows, 15, 1, mask)[:15].isnan().any()


def test_it_is_only_asked_for_what_it_is_made_for():
    rows = torch.zeros(32, 2 * WIDTH)
    assert can_attend(rows, 16, 2)
    assert not can_attend(rows, LANES + 1, 2)
    assert not can_attend(rows, 16, 1)
    assert not can_attend(rows.double(), 16, 2)


@pytest.mark.parametrize("config", [NetworkConfig(), NetworkConfig(kind="attentive"), NetworkConfig(width=16)])
def test_a_network_gives_the_same_values_and_afterwards_the_same_bits(config: NetworkConfig):
    observations = 20 * torch.randn(8, 15, 5, generator=torch.Generator().manual_seed(0))
    observations[..., 0] = (torch.arange(15) < 11).float()
    network = build_network(config, 3, 0)
    if network.gate is not None:
        torch.nn.init.constant_(network.gate, 0.3)
    before = network(observations)
    with compiled_attention(network):
        within = network(observations)
        with torch.inference_mode():
            assert torch.equal(network(observations), within)
    torch.testing.assert_close(within, before, rtol=1e-6, atol=2e-6)
    assert torch.equal(network(observations), before)
