"""The compiled layer against torch's, in float64 and in float32."""

import copy
import threading
from typing import NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from rapid.config import NetworkConfig
from rapid.networks import layer
from rapid.networks.blocks import Block, Projection, compiled_layers
from rapid.networks.denormals import no_denormals
from rapid.networks.q_network import build_network


class Case(NamedTuple):
    """A layer, what it reads, and the gradient of what it gives."""

    block: Block
    closing: nn.LayerNorm | None
    rows: Tensor
    mask: Tensor | None
    first_only: bool
    gradient: Tensor


def drawn(
    batch: int,
    length: int,
    sizes: tuple[int, int, int],
    *,
    first_only: bool = False,
    closes: bool = False,
    share: float = 0.6,
    seed: int = 0,
) -> Case:
    """Draw a layer of a width, heads and feed-forward width; the first key and so large a share of all may be read."""
    generator = torch.Generator().manual_seed(seed)
    block, closing = Block(*sizes), nn.LayerNorm(sizes[0]) if closes else None
    for parameter in [*block.parameters(), *(closing.parameters() if closing else ())]:
        scale = parameter.shape[-1] ** -0.5 if parameter.ndim > 1 else 0.5
        parameter.data = scale * torch.randn(parameter.shape, generator=generator)
    rows = torch.randn(batch * length, sizes[0], generator=generator)
    present = torch.rand(batch, length, generator=generator) < share
    present[:, 0] = True
    mask = torch.where(present, 0.0, -torch.inf)[:, None, None]
    gradient = torch.randn(batch if first_only else batch * length, sizes[0], generator=generator)
    return Case(block, closing, rows, mask, first_only, gradient)


def computed(case: Case, kind: torch.dtype, compiled: bool, learns: bool = True) -> list[Tensor]:
    """Return the rows after the layer and the gradients of the rows before and, if it learns, of all parameters."""
    block, closing = (copy.deepcopy(part).to(kind) if part else None for part in (case.block, case.closing))
    assert isinstance(block, Block)
    parameters = [*block.parameters(), *(closing.parameters() if closing else ())]
    for parameter in parameters:
        parameter.requires_grad_(learns)
    rows = case.rows.to(kind).requires_grad_()
    assert case.mask is not None
    with compiled_layers(*([block] if compiled else [])):
        out = block(rows, case.mask.shape[-1], case.mask.to(kind), case.first_only, closing)
    wanted = [rows, *parameters] if learns else [rows]
    return [out.detach(), *torch.autograd.grad(out, wanted, case.gradient.to(kind))]


SIZES = [(32, 1, 64), (64, 2, 128), (16, 1, 16)]


@settings(max_examples=60, deadline=None)
@given(
    batch=st.integers(1, 40),
    length=st.integers(1, 16),
    sizes=st.sampled_from(SIZES),
    first_only=st.booleans(),
    closes=st.booleans(),
    share=st.sampled_from([0.0, 0.5, 1.0]),
    seed=st.integers(0, 2**16),
)
def test_it_is_as_near_to_the_exact_layer_as_torch_is_and_so_is_every_gradient(
    batch: int, length: int, sizes: tuple[int, int, int], first_only: bool, closes: bool, share: float, seed: int
):
    case = drawn(batch, length, sizes, first_only=first_only, closes=closes, share=share, seed=seed)
    exact, torchs = computed(case, torch.float64, False), computed(case, torch.float32, False)
    for ours, theirs, expected in zip(computed(case, torch.float32, True), torchs, exact, strict=True):
        assert ours.shape == expected.shape
        size = float(expected.abs().max())
        assert (ours - expected).abs().max() <= 3 * (theirs - expected).abs().max() + 1e-6 * size


@pytest.mark.parametrize("first_only", [True, False])
def test_a_gradient_of_the_rows_alone_is_the_same_bit_for_bit(first_only: bool):
    case = drawn(21, 15, SIZES[0], first_only=first_only, closes=True)
    alone, whole = (computed(case, torch.float32, True, learns) for learns in (False, True))
    assert torch.equal(alone[0], whole[0])
    assert torch.equal(alone[1], whole[1])


def test_without_a_gradient_it_gives_the_same_bits():
    case = drawn(37, 15, SIZES[0], closes=True)
    assert case.mask is not None
    expected = computed(case, torch.float32, True)[0]
    with compiled_layers(case.block):
        for mode in (torch.no_grad(), torch.inference_mode()):
            with mode:
                assert torch.equal(case.block(case.rows, 15, case.mask, closing=case.closing), expected)


def test_no_mask_is_a_mask_that_hides_nothing():
    case = drawn(5, 9, SIZES[1], share=1.0)
    with compiled_layers(case.block), torch.no_grad():
        assert torch.equal(case.block(case.rows, 9, None), case.block(case.rows, 9, case.mask))


