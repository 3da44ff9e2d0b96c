"""The verbs of the command line, and what those of the data's way do with their options (:mod:`rapid.options`).

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

from rapid import tools
from rapid.config import Config, without_place
from rapid.config_io import to_dict
from rapid.errors import RapidError
from rapid.locks import exclusive
from rapid.options import (
    Adapt,
    Adversary,
    Collect,
    Distill,
    Evaluate,
    Mix,
    Relabel,
    Run,
)
from rapid.outputs import DATASET, TRAINING, ClashError, claimed, clear, place_for
from rapid.parsing import parse
from rapid.presets import preset
from rapid.scenarios import get_scenario
from rapid.spawns import TrainPart
from rapid.tool_options import (
    Agents,
    Certify,
    Doctor,
    Export,
    Import,
    Models,
    Play,
    Presets,
    Pull,
    Push,
    Report,
    Reproduce,
    TeachBench,
    VerifySimulator,
)

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
    run(config, Path(options.directory or f"runs/{name}"), options.restart, force=options.force)
    return 0


def _collect(options: Collect, config: Config) -> int:
    from rapid.phases.checks import check
    from rapid.phases.data import collect_transitions, place_to_collect

    check(config)
    # The random driver's transitions are the other source of a mixture, from spawns of their own.
    uniform = (config.teacher.backend, config.teacher.model) == ("scripted", "random")
    source = cast(TrainPart, "random" if uniform else "teacher")
    out = Path(options.out) if options.out else place_to_collect(config, source)
    with exclusive(out):
        try:
            dataset = collect_transitions(config, out, source)
        except ClashError:
            if not options.force:
                raise
            clear(out, DATASET)
            dataset = collect_transitions(config, out, source)
    print(f"{len(dataset)} transitions in {out}")
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
    from rapid.agents.specs import digest
    from rapid.data.shipped import dataset_folder
    from rapid.files import sha256

    if name == "agent":
        if found := digest(path):
            return found
        raise RapidError(f"There is no saved agent at '{path}'. Check the path, or make it first.")
    folder = dataset_folder(path)
    for record in (folder / "dataset.json", folder):
        if record.is_file():
            return sha256(record)
    raise RapidError(f"There is no dataset at '{path}'. Check the path, or make it first.")


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
        before, after = train(options.agent, config.scenario, options.attack, options.steps, out, options.seed)
        print(f"The adversary is in {out}; in training the agent's return went from {before:.2f} to {after:.2f}")
    return 0


VERBS: dict[str, tuple[type[Any], Callable[[Any, Config], int], str]] = {
    "run": (Run, _run, "rapid.run"),
    "collect": (Collect, _collect, "rapid.phases.data"),
    "relabel": (Relabel, _relabel, "rapid.data.relabel"),
    "mix": (Mix, _mix, "rapid.phases.data"),
    "distill": (Distill, _distill, "rapid.phases.distill"),
    "adapt": (Adapt, _adapt, "rapid.phases.adapt"),
    "evaluate": (Evaluate, _evaluate, "rapid.phases.measure"),
    "adversary": (Adversary, _adversary, "rapid.phases.adversary"),
    "teach-bench": (TeachBench, tools.teach_bench, "rapid.teach_bench"),
    "certify": (Certify, tools.certify, "rapid.certify.table"),
    "export": (Export, tools.export, "rapid.agents.onnx"),
    "import": (Import, tools.import_agent, "rapid.agents.sb3"),
    "report": (Report, tools.report, "rapid.phases.page"),
    "reproduce": (Reproduce, tools.reproduce, "rapid.experiments.reproduce"),
    "play": (Play, tools.play, "rapid.play"),
    "presets": (Presets, tools.presets, "rapid.presets"),
    "agents": (Agents, tools.agents, "rapid.agents.shipped"),
    "push": (Push, tools.push, "rapid.hub"),
    "pull": (Pull, tools.pull, "rapid.hub"),
    "models": (Models, tools.models, "rapid.teacher.models"),
    "verify-simulator": (VerifySimulator, tools.verify_simulator, "rapid.simulator.verify"),
    "doctor": (Doctor, tools.doctor, "rapid.doctor"),
}
"""For each verb its options, its action, and the module whose import takes the time before its first word."""
