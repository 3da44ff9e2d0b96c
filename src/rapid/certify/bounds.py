"""Bounds on what a network says, whatever it is shown within a box around an observation.

Affine forms (:mod:`rapid.certify.forms`) are carried through every kind of network as it was trained: the encoding, the
mixture of policies with its router and gate, attention with its softmax, LayerNorm, and perceptrons. Of a perceptron,
linear bounds from the back as well (CROWN: Zhang et al., 2018); the tighter bound counts.

What is bounded is each difference q_i - q_j. Shapes: B batch, V vehicles, F features, D width, A actions.
"""

import copy
from typing import cast

import torch
from torch import Tensor, nn

from rapid.certify.forms import Form, affine, averaged, between, joined, layer_norm, linear, products, softmax
from rapid.errors import RapidError
from rapid.networks.blocks import Block, Transformer
from rapid.networks.encoding import BESIDE, NEAR, Encoding
from rapid.networks.memory import Memory
from rapid.networks.mixture import MixtureOfPolicies, PolicyEncoder
from rapid.networks.mlp import MlpHead
from rapid.networks.q_network import MIRRORED_ACTIONS, QNetwork
from rapid.networks.token_head import TokenHead
from rapid.scenarios import NUM_ACTIONS

ROUNDING = 1e-4
"""By how much a difference must exceed 0 to count as proven: networks compute in single precision, bounds do not."""

NEAR_TIE = 1e-4
"""Metres by which a box is wider where y is rounded to lanes: the network does that in single precision."""
CHUNK_PERCEPTRON, CHUNK_TOKENS = 16, 1
"""Observations that are bounded at once. A mixture's forms take hundreds of megabytes each."""


class Bounds:
    """Lower bounds of the differences of a network's Q-values; its safety filter, if any, is left out.

    Args:
        network: any network; it is copied.

    Raises:
        RapidError: the network is a stack.
    """

    def __init__(self, network: QNetwork) -> None:
        if network.is_stack:
            raise RapidError("Bounds are computed for one network. This one is a stack of several.")
        self.network = copy.deepcopy(network).double().cpu().requires_grad_(False)

    @torch.no_grad()
    def differences(self, low_BVF: Tensor, high_BVF: Tensor, state_BS: Tensor | None = None) -> Tensor:
        """Return (B, A, A): entry (i, j) is at most q_i - q_j wherever the observation lies in the box.

        Presence, rounded, counts as what it is in the middle of the box. What a network remembers is known. Where a
        bound overflows it is NaN.
        """
        chunk = CHUNK_TOKENS if isinstance(self.network.head, TokenHead) else CHUNK_PERCEPTRON
        state_BS = low_BVF.new_zeros(len(low_BVF), 0) if state_BS is None else state_BS
        parts = (each.double().cpu().split(chunk) for each in (low_BVF, high_BVF, state_BS))
        return torch.cat([self._differences(*part) for part in zip(*parts, strict=True)])

    def _differences(self, low_BVF: Tensor, high_BVF: Tensor, state_BS: Tensor) -> Tensor:
        encoding = self.network.encoding
        radius_BVF = (high_BVF - low_BVF) / 2
        errors = radius_BVF[0].numel()
        # One error for each entry of the observation.
        each = torch.eye(errors, dtype=torch.float64).view(errors, 1, *radius_BVF.shape[1:])
        seen = Form((low_BVF + high_BVF) / 2, each * radius_BVF, torch.zeros_like(radius_BVF))
        present_BV1 = seen.centre[..., :1] > encoding.absent_V1
        memory = self.network.memory
        if memory is not None:
            believed = _squeezed if memory.squeeze else _believed
            return self._of_road(believed(memory, seen, state_BS), present_BV1, _recalled(memory, seen, state_BS))
        least_BAA = self._of_road(seen, present_BV1)
        if self.network.config.mirror:
            turned = seen.scaled(encoding.turned_F).plus(encoding.far_side_F)
            turned = Form(*(torch.where(present_BV1, new, old) for new, old in zip(turned, seen, strict=True)))
            order = torch.tensor(MIRRORED_ACTIONS)
            least_BAA = (least_BAA + self._of_road(turned, present_BV1)[:, order][:, :, order]) / 2
        return least_BAA

    def _of_road(self, seen: Form, present_BV1: Tensor, recalled: list[Form] | None = None) -> Tensor:
        encoding, head = self.network.encoding, self.network.head
        features = _features(encoding, seen)
        if encoding.mask_absent:
            features = features.where(present_BV1, 0.0)
        else:
            present_BV1 = torch.ones_like(present_BV1)
        one_AA = torch.eye(NUM_ACTIONS, dtype=torch.float64)
        pairs_PA = (one_AA[:, None] - one_AA).flatten(0, 1)
        if isinstance(head, TokenHead):
            least_BP = _tokens(head, features, present_BV1[..., 0], pairs_PA, recalled or [])
        else:
            assert isinstance(head, MlpHead)
            weights_N = [1.0] if head.weights_N is None else head.weights_N.tolist()
            flat = features.map(lambda part: part.flatten(-2))
            least_BP = torch.zeros(len(flat.centre), len(pairs_PA), dtype=torch.float64)
            for mlp, weight in zip(head.mlps, weights_N, strict=True):
                layers = [layer for layer in cast(nn.Sequential, mlp) if isinstance(layer, nn.Linear)]
                least_BP += perceptron(layers, flat, pairs_PA * weight)
        return least_BP.unflatten(-1, (NUM_ACTIONS, NUM_ACTIONS))


