"""Who lies to the policy while phase 3 learns: a mixture of attacks, one for each episode, a new point at each step.

The policy sees what the adversary leaves of the observation; critic, reward and memory have the truth. Sizes are in
features normalised by highway-env's ranges, as everywhere (:mod:`rapid.attacks`).

Shapes: W worlds, V vehicles, F features, A actions, S entries of a state.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.config_learning import AdversaryConfig
from rapid.scenarios import NUM_ACTIONS

CLEAN, NOISE, AWAY, TOWARDS = range(4)
"""What an episode is under: nothing, uniform noise, gradients away from the greedy action, or towards a drawn one."""


class Adversary:
    """Draws what each world's episode is under, and attacks every step of it.

    Args:
        config: the mixture.
        count: W.
        scale_F: what 1 means in each normalised feature.
        temperature: T of the policy softmax(Q / T).
        generator: the source of all its chance; whoever resumes sets its state.
    """

    def __init__(
        self, config: AdversaryConfig, count: int, scale_F: Tensor, temperature: float, generator: torch.Generator
    ) -> None:
        self.config, self._scale_F, self._temperature, self._generator = config, scale_F, temperature, generator
        gradient = config.gradient_share
        shares = [
            1 - config.noise_share - gradient,
            config.noise_share,
            gradient * (1 - config.targeted_share),
            gradient * config.targeted_share,
        ]
        self._shares = torch.tensor(shares, device=generator.device).clamp_min(0)
        self.kind_W = torch.zeros(count, dtype=torch.long, device=generator.device)
        self.begin(np.ones(count, np.bool_))

    @property
    def active(self) -> bool:
        """Whether it ever does anything."""
        return self.config.gradient_share + self.config.noise_share > 0

    def begin(self, ended_W: NDArray[np.bool_]) -> None:
        """Draw anew for the worlds whose episode has ended."""
        if self.active and ended_W.any():
            drawn_W = torch.multinomial(self._shares, len(self.kind_W), True, generator=self._generator)
            self.kind_W = torch.where(torch.from_numpy(ended_W).to(drawn_W.device), drawn_W, self.kind_W)

    def __call__(
        self, q_of: Callable[[Tensor, Tensor | None], Tensor], obs_WVF: Tensor, state_WS: Tensor | None, size: float
    ) -> Tensor:
        """Return what the policy sees (W, V, F).

        Args:
            q_of: observations and states to Q-values.
            obs_WVF: the truth, as the policy would see it.
            state_WS: the policy's memory, if it has one; the adversary knows it.
            size: by what the radius and the noise are multiplied, 0 to 1.
        """
        if not self.active or not size:
            return obs_WVF
        seen_WVF = obs_WVF.clone()
        kind_W = self.kind_W.to(obs_WVF.device)
        noisy = (kind_W == NOISE).nonzero().squeeze(1)
        if len(noisy):
            seen_WVF[noisy] += self._draw(obs_WVF[noisy]) * (self.config.noise * size)
        chosen = (kind_W >= AWAY).nonzero().squeeze(1)
        if len(chosen):
            states = None if state_WS is None else state_WS[chosen]
            seen_WVF[chosen] = self._ascend(q_of, obs_WVF[chosen], states, kind_W[chosen] == TOWARDS, size)
        return seen_WVF

    def _draw(self, obs_BVF: Tensor) -> Tensor:
        """Return uniform offsets within +-1 normalised, in metres and m/s, for all features but presence."""
        device = self._generator.device
        drawn_BVF = torch.rand(obs_BVF.shape, generator=self._generator, device=device).to(obs_BVF.device)
        return (drawn_BVF * 2 - 1) * self._reach_F

    @property
    def _reach_F(self) -> Tensor:
        reach_F = self._scale_F.clone()
        reach_F[0] = 0
        return reach_F

    def _ascend(
        self,
        q_of: Callable[[Tensor, Tensor | None], Tensor],
        obs_BVF: Tensor,
        state_BS: Tensor | None,
        towards_B: Tensor,
        size: float,
    ) -> Tensor:
        """Projected gradient ascent, from the truth or from a random point of the ball."""
        config, reach_F = self.config, self._reach_F * size
        with torch.no_grad():
            greedy_B = q_of(obs_BVF, state_BS).argmax(1)
        drawn_B = torch.randint(NUM_ACTIONS, greedy_B.shape, generator=self._generator, device=self._generator.device)
        action_B1 = torch.where(towards_B, drawn_B.to(greedy_B.device), greedy_B)[:, None]
        sign_B = torch.where(towards_B, -1.0, 1.0)
        # The attacks of the paper's table read Q-values at temperature 1, the policy acts at its own.
        temperature_B1 = torch.where(towards_B, self._temperature, 1.0)[:, None]
        # Who starts far away is noticed. So some climb in short steps from the truth, as the attacks that are measured.
        near_B = torch.rand(len(obs_BVF), generator=self._generator, device=self._generator.device) < config.near_share
        near_B11 = near_B.to(obs_BVF.device)[:, None, None]
        start_BVF = obs_BVF + self._draw(obs_BVF) * (config.radius * size)
        if config.spared_share:
            drawn_B = torch.rand(len(obs_BVF), generator=self._generator, device=self._generator.device)
            spared_B = (drawn_B < config.spared_share).to(obs_BVF.device)
            reach_F = reach_F.expand_as(obs_BVF).clone()
            reach_F[spared_B, 0] = 0
            start_BVF[spared_B, 0] = obs_BVF[spared_B, 0]
        low_BVF, high_BVF = obs_BVF - config.radius * reach_F, obs_BVF + config.radius * reach_F
        seen_BVF = torch.where(near_B11, obs_BVF, start_BVF)
        step_BVF = torch.where(near_B11, config.radius / config.steps, config.step_size) * reach_F
        with torch.enable_grad():
            for _ in range(config.steps):
                seen_BVF = seen_BVF.detach().requires_grad_()
                logits_BA = q_of(seen_BVF, state_BS) / temperature_B1
                own_B = logits_BA.gather(1, action_B1).squeeze(1)
                others_B = logits_BA.scatter(1, action_B1, -1e30).logsumexp(1)
                # Its sign is that of the cross-entropy's gradient, and it never vanishes where the network is sure.
                (gradient_BVF,) = torch.autograd.grad(((others_B - own_B) * sign_B).sum(), seen_BVF)
                with torch.no_grad():
                    moved_BVF = seen_BVF + gradient_BVF.sign() * step_BVF
                    seen_BVF = torch.minimum(torch.maximum(moved_BVF, low_BVF), high_BVF)
        return seen_BVF.detach()
