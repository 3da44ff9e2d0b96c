"""What each verb of the command line does. Options are fields of the settings tree (:mod:`rapid.config`)."""

import dataclasses
import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

import tyro
from tyro.conf import Positional, arg

from rapid.bounds import Count, Positive, Seed, check_bounds
from rapid.config import (
    PLANS,
    RECIPES,
    SCALES,
    AdaptConfig,
    CollectConfig,
    Config,
    DistillConfig,
    EvaluateConfig,
    MixConfig,
    NetworkConfig,
    Plan,
    Recipe,
    Scale,
    TeacherConfig,
    without_place,
)
from rapid.config_io import apply_overrides, load_toml, to_dict, to_toml, validate
from rapid.errors import RapidError
from rapid.presets import DEFAULT_PLAN, OF_RECIPE, differences, of_file, preset, without_presets
from rapid.scenarios import PAPER_SCENARIOS, Reward, get_scenario
from rapid.tracking import Tracking

if TYPE_CHECKING:
    from rapid.data.dataset import Dataset

T = TypeVar("T")

# A section of the tree whose options stand at the top level: `--p`, not `--mix.p`.
Flat = Annotated[T, arg(name="")]
SettingsFile = Annotated[str, arg(name="config", metavar="FILE.toml")]


@dataclass(frozen=True)
class Source:
    """Where the defaults of a verb's settings come from."""

    recipe: Recipe = Config.recipe
    """Defaults of the settings."""
    scale: Scale = Config.scale
    """Defaults of the sizes."""
    plan: Plan = Config.plan
    """Defaults of phase 3."""
    file: SettingsFile = ""
    """Settings in a TOML file; options override it, it overrides recipe and scale."""


@dataclass(frozen=True)
class Run:
    """Do everything, in one directory: collect, mix, distill, adapt, evaluate, report.

    The same command goes on after an interruption.
    """

    settings: Flat[Config] = field(default_factory=Config)
    file: SettingsFile = ""
    """Settings in a TOML file; options override it, it overrides recipe and scale."""
    directory: str = ""
    """Where the run lives; by default runs/SCENARIO-RECIPE-SCALE-seedN, with a hash of other settings behind it."""
    restart: Annotated[str, arg(name="from", metavar="STEP")] = ""
    """Redo this step and all later ones: collect, mix, distill, adapt, evaluate or report."""


@dataclass(frozen=True)
class Collect:
    """Let a teacher drive and keep every step as an offline dataset.

    The same command goes on after an interruption, and with a larger budget or more transitions. --workers n divides
    the work among n processes, or with --engine ray among the machines of a Ray cluster. With --teacher.backend
    scripted --teacher.model random it makes the random data of a mixture, of --random-transitions transitions.
    """

    collect: Flat[CollectConfig] = field(default_factory=CollectConfig)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    out: str = "data/teacher"
    """Directory of the dataset."""
    scenario: str = Config.scenario
    """Where the teacher drives."""
    seed: Seed = Config.seed
    """Decides the random driver's actions; the traffic is fixed by the spawn seeds."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Relabel:
    """Give a collected dataset the scenario's other reward: its episodes are driven again, action by action."""

    dataset: Annotated[Positional[str], arg(metavar="DATASET")]
    """Directory of the dataset as it was collected, or a shipped set such as shipped:lane-3-density-2/teacher."""
    reward: Reward = "progress"
    """The reward that is wanted; `progress` counts distance and not crashing alone."""
    out: str = "data/relabelled"
    """Directory of the dataset with these rewards."""


