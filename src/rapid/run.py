"""The steps of ``rapid run``, each reading the artefacts of the one before: the whole job on one page."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rapid.agents.open import open_agent
from rapid.baselines import offline_baseline, online_baseline
from rapid.config import Config
from rapid.data.dataset import Dataset
from rapid.data.fallbacks import fallback_notice
from rapid.data.shipped import SHIPPED
from rapid.errors import RapidError, did_you_mean
from rapid.locks import exclusive
from rapid.networks.conversions import check_widening
from rapid.outputs import RUN, clear
from rapid.phases.adapt import ONLINE, adapt_agent, learn_online
from rapid.phases.checks import check
from rapid.phases.data import collect_transitions, data_folders, given_data, mix_datasets
from rapid.phases.distill import distill_agent
from rapid.phases.measure import FLOORS, PLANNER, TEACHER, floors_under_attack, measure, why_no_teacher
from rapid.phases.page import write_run_report
from rapid.progress import format_seconds
from rapid.runs import MANIFEST, STEPS, RunDirectory, commit
from rapid.scenarios import get_scenario
from rapid.simulator import make_vec


def run(
    config: Config, directory: Path, restart: str = "", say: Callable[[str], None] = print, *, force: bool = False
) -> Path:
    """Do every step that is not done yet and return the path of the report.

    Args:
        config: the settings.
        directory: where the run lives; made, or gone on with.
        restart: a step to redo, with all later ones; empty to redo none.
        say: receives a line at a time.
        force: remove what a run with other settings made in the directory, and nothing else.

    Raises:
        RapidError: anything about the input or the surroundings that keeps the run from its end.
    """
    check(config)
    if config.data not in ("", SHIPPED):
        config = replace(config, data=str(Path(config.data).resolve()))
    _check_whole(config)
    if restart and restart not in STEPS:
        raise RapidError(f"Unknown step '{restart}'{did_you_mean(restart, STEPS)} Steps: {', '.join(STEPS)}.")
    # Before the first look at it: of two runs with other settings the second must see what the first is.
    with exclusive(directory):
        try:
            home = RunDirectory(directory, config, STEPS)
        except RapidError:
            if not (force and (directory / MANIFEST).exists()):
                raise
            read = (config.data, config.teacher.memory, config.teacher.replay_file)
            clear(directory, RUN, [Path(path) for path in read if path not in ("", SHIPPED)])
            home = RunDirectory(directory, config, STEPS)
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


def _check_whole(config: Config) -> None:
    """Look for steps of one run that cannot follow each other."""
    network, collected, mixture = config.network, config.collect, config.mix
    if collected.shard != "1/1":
        raise RapidError(
            f"collect.shard is '{collected.shard}', but a run needs the whole collection. Divide it with "
            "collect.workers."
        )
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
        given_data(config)
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


def _collect(config: Config, home: RunDirectory) -> dict[str, Any]:
    if config.data:
        teacher_data, random_data = given_data(config)
        return _collected(teacher_data, random_data)
    teacher_data = collect_transitions(config, home.path / "collect" / "teacher", "teacher")
    if len(teacher_data) < config.collect.teacher_transitions:
        raise RapidError(
            f"The budget is spent after {len(teacher_data)} of {config.collect.teacher_transitions} transitions. What "
            "was collected is kept, and the same command goes on collecting; or choose smaller sizes."
        )
    # The random driver takes seconds: dividing its work would cost more than it gains.
    alone = replace(config, collect=replace(config.collect, engine="local", workers=1, shards=1))
    random_data = collect_transitions(alone, home.path / "collect" / "random", "random")
    return _collected(teacher_data, random_data)


def _collected(teacher: Dataset, random: Dataset) -> dict[str, Any]:
    notice = fallback_notice(teacher)
    sizes = {"teacher_transitions": len(teacher), "random_transitions": len(random)}
    return {**sizes, **({"note": notice} if notice else {})}


def _mix(config: Config, home: RunDirectory) -> dict[str, Any]:
    mixed = mix_datasets(config, *data_folders(config, home.path), home.path / "mix")
    return {"transitions": len(mixed), "teacher_share": mixed.teacher_share}


def _distill(config: Config, home: RunDirectory) -> dict[str, Any]:
    mixed = home.path / "mix"
    distill_agent(config, mixed, home.path / "distill" / "rapid", "distilled")
    # The two baselines that see the same data: what the method adds is the difference to them.
    distill_agent(offline_baseline(config, "dqn"), mixed, home.path / "distill" / "offline-dqn", "offline DQN")
    distill_agent(offline_baseline(config, "bc"), mixed, home.path / "distill" / "cloning", "behaviour cloning")
    return {}


def _adapt(config: Config, home: RunDirectory) -> dict[str, Any]:
    adapt_agent(config, home.path / "distill" / "rapid" / "agent", home.path / "mix", home.path / "adapt" / "rapid")
    # The two baselines that drive as much but know nothing at first: what distilling adds is the difference to them.
    for folder, (algorithm, name) in ONLINE.items():
        learn_online(online_baseline(config, algorithm), home.path / "adapt" / folder, name)
    return {}


def _evaluate(config: Config, home: RunDirectory) -> dict[str, Any]:
    specs: list[str] = list(FLOORS)
    is_floor = config.teacher.backend == "scripted" and config.teacher.model in FLOORS
    note = ""
    if config.evaluate.teacher_spawns and not is_floor:
        note = why_no_teacher(config)
        # The place is kept: the others' parts have the same numbers, should the teacher be there next time.
        specs.append("" if note else TEACHER)
    if config.evaluate.planner_spawns and config.simulator == "compiled":
        specs.append(PLANNER)
    specs += [str(home.path / "distill" / name / "agent") for name in ("cloning", "offline-dqn", "rapid")]
    specs.append(str(home.path / "adapt" / "rapid" / "agent"))
    specs += [spec for spec in floors_under_attack(config.adapt.scenario or config.scenario) if spec not in FLOORS]
    specs += [str(home.path / "adapt" / folder / "agent") for folder in ONLINE]
    rows = measure(config, config.adapt.scenario or config.scenario, specs, home.path / "evaluate")
    return {"episodes": len(rows), **({"note": note} if note else {})}


def _report(config: Config, home: RunDirectory) -> dict[str, Any]:
    write_run_report(config, home.path)
    return {}