def perceptron(layers: list[nn.Linear], inside: Form, wanted_PA: Tensor) -> Tensor:
    """Return a lower bound (B, P) of `wanted_PA` times the output of linear layers with ReLU between them.

    By forms from the front, and by linear bounds from the back (CROWN): of each ReLU the lower bound is 0 or x,
    whichever leaves less room, the upper one the chord.
    """
    reached: list[Form] = []
    values = inside
    for layer in layers[:-1]:
        reached.append(linear(values, layer))
        values = reached[-1].relu()
    by_forms = affine(values, wanted_PA @ layers[-1].weight, wanted_PA @ layers[-1].bias).low
    # The lower bound is weight_BPI . (what the layer reads) + rest_BP, carried back layer by layer.
    weight_BPI = (wanted_PA @ layers[-1].weight).expand(len(inside.centre), -1, -1)
    rest_BP = (wanted_PA @ layers[-1].bias).expand(len(inside.centre), -1)
    for layer, form in zip(reversed(layers[:-1]), reversed(reached), strict=True):
        low, high = form.low[:, None], form.high[:, None]
        crosses = (low < 0) & (high > 0)
        chord = torch.where(crosses, high / (high - low).clamp_min(1e-300), (low >= 0).double())
        below = torch.where(crosses, (high > -low).double(), (low >= 0).double())
        positive, negative = weight_BPI.clamp_min(0), weight_BPI.clamp_max(0)
        rest_BP = rest_BP + (negative * torch.where(crosses, -low * chord, 0.0)).sum(-1)
        weight_BPI = positive * below + negative * chord
        rest_BP = rest_BP + weight_BPI @ layer.bias
        weight_BPI = weight_BPI @ layer.weight
    middle_BP = (weight_BPI @ inside.centre[..., None])[..., 0]
    swing_BP = (weight_BPI @ inside.linear.movedim(0, -1)).abs().sum(-1)
    slack_BP = (weight_BPI.abs() @ inside.rest[..., None])[..., 0]
    return torch.maximum(by_forms, rest_BP + middle_BP - swing_BP - slack_BP)


def _believed(memory: Memory, seen: Form, state_BS: Tensor) -> Form:
    """Return what is seen with the ego's own row within what is known of it."""
    infinite_BVF = torch.full_like(seen.centre, torch.inf)
    lowest_BF, highest_BF = (memory.believed(each, state_BS)[:, 0] for each in (-infinite_BVF, infinite_BVF))
    rows: list[Form] = []
    for feature in range(seen.centre.shape[-1]):
        entry = seen.map(lambda part, i=feature: part[..., :1, i : i + 1])
        low_B, high_B = lowest_BF[:, feature], highest_BF[:, feature]
        if bool(low_B.isfinite().all()):
            least_B11 = low_B[:, None, None]
            entry = entry.plus(-least_B11).relu().plus(least_B11)
        if bool(high_B.isfinite().all()):
            most_B11 = high_B[:, None, None]
            entry = entry.scaled(-1.0).plus(most_B11).relu().scaled(-1.0).plus(most_B11)
        rows.append(entry)
    return joined([joined(rows, -1), seen.map(lambda part: part[..., 1:, :])], -2)


