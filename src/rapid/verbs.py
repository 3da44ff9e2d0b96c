"""What each verb of the command line does with its options (:mod:`rapid.options`).

An action gets the verb's options and the settings that they give, and returns the exit code.
"""

import dataclasses
import hashlib
import importlib
import json
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rapid.config import SCALES, Config, without_place
from rapid.config_io import to_dict, to_toml
from rapid.errors import RapidError
from rapid.locks import exclusive, exclusive_file
from rapid.options import (
    Adapt,
    Adversary,
    Agents,
    Certify,
    Collect,
    Distill,
    Doctor,
    Evaluate,
    Export,
    Import,
    Mix,
    Models,
    Play,
    Presets,
    Relabel,
    Report,
    Reproduce,
    Run,
    TeachBench,
    VerifySimulator,
)
from rapid.outputs import DATASET, TRAINING, ClashError, check_new_file, claimed, clear, place_for
from rapid.parsing import parse
from rapid.presets import DEFAULT_PLAN, OF_RECIPE, differences, preset
from rapid.scenarios import get_scenario
from rapid.spawns import TrainPart

if TYPE_CHECKING:
    from rapid.data.dataset import Dataset


def prepare(verb: str, words: Sequence[str]) -> Callable[[], int]:
    """Parse the options of `verb` and import what it needs.

    Returns:
        What does it, and returns the exit code.

    Raises:
        RapidError: any input that cannot be used.
        SystemExit: after printing the help, or tyro's own explanation of a wrong value (2).
    """
    options, config = parse(verb, {name: kind for name, (kind, _, _) in VERBS.items()}, words)
    _, action, module = VERBS[verb]
    importlib.import_module(module)
    return partial(action, options, config)


def _run(options: Run, config: Config) -> int:
    from rapid.run import run

    name = f"{config.scenario}-{config.recipe}-{config.scale}-{config.plan}-seed{config.seed}".replace(":", "-")
    plain = dataclasses.replace(
        preset(config.recipe, config.scale, config.plan), scenario=config.scenario, seed=config.seed
    )
    if without_place(config) != without_place(plain):
        # Any other setting gets a directory of its own, so that it does not meet the run without it.
        differing = json.dumps(to_dict(without_place(config)), sort_keys=True)
        name += f"-{hashlib.sha256(differing.encode()).hexdigest()[:8]}"
    run(config, Path(options.directory or f"runs/{name}"), options.restart)
    return 0


def _collect(options: Collect, config: Config) -> int:
    from rapid.phases.checks import check
    from rapid.phases.data import collect_transitions

    check(config)
    # The random driver's transitions are the other source of a mixture, from spawns of their own.
    uniform = (config.teacher.backend, config.teacher.model) == ("scripted", "random")
    out, source = Path(options.out), cast(TrainPart, "random" if uniform else "teacher")
    with exclusive(out):
        try:
            dataset = collect_transitions(config, out, source)
        except ClashError:
            if not options.force:
                raise
            clear(out, DATASET)
            dataset = collect_transitions(config, out, source)
    print(f"{len(dataset)} transitions in {options.out}")
    if not (dataset.collection or {}).get("complete", True):
        print("The budget is spent; the same command with a larger one goes on.", file=sys.stderr)
    _tell_fallbacks(dataset)
    return 0


def _tell_fallbacks(dataset: "Dataset") -> None:
    """Say how many decisions are not the model's, if there are any."""
    from rapid.data.fallbacks import fallback_notice

    if notice := fallback_notice(dataset):
        print(notice, file=sys.stderr)


def _relabel(options: Relabel, config: Config) -> int:
    from rapid.data.dataset import load_dataset, save_dataset
    from rapid.data.relabel import relabel
    from rapid.progress import task

    dataset = load_dataset(options.dataset)
    if get_scenario(dataset.scenario).reward == options.reward:
        raise RapidError(
            f"'{options.dataset}' has the reward '{options.reward}' already. Name the other with --reward."
        )
    with _claim(options, config, "data/relabelled", DATASET) as out:
        with task("relabel", len(dataset), "transitions") as progress:
            save_dataset(relabel(dataset, options.reward, progress), out)
        print(f"{len(dataset)} transitions in {out}")
    return 0


