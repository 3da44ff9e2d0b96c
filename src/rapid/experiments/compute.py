"""How each kind of cell is computed: from the directories of its inputs into its own, by the phases on disk."""

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import rapid
from rapid.agents.monitored import save_monitored
from rapid.agents.open import open_agent
from rapid.agents.saved import load_agent, moved_on, remembers
from rapid.config import Config
from rapid.config_learning import NetworkConfig
from rapid.data.dataset import load_dataset, mix, save_dataset
from rapid.data.relabel import relabel
from rapid.errors import RapidError
from rapid.evaluation.metrics import save_rows
from rapid.evaluation.rollouts import evaluate_agent, is_applicable
from rapid.experiments.cells import (
    Adapt,
    Cell,
    Collect,
    Data,
    Decide,
    Distill,
    Drive,
    Driven,
    Driver,
    Fresh,
    Mix,
    Monitored,
    Relabel,
    Scenes,
    Shipped,
    data_scenario,
    key,
    kind_of,
)
from rapid.experiments.store import FACTS, ROWS
from rapid.files import write_json
from rapid.phases.adapt import adapt_agent, new_agent
from rapid.phases.data import collect_transitions
from rapid.phases.distill import distill_agent
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.seeding import stream_seed
from rapid.spawns import spawn_seeds
from rapid.teacher import make_teacher

SCENE = 15
"""Decisions before a scene is looked at: the middle of an episode of 30."""


def compute(cell: Cell, place: Path, given: Mapping[str, Path]) -> None:
    """Compute a cell into `place`, reading its inputs' directories from `given`, by their keys.

    A training goes on from the checkpoint that an earlier call left in `place`.

    Raises:
        RapidError: whatever keeps the work from its end.
    """
    match cell:
        case Collect():
            _collect(cell, place)
        case Relabel():
            save_dataset(relabel(load_dataset(_data(cell.data, given)), cell.reward), place / "data")
        case Mix():
            teacher, random = (load_dataset(_data(data, given)) for data in (cell.teacher, cell.random))
            settings = cell.settings
            mixed = mix(
                teacher, random, settings.p, settings.size, stream_seed(cell.seed, "mix"), settings.level
            )  # the stream that `rapid run` draws from
            save_dataset(mixed, place / "data")
        case Fresh():
            new_agent(cell.network, cell.scenario, cell.seed, place / "agent")
        case Distill():
            distill_agent(_settings(cell), given[key(cell.data)] / "data", place)
        case Adapt():
            data = given[key(cell.data)] / "data" if cell.data else None
            adapt_agent(_settings(cell), _folder(cell.origin, given), data, place)
        case Monitored():
            metadata = {"name": "monitored", "scenario": cell.scenario, "seed": cell.seed}
            save_monitored(place / "agent", _folder(cell.calm, given), _folder(cell.wary, given), metadata)
        case Drive():
            _drive(cell, place, given)
        case Scenes():
            _scenes(cell, place, given)
        case Decide():
            _decide(cell, place, given)
        case Shipped():
            raise RapidError("A shipped dataset is there already.")


def _settings(cell: Distill | Adapt) -> Config:
    """Return the whole tree of settings of a training."""
    base = Config(seed=cell.seed)
    evaluate = replace(base.evaluate, curve_spawns=cell.curve_spawns)
    if isinstance(cell, Distill):
        scenario = data_scenario(cell.data)
        mixture = cell.data.settings
        return replace(
            base, scenario=scenario, network=cell.network, distill=cell.settings, evaluate=evaluate, mix=mixture
        )
    adapt = replace(cell.settings, scenario=cell.scenario)
    config = replace(base, scenario=cell.scenario, adapt=adapt, evaluate=evaluate)
    origin = _root(cell)
    config = replace(config, network=_network(cell))
    return replace(config, distill=origin.settings, mix=origin.data.settings) if isinstance(origin, Distill) else config


def _data(data: Data, given: Mapping[str, Path]) -> Path:
    if isinstance(data, Shipped):
        return Path(f"shipped:{data.scenario}/{data.source}")
    return given[key(data)] / "data"


def _collect(cell: Collect, place: Path) -> None:
    random = (cell.driver.backend, cell.driver.model) == ("scripted", "random")
    collect = replace(Config().collect, teacher_transitions=cell.transitions, random_transitions=cell.transitions)
    config = Config(scenario=cell.scenario, teacher=cell.driver, collect=collect, seed=cell.seed)
    dataset = collect_transitions(config, place / "data", "random" if random else "teacher")
    if len(dataset) < cell.transitions:
        raise RapidError(f"Only {len(dataset)} of {cell.transitions} transitions were collected. Run it again.")


def _folder(agent: Distill | Adapt | Monitored | Fresh | Driver, given: Mapping[str, Path]) -> Path:
    # The name of a shipped agent is read like a directory.
    return Path(agent.name) if isinstance(agent, Driver) else given[key(agent)] / "agent"


def _agent(agent: Driven, scenario: str, given: Mapping[str, Path], seed: int) -> Any:
    if not isinstance(agent, Driver):
        return open_agent(str(_folder(agent, given)), scenario, seed)
    if agent.teacher is not None:
        return make_teacher(agent.teacher, get_scenario(scenario).lanes, seed)
    return open_agent(agent.name, scenario, seed)


def _drive(cell: Drive, place: Path, given: Mapping[str, Path]) -> None:
    agent = _agent(cell.agent, cell.scenario, given, cell.seed)
    if not is_applicable(agent, cell.attack):
        raise RapidError(f"The attack '{cell.attack}' cannot be made on '{agent.name}'.")
    rows = evaluate_agent(
        agent,
        cell.scenario,
        spawn_seeds(cell.spawn_set, cell.spawns),
        (cell.attack,),
        generator_seed=cell.seed,
        training_seed=None if isinstance(cell.agent, Driver) else cell.agent.seed,
        commit=_commit(),
    )
    save_rows(place / ROWS, rows)