@dataclass(frozen=True)
class Mix:
    """Mix a teacher's and a random dataset into one, transition by transition."""

    teacher_data: Annotated[Positional[str], arg(metavar="TEACHER_DATA")]
    """Directory of the teacher's dataset."""
    random_data: Annotated[Positional[str], arg(metavar="RANDOM_DATA")]
    """Directory of the random dataset."""
    mix: Flat[MixConfig] = field(default_factory=MixConfig)
    out: str = "data/mixed"
    """Directory of the mixture."""
    seed: Seed = Config.seed
    """Decides which transitions are drawn."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Distill:
    """Phase 2: train a policy offline on a dataset, with the robust term."""

    dataset: Annotated[Positional[str], arg(metavar="DATASET")]
    """Directory of the dataset."""
    distill: Flat[DistillConfig] = field(default_factory=DistillConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    out: str = "distilled"
    """Directory of the agent and its training record."""
    curve_spawns: Count = EvaluateConfig.curve_spawns
    """Episodes of each point of the learning curve."""
    tracking: Tracking = Config.tracking
    """Where the metrics are copied to; offline unless WANDB_MODE says otherwise."""
    seed: Seed = Config.seed
    """Decides the weights, the batches and the inner attack."""
    seeds: Positive = 1
    """Train this many agents, of the seeds from --seed on, into OUT/seed-N. Baselines (kind mlp, neither robust nor
    Munchausen term) train together as one stack in less than half the time, with one record for all in OUT/together;
    others one after another, where a process for each seed is faster."""
    device: str = Config.device
    """Torch device; on a CUDA device a gradient step is recorded once and replayed."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Adapt:
    """Phase 3: let an agent learn online in the target scenario, its distilled policy frozen."""

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent."""
    adapt: Flat[AdaptConfig] = field(default_factory=AdaptConfig)
    dataset: str = ""
    """Offline dataset: for --offline-share, which is 0 without it, and to measure what is forgotten."""
    out: str = "adapted"
    """Directory of the adapted agent and its training record."""
    curve_spawns: Count = EvaluateConfig.curve_spawns
    """Episodes of each point of the learning curve."""
    tracking: Tracking = Config.tracking
    """Where the metrics are copied to; offline unless WANDB_MODE says otherwise."""
    seed: Seed = Config.seed
    """Decides the traffic, the exploration and the batches."""
    device: str = Config.device
    """Torch device; on a CUDA device a gradient step of Q-learning is recorded once and replayed."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Evaluate:
    """Compare agents over the same fixed spawns, clean and under attacks, in one table and one plot."""

    agents: Annotated[Positional[tuple[str, ...]], arg(metavar="AGENT ...")]
    """Directories of agents, ONNX files, and drivers by name: slower, idle, faster, random, rule, rule-forecast,
    rule-foresight, uniform-safe, planner, planner-cars, planner-observation, teacher (the one of --config)."""
    evaluate: Flat[EvaluateConfig] = field(default_factory=EvaluateConfig)
    scenario: str = ""
    """Where they drive; by default where the saved agents were trained, else in lane-3-density-2."""
    simulator: Annotated[str, arg(metavar="{compiled,highway-env}")] = Config.simulator
    """The compiled twin, or highway-env itself."""
    out: str = "evaluation"
    """Directory of the episodes, the table and the plot."""
    seed: Seed = Config.seed
    """Decides the noise of attacks and the random driver; the traffic is fixed by the spawn seeds."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class TeachBench:
    """Compare teachers, models and prompt styles on the same spawns: what each is worth, what each costs.

    The same command goes on after an interruption; with one more teacher it drives that one only.
    """

    teachers: Annotated[Positional[tuple[str, ...]], arg(metavar="TEACHER ...")]
    """Scripted drivers (rule, rule-forecast, slower, random, ..., planner), embedded models with a style
    (smollm2-135m:digest, smollm2-135m:react, and as a control smollm2-135m:digest:shuffled), or TOML files with a
    [teacher] section, for servers and recordings. The others are compared with the first."""
    scenarios: Annotated[tuple[str, ...], arg(name="scenario")] = PAPER_SCENARIOS
    """Where they drive; by default the paper's three."""
    spawns: Positive = 32
    """Episodes of each teacher in each scenario."""
    spawn_set: Literal["tune", "test"] = "tune"
    """Where the spawn seeds come from: `tune` to choose a teacher, `test` to report one that was chosen elsewhere."""
    lockstep: Positive = 64
    """Episodes driven side by side: a `local` model answers all of them together."""
    out: str = "teach-bench"
    """Directory of the rows, the table and the plot."""
    simulator: Annotated[str, arg(metavar="{compiled,highway-env}")] = Config.simulator
    """The compiled twin, or highway-env itself."""
    seed: Seed = Config.seed
    """Decides the random drivers and the shuffled facts; the traffic is fixed by the spawn seeds."""


