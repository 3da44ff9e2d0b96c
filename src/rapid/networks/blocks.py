"""A pre-norm transformer, as small as the paper's needs (paper: appendix "Network Implementation").

Shapes: B batch, T tokens, D width, H heads, L layers. A `mask_B11T` is added to the attention scores: 0 where a key may
be read, -inf where not.
"""

from collections.abc import Generator
from contextlib import contextmanager
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from rapid.networks import layer


class Block(nn.Module):
    """One layer: self-attention, then a feed-forward network, each behind a LayerNorm and around a residual.

    Inside, tokens are rows of one matrix (B*T, D): a sixth faster than (B, T, D), because autograd keeps fewer views.
    """

    def __init__(self, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.heads = heads
        self.compiled = 0
        """Not 0: it is computed by :mod:`rapid.networks.layer` where it can be, which is faster, and rounded otherwise.
        It counts who wants that, for one may begin before another has ended."""
        self.attention_norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.attention_out = nn.Linear(width, width)
        self.feedforward_norm = nn.LayerNorm(width)
        self.feedforward_in = nn.Linear(width, feedforward)
        self.feedforward_out = nn.Linear(feedforward, width)

    def forward(
        self,
        rows: Tensor,
        length: int,
        mask_B11T: Tensor | None,
        first_only: bool = False,
        closing: nn.LayerNorm | None = None,
    ) -> Tensor:
        """Return the rows (B*T, D) after this layer; with `first_only` each sample's first token only (B, D).

        The value of the first token is the same either way; alone, it needs no other query and no other feed-forward.

        Args:
            rows: the tokens (B*T, D).
            length: T.
            mask_B11T: added to the attention scores.
            first_only: whether only the first token is wanted.
            closing: a norm that the rows go through at last.
        """
        if self.compiled and layer.can_compute(rows, length, self.heads, self.feedforward_in.weight):
            parts = (
                *(self.attention_norm, self.query_key_value, self.attention_out),
                *(self.feedforward_norm, self.feedforward_in, self.feedforward_out),
                *((closing,) if closing else ()),
            )
            parameters = [parameter for part in parts for parameter in (part.weight, part.bias)]
            return layer.compute(rows, length, self.heads, mask_B11T, first_only, parameters)
        query, key, value = self._project(rows, length, first_only)
        attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask_B11T)
        attended = attended.transpose(1, 2).reshape(-1, rows.shape[-1])
        if first_only:
            rows = rows.unflatten(0, (-1, length))[:, 0]
        # In place, which needs less memory at once: up to a tenth faster.
        rows = self.attention_out(attended).add_(rows)
        hidden = functional.relu_(self.feedforward_in(self.feedforward_norm(rows)))
        rows = self.feedforward_out(hidden).add_(rows)
        return closing(rows) if closing else rows

    def attention(self, rows: Tensor, length: int, mask_B11T: Tensor | None) -> Tensor:
        """Return the attention probabilities of the layer (B, H, T queries, T keys)."""
        query, key, _ = self._project(rows, length, first_only=False)
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
        return (scores if mask_B11T is None else scores + mask_B11T).softmax(-1)

    def _project(self, rows: Tensor, length: int, first_only: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Return query, key and value, each (B, H, T, D/H); with `first_only` the query of the first token alone."""
        normed, width = self.attention_norm(rows), rows.shape[-1]
        if first_only:
            weight, bias = self.query_key_value.weight, self.query_key_value.bias
            first = normed.unflatten(0, (-1, length))[:, 0]
            (query,) = self._heads(functional.linear(first, weight[:width], bias[:width]), 1, 1)
            key, value = self._heads(functional.linear(normed, weight[width:], bias[width:]), length, 2)
        else:
            query, key, value = self._heads(self.query_key_value(normed), length, 3)
        return query, key, value

    def _heads(self, rows: Tensor, length: int, parts: int) -> tuple[Tensor, ...]:
        split = rows.view(-1, length, parts, self.heads, rows.shape[-1] // (parts * self.heads))
        # Taken apart before it is transposed, so that the gradient is put together in place, without another copy.
        return tuple(part.transpose(1, 2) for part in split.unbind(2))


class Projection(nn.Linear):
    """A linear layer that reads the few features of a vehicle."""

    compiled = 0
    """Not 0: its gradient is by :mod:`rapid.networks.layer`, which is faster on a CPU, and rounded otherwise."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the rows (..., D) of features (..., F)."""
        if self.compiled and layer.is_plain(input):
            return layer.project(input, self.weight, self.bias)
        return super().forward(input)


@contextmanager
def compiled_layers(*networks: nn.Module) -> Generator[None]:
    """Let the layers of some networks be computed by :mod:`rapid.networks.layer` meanwhile."""
    modules = [module for network in networks for module in network.modules()]
    layers = [module for module in modules if isinstance(module, Block | Projection)]
    for each in layers:
        each.compiled += 1
    try:
        yield
    finally:
        for each in layers:
            each.compiled -= 1


@contextmanager
def spared_weights(*networks: nn.Module) -> Generator[None]:
    """Let no gradient be taken by the weights of some networks meanwhile.

    An attack needs none of them, and compiled layers cannot know what a gradient will be taken of.
    """
    weights = [weight for network in networks for weight in network.parameters() if weight.requires_grad]
    for weight in weights:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in weights:
            weight.requires_grad_(True)


class Transformer(nn.Module):
    """A stack of blocks and a closing LayerNorm."""

    def __init__(self, layers: int, width: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(width, heads, feedforward) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, tokens_BTD: Tensor, mask_B11T: Tensor | None, first_only: bool = False) -> Tensor:
        """Return the encoded tokens (B, T, D); with `first_only` the first one only (B, D)."""
        length, last = tokens_BTD.shape[1], len(self.blocks) - 1
        rows = tokens_BTD.flatten(0, 1)
        for index, block in enumerate(self.blocks):
            closing = self.norm if index == last else None
            rows = block(rows, length, mask_B11T, first_only and index == last, closing)
        return rows if first_only else rows.view(tokens_BTD.shape)

    def attention(self, tokens_BTD: Tensor, mask_B11T: Tensor | None) -> Tensor:
        """Return the attention probabilities of every layer (B, L, H, T queries, T keys)."""
        length, layers = tokens_BTD.shape[1], list[Tensor]()
        rows = tokens_BTD.flatten(0, 1)
        for module in self.blocks:
            block = cast(Block, module)
            layers.append(block.attention(rows, length, mask_B11T))
            rows = block(rows, length, mask_B11T)
        return torch.stack(layers, 1)
