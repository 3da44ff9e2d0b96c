"""The mixture of policies over vehicle tokens, with its router and zero gate (paper: section 3.3, equation 6).

Shapes: B batch, V vehicles, F features, D width, N policies. Policy 1 (index 0) is distilled from the teacher; the
others are adapters, which the gate `g`, zero at first, lets in during online adaptation.
"""

import math
from typing import cast

import torch
from torch import Tensor, nn

from rapid.config_learning import NetworkConfig
from rapid.networks.blocks import Projection, Transformer
from rapid.networks.encoding import num_inputs
from rapid.networks.memory import Recalled


class PolicyEncoder(nn.Module):
    """One policy: a linear projection, a mark of place, a transformer (paper: appendix, "Policy Networks")."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.projection = Projection(num_inputs(config.input), config.width)
        if config.position == "learned":
            self.position = nn.Parameter(torch.empty(config.vehicles, config.width))
        elif config.position == "ego":
            self.position = nn.Parameter(torch.empty(1, config.width))
        elif config.position == "sinusoidal":
            self.register_buffer("position", sinusoids(config.vehicles, config.width), persistent=False)
        else:
            self.position = None
        self.transformer = Transformer(config.layers, config.width, config.heads, config.feedforward)

    def forward(self, features_BVF: Tensor, mask_B11V: Tensor | None, recalled_BD: Tensor | None = None) -> Tensor:
        """Return the policy's tokens (B, V, D); what is recalled is added to each."""
        tokens_BVD = self.projection(features_BVF)
        if recalled_BD is not None:
            tokens_BVD = tokens_BVD + recalled_BD[:, None]
        if self.position is not None:
            rows = self.position.shape[0]
            # A mark on the ego alone is one row, filled up with zeros.
            tokens_BVD = tokens_BVD + nn.functional.pad(self.position, (0, 0, 0, features_BVF.shape[1] - rows))
        return self.transformer(tokens_BVD, mask_B11V)


class MixtureOfPolicies(nn.Module):
    """The tokens of N policies, summed with weights for each vehicle.

    With router weights omega = softmax(topK(router)), the weights are, by `config.gate`:

    * `linear`: w1 = omega1, wi = gi * omegai;
    * `tanh`: wi = tanh(gi) * omegai, w1 = 1 - sum of the others.

    Policy 1 is always among the K; the adapters compete for the other K-1 places.
    """

    def __init__(self, config: NetworkConfig, num_policies: int) -> None:
        super().__init__()
        self.top_k, self.gate_kind = min(config.top_k, num_policies), config.gate
        self.policies = nn.ModuleList(PolicyEncoder(config) for _ in range(num_policies))
        self.gate_NV = nn.Parameter(torch.zeros(num_policies - 1, config.vehicles))
        self.router = _router(num_inputs(config.input), config.width, num_policies) if num_policies > 1 else None
        self.stays_closed = False
        """Whether the gate is 0 and is not trained. A recording on a GPU, which cannot look, goes by it."""

    def forward(
        self,
        features_BVF: Tensor,
        mask_B11V: Tensor | None,
        recalled: Recalled | None = None,
        first_BVD: Tensor | None = None,
    ) -> Tensor:
        """Return the mixed tokens (B, V, D); memory reaches the router and, of the policies, the adapters.

        Whoever has policy 1's tokens already gives them as `first_BVD`.
        """
        if first_BVD is None:
            first_BVD = cast(Tensor, self.policies[0](features_BVF, mask_B11V, None))
        if self.router is None:
            return first_BVD
        router_BVN, weights_BVN = self.weights(features_BVF, recalled)
        mixed_BVD = weights_BVN[..., 0, None] * first_BVD
        token_BD = None if recalled is None else recalled.token_BD
        for index, policy in enumerate(self.policies):
            if index and self._runs(index, router_BVN):
                mixed_BVD = mixed_BVD + weights_BVN[..., index, None] * policy(features_BVF, mask_B11V, token_BD)
        return mixed_BVD

    def weights(self, features_BVF: Tensor, recalled: Recalled | None = None) -> tuple[Tensor, Tensor]:
        """Return the router's softmaxed weights and the signed weights after the gate, both (B, V, N)."""
        if self.router is None:
            ones_BV1 = torch.ones_like(features_BVF[..., :1])
            return ones_BV1, ones_BV1
        logits_BVN = self.router(features_BVF)
        if recalled is not None:
            logits_BVN = logits_BVN + recalled.router_BN[:, None]
        if self.top_k < len(self.policies):
            adapters = logits_BVN[..., 1:]
            kept = adapters.topk(self.top_k - 1, -1).indices
            closed = torch.full_like(adapters, -torch.inf)
            logits_BVN = torch.cat([logits_BVN[..., :1], closed.scatter(-1, kept, adapters.gather(-1, kept))], -1)
        router_BVN = logits_BVN.softmax(-1)
        gate_VN = (self.gate_NV.tanh() if self.gate_kind == "tanh" else self.gate_NV).T
        adapters_BVN = gate_VN * router_BVN[..., 1:]
        if self.gate_kind == "tanh":
            first_BV1 = 1 - adapters_BVN.sum(-1, keepdim=True)
        else:
            first_BV1 = router_BVN[..., :1]
        return router_BVN, torch.cat([first_BV1, adapters_BVN], -1)

    def _runs(self, index: int, router_BVN: Tensor) -> bool:
        """Whether the adapter can change the output or a gradient; if not, leaving it out changes no bit."""
        if router_BVN.is_cuda and torch.cuda.is_current_stream_capturing():
            # A recording cannot ask for values, and is replayed with others.
            return not self.stays_closed
        if self.top_k < len(self.policies) and not bool(router_BVN[..., index].any()):
            return False
        gate_learns = self.gate_NV.requires_grad and torch.is_grad_enabled()
        return gate_learns or bool(self.gate_NV[index - 1].any())


def _router(inputs: int, width: int, num_policies: int) -> nn.Sequential:
    """A small MLP that scores the policies for one vehicle."""
    return nn.Sequential(Projection(inputs, width), nn.ReLU(), nn.Linear(width, num_policies))


def sinusoids(length: int, width: int) -> Tensor:
    """Return the fixed position encoding of "Attention Is All You Need" (length, width)."""
    rates = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000.0) / width))
    angles = torch.arange(length)[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], -1).flatten(1)[:, :width]
