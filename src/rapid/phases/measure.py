"""Measuring on disk: agents over the test spawns, each driven once, with table and plot."""

import hashlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rapid.agents.open import PLANNERS, check_road, open_agent
from rapid.agents.origin import origin_of
from rapid.agents.q_agent import QAgent
from rapid.agents.specs import digest
from rapid.attacks import get_attack
from rapid.attacks.adversary import fingerprint, save_adversary, train_adversary
from rapid.attacks.attack import offers
from rapid.attacks.spec import AttackSpec
from rapid.attacks.suite import PRESETS, expand
from rapid.config import Config, without_place
from rapid.config_io import to_dict
from rapid.engines import run_jobs
from rapid.errors import DamagedError, RapidError
from rapid.evaluation.metrics import EpisodeRow, load_rows, save_rows
from rapid.evaluation.recording import Recording, explained_by, load_recordings, save_recordings
from rapid.evaluation.rollouts import Episodes, is_applicable, run_episodes
from rapid.evaluation.summary import label_of, summary_text
from rapid.evaluation.worst import worst_text
from rapid.files import write_text
from rapid.networks.q_network import QNetwork
from rapid.outputs import EVALUATION, claimed
from rapid.phases.checks import check
from rapid.phases.data import given_data
from rapid.progress import task, warn
from rapid.report import ReportData, write_figures, write_report
from rapid.report.figures import save_figure
from rapid.report.sweep import sweep_figure, sweep_text
from rapid.runs import commit, versions
from rapid.scenarios import get_scenario
from rapid.spawns import spawn_seeds
from rapid.teacher import make_teacher
from rapid.teacher.models import is_present
from rapid.teacher.scripted import has_plan

FLOORS = ("slower", "idle", "random", "rule")
"""Scripted drivers that stand under every score."""
TEACHER = "teacher"
"""The configured teacher, as an agent to be measured."""
PLANNER = "planner"
"""Search with the simulator itself as its model: a reference, no bound."""
RECORDED = 4
"""Episodes of the adapted agent, and of the teacher, that the report can play."""
CRASHES = 2
"""Crashes of an adapted agent under each attack that the report can play; of other learned agents and of scripted
drivers, one."""


def compare(
    config: Config,
    specs: Sequence[str],
    out: str | Path = "",
    force: bool = False,
    say: Callable[[str], None] | None = None,
) -> list[EpisodeRow]:
    """Drive the agents named and write rows, table, plot and page; `teacher` is the configured teacher.

    Args:
        config: where and how they drive.
        specs: the agents.
        out: the directory; empty is none: the table is said and nothing is kept.
        force: replace another comparison there.
        say: is given the table, and where all of it is.
    """
    if not specs:
        raise RapidError(f"Which agents? Name their directories, ONNX files or drivers, such as {', '.join(FLOORS)}.")
    check(config)
    specs = list(dict.fromkeys(specs))
    # Opened once: a language model takes long to load, and as much memory again.
    opened = {spec: _open(config, spec, config.scenario) for spec in specs}
    names = [_checked_name(config, spec, opened[spec]) for spec in specs]
    # Two trainings of the same name would fall into one row of the table.
    # And what is only called as one of the drivers would be shown as that driver.
    labels = {
        spec: f"{name} ({spec})"
        for spec, name in zip(specs, names, strict=True)
        if names.count(name) > 1 or (label_of(name) != name and origin_of(opened[spec]) != name)
    }
    settings = to_dict(without_place(config).evaluate)
    request = {
        "threads": config.threads,
        "agents": [[spec, digest(spec)] for spec in specs],
        "teacher": to_dict(config.teacher) if TEACHER in specs else None,
        "scenario": config.scenario,
        "simulator": config.simulator,
        "seed": config.seed,
        "evaluate": {key: list(value) if isinstance(value, tuple) else value for key, value in settings.items()},
    }
    if sources := {each.source: digest(each.source) for each in expand(config.evaluate.attacks) if each.source}:
        request["attackers"] = sources
    with ExitStack() as held:
        place = Path(out or held.enter_context(tempfile.TemporaryDirectory(prefix="rapid-")))
        held.enter_context(claimed(place, request, EVALUATION, force=force, keep=map(Path, specs)))
        if any(text.partition(":")[0] in PRESETS for text in config.evaluate.attacks):
            floors = [floor for floor in floors_under_attack(config.scenario) if floor not in specs]
            opened |= {spec: _open(config, spec, config.scenario) for spec in floors}
            specs = [*specs, *floors]
        rows = measure(config, config.scenario, specs, place, labels, opened)
        if out:
            report = ReportData(
                title=f"{len(specs)} drivers on {config.scenario}",
                settings=to_dict(config),
                versions=versions(),
                commit=commit(),
                rows=rows,
                recordings=recorded(place),
                trained=False,
            )
            write_figures(report, place)
            write_report(report, place / "report.html")
        if say:
            say((place / "summary.txt").read_text(encoding="utf-8"))
            say(
                f"Rows, table and plot: {place}\nThe page: {place / 'report.html'}"
                if out
                else "Nothing was kept; --out DIRECTORY keeps rows, plot and page."
            )
    return rows


