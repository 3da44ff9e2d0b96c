"""The steps of ``rapid run``, each reading the artefacts of the one before: the whole job on one page.

Every function here works on directories, so the verbs of the command line call the same code.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from rapid.agents.open import PLANNERS, check_road, open_agent
from rapid.agents.saved import QAgent, load_agent, save_agent
from rapid.attacks import get_attack
from rapid.config import Config, TeacherConfig, preset, without_place
from rapid.config_io import apply_overrides, to_dict, validate
from rapid.data.collection import Budget, collect, parse_shard
from rapid.data.dataset import Dataset, load_dataset, mix, save_dataset, summary
from rapid.data.journal import exclusive
from rapid.data.sharding import collect_shards, shards_of
from rapid.data.shipped import SHIPPED, shipped_sets
from rapid.data.transitions import Transitions
from rapid.engines import check_engine
from rapid.errors import RapidError, did_you_mean
from rapid.evaluation.metrics import EpisodeRow, load_rows, save_rows
from rapid.evaluation.recording import Recording, load_recordings, save_recordings
from rapid.evaluation.rollouts import Episodes, is_applicable, run_episodes
from rapid.evaluation.summary import summary_text
from rapid.experiments.paper import paper_numbers
from rapid.files import read_json, sha256, write_json, write_text
from rapid.networks.q_network import QNetwork, build_network, check_widening, widened
from rapid.networks.stack import stack_networks, unstack_networks
from rapid.progress import format_seconds, task
from rapid.report import ReportData, RoutingSnapshot, write_figures, write_report
from rapid.runs import RunDirectory, commit
from rapid.scenarios import get_scenario, seeing
from rapid.seeding import stream_seed
from rapid.simulator import make_vec
from rapid.spawns import TrainPart, spawn_seeds
from rapid.teacher import Teacher, check_teacher, make_teacher
from rapid.teacher.models import is_present
from rapid.tracking import Tracker, check_tracking
from rapid.training.machinery.diagnostics import Forgetting
from rapid.training.machinery.record import CHECKPOINT_FILE, load_metrics
from rapid.training.offline import distill, is_stackable
from rapid.training.online import adapt
from rapid.training.ppo import adapt_by_ppo

STEPS = ("collect", "mix", "distill", "adapt", "evaluate", "report")
FLOORS = ("slower", "idle", "random", "rule")
"""Scripted drivers that stand under every score."""
TEACHER = "teacher"
"""The configured teacher, as an agent to be measured."""
PLANNER = "planner"
"""Search with the simulator itself as its model: a reference, no bound."""
PPO = "ppo"
"""Where, beside the record of phase 3's Q-learning, that of its second part lies."""
RECORDED = 4
"""Episodes of the adapted agent, and of the teacher, that the report can play."""


def run(config: Config, directory: Path, restart: str = "", say: Callable[[str], None] = print) -> Path:
    """Do every step that is not done yet and return the path of the report.

    Args:
        config: the settings.
        directory: where the run lives; made, or gone on with.
        restart: a step to redo, with all later ones; empty to redo none.
        say: receives a line at a time.

    Raises:
        RapidError: anything about the input or the surroundings that keeps the run from its end.
    """
    check(config)
    if config.data not in ("", SHIPPED):
        config = replace(config, data=str(Path(config.data).resolve()))
    _check_whole(config)
    if restart and restart not in STEPS:
        raise RapidError(f"Unknown step '{restart}'{did_you_mean(restart, STEPS)} Steps: {', '.join(STEPS)}.")
    home = RunDirectory(directory, config, STEPS)
    with exclusive(home.path / "lock"):
        return _run_steps(config, home, restart, say)


