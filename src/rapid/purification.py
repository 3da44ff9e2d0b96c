"""What purifying defences squeeze observations through: few numbers, fitted on shipped data (Mohan et al., 2025).

Shapes: B batch, V vehicles, F features, N observations of the data, D numbers of an observation, C components.
"""

from functools import lru_cache

import torch
from torch import Tensor, nn

from rapid.data.shipped import shipped_sets
from rapid.errors import RapidError
from rapid.networks.encoding import feature_scale
from rapid.scenarios import NUM_FEATURES, NUM_VEHICLES, get_scenario
from rapid.seeding import torch_stream

NUMBERS = NUM_VEHICLES * (NUM_FEATURES - 1)
"""D: of an observation without presence."""
HIDDEN, EPOCHS, BATCH, RATE = 64, 30, 512, 2e-3
"""Of the autoencoder: width of its hidden layers, and how it is fitted."""


def numbers_of(obs_BVF: Tensor, scale_4: Tensor) -> Tensor:
    """Return observations as a purifier reads them (B, D)."""
    ahead_BV1 = obs_BVF[..., 1:2] - obs_BVF[:, :1, 1:2]
    scaled_BV4 = torch.cat([ahead_BV1, obs_BVF[..., 2:]], -1) / scale_4
    return torch.where(obs_BVF[..., :1] > 0.5, scaled_BV4, 0.0).flatten(1)


class Principal(nn.Module):
    """The first principal components."""

    mean_D: Tensor
    axes_DC: Tensor

    def __init__(self, data_ND: Tensor, size: int) -> None:
        super().__init__()
        data_ND = data_ND.double()
        mean_D = data_ND.mean(0)
        _, vectors_DD = torch.linalg.eigh((data_ND - mean_D).T @ (data_ND - mean_D))
        self.register_buffer("mean_D", mean_D.float())
        self.register_buffer("axes_DC", vectors_DD[:, -size:].float())

    def forward(self, numbers_BD: Tensor) -> Tensor:
        """Return the nearest point of their span (B, D)."""
        return self.mean_D + (numbers_BD - self.mean_D) @ self.axes_DC @ self.axes_DC.T


def _autoencoder(data_ND: Tensor, size: int) -> nn.Module:
    """Return an autoencoder with a bottleneck of `size` numbers, fitted; the same for the same data."""
    source = torch_stream(0, f"autoencoder/{size}")
    with torch.random.fork_rng(devices=[]), torch.inference_mode(False), torch.enable_grad():
        torch.manual_seed(int(torch.randint(2**31, (1,), generator=source)))
        network = nn.Sequential(
            *(nn.Linear(NUMBERS, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, size)),
            *(nn.Linear(size, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, NUMBERS)),
        )
        optimizer = torch.optim.Adam(network.parameters(), RATE)
        for _ in range(EPOCHS):
            for rows in torch.randperm(len(data_ND), generator=source).split(BATCH):
                loss = (network(data_ND[rows]) - data_ND[rows]).square().sum(1).mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
    return network.requires_grad_(False).eval()


@lru_cache
def fitted(kind: str, size: int, road: str) -> nn.Module:
    """Return what squeezes observations of a road, fitted on what its shipped random and teacher drivers saw."""
    from rapid.data.dataset import load_dataset

    names = [f"{road}/{driver}" for driver in ("random", "teacher")]
    if missing := set(names) - set(shipped_sets()):
        raise RapidError(
            f"A purifier is fitted on shipped data, and there is none called {', '.join(sorted(missing))}. Choose a "
            f"scenario among {', '.join(sorted({name.partition('/')[0] for name in shipped_sets()}))}, or a defence "
            "that is not fitted."
        )
    parts = [torch.from_numpy(load_dataset(f"shipped:{name}").transitions.obs_NVF) for name in names]
    data_ND = numbers_of(torch.cat(parts)[:, :NUM_VEHICLES], feature_scale(get_scenario(road).lanes)[1:])
    return Principal(data_ND, size) if kind == "purify-pca" else _autoencoder(data_ND, size)
