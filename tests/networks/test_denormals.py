"""Denormal numbers are left out where it saves time, and nowhere else."""

from typing import Any

import numpy as np
import pytest
import torch

from rapid.agents.onnx import driven_observations
from rapid.agents.saved import load_agent
from rapid.attacks.registry import get_attack
from rapid.networks.denormals import no_denormals

TINY = 1e-40


def smallest() -> float:
    return (torch.full((4,), TINY) * 1).amax().item()


def test_only_within() -> None:
    assert smallest() > 0
    with no_denormals():
        assert smallest() == 0
        with no_denormals():
            assert smallest() == 0
        assert smallest() == 0
    assert smallest() > 0
    with pytest.raises(ZeroDivisionError), no_denormals():
        raise ZeroDivisionError
    assert smallest() > 0


@pytest.mark.parametrize("attack", ["fgsm", "pgd", "pgd:steps=3,restarts=2,loss=mad"])
def test_an_attack_computes_without_them_and_restores_them(attack: str) -> None:
    seen: list[float] = []

    def values(obs_BVF: torch.Tensor) -> torch.Tensor:
        seen.append(smallest())
        return obs_BVF.sum(1)

    get_attack(attack, 3)(values, torch.rand(2, 15, 5), torch.Generator())
    assert seen[0] > 0, "the action on the true observation is found as it is when driving"
    assert set(seen[1:]) == {0.0}
    assert smallest() > 0


def test_q_values_are_the_same_without_them() -> None:
    """Threads that keep the mode after a training change no result."""
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such mode")
    agent, met = load_agent("shipped:lane-3-density-2/distilled"), 0
    obs_BVF, _ = driven_observations(agent, "lane-3-density-2", range(900_000, 900_012))
    # Far from all that it was trained on its activations fade.
    obs_BVF[..., 1:] += np.random.default_rng(0).normal(0, 100, obs_BVF[..., 1:].shape).astype(np.float32)

    def count(module: Any, inputs: Any, output: Any) -> None:
        nonlocal met
        if isinstance(output, torch.Tensor):
            met += int(((output != 0) & (output.abs() < torch.finfo(output.dtype).tiny)).sum())

    hooks = [module.register_forward_hook(count) for module in agent.network.modules()]
    expected = agent.q_values(obs_BVF)
    for hook in hooks:
        hook.remove()
    assert met > 0
    with no_denormals():
        np.testing.assert_array_equal(agent.q_values(obs_BVF), expected)