def _run_steps(config: Config, home: RunDirectory, restart: str, say: Callable[[str], None]) -> Path:
    if restart:
        home.restart_from(restart)
    actions: dict[str, Callable[[Config, RunDirectory], dict[str, Any]]] = {
        "collect": _collect,
        "mix": _mix,
        "distill": _distill,
        "adapt": _adapt,
        "evaluate": _evaluate,
        "report": _report,
    }
    _warm_up(config, say)
    say(f"run {home.path}: {config.scenario}, recipe {config.recipe}, scale {config.scale}, seed {config.seed}")
    now = commit()
    earlier = [step for step in STEPS if home.is_done(step) and home.facts(step).get("commit", now) != now]
    if earlier:
        say(f"Done by another commit than today's ({now or 'unknown'}), and kept: {', '.join(earlier)}. --from redoes.")
    for number, step in enumerate(STEPS, 1):
        heading = f"[{number}/{len(STEPS)}] {step}"
        if home.is_done(step):
            say(f"{heading}: done before, in {format_seconds(home.facts(step)['seconds'])}")
            continue
        say(heading)
        start = time.monotonic()
        facts = actions[step](config, home)
        if "note" in facts:
            say(facts["note"])
        home.finish(step, time.monotonic() - start, commit=now, **facts)
    say("\n" + (home.path / "evaluate" / "summary.txt").read_text(encoding="utf-8"))
    times = ", ".join(f"{step} {format_seconds(home.facts(step)['seconds'])}" for step in STEPS)
    say(f"time: {times}")
    say(f"report: {(home.path / 'report.html').resolve()}")
    return home.path / "report.html"


def _warm_up(config: Config, say: Callable[[str], None]) -> None:
    """Use the simulator and its search once, so that their compilation, if it is due, is not taken for a stall."""
    if config.simulator != "compiled":
        return
    notice = threading.Timer(2.0, say, ("Compiling the simulator for this machine, once: about a minute.",))
    notice.start()
    try:
        worlds = make_vec(config.scenario, 1, autoreset=False)
        observation, _ = worlds.reset(seed=0)
        worlds.step(open_agent(PLANNER, config.scenario).bind(worlds).act(observation))
        worlds.close()
    finally:
        notice.cancel()


def check(config: Config) -> None:
    """Look for everything that can be seen to be wrong before any work starts.

    Raises:
        RapidError: the first thing found.
    """
    validate(config)
    torch.set_num_threads(config.threads)
    try:
        torch.empty(0, device=config.device)
    except (RuntimeError, AssertionError) as error:
        raise RapidError(
            f"Device '{config.device}' cannot be used: {str(error).splitlines()[0].rstrip('.')}. Use --device cpu."
        ) from error
    lanes = get_scenario(config.scenario).lanes
    for name in config.evaluate.attacks:
        get_attack(name, lanes)
    parse_shard(config.collect.shard)
    check_engine(config.collect.engine)
    check_tracking(config.tracking)
    check_teacher(config.teacher, lanes)


def _check_whole(config: Config) -> None:
    """Look for steps of one run that cannot follow each other."""
    network, collected, mixture = config.network, config.collect, config.mix
    if config.adapt.train == "adapter" and (network.kind not in ("rapid", "mlp-mixture") or network.num_policies < 2):
        raise RapidError(
            f"adapt.train is 'adapter', but a network of kind '{network.kind}' with {network.num_policies} policies "
            "has no adapter. Choose network.kind 'rapid' with network.num-policies 2, or adapt.train 'all'."
        )
    if config.adapt.vehicles:
        check_widening(network, config.adapt.vehicles)
    own, target = (get_scenario(name).lanes for name in (config.scenario, config.adapt.scenario or config.scenario))
    if (network.mirror or config.adapt.mirror) and own != target:
        raise RapidError(
            f"A network that mirrors the road does so on {own} lanes, those of scenario '{config.scenario}', but "
            f"adapt.scenario '{config.adapt.scenario}' has {target}. Choose one of {own} lanes, or do without mirror."
        )
    if config.data:
        _given_data(config)
        return
    for source, have, share in (
        ("teacher", collected.teacher_transitions, mixture.p),
        ("random", collected.random_transitions, 1 - mixture.p),
    ):
        if have < 1 or (mixture.level == "transition" and have < int(share * mixture.size)):
            raise RapidError(
                f"mix.size {mixture.size} at mix.p {mixture.p:g} needs {max(1, int(share * mixture.size))} {source} "
                f"transitions, but collect.{source}_transitions is {have}. Collect more, or mix less."
            )


# Phase 1


