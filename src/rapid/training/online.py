"""Phase 3, by Q-learning: adapt online in the target scenario, the distilled policy frozen.

Paper: sections 3.3 and 4.4.
"""

import os
from dataclasses import replace
from typing import Any

import numpy as np

from rapid import termination
from rapid.config_learning import AdaptConfig, PpoConfig
from rapid.data.replay import OfflineSampler, ReplayBuffer, join_batches
from rapid.data.transitions import Transitions
from rapid.errors import RapidError
from rapid.networks.denormals import no_denormals
from rapid.networks.q_network import QNetwork, build_network, set_phase
from rapid.progress import Task
from rapid.scenarios import get_scenario
from rapid.seeding import numpy_stream, stream_seed, torch_stream
from rapid.training.learner import Learner
from rapid.training.machinery.diagnostics import Forgetting, gate_size
from rapid.training.machinery.record import Evaluate, Record, Track, crossed, network_fingerprint
from rapid.training.machinery.worlds import Drive, Explorer, MakeWorlds, default_worlds
from rapid.training.offline import check_labels, data_fingerprint

LOG_EVERY = 1_000
"""Environment steps between two lines of metrics."""


@termination.waiting()
@no_denormals()
def adapt(
    network: QNetwork,
    config: AdaptConfig,
    scenario: str,
    directory: str | os.PathLike[str],
    seed: int,
    offline: Transitions | None = None,
    evaluate: Evaluate | None = None,
    progress: Task | None = None,
    *,
    make_worlds: MakeWorlds | None = None,
    checkpoint_seconds: float = 60.0,
    track: Track | None = None,
    teacher_share: float | None = None,
    forgetting: Forgetting | None = None,
) -> QNetwork:
    """Train `network` in place by driving and return it; the same call goes on from the last checkpoint.

    Args:
        network: the distilled network.
        config: steps, exploration, replay, what is trained, loss, optimiser.
        scenario: where it drives.
        directory: where ``metrics.jsonl`` and the checkpoint go.
        seed: of exploration, batches, traffic and the inner attack.
        offline: the offline data: for `config.offline_share`, and to measure forgetting.
        evaluate: called every `config.evaluate_every` environment steps and at the end.
        progress: counts environment steps.
        make_worlds: gives a vector environment of so many worlds with SAME_STEP autoreset; None is `rapid.make_vec`.
        checkpoint_seconds: time between two checkpoints.
        track: is given every row of metrics.
        teacher_share: share of teacher transitions among the offline ones of every batch; None is as they lie.
        forgetting: compares with what was distilled; None compares with `network` as it is given.

    Raises:
        RapidError: settings that do not fit the data, a loss that is not finite (the last good checkpoint stays), or a
            directory of another training.
    """
    if network.is_stack:
        raise RapidError("A stack of networks cannot drive. Adapt one network at a time.")
    offline_count = _check(config, offline)
    device = str(next(network.parameters()).device)
    record = Record(
        directory,
        {
            "phase": "adapt",
            # What comes after does not matter here: it may be added once this is done.
            "config": replace(config, ppo=PpoConfig()),
            "network": network.config,
            "weights": network_fingerprint(network),
            "data": data_fingerprint(offline) if offline is not None else None,
            "scenario": scenario,
            "seed": seed,
            **({"teacher_share": teacher_share} if teacher_share is not None else {}),
        },
        checkpoint_seconds,
        track,
    )
    forgetting = forgetting or Forgetting(network, offline, seed)
    if config.train == "scratch":
        fresh = build_network(network.config, network.lanes, stream_seed(seed, "adapt/network"))
        network.load_state_dict(fresh.state_dict())
    set_phase(network, "adapt" if config.train == "adapter" else "all", config.freeze_decoder)

    # Whole rounds of all worlds; one gradient step for every 1 / updates_per_step environment steps after the start.
    worlds_count = config.num_envs
    total_steps = -(-config.steps // worlds_count) * worlds_count
    planned = int(max(total_steps - config.learning_starts, 0) * config.updates_per_step)
    loss = config.loss
    learner = Learner(network, config.optimizer, loss, planned, torch_stream(seed, "adapt/attack", device))
    vehicles = network.config.vehicles
    buffer = ReplayBuffer(config.buffer_size, worlds_count, loss.discount, loss.n_step, device, vehicles)
    # Over several steps the offline rewards would be those of other drivers, half of them random.
    sampler = None
    if offline and offline_count:
        sampler = OfflineSampler(offline, loss.discount, 1, device, teacher_share, vehicles)
    rng = numpy_stream(seed, "adapt/exploration and batches")
    drive = Drive(make_worlds or default_worlds(scenario, vehicles), worlds_count, seed)
    explorer = Explorer(worlds_count, config.exploration_hold)
    timed = get_scenario(scenario).clock
    steps = 0

    def state() -> dict[str, Any]:
        return {
            "learner": learner.state_dict(),
            "buffer": buffer.state_dict(),
            "rng": rng.bit_generator.state,
            "drive": drive.state_dict(),
            "explorer": explorer.state_dict(),
            "steps": steps,
        }

    if (saved := record.resume()) is not None:
        learner.load_state_dict(saved["learner"])
        buffer.load_state_dict(saved["buffer"])
        rng.bit_generator.state = saved["rng"]
        drive.load_state_dict(saved["drive"])
        explorer.load_state_dict(saved["explorer"])
        steps = saved["steps"]
        if progress:
            progress.skip(steps)

    while steps < total_steps:
        epsilon = exploration(config, steps)
        action_W = explorer.act(network, drive.obs_WVF, epsilon, rng, device)
        obs_WVF, action_W, reward_W, next_obs_WVF, terminated_W, truncated_W = drive.step(action_W)
        # Who sees the clock is told that nothing comes after the time limit; to all others it is no end.
        ended_W = terminated_W | truncated_W if timed else terminated_W
        buffer.add(obs_WVF, action_W, reward_W, next_obs_WVF, ended_W, truncated_W)
        steps += worlds_count

        due = int((steps - config.learning_starts) * config.updates_per_step)
        while learner.updates < due and len(buffer):
            batch = buffer.sample(config.optimizer.batch_size - offline_count, rng)
            learner.update(join_batches(batch, sampler.sample(offline_count, rng)) if sampler else batch)

        last = steps >= total_steps
        measure = last or crossed(steps, worlds_count, config.evaluate_every)
        if not measure and not crossed(steps, worlds_count, LOG_EVERY):
            continue
        row = {
            "step": steps,
            "updates": learner.updates,
            **learner.means(),
            **drive.means(),
            "learning_rate": learner.learning_rate,
            "exploration": epsilon,
            "gate": gate_size(network),
            "seconds": record.seconds,
        }
        if measure:
            row["agreement"] = forgetting.agreement(network)
            if evaluate and config.evaluate_every:
                row["evaluation"] = evaluate(network, steps)
        record.write(row)
        record.checkpoint(state, now=last)
        if progress:
            progress.advance(steps - progress.done)
            progress.note(f"return {row['return']:.1f}" if row.get("return") is not None else "")
    drive.close()
    return network


def exploration(config: AdaptConfig, steps: int) -> float:
    """Return epsilon after so many environment steps: linear over the first `exploration_share`, then constant."""
    span = config.exploration_share * config.steps
    progress = min(steps / span, 1.0) if span > 0 else 1.0
    return config.exploration_start + progress * (config.exploration_end - config.exploration_start)


def _check(config: AdaptConfig, offline: Transitions | None) -> int:
    """Return how many transitions of each batch are offline ones, if the settings fit together."""
    count = int(np.floor(config.offline_share * config.optimizer.batch_size + 0.5))
    if config.optimizer.algorithm == "bc":
        raise RapidError("Cloning has nothing to learn from its own driving. Set adapt.optimizer.algorithm to 'dqn'.")
    if count and offline is None:
        raise RapidError("adapt.offline_share needs the offline data. Give the dataset, or set the share to 0.")
    if config.loss.robust_weight > 0 and config.loss.robust_on == "teacher":
        if not count or offline is None:
            raise RapidError(
                "adapt.loss.robust_on is 'teacher', but no teacher transitions are in the batches. Raise "
                "adapt.offline_share, or set adapt.loss.robust_on to 'all' or adapt.loss.robust_weight to 0."
            )
        check_labels(offline, config.loss, config.optimizer.algorithm)
    return count