def _squeezed(memory: Memory, seen: Form, state_BS: Tensor) -> Form:
    """Return what is seen with features squeezed.

    Presence, and where along the road the others are, stay what they were. Every other entry rises with the one that it
    is made of and depends on nothing else that is seen, so it lies between what the corners of the box give.
    """
    low_BVF, high_BVF = (memory.squeezed(part, state_BS) for part in (seen.low - NEAR_TIE, seen.high + NEAR_TIE))
    # Speeds are told by presence alone, which is that of the middle.
    low_BVF[..., 3] = high_BVF[..., 3] = memory.squeezed(seen.centre, state_BS)[..., 3]
    kept_VF = torch.zeros_like(low_BVF[0], dtype=torch.bool)
    kept_VF[:, 0] = kept_VF[1:, 1] = True
    corners = between(low_BVF, high_BVF, len(seen.linear))
    return Form(*(torch.where(kept_VF, old, new) for old, new in zip(seen, corners, strict=True)))


def _recalled(memory: Memory, seen: Form, state_BS: Tensor) -> list[Form]:
    """Return what memory adds to the adapters' tokens, to the token that is read, and to the router, each (B, 1, D)."""
    # What is known is linear in what is seen of the ego, presence apart, which is that of the middle.
    known_BM = memory.knowledge(seen.centre, state_BS)
    moved_EBM = torch.stack([memory.knowledge(seen.centre + part, state_BS) - known_BM for part in seen.linear])
    known = Form(known_BM[:, None], moved_EBM[:, :, None], torch.zeros_like(known_BM[:, None]))
    added = affine(linear(known, memory.hidden).relu(), memory.out.weight)
    starts = [sum(memory.sizes[:place]) for place in range(len(memory.sizes))]
    return [
        added.map(lambda part, first=first, size=size: part[..., first : first + size])
        for first, size in zip(starts, memory.sizes, strict=True)
    ]


def _features(encoding: Encoding, seen: Form) -> Form:
    if encoding.kind == "raw":
        return seen
    if encoding.kind == "normalized":
        return seen.scaled(1 / encoding.scale_F)
    relative = seen.minus(seen.map(lambda part: part[..., :1, :]).scaled(encoding.relative_VF))
    scaled = relative.scaled(1 / encoding.unit_F)
    if encoding.kind == "ego":
        return scaled
    ahead, aside, faster = (relative.map(lambda part, i=i: part[..., i : i + 1]) for i in (1, 2, 3))
    low, high = ahead.low, ahead.high
    near, far = torch.maximum(low, -high).clamp_min(0) + NEAR, torch.maximum(-low, high) + NEAR
    share = ahead.curved(lambda x: x / (x.abs() + NEAR), NEAR / far.square(), NEAR / near.square())
    steep, flat = near.square().reciprocal(), far.square().reciprocal()
    least = torch.where(high > 0, -steep, flat)  # the slope of 1 / (|x| + 10 m) is negative ahead, positive behind
    most = torch.where(low < 0, steep, -flat)
    closing = faster.times(ahead.curved(lambda x: 1 / (x.abs() + NEAR), least, most))
    low, high = aside.low, aside.high
    nearest, farthest = torch.maximum(low, -high).clamp_min(0), torch.maximum(-low, high)
    bells = [(-(x / BESIDE).square()).exp() for x in (nearest, farthest)]
    slopes = torch.stack([-2 / BESIDE**2 * x * bell for x in (low, high) for bell in bells])
    beside = aside.curved(lambda x: (-(x / BESIDE).square()).exp(), slopes.amin(0), slopes.amax(0))
    return joined([scaled, share, beside, closing], -1)


def _tokens(head: TokenHead, features: Form, seen_BV: Tensor, pairs_PA: Tensor, recalled: list[Form]) -> Tensor:
    tokens, decoder = _mixture(head.mixture, features, seen_BV, recalled), head.decoder
    action = [each.padded(len(tokens.linear)) for each in recalled[1:2]]
    if decoder.action_token is not None:
        first = decoder.action_token.expand(len(seen_BV), -1, -1)
        read = between(first, first, len(tokens.linear))
        tokens = joined([read.plus(action[0]) if action else read, tokens], -2)
        seen_BV = torch.cat([torch.ones_like(seen_BV[:, :1]), seen_BV], 1)
    elif action:
        ego, others = (tokens.map(lambda part, i=i: part[..., i, :]) for i in (slice(0, 1), slice(1, None)))
        tokens = joined([ego.plus(action[0]), others], -2)
    read = _transformer(decoder.transformer, tokens, seen_BV, first_only=True)
    return affine(read, pairs_PA @ decoder.head.weight, pairs_PA @ decoder.head.bias).low[:, 0]


