"""Where attacks draw from: one generator, or one for each observation, so that nothing depends on the batch."""

from collections.abc import Sequence

import torch
from torch import Tensor

Source = torch.Generator | Sequence[torch.Generator]
"""One generator for a whole batch (training), or one for each of its observations (measuring)."""


def uniform(shape: Sequence[int], source: Source, device: torch.device | str = "cpu") -> Tensor:
    """Return numbers uniform in [0, 1); with a generator each, those of row i come from generator i alone."""
    if isinstance(source, torch.Generator):
        return torch.rand(*shape, generator=source, device=source.device).to(device)
    return torch.stack([torch.rand(*shape[1:], generator=each) for each in _checked(source, shape)]).to(device)


def normal(shape: Sequence[int], source: Source, device: torch.device | str = "cpu") -> Tensor:
    """Return normal numbers of mean 0 and deviation 1, drawn as by :func:`uniform`."""
    if isinstance(source, torch.Generator):
        return torch.randn(*shape, generator=source, device=source.device).to(device)
    return torch.stack([torch.randn(*shape[1:], generator=each) for each in _checked(source, shape)]).to(device)


def chosen(source: Source, rows: Sequence[int]) -> Source:
    """Return the source of some rows of a batch."""
    return source if isinstance(source, torch.Generator) else [source[row] for row in rows]


def _checked(source: Sequence[torch.Generator], shape: Sequence[int]) -> Sequence[torch.Generator]:
    if len(source) != shape[0]:
        raise ValueError(f"{len(source)} generators for {shape[0]} observations")
    return source