@dataclass(frozen=True)
class Export:
    """Write an agent as ONNX, compare the two on real observations, and time a decision."""

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent."""
    out: str = ""
    """The file; by default AGENT.onnx, beside the agent's directory."""
    dataset: str = ""
    """Dataset whose observations are compared; without it, those that the agent meets on 32 test spawns."""


@dataclass(frozen=True)
class Report:
    """Write the page of a run again."""

    directory: Annotated[Positional[str], arg(metavar="DIRECTORY")]
    """Directory of the run."""


@dataclass(frozen=True)
class Reproduce:
    """Compute tables and figures of the paper and ours, beside what the paper prints; without an id list them.

    The same command goes on after an interruption; what is done is never computed again.
    """

    ids: Annotated[Positional[tuple[str, ...]], arg(metavar="ID ...")] = ()
    """Such as attack, offline or ratio; `all` is every one."""
    recipe: Recipe = "paper"
    """How things are trained."""
    scale: Scale = Config.scale
    """How much is run: tiny (minutes), quick, full (five trainings, 200 spawns)."""
    engine: Annotated[str, arg(metavar="{local,ray}")] = CollectConfig.engine
    """Where parts are computed."""
    workers: Positive = 1
    """Parts under way at once."""
    store: str = "runs/store"
    """Directory of finished parts."""
    layers: tuple[str, ...] = ()
    """Directories of small results that are only read; results/cells is one wherever it is there."""
    out: str = ""
    """Directory of the page; by default runs/reproduce/RECIPE-SCALE."""
    export: str = ""
    """Also write the small results to this directory, as a layer for other checkouts."""
    dry_run: bool = False
    """Only say what is done and what is to do."""
    page_only: bool = False
    """Compute nothing: write the page of what is there."""


@dataclass(frozen=True)
class Presets:
    """Print what a recipe, a scale and a plan set; with a second one, only where the two differ."""

    first: Annotated[Positional[str], arg(metavar="RECIPE[/SCALE[/PLAN]]")] = ""
    """Such as strong, strong/full or strong/full/ppo; nothing lists what there is."""
    second: Annotated[Positional[str], arg(metavar="RECIPE[/SCALE[/PLAN]]")] = ""
    """What the first is compared with."""


@dataclass(frozen=True)
class Agents:
    """List the trained agents that come with the package, or show the card of one."""

    action: Annotated[Positional[str], arg(metavar="ACTION")] = "list"
    """list, or show."""
    name: Annotated[Positional[str], arg(metavar="NAME")] = ""
    """Such as lane-3-density-2/rapid; not needed to list."""


@dataclass(frozen=True)
class Models:
    """List the embedded language models, fetch one, verify it, or remove it."""

    action: Annotated[Positional[str], arg(metavar="ACTION")] = "list"
    """list, pull, verify or remove."""
    name: Annotated[Positional[str], arg(metavar="NAME")] = ""
    """The model; not needed to list."""


@dataclass(frozen=True)
class VerifySimulator:
    """Hold the compiled simulator against the installed highway-env, step by step, and give a verdict."""

    episodes: Positive = 12
    """Episodes in all, shared among the scenarios."""
    scenarios: Annotated[tuple[str, ...], arg(name="scenario")] = ()
    """Scenarios or HighwayEnv's ids; by default the paper's with both dynamics, HighwayEnv's own, and others that reach
    the rest of the configuration; then the time limits at many frequencies are compared too."""
    processes: Positive = 1
    """Processes that drive highway-env, which takes nearly all of the time."""
    plain_math: bool = True
    """Let NumPy use the C library's functions under highway-env, so that states can be compared to the last bit.
    Without it, on a processor with AVX-512, highway-env differs from itself elsewhere, visibly so after crashes."""
    out: str = ""
    """Also write the verdict to this file."""


