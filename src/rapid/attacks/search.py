"""Projected gradient ascent that keeps what it finds, for many observations side by side.

Offsets are in normalised features within a ball around the true observation. The points tried are nested: more steps
or more runs try all that fewer do and then some, so the loss found never falls (paper: section 4.5; Madry et al.,
2018, "Towards Deep Learning Models Resistant to Adversarial Attacks"; Croce and Hein, 2020, for DLR; Zhang et al.,
2020, "Robust Deep Reinforcement Learning against Adversarial Perturbations on State Observations", for MAD).
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor, nn

from rapid.attacks.draws import Source, chosen, normal, uniform
from rapid.networks.blocks import compiled_layers, spared_weights
from rapid.networks.denormals import no_denormals

Values = Callable[[Tensor], Tensor]
"""Raw observations (B, V, F) to Q-values (B, A)."""


@dataclass(frozen=True)
class AtState:
    """A network with a memory, in one state for each observation, as :data:`Values`."""

    network: Any
    state_BS: Tensor

    @property
    def lanes(self) -> int:
        """Of the road that the network knows."""
        return self.network.lanes

    def __call__(self, obs_BVF: Tensor) -> Tensor:
        """Return the Q-values (B, A)."""
        return self.network(obs_BVF, self.state_BS)

    def take(self, rows_R: Tensor) -> "AtState":
        """Return it for some of the observations."""
        return AtState(self.network, self.state_BS[rows_R])


def values_at(values: Values, rows_R: Tensor) -> Values:
    """Return the values of some of the observations: those of who remembers belong to theirs."""
    return values.take(rows_R) if isinstance(values, AtState) else values


ROUNDING = 1e-5
"""Share of the radius left free, so that float32 metres, read back, still lie inside the ball."""
TEMPERATURE = 0.1
"""T of softmax(Q / T) where a loss speaks of probabilities of actions: that of the policy while PPO learns."""


@dataclass(frozen=True)
class Ball:
    """What may be shown instead of an observation."""

    norm: Literal["linf", "l2"]
    radius: float
    """In normalised features."""
    scale_VF: Tensor
    """What 1 means in each normalised feature of each row; 0 where nothing may move."""
    before_BVF: Tensor | None = None
    """Offsets of the step before, from which those of this one may differ by"""
    coupling: float = 0.0
    """at most so much in each feature (`linf` only)."""

    def take(self, rows_R: Tensor) -> "Ball":
        """Return it for some of the observations."""
        return self if self.before_BVF is None else replace(self, before_BVF=self.before_BVF[rows_R])

    def at(self, obs_BVF: Tensor, offset_BVF: Tensor) -> Tensor:
        """Return the observations at an offset, untouched where nothing may move."""
        return obs_BVF + offset_BVF * self.scale_VF

    def project(self, offset_BVF: Tensor) -> Tensor:
        """Return the nearest offset inside."""
        radius = self.radius * (1 - ROUNDING)
        if self.before_BVF is not None:
            nearby_BVF = offset_BVF - self.before_BVF
            offset_BVF = self.before_BVF + nearby_BVF.clamp(-self.coupling, self.coupling)
        if self.norm == "linf":
            return offset_BVF.clamp(-radius, radius)
        length_B11 = offset_BVF.square().sum((1, 2), keepdim=True).sqrt()
        return offset_BVF * (radius / length_B11.clamp_min(radius)) if radius > 0 else torch.zeros_like(offset_BVF)

    def ascent(self, gradient_BVF: Tensor) -> Tensor:
        """Return the steepest ascent of length 1 for gradients by the raw features; 0 where they are 0."""
        gradient_BVF = gradient_BVF * self.scale_VF
        if self.norm == "linf":
            return gradient_BVF.sign()
        # Scaling by the largest entry first keeps the squares of tiny gradients from vanishing.
        largest_B11 = gradient_BVF.abs().amax((1, 2), keepdim=True)
        scaled_BVF = gradient_BVF / torch.where(largest_B11 > 0, largest_B11, 1.0)
        length_B11 = scaled_BVF.square().sum((1, 2), keepdim=True).sqrt()
        return scaled_BVF / torch.where(length_B11 > 0, length_B11, 1.0)

    def draw(self, obs_BVF: Tensor, source: Source) -> Tensor:
        """Return offsets uniform in the ball."""
        free_VF = (self.scale_VF > 0).to(obs_BVF.dtype)
        if self.norm == "linf":
            return self.project((uniform(obs_BVF.shape, source, obs_BVF.device) * 2 - 1) * free_VF * self.radius)
        noise_BVF = normal(obs_BVF.shape, source, obs_BVF.device) * free_VF
        share_B11 = uniform((len(obs_BVF), 1, 1), source, obs_BVF.device) ** (1 / free_VF.sum().clamp_min(1))
        length_B11 = noise_BVF.square().sum((1, 2), keepdim=True).sqrt().clamp_min(1e-30)
        return self.project(noise_BVF / length_B11 * share_B11 * self.radius)


@dataclass(frozen=True)
class Aim:
    """What is wanted of each of B observations."""

    loss: Literal["ce", "margin", "dlr", "min-q", "mad", "toward"]
    """`toward` is how far the action wanted surpasses all others; the others lead away from the agent's own."""
    action_B: Tensor
    """The agent's own action, or the one that is wanted."""
    true_q_BA: Tensor
    """The values of the true observation."""

    def take(self, rows_R: Tensor) -> "Aim":
        """Return it for some of the observations."""
        return Aim(self.loss, self.action_B[rows_R], self.true_q_BA[rows_R])

    def __call__(self, q_BA: Tensor) -> Tensor:
        """Return the loss (B,) to be made large."""
        if self.loss == "mad":
            before_BA, after_BA = ((q / TEMPERATURE).log_softmax(1) for q in (self.true_q_BA, q_BA))
            return (before_BA.exp() * (before_BA - after_BA)).sum(1)
        if self.loss == "min-q":
            return -((q_BA / TEMPERATURE).softmax(1) * self.true_q_BA).sum(1)
        if self.loss == "ce":
            # -log p_a = softplus(logsumexp of z_j - z_a over the others): exact however sure the network is, where the
            # textbook's p - 1 rounds to 0.
            return nn.functional.softplus(self._others(q_BA).logsumexp(1))
        margin_B = self._others(q_BA).amax(1)
        if self.loss == "toward":
            return -margin_B
        if self.loss == "dlr":
            highest_B3 = q_BA.topk(3, 1).values
            return margin_B / (highest_B3[:, 0] - highest_B3[:, 2]).clamp_min(1e-12)
        return margin_B

    def reached(self, q_BA: Tensor) -> Tensor:
        """Return where the greedy action is the one wanted, or no longer the agent's own (B,)."""
        same_B = q_BA.argmax(1) == self.action_B
        return same_B if self.loss == "toward" else ~same_B

    def _others(self, q_BA: Tensor) -> Tensor:
        own_BA = nn.functional.one_hot(self.action_B, q_BA.shape[1]).bool()
        return (q_BA - q_BA.gather(1, self.action_B[:, None])).masked_fill(own_BA, -1e30)


