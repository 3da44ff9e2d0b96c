"""Phase 3 on disk: let an agent learn online, by Q-learning and then by PPO."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from rapid.agents.open import check_road
from rapid.agents.origin import at
from rapid.agents.q_agent import QAgent
from rapid.agents.saved import load_agent, save_agent
from rapid.baselines import OnlineBaseline
from rapid.config import Config, without_place
from rapid.config_io import parts_of, to_dict
from rapid.config_learning import NetworkConfig
from rapid.data.dataset import load_dataset
from rapid.errors import RapidError
from rapid.networks.conversions import for_lanes, widened, with_memory
from rapid.networks.q_network import build_network, check_memory
from rapid.phases.checks import shown_plan
from rapid.phases.data import learnable
from rapid.phases.measure import learning_curve
from rapid.progress import task
from rapid.scenarios import get_scenario, seeing
from rapid.seeding import stream_seed
from rapid.simulator import make_vec
from rapid.tracking import Tracker
from rapid.training.machinery.diagnostics import Forgetting
from rapid.training.online import adapt
from rapid.training.ppo import adapt_by_ppo

PPO = "ppo"
"""Where, beside the record of phase 3's Q-learning, that of its second part lies."""


ONLINE: dict[str, tuple[OnlineBaseline, str]] = {
    "online-dqn": ("dqn", "online DQN"),
    "online-ppo": ("ppo", "online PPO"),
}
"""Baselines of a run that learn online from new weights, with as many steps as RAPID's phase 3: directory, algorithm
and name."""


def new_agent(network: NetworkConfig, scenario: str, seed: int, out: Path) -> None:
    """Write an agent with new weights to `out`."""
    fresh = build_network(network, get_scenario(scenario).lanes, stream_seed(seed, "network"))
    save_agent(out, fresh, {"name": "new weights", "phase": "new", "scenario": scenario, "seed": seed})


def learn_online(config: Config, out: Path, name: str) -> QAgent:
    """Let an agent with new weights learn online in the target scenario; it is written to ``out/agent``."""
    start = out / "new"
    new_agent(config.network, config.adapt.scenario or config.scenario, config.seed, start)
    return adapt_agent(config, start, None, out, name)


def adapt_agent(config: Config, agent: Path, data: Path | None, out: Path, name: str = "RAPID") -> QAgent:
    """Let the agent in `agent` learn online in the target scenario; it is written to ``out/agent``."""
    distilled = load_agent(agent, config.device)
    scenario = config.adapt.scenario or distilled.metadata.get("scenario", config.scenario)
    settings = config.adapt if data else replace(config.adapt, offline_share=0.0)
    network, seed = distilled.network, stream_seed(config.seed, "adapt")
    if agent.resolve() == (out / "agent").resolve():
        raise RapidError(f"Adapting '{agent}' into '{out}' would replace the agent itself. Choose another directory.")
    dataset = load_dataset(data) if data else None
    offline = learnable(dataset) if dataset else None
    if settings.memory or network.memory is not None:
        check_memory(replace(network.config, memory=True, mirror=network.config.mirror or settings.mirror))
    # Of what was distilled, before it is mirrored or sees farther.
    forgetting = Forgetting(network, offline, seed)
    if settings.vehicles:
        network = widened(network, settings.vehicles)
    if settings.mirror:
        network.config = replace(network.config, mirror=True)
    if network.memory is not None and settings.steps:
        raise RapidError(
            f"'{agent}' has a memory, and Q-learning keeps none. Set adapt.steps to 0, to go on by PPO alone."
        )
    lanes = get_scenario(scenario).lanes
    if network.memory is not None and network.lanes != lanes:
        network = for_lanes(network, lanes)
    if settings.shield:
        network.config = replace(network.config, shield=settings.shield)
    check_road(QAgent(network, distilled.name), scenario)
    plan = shown_plan(settings, scenario)
    evaluate, seen = learning_curve(config, scenario, name), seeing(network.config.vehicles)
    tracker = Tracker(config.tracking, out, f"adapt-{name}".replace(" ", "-"), to_dict(without_place(config)))
    rollout = settings.ppo.num_envs * settings.ppo.rollout
    total = settings.steps + settings.ppo.steps // rollout * rollout
    with tracker, task(f"adapt, {name}", total, "steps") as work:
        if settings.steps:
            adapt(
                network,
                settings,
                scenario,
                out,
                seed=seed,
                offline=offline,
                evaluate=evaluate,
                progress=work,
                make_worlds=lambda count: make_vec(scenario, count, config.simulator, config=seen),
                track=tracker.log,
                teacher_share=dataset.teacher_share if dataset else None,
                forgetting=forgetting,
            )
        if settings.ppo.steps:
            origin = None
            if settings.memory:
                seeing_all = for_lanes(with_memory(network), lanes)
                network = with_memory(seeing_all, settings.squeeze)
                # What it did before it read squeezed features, by features as they are.
                origin = None if network is seeing_all else seeing_all
            timed = replace(get_scenario(scenario), clock=True)
            # As many processes step the worlds as the learner may use threads.
            processes = config.threads if config.simulator == "compiled" else 1
            adapt_by_ppo(
                network,
                settings,
                scenario,
                out / PPO,
                seed=seed,
                forgetting=forgetting,
                evaluate=evaluate,
                progress=work,
                make_worlds=lambda count: make_vec(timed, count, config.simulator, config=seen, processes=processes),
                track=tracker.log,
                plan=plan,
                origin=origin,
            )
    metadata = {"name": name, "phase": "adapt", "from": str(agent), "scenario": scenario, "seed": config.seed}
    if (weight := _robust_weight(distilled.metadata)) is not None:
        metadata["robust_weight"] = weight
    # What was used, which need not be what was asked for.
    used = replace(config, scenario=scenario, network=network.config, adapt=replace(settings, scenario=scenario))
    save_agent(out / "agent", network, metadata | {"config": parts_of(used, "network", "adapt")})
    return QAgent(network, name)


def _robust_weight(metadata: dict[str, Any]) -> Any:
    """Return the weight of J_robust with which an agent was distilled, however often adapted since; None if unknown.

    The settings of an adapted agent no longer tell it, and it decides which of the paper's agents this is.
    """
    own = at(metadata, "config", "distill", "loss", "robust_weight")
    return metadata.get("robust_weight") if own is None else own
