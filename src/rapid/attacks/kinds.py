"""The kinds of attacks, each as one small class around the search that it does."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from rapid.attacks.attack import Base, Field, Moment, Needs, Shown
from rapid.attacks.directed import ORDERS, direct
from rapid.attacks.draws import Source, uniform
from rapid.attacks.noise import add_noise, lies
from rapid.attacks.search import Runs, ascend, own_action
from rapid.attacks.spec import AttackSpec, fields_of
from rapid.attacks.square import squares

_RUN_FIELDS = tuple(key for key in fields_of("transfer") if key != "source")


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


class DirectedAttack(Base):
    """Of the actions that some point of the ball reaches, the first in an order of preference."""

    needs: Needs = "gradient"

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the observations at which the network takes that action."""
        ball, spec = self.ball(network, obs_BVF), self.spec
        runs = Runs(spec.steps, spec.step, spec.restarts, spec.start, stop=True)
        return direct(self.network(network), obs_BVF, ORDERS[spec.target], ball, runs, source)


class SquareAttack(Base):
    """Random search, without gradients."""

    needs: Needs = "values"

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the best of the points tried."""
        values, ball = self.network(network), self.ball(network, obs_BVF)
        return squares(values, obs_BVF, own_action(values, obs_BVF, self.spec.loss), ball, self.spec.queries, source)


class TransferAttack(Base):
    """The points against which another agent fares worst."""

    def __init__(self, spec: AttackSpec, lanes: int | None) -> None:
        from rapid.agents.saved import load_agent

        super().__init__(spec, lanes)
        self._attack = GradientAttack(AttackSpec("pgd", **{key: getattr(spec, key) for key in _RUN_FIELDS}), lanes)
        self._network = load_agent(spec.source).network

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the observations against which the other agent fares worst."""
        device = obs_BVF.device
        return self._attack(self._network, obs_BVF.to(self._network.scale_F.device), source).to(device)


class LieAttack(Base):
    """The same lie in every step of an episode: no filter over time finds it."""

    def begin(self, field: Field) -> Shown:
        """Return what is shown in these episodes; what is drawn is drawn at the first step."""
        drawn: dict[int, Tensor] = {}

        def shown(now: Moment) -> Tensor:
            worlds = now.worlds.tolist()
            for world in worlds:
                if world not in drawn:
                    shape, device = (1, *now.obs_BVF.shape[1:]), now.obs_BVF.device
                    drawn[world] = uniform(shape, [field.streams[world]], device)
            return self._at(now.values, now.obs_BVF, torch.cat([drawn[world] for world in worlds]))

        return shown

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return the observations with the lie in them."""
        return self._at(network, obs_BVF, uniform(obs_BVF.shape, source, obs_BVF.device))

    def _at(self, network: Any, obs_BVF: Tensor, drawn_BVF: Tensor) -> Tensor:
        ball = self.ball(network, obs_BVF)
        offset_BVF = lies(self.spec.to, drawn_BVF) * ball.radius
        return ball.at(obs_BVF, ball.project(offset_BVF))


class CoupledAttack(Base):
    """Gradient ascent whose perturbation of each row of the observation changes little from one step to the next."""

    needs: Needs = "gradient"

    def begin(self, field: Field) -> Shown:
        """Return what is shown in these episodes: before the first step nothing is perturbed."""
        before: dict[int, Tensor] = {}

        def shown(now: Moment) -> Tensor:
            worlds, none_VF = now.worlds.tolist(), torch.zeros_like(now.obs_BVF[0])
            before_BVF = torch.stack([before.get(world, none_VF) for world in worlds])
            seen_BVF, offset_BVF = self._step(now.values, now.obs_BVF, field.sources(now.worlds), before_BVF)
            before.update(zip(worlds, offset_BVF, strict=True))
            return seen_BVF

        return shown

    def __call__(self, network: Any, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return what is shown in a first step."""
        return self._step(network, obs_BVF, source, torch.zeros_like(obs_BVF))[0]

    def _step(self, network: Any, obs_BVF: Tensor, source: Source, before_BVF: Tensor) -> tuple[Tensor, Tensor]:
        values, spec, free = self.network(network), self.spec, self.ball(network, obs_BVF)
        ball = replace(free, before_BVF=before_BVF, coupling=spec.coupling * free.radius)
        runs = Runs(spec.steps, spec.step, spec.restarts)
        seen_BVF = ascend(values, obs_BVF, own_action(values, obs_BVF, spec.loss), ball, runs, source)
        scale_VF = torch.where(free.scale_VF > 0, free.scale_VF, 1.0)
        return seen_BVF, ball.project((seen_BVF - obs_BVF) / scale_VF)
