"""Multilayer perceptrons over the flattened observation: the baselines' network, a mixture of them, several as one.

Shapes: B batch, V vehicles, F features, A actions, N policies, S members of a stack.
"""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from rapid.config_learning import NetworkConfig
from rapid.networks.encoding import num_inputs
from rapid.scenarios import NUM_ACTIONS


class MlpHead(nn.Module):
    """Weighted sum of the Q-values of N multilayer perceptrons over the flattened observation.

    With N = 1 this is the baselines' network (paper: hyperparameter table); with more it is the mixture of *actions*
    that the remark in section 3.3 compares against: weights learned, but the same for every vehicle and state. They
    start at (1, 0, ..., 0), so that the two training phases mean the same as for the mixture of policies.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        count = config.num_policies if config.kind == "mlp-mixture" else 1
        self.mlps = nn.ModuleList(
            self._mlp(config.vehicles * num_inputs(config.input), config.hidden) for _ in range(count)
        )
        self.weights_N = nn.Parameter(torch.zeros(count)) if count > 1 else None

    @staticmethod
    def _mlp(inputs: int, hidden: tuple[int, ...]) -> nn.Sequential:
        sizes = (inputs, *hidden)
        layers: list[nn.Module] = [nn.Flatten()]
        for before, after in zip(sizes, hidden, strict=False):
            layers += [nn.Linear(before, after), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(sizes[-1], NUM_ACTIONS))

    def forward(self, features_BVF: Tensor, mask_B11V: Tensor | None) -> Tensor:
        """Return the Q-values (B, A); the features of absent rows are zero already, so the mask has no use here."""
        if self.weights_N is None:
            return self.mlps[0](features_BVF)
        return torch.stack([mlp(features_BVF) for mlp in self.mlps], -1) @ self.weights_N


class MlpStack(nn.Module):
    """S perceptrons of one shape, each reading its own part of the batch: their products are one call for all.

    The networks are so small that an update spends most of its time on calls. Of five together each takes less than
    half the time that it takes alone.
    """

    weights_N: None = None
    """A stack holds plain perceptrons, no mixtures of actions."""

    def __init__(self, heads: Sequence[MlpHead]) -> None:
        super().__init__()
        self.members = len(heads)
        layers = list(zip(*(_linear_layers(head) for head in heads), strict=True))
        self.weights_SIO = nn.ParameterList(torch.stack([each.weight.detach().T for each in same]) for same in layers)
        self.biases_S1O = nn.ParameterList(torch.stack([each.bias.detach()[None] for each in same]) for same in layers)

    def forward(self, features_BVF: Tensor, mask_B11V: Tensor | None) -> Tensor:
        """Return the Q-values (B, A); the first B/S rows are those of the first member, and so on."""
        hidden = features_BVF.view(self.members, -1, features_BVF[0].numel())
        last = len(self.weights_SIO) - 1
        for index, (weight_SIO, bias_S1O) in enumerate(zip(self.weights_SIO, self.biases_S1O, strict=True)):
            hidden = torch.baddbmm(bias_S1O, hidden, weight_SIO)
            if index < last:
                hidden = hidden.relu()
        return hidden.flatten(0, 1)

    @torch.no_grad()
    def copy_to(self, head: MlpHead, member: int) -> None:
        """Give `head` the weights of a member."""
        for layer, weight_SIO, bias_S1O in zip(_linear_layers(head), self.weights_SIO, self.biases_S1O, strict=True):
            layer.weight.copy_(weight_SIO[member].T)
            layer.bias.copy_(bias_S1O[member, 0])


def _linear_layers(head: MlpHead) -> list[nn.Linear]:
    return [layer for layer in cast(nn.Sequential, head.mlps[0]) if isinstance(layer, nn.Linear)]