@dataclass(frozen=True)
class Doctor:
    """Check Python, torch, the simulator's speed, the cache, the model and the endpoint."""

    teacher: TeacherConfig = field(default_factory=TeacherConfig)


def call(verb: str, words: Sequence[str]) -> int:
    """Parse the options of `verb` and do it.

    Returns:
        The exit code.

    Raises:
        RapidError: any input that cannot be used.
        SystemExit: after printing the help, or tyro's own explanation of a wrong option (2).
    """
    kind, action = _VERBS[verb]
    base = _base_settings(words)
    options = tyro.cli(
        kind,
        args=list(words),
        prog=f"rapid {verb}",
        default=_defaults(kind, base),
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )
    check_bounds(options)
    return action(options, _with_options(base, options))


def _base_settings(words: Sequence[str]) -> Config:
    """The settings that recipe, scale, plan and a settings file give, before the options.

    Raises:
        RapidError: an option names another recipe, scale or plan than the file, whose settings would contradict it.
    """
    file = _option(words, "config")
    overrides = load_toml(file) if file else {}
    choices = {"recipe": RECIPES, "scale": SCALES, "plan": PLANS}
    asked = {name: value for name in choices if (value := _option(words, name))}
    if words and ("-h" in words or "--help" in words):
        asked = {name: value for name, value in asked.items() if value in choices[name]}
    for name, value in asked.items():
        if name in overrides and overrides[name] != value:
            raise RapidError(
                f"The settings file '{file}' is of the {name} '{overrides[name]}', and --{name} says '{value}'. Its "
                f"other settings would stay, so what ran would be neither. Leave --{name} out, or the file."
            )
    named = any(name in overrides for name in choices)
    base = of_file(overrides) if named else preset(**asked)
    return apply_overrides(base, without_presets(overrides), source=f"'{file}'")


def _option(words: Sequence[str], name: str) -> str:
    """The value of ``--name value`` or ``--name=value`` among `words`, or an empty string."""
    for i, word in enumerate(words):
        if word == f"--{name}":
            return words[i + 1] if i + 1 < len(words) else ""
        if word.startswith(f"--{name}="):
            return word.partition("=")[2]
    return ""


def _defaults(kind: type[T], base: Config) -> T:
    """An instance of a verb's options with the values of `base`; positional fields stay required."""
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        if item.name == "settings":
            values[item.name] = base
        elif item.name == "source":
            values[item.name] = Source(base.recipe, base.scale, base.plan)
        elif hasattr(base, item.name) and item.default in (dataclasses.MISSING, getattr(Config, item.name, None)):
            values[item.name] = getattr(base, item.name)
        elif item.name == "curve_spawns":
            values[item.name] = base.evaluate.curve_spawns
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            values[item.name] = tyro.MISSING
    return kind(**values)


def _with_options(base: Config, options: Any) -> Config:
    """`base` with the sections and values that a verb's options carry."""
    if isinstance(options, Run):
        return validate(options.settings)
    if isinstance(options, Evaluate) and not options.scenario:
        from rapid.agents.open import own_scenario

        options = dataclasses.replace(options, scenario=own_scenario(options.agents) or base.scenario)
    names = {item.name for item in dataclasses.fields(options)} & {item.name for item in dataclasses.fields(Config)}
    config = dataclasses.replace(base, **{name: getattr(options, name) for name in names})
    curve_spawns = getattr(options, "curve_spawns", None)
    if curve_spawns is not None:
        config = dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, curve_spawns=curve_spawns))
    return validate(config)


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
    dataset = collect_transitions(config, Path(options.out), "random" if uniform else "teacher")
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

    out = _new_folder(options.out)
    dataset = load_dataset(options.dataset)
    if get_scenario(dataset.scenario).reward == options.reward:
        raise RapidError(
            f"'{options.dataset}' has the reward '{options.reward}' already. Name the other with --reward."
        )
    with task("relabel", len(dataset), "transitions") as progress:
        save_dataset(relabel(dataset, options.reward, progress), out)
    print(f"{len(dataset)} transitions in {options.out}")
    return 0


