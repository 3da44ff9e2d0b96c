"""The layers of a transformer as ONNX nodes, with attention multiplied out.

Shapes: B batch, T tokens, D width, H heads. Rows are (B*T, D).
"""

from typing import cast

import numpy as np
from numpy.typing import NDArray

from rapid.agents.onnx_graph import Array, Graph, array
from rapid.networks.blocks import Block, Transformer


def through_transformer(graph: Graph, transformer: Transformer, rows: str, length: int, mask: str | None) -> str:
    """Return the rows (B*T, D) after all layers, normalised."""
    for block in transformer.blocks:
        rows = through_block(graph, cast(Block, block), rows, length, mask)
    return graph.norm(rows, transformer.norm)


class _Attention:
    """The weights of a block's attention, multiplied out.

    Scores are q k' = (x Wq + bq) (x Wk + bk)'. What is the same for every key has no influence after the softmax,
    which leaves (x Wq Wk' + bq Wk') x': the tokens themselves are the keys. And since a softmax sums to 1, they are the
    values too: P (x Wv + bv) Wo + bo = (P x) Wv Wo + (bv Wo + bo). Two projections are left of four, each H times as
    wide: less work with one head, fewer nodes with any number.
    """

    def __init__(self, block: Block) -> None:
        weight = block.query_key_value.weight.detach().cpu().double().numpy()
        bias = block.query_key_value.bias.detach().cpu().double().numpy()
        out = block.attention_out.weight.detach().cpu().double().numpy()
        heads, width = block.heads, weight.shape[1]
        size = width // heads
        query_HSD, key_HSD, value_HSD = weight.reshape(3, heads, size, width)
        query_HS, _, value_HS = bias.reshape(3, heads, size)
        out_HSD = out.T.reshape(heads, size, width)
        self.heads, self.width = heads, width
        self.ask_DE = np.einsum("hsd,hse->dhe", query_HSD, key_HSD).reshape(width, -1) / size**0.5
        """Tokens (., D) to queries (., H*D)."""
        self.ask_E = np.einsum("hs,hse->he", query_HS, key_HSD).reshape(-1) / size**0.5
        self.give_ED = np.einsum("hsd,hse->hde", value_HSD, out_HSD).reshape(-1, width)
        """What the heads attended to (., H*D) to the block's tokens (., D)."""
        self.give_D = np.einsum("hs,hsd->d", value_HS, out_HSD) + array(block.attention_out.bias)


def through_block(graph: Graph, block: Block, rows: str, length: int, mask: str | None) -> str:
    """Return the rows (B*T, D) after the layer."""
    attention = _Attention(block)
    normed = graph.norm(rows, block.attention_norm)
    asked = graph.node("Gemm", normed, _float(attention.ask_DE), _float(attention.ask_E))
    query = _heads_first(graph, asked, length, attention)
    attended = _attend(graph, query, normed, length, mask, attention)
    if attention.heads > 1:
        attended = graph.node("Transpose", attended, perm=[0, 2, 1, 3])
    attended = graph.reshape(attended, -1, attention.heads * attention.width)
    attended = graph.node("Gemm", attended, _float(attention.give_ED), _float(attention.give_D))
    return _feedforward(graph, block, graph.node("Add", rows, attended))


def first_of_block(graph: Graph, block: Block, rows: str, length: int, mask: str | None, first_D: Array | None) -> str:
    """Return each sample's first row (B, D) after the layer; `first_D` is what it is before, if always the same."""
    attention = _Attention(block)
    normed = graph.norm(rows, block.attention_norm)
    heads, width = attention.heads, attention.width
    if first_D is None:
        first = _first(graph, normed, length, width)
        asked = graph.node("Gemm", first, _float(attention.ask_DE), _float(attention.ask_E))
        query: str | Array = graph.reshape(asked, -1, heads, 1, width)
    else:
        norm = block.attention_norm
        centred_D = (first_D - first_D.mean()) / np.sqrt(first_D.var() + norm.eps)
        normed_D = centred_D * array(norm.weight) + array(norm.bias)
        query = _float(normed_D @ attention.ask_DE + attention.ask_E).reshape(1, heads, 1, width)
    attended = _attend(graph, query, normed, length, mask, attention)
    attended = graph.reshape(attended, -1, heads * width)
    bias_D = attention.give_D if first_D is None else attention.give_D + first_D
    attended = graph.node("Gemm", attended, _float(attention.give_ED), _float(bias_D))
    if first_D is None:
        attended = graph.node("Add", _first(graph, rows, length, width), attended)
    return _feedforward(graph, block, attended)


def _heads_first(graph: Graph, rows: str, length: int, attention: _Attention) -> str:
    """Return rows (B*T, H*D) as (B, H, T, D)."""
    if attention.heads == 1:
        return graph.reshape(rows, -1, 1, length, attention.width)
    split = graph.reshape(rows, -1, length, attention.heads, attention.width)
    return graph.node("Transpose", split, perm=[0, 2, 1, 3])


def _attend(graph: Graph, query: str | Array, normed: str, length: int, mask: str | None, attention: _Attention) -> str:
    """Return what the queries (B, H, ., D) attend to among the tokens (B*T, D), as (B, H, ., D)."""
    tokens = graph.reshape(normed, -1, 1, length, attention.width)
    scores = graph.node("MatMul", query, graph.node("Transpose", tokens, perm=[0, 1, 3, 2]))
    if mask:
        scores = graph.node("Add", scores, mask)
    return graph.node("MatMul", graph.node("Softmax", scores, axis=-1), tokens)


def _feedforward(graph: Graph, block: Block, rows: str) -> str:
    hidden = graph.node("Relu", graph.linear(graph.norm(rows, block.feedforward_norm), block.feedforward_in))
    return graph.node("Add", rows, graph.linear(hidden, block.feedforward_out))


def _first(graph: Graph, rows: str, length: int, width: int) -> str:
    """Return each sample's first row (B, D)."""
    return graph.node("Gather", graph.reshape(rows, -1, length, width), graph.constant(0, np.int64), axis=1)


def _float(array: NDArray[np.floating]) -> Array:
    return array.astype(np.float32)
