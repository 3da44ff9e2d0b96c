"""Q-networks: RAPID's mixture of policies, its single policy, and two kinds of MLP, all with one interface.

Shapes: B batch, V vehicles, F features, D width, N policies, A actions, L layers, H heads.
"""

from typing import Literal, NamedTuple, cast

import torch
from torch import Tensor, nn

from rapid.config_learning import NetworkConfig
from rapid.data.batch import with_rows
from rapid.errors import RapidError
from rapid.networks.encoding import Encoding
from rapid.networks.memory import Memory
from rapid.networks.mlp import MlpHead, MlpStack
from rapid.networks.token_head import TokenHead
from rapid.safety import filter_values, margins, read_box
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, MAX_VEHICLES, MIN_VEHICLES, SLOWER
from rapid.seeding import torch_stream

Phase = Literal["distill", "adapt", "all"]

MIRRORED_ACTIONS = [LANE_RIGHT, IDLE, LANE_LEFT, FASTER, SLOWER]
"""Each action as it is seen in the mirror."""


class Explanation(NamedTuple):
    """Why a network prefers an action; tensors without gradient, None where the network has no such part.

    Of a network that averages with the mirror image, the Q-values are means; all else is of the road as it is.
    """

    q_BA: Tensor
    """The Q-values."""
    weights_BVN: Tensor | None
    """The signed weight of each policy for each vehicle, after the zero gate."""
    router_BVN: Tensor | None
    """The router's weights before the gate; each vehicle's sum to 1."""
    gate_NV: Tensor | None
    """The zero gate of the adapters, (N-1, V)."""
    attention_BLHV: Tensor | None
    """How much the token from which Q is read attends to each vehicle, in every layer and head of the decoder. Where an
    action token is prepended, the share missing to 1 is its attention to itself."""