def _checked_name(config: Config, spec: str, agent: Any) -> str:
    """Return the name of an agent on which all attacks can be made that need what it has; say which cannot be made.

    Raises:
        RapidError: an attack was made for another agent, or none of them can be made.
    """
    attacks = expand(config.evaluate.attacks if spec != TEACHER else config.evaluate.teacher_attacks)
    for each in attacks:
        if each.source and (attack := get_attack(each, get_scenario(config.scenario).lanes)).needs in offers(agent):
            attack.check(agent)
    lacking = [each.shown for each in attacks if not is_applicable(agent, each)]
    said = (
        f"On '{agent.name}' these attacks cannot be made: {', '.join(lacking)}. They need a network, Q-values, or one "
        "who sees observations (docs/attacks.md)."
    )
    if lacking and len(lacking) == len(attacks):
        raise RapidError(f"{said} Give others, such as uniform, gaussian or lie.")
    if lacking:
        warn(said)
    return str(agent.name)


def floors_under_attack(scenario: str) -> list[str]:
    """Return the drivers that no lie about other cars can mislead, as far as there is a plan for this scenario."""
    return ["slower", "immune", *(["blind"] if has_plan(scenario) else [])]


def why_no_teacher(config: Config) -> str:
    """Why the teacher is not measured, or nothing. A run on given data measures their driver, and fetches no model."""
    if not config.data:
        return ""
    driver, settings = given_data(config)[0].drivers.get("teacher", {}), config.teacher
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


def _open(config: Config, spec: str, scenario: str) -> Any:
    if spec == TEACHER:
        return make_teacher(config.teacher, get_scenario(scenario).lanes, config.seed, scenario)
    agent = open_agent(spec, scenario, config.seed, config.device)
    check_road(agent, scenario)
    return agent


def measure(
    config: Config,
    scenario: str,
    specs: Sequence[str],
    out: Path,
    labels: Mapping[str, str] | None = None,
    opened: Mapping[str, Any] | None = None,
) -> list[EpisodeRow]:
    """Drive every agent over the test spawns under every attack; an agent that is done is not driven again.

    An empty name only takes a number. `labels` are names for agents whose own would not tell them apart; `opened` are
    agents that are open already.
    """
    rows: list[EpisodeRow] = []
    for number, spec in enumerate(specs):
        if not spec:
            continue
        part = out / "parts" / f"{number:02}.parquet"
        kept = _kept(part)
        if kept is None:
            agent = opened[spec] if opened else _open(config, spec, scenario)
            if labels and spec in labels:
                agent.name = labels[spec]
            driven = _drive(config, scenario, spec, agent, out)
            episodes = [of for _, of in driven]
            recordings = [recording for of in episodes for recording in of.recordings[:RECORDED]]
            recordings += crashes_of(config, agent, driven)
            if recordings:
                save_recordings(
                    part.with_suffix(".recordings.json"), [explained_by(agent, each) for each in recordings]
                )
            source = commit()
            save_rows(
                part, [row for of in episodes for row in of.rows(config.seed if of.has_network else None, source)]
            )
            kept = load_rows(part)
        rows += kept
    save_rows(out / "episodes.parquet", rows)
    texts = (summary_text(rows), worst_text(rows), sweep_text(rows))
    write_text(out / "summary.txt", "\n\n".join(text for text in texts if text) + "\n")
    if (figure := sweep_figure(rows)) is not None:
        save_figure(figure, out / "sweep.png")
    return rows


def recorded(place: Path) -> list[Recording]:
    """Return the episodes that were kept while measuring there, those of the last agent first."""
    files = sorted((place / "parts").glob("*.recordings.json"), reverse=True)
    return [recording for path in files for recording in load_recordings(path)]


def _kept(part: Path) -> list[EpisodeRow] | None:
    """Return what was measured of an agent before; None if it has to be driven."""
    if not part.exists():
        return None
    try:
        return load_rows(part)
    except DamagedError as error:
        warn(f"{error} The agent is driven again.")
        return None


