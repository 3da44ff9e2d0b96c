"""How PPO drives: whole rollouts of many worlds, under attack and exploring if the settings say so.

Policy, critic, memory and reward are kept apart here: the policy sees what the adversary leaves of an observation and
remembers what the car knows by itself; the critic and the reward have the truth.

Shapes: T steps of a rollout, W worlds, N = T*W transitions, V vehicles, F features, S entries of a memory's state.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from rapid.config_learning import AdversaryConfig, PpoConfig
from rapid.errors import RapidError
from rapid.seeding import numpy_stream, torch_stream
from rapid.training.learner import check_generator
from rapid.training.machinery.adversary import CLEAN, Adversary
from rapid.training.machinery.guide import Guide
from rapid.training.machinery.worlds import Drive, Explorer

ATTACKED = 2.0
"""What the ego's presence, beside the time, is raised by for the critic in an episode under attack."""


class Policy(Protocol):
    """What a collector asks of the learner."""

    updates: int

    def as_seen(self, obs_BVF: Tensor) -> Tensor:
        """Return the observations as the policy may see them."""
        ...

    def q_values(self, seen_BVF: Tensor, state_BS: Tensor | None = None) -> Tensor:
        """Return the policy's Q-values (B, A)."""
        ...

    def log_probs(self, seen_BVF: Tensor, state_BS: Tensor | None = None) -> Tensor:
        """Return the policy's log-probabilities (B, A)."""
        ...

    def values(self, obs_BVF: Tensor) -> Tensor:
        """Return what the critic expects until the end of the episode (B,)."""
        ...


class Rollout(NamedTuple):
    """N transitions of one policy, with what is learned from them."""

    obs_NVF: Tensor
    """The true observation with what the critic is told beside it: the time, and whether the episode is attacked."""
    seen_NVF: Tensor
    """What the policy saw."""
    state_NS: Tensor | None
    """What it remembered, if it has a memory."""
    action_N: Tensor
    log_prob_N: Tensor
    """Of the action, under the policy that drove."""
    advantage_N: Tensor
    return_N: Tensor
    """The critic's target."""
    shown_NA: Tensor | None = None
    """The probabilities that a guide showed, if there was one."""
    first_NVD: Tensor | None = None
    """Policy 1's tokens of what was seen, if no update changes them."""

    def rows(self, rows_B: Tensor) -> "Rollout":
        """Return some of the transitions."""
        return Rollout(*(None if tensor is None else tensor[rows_B] for tensor in self))  # pyright: ignore


