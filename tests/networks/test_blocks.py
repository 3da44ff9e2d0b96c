"""The attention block against a plain implementation, and its shortcut for the first token."""

import pytest
import torch
from torch import nn

from rapid.networks.blocks import Block, Transformer


def plain_block(block: Block, tokens, mask):
    """One pre-norm layer written out with loops over heads."""
    width = tokens.shape[-1]
    size = width // block.heads
    normed = block.attention_norm(tokens)
    query, key, value = block.query_key_value(normed).chunk(3, -1)
    heads = []
    for h in range(block.heads):
        part = slice(h * size, (h + 1) * size)
        scores = query[..., part] @ key[..., part].transpose(1, 2) / size**0.5
        heads.append((scores + mask[:, 0]).softmax(-1) @ value[..., part])
    tokens = tokens + block.attention_out(torch.cat(heads, -1))
    return tokens + block.feedforward_out(block.feedforward_in(block.feedforward_norm(tokens)).relu())


@pytest.fixture
def mask():
    mask = torch.zeros(3, 1, 1, 7)
    mask[1, ..., 4:] = -torch.inf
    return mask


def test_a_block_is_pre_norm_attention_and_feedforward(mask):
    block, tokens = Block(16, 4, 32), torch.randn(3, 7, 16)
    expected = plain_block(block, tokens, mask)
    assert torch.allclose(block(tokens.flatten(0, 1), 7, mask).view(3, 7, 16), expected, atol=1e-5)


@pytest.mark.parametrize("layers", [1, 3])
def test_computing_the_first_token_alone_changes_neither_value_nor_gradient(mask, layers):
    transformer = Transformer(layers, 16, 2, 32)
    tokens = torch.randn(3, 7, 16, requires_grad=True)
    full, short = transformer(tokens, mask)[:, 0], transformer(tokens, mask, first_only=True)
    assert torch.allclose(full, short, atol=1e-5)
    for a, b in zip(*(torch.autograd.grad(x.square().sum(), tokens) for x in (full, short)), strict=True):
        assert torch.allclose(a, b, atol=1e-4)


def test_attention_probabilities_sum_to_one_and_reproduce_the_output(mask):
    transformer, tokens = Transformer(2, 16, 2, 32), torch.randn(3, 7, 16)
    attention = transformer.attention(tokens, mask)
    assert attention.shape == (3, 2, 2, 7, 7)
    assert torch.allclose(attention.sum(-1), torch.ones(3, 2, 2, 7))
    assert not attention[1, ..., 4:].any()
    block = transformer.blocks[0]
    assert isinstance(block, Block)
    assert isinstance(block.attention_norm, nn.LayerNorm)
    values = block.query_key_value(block.attention_norm(tokens))[..., 32:].unflatten(-1, (2, 8)).transpose(1, 2)
    attended = (attention[:, 0] @ values).transpose(1, 2).flatten(2)
    after = tokens + block.attention_out(attended)
    after = after + block.feedforward_out(block.feedforward_in(block.feedforward_norm(after)).relu())
    assert torch.allclose(block(tokens.flatten(0, 1), 7, mask).view(3, 7, 16), after, atol=1e-5)
