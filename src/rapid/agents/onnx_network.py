"""A Q-network as an ONNX graph (:mod:`rapid.agents.onnx_graph`).

What can be computed from the weights alone is computed here: units go into the first layer's weights, what the action
token asks for is a constant, closed adapters are left out.

Shapes: B batch, V vehicles, F features of the network, G of the graph, D width, N policies, A actions, T tokens. Rows
are (B*T, D).
"""

from typing import Any, cast

import numpy as np
from torch import Tensor, nn

from rapid.agents.onnx_arrays import Arrays
from rapid.agents.onnx_graph import Array, Graph, array
from rapid.agents.onnx_memory import Names, believed, next_state, recalled
from rapid.agents.onnx_transformer import first_of_block, through_block, through_transformer
from rapid.networks.blocks import Block
from rapid.networks.encoding import BESIDE, NEAR, NEAR_FEATURES
from rapid.networks.memory import STATE_SIZE
from rapid.networks.mixture import MixtureOfPolicies, PolicyEncoder
from rapid.networks.mlp import MlpHead
from rapid.networks.q_network import MIRRORED_ACTIONS, QNetwork
from rapid.networks.token_head import ActionDecoder, TokenHead
from rapid.safety import filter_values, margins, read_box
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES


def build_model(network: QNetwork) -> Any:
    """Return the `onnx.ModelProto` that reads `obs` (B, V, F) and gives `q` (B, A).

    That of a network with a memory also reads `state` (B, S), and gives `next_state`, that after the greedy action.

    Raises:
        ImportError: onnx is not installed.
    """
    import onnx

    graph, memory = Graph(onnx, network.config.vehicles), network.memory
    q_values(graph, network, "state")
    # The Q-values are what the last node gives.
    graph.nodes[-1].output[0] = "q"
    if memory is not None:
        next_state(graph, memory.lanes, "state", "q")
        graph.nodes[-1].output[0] = "next_state"
    return graph.model(0 if memory is None else STATE_SIZE)


def q_values(graph: Graph, network: QNetwork, state: str) -> str:
    """Return the Q-values (B, A) of `obs`, and of a state (B, S) if the network has a memory."""
    q = _unfiltered(graph, network, state)
    if not network.config.shield:
        return q
    arrays = Arrays(graph)
    box = read_box(network.config.shield, network.lanes)
    return filter_values(arrays, arrays.of(q), margins(arrays, arrays.of("obs"), network.lanes, box)).name


def _unfiltered(graph: Graph, network: QNetwork, state: str) -> str:
    if not network.config.mirror:
        return _seen(graph, network, "obs", state)
    # The road and its mirror image as one batch.
    encoding = network.encoding
    turned = graph.node("Add", graph.node("Mul", "obs", array(encoding.turned_F)), array(encoding.far_side_F))
    present = graph.node("Greater", graph.cut("obs", 0, 1, 2), array(encoding.absent_V1))
    both = graph.node("Concat", "obs", graph.node("Where", present, turned, "obs"), axis=0)
    both = graph.reshape(_seen(graph, network, both, state), 2, -1, NUM_ACTIONS)
    actions = graph.constant(MIRRORED_ACTIONS, np.int64)
    mirrored = graph.node("Gather", graph.cut(both, 1, 2, 0), actions, axis=2)
    total = graph.node("Add", graph.cut(both, 0, 1, 0), mirrored)
    return graph.reshape(graph.node("Mul", total, 0.5), -1, NUM_ACTIONS)


def _seen(graph: Graph, network: QNetwork, obs: str, state: str) -> str:
    """Return the Q-values (B, A) of observations as they are."""
    head, encoding = network.head, network.encoding
    names = None
    if network.memory is not None:
        names, obs = recalled(graph, network.memory, obs, state), believed(graph, network.memory, obs, state)
    features, read_GF = obs, np.eye(NUM_FEATURES, dtype=np.float32)
    if encoding.kind == "normalized":
        read_GF /= array(encoding.scale_F)
    elif encoding.kind in ("ego", "near"):
        ego = graph.cut(obs, 0, 1, 1)
        features = graph.node("Sub", obs, graph.node("Mul", ego, array(encoding.relative_VF)))
        read_GF /= array(encoding.unit_F)
        if encoding.kind == "near":
            features = _near(graph, features)
            read_GF = _read_near(read_GF)
    present = None
    if encoding.mask_absent:
        present = graph.node("Greater", graph.cut(obs, 0, 1, 2), array(encoding.absent_V1))
    if not isinstance(head, TokenHead):
        assert isinstance(head, MlpHead)  # agents are never stacks
        if present:
            features = graph.node("Where", present, features, 0.0)
        return _mlps(graph, head, features, read_GF)
    # What the rows of absent vehicles hold has no influence: the mask hides them, and none of them is read.
    mask = graph.reshape(graph.node("Where", present, 0.0, -np.inf), -1, 1, 1, graph.vehicles) if present else None
    tokens = _mixture(graph, head.mixture, features, read_GF, mask, names)
    return _decoder(graph, head.decoder, tokens, mask, names)


def _near(graph: Graph, relative: str) -> str:
    """Return ego-relative features (B, V, F), the same divided by the distance, and `beside`, next to each other."""
    ahead, aside = graph.cut(relative, 1, 2, 2), graph.cut(relative, 2, 3, 2)
    distance = graph.node("Add", graph.node("Abs", ahead), NEAR)
    beside = graph.node("Exp", graph.node("Mul", graph.node("Mul", aside, aside), -1 / BESIDE**2))
    return graph.node("Concat", relative, graph.node("Div", relative, distance), beside, axis=-1)


