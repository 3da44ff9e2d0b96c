"""DQN of stable-baselines3 on HighwayEnv's task, with the settings of HighwayEnv's published script.

    python sb3_dqn.py                                  # on the compiled simulator
    python sb3_dqn.py --simulator highway-env          # on HighwayEnv itself: one line differs
    rapid import highway_dqn/model.zip                 # the trained model as an agent of RAPID

Needs stable-baselines3 (`pip install stable-baselines3`).
"""

import argparse
import time
from pathlib import Path

import gymnasium
import highway_env  # noqa: F401 - registers HighwayEnv's own ids
from stable_baselines3 import DQN
from stable_baselines3.common.evaluation import evaluate_policy

import rapid  # noqa: F401 - registers the compiled simulator's

ID = {"compiled": "rapid/highway-fast-v0", "highway-env": "highway-fast-v0"}

if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--simulator", choices=tuple(ID), default="compiled")
    options.add_argument("--steps", type=int, default=20_000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--episodes", type=int, default=20, help="driven afterwards")
    options.add_argument("--out", type=Path, default=Path("highway_dqn/model"))
    chosen = options.parse_args()

    env = gymnasium.make(ID[chosen.simulator])  # the one line
    model = DQN(
        "MlpPolicy",
        env,
        learning_rate=5e-4,
        buffer_size=15_000,
        learning_starts=200,
        batch_size=32,
        gamma=0.8,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=50,
        policy_kwargs={"net_arch": [256, 256]},
        seed=chosen.seed,
        device="cpu",
    )
    start, used = time.perf_counter(), time.process_time()
    model.learn(chosen.steps)
    print(f"{chosen.simulator}: {chosen.steps} steps in {time.perf_counter() - start:.1f} s", end=", ")
    print(f"{time.process_time() - used:.1f} s of CPU time")
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    model.save(chosen.out)
    mean, spread = evaluate_policy(model, model.get_env(), n_eval_episodes=chosen.episodes)
    print(f"{chosen.episodes} episodes: return {mean:.2f} ± {spread:.2f}; the model is in {chosen.out}.zip")