_commit = cache(commit)


def _scenes(cell: Scenes, place: Path, given: Mapping[str, Path]) -> None:
    """The scenes are the middle of the first `count` test spawns' episodes, or the last before they end."""
    agent = _agent(cell.agent, cell.scenario, given, cell.seed)
    scenes: list[dict[str, Any]] = []
    for seed in spawn_seeds("test", cell.count):
        env = rapid.make_env(cell.scenario)
        obs_VF, _ = env.reset(seed=seed)
        # What an agent with a memory is given beside the observation.
        known: tuple[Any, ...] = (agent.start(1),) if remembers(agent) else ()
        for _ in range(SCENE):
            action_B = agent.act(np.asarray(obs_VF)[None], *known)
            known = tuple(agent.remember(state_BS, action_B) for state_BS in known)
            obs_VF, _, terminated, truncated, _ = env.step(int(action_B[0]))
            if terminated or truncated:
                break
        env.close()
        told = agent.explain(np.asarray(obs_VF)[None], *known)
        weights_VN = None if told.weights_BVN is None else told.weights_BVN[0].tolist()
        scenes.append(
            {
                "seed": seed,
                "obs": np.asarray(obs_VF).tolist(),
                "weights": weights_VN,
                "q": agent.q_values(np.asarray(obs_VF)[None], *known)[0].tolist(),
            }
        )
    gate = getattr(agent.network, "gate", None)
    write_json(place / FACTS, {"scenes": scenes, "gate": None if gate is None else gate.detach().tolist()})


def _decide(cell: Decide, place: Path, given: Mapping[str, Path]) -> None:
    """One world at a time, as a car would ask; the first decision, which loads and compiles, is not counted."""
    agent = _agent(cell.agent, cell.scenario, given, 0)
    env = rapid.make_env(cell.scenario)
    seconds: list[float] = []
    previous: Any = None
    seeds = iter(spawn_seeds("tune", cell.decisions + 1))
    obs_VF, _ = env.reset(seed=next(seeds))
    known: tuple[Any, ...] = (agent.start(1),) if remembers(agent) else ()
    while len(seconds) <= cell.decisions:
        start = time.perf_counter()
        if hasattr(agent, "decide"):
            decision = agent.decide(np.asarray(obs_VF)[None], [previous], np.array([len(seconds)], np.int64))[0]
            action, previous = int(decision.action), decision
        else:
            action_B = agent.act(np.asarray(obs_VF)[None], *known)
            known = tuple(moved_on(agent, np.asarray(obs_VF)[None], state_BS, action_B) for state_BS in known)
            action = int(action_B[0])
        seconds.append(time.perf_counter() - start)
        obs_VF, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            previous = None
            known = (agent.start(1),) if remembers(agent) else ()
            obs_VF, _ = env.reset(seed=next(seeds))
    env.close()
    count = len(seconds) - 1
    write_json(
        place / FACTS,
        {
            "agent": agent.name,
            "decisions": count,
            "median_seconds": float(np.median(seconds[1:])),
            "mean_seconds": float(np.mean(seconds[1:])),
            "threads": torch.get_num_threads(),
        },
    )


def work_of(cell: Cell) -> tuple[str, float]:
    """Return what a cell's time is counted in, and how many: for predictions.

    Robust inner attacks and networks of tokens make a gradient step dearer, gradient attacks a driven episode.
    """
    match cell:
        case Collect():
            return f"collect/{cell.driver.backend}/{cell.driver.model}/{cell.driver.style}", cell.transitions
        case Distill():
            loss = cell.settings.loss
            robust = f"{loss.robust_on}-{loss.robust.steps}" if loss.robust_weight else "none"
            batch = cell.settings.optimizer.batch_size
            return f"distill/{_size(cell.network)}/{robust}/{batch}", float(cell.settings.iterations)
        case Adapt():
            settings = cell.settings
            attacked = "-attacked" if settings.adversary.gradient_share else ""
            part = f"ppo{attacked}" if settings.ppo.steps else "q"
            updates = settings.steps * settings.updates_per_step
            return f"adapt/{_size(_network(cell))}/{part}", settings.ppo.steps or max(updates, 1.0)
        case Drive():
            who = cell.agent.name if isinstance(cell.agent, Driver) else _size(_network(cell.agent))
            return f"drive/{who}/{cell.attack.partition(':')[0]}", float(cell.spawns)
        case Decide():
            return f"decide/{cell.agent.name if isinstance(cell.agent, Driver) else 'policy'}", cell.decisions
        case _:
            return kind_of(cell), 1.0


def _size(network: NetworkConfig) -> str:
    return network.kind if network.kind == "mlp" else f"{network.kind}/{network.width}x{network.layers}"


def _root(agent: Distill | Adapt | Fresh | Driver) -> Distill | Fresh | Driver:
    while isinstance(agent, Adapt):
        agent = agent.origin
    return agent


def _network(agent: Distill | Adapt | Monitored | Fresh | Driver) -> NetworkConfig:
    """Return the settings of the network that an agent began with; of two with a monitor the wary one's."""
    agent = agent.wary if isinstance(agent, Monitored) else agent
    root = _root(agent)
    return _of_shipped(root.name) if isinstance(root, Driver) else root.network


@cache
def _of_shipped(name: str) -> NetworkConfig:
    return load_agent(name).network.config