@dataclass(frozen=True)
class Runs:
    """How hard is searched."""

    steps: int
    step: float
    """Length of a step in normalised features; 0: :func:`step_length`."""
    restarts: int = 1
    start: Literal["clean", "random"] = "clean"
    keep: Literal["best", "last"] = "best"
    stop: bool = False
    """Leave an observation at the first point where the aim is reached."""


def step_length(radius: float, step: int) -> float:
    """Return the length of one step: a tenth of the radius, half of that from the 20th step on, a fifth from the 35th.

    It does not depend on how many steps there are, so that more of them only add points.
    """
    return radius * (0.1 if step < 20 else 0.05 if step < 35 else 0.02)


@contextmanager
def for_gradients(values: Values) -> Generator[None]:
    """Allow gradients by the observations, spare those by the weights, and compute layers fast where that is known."""
    network: Any = values.network if isinstance(values, AtState) else values
    networks = [network] if isinstance(network, nn.Module) else []
    fast = spared_weights(*networks), compiled_layers(*networks)
    with torch.inference_mode(False), torch.enable_grad(), no_denormals(), fast[0], fast[1]:
        yield


@torch.no_grad()
def own_action(values: Values, obs_BVF: Tensor, loss: str) -> Aim:
    """Return the aim to lead the agent away from what it does on the true observations."""
    q_BA = values(obs_BVF)
    return Aim(loss, q_BA.argmax(1), q_BA)  # pyright: ignore[reportArgumentType] - a loss by its name


