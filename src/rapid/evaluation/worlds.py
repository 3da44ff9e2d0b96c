"""Worlds under way side by side, and what is measured of them step by step."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rapid.agents.open import Driver
from rapid.attacks.attack import Attack, Field, Moment, Shown, network_of, values_of
from rapid.errors import RapidError
from rapid.evaluation.crashes import hit_of
from rapid.evaluation.metrics import time_to_collision
from rapid.evaluation.recording import Recording
from rapid.road import LANE_WIDTH
from rapid.scenarios import ACTIONS, IDLE, NUM_ACTIONS, NUM_VEHICLES
from rapid.seeding import torch_stream
from rapid.teacher.decision import Decision, answer_in_words, computed_in_words


class Perturbation:
    """An attack on an agent in some worlds, with one random stream per episode: nothing depends on the batch."""

    def __init__(
        self, attack: Attack | None, agent: Any, scenario: str, seeds: NDArray[np.int64], generator_seed: int
    ) -> None:
        self._shown: Shown | None = None
        if attack is None:
            return
        network = network_of(agent)
        self._agent = agent
        self._device = torch.device("cpu") if network is None else next(network.parameters()).device
        streams = [torch_stream(generator_seed, f"attack/{seed}") for seed in seeds]
        self._shown = attack.begin(Field(agent, streams, scenario, seeds.tolist()))

    def __call__(
        self,
        obs_BVF: NDArray[np.float32],
        worlds: NDArray[np.int64],
        env: Any,
        state_BS: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return what is shown of the true observations of `worlds`.

        `env` holds all worlds; `state_BS` is what an agent with a memory remembers in these, which the attack knows.
        """
        if self._shown is None:
            return obs_BVF
        obs = torch.from_numpy(np.ascontiguousarray(obs_BVF)).to(self._device)
        seen = self._shown(Moment(obs, worlds, values_of(self._agent, state_BS), state_BS, env))
        return seen.detach().cpu().numpy().astype(np.float32, copy=False)