def _mix(options: Mix, config: Config) -> int:
    from rapid.phases.data import mix_datasets

    with _claim(options, config, "data/mixed", DATASET) as out:
        mixed = mix_datasets(config, Path(options.teacher_data), Path(options.random_data), out)
        print(f"{len(mixed)} transitions in {out}")
    _tell_fallbacks(mixed)
    return 0


_READ = ("dataset", "teacher_data", "random_data", "agent")
"""Options that name what a verb reads: a dataset's or an agent's directory."""


@contextmanager
def _claim(options: Any, config: Config, usual: str, makes: Sequence[str]) -> Generator[Path, None, None]:
    """Hold the directory of a verb's output; what it reads is told by its content, whatever it is called."""
    own = {item.name: getattr(options, item.name) for item in dataclasses.fields(options)}
    read = {name: own.pop(name) for name in _READ if own.get(name)}
    settings = to_dict(without_place(config))
    request = {
        "verb": type(options).__name__.lower(),
        "reads": {name: _content(name, path) for name, path in read.items()},
        "threads": config.threads,
        **{name: settings.get(name, value) for name, value in own.items() if name not in ("out", "force", "source")},
    }
    place = Path(options.out) if options.out else place_for(usual, request)
    with claimed(place, request, makes, force=options.force, keep=map(Path, read.values())) as out:
        yield out


def _content(name: str, path: str) -> str:
    """Return the hash of a dataset or an agent, whose records name those of their files."""
    from rapid.agents.shipped import agent_folder
    from rapid.data.shipped import dataset_folder
    from rapid.files import sha256

    folder = agent_folder(path) if name == "agent" else dataset_folder(path)
    for record in (folder / "dataset.json", folder / "config.json", folder):
        if record.is_file():
            return sha256(record)
    raise RapidError(f"There is neither a dataset nor an agent at '{path}'. Check the path, or make it first.")


def _distill(options: Distill, config: Config) -> int:
    from rapid.phases.checks import check
    from rapid.phases.distill import distill_agent, distill_seeds

    check(config)
    with _claim(options, config, "distilled", TRAINING) as out:
        if options.seeds == 1:
            distill_agent(config, Path(options.dataset), out, tell=_tell_fallbacks)
            print(f"The agent is in {out}/agent")
            return 0
        seeds = range(config.seed, config.seed + options.seeds)
        for home in distill_seeds(config, Path(options.dataset), out, seeds, tell=_tell_fallbacks):
            print(f"An agent is in {home}/agent")
    return 0


def _adapt(options: Adapt, config: Config) -> int:
    from rapid.phases.adapt import adapt_agent
    from rapid.phases.checks import check

    check(config)
    dataset = Path(options.dataset) if options.dataset else None
    with _claim(options, config, "adapted", TRAINING) as out:
        adapt_agent(config, Path(options.agent), dataset, out)
        print(f"The agent is in {out}/agent")
    return 0


def _evaluate(options: Evaluate, config: Config) -> int:
    from rapid.phases.measure import compare

    compare(config, options.agents, options.out, options.force, say=print)
    return 0


def _adversary(options: Adversary, config: Config) -> int:
    from rapid.phases.adversary import train

    with _claim(options, config, "adversary", ("*",)) as out:
        before, after = train(options.agent, options.scenario, options.attack, options.steps, out, options.seed)
        print(f"The adversary is in {out}; in training the agent's return went from {before:.2f} to {after:.2f}")
    return 0


def _teach_bench(options: TeachBench, config: Config) -> int:
    from rapid.teach_bench import compare_teachers

    compare_teachers(
        config,
        options.teachers,
        options.scenarios,
        Path(options.out),
        spawns=options.spawns,
        spawn_set=options.spawn_set,
        lockstep=options.lockstep,
    )
    print((Path(options.out) / "summary.txt").read_text(encoding="utf-8"))
    return 0


def _certify(options: Certify, config: Config) -> int:
    from rapid.agents.open import check_road, network_agent
    from rapid.certify.table import certify

    agent = network_agent(options.agent)
    check_road(agent, config.scenario)
    out = Path(options.out)
    counts = options.decisions, options.spawns, options.returns
    print(certify(agent, config.scenario, options.radii, *counts, out), end="")
    return 0