def ascend(values: Values, obs_BVF: Tensor, aim: Aim, ball: Ball, runs: Runs, source: Source) -> Tensor:
    """Return the observations (B, V, F) within the ball at which the loss of `aim` is largest, of all points tried.

    Args:
        values: the network that is attacked.
        obs_BVF: the true observations, metres and m/s.
        aim: the loss, for each observation.
        ball: what may be shown.
        runs: steps and restarts.
        source: of random starts.
    """
    with for_gradients(values):
        obs_BVF = obs_BVF.detach().clone()
        shown_BVF = obs_BVF.clone()
        best_B = torch.full((len(obs_BVF),), -torch.inf, device=obs_BVF.device)
        reached_B = torch.zeros(len(obs_BVF), dtype=torch.bool, device=obs_BVF.device)
        rows_R = torch.arange(len(obs_BVF), device=obs_BVF.device)
        fgsm_BVF: Tensor | None = None
        for run in range(runs.restarts):
            if len(rows_R) == 0:
                break
            some, true_RVF, nearby = aim.take(rows_R), obs_BVF[rows_R], ball.take(rows_R)
            if run == 1 and fgsm_BVF is not None:
                offset_RVF = fgsm_BVF[rows_R]
            elif run > 0 or runs.start == "random":
                offset_RVF = nearby.draw(true_RVF, chosen(source, rows_R.tolist()))
            else:
                offset_RVF = nearby.project(torch.zeros_like(true_RVF))
            trace = _Trace(shown_BVF, best_B, reached_B, rows_R, runs.keep)
            first_RVF = _climb(values_at(values, rows_R), true_RVF, offset_RVF, some, nearby, runs, trace)
            if run == 0 and runs.start == "clean":
                fgsm_BVF = first_RVF
            rows_R = (~reached_B).nonzero().squeeze(1)
        return shown_BVF


@dataclass
class _Trace:
    """What has been found; tensors of all B observations, of which `rows_R` are being attacked."""

    shown_BVF: Tensor
    best_B: Tensor
    reached_B: Tensor
    rows_R: Tensor
    keep: Literal["best", "last"]

    def note(self, seen_RVF: Tensor, loss_R: Tensor, reached_R: Tensor) -> None:
        better_R = loss_R > self.best_B[self.rows_R] if self.keep == "best" else torch.ones_like(reached_R)
        rows_K = self.rows_R[better_R]
        self.shown_BVF[rows_K] = seen_RVF[better_R]
        self.best_B[rows_K] = loss_R[better_R]
        self.reached_B[self.rows_R] |= reached_R


def _climb(
    values: Values, true_RVF: Tensor, offset_RVF: Tensor, aim: Aim, ball: Ball, runs: Runs, trace: _Trace
) -> Tensor:
    """Make one run, note every point, and return FGSM's offset: as long as the radius, along the first gradient."""
    fgsm_RVF, first_RVF = None, offset_RVF
    for step in range(runs.steps + 1):
        seen_RVF = ball.at(true_RVF, offset_RVF).requires_grad_()
        q_RA = values(seen_RVF)
        loss_R = aim(q_RA)
        reached_R = aim.reached(q_RA.detach())
        trace.note(seen_RVF.detach(), loss_R.detach(), reached_R)
        if step == runs.steps:
            break
        if step == 0 and aim.loss == "mad":
            loss_R = Aim("ce", aim.action_B, aim.true_q_BA)(q_RA)  # at the true observation MAD has no gradient
        (gradient_RVF,) = torch.autograd.grad(loss_R.sum(), seen_RVF)
        ascent_RVF = ball.ascent(gradient_RVF)
        with torch.no_grad():
            if fgsm_RVF is None:
                fgsm_RVF = ball.project(first_RVF + ascent_RVF * ball.radius)
                if runs.keep == "best":
                    at_RVF = ball.at(true_RVF, fgsm_RVF)
                    q_RA = values(at_RVF)
                    trace.note(at_RVF, aim(q_RA), aim.reached(q_RA))
            length = runs.step or step_length(ball.radius, step)
            offset_RVF = ball.project(offset_RVF + ascent_RVF * length)
            if runs.stop and bool((done_R := trace.reached_B[trace.rows_R]).any()):
                left_R = ~done_R
                true_RVF, offset_RVF, aim = true_RVF[left_R], offset_RVF[left_R], aim.take(left_R)
                ball, values = ball.take(left_R), values_at(values, left_R.nonzero().squeeze(1))
                trace.rows_R = trace.rows_R[left_R]
                if not len(true_RVF):
                    break
    return fgsm_RVF if fgsm_RVF is not None else first_RVF
