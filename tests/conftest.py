"""Shared by all tests: one thread, and observations as a road gives them."""

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import browser

torch.set_num_threads(1)
# Ray's workers are as polite as can be by default, and starve where another program runs beside the tests.
os.environ.setdefault("RAY_worker_niceness", "0")


class Roads:
    """Makes observations (B, 15, 5) of random traffic, metres and m/s, some rows absent and then zero."""

    def __call__(self, batch: int, seed: int = 0, absent: float = 0.2, lanes: int = 3) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        obs = torch.rand(batch, 15, 5, generator=generator) * torch.tensor([1.0, 400.0, 1.0, 32.0, 2.0])
        obs[..., 2] = 4.0 * torch.randint(0, lanes, (batch, 15), generator=generator)
        obs[..., 1] += 200
        obs[..., 0] = (torch.rand(batch, 15, generator=generator) >= absent).float()
        obs[:, 0, 0] = 1
        return obs * obs[..., :1]


@pytest.fixture
def roads() -> Roads:
    """Give the maker of observations."""
    return Roads()


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """Give the system's Chromium; skips where there is none, and fails in CI."""
    with browser.launched() as started:
        yield started


if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a shell, Ctrl-C is ignored here and in every process that a test starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