def _mix(options: Mix, config: Config) -> int:
    from rapid.phases.data import mix_datasets

    out = _new_folder(options.out)
    mixed = mix_datasets(config, Path(options.teacher_data), Path(options.random_data), out)
    print(f"{len(mixed)} transitions in {options.out}")
    _tell_fallbacks(mixed)
    return 0


def _new_folder(path: str) -> Path:
    """Return the path if nothing is there yet.

    Raises:
        RapidError: there is something.
    """
    out = Path(path)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RapidError(
            f"'{out}' exists and is not an empty directory. Choose another --out, so that nothing is overwritten."
        )
    return out


def _distill(options: Distill, config: Config) -> int:
    from rapid.phases.checks import check
    from rapid.phases.distill import distill_agent, distill_seeds

    check(config)
    if options.seeds == 1:
        distill_agent(config, Path(options.dataset), Path(options.out), tell=_tell_fallbacks)
        print(f"The agent is in {options.out}/agent")
        return 0
    seeds = range(config.seed, config.seed + options.seeds)
    for home in distill_seeds(config, Path(options.dataset), Path(options.out), seeds, tell=_tell_fallbacks):
        print(f"An agent is in {home}/agent")
    return 0


def _adapt(options: Adapt, config: Config) -> int:
    from rapid.phases.adapt import adapt_agent
    from rapid.phases.checks import check

    check(config)
    dataset = Path(options.dataset) if options.dataset else None
    adapt_agent(config, Path(options.agent), dataset, Path(options.out))
    print(f"The agent is in {options.out}/agent")
    return 0


def _evaluate(options: Evaluate, config: Config) -> int:
    from rapid.phases.measure import compare

    compare(config, options.agents, Path(options.out))
    print((Path(options.out) / "summary.txt").read_text(encoding="utf-8"))
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


def _export(options: Export, config: Config) -> int:
    import torch

    from rapid.agents.onnx import driven_observations, export_onnx, latency
    from rapid.agents.saved import load_agent
    from rapid.data.batch import with_rows
    from rapid.data.dataset import load_dataset
    from rapid.spawns import spawn_seeds

    agent, folder = load_agent(options.agent), Path(options.agent)
    out = options.out or f"{folder.resolve()}.onnx"
    if options.dataset:
        obs_NVF = load_dataset(options.dataset).transitions.obs_NVF
        obs_BVF = with_rows(torch.from_numpy(obs_NVF), agent.vehicles).numpy()
    else:
        scenario = str(agent.metadata.get("scenario") or config.scenario)
        obs_BVF = driven_observations(agent, scenario, spawn_seeds("test", 32))
    parity = export_onnx(agent, out, obs_BVF)
    print(
        f"{out}\n{parity.observations} observations: largest difference of Q-values {parity.difference:.2g}, "
        f"the same action on {parity.agreement:.2%}\n"
        f"one decision on one thread: {latency(out, obs_BVF[0]) * 1e6:.0f} microseconds (median)"
    )
    return 0


def _report(options: Report, config: Config) -> int:
    from rapid.phases.page import report_again

    print(report_again(Path(options.directory)))
    return 0


def _reproduce(options: Reproduce, config: Config) -> int:
    from rapid.experiments.exhibits import ALL, cells_of
    from rapid.experiments.reproduce import listing, open_reproduction, reproduce, text_of, write_page

    ids = () if options.ids == ("all",) else options.ids
    layers = [Path(layer) for layer in options.layers]
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


_VERBS: dict[str, tuple[type[Any], Callable[[Any, Config], int]]] = {
    "run": (Run, _run),
    "collect": (Collect, _collect),
    "relabel": (Relabel, _relabel),
    "mix": (Mix, _mix),
    "distill": (Distill, _distill),
    "adapt": (Adapt, _adapt),
    "evaluate": (Evaluate, _evaluate),
    "teach-bench": (TeachBench, _teach_bench),
    "export": (Export, _export),
    "report": (Report, _report),
    "reproduce": (Reproduce, _reproduce),
    "presets": (Presets, _presets),
    "agents": (Agents, _agents),
    "models": (Models, _models),
    "verify-simulator": (VerifySimulator, _verify),
    "doctor": (Doctor, _doctor),
}
