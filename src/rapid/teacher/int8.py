"""Linear layers in whole numbers, for a model that writes: faster on a processor that multiplies and adds bytes.

Weights have one scale for each output, activations one for each token, so that what a token gives does not depend on
the other tokens in the batch, and sums of whole numbers are exact in any order.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn

LARGEST = 127


def is_fast() -> bool:
    """Say whether the processor multiplies and adds bytes in one instruction (AVX-512 VNNI)."""
    # Older versions of torch cannot tell.
    capabilities: Callable[[], dict[str, bool]] = getattr(torch.cpu, "get_capabilities", dict)
    return bool(capabilities().get("avx512_vnni"))


class Int8Linear(nn.Module):
    """A linear layer with weights and activations rounded to 8 bits; (..., inputs) to (..., outputs)."""

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        weight_NK = linear.weight.detach()
        self.scale_N = _scale(weight_NK)[:, 0]
        self.weight_NK = (weight_NK / self.scale_N[:, None]).round().to(torch.int8)
        self.bias: Tensor | None = linear.bias

    def forward(self, inputs: Tensor) -> Tensor:
        """Apply the layer."""
        inputs_BK = inputs.reshape(-1, inputs.shape[-1])
        scale_B1 = _scale(inputs_BK)
        rounded_BK = (inputs_BK / scale_B1).round().to(torch.int8)
        # The product with the transposed weights is the faster one.
        sums_BN = torch._int_mm(rounded_BK, self.weight_NK.t())  # pyright: ignore[reportPrivateUsage]
        outputs_BN = sums_BN.float().mul_(scale_B1).mul_(self.scale_N)
        if self.bias is not None:
            outputs_BN += self.bias
        return outputs_BN.reshape(*inputs.shape[:-1], -1)


def to_int8(model: nn.Module) -> None:
    """Replace the linear layers of a model by ones in whole numbers; only weights that others hold stay in memory."""
    for parent in list(model.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.Linear):
                setattr(parent, name, Int8Linear(child))


def _scale(values_NK: Tensor) -> Tensor:
    return values_NK.abs().amax(1, keepdim=True).clamp_min(1e-12) / LARGEST
