"""PPO of stable-baselines3 on six of HighwayEnv's worlds, with the settings of HighwayEnv's published script.

    python sb3_ppo.py                                  # six compiled worlds in this process
    python sb3_ppo.py --simulator highway-env          # HighwayEnv itself in six processes: one line differs
    rapid import highway_ppo/model.zip                 # the trained model as an agent of RAPID

Needs stable-baselines3 (`pip install stable-baselines3`).
"""

import argparse
import time
from pathlib import Path

import highway_env  # noqa: F401 - registers HighwayEnv's own ids
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv

import rapid

WORLDS, BATCH = 6, 64


def make_worlds(simulator: str, seed: int):
    """Return the worlds to train in."""
    if simulator == "highway-env":
        return make_vec_env("highway-fast-v0", WORLDS, seed, vec_env_cls=SubprocVecEnv)
    return rapid.make_sb3_vec("highway-fast-v0", WORLDS, seed)  # the one line


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--simulator", choices=("compiled", "highway-env"), default="compiled")
    options.add_argument("--steps", type=int, default=20_000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--episodes", type=int, default=20, help="driven afterwards")
    options.add_argument("--out", type=Path, default=Path("highway_ppo/model"))
    chosen = options.parse_args()

    worlds = make_worlds(chosen.simulator, chosen.seed)
    model = PPO(
        "MlpPolicy",
        worlds,
        learning_rate=5e-4,
        n_steps=BATCH * 12 // WORLDS,
        batch_size=BATCH,
        n_epochs=10,
        gamma=0.8,
        policy_kwargs={"net_arch": {"pi": [256, 256], "vf": [256, 256]}},
        seed=chosen.seed,
        device="cpu",
    )
    start = time.perf_counter()
    model.learn(chosen.steps)
    print(f"{chosen.simulator}: {chosen.steps} steps in {time.perf_counter() - start:.1f} s")
    worlds.close()
    chosen.out.parent.mkdir(parents=True, exist_ok=True)
    model.save(chosen.out)
    judge = rapid.make_sb3_vec("highway-fast-v0", WORLDS, seed=1_000_000)
    mean, spread = evaluate_policy(model, judge, n_eval_episodes=chosen.episodes)
    print(f"{chosen.episodes} episodes: return {mean:.2f} ± {spread:.2f}; the model is in {chosen.out}.zip")
