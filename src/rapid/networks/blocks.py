"""A pre-norm transformer, as small as the paper's needs (paper: appendix "Network Implementation").

Shapes: B batch, T tokens, D width, H heads, L layers. A `mask_B11T` is added to the attention scores: 0 where a key may
be read, -inf where not.
"""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional


class Block(nn.Module):
    """One layer: self-attention, then a feed-forward network, each behind a LayerNorm and around a residual."""

    def __init__(self, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.attention_out = nn.Linear(width, width)
        self.feedforward_norm = nn.LayerNorm(width)
        self.feedforward_in = nn.Linear(width, feedforward)
        self.feedforward_out = nn.Linear(feedforward, width)

    def forward(self, tokens_BTD: Tensor, mask_B11T: Tensor | None, first_only: bool = False) -> Tensor:
        """Return the tokens after this layer; with `first_only` just the first one (B, 1, D), for less work.

        Only the first token's query, residual and feed-forward are computed then; the value is the same.
        """
        normed_BTD = self.attention_norm(tokens_BTD)
        query, key, value = self._project(normed_BTD, first_only)
        attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask_B11T)
        if first_only:
            tokens_BTD = tokens_BTD[:, :1]
        tokens_BTD = tokens_BTD + self.attention_out(attended.transpose(1, 2).reshape(tokens_BTD.shape))
        hidden = functional.relu(self.feedforward_in(self.feedforward_norm(tokens_BTD)))
        return tokens_BTD + self.feedforward_out(hidden)

    def attention(self, tokens_BTD: Tensor, mask_B11T: Tensor | None) -> Tensor:
        """Return the attention probabilities of the layer (B, H, T queries, T keys)."""
        query, key, _ = self._project(self.attention_norm(tokens_BTD), first_only=False)
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
        return (scores if mask_B11T is None else scores + mask_B11T).softmax(-1)

    def _project(self, normed_BTD: Tensor, first_only: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return query, key and value, each (B, H, T, D/H)."""
        width = normed_BTD.shape[-1]
        if first_only:
            weight, bias = self.query_key_value.weight, self.query_key_value.bias
            query = functional.linear(normed_BTD[:, :1], weight[:width], bias[:width])
            key, value = functional.linear(normed_BTD, weight[width:], bias[width:]).split(width, -1)
        else:
            query, key, value = self.query_key_value(normed_BTD).split(width, -1)
        return self._split(query), self._split(key), self._split(value)

    def _split(self, x_BTD: Tensor) -> Tensor:
        return x_BTD.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class Transformer(nn.Module):
    """A stack of blocks and a closing LayerNorm."""

    def __init__(self, layers: int, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads, feedforward) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, tokens_BTD: Tensor, mask_B11T: Tensor | None, first_only: bool = False) -> Tensor:
        """Return the encoded tokens (B, T, D); with `first_only` the first one only (B, 1, D)."""
        last = len(self.blocks) - 1
        for index, block in enumerate(self.blocks):
            tokens_BTD = block(tokens_BTD, mask_B11T, first_only and index == last)
        return self.norm(tokens_BTD)

    def attention(self, tokens_BTD: Tensor, mask_B11T: Tensor | None) -> Tensor:
        """Return the attention probabilities of every layer (B, L, H, T queries, T keys)."""
        layers: list[Tensor] = []
        for module in self.blocks:
            block = cast(Block, module)
            layers.append(block.attention(tokens_BTD, mask_B11T))
            tokens_BTD = block(tokens_BTD, mask_B11T)
        return torch.stack(layers, 1)