def _collect(config: Config, home: RunDirectory) -> dict[str, Any]:
    if config.data:
        teacher_data, random_data = _given_data(config)
        return {"teacher_transitions": len(teacher_data), "random_transitions": len(random_data)}
    teacher_data = collect_transitions(config, home.path / "collect" / "teacher", "teacher")
    if len(teacher_data) < config.collect.teacher_transitions:
        raise RapidError(
            f"The budget is spent after {len(teacher_data)} of {config.collect.teacher_transitions} transitions. What "
            "was collected is kept, and the same command goes on collecting; or choose smaller sizes."
        )
    # The random driver takes seconds: dividing its work would cost more than it gains.
    alone = replace(config, collect=replace(config.collect, engine="local", workers=1, shards=1))
    random_data = collect_transitions(alone, home.path / "collect" / "random", "random")
    return {"teacher_transitions": len(teacher_data), "random_transitions": len(random_data)}


def _data_folders(config: Config, directory: Path) -> tuple[Path, Path]:
    """Where the teacher's and the random dataset of the run in `directory` are: given, shipped, or its own."""
    folder = Path(config.data) if config.data else directory / "collect"
    if config.data == SHIPPED:
        folder = Path(f"{SHIPPED}:{get_scenario(config.scenario).name}")
    return folder / "teacher", folder / "random"


def _given_data(config: Config) -> tuple[Dataset, Dataset]:
    """Load the teacher's and the random dataset that the settings name, and see that the mixture can be made of them.

    Raises:
        RapidError: none are shipped for the scenario, they are not there, damaged, of another scenario, or too small.
    """
    scenario = get_scenario(config.scenario).name
    shipped = sorted({name.partition("/")[0] for name in shipped_sets()})
    if config.data == SHIPPED and scenario not in shipped:
        raise RapidError(
            f"No data is shipped for the scenario '{scenario}'. Choose --scenario {', '.join(shipped)}, or leave "
            "--data out, to collect."
        )
    teacher, random = map(load_dataset, _data_folders(config, Path()))
    for name, dataset in (("teacher", teacher), ("random", random)):
        if dataset.scenario != scenario:
            raise RapidError(
                f"The {name} dataset in '{config.data}' is of the scenario '{dataset.scenario}', not '{scenario}'. "
                f"Choose --scenario {dataset.scenario}, or other data."
            )
    mix(teacher, random, config.mix.p, config.mix.size, config.seed, config.mix.level)
    return teacher, random


