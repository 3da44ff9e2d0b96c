"""A Q-network as an ONNX graph of standard operators, written node by node.

Tracing gives a correct graph of twice as many nodes, and at batch 1 it is their number that takes the time. What can be
computed from the weights alone is computed here: units go into the first layer's weights, the scale of the scores into
the queries', closed adapters are left out.

Shapes: B batch, V vehicles, F features, D width, N policies, A actions, H heads, T tokens. Rows are (B*T, D).
"""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from rapid.networks.blocks import Block, Transformer
from rapid.networks.encoding import BESIDE, NEAR, NEAR_FEATURES
from rapid.networks.mixture import MixtureOfPolicies, PolicyEncoder
from rapid.networks.q_network import ActionDecoder, MlpHead, QNetwork
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES

OPSET, IR_VERSION = 17, 8
Array = NDArray[np.float32]


class Graph:
    """Nodes and constants, in the order in which they were asked for."""

    def __init__(self, onnx: Any) -> None:
        self._onnx, self.nodes, self.constants = onnx, list[Any](), list[Any]()

    def constant(self, value: Any, kind: type = np.float32) -> str:
        """Keep an array and return its name."""
        name = f"c{len(self.constants)}"
        self.constants.append(self._onnx.numpy_helper.from_array(np.asarray(value, kind, order="C"), name))
        return name

    def node(self, kind: str, *inputs: str | Array | float, outputs: int = 1, **attributes: Any) -> Any:
        """Add a node; inputs that are numbers become constants. Return its output's name, or a list of several."""
        names = [item if isinstance(item, str) else self.constant(item) for item in inputs]
        made = [f"n{len(self.nodes)}_{index}" for index in range(outputs)]
        self.nodes.append(self._onnx.helper.make_node(kind, names, made, **attributes))
        return made[0] if outputs == 1 else made

    def reshape(self, value: str, *shape: int) -> str:
        """Return the value in another shape; -1 is what is left over."""
        return self.node("Reshape", value, self.constant(shape, np.int64))

    def cut(self, value: str, start: int, end: int, axis: int) -> str:
        """Return entries `start` to `end` along an axis."""
        bounds = [self.constant([number], np.int64) for number in (start, end, axis)]
        return self.node("Slice", value, *bounds)

    def linear(self, rows: str, layer: nn.Linear) -> str:
        """Return what the layer makes of rows."""
        return self.node("Gemm", rows, _array(layer.weight).T, _array(layer.bias))

    def norm(self, rows: str, layer: nn.LayerNorm) -> str:
        """Return the rows normalised."""
        return self.node(
            "LayerNormalization", rows, _array(layer.weight), _array(layer.bias), axis=-1, epsilon=layer.eps
        )


def build_model(network: QNetwork) -> Any:
    """Return the `onnx.ModelProto` that reads `obs` (B, V, F) and gives `q` (B, A).

    Raises:
        ImportError: onnx is not installed.
    """
    import onnx

    graph = Graph(onnx)
    _q_values(graph, network)
    # The Q-values are what the last node gives.
    graph.nodes[-1].output[0] = "q"
    kind, make = onnx.TensorProto.FLOAT, onnx.helper.make_tensor_value_info
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "rapid",
            [make("obs", kind, ["batch", NUM_VEHICLES, NUM_FEATURES])],
            [make("q", kind, ["batch", NUM_ACTIONS])],
            graph.constants,
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="rapid",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def _q_values(graph: Graph, network: QNetwork) -> str:
    head, encoding = network.head, network.encoding
    features, unit_F = "obs", np.ones(NUM_FEATURES, np.float32)
    if encoding.kind == "normalized":
        unit_F = _array(encoding.scale_F)
    elif encoding.kind in ("ego", "near"):
        ego = graph.cut("obs", 0, 1, 1)
        features, unit_F = (
            graph.node("Sub", "obs", graph.node("Mul", ego, _array(encoding.relative_VF))),
            _array(encoding.unit_F),
        )
        if encoding.kind == "near":
            features = graph.node("Concat", features, *_near(graph, features), axis=-1)
            unit_F = np.append(unit_F, np.ones(NEAR_FEATURES, np.float32))
    present = None
    if encoding.mask_absent:
        present = graph.node("Greater", graph.cut("obs", 0, 1, 2), _array(encoding.absent_V1))
    if isinstance(head, MlpHead):
        if present:
            features = graph.node("Where", present, features, 0.0)
        return _mlps(graph, head, features, unit_F)
    # What the rows of absent vehicles hold has no influence: the mask hides them, and none of them is read.
    mask = graph.reshape(graph.node("Where", present, 0.0, -np.inf), -1, 1, 1, NUM_VEHICLES) if present else None
    return _decoder(graph, head.decoder, _mixture(graph, head.mixture, features, unit_F, mask), mask)


