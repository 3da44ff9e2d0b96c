"""PPO in one file, the way CleanRL writes it, on many compiled worlds; exports an agent that `rapid evaluate` drives.

    python cleanrl_ppo.py                              # some minutes
    rapid evaluate cleanrl.onnx idle faster --scenario lane-3-density-2

The environment is Gymnasium's vector interface with resets within the step; what the last observation of a cut
episode is worth comes from `final_obs`. Needs onnx and onnxruntime (`pip install onnx onnxruntime`).
"""

import argparse
import time
import warnings

import numpy as np
import torch
from torch import nn

import rapid
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES

SCALE = torch.tensor([1.0, 100.0, 12.0, 20.0, 5.0])
"""What the columns of a row (presence, x, y, vx, vy) are divided by; m and m/s."""


class Policy(nn.Module):
    """What an agent of RAPID is: from raw rows (B, V, F) to preferences (B, A)."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", SCALE)
        self.register_buffer("own", torch.tensor([0.0, 1.0, 0.0, 1.0, 0.0]))  # x and vx count from the ego's
        self.body = nn.Sequential(
            nn.Linear(NUM_VEHICLES * NUM_FEATURES, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU()
        )
        self.head, self.critic = nn.Linear(256, NUM_ACTIONS), nn.Linear(256, 1)

    def features(self, rows: torch.Tensor) -> torch.Tensor:
        """Return what both heads read: rows relative to the ego, absent ones zero."""
        relative = (rows - rows[:, :1] * self.own) * rows[:, :, :1] / self.scale
        return self.body(relative.flatten(1))

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the preferences."""
        return self.head(self.features(rows))

    def value(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the value, (B,)."""
        return self.critic(self.features(rows)).squeeze(1)


def train(chosen: argparse.Namespace) -> Policy:
    """Return the trained policy."""
    torch.manual_seed(chosen.seed)
    worlds = rapid.make_vec(chosen.scenario, chosen.worlds, seed=chosen.seed)
    policy = Policy()
    optimizer = torch.optim.Adam(policy.parameters(), lr=3e-4, eps=1e-5)
    start, returns, running = time.perf_counter(), list[float](), np.zeros(chosen.worlds)
    seen = torch.from_numpy(worlds.reset()[0])
    for update in range(1, chosen.steps // (chosen.worlds * chosen.horizon) + 1):
        kept: dict[str, list[torch.Tensor]] = {
            key: [] for key in ("seen", "action", "chance", "value", "reward", "end")
        }
        for _ in range(chosen.horizon):
            with torch.no_grad():
                logits, value = policy(seen), policy.value(seen)
                chances = torch.distributions.Categorical(logits=logits)
                action = chances.sample()
            after, reward, terminated, truncated, info = worlds.step(action.numpy())
            running += reward
            ended = terminated | truncated
            returns += running[ended].tolist()
            running[ended] = 0.0
            paid = torch.from_numpy(reward).float()
            if truncated.any():  # the road goes on after the time limit: what is cut off is worth what the critic says
                cut = np.flatnonzero(truncated & ~terminated)
                with torch.no_grad():
                    last = torch.from_numpy(np.stack(list(info["final_obs"][cut]))) if len(cut) else seen[:0]
                    paid[cut] += chosen.gamma * policy.value(last)
            step = (seen, action, chances.log_prob(action), value, paid, torch.from_numpy(ended).float())
            for key, tensor in zip(kept, step, strict=True):
                kept[key].append(tensor)
            seen = torch.from_numpy(after)
        _improve(policy, optimizer, {key: torch.stack(tensors) for key, tensors in kept.items()}, seen, chosen)
        if update % 10 == 0:
            done = update * chosen.worlds * chosen.horizon
            speed = done / (time.perf_counter() - start)
            print(f"{done:>9,} steps, {speed:,.0f} a second, return {np.mean(returns[-200:]):.2f}", flush=True)
    worlds.close()
    return policy


def _improve(
    policy: Policy,
    optimizer: torch.optim.Optimizer,
    kept: dict[str, torch.Tensor],
    seen: torch.Tensor,
    chosen: argparse.Namespace,
) -> None:
    """Take PPO's epochs over one rollout (Schulman et al., 2017)."""
    horizon = len(kept["reward"])
    with torch.no_grad():
        following, gain, gains = policy.value(seen), torch.zeros(len(seen)), [torch.zeros(0)] * horizon
    for t in reversed(range(horizon)):
        alive = 1 - kept["end"][t]
        surprise = kept["reward"][t] + chosen.gamma * alive * following - kept["value"][t]
        gain = surprise + chosen.gamma * 0.95 * alive * gain
        gains[t], following = gain, kept["value"][t]
    gain_N = torch.stack(gains).flatten()
    target_N = gain_N + kept["value"].flatten()
    rows, action, chance = kept["seen"].flatten(0, 1), kept["action"].flatten(), kept["chance"].flatten()
    for _ in range(4):
        for part in torch.randperm(len(gain_N)).chunk(8):
            chances = torch.distributions.Categorical(logits=policy(rows[part]))
            ratio = (chances.log_prob(action[part]) - chance[part]).exp()
            wanted = (gain_N[part] - gain_N[part].mean()) / (gain_N[part].std() + 1e-8)
            loss = -torch.min(ratio * wanted, ratio.clamp(0.8, 1.2) * wanted).mean()
            loss = loss + 0.5 * (policy.value(rows[part]) - target_N[part]).square().mean()
            loss = loss - 0.01 * chances.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(policy.parameters(), 0.5)
            optimizer.step()


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--scenario", default="lane-3-density-2")
    options.add_argument("--steps", type=int, default=300_000)
    options.add_argument("--worlds", type=int, default=64)
    options.add_argument("--horizon", type=int, default=32)
    options.add_argument("--gamma", type=float, default=0.95)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--out", default="cleanrl.onnx")
    chosen = options.parse_args()
    policy = train(chosen).eval()
    row = torch.zeros(2, NUM_VEHICLES, NUM_FEATURES)
    batch = {"obs": {0: "batch"}, "q": {0: "batch"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch's newer exporter needs one more package
        torch.onnx.export(
            policy, (row,), chosen.out, input_names=["obs"], output_names=["q"], dynamic_axes=batch, dynamo=False
        )
    print(f"{chosen.out} is an agent: rapid evaluate {chosen.out}")
