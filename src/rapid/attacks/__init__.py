"""Attacks on what an agent sees: the paper's four, by name (paper: section 4.5).

Sizes are in features normalised by highway-env's ranges, so 0.1 is 20 m along the road, 0.4 m times the number of lanes
across it, and 8 m/s.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from rapid.attacks.gradient import maximize_loss
from rapid.attacks.noise import add_noise
from rapid.config import RobustConfig
from rapid.errors import RapidError, did_you_mean
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import QNetwork

__all__ = ["ATTACKS", "Attack", "get_attack"]


class Attack(Protocol):
    """Changes observations before the agent sees them."""

    @property
    def name(self) -> str:
        """The name under which :func:`get_attack` finds it."""
        ...

    @property
    def needs_gradient(self) -> bool:
        """Whether it needs the agent's network; other attacks work on any agent."""
        ...

    def describe(self, lanes: int) -> str:
        """Return its size in words, in normalised features and in metres and m/s on a road with `lanes` lanes."""
        ...

    def __call__(self, network: QNetwork | None, obs_BVF: Tensor, generator: torch.Generator) -> Tensor:
        """Return the attacked observations (B, V, F); the given ones are left as they are."""
        ...


@dataclass(frozen=True)
class NoAttack:
    """Leaves the observations as they are."""

    name: str = "none"
    needs_gradient: bool = False

    def describe(self, lanes: int) -> str:
        """Return its size in words."""
        return "no perturbation"

    def __call__(self, network: QNetwork | None, obs_BVF: Tensor, generator: torch.Generator) -> Tensor:
        """Return the observations."""
        return obs_BVF


@dataclass(frozen=True)
class NoiseAttack:
    """Independent noise on every feature."""

    name: str
    kind: Literal["uniform", "gaussian"]
    size: float
    lanes: int | None
    attack_presence: bool
    needs_gradient: bool = False

    def describe(self, lanes: int) -> str:
        """Return its size in words."""
        kind = "uniform within ±" if self.kind == "uniform" else "Gaussian, standard deviation "
        return f"{kind}{in_units(self.size, self.lanes or lanes)}{_presence(self.attack_presence)}"

    def __call__(self, network: QNetwork | None, obs_BVF: Tensor, generator: torch.Generator) -> Tensor:
        """Return the noisy observations."""
        scale_F = _scale(self.name, self.lanes, network, obs_BVF)
        return add_noise(obs_BVF, scale_F, self.kind, self.size, self.attack_presence, generator)


@dataclass(frozen=True)
class GradientAttack:
    """Projected gradient ascent on the cross-entropy of the agent's own greedy action."""

    name: str
    ball: RobustConfig
    lanes: int | None
    needs_gradient: bool = True

    def describe(self, lanes: int) -> str:
        """Return its size in words."""
        ball = self.ball
        norm = "L∞" if ball.norm == "linf" else "L2"
        steps = "1 step" if ball.steps == 1 else f"{ball.steps} steps of {ball.step_size:g}"
        size = in_units(ball.radius, self.lanes or lanes)
        return f"{norm} ball of radius {size}, {steps}{_presence(ball.attack_presence)}"

    def __call__(self, network: QNetwork | None, obs_BVF: Tensor, generator: torch.Generator) -> Tensor:
        """Return the observations against which the network's greedy action fares worst."""
        if network is None:
            raise RapidError(
                f"The attack '{self.name}' needs the gradient of a network, and this agent has none. "
                "Choose an attack without gradients ('uniform', 'gaussian') or a saved agent."
            )
        with torch.no_grad():
            q_BA = network(obs_BVF)
        labels_BA = torch.nn.functional.one_hot(q_BA.argmax(-1), q_BA.shape[-1]).to(q_BA.dtype)
        scale_F = _scale(self.name, self.lanes, network, obs_BVF)
        return maximize_loss(network, obs_BVF, labels_BA, scale_F, self.ball, generator=generator)


def _gradient(name: str, steps: int, step_size: float, lanes: int | None, attack_presence: bool) -> Attack:
    ball = RobustConfig("linf", 0.1, steps, step_size, random_start=False, attack_presence=attack_presence)
    return GradientAttack(name, ball, lanes)


ATTACKS: dict[str, Callable[[int | None, bool], Attack]] = {
    "none": lambda lanes, presence: NoAttack(),
    "uniform": lambda lanes, presence: NoiseAttack("uniform", "uniform", 0.2, lanes, presence),
    "gaussian": lambda lanes, presence: NoiseAttack("gaussian", "gaussian", 0.2, lanes, presence),
    "fgsm": lambda lanes, presence: _gradient("fgsm", 1, 0.1, lanes, presence),
    "pgd": lambda lanes, presence: _gradient("pgd", 10, 0.01, lanes, presence),
}
"""Makers of attacks, by name; they take the lanes, or None, and whether presence may be changed."""


def get_attack(name: str, lanes: int | None = None, attack_presence: bool = False) -> Attack:
    """Return the attack called `name`.

    Args:
        name: one of :data:`ATTACKS`.
        lanes: lanes of the road whose ranges give the sizes their metres, so that every agent meets the same attack;
            None takes the ranges stored with the agent's network.
        attack_presence: whether the presence feature may be changed too.

    Raises:
        RapidError: there is no such attack.
    """
    if name not in ATTACKS:
        raise RapidError(f"Unknown attack '{name}'{did_you_mean(name, ATTACKS)} Known attacks: {', '.join(ATTACKS)}.")
    return ATTACKS[name](lanes, attack_presence)


def in_units(size: float, lanes: int) -> str:
    """Return a size in normalised features as text, with what it is in metres and m/s."""
    _, x, y, vx, _ = (float(unit) * size for unit in feature_scale(lanes))
    return f"{size:g} ({x:g} m along, {y:.3g} m across, {vx:g} m/s)"


def _presence(attacked: bool) -> str:
    return ", presence too" if attacked else ""


def _scale(name: str, lanes: int | None, network: QNetwork | None, obs_BVF: Tensor) -> Tensor:
    if lanes is not None:
        return feature_scale(lanes).to(obs_BVF.device)
    if network is None:
        raise RapidError(f"The attack '{name}' does not know the road: give get_attack the number of lanes.")
    return network.scale_F
