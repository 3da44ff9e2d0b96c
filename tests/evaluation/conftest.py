from typing import Any

import numpy as np
import pytest
from toy_worlds import ToyWorlds

import rapid


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> list[ToyWorlds]:
    """Put toy worlds in the place of `rapid.make_vec`; the list holds those that were made."""
    made: list[ToyWorlds] = []

    def make(scenario: str, num_envs: int, simulator: str, config: dict[str, Any], autoreset: bool) -> ToyWorlds:
        assert not autoreset
        assert config == {"observation": {"vehicles_count": 15}}
        made.append(ToyWorlds(num_envs))
        return made[-1]

    monkeypatch.setattr(rapid, "make_vec", make, raising=False)
    return made


class Constant:
    """Always the same action."""

    def __init__(self, action: int, name: str = "constant") -> None:
        self.action, self.name = action, name

    def act(self, obs_BVF: np.ndarray) -> np.ndarray:
        return np.full(len(obs_BVF), self.action)


@pytest.fixture
def constant() -> type[Constant]:
    return Constant