def _with_adversary(config: Config, scenario: str, agent: Any, attack: AttackSpec, out: Path) -> AttackSpec:
    """Return the attack; where an adversary is to be trained, with the one that is kept in `out`."""
    if attack.kind != "adversary" or attack.source:
        return attack
    steps = config.evaluate.adversary_steps
    of = f"{fingerprint(agent.network)} {scenario} {attack.name} {steps} {config.seed}"
    home = out / "adversaries" / hashlib.sha256(of.encode()).hexdigest()[:12]
    if not (home / "config.json").exists():
        with task(f"adversary, {agent.name}", steps, "steps") as work:
            director = train_adversary(agent, scenario, attack, steps, config.seed, lambda done, _: work.advance(done))
        save_adversary(home, director, agent, scenario, attack, steps)
    return replace(attack, source=str(home), label=attack.name)


def _drive(config: Config, scenario: str, spec: str, agent: Any, out: Path) -> list[tuple[AttackSpec, Episodes]]:
    spawns, attacks = config.evaluate.spawns, expand(config.evaluate.attacks)
    if spec == TEACHER:
        # A language model takes long over a decision: fewer spawns, and fewer attacks.
        spawns, attacks = config.evaluate.teacher_spawns, expand(config.evaluate.teacher_attacks)
    elif spec in PLANNERS:
        spawns = config.evaluate.planner_spawns
    attacks = [attack for attack in attacks if is_applicable(agent, attack)]
    attacks = [_with_adversary(config, scenario, agent, attack, out) for attack in attacks]
    workers = min(config.evaluate.workers, len(attacks))
    jobs = [(config, scenario, spec, agent if workers == 1 else agent.name, attack, spawns) for attack in attacks]
    found: dict[int, Episodes] = {}
    with task(f"evaluate, {agent.name}", spawns * len(attacks), "episodes") as work:
        for place, episodes in run_jobs(
            _drive_under, jobs, workers=workers, receive=lambda _, ended: work.advance(ended)
        ):
            found[place] = episodes
    return [(attack, found[place]) for place, attack in enumerate(attacks)]


def _drive_under(job: tuple[Config, str, str, Any, AttackSpec, int], report: Callable[[Any], None]) -> Episodes:
    """Drive an agent, or in a process of its own the one that `spec` names, under one attack."""
    config, scenario, spec, agent, attack, spawns = job
    if isinstance(agent, str):
        torch.set_num_threads(config.threads)
        name, agent = agent, _open(config, spec, scenario)
        agent.name = name
    return run_episodes(
        agent,
        scenario,
        spawn_seeds("test", spawns),
        attack,
        generator_seed=config.seed,
        record=attack == AttackSpec() and (spec == TEACHER or _is_adapted(agent)),
        simulator=config.simulator,
        progress=report,
    )


def _is_adapted(agent: Any) -> bool:
    """Whether an agent is RAPID after phase 3, whatever it is called."""
    config = getattr(getattr(agent, "network", None), "config", None)
    return getattr(config, "kind", "") == "rapid" and getattr(agent, "metadata", {}).get("phase") == "adapt"


def crashes_of(config: Config, agent: Any, driven: Sequence[tuple[AttackSpec, Episodes]]) -> list[Recording]:
    """Drive the first crashes of an agent again, under each attack, to keep what happened step by step.

    Of learned agents and of scripted drivers, that is. A scripted driver that drove alike under another attack, because
    it does not see what was done, is kept once.
    """
    found: list[Recording] = []
    alike: set[tuple[int, int, float]] = set()
    for attack, of in driven:
        known = {recording.seed for recording in of.recordings[:RECORDED]}
        if of.kind not in ("learned", "floor"):
            continue
        crashed = [
            (int(of.seed_E[i]), int(of.length_E[i]), float(of.return_E[i]))
            for i in np.flatnonzero(of.crashed_E)
            if int(of.seed_E[i]) not in known
        ][: CRASHES if _is_adapted(agent) else 1]
        seeds = [episode[0] for episode in crashed if of.kind == "learned" or episode not in alike]
        alike |= set(crashed)
        if seeds:
            again = run_episodes(
                agent,
                of.scenario,
                seeds,
                attack,
                generator_seed=config.seed,
                record=True,
                simulator=config.simulator,
            )
            # Among fewer worlds the network's sums round otherwise, so another action may win by a hair.
            found += [recording for recording in again.recordings if recording.crashed]
    return found


def learning_curve(config: Config, scenario: str, name: str) -> Callable[[QNetwork, int], dict[str, float]] | None:
    """What a trainer calls to put a point on the learning curve: clean return and crash share on tuning spawns."""
    if config.evaluate.curve_spawns == 0:
        return None
    seeds = spawn_seeds("tune", config.evaluate.curve_spawns)

    def evaluate(network: QNetwork, iteration: int) -> dict[str, float]:
        episodes = run_episodes(QAgent(network, name), scenario, seeds, simulator=config.simulator)
        return {"return": float(episodes.return_E.mean()), "crash_share": float(episodes.crashed_E.mean())}

    return evaluate
