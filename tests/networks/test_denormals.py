"""Denormal numbers are left out where it saves time, and nowhere else."""

import pytest
import torch

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
def test_an_attack_computes_without_them_and_restores_them(attack) -> None:
    seen: list[float] = []

    def values(obs_BVF: torch.Tensor) -> torch.Tensor:
        seen.append(smallest())
        return obs_BVF.sum(1)

    get_attack(attack, 3)(values, torch.rand(2, 15, 5), torch.Generator())
    assert seen[0] > 0, "the action on the true observation is found as it is when driving"
    assert set(seen[1:]) == {0.0}
    assert smallest() > 0