class Collector:
    """Drives worlds for a learner and remembers where they are, savable as a whole.

    Args:
        drive: the worlds; their observation tells the time.
        config: sizes, crash penalty, exploration.
        adversary: the mixture of attacks.
        scale_F: what 1 means in each normalised feature.
        seed: of actions, exploration and attacks.
        device: where tensors go.
        make_guide: gives the guide when its time has come; None is no guide.
    """

    def __init__(
        self,
        drive: Drive,
        config: PpoConfig,
        adversary: AdversaryConfig,
        scale_F: Tensor,
        seed: int,
        device: str,
        make_guide: Callable[[], Guide] | None = None,
    ) -> None:
        self.drive, self.config, self._device = drive, config, device
        self.mixture, self._size = adversary, 1.0
        self._make_guide = make_guide
        self.guide: Guide | None = None
        self._sampler = torch_stream(seed, "ppo/actions", device)
        self._liar = torch_stream(seed, "ppo/adversary", device)
        self.adversary = Adversary(adversary, config.num_envs, scale_F, config.temperature, self._liar)
        self._explorer = Explorer(config.num_envs, config.exploration_hold)
        self._rng = numpy_stream(seed, "ppo/exploration")

    @torch.no_grad()
    def collect(self, learner: Policy, done: int = 1, planned: int = 1) -> Rollout:
        """Drive every world for `config.rollout` steps and return what there is to learn.

        A crash costs `config.crash_penalty` more here than in the return that is reported.

        Args:
            learner: who drives.
            done: how many rollouts are done, by which attacks have grown and exploration has fallen.
            planned: how many there will be.

        Raises:
            RapidError: an observation or a Q-value is not finite.
        """
        config, device = self.config, self._device
        guide = self._prepare(done, planned)
        epsilon = config.exploration * max(1 - 2 * done / planned, 0.0)
        obs: list[Tensor] = []
        seen: list[Tensor] = []
        states: list[Tensor] = []
        actions: list[Tensor] = []
        log_probs: list[Tensor] = []
        rewards: list[Tensor] = []
        ended: list[Tensor] = []
        shown: list[Tensor] = []
        for _ in range(config.rollout):
            obs_WVF, state_WS = self._observed()
            seen_WVF = self.adversary(learner.q_values, learner.as_seen(obs_WVF), state_WS, self._size)
            log_prob_WA = learner.log_probs(seen_WVF, state_WS)
            if not log_prob_WA.isfinite().all():
                raise RapidError(
                    f"Training stopped after update {learner.updates} of PPO: an observation or a Q-value is not "
                    "finite. The worlds are at fault if an observation is; else lower adapt.ppo.learning_rate."
                )
            action_W = torch.multinomial(log_prob_WA.exp(), 1, generator=self._sampler).squeeze(1)
            if epsilon:
                explores_W = torch.from_numpy(self._explorer.begin(epsilon, self._rng)).to(device)
                action_W = torch.where(explores_W, torch.from_numpy(self._explorer.held_W).to(device), action_W)
            if guide is not None and state_WS is not None:
                shown_WA = guide(learner.as_seen(obs_WVF), state_WS, self.adversary.kind_W != CLEAN)
                action_W = guide.drive(action_W, shown_WA)
                shown.append(shown_WA)
            obs.append(self._told(obs_WVF))
            seen.append(seen_WVF)
            if state_WS is not None:
                states.append(state_WS)
            actions.append(action_W)
            log_probs.append(log_prob_WA.gather(1, action_W[:, None]).squeeze(1))
            _, _, reward_W, _, terminated_W, truncated_W = self.drive.step(action_W.cpu().numpy())
            reward_W = reward_W - config.crash_penalty * terminated_W
            rewards.append(torch.from_numpy(reward_W.astype(np.float32)).to(device))
            ended_W = terminated_W | truncated_W
            ended.append(torch.from_numpy(ended_W).to(device))
            self.adversary.begin(ended_W)
            if guide is not None:
                guide.begin(ended_W)
        # After an end comes the next episode, whose first value counts for nothing.
        last_WVF = self._told(self._observed()[0])
        told = [*obs, last_WVF]
        # From a guide's rollout no critic learns.
        value_TW = torch.stack([learner.values(each) if guide is None else each.new_zeros(len(each)) for each in told])
        reward_TW, ended_TW = torch.stack(rewards), torch.stack(ended)
        advantage_TW = advantages(reward_TW, value_TW, ended_TW, config.discount, config.trace)
        return Rollout(
            torch.cat(obs),
            torch.cat(seen),
            torch.cat(states) if states else None,
            torch.cat(actions),
            torch.cat(log_probs),
            advantage_TW.flatten(),
            (advantage_TW + value_TW[:-1]).flatten(),
            torch.cat(shown) if shown else None,
        )

    def _prepare(self, done: int, planned: int) -> Guide | None:
        """Decide how large attacks are, and who shows what to do, in the rollout after so many of those planned."""
        mixture, make_guide = self.mixture, self._make_guide
        after = done / planned - mixture.begin
        ramp = 0.0 if make_guide else mixture.ramp
        self._size = min(max(after, 0.0) / ramp, 1.0) if ramp else float(after >= 0)
        guided = mixture.guided_rollouts(planned)
        if make_guide is None or done not in guided:
            self.guide = None
        else:
            self.guide = self.guide or make_guide()
            self.guide.left = (guided.stop - done) / len(guided)
            self._size = 1.0
        return self.guide

    def _observed(self) -> tuple[Tensor, Tensor | None]:
        """Return the true observations (W, V, F) and what is remembered there (W, S)."""
        state_WS = self.drive.state_WS
        remembered_WS = None if state_WS is None else torch.from_numpy(state_WS).to(self._device)
        return torch.from_numpy(self.drive.obs_WVF).to(self._device), remembered_WS

    def _told(self, obs_WVF: Tensor) -> Tensor:
        """Return the observations with what the critic is told: beside the time, which episodes are attacked."""
        if not self.adversary.active or not self._size:
            return obs_WVF
        told_WVF = obs_WVF.clone()
        told_WVF[:, 0, 0] += ATTACKED * (self.adversary.kind_W != CLEAN)
        return told_WVF

    def state_dict(self) -> dict[str, Any]:
        """Return everything that `load_state_dict` needs."""
        return {
            "drive": self.drive.state_dict(),
            "sampler": self._sampler.get_state(),
            "liar": self._liar.get_state(),
            "kinds": self.adversary.kind_W,
            "explorer": self._explorer.state_dict(),
            "rng": self._rng.bit_generator.state,
            "guide": None if self.guide is None else self.guide.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where the collector was whose `state_dict` this is.

        Raises:
            RapidError: it was on another kind of device.
        """
        check_generator(self._sampler, state["sampler"])
        self.drive.load_state_dict(state["drive"])
        self._sampler.set_state(state["sampler"])
        self._liar.set_state(state["liar"])
        self.adversary.kind_W = state["kinds"]
        self._explorer.load_state_dict(state["explorer"])
        self._rng.bit_generator.state = state["rng"]
        if (guide := state.get("guide")) is not None and self._make_guide is not None:
            self.guide = self._make_guide()
            self.guide.load_state_dict(guide)


def advantages(reward_TW: Tensor, value_TW: Tensor, ended_TW: Tensor, discount: float, trace: float) -> Tensor:
    """Return generalised advantage estimates (T, W) (Schulman et al., 2016: equation 16).

    Args:
        reward_TW: the rewards.
        value_TW: the critic's values, (T + 1, W): of the state before each step and after the last.
        ended_TW: bool: whether the episode ended with this step, by a crash or because the time was up.
        discount: gamma.
        trace: lambda.
    """
    found_TW = torch.zeros_like(reward_TW)
    after_W = torch.zeros_like(reward_TW[0])
    for step in range(len(reward_TW) - 1, -1, -1):
        on_W = discount * (~ended_TW[step]).to(reward_TW.dtype)
        error_W = reward_TW[step] + on_W * value_TW[step + 1] - value_TW[step]
        after_W = error_W + trace * on_W * after_W
        found_TW[step] = after_W
    return found_TW
