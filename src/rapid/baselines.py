"""The settings of what RAPID is compared with: MLPs that learn offline or online, derived from RAPID's own."""

from dataclasses import replace
from typing import Literal

from rapid.config import AdversaryConfig, Config
from rapid.experiments.paper import paper_numbers

OfflineBaseline = Literal["dqn", "ddqn", "cql", "bc"]


def offline_baseline(config: Config, algorithm: OfflineBaseline) -> Config:
    """Return the settings of an MLP that learns offline by another algorithm.

    They are those of RAPID but for what makes the algorithm; in the recipe `paper`, step size, batch and target updates
    are what the paper's table prints for it. CQL builds on double DQN, as d3rlpy's does.
    """
    loss = replace(
        config.distill.loss,
        conservative_weight=1.0 if algorithm == "cql" else 0.0,
        robust_weight=0.0,
        double=algorithm in ("ddqn", "cql"),
    )
    optimizer = replace(config.distill.optimizer, algorithm="bc" if algorithm == "bc" else "dqn")
    if config.recipe == "paper" and algorithm != "bc":
        printed = paper_numbers()["hyperparameters"][algorithm]
        optimizer = replace(
            optimizer,
            learning_rate=printed["learning_rate"],
            batch_size=printed["batch_size"],
            target_update=printed["target_update_interval"],
        )
    network = replace(config.network, kind="mlp")
    return replace(config, network=network, distill=replace(config.distill, loss=loss, optimizer=optimizer))


MLP_DISCOUNT = 0.93
"""Longest discount of the MLPs from scratch: chosen of 0.9, 0.93 and 0.95 by one training each (docs/log/)."""

OnlineBaseline = Literal["dqn", "ddqn", "munchausen", "ppo"]


def online_baseline(config: Config, algorithm: OnlineBaseline) -> Config:
    """Return the settings of an MLP that learns online from new weights, with as many steps as RAPID's phase 3.

    `munchausen` learns by both parts of phase 3 as RAPID does, `dqn` and `ddqn` by Q-learning alone, `ppo` by PPO
    alone. In the recipe `paper` the DQN has the step size that the paper prints for it.
    """
    adapt = config.adapt
    discount = adapt.loss.discount if config.recipe == "paper" else min(adapt.loss.discount, MLP_DISCOUNT)
    loss = replace(
        adapt.loss,
        conservative_weight=0.0,
        double=algorithm != "dqn",
        munchausen_weight=adapt.loss.munchausen_weight if algorithm == "munchausen" else 0.0,
        discount=discount,
    )
    rate = 5e-4
    if config.recipe == "paper" and algorithm == "dqn":
        rate = paper_numbers()["hyperparameters"]["dqn"]["learning_rate"]
    steps, ppo = adapt.steps + adapt.ppo.steps, adapt.ppo
    # An MLP has weights for every row and no tokens: it sees from the start as far as RAPID in the end, and no memory.
    rows = adapt.vehicles or config.network.vehicles
    network = replace(config.network, kind="mlp", memory=False, squeeze=False, vehicles=rows)
    adapt = replace(
        adapt,
        train="scratch",
        vehicles=0,
        memory=False,
        squeeze=False,
        exploration_start=1.0,
        exploration_end=0.05,
        offline_share=0.0,
        loss=loss,
        optimizer=replace(adapt.optimizer, learning_rate=rate),
    )
    if algorithm in ("dqn", "ddqn"):
        # Q-learning is not attacked.
        adapt = replace(adapt, steps=steps, ppo=replace(ppo, steps=0), adversary=AdversaryConfig())
    elif algorithm == "ppo":
        # Two rollouts at least: its policy changes between them.
        steps = max(steps, 2 * ppo.num_envs * ppo.rollout)
        adapt = replace(adapt, steps=0, ppo=replace(ppo, steps=steps, critic_steps=0), train="all")
    # What a guide shows goes by a memory.
    adapt = replace(adapt, adversary=replace(adapt.adversary, guided=0.0))
    return replace(config, network=network, adapt=adapt)