def _near(graph: Graph, relative: str) -> tuple[str, str, str]:
    """Return what `near` adds to the ego-relative features, each (B, V, 1)."""
    ahead, aside, faster = (graph.cut(relative, place, place + 1, 2) for place in (1, 2, 3))
    distance = graph.node("Add", graph.node("Abs", ahead), NEAR)
    share = graph.node("Mul", aside, 1 / BESIDE)
    beside = graph.node("Exp", graph.node("Neg", graph.node("Mul", share, share)))
    return graph.node("Div", ahead, distance), beside, graph.node("Div", faster, distance)


def _mlps(graph: Graph, head: MlpHead, features: str, unit_F: Array) -> str:
    flat, total = graph.reshape(features, -1, NUM_VEHICLES * len(unit_F)), ""
    weights_N = [1.0] if head.weights_N is None else _array(head.weights_N).tolist()
    for mlp, weight in zip(head.mlps, weights_N, strict=True):
        layers = [layer for layer in cast(nn.Sequential, mlp) if isinstance(layer, nn.Linear)]
        rows = flat
        for index, layer in enumerate(layers):
            last, matrix = index == len(layers) - 1, _array(layer.weight).T
            matrix = matrix / np.tile(unit_F, NUM_VEHICLES)[:, None] if index == 0 else matrix
            share = np.float32(weight if last else 1.0)
            rows = graph.node("Gemm", rows, matrix * share, _array(layer.bias) * share)
            rows = rows if last else graph.node("Relu", rows)
        total = graph.node("Add", total, rows) if total else rows
    return total


def _mixture(graph: Graph, mixture: MixtureOfPolicies, features: str, unit_F: Array, mask: str | None) -> str:
    """Return the mixed tokens (B, V, D)."""
    first, *adapters = (cast(PolicyEncoder, policy) for policy in mixture.policies)
    tokens = _policy(graph, first, features, unit_F, mask)
    if mixture.router is None:
        return tokens
    into, _, out = mixture.router
    hidden = graph.node("MatMul", features, _array(cast(nn.Linear, into).weight).T / unit_F[:, None])
    hidden = graph.node("Relu", graph.node("Add", hidden, _array(cast(nn.Linear, into).bias)))
    logits = graph.node("MatMul", hidden, _array(cast(nn.Linear, out).weight).T)
    logits = graph.node("Add", logits, _array(cast(nn.Linear, out).bias))
    if mixture.top_k < len(mixture.policies):
        logits = _top_k(graph, logits, len(mixture.policies), mixture.top_k)
    weights = graph.node("Softmax", logits, axis=-1)
    gate_VN = np.concatenate([np.ones((NUM_VEHICLES, 1)), _array(mixture.gate_NV).T], 1).astype(np.float32)
    if mixture.gate_kind == "tanh":
        gate_VN[:, 0], gate_VN[:, 1:] = 0, np.tanh(gate_VN[:, 1:])
    opened = [index for index in range(1, len(mixture.policies)) if gate_VN[:, index].any()]
    if mixture.gate_kind == "tanh" and not opened:
        return tokens
    if opened:
        weights = graph.node("Mul", weights, gate_VN)
    if mixture.gate_kind == "tanh":
        axes = graph.constant([-1], np.int64)
        share = graph.node("Sub", 1.0, graph.node("ReduceSum", weights, axes, keepdims=1))
    else:
        share = graph.cut(weights, 0, 1, 2)
    mixed = graph.node("Mul", tokens, share)
    for index in opened:
        tokens = _policy(graph, adapters[index - 1], features, unit_F, mask)
        part = graph.node("Mul", tokens, graph.cut(weights, index, index + 1, 2))
        mixed = graph.node("Add", mixed, part)
    return mixed


def _top_k(graph: Graph, logits: str, policies: int, kept: int) -> str:
    """Return the logits (B, V, N) with -inf for the adapters outside the K that are active."""
    own, adapters = graph.cut(logits, 0, 1, 2), graph.cut(logits, 1, policies, 2)
    if kept == 1:
        return graph.node("Concat", own, graph.node("Sub", adapters, np.inf), axis=-1)
    count = graph.constant([kept - 1], np.int64)
    values, _ = graph.node("TopK", adapters, count, outputs=2, axis=-1)
    smallest = graph.cut(values, kept - 2, kept - 1, 2)
    closed = graph.node("Where", graph.node("GreaterOrEqual", adapters, smallest), adapters, -np.inf)
    return graph.node("Concat", own, closed, axis=-1)