def _export(options: Export, config: Config) -> int:
    import torch

    from rapid.agents.onnx import driven_observations, export_onnx, latency
    from rapid.agents.open import network_agent
    from rapid.data.batch import with_rows
    from rapid.data.dataset import load_dataset
    from rapid.spawns import spawn_seeds

    agent = network_agent(options.agent)
    out = options.out or f"{Path(options.agent.rpartition(':')[2]).resolve()}.onnx"
    if options.dataset:
        obs_NVF = load_dataset(options.dataset).transitions.obs_NVF
        obs_BVF, state_BS = with_rows(torch.from_numpy(obs_NVF), agent.vehicles).numpy(), None
    else:
        scenario = str(agent.metadata.get("scenario") or config.scenario)
        obs_BVF, state_BS = driven_observations(agent, scenario, spawn_seeds("test", 32))
    with exclusive_file(out):
        check_new_file(Path(out), options.force)
        parity = export_onnx(agent, out, obs_BVF, state_BS)
    print(
        f"{out}\n{parity.observations} observations: largest difference of Q-values {parity.difference:.2g}, "
        f"the same action on {parity.agreement:.2%}\n"
        f"one decision on one thread: {latency(out, obs_BVF[0]) * 1e6:.0f} microseconds (median)"
    )
    return 0


def _import(options: Import, config: Config) -> int:
    from rapid.agents.sb3 import import_sb3

    out = options.out or str(Path(options.model).with_suffix(".onnx"))
    parity = import_sb3(options.model, out, options.trained_on)
    print(
        f"{out}\n{parity.observations} observations of {options.trained_on}: largest difference of values "
        f"{parity.difference:.2g}, the same action on {parity.agreement:.2%}\n"
        f"Next: rapid evaluate {out}"
    )
    return 0


def _report(options: Report, config: Config) -> int:
    from rapid.phases.page import report_again

    directory = Path(options.directory)
    if not (directory / "run.json").exists():
        raise RapidError(f"There is no run at '{directory}'. Check the path, or make it first: rapid run")
    with exclusive(directory):
        print(report_again(directory))
    return 0


def _fill_blocks(store: Path, check: bool) -> int:
    from rapid.experiments.readme import update
    from rapid.experiments.reproduce import open_reproduction

    stale = update(Path(), open_reproduction((), Config.recipe, "full", store).store, check)
    told = ", ".join(map(str, stale))
    if check and stale:
        print(f"Not what the rows say: {told}. Mend with: rapid reproduce --readme", file=sys.stderr)
    else:
        print(f"Filled: {told}." if stale else "Every block is what the rows say.")
    return int(check and bool(stale))


def _reproduce(options: Reproduce, config: Config) -> int:
    from rapid.experiments.exhibits import ALL, cells_of
    from rapid.experiments.reproduce import listing, open_reproduction, reproduce, text_of, write_page

    ids = () if options.ids == ("all",) else options.ids
    layers = [Path(layer) for layer in options.layers]
    if options.readme or options.check:
        return _fill_blocks(Path(options.store), options.check)
    of = open_reproduction(ids, options.recipe, options.scale, Path(options.store), layers)
    if not options.ids or options.dry_run:
        print(listing(of))
        return 0
    out = Path(options.out or f"runs/reproduce/{options.recipe}-{options.scale}")
    failed: dict[str, str] = {}
    if options.page_only:
        page = write_page(of, out)
    else:
        outcome, page = reproduce(of, out, cast(Any, options.engine), options.workers)
        failed = outcome.failed
    if options.export:
        for exhibit in of.exhibits:
            name = f"{exhibit.id}-{of.request(exhibit).recipe}-{options.scale}"
            of.store.export(
                cells_of(ALL[exhibit.id], of.request(exhibit).recipe, options.scale), Path(options.export), name
            )
    if ids:
        print(text_of(of))
    print(f"page: {page}")
    if failed:
        print(f"{len(failed)} parts failed; the same command tries them again.", file=sys.stderr)
    return int(bool(failed))


