"""Phase 2: distil the teacher's data into the network, offline (paper: section 3.2).

DQN, double DQN, CQL and behaviour cloning are settings of the one loop, for every kind of network.
"""

import os
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from rapid import termination
from rapid.config_learning import DistillConfig, LossConfig, NetworkConfig
from rapid.data.replay import OfflineSampler
from rapid.data.transitions import TEACHER, Transitions
from rapid.errors import RapidError
from rapid.networks.denormals import no_denormals
from rapid.networks.q_network import QNetwork, set_phase
from rapid.networks.stack import unstack_networks
from rapid.progress import Task
from rapid.seeding import numpy_stream, torch_stream
from rapid.training.learner import Learner
from rapid.training.machinery.record import Evaluate, Record, Track, crossed, fingerprint, network_fingerprint

LOG_EVERY = 100


@termination.waiting()
@no_denormals()
def distill(
    transitions: Transitions,
    network: QNetwork,
    config: DistillConfig,
    directory: str | os.PathLike[str],
    seed: int | Sequence[int],
    evaluate: Evaluate | None = None,
    progress: Task | None = None,
    *,
    teacher_share: float | None = None,
    checkpoint_seconds: float = 60.0,
    track: Track | None = None,
) -> QNetwork:
    """Train `network` in place on a fixed dataset and return it; the same call goes on from the last checkpoint.

    Args:
        transitions: the dataset, teacher and random transitions mixed.
        network: policy 1, the router and the decoder are trained (phase `distill`). Of a stack
            (:mod:`rapid.networks.stack`) every member is trained as it would be alone.
        config: iterations, loss, optimiser.
        directory: where ``metrics.jsonl`` and the checkpoint go.
        seed: of the batches and the inner attack; of a stack one for each member.
        evaluate: called every `config.evaluate_every` iterations and at the end, for each member of a stack.
        progress: counts iterations.
        teacher_share: see `Dataset.teacher_share`.
        checkpoint_seconds: time between two checkpoints.
        track: is given every row of metrics.

    Raises:
        RapidError: an empty dataset, one without what the loss needs, a loss that is not finite (the last good
            checkpoint stays), or a directory of another training.
    """
    check_labels(transitions, config.loss, config.optimizer.algorithm)
    seeds = [seed] if isinstance(seed, int) else list(seed)
    _check_members(network, seeds, config)
    device = str(next(network.parameters()).device)
    set_phase(network, "distill")
    record = Record(
        directory,
        {
            "phase": "distill",
            "config": config,
            "network": network.config,
            "weights": network_fingerprint(network),
            "data": data_fingerprint(transitions),
            "teacher_share": teacher_share,
            "seed": seeds[0] if len(seeds) == 1 else seeds,
        },
        checkpoint_seconds,
        track,
    )
    sampler = OfflineSampler(transitions, config.loss.discount, config.loss.n_step, device, teacher_share)
    rngs = [numpy_stream(each, "distill/batches") for each in seeds]
    attack = torch_stream(seeds[0], "distill/attack", device)
    learner = Learner(network, config.optimizer, config.loss, config.iterations, attack)

    def state() -> dict[str, Any]:
        first, *others = (rng.bit_generator.state for rng in rngs)
        return {"learner": learner.state_dict(), "rng": first, "other_rngs": others}

    if (saved := record.resume()) is not None:
        learner.load_state_dict(saved["learner"])
        for rng, was in zip(rngs, [saved["rng"], *saved.get("other_rngs", [])], strict=True):
            rng.bit_generator.state = was
        if progress:
            progress.skip(learner.updates)

    while learner.updates < config.iterations:
        learner.update(sampler.sample(config.optimizer.batch_size, *rngs))

        done = learner.updates
        last = done == config.iterations
        measure = last or crossed(done, 1, config.evaluate_every)
        if not measure and not crossed(done, 1, LOG_EVERY):
            continue
        row = {"iteration": done, **learner.means(), "learning_rate": learner.learning_rate, "seconds": record.seconds}
        if evaluate and measure and config.evaluate_every:
            if len(seeds) == 1:
                row["evaluation"] = evaluate(network, done)
            else:
                members = enumerate(unstack_networks(network))
                row["evaluation"] = {f"member-{index}": evaluate(member, done) for index, member in members}
        record.write(row)
        record.checkpoint(state, now=last)
        if progress:
            progress.advance(done - progress.done)
            progress.note(f"loss {row['total']:.3g}")
    return network


def is_stackable(network: NetworkConfig, config: DistillConfig) -> bool:
    """Whether several such networks can be trained as one stack: the loss is then the mean of the members' losses.

    The robust and the Munchausen term put two batches behind each other, which no stack can read; and how many of the
    teacher's transitions are cloned differs between members.
    """
    teacher_only = config.optimizer.algorithm == "bc" and config.loss.robust_on == "teacher"
    concatenates = config.loss.robust_weight > 0 or config.loss.munchausen_weight > 0
    return network.kind == "mlp" and not concatenates and not teacher_only


def _check_members(network: QNetwork, seeds: Sequence[int], config: DistillConfig) -> None:
    """Raise unless there is a seed for each member, and a stack can be trained like this."""
    if len(seeds) != network.members:
        raise RapidError(f"There are {len(seeds)} seeds for {network.members} networks. Give one for each.")
    if len(seeds) > 1 and not is_stackable(network.config, config):
        raise RapidError(
            "A stack of networks has no robust and no Munchausen term, and does not clone the teacher's transitions "
            "alone. Train each network by itself, or set loss.robust_weight and loss.munchausen_weight to 0 and "
            "loss.robust_on to 'all'."
        )


def check_labels(transitions: Transitions, loss: LossConfig, algorithm: str) -> None:
    """Raise unless the data has what the loss is built on.

    Raises:
        RapidError: no transitions, no transition of a teacher, or no action probabilities, where they are needed.
    """
    if not len(transitions):
        raise RapidError("The dataset is empty. Collect transitions first.")
    needed = algorithm == "bc" or loss.robust_weight > 0
    if needed and loss.robust_on == "teacher" and not (transitions.source_N == TEACHER).any():
        raise RapidError(
            "The loss needs transitions of the teacher (loss.robust_on is 'teacher'), but the dataset has none. Set "
            "loss.robust_on to 'all', or mix in the teacher's data."
        )
    if loss.robust_weight > 0 and loss.robust_labels == "soft" and np.isnan(transitions.probabilities_NA).all():
        raise RapidError(
            "The loss needs the teacher's action probabilities (loss.robust_labels is 'soft'), but the dataset has "
            "none. Set loss.robust_labels to 'hard', or collect with a teacher that gives them."
        )


def data_fingerprint(transitions: Transitions) -> str:
    """Return the SHA-256 of all arrays."""
    return fingerprint(getattr(transitions, field.name) for field in fields(transitions))