def _policy(graph: Graph, policy: PolicyEncoder, features: str, unit_F: Array, mask: str | None) -> str:
    """Return the policy's tokens (B, V, D)."""
    width = policy.projection.out_features
    bias_VD = np.tile(_array(policy.projection.bias), (NUM_VEHICLES, 1))
    if policy.position is not None:
        position = _array(cast(Tensor, policy.position))
        bias_VD[: len(position)] += position
    tokens = graph.node("MatMul", features, _array(policy.projection.weight).T / unit_F[:, None])
    rows = graph.reshape(graph.node("Add", tokens, bias_VD), -1, width)
    rows = _transformer(graph, policy.transformer, rows, NUM_VEHICLES, mask)
    return graph.reshape(rows, -1, NUM_VEHICLES, width)


def _decoder(graph: Graph, decoder: ActionDecoder, tokens: str, mask: str | None) -> str:
    """Return the Q-values (B, A)."""
    length, width = NUM_VEHICLES, decoder.head.in_features
    if decoder.action_token is not None:
        length += 1
        pads = graph.constant([0, 1, 0, 0, 0, 0], np.int64)
        token_TD = np.zeros((length, width), np.float32)
        token_TD[0] = _array(decoder.action_token)[0, 0]
        tokens = graph.node("Add", graph.node("Pad", tokens, pads), token_TD)
        if mask:
            mask = graph.node("Pad", mask, graph.constant([0, 0, 0, 1, 0, 0, 0, 0], np.int64))
    rows = graph.reshape(tokens, -1, width)
    return graph.linear(_transformer(graph, decoder.transformer, rows, length, mask, first_only=True), decoder.head)


def _transformer(
    graph: Graph, transformer: Transformer, rows: str, length: int, mask: str | None, first_only: bool = False
) -> str:
    blocks = [cast(Block, block) for block in transformer.blocks]
    for index, block in enumerate(blocks):
        rows = _block(graph, block, rows, length, mask, first_only and index == len(blocks) - 1)
    return graph.norm(rows, transformer.norm)


def _block(graph: Graph, block: Block, rows: str, length: int, mask: str | None, first_only: bool) -> str:
    """Return the rows after the layer; with `first_only` each sample's first."""
    heads, width = block.heads, block.attention_norm.normalized_shape[0]
    size = width // heads
    weight, bias = _array(block.query_key_value.weight).T.copy(), _array(block.query_key_value.bias).copy()
    weight[:, :width] *= np.float32(size**-0.5)
    bias[:width] *= np.float32(size**-0.5)
    normed = graph.norm(rows, block.attention_norm)
    query = ""
    if first_only:
        rows, first = (_first(graph, value, length, width) for value in (rows, normed))
        query = graph.reshape(graph.node("Gemm", first, weight[:, :width], bias[:width]), -1, heads, 1, size)
        weight, bias = weight[:, width:], bias[width:]
    parts = weight.shape[1] // width
    split = graph.reshape(graph.node("Gemm", normed, weight, bias), -1, length, parts * heads, size)
    projected = graph.node("Split", graph.node("Transpose", split, perm=[0, 2, 1, 3]), outputs=parts, axis=1)
    if not first_only:
        query, *projected = projected
    key, value = projected
    scores = graph.node("MatMul", query, graph.node("Transpose", key, perm=[0, 1, 3, 2]))
    if mask:
        scores = graph.node("Add", scores, mask)
    attended = graph.node("MatMul", graph.node("Softmax", scores, axis=-1), value)
    if not first_only:
        attended = graph.node("Transpose", attended, perm=[0, 2, 1, 3])
    attended = graph.linear(graph.reshape(attended, -1, width), block.attention_out)
    rows = graph.node("Add", rows, attended)
    hidden = graph.node("Relu", graph.linear(graph.norm(rows, block.feedforward_norm), block.feedforward_in))
    return graph.node("Add", rows, graph.linear(hidden, block.feedforward_out))


def _first(graph: Graph, rows: str, length: int, width: int) -> str:
    """Return each sample's first row (B, D)."""
    return graph.node("Gather", graph.reshape(rows, -1, length, width), graph.constant(0, np.int64), axis=1)


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().numpy()