class QNetwork(nn.Module):
    """Raw observations (B, V, F) in, Q-values (B, A) out; the policy is their argmax.

    With `config.mirror` the Q-values are the mean of those of the road and of its mirror image, so that left and right
    make no difference. With `config.shield` the interval filter is applied to them (:mod:`rapid.safety`): the greedy
    action is the best of those that are safe whatever lies behind what is seen. Neither has weights, so any network may
    be given them by another `config`.
    """

    mirrored_A: Tensor
    """:data:`MIRRORED_ACTIONS`."""

    def __init__(self, config: NetworkConfig, lanes: int) -> None:
        super().__init__()
        self.config, self.lanes = config, lanes
        self.encoding = Encoding(config.input, lanes, config.mask_absent, config.vehicles)
        self.head: TokenHead | MlpHead | MlpStack
        self.head = TokenHead(config) if config.kind in ("rapid", "attentive") else MlpHead(config)
        self.memory = Memory(config, lanes) if config.memory else None
        # A buffer, for a list of indices would be copied to the device at every call.
        self.register_buffer("mirrored_A", torch.tensor(MIRRORED_ACTIONS), persistent=False)

    @property
    def is_stack(self) -> bool:
        """Whether this is several networks as one (:mod:`rapid.networks.stack`), each with its part of a batch."""
        return isinstance(self.head, MlpStack)

    @property
    def members(self) -> int:
        """How many networks this is: 1 unless it is a stack."""
        return self.head.members if isinstance(self.head, MlpStack) else 1

    @property
    def scale_F(self) -> Tensor:
        """What 1 means in each normalised feature (F,): metres and m/s."""
        return self.encoding.scale_F

    @property
    def gate(self) -> nn.Parameter | None:
        """What lets the adapters in: the zero gate (N-1, V), or the weights (N,) of a mixture of actions."""
        head = self.head
        return head.mixture.gate_NV if isinstance(head, TokenHead) else head.weights_N

    def forward(self, obs_BVF: Tensor, state_BS: Tensor | None = None, first_BVD: Tensor | None = None) -> Tensor:
        """Return the Q-values (B, A).

        Args:
            obs_BVF: raw observations.
            state_BS: the state of a network with a memory (:mod:`rapid.networks.memory`).
            first_BVD: what :meth:`frozen_tokens` gave for them, which spares policy 1.

        Raises:
            RapidError: a state is missing, or is given to a network without a memory.
        """
        obs_BVF = with_rows(obs_BVF, self.config.vehicles)
        if (self.memory is None) != (state_BS is None):
            raise RapidError(
                "A network with a memory (network.memory) needs its state beside the observations, and one without "
                "takes none. Ask its agent: agent.start(worlds) gives the first state."
            )
        if self.memory is not None and state_BS is not None:
            features_BVF, mask_B11V = self.encoding(self.memory.believed(obs_BVF, state_BS))
            q_BA = cast(TokenHead, self.head)(features_BVF, mask_B11V, self.memory(obs_BVF, state_BS), first_BVD)
        elif first_BVD is not None:
            q_BA = cast(TokenHead, self.head)(*self.encoding(obs_BVF), None, first_BVD)
        else:
            q_BA = self._unfiltered(obs_BVF)
        return self._shielded(q_BA, obs_BVF)

    def _unfiltered(self, obs_BVF: Tensor) -> Tensor:
        q_BA = self.head(*self.encoding(obs_BVF))
        if not self.config.mirror:
            return q_BA
        mirrored_BA = self.head(*self.encoding(self.encoding.mirrored(obs_BVF)))
        return (q_BA + mirrored_BA.index_select(1, self.mirrored_A)) / 2

    def _shielded(self, q_BA: Tensor, obs_BVF: Tensor) -> Tensor:
        if not self.config.shield:
            return q_BA
        return filter_values(torch, q_BA, margins(torch, obs_BVF, self.lanes, read_box(self.config.shield, self.lanes)))

    @torch.no_grad()
    def frozen_tokens(self, obs_BVF: Tensor, state_BS: Tensor | None = None) -> Tensor | None:
        """Return policy 1's tokens (B, V, D), which no update changes; None where it is trained or there is none.

        None, too, for a network that averages with the mirror image, which needs two of each.
        """
        head = self.head
        if not isinstance(head, TokenHead) or self.config.mirror:
            return None
        first = head.mixture.policies[0]
        if any(parameter.requires_grad for parameter in first.parameters()):
            return None
        obs_BVF = with_rows(obs_BVF, self.config.vehicles)
        if self.memory is not None and state_BS is not None:
            obs_BVF = self.memory.believed(obs_BVF, state_BS)
        return first(*self.encoding(obs_BVF))

    @torch.no_grad()
    def explain(self, obs_BVF: Tensor, state_BS: Tensor | None = None) -> Explanation:
        """Return the Q-values and what they rest on, for each vehicle; it costs about two forward passes."""
        obs_BVF = with_rows(obs_BVF, self.config.vehicles)
        q_BA = self(obs_BVF, state_BS)
        if not isinstance(self.head, TokenHead):
            return Explanation(q_BA, None, None, None, None)
        recalled = None
        if self.memory is not None and state_BS is not None:
            recalled, obs_BVF = self.memory(obs_BVF, state_BS), self.memory.believed(obs_BVF, state_BS)
        features_BVF, mask_B11V = self.encoding(obs_BVF)
        mixture = self.head.mixture
        router_BVN, weights_BVN = mixture.weights(features_BVF, recalled)
        attention_BLHV = self.head.decoder.attention(
            mixture(features_BVF, mask_B11V, recalled), mask_B11V, None if recalled is None else recalled.action_BD
        )
        gate_NV = mixture.gate_NV.detach().clone()
        return Explanation(q_BA, weights_BVN, router_BVN, gate_NV, attention_BLHV)