def collect_transitions(config: Config, out: Path, source: TrainPart = "teacher") -> Dataset:
    """Let the configured teacher drive, or for `source` random the uniform driver, and keep every step in `out`."""
    settings = config.teacher if source == "teacher" else TeacherConfig(backend="scripted", model="random")
    sizes = config.collect
    wanted = sizes.teacher_transitions if source == "teacher" else sizes.random_transitions
    budget = Budget(sizes.max_tokens, sizes.max_cost, sizes.max_seconds, sizes.max_decisions)
    options: dict[str, Any] = {
        "source": source,
        "budget": budget if source == "teacher" else None,
        "make_worlds": partial(make_vec, config.scenario, simulator=config.simulator, autoreset=False),
    }
    lockstep = sizes.lockstep if source == "teacher" else max(sizes.lockstep, 100)
    have = shards_of(out)
    shards = sizes.shards or have or sizes.workers
    if shards == 1 and sizes.workers > 1:
        raise RapidError(
            f"The collection in '{out}' was begun in one part, which one worker drives. Go on with --workers 1 and "
            "--engine local, or choose another directory."
        )
    if shards == 1:
        teacher = make_teacher(settings, get_scenario(config.scenario).lanes, config.seed)
        with task(f"collect, {teacher.name}", wanted, "transitions") as work:
            return collect(teacher, config.scenario, out, wanted, lockstep, shard=sizes.shard, progress=work, **options)
    # Each worker has a teacher of its own; together they ask no more than one would.
    at_once = min(sizes.workers, shards)
    settings = replace(
        settings,
        concurrency=max(1, settings.concurrency // at_once),
        requests_per_minute=settings.requests_per_minute / at_once,
    )
    title = f"collect, {settings.model}, {shards} shards"
    with task(title, wanted, "transitions") as work:
        return collect_shards(
            partial(_worker_teacher, settings, get_scenario(config.scenario).lanes, config.seed, config.threads),
            config.scenario,
            out,
            wanted,
            lockstep,
            shards=shards,
            workers=sizes.workers,
            engine=sizes.engine,
            progress=work,
            **options,
        )


def _worker_teacher(settings: TeacherConfig, lanes: int, seed: int, threads: int) -> Teacher:
    torch.set_num_threads(threads)
    return make_teacher(settings, lanes, seed)


def _mix(config: Config, home: RunDirectory) -> dict[str, Any]:
    mixed = mix_datasets(config, *_data_folders(config, home.path), home.path / "mix")
    return {"transitions": len(mixed), "teacher_share": mixed.teacher_share}


def mix_datasets(config: Config, teacher_data: Path, random_data: Path, out: Path) -> Dataset:
    """Mix two datasets at ratio p into `out`."""
    teacher, random = load_dataset(teacher_data), load_dataset(random_data)
    mixed = mix(teacher, random, config.mix.p, config.mix.size, stream_seed(config.seed, "mix"), config.mix.level)
    save_dataset(mixed, out)
    return mixed


# Phase 2


def _distill(config: Config, home: RunDirectory) -> dict[str, Any]:
    mixed = home.path / "mix"
    distill_agent(config, mixed, home.path / "distill" / "rapid", "distilled")
    # The two baselines that see the same data: what the method adds is the difference to them.
    distill_agent(baseline(config, "dqn"), mixed, home.path / "distill" / "offline-dqn", "offline DQN")
    distill_agent(baseline(config, "bc"), mixed, home.path / "distill" / "cloning", "behaviour cloning")
    return {}


def baseline(config: Config, algorithm: Literal["dqn", "ddqn", "cql", "bc"]) -> Config:
    """Return the settings of an MLP that learns offline by another algorithm: the baselines.

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


def distill_agent(config: Config, data: Path, out: Path, name: str = "distilled") -> QAgent:
    """Train a policy offline on the dataset in `data`; the agent is written to ``out/agent``."""
    dataset = load_dataset(data)
    network = _new_network(config, dataset)
    _distill_network(config, dataset, network, out, name, stream_seed(config.seed, "distill"))
    _save_distilled(config, data, dataset, network, out, name)
    return QAgent(network, name)


def distill_seeds(config: Config, data: Path, out: Path, seeds: Sequence[int], name: str = "distilled") -> list[Path]:
    """Train a policy of each seed on the dataset in `data`, and return their directories, ``out/seed-N``.

    Where the networks can be stacked (:mod:`rapid.networks.stack`) they train together, recorded in ``out/together``;
    others one after another.

    Raises:
        RapidError: a directory holds what was not trained like this, or anything that `distill` refuses.
    """
    homes = [out / f"seed-{seed}" for seed in seeds]
    own = [replace(config, seed=seed) for seed in seeds]
    together, stacked = out / "together", is_stackable(config.network, config.distill)
    for home in homes:
        alone = (home / CHECKPOINT_FILE).exists()
        if (alone and stacked) or (not alone and (home / "agent").exists() and not together.exists()):
            raise RapidError(f"'{home}' holds an agent that was trained otherwise. Choose another --out.")
    if not stacked:
        if together.exists():
            raise RapidError(f"'{together}' holds seeds that were trained together. Choose another --out.")
        for each, home in zip(own, homes, strict=True):
            distill_agent(each, data, home, name)
        return homes
    dataset = load_dataset(data)
    stack = stack_networks([_new_network(each, dataset) for each in own])
    streams = [stream_seed(seed, "distill") for seed in seeds]
    _distill_network(config, dataset, stack, together, f"{name} {len(homes)} seeds", streams)
    for each, network, home in zip(own, unstack_networks(stack), homes, strict=True):
        _save_distilled(each, data, dataset, network, home, name)
    return homes


def _new_network(config: Config, dataset: Dataset) -> QNetwork:
    lanes = get_scenario(dataset.scenario).lanes
    return build_network(config.network, lanes, stream_seed(config.seed, "network")).to(config.device)


def _distill_network(
    config: Config, dataset: Dataset, network: QNetwork, out: Path, name: str, seed: int | Sequence[int]
) -> None:
    tracker = Tracker(config.tracking, out, f"distill-{name}".replace(" ", "-"), to_dict(without_place(config)))
    with tracker, task(f"distill, {name}", config.distill.iterations, "iterations") as work:
        distill(
            _learnable(dataset),
            network,
            config.distill,
            out,
            seed=seed,
            evaluate=_curve(config, dataset.scenario, name),
            progress=work,
            teacher_share=dataset.teacher_share,
            track=tracker.log,
        )


def _save_distilled(config: Config, data: Path, dataset: Dataset, network: QNetwork, out: Path, name: str) -> None:
    metadata = {"name": name, "phase": "distill", "data": str(data), "scenario": dataset.scenario, "seed": config.seed}
    save_agent(out / "agent", network, metadata | {"config": to_dict(config)})


def _learnable(dataset: Dataset) -> Transitions:
    """Return the transitions as a trainer takes them."""
    return dataset.transitions.timed() if get_scenario(dataset.scenario).clock else dataset.transitions


def _curve(config: Config, scenario: str, name: str) -> Callable[[QNetwork, int], dict[str, float]] | None:
    """What a trainer calls to put a point on the learning curve: clean return and crash share on tuning spawns."""
    if config.evaluate.curve_spawns == 0:
        return None
    seeds = spawn_seeds("tune", config.evaluate.curve_spawns)

    def evaluate(network: QNetwork, iteration: int) -> dict[str, float]:
        episodes = run_episodes(QAgent(network, name), scenario, seeds, simulator=config.simulator)
        return {"return": float(episodes.return_E.mean()), "crash_share": float(episodes.crashed_E.mean())}

    return evaluate


# Phase 3


def _adapt(config: Config, home: RunDirectory) -> dict[str, Any]:
    adapt_agent(config, home.path / "distill" / "rapid" / "agent", home.path / "mix", home.path / "adapt" / "rapid")
    return {}


def adapt_agent(config: Config, agent: Path, data: Path | None, out: Path, name: str = "RAPID") -> QAgent:
    """Let the agent in `agent` learn online in the target scenario; it is written to ``out/agent``."""
    distilled = load_agent(agent, config.device)
    scenario = config.adapt.scenario or distilled.metadata.get("scenario", config.scenario)
    settings = config.adapt if data else replace(config.adapt, offline_share=0.0)
    network, seed = distilled.network, stream_seed(config.seed, "adapt")
    if agent.resolve() == (out / "agent").resolve():
        raise RapidError(f"Adapting '{agent}' into '{out}' would replace the agent itself. Choose another directory.")
    offline = _learnable(load_dataset(data)) if data else None
    # Of what was distilled, before it is mirrored or sees farther.
    forgetting = Forgetting(network, offline, seed)
    if settings.vehicles:
        network = widened(network, settings.vehicles)
    if settings.mirror:
        network.config = replace(network.config, mirror=True)
    check_road(QAgent(network, distilled.name), scenario)
    evaluate, seen = _curve(config, scenario, name), seeing(network.config.vehicles)
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
            )
        if settings.ppo.steps:
            timed = replace(get_scenario(scenario), clock=True)
            adapt_by_ppo(
                network,
                settings,
                scenario,
                out / PPO,
                seed=seed,
                forgetting=forgetting,
                evaluate=evaluate,
                progress=work,
                make_worlds=lambda count: make_vec(timed, count, config.simulator, config=seen),
                track=tracker.log,
            )
    metadata = {"name": name, "phase": "adapt", "from": str(agent), "scenario": scenario, "seed": config.seed}
    save_agent(out / "agent", network, metadata | {"config": to_dict(config)})
    return QAgent(network, name)


# Measuring


def _evaluate(config: Config, home: RunDirectory) -> dict[str, Any]:
    specs: list[str] = list(FLOORS)
    is_floor = config.teacher.backend == "scripted" and config.teacher.model in FLOORS
    note = ""
    if config.evaluate.teacher_spawns and not is_floor:
        note = _why_no_teacher(config)
        # The place is kept: the others' parts have the same numbers, should the teacher be there next time.
        specs.append("" if note else TEACHER)
    if config.evaluate.planner_spawns and config.simulator == "compiled":
        specs.append(PLANNER)
    specs += [str(home.path / "distill" / name / "agent") for name in ("cloning", "offline-dqn", "rapid")]
    specs.append(str(home.path / "adapt" / "rapid" / "agent"))
    rows = _measure(config, config.adapt.scenario or config.scenario, specs, home.path / "evaluate")
    return {"episodes": len(rows), **({"note": note} if note else {})}


def _why_no_teacher(config: Config) -> str:
    """Why the teacher is not measured, or nothing. A run on given data measures their driver, and fetches no model."""
    if not config.data:
        return ""
    driver, settings = _given_data(config)[0].drivers.get("teacher", {}), config.teacher
    if (driver.get("backend"), driver.get("model")) != (settings.backend, settings.model):
        return (
            f"The teacher is not measured: {driver.get('name', 'another')} drove in the data, and the settings name "
            f"{settings.backend} {settings.model}."
        )
    if settings.backend == "local" and not is_present(settings.model):
        return (
            f"The teacher is not measured: {settings.model} is not on this machine, and a run on given data fetches no "
            f"model. To have its row: rapid models pull {settings.model}, then this run with --from evaluate."
        )
    return ""


def compare(config: Config, specs: Sequence[str], out: Path) -> list[EpisodeRow]:
    """Drive the agents named and write rows, table and plot to `out`; `teacher` is the configured teacher."""
    check(config)
    names = [str(_open(config, spec, config.scenario).name) for spec in specs]
    # Two trainings of the same name would fall into one row of the table.
    labels = {spec: f"{name} ({spec})" for spec, name in zip(specs, names, strict=True) if names.count(name) > 1}
    files = [Path(spec) / "config.json" if Path(spec).is_dir() else Path(spec) for spec in specs]
    request = {
        "agents": [[spec, sha256(file) if file.is_file() else ""] for spec, file in zip(specs, files, strict=True)],
        "teacher": to_dict(config.teacher) if TEACHER in specs else None,
        "scenario": config.scenario,
        "simulator": config.simulator,
        "seed": config.seed,
        "evaluate": to_dict(config.evaluate) | {"attacks": list(config.evaluate.attacks)},
    }
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        if not (out / "request.json").exists() or read_json(out / "request.json") != request:
            raise RapidError(f"'{out}' holds something else than this comparison. Choose another --out, or empty it.")
    else:
        write_json(out / "request.json", request)
    rows = _measure(config, config.scenario, specs, out, labels)
    write_figures(ReportData(title=f"{config.scenario}", rows=rows), out)
    return rows


def _open(config: Config, spec: str, scenario: str) -> Any:
    if spec == TEACHER:
        return make_teacher(config.teacher, get_scenario(scenario).lanes, config.seed)
    agent = open_agent(spec, scenario, config.seed, config.device)
    check_road(agent, scenario)
    return agent


def _measure(
    config: Config, scenario: str, specs: Sequence[str], out: Path, labels: Mapping[str, str] | None = None
) -> list[EpisodeRow]:
    """Drive every agent over the test spawns under every attack; an agent that is done is not driven again.

    An empty name only takes a number. `labels` are names for agents whose own would not tell them apart.
    """
    rows: list[EpisodeRow] = []
    for number, spec in enumerate(specs):
        if not spec:
            continue
        part = out / "parts" / f"{number:02}.parquet"
        if not part.exists():
            agent = _open(config, spec, scenario)
            if labels and spec in labels:
                agent.name = labels[spec]
            episodes = _drive(config, scenario, spec, agent)
            if recordings := [recording for of in episodes for recording in of.recordings[:RECORDED]]:
                save_recordings(part.with_suffix(".recordings.json"), recordings)
            source = commit()
            save_rows(
                part, [row for of in episodes for row in of.rows(config.seed if of.has_network else None, source)]
            )
        rows += load_rows(part)
    save_rows(out / "episodes.parquet", rows)
    write_text(out / "summary.txt", summary_text(rows) + "\n")
    return rows


def _drive(config: Config, scenario: str, spec: str, agent: Any) -> list[Episodes]:
    spawns, attacks = config.evaluate.spawns, config.evaluate.attacks
    if spec == TEACHER:
        # A language model takes long over a decision: fewer spawns, and only as it drives undisturbed.
        spawns, attacks = config.evaluate.teacher_spawns, ("none",)
    elif spec in PLANNERS:
        spawns = config.evaluate.planner_spawns
    attacks = [name for name in attacks if is_applicable(agent, name)]
    with task(f"evaluate, {agent.name}", spawns * len(attacks), "episodes") as work:
        return [
            run_episodes(
                agent,
                scenario,
                spawn_seeds("test", spawns),
                attack,
                generator_seed=config.seed,
                record=attack == "none" and (spec == TEACHER or agent.name == "RAPID"),
                simulator=config.simulator,
                progress=work.advance,
            )
            for attack in attacks
        ]


# Showing


def _report(config: Config, home: RunDirectory) -> dict[str, Any]:
    write_run_report(config, home.path)
    return {}


def report_again(directory: Path) -> Path:
    """Write the page of a finished run again and return its path.

    Raises:
        RapidError: there is no run, or it has not been measured yet.
    """
    manifest = read_json(directory / "run.json", "run manifest")
    config = apply_overrides(preset(), manifest.get("config", {}), source=f"'{directory / 'run.json'}'")
    return write_run_report(config, directory)


def write_run_report(config: Config, directory: Path) -> Path:
    """Gather the artefacts of a run into ``report.html`` and the figures beside it."""
    manifest = read_json(directory / "run.json", "run manifest")
    steps = {step: directory / "steps" / f"{step}.json" for step in STEPS}
    recordings = [
        recording
        for path in sorted((directory / "evaluate" / "parts").glob("*.recordings.json"), reverse=True)
        for recording in load_recordings(path)
    ]
    teacher_data = load_dataset(_data_folders(config, directory)[0])
    notes = []
    if config.data:
        notes.append(f"Nothing was collected in this run; its data: {config.data}.")
    measured = read_json(steps["evaluate"]) if steps["evaluate"].exists() else {}
    if "note" in measured:
        notes.append(measured["note"])
    if config.scale in ("tiny", "quick"):
        notes.append(f"Scale {config.scale}: one training seed and few spawns. This shows that it works, not how well.")
    data = ReportData(
        title=f"RAPID on {config.adapt.scenario or config.scenario}",
        settings=to_dict(config),
        versions=manifest["versions"],
        commit=manifest["commit"],
        command=f"rapid run --config {directory / 'config.toml'} --directory {directory}",
        started=manifest["started"],
        timings={step: read_json(path)["seconds"] for step, path in steps.items() if path.exists()},
        rows=load_rows(directory / "evaluate" / "episodes.parquet"),
        main_agent="RAPID",
        distill={
            "distilled": load_metrics(directory / "distill" / "rapid"),
            "offline DQN": load_metrics(directory / "distill" / "offline-dqn"),
            "behaviour cloning": load_metrics(directory / "distill" / "cloning"),
        },
        adapt={"RAPID": [row for part in _parts(config, directory / "adapt" / "rapid") for row in load_metrics(part)]},
        routing=_routing(config, directory, recordings),
        recordings=recordings,
        dataset={"driver": teacher_data.drivers, **summary(teacher_data)},
        notes=notes,
    )
    write_figures(data, directory / "figures")
    return write_report(data, directory / "report.html")


def _parts(config: Config, directory: Path) -> list[Path]:
    """Where the records of phase 3 lie, in their order."""
    parts = {directory: config.adapt.steps, directory / PPO: config.adapt.ppo.steps}
    return [part for part, steps in parts.items() if steps]


def _routing(config: Config, directory: Path, recordings: Sequence[Recording]) -> list[RoutingSnapshot]:
    """The routing weights in one scene of RAPID's first recorded episode, before and after adaptation."""
    recording = next((recording for recording in recordings if recording.agent == "RAPID"), None)
    if recording is None or config.network.kind != "rapid":
        return []
    obs_VF = recording.obs_TVF[len(recording.action_T) // 2]
    snapshots = []
    for label, phase in (("before adaptation", "distill"), ("after adaptation", "adapt")):
        agent = load_agent(directory / phase / "rapid" / "agent")
        # What was distilled may see fewer: the nearest, which come first.
        seen_VF = obs_VF[: agent.vehicles]
        weights_BVN = agent.explain(seen_VF[None]).weights_BVN
        if weights_BVN is not None:
            snapshots.append(RoutingSnapshot(label, weights_BVN[0].numpy(), seen_VF))
    return snapshots