def _read_near(read_FF: Array) -> Array:
    """Return how the features of `near` are read off what :func:`_near` gives: of the quotients, x's and vx's count."""
    read_GF = np.zeros((2 * NUM_FEATURES + 1, NUM_FEATURES + NEAR_FEATURES), np.float32)
    read_GF[:NUM_FEATURES, :NUM_FEATURES] = read_FF
    share, beside, closing = range(NUM_FEATURES, NUM_FEATURES + NEAR_FEATURES)
    read_GF[NUM_FEATURES + 1, share] = read_GF[NUM_FEATURES + 3, closing] = read_GF[-1, beside] = 1
    return read_GF


def _mlps(graph: Graph, head: MlpHead, features: str, read_GF: Array) -> str:
    flat, total = graph.reshape(features, -1, graph.vehicles * len(read_GF)), ""
    weights_N = [1.0] if head.weights_N is None else array(head.weights_N).tolist()
    for mlp, weight in zip(head.mlps, weights_N, strict=True):
        layers = [layer for layer in cast(nn.Sequential, mlp) if isinstance(layer, nn.Linear)]
        rows = flat
        for index, layer in enumerate(layers):
            last, matrix = index == len(layers) - 1, array(layer.weight).T
            matrix = np.kron(np.eye(graph.vehicles, dtype=np.float32), read_GF) @ matrix if index == 0 else matrix
            share = np.float32(weight if last else 1.0)
            rows = graph.node("Gemm", rows, matrix * share, array(layer.bias) * share)
            rows = rows if last else graph.node("Relu", rows)
        total = graph.node("Add", total, rows) if total else rows
    return total


def _mixture(
    graph: Graph,
    mixture: MixtureOfPolicies,
    features: str,
    read_GF: Array,
    mask: str | None,
    names: Names | None = None,
) -> str:
    """Return the mixed tokens (B, V, D)."""
    first, *adapters = (cast(PolicyEncoder, policy) for policy in mixture.policies)
    tokens = _policy(graph, first, features, read_GF, mask)
    if mixture.router is None:
        return tokens
    into, _, out = mixture.router
    hidden = graph.node("MatMul", features, read_GF @ array(cast(nn.Linear, into).weight).T)
    hidden = graph.node("Relu", graph.node("Add", hidden, array(cast(nn.Linear, into).bias)))
    logits = graph.node("MatMul", hidden, array(cast(nn.Linear, out).weight).T)
    logits = graph.node("Add", logits, array(cast(nn.Linear, out).bias))
    if names is not None:
        logits = graph.node("Add", logits, graph.reshape(names.router, -1, 1, len(mixture.policies)))
    if mixture.top_k < len(mixture.policies):
        logits = _top_k(graph, logits, len(mixture.policies), mixture.top_k)
    weights = graph.node("Softmax", logits, axis=-1)
    gate_VN = np.concatenate([np.ones((graph.vehicles, 1)), array(mixture.gate_NV).T], 1).astype(np.float32)
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
        tokens = _policy(graph, adapters[index - 1], features, read_GF, mask, names)
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


def _policy(
    graph: Graph,
    policy: PolicyEncoder,
    features: str,
    read_GF: Array,
    mask: str | None,
    names: Names | None = None,
) -> str:
    """Return the policy's tokens (B, V, D)."""
    width = policy.projection.out_features
    bias_VD = np.tile(array(policy.projection.bias), (graph.vehicles, 1))
    if policy.position is not None:
        position = array(cast(Tensor, policy.position))
        bias_VD[: len(position)] += position
    tokens = graph.node("MatMul", features, read_GF @ array(policy.projection.weight).T)
    tokens = graph.node("Add", tokens, bias_VD)
    if names is not None:
        tokens = graph.node("Add", tokens, graph.reshape(names.token, -1, 1, width))
    rows = graph.reshape(tokens, -1, width)
    rows = through_transformer(graph, policy.transformer, rows, graph.vehicles, mask)
    return graph.reshape(rows, -1, graph.vehicles, width)


def _decoder(graph: Graph, decoder: ActionDecoder, tokens: str, mask: str | None, names: Names | None = None) -> str:
    """Return the Q-values (B, A)."""
    length, width, first_D = graph.vehicles, decoder.head.in_features, None
    if decoder.action_token is not None:
        length, first_D = length + 1, array(decoder.action_token)[0, 0]
        pads = graph.constant([0, 1, 0, 0, 0, 0], np.int64)
        token_TD = np.zeros((length, width), np.float32)
        token_TD[0] = first_D
        tokens = graph.node("Add", graph.node("Pad", tokens, pads), token_TD)
        if mask:
            mask = graph.node("Pad", mask, graph.constant([0, 0, 0, 1, 0, 0, 0, 0], np.int64))
    if names is not None:
        # To the token that is read alone, which is then no longer the same whatever is known.
        after, first_D = graph.constant([0, 0, 0, 0, length - 1, 0], np.int64), None
        tokens = graph.node("Add", tokens, graph.node("Pad", graph.reshape(names.action, -1, 1, width), after))
    rows = graph.reshape(tokens, -1, width)
    blocks = [cast(Block, block) for block in decoder.transformer.blocks]
    for block in blocks[:-1]:
        rows = through_block(graph, block, rows, length, mask)
    # Before the first layer the action token is the same whatever is seen.
    rows = first_of_block(graph, blocks[-1], rows, length, mask, first_D if len(blocks) == 1 else None)
    return graph.linear(graph.norm(rows, decoder.transformer.norm), decoder.head)
