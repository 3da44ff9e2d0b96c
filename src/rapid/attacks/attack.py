"""What every attack is: what it asks of an agent, what may be shown, and how episodes begin."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.attacks.draws import Source
from rapid.attacks.search import AtState, Ball, Values
from rapid.attacks.spec import AttackSpec
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

    def check(self, agent: Any) -> None:
        """Check that the attack can be made on an agent that offers what it needs.

        Raises:
            RapidError: it was made for another.
        """
        ...

    def begin(self, field: "Field") -> "Shown":
        """Return what is shown in episodes that begin now."""
        ...

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the attacked observations (B, V, F), each on its own; the given ones are left as they are.

        Args:
            network: Q-values (B, A) of raw observations; None if the attack needs nothing.
            obs_BVF: the true observations, metres and m/s.
            source: of what is drawn: one generator, or one for each observation.
        """
        ...


@dataclass(frozen=True)
class Moment:
    """One step of the worlds still under way."""

    obs_BVF: Tensor
    """Their true observations, metres and m/s."""
    worlds: NDArray[np.int64]
    """Which worlds they are."""
    values: Values | None
    """The agent's Q-values (B, A) of raw observations, if it has any: what it remembers is in them."""
    state_BS: NDArray[np.float32] | None = None
    """What it remembers, if it has a memory."""
    env: Any = None
    """The environment that holds all worlds."""


Shown = Callable[[Moment], Tensor]
"""What the agent is shown at a moment (B, V, F)."""


@dataclass(frozen=True)
class Field:
    """Episodes that are driven side by side under an attack."""

    agent: Any
    """Who drives."""
    streams: Sequence[torch.Generator]
    """One for each episode."""
    scenario: str = ""
    seeds: Sequence[int] = ()
    """The spawn seed of each."""

    def sources(self, worlds: NDArray[np.int64]) -> list[torch.Generator]:
        """Return the streams of some of them."""
        return [self.streams[world] for world in worlds.tolist()]


def network_of(agent: Any) -> torch.nn.Module | None:
    """Return the agent's network, if it has one."""
    network = getattr(agent, "network", None)
    return network if isinstance(network, torch.nn.Module) else None


def values_of(agent: Any, state_BS: NDArray[np.float32] | None = None) -> Values | None:
    """Return the agent's Q-values as a function of raw observations: its network, or what it says without one.

    Args:
        agent: who drives.
        state_BS: what it remembers beside each observation, if it has a memory.
    """
    network, q_values = network_of(agent), getattr(agent, "q_values", None)
    if network is not None:
        device = next(network.parameters()).device
        return network if state_BS is None else AtState(network, torch.from_numpy(state_BS).to(device))
    if not callable(q_values):
        return None
    if state_BS is None:
        return lambda obs_BVF: torch.from_numpy(np.array(q_values(obs_BVF.numpy()), np.float32))

    def remembering(obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        return torch.from_numpy(np.array(q_values(obs_BVF.numpy(), state_BS.numpy()), np.float32))

    return AtState(remembering, torch.from_numpy(state_BS))


def offers(agent: Any) -> tuple[Needs, ...]:
    """Return what an agent has of that which attacks need.

    One that is bound to the worlds sees no observation, so no attack can be made on it.
    """
    if callable(getattr(agent, "bind", None)):
        return ()
    if network_of(agent) is not None:
        return ("nothing", "values", "gradient")
    return ("nothing", "values") if values_of(agent) is not None else ("nothing",)


class Base(ABC):
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

    @abstractmethod
    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the attacked observations."""

    def check(self, agent: Any) -> None:
        """Check that the attack can be made on an agent that offers what it needs.

        Raises:
            RapidError: it was made for another.
        """
        return

    def begin(self, field: Field) -> Shown:
        """Return what is shown in these episodes; whatever an attack remembers, it remembers there."""
        return lambda now: self(now.values, now.obs_BVF, field.sources(now.worlds))

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
            scale_F, radius = feature_scale(lanes) * torch.tensor(spec.mask()), spec.radius
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