class Worlds:
    """B worlds under way and what has been measured of them; a finished one counts no further."""

    def __init__(self, seed_B: NDArray[np.int64], record: bool) -> None:
        count = len(seed_B)
        self.seed_B = seed_B
        self.return_B, self.speed_B, self.distance_B = (np.zeros(count) for _ in range(3))
        self.length_B, self.lane_changes_B = (np.zeros(count, np.int64) for _ in range(2))
        self.crashed_B = np.zeros(count, np.bool_)
        self.hit_B = [""] * count
        self.ttc_B = np.full(count, np.inf)
        self.counts_BA = np.zeros((count, NUM_ACTIONS), np.int64)
        self.decision_seconds = 0.0
        self._steps: list[list[_Step]] | None = [[] for _ in range(count)] if record else None

    def drive(
        self,
        env: Any,
        driver: Driver,
        perturb: Perturbation,
        lanes: int,
        progress: Callable[[float], None] | None,
        vehicles: int = NUM_VEHICLES,
    ) -> None:
        """Step all worlds until every one has ended; the driver sees the first `vehicles` rows of an observation."""
        obs_BVF, _ = env.reset(seed=self.seed_B.tolist())
        obs_BVF = np.array(obs_BVF, np.float32)
        start_B = obs_BVF[:, 0, 1].astype(np.float64)
        lane_B = _lane(obs_BVF, lanes)
        self.ttc_B = np.minimum(self.ttc_B, _time_to_collision(obs_BVF))
        alive_B = np.ones(len(self.seed_B), np.bool_)
        step = 0
        while alive_B.any():
            worlds = np.flatnonzero(alive_B)
            seen_BVF = obs_BVF[:, :vehicles].copy()
            seen_BVF[worlds] = perturb(seen_BVF[worlds], worlds, env, driver.memory(worlds, len(alive_B)))
            began = time.perf_counter()
            chosen = driver.choose(seen_BVF, worlds, self.seed_B, step)
            self.decision_seconds += time.perf_counter() - began
            self._check(chosen, len(worlds))
            action_B = np.full(len(self.seed_B), IDLE, np.int64)
            action_B[worlds] = chosen
            if self._steps is not None:
                said = driver.commentary(seen_BVF, worlds)
                for i, world in enumerate(worlds):
                    self._steps[world].append(_Step(obs_BVF[world].copy(), int(chosen[i]), *said[i], seen_BVF[world]))
            before_BVF = obs_BVF
            # Copied: an environment may write its next observation into the same memory.
            obs_BVF, reward_B, terminated_B, truncated_B, info = env.step(action_B)
            obs_BVF = np.array(obs_BVF, np.float32)
            self.return_B[worlds] += np.asarray(reward_B, np.float64)[worlds]
            self.length_B[worlds] += 1
            self.counts_BA[worlds, chosen] += 1
            self.crashed_B[worlds] = np.asarray(info["crashed"], np.bool_)[worlds]
            for world in worlds[self.crashed_B[worlds]]:
                self.hit_B[world] = hit_of(before_BVF[world], obs_BVF[world])
            self.speed_B[worlds] += np.asarray(info["speed"], np.float64)[worlds]
            self.distance_B[worlds] = obs_BVF[worlds, 0, 1] - start_B[worlds]
            new_lane_B = _lane(obs_BVF, lanes)
            self.lane_changes_B[worlds] += (new_lane_B != lane_B)[worlds]
            lane_B = new_lane_B
            self.ttc_B[worlds] = np.minimum(self.ttc_B[worlds], _time_to_collision(obs_BVF[worlds]))
            if self._steps is not None:
                for world in worlds:
                    last = self._steps[world][-1]
                    last.reward, last.after = float(reward_B[world]), obs_BVF[world].copy()
            ended_B = alive_B & (np.asarray(terminated_B, np.bool_) | np.asarray(truncated_B, np.bool_))
            alive_B &= ~ended_B
            if progress is not None and ended_B.any():
                progress(int(ended_B.sum()))
            step += 1

    @staticmethod
    def _check(chosen: NDArray[np.int64], expected: int) -> None:
        if chosen.shape != (expected,) or (chosen < 0).any() or (chosen >= NUM_ACTIONS).any():
            raise RapidError(
                f"The agent answered {chosen.tolist()!r} for {expected} worlds; expected as many actions, each one of "
                f"{', '.join(f'{i} {name}' for i, name in enumerate(ACTIONS))}."
            )

    def recordings(self, agent: str, scenario: str, attack: str) -> list[Recording]:
        """Return the recorded episodes, if any."""
        found: list[Recording] = []
        for world, steps in enumerate(self._steps or []):
            values = [step.q_A for step in steps]
            found.append(
                Recording(
                    agent=agent,
                    scenario=scenario,
                    seed=int(self.seed_B[world]),
                    attack=attack,
                    obs_TVF=np.stack([*(step.before for step in steps), steps[-1].after]),
                    action_T=np.array([step.action for step in steps], np.int64),
                    reward_T=np.array([step.reward for step in steps], np.float64),
                    crashed=bool(self.crashed_B[world]),
                    q_TA=np.stack([q for q in values if q is not None]) if values[0] is not None else None,
                    **_words([step.decision for step in steps]),
                    seen_TVF=None if attack == "none" else np.stack([step.seen_VF for step in steps]),
                )
            )
        return found


def _words(decisions: Sequence[Decision | None]) -> dict[str, Any]:
    """Return what was told, answered and computed at each decision of an episode, of each nothing if there is none."""
    made = [decision for decision in decisions if decision is not None]
    if not made or len(made) < len(decisions):
        return {}
    odds_TA = np.array([decision.probabilities or (math.nan,) * NUM_ACTIONS for decision in made], np.float32)
    texts = {
        "told": [decision.told for decision in made],
        "answered": list(map(answer_in_words, made)),
        "computed": list(map(computed_in_words, made)),
    }
    found: dict[str, Any] = {name: tuple(lines) for name, lines in texts.items() if any(lines)}
    return found | ({} if np.isnan(odds_TA).all() else {"odds_TA": odds_TA})


@dataclass
class _Step:
    """One decision of one world, while it is recorded."""

    before: NDArray[np.float32]
    action: int
    q_A: NDArray[np.float32] | None
    decision: Decision | None
    seen_VF: NDArray[np.float32]
    reward: float = 0.0
    after: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))


def _time_to_collision(obs_BVF: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return it for the usual rows, so that it is the same for who reads more or fewer."""
    return time_to_collision(obs_BVF[:, :NUM_VEHICLES])


def _lane(obs_BVF: NDArray[np.float32], lanes: int) -> NDArray[np.int64]:
    """Return the lane each ego is nearest to."""
    return np.clip(np.rint(obs_BVF[:, 0, 2] / LANE_WIDTH), 0, lanes - 1).astype(np.int64)
