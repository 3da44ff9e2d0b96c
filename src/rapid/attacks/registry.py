"""From a spec to an attack that can be made on observations."""

from collections.abc import Callable
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from rapid.attacks.draws import Source
from rapid.attacks.noise import add_noise
from rapid.attacks.search import Ball, Runs, Values, ascend, own_action
from rapid.attacks.spec import AttackSpec, as_spec
from rapid.errors import RapidError
from rapid.networks.encoding import feature_scale

Needs = Literal["nothing", "values", "gradient"]
"""What an attack asks of the agent: nothing, its Q-values, or a network that can be differentiated."""


class Attack(Protocol):
    """Changes observations before the agent sees them."""

    @property
    def spec(self) -> AttackSpec:
        """What it is."""
        ...

    @property
    def name(self) -> str:
        """How tables call it."""
        ...

    @property
    def needs(self) -> Needs:
        """What it asks of the agent."""
        ...

    @property
    def needs_gradient(self) -> bool:
        """Whether it needs the agent's network."""
        ...

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the attacked observations (B, V, F); the given ones are left as they are.

        Args:
            network: Q-values (B, A) of raw observations; None if the attack needs nothing.
            obs_BVF: the true observations, metres and m/s.
            source: of what is drawn: one generator, or one for each observation.
        """
        ...


class Base:
    """What all attacks share."""

    needs: Needs = "nothing"

    def __init__(self, spec: AttackSpec, lanes: int | None) -> None:
        self.spec, self.lanes = spec, lanes

    @property
    def name(self) -> str:
        """How tables call it."""
        return self.spec.shown

    @property
    def needs_gradient(self) -> bool:
        """Whether it needs the agent's network."""
        return self.needs == "gradient"

    def ball(self, network: Any, obs_BVF: Tensor) -> Ball:
        """Return what may be shown, for observations of this shape.

        Raises:
            RapidError: neither the attack nor the network knows how many lanes the road has.
        """
        spec, lanes = self.spec, self.lanes or getattr(network, "lanes", None)
        if spec.metres or spec.speed:
            # A box: 1 is its half width in every feature.
            scale_F, radius = torch.tensor(spec.sizes(lanes=1)), 1.0
        elif lanes is None:
            raise RapidError(f"The attack '{self.name}' does not know the road: give get_attack the number of lanes.")
        else:
            scale_F, radius = feature_scale(lanes), spec.radius
        scale_VF = scale_F.repeat(obs_BVF.shape[1], 1)
        if spec.presence == "masked":
            scale_VF[:, 0] = 0
        if spec.ego == "trusted":
            scale_VF[0] = 0
        return Ball(spec.norm, radius, scale_VF.to(obs_BVF.device))

    def network(self, network: Any) -> Values:
        """Return the network.

        Raises:
            RapidError: there is none.
        """
        if network is None:
            raise RapidError(
                f"The attack '{self.name}' needs the gradient of a network, and this agent has none. "
                "Choose an attack without gradients (uniform, gaussian, lie, square, transfer) or a saved agent."
            )
        return network


class NoAttack(Base):
    """Leaves the observations as they are."""

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the observations."""
        return obs_BVF


class NoiseAttack(Base):
    """Independent noise on every feature."""

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the noisy observations."""
        ball = self.ball(network, obs_BVF)
        kind = "uniform" if self.spec.kind == "uniform" else "gaussian"
        return add_noise(obs_BVF, ball.scale_VF * ball.radius, kind, source)


class GradientAttack(Base):
    """Projected gradient ascent on a loss of the agent's own greedy action; FGSM is one step as long as the radius."""

    needs: Needs = "gradient"

    def runs(self, radius: float) -> Runs:
        """Return how hard is searched within a ball of this radius."""
        spec = self.spec
        if spec.kind == "fgsm":
            return Runs(1, radius, keep=spec.keep)
        return Runs(spec.steps, spec.step, spec.restarts, spec.start, spec.keep)

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the observations against which the network's greedy action fares worst."""
        values, ball = self.network(network), self.ball(network, obs_BVF)
        aim = own_action(values, obs_BVF, self.spec.loss)
        return ascend(values, obs_BVF, aim, ball, self.runs(ball.radius), source)


_MAKERS: dict[str, Callable[[AttackSpec, int | None], Attack]] = {
    "none": NoAttack,
    "uniform": NoiseAttack,
    "gaussian": NoiseAttack,
    "fgsm": GradientAttack,
    "pgd": GradientAttack,
}


def get_attack(attack: str | AttackSpec, lanes: int | None = None) -> Attack:
    """Return an attack by its text or spec.

    Args:
        attack: such as ``pgd``, ``pgd:steps=50,restarts=5,radius=0.02`` or a spec; see :mod:`rapid.attacks.spec`.
        lanes: lanes of the road whose ranges give the sizes their metres, so that every agent meets the same attack;
            None takes those of the agent's network.

    Raises:
        RapidError: there is no such attack.
    """
    spec = as_spec(attack)
    return _MAKERS[spec.kind](spec, lanes)