def build_network(config: NetworkConfig, lanes: int, seed: int) -> QNetwork:
    """Return a new network whose weights depend on `config` and `seed` alone, with every parameter trainable.

    Raises:
        RapidError: N < 1, K outside 1..N, a width that the heads do not divide, vehicles outside 2..51, a memory that
            :func:`check_memory` refuses, or a shield that :func:`rapid.safety.read_box` does not read.
    """
    if config.memory or config.squeeze:
        check_memory(config)
    if config.shield:
        read_box(config.shield, lanes)
    if config.num_policies < 1 or not 1 <= config.top_k <= config.num_policies:
        raise RapidError(
            f"A network with num_policies N = {config.num_policies} and top_k K = {config.top_k} cannot be built: "
            "N must be at least 1 and K between 1 and N."
        )
    if config.heads < 1 or config.width % config.heads or min(config.layers, config.decoder_layers) < 1:
        raise RapidError(
            f"A network of width {config.width} with {config.heads} heads and {config.layers} + "
            f"{config.decoder_layers} layers cannot be built: "
            "the width must be a multiple of the heads, with at least one head and one layer."
        )
    if not MIN_VEHICLES <= config.vehicles <= MAX_VEHICLES:
        raise RapidError(
            f"A network that reads vehicles V = {config.vehicles} cannot be built: V must be between {MIN_VEHICLES} "
            f"and {MAX_VEHICLES}, as many rows as an observation can have."
        )
    # The constructors draw from the global stream; every such value is overwritten below, so its state is kept.
    with torch.random.fork_rng(devices=[]):
        network = QNetwork(config, lanes)
    _initialize(network, torch_stream(seed, "network"))
    return network


@torch.no_grad()
def _initialize(network: QNetwork, generator: torch.Generator) -> None:
    """Draw the weights: linear layers uniform within 1/sqrt(inputs), embeddings normal with deviation 0.02, g zero."""
    for module in network.modules():
        if isinstance(module, nn.Linear):
            bound = module.in_features**-0.5
            for parameter in module.parameters():
                parameter.uniform_(-bound, bound, generator=generator)
    for name, parameter in network.named_parameters():
        if name.endswith(("position", "action_token")):
            parameter.normal_(0, 0.02, generator=generator)
        elif name.endswith("weights_N"):
            parameter[0] = 1
    if network.memory is not None:
        # So that what has learned without a memory acts, bit for bit, as it did.
        network.memory.out.weight.zero_()


def set_phase(network: QNetwork, phase: Phase, freeze_decoder: bool = False) -> None:
    """Choose what is trained by setting ``requires_grad`` (paper: figure 3 and section 3.3).

    `distill` (phase 2) trains policy 1, the router and the decoder. `adapt` (phase 3) freezes policy 1 and trains the
    adapters, the zero gate, the router and, unless `freeze_decoder`, the decoder. `all` trains every weight. In a
    mixture of actions the MLPs stand for the policies and their weights for the gate. A network without adapters has
    no phase 3.

    Raises:
        RapidError: `adapt` on a network without adapters, or `freeze_decoder` on one without a decoder.
    """
    head, gate = network.head, network.gate
    if isinstance(head, MlpStack):
        if phase == "adapt" or freeze_decoder:
            raise RapidError("A stack of networks trains every weight. Train one network at a time instead.")
        network.requires_grad_(True)
        return
    first, *adapters = head.mixture.policies if isinstance(head, TokenHead) else head.mlps
    if phase == "adapt" and not adapters:
        raise RapidError(
            f"A '{network.config.kind}' network with one policy has no adapter to train. "
            "Set adapt.train to 'all' or 'scratch', or distil a network of kind 'rapid' with num_policies >= 2."
        )
    network.requires_grad_(True)
    if phase == "distill":
        for adapter in adapters:
            adapter.requires_grad_(False)
        if gate is not None:
            gate.requires_grad_(False)
    elif phase == "adapt":
        first.requires_grad_(False)
    if isinstance(head, TokenHead):
        head.mixture.stays_closed = phase == "distill" and not bool(head.mixture.gate_NV.any())
    if freeze_decoder:
        if not isinstance(head, TokenHead):
            raise RapidError(f"A '{network.config.kind}' network has no decoder to freeze. Unset freeze_decoder.")
        head.decoder.requires_grad_(False)


def check_memory(config: NetworkConfig) -> None:
    """Check that a network of these settings can have a memory.

    Raises:
        RapidError: it has no tokens, averages with the mirror image, or would squeeze features without a memory.
    """
    if not config.memory:
        raise RapidError(
            "Squeezed features take the ego's place and speed from a memory. Set memory as well, or unset squeeze."
        )
    if config.kind not in ("rapid", "attentive"):
        raise RapidError(
            f"A network of kind '{config.kind}' has no tokens that a memory could speak to. Unset memory, or choose "
            "network.kind rapid or attentive."
        )
    if config.mirror:
        raise RapidError("A memory tells left from right, the mirror does not. Unset memory or mirror.")
