"""The head of a network of tokens: the mixture of policies, and the decoder that reads Q-values off its tokens.

Shapes: B batch, V vehicles, T tokens, F features, D width, A actions, L layers, H heads.
"""

import torch
from torch import Tensor, nn

from rapid.config_learning import NetworkConfig
from rapid.networks.blocks import Transformer
from rapid.networks.memory import Recalled
from rapid.networks.mixture import MixtureOfPolicies
from rapid.scenarios import NUM_ACTIONS


class ActionDecoder(nn.Module):
    """Vehicle tokens to Q-values: a transformer whose first token is read (paper: appendix, "Action Decoder")."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        prepend = config.action_token == "prepend"
        self.action_token = nn.Parameter(torch.empty(1, 1, config.width)) if prepend else None
        self.transformer = Transformer(config.decoder_layers, config.width, config.heads, config.feedforward)
        self.head = nn.Linear(config.width, NUM_ACTIONS)

    def forward(self, tokens_BVD: Tensor, mask_B11V: Tensor | None, recalled_BD: Tensor | None = None) -> Tensor:
        """Return the Q-values (B, A); what is recalled is added to the token that is read."""
        tokens_BTD, mask_B11T = self._with_action_token(tokens_BVD, mask_B11V, recalled_BD)
        return self.head(self.transformer(tokens_BTD, mask_B11T, first_only=True))

    def attention(self, tokens_BVD: Tensor, mask_B11V: Tensor | None, recalled_BD: Tensor | None = None) -> Tensor:
        """Return the attention of the token that is read to the vehicles (B, L, H, V)."""
        tokens_BTD, mask_B11T = self._with_action_token(tokens_BVD, mask_B11V, recalled_BD)
        return self.transformer.attention(tokens_BTD, mask_B11T)[:, :, :, 0, -tokens_BVD.shape[1] :]

    def _with_action_token(
        self, tokens_BVD: Tensor, mask_B11V: Tensor | None, recalled_BD: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        if self.action_token is None:
            if recalled_BD is None:
                return tokens_BVD, mask_B11V
            return torch.cat([tokens_BVD[:, :1] + recalled_BD[:, None], tokens_BVD[:, 1:]], 1), mask_B11V
        if recalled_BD is None:
            first_B1D = self.action_token.expand(tokens_BVD.shape[0], -1, -1)
        else:
            first_B1D = self.action_token + recalled_BD[:, None]
        tokens_BTD = torch.cat([first_B1D, tokens_BVD], 1)
        # Padding with 0 lets every token see the action token.
        return tokens_BTD, None if mask_B11V is None else nn.functional.pad(mask_B11V, (1, 0))


class TokenHead(nn.Module):
    """The mixture of policies and the action decoder: kinds `rapid` and, with one policy, `attentive`."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.mixture = MixtureOfPolicies(config, config.num_policies if config.kind == "rapid" else 1)
        self.decoder = ActionDecoder(config)

    def forward(
        self,
        features_BVF: Tensor,
        mask_B11V: Tensor | None,
        recalled: Recalled | None = None,
        first_BVD: Tensor | None = None,
    ) -> Tensor:
        """Return the Q-values (B, A); whoever has policy 1's tokens already gives them as `first_BVD`."""
        tokens_BVD = self.mixture(features_BVF, mask_B11V, recalled, first_BVD)
        return self.decoder(tokens_BVD, mask_B11V, None if recalled is None else recalled.action_BD)