def test_threads_beside_each_other_compute_what_they_compute_alone():
    cases = [drawn(64, 15, SIZES[i % 2], closes=True, first_only=i > 1, seed=i) for i in range(4)]
    alone = [computed(case, torch.float32, True) for case in cases]
    beside: list[list[list[Tensor]]] = [[] for _ in cases]

    def work(index: int) -> None:
        beside[index] = [computed(cases[index], torch.float32, True) for _ in range(10)]

    threads = [threading.Thread(target=work, args=(index,)) for index in range(len(cases))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for expected, found in zip(alone, beside, strict=True):
        assert len(found) == 10
        for each in found:
            assert all(torch.equal(*pair) for pair in zip(each, expected, strict=True))


def test_graphs_that_are_open_at_once_and_one_that_is_gone_through_twice_keep_what_they_need():
    first, second = (drawn(16, 15, SIZES[0], seed=seed) for seed in (1, 2))
    expected = computed(first, torch.float32, True)[1]
    assert first.mask is not None
    rows = first.rows.clone().requires_grad_()
    with compiled_layers(first.block):
        out = first.block(rows, 15, first.mask)
        computed(second, torch.float32, True)
        for retain in (True, False):
            (found,) = torch.autograd.grad(out, rows, first.gradient, retain_graph=retain)
            computed(second, torch.float32, True)
            assert torch.equal(found, expected)


def test_scores_far_apart_neither_overflow_nor_lose_the_sum():
    case = drawn(16, 15, SIZES[0])
    case.block.query_key_value.weight.data *= 30
    found, expected = computed(case, torch.float32, True), computed(case, torch.float64, False)
    assert all(each.isfinite().all() for each in found)
    torch.testing.assert_close(found[0].double(), expected[0], rtol=1e-3, atol=1e-3)


def test_what_is_hidden_changes_no_bit_of_the_others_and_what_is_no_number_shows():
    case = drawn(8, 15, SIZES[0])
    assert case.mask is not None
    hidden = (case.mask[:, 0, 0] != 0).flatten()
    other = case._replace(rows=torch.where(hidden[:, None], 7.0, case.rows))
    assert torch.equal(*(computed(each, torch.float32, True)[0][~hidden] for each in (case, other)))
    case.block.feedforward_in.weight.data[0, 0] = torch.nan
    assert computed(case, torch.float32, True)[0].isnan().any(1).all()


def test_denormal_numbers_count_as_zero_where_they_shall():
    case = drawn(4, 15, SIZES[0])
    case = case._replace(gradient=case.gradient * 1e-38)
    assert _least(computed(case, torch.float32, True)) < torch.finfo(torch.float32).tiny
    with no_denormals():
        assert _least(computed(case, torch.float32, True)) >= torch.finfo(torch.float32).tiny


def _least(found: list[Tensor]) -> float:
    sizes = torch.cat([each.flatten() for each in found[1:]]).double().abs()
    return float(sizes[sizes > 0].min())


def test_a_second_derivative_is_refused():
    case = drawn(2, 15, SIZES[0])
    rows = case.rows.clone().requires_grad_()
    with compiled_layers(case.block):
        out = case.block(rows, 15, case.mask)
    (gradient,) = torch.autograd.grad(out.square().sum(), rows, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_it_is_only_asked_for_what_it_is_made_for():
    rows, weight = torch.zeros(32, 64), torch.zeros(128, 64)
    assert layer.can_compute(rows, 16, 2, weight)
    assert not layer.can_compute(rows, 16, 2, weight.double())
    assert not layer.can_compute(rows, 17, 2, weight)
    assert not layer.can_compute(rows, 16, 8, weight)
    assert not layer.can_compute(rows, 16, 2, weight[:100])
    assert not layer.can_compute(rows.double(), 16, 2, weight)
    assert not layer.can_compute(rows.to("meta"), 16, 2, weight)
    seen: list[bool] = []
    torch.vmap(lambda rows: seen.append(layer.can_compute(rows, 16, 2, weight)) or rows)(rows[None])
    assert seen == [False]


def test_with_torch_for_what_it_is_not_made_for_the_bits_are_torchs():
    case = drawn(3, 20, SIZES[0])
    for ours, theirs in zip(*(computed(case, torch.float32, compiled) for compiled in (True, False)), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("config", [NetworkConfig(), NetworkConfig(kind="attentive"), NetworkConfig(width=8)])
def test_a_network_gives_the_same_values_and_afterwards_the_same_bits(config: NetworkConfig):
    observations = 20 * torch.randn(8, 15, 5, generator=torch.Generator().manual_seed(0))
    observations[..., 0] = (torch.arange(15) < 11).float()
    network = build_network(config, 3, 0)
    if network.gate is not None:
        torch.nn.init.constant_(network.gate, 0.3)
    before = network(observations)
    with compiled_layers(network):
        within = network(observations)
        with torch.inference_mode():
            assert torch.equal(network(observations), within)
    torch.testing.assert_close(within, before, rtol=1e-6, atol=4e-6)
    assert torch.equal(network(observations), before)


def test_a_projection_has_torchs_gradients_but_for_rounding():
    generator = torch.Generator().manual_seed(0)
    projection, rows = Projection(8, 32), torch.randn(9, 15, 8, generator=generator).requires_grad_()
    gradient = torch.randn(9, 15, 32, generator=generator)

    def found() -> list[Tensor]:
        out = projection(rows)
        return [out, *torch.autograd.grad(out, [rows, *projection.parameters()], gradient)]

    expected = found()
    with compiled_layers(projection):
        for ours, theirs in zip(found(), expected, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)


def test_what_is_expanded_in_memory_is_read_as_what_it_says():
    block, _, rows, mask, _, _ = drawn(4, 15, (32, 1, 64))
    spread = torch.full((1,), 0.5).expand(60, 32)
    for shown in (rows, spread):
        kept = shown.clone().requires_grad_()
        with torch.enable_grad():
            (expected,) = torch.autograd.grad(block(kept, 15, mask).sum(), kept)
            with compiled_layers(block):
                outer = shown.detach().requires_grad_()
                (found,) = torch.autograd.grad(block(outer, 15, mask).sum(), outer)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_layers_that_were_compiled_before_are_so_afterwards():
    block = Block(32, 1, 64)
    with compiled_layers(block):
        with compiled_layers(block):
            assert block.compiled
        assert block.compiled
    assert not block.compiled