def _play(options: Play, config: Config) -> int:
    from rapid.play import Roster, first_moment, serve

    scenario = get_scenario(options.scenario).name if options.scenario else ""
    roster = Roster(options.agents, Path("runs"), config.teacher, config.seed)
    start = first_moment(roster, options.agents, scenario, options.spawn, options.moment)
    serve(roster, start, options.port, config.seed, options.browser)
    return 0


def _presets(options: Presets, config: Config) -> int:
    if not options.first:
        for recipe, plans in OF_RECIPE.items():
            print(f"{recipe}: scales {', '.join(SCALES)}; plans {', '.join(plans)} (usual: {DEFAULT_PLAN[recipe]})")
        return 0
    first = preset(*options.first.split("/", 2))
    if not options.second:
        print(to_toml(to_dict(first)), end="")
        return 0
    rows = differences(first, preset(*options.second.split("/", 2)))
    width = max(map(len, rows), default=0)
    for name, (here, there) in rows.items():
        print(f"{name:<{width}}  {here!r} -> {there!r}")
    if not rows:
        print("They set the same.")
    return 0


def _agents(options: Agents, config: Config) -> int:
    from rapid.agents.shipped import card, listing

    if options.action == "list":
        print(listing())
        return 0
    if options.action != "show":
        raise RapidError(f"'{options.action}' is nothing to do with agents. Say list, or show NAME.")
    print(json.dumps(card(options.name.removeprefix("shipped:")), indent=2))
    return 0


def _models(options: Models, config: Config) -> int:
    from rapid.teacher import models

    return models.command(options.action, options.name)


def _verify(options: VerifySimulator, config: Config) -> int:
    from rapid.files import write_text
    from rapid.progress import task
    from rapid.simulator.verify import verify

    if options.out:
        check_new_file(Path(options.out), options.force)
    with task("verify", options.episodes, "episodes") as work:
        findings = verify(
            options.scenarios or None,
            options.episodes,
            processes=options.processes,
            plain_math=options.plain_math,
            time_limits=not options.scenarios,
            progress=lambda done, total, findings: work.advance(),
        )
    print(findings.verdict())
    if options.out:
        write_text(options.out, findings.verdict() + "\n")
    return 0 if findings.equal else 1


def _doctor(options: Doctor, config: Config) -> int:
    from rapid.doctor import examine

    mark = {"ok": "ok     ", "warning": "warning", "failed": "FAILED "}
    failed = False
    for finding in examine(options.teacher):
        print(f"{mark[finding.verdict]}  {finding.name:<16} {finding.fact}", flush=True)
        if finding.fix:
            print(f"{'':26}{finding.fix}")
        failed |= finding.verdict == "failed"
    print("Something needs mending, see above." if failed else "Everything that a run needs is there.", file=sys.stderr)
    return int(failed)


VERBS: dict[str, tuple[type[Any], Callable[[Any, Config], int], str]] = {
    "run": (Run, _run, "rapid.run"),
    "collect": (Collect, _collect, "rapid.phases.data"),
    "relabel": (Relabel, _relabel, "rapid.data.relabel"),
    "mix": (Mix, _mix, "rapid.phases.data"),
    "distill": (Distill, _distill, "rapid.phases.distill"),
    "adapt": (Adapt, _adapt, "rapid.phases.adapt"),
    "evaluate": (Evaluate, _evaluate, "rapid.phases.measure"),
    "adversary": (Adversary, _adversary, "rapid.phases.adversary"),
    "teach-bench": (TeachBench, _teach_bench, "rapid.teach_bench"),
    "certify": (Certify, _certify, "rapid.certify.table"),
    "export": (Export, _export, "rapid.agents.onnx"),
    "import": (Import, _import, "rapid.agents.sb3"),
    "report": (Report, _report, "rapid.phases.page"),
    "reproduce": (Reproduce, _reproduce, "rapid.experiments.reproduce"),
    "play": (Play, _play, "rapid.play"),
    "presets": (Presets, _presets, "rapid.presets"),
    "agents": (Agents, _agents, "rapid.agents.shipped"),
    "models": (Models, _models, "rapid.teacher.models"),
    "verify-simulator": (VerifySimulator, _verify, "rapid.simulator.verify"),
    "doctor": (Doctor, _doctor, "rapid.doctor"),
}
"""For each verb its options, its action, and the module whose import takes the time before its first word."""
