"""Adam, as lean as it gets: torch's own fused kernel without the bookkeeping around it.

The weights after a step are those of `torch.optim.Adam`, bit for bit. Its bookkeeping takes longer than the arithmetic
where a network is as small as the baselines': a fifth of an update.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

BETAS = (0.9, 0.999)
"""Decay of the averages of the gradient and of its square."""
EPSILON = 1e-8


class Adam:
    """Moves `parameters` in place by their gradients.

    Args:
        parameters: what is trained.
        rates: by what each parameter's step size is multiplied; None is 1 for all.
    """

    def __init__(self, parameters: Sequence[Tensor], rates: Sequence[float] | None = None) -> None:
        # Detached, they share the parameters' memory and no step needs to say that it takes no gradient.
        self._weights = [parameter.detach() for parameter in parameters]
        self._mean = [torch.zeros_like(weight) for weight in self._weights]
        self._square = [torch.zeros_like(weight) for weight in self._weights]
        # The kernel knows one step size, so there is a call for each rate.
        self._groups: dict[float, list[int]] = {}
        for index, rate in enumerate(rates or [1.0] * len(self._weights)):
            self._groups.setdefault(rate, []).append(index)
        # One count for all: the kernel wants one for each weight, but they never differ.
        self._count = torch.zeros((), device=self._weights[0].device)

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], learning_rate: float | Tensor) -> None:
        """Take one step down the gradients, one for each parameter.

        Args:
            gradients: of the parameters, in their order.
            learning_rate: the size of the step; a scalar tensor on the parameters' device spares waiting for it.
        """
        self._count += 1
        for rate, group in self._groups.items():
            torch._fused_adam_(  # pyright: ignore[reportPrivateUsage]
                [self._weights[index] for index in group],
                [gradients[index] for index in group],
                [self._mean[index] for index in group],
                [self._square[index] for index in group],
                [],
                [self._count] * len(group),
                lr=rate * learning_rate,
                beta1=BETAS[0],
                beta2=BETAS[1],
                weight_decay=0.0,
                eps=EPSILON,
                amsgrad=False,
                maximize=False,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs."""
        return {"count": self._count, "mean": self._mean, "square": self._square}

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Become as the optimiser was whose `state_dict` this is."""
        self._count.copy_(state["count"])
        for mine, saved in (
            *zip(self._mean, state["mean"], strict=True),
            *zip(self._square, state["square"], strict=True),
        ):
            mine.copy_(saved)


@torch.no_grad()
def clip_norm(gradients: tuple[Tensor, ...] | list[Tensor], largest: float, members: int = 1) -> Tensor:
    """Scale the gradients in place so that their norm, all together, is at most `largest`; return what it was.

    With several members, the first axis of every gradient, each has a norm of its own: the result is (S,).
    """
    if members > 1:
        norm_S = torch.stack([gradient.flatten(1).square().sum(1) for gradient in gradients]).sum(0).sqrt()
        scale_S = (largest / (norm_S + 1e-6)).clamp(max=1.0)
        for gradient in gradients:
            gradient.mul_(scale_S.view(-1, *[1] * (gradient.dim() - 1)))
        return norm_S
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))  # pyright: ignore[reportPrivateUsage]
    torch._foreach_mul_(gradients, (largest / (norm + 1e-6)).clamp(max=1.0))  # pyright: ignore[reportPrivateUsage]
    return norm
