"""One seed, many named streams: each part of a run draws from its own generator."""

import hashlib

import numpy as np
import torch


def stream_seed(seed: int, name: str) -> int:
    """Return the 63-bit seed of the stream `name` under the run's `seed`."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def numpy_stream(seed: int, name: str) -> np.random.Generator:
    """Return a fresh NumPy generator for the stream `name`."""
    return np.random.default_rng(stream_seed(seed, name))


def torch_stream(seed: int, name: str, device: str = "cpu") -> torch.Generator:
    """Return a fresh torch generator for the stream `name`."""
    return torch.Generator(device).manual_seed(stream_seed(seed, name))
