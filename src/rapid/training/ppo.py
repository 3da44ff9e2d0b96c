"""Phase 3, second part: policy gradients on the return itself (PPO; Schulman et al., 2017).

Q-learning discounts, and no observation tells when an episode ends, so what it optimises is not quite what is measured:
the sum of rewards until the time is up. From what it has found, PPO goes on with just that. The policy is softmax(Q/T),
so afterwards Q-values are preferences, no longer estimates of a return. The critic, needed in training alone, is told
the time that the policy does not see (an asymmetric actor-critic; Pinto et al., 2018). Under attack
(`adapt.adversary`) the policy alone sees what is left of an observation (:mod:`rapid.training.collector`).

Shapes: N transitions of a rollout, B a minibatch, V vehicles, F features, S entries of a state, A actions.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rapid import termination
from rapid.config_io import least_steps
from rapid.config_learning import AdaptConfig
from rapid.errors import RapidError
from rapid.networks.denormals import no_denormals
from rapid.networks.q_network import QNetwork, set_phase
from rapid.progress import Task
from rapid.scenarios import get_scenario
from rapid.seeding import stream_seed, torch_stream
from rapid.training.collector import Collector
from rapid.training.machinery.diagnostics import Forgetting, gate_size
from rapid.training.machinery.guide import Guide
from rapid.training.machinery.record import Evaluate, Record, Track, crossed, network_fingerprint
from rapid.training.machinery.worlds import Drive, MakeWorlds, default_worlds
from rapid.training.ppo_learner import PpoLearner


@termination.waiting()
@no_denormals()
def adapt_by_ppo(
    network: QNetwork,
    config: AdaptConfig,
    scenario: str,
    directory: str | os.PathLike[str],
    seed: int,
    forgetting: Forgetting | None = None,
    evaluate: Evaluate | None = None,
    progress: Task | None = None,
    *,
    make_worlds: MakeWorlds | None = None,
    checkpoint_seconds: float = 60.0,
    track: Track | None = None,
    plan: Sequence[int] = (),
    origin: QNetwork | None = None,
) -> QNetwork:
    """Train `network` in place for `config.ppo.steps` and return it; the same call goes on from the last checkpoint.

    Args:
        network: what phase 3 has taught by Q-learning, or any other network.
        config: `ppo`, and of the rest what is trained, how often it is measured, and the gate's rate.
        scenario: where it drives.
        directory: where ``metrics.jsonl`` and the checkpoint go.
        seed: of actions, minibatches, traffic and the critic's first weights.
        forgetting: measures how far the policy still acts as it did when phase 3 began; None leaves that out.
        evaluate: called every `config.evaluate_every` environment steps and at the end.
        progress: counts environment steps.
        make_worlds: gives worlds of `scenario` whose observation tells the time; None is `rapid.make_vec`.
        checkpoint_seconds: time between two checkpoints.
        track: is given every row of metrics; their steps go on from `config.steps`.
        plan: the actions of an episode that a guide shows under attack (`config.adversary.guided`).
        origin: the policy that a guide from the first rollout on shows where nobody attacks. Without it, and later, it
            is the network as it is when the guide begins.

    Raises:
        RapidError: a guide for a network without a memory, or without a plan; steps that teach the policy nothing, a
            loss that is not finite (the last good checkpoint stays), or a directory of another training.
    """
    if network.is_stack:
        raise RapidError("A stack of networks cannot drive. Adapt one network at a time.")
    ppo, seen = config.ppo, get_scenario(scenario)
    if seen.reward == "progress":
        ppo = replace(ppo, crash_penalty=ppo.progress_crash_penalty)
    if ppo.steps < least_steps(config):
        raise RapidError(
            f"adapt.ppo.steps is {ppo.steps}, but the policy learns nothing in less than {least_steps(config)}: "
            f"adapt.ppo.critic_steps = {ppo.critic_steps} in whole rollouts, and one more. Raise it."
        )
    if config.adversary.guided and (network.memory is None or not plan):
        raise RapidError(
            "adapt.adversary.guided shows the policy a plan that goes by the time, so it needs a network with a memory "
            "(adapt.memory) and that plan. Set adapt.adversary.guided to 0 to leave the guide out."
        )
    per_rollout = ppo.num_envs * ppo.rollout
    # No more than asked for: whole rollouts would otherwise go beyond a budget.
    rollouts = ppo.steps // per_rollout
    # What is learned before a later guide begins is not to be unlearned.
    before = origin if 0 in config.adversary.guided_rollouts(rollouts) else None
    device = str(next(network.parameters()).device)
    record = Record(
        directory,
        {
            "phase": "ppo",
            "config": config,
            "network": network.config,
            "weights": network_fingerprint(network),
            "scenario": scenario,
            "seed": seed,
        }
        | ({"plan": list(plan)} if config.adversary.guided else {})
        | ({"origin": network_fingerprint(before)} if before is not None else {}),
        checkpoint_seconds,
        track,
    )
    set_phase(network, "adapt" if config.train == "adapter" else "all", config.freeze_decoder)
    learner = PpoLearner(network, ppo, config.optimizer.gate_rate, seen.clock, seed, rollouts)
    make_worlds = make_worlds or default_worlds(replace(seen, clock=True), network.config.vehicles)
    lanes = network.lanes if network.config.memory else None
    drive = Drive(make_worlds, ppo.num_envs, stream_seed(seed, "ppo"), lanes)

    def make_guide() -> Guide:
        return Guide(network if before is None else before, plan, ppo, torch_stream(seed, "ppo/guide", device))

    collector = Collector(
        drive,
        ppo,
        config.adversary,
        network.scale_F,
        seed,
        device,
        make_guide if config.adversary.guided else None,
    )
    earlier = -(-config.steps // config.num_envs) * config.num_envs
    done = 0

    def state() -> dict[str, Any]:
        return {"learner": learner.state_dict(), "collector": collector.state_dict(), "rollouts": done}

    if (saved := record.resume()) is not None:
        # A guide's copy computes as the network did where it was made.
        with learner.computing():
            collector.load_state_dict(saved["collector"])
        learner.load_state_dict(saved["learner"])
        done = saved["rollouts"]
        if progress:
            progress.skip(done * per_rollout)

    while done < rollouts:
        with learner.computing():
            rollout = collector.collect(learner, done, rollouts)
            guide = collector.guide
            learner.update(rollout, guide.left if guide else 1.0)
        done += 1
        steps, last = earlier + done * per_rollout, done == rollouts
        row = {
            "step": steps,
            "updates": learner.updates,
            **learner.means(),
            **drive.means(),
            "learning_rate": ppo.guide_rate * guide.left if guide else learner.learning_rate,
            "gate": gate_size(network),
            "seconds": record.seconds,
        }
        if last or crossed(steps, per_rollout, config.evaluate_every):
            row["agreement"] = forgetting.agreement(network) if forgetting else None
            if evaluate and config.evaluate_every:
                row["evaluation"] = evaluate(network, steps)
        record.write(row)
        record.checkpoint(state, now=last)
        if progress:
            progress.advance(per_rollout)
            progress.note(f"return {row['return']:.1f}" if row.get("return") is not None else "")
    drive.close()
    return network