def _mixture(mixture: MixtureOfPolicies, features: Form, seen_BV: Tensor, recalled: list[Form]) -> Form:
    policies = [cast(PolicyEncoder, policy) for policy in mixture.policies]
    total = _policy(policies[0], features, seen_BV)
    if mixture.router is None:
        return total
    into, _, out = mixture.router
    scores = linear(linear(features, cast(nn.Linear, into)).relu(), cast(nn.Linear, out))
    if recalled:
        scores = scores.plus(recalled[2])
    if mixture.top_k < len(policies):
        omega = _among_the_best(scores, mixture.top_k)
    else:
        omega = softmax(scores, torch.ones_like(scores.centre, dtype=torch.bool))
    gate_VN = (mixture.gate_NV.tanh() if mixture.gate_kind == "tanh" else mixture.gate_NV).T
    weights = omega.map(lambda part: part[..., 1:]).scaled(gate_VN)
    if mixture.gate_kind == "tanh":
        own = weights.map(lambda part: part.sum(-1, keepdim=True)).scaled(-1.0).plus(1.0)
    else:
        own = omega.map(lambda part: part[..., :1])
    total = total.times(own)
    for index, policy in enumerate(policies[1:]):
        if bool(gate_VN[:, index].any()):
            weight = weights.map(lambda part, i=index: part[..., i : i + 1])
            # Its new errors come behind those of the policies before.
            total = total.plus(_policy(policy, features.padded(len(total.linear)), seen_BV, recalled).times(weight))
    return total.named()


def _among_the_best(scores: Form, top_k: int) -> Form:
    """Return the router's shares among policy 1 and the K-1 best adapters, which need not be the same all over the box.

    Where they are not, each adapter may be left out, or be in with policy 1 alone.
    """
    low, high = scores.low, scores.high
    active = torch.zeros_like(low, dtype=torch.bool)
    active[..., 0] = True
    if top_k > 1:
        active.scatter_(-1, scores.centre[..., 1:].topk(top_k - 1, -1).indices + 1, True)
    worst = low.where(active, torch.inf)[..., 1:].amin(-1, keepdim=True)
    best = high.where(~active, -torch.inf).amax(-1, keepdim=True)
    certain = (worst > best) if top_k > 1 else torch.ones_like(best, dtype=torch.bool)
    shares = softmax(scores, active)
    alone = (high[..., 1:] - torch.logaddexp(high[..., 1:], low[..., :1])).exp()
    others = high[..., 1:].topk(max(top_k - 1, 1), -1).values
    own = (low[..., :1] - torch.logaddexp(low[..., :1], others.logsumexp(-1, keepdim=True))).exp()
    least = torch.cat([own, torch.zeros_like(alone)], -1)
    loose = between(least, torch.cat([torch.ones_like(own), alone], -1), len(scores.linear))
    return Form(*(torch.where(certain, sharp, wide) for sharp, wide in zip(shares, loose, strict=True)))


def _policy(policy: PolicyEncoder, features: Form, seen_BV: Tensor, recalled: list[Form] | None = None) -> Form:
    tokens = linear(features, policy.projection)
    if recalled:
        tokens = tokens.plus(recalled[0])
    if policy.position is not None:
        rows = policy.position.shape[0]
        tokens = tokens.plus(nn.functional.pad(policy.position, (0, 0, 0, seen_BV.shape[1] - rows)))
    return _transformer(policy.transformer, tokens, seen_BV)


def _transformer(transformer: Transformer, tokens: Form, seen_BT: Tensor, first_only: bool = False) -> Form:
    last = len(transformer.blocks) - 1
    for index, block in enumerate(transformer.blocks):
        tokens = _block(cast(Block, block), tokens, seen_BT, first_only and index == last)
    return layer_norm(tokens, transformer.norm)


def _block(block: Block, tokens: Form, seen_BT: Tensor, first_only: bool) -> Form:
    """Return the tokens after a layer; with `first_only` the first one alone."""
    normed = layer_norm(tokens, block.attention_norm)
    asking = normed
    if first_only:
        tokens, asking = (form.map(lambda part: part[..., :1, :]) for form in (tokens, normed))
    width, weight, bias = normed.centre.shape[-1], block.query_key_value.weight, block.query_key_value.bias
    size, heads = width // block.heads, list[Form]()
    for start in range(0, width, size):
        query, key, value = (
            affine(rows, weight[part : part + size], bias[part : part + size])
            for rows, part in ((asking, start), (normed, width + start), (normed, 2 * width + start))
        )
        scores = products(query.scaled(size**-0.5), key)
        heads.append(averaged(softmax(scores, seen_BT[:, None].expand(scores.centre.shape)), value))
    tokens = tokens.plus(linear(joined(heads, -1), block.attention_out)).named()
    hidden = linear(layer_norm(tokens, block.feedforward_norm), block.feedforward_in).relu()
    return tokens.plus(linear(hidden, block.feedforward_out)).named()
