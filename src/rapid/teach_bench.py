"""``rapid teach-bench``: several teachers on the same spawn seeds, what each is worth and what each costs.

What a teacher did in a scenario is kept under the hash of its settings, its prompts and its spawns, so the same command
goes on after an interruption, and a command with one more teacher drives that one only. After a change of the code that
those do not show, choose another directory; each row tells the commit that measured it.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from rapid.agents.open import open_agent
from rapid.config import Config, TeacherConfig
from rapid.config_io import apply_overrides, load_toml, to_dict, validate
from rapid.errors import DamagedError, RapidError, did_you_mean
from rapid.evaluation.teacher_summary import (
    TeacherSummary,
    summarize_teachers,
    teachers_json,
    teachers_markdown,
    teachers_text,
)
from rapid.evaluation.teachers import SCHEMA, TeacherRow, drive_teacher, load_teacher_rows, save_teacher_rows
from rapid.files import read_json, sha256, write_json, write_text
from rapid.locks import exclusive, is_empty
from rapid.presets import preset
from rapid.progress import task, warn
from rapid.report.figures import save_figure, teachers_figure
from rapid.runs import commit, versions
from rapid.scenarios import get_scenario
from rapid.simulator import make_vec
from rapid.spawns import SpawnSet, spawn_seeds
from rapid.teacher import make_teacher, models
from rapid.teacher.prompt import prompt_version
from rapid.teacher.scripted import SCRIPTED

PLANNER = "planner"
SHUFFLED = "shuffled"
STYLES = ("digest", "react")
_FORMAT = "rapid-teach-bench"


@dataclass(frozen=True)
class Entrant:
    """One teacher of a comparison."""

    spec: str
    """As it was named; its name in the tables."""
    teacher: TeacherConfig | None
    """Its settings; None is the planner, which needs none."""

    def open(self, scenario: str, seed: int) -> Any:
        """Return what drives in a scenario; a model is loaded here."""
        if self.teacher is None:
            return open_agent(PLANNER, scenario, seed)
        return make_teacher(self.teacher, get_scenario(scenario).lanes, seed, scenario)


def read_spec(spec: str) -> Entrant:
    """Return the teacher that a spec names: a scripted driver, ``MODEL[:STYLE][:shuffled]``, or a TOML settings file.

    Raises:
        RapidError: it names none of these, or one that cannot be.
    """
    if spec == PLANNER:
        return Entrant(spec, None)
    if spec in SCRIPTED:
        return Entrant(spec, TeacherConfig(backend="scripted", model=spec))
    if spec.endswith(".toml"):
        return Entrant(spec, _from_file(spec))
    model, *words = spec.split(":")
    # A path may hold colons; a registered name does not.
    while words and model not in models.registry() and words[0] not in (*STYLES, SHUFFLED):
        model += f":{words.pop(0)}"
    if not (model in models.registry() or _is_path(model)):
        known = (*SCRIPTED, PLANNER, *models.registry())
        raise RapidError(
            f"There is no teacher '{spec}'{did_you_mean(model, known)} Give a scripted driver "
            f"({', '.join((*SCRIPTED, PLANNER))}), an embedded model with a style such as "
            f"{next(iter(models.registry()))}:digest (models: {', '.join(models.registry())}; or the path of one), or "
            "a TOML file with a [teacher] section, for servers and recordings."
        )
    if not models.is_present(model) and _is_path(model):
        raise RapidError(f"There is no model at '{model}'. Check the path, or choose from: rapid models list")
    style = words.pop(0) if words and words[0] in STYLES else "digest"
    shuffled = words == [SHUFFLED]
    if words and not shuffled:
        raise RapidError(
            f"Unknown style '{':'.join(words)}' in '{spec}'{did_you_mean(words[0], (*STYLES, SHUFFLED))} Write "
            "MODEL:digest, MODEL:react or, for the control, MODEL:digest:shuffled."
        )
    if shuffled and style != "digest":
        raise RapidError(f"'{spec}' cannot be: facts are shuffled in digest style only. Write {model}:digest:shuffled.")
    return Entrant(
        spec, TeacherConfig(model=model, style="react" if style == "react" else "digest", shuffle_facts=shuffled)
    )


def _from_file(path: str) -> TeacherConfig:
    section = load_toml(path).get("teacher")
    if not isinstance(section, dict):
        raise RapidError(f"The settings file '{path}' has no [teacher] section. Add one, with backend and model.")
    teacher = apply_overrides(TeacherConfig(), section, "teacher", f"'{path}'")
    return validate(replace(preset(), teacher=teacher)).teacher


def _is_path(name: str) -> bool:
    return "/" in name or name.endswith(".gguf")


def compare_teachers(
    config: Config,
    specs: Sequence[str],
    scenarios: Sequence[str],
    out: Path,
    *,
    spawns: int,
    spawn_set: SpawnSet,
    lockstep: int,
) -> list[TeacherSummary]:
    """Drive every teacher in every scenario over the same spawns, and write what was measured to `out`.

    The files: ``episodes.parquet`` (one row an episode), ``summary.txt``, ``summary.md``, ``summary.json``,
    ``teachers.png`` and ``.svg``; ``parts/`` holds the rows of each teacher in each scenario.

    Args:
        config: gives seed, simulator and threads.
        specs: the teachers; the first is the one that the others are compared with.
        scenarios: names of scenarios.
        out: a directory of its own.
        spawns: episodes of each teacher in each scenario.
        spawn_set: the set of spawn seeds they come from.
        lockstep: episodes driven side by side, so that a model sees a batch of prompts.

    Raises:
        RapidError: anything about the input, before any work; a teacher that fails.
    """
    entrants, seeds = _check(config, specs, scenarios, spawns, spawn_set, lockstep)
    scenarios = [get_scenario(name).name for name in scenarios]
    request = {
        "format": _FORMAT,
        "teachers": {entrant.spec: to_dict(entrant.teacher) if entrant.teacher else {} for entrant in entrants},
        "scenarios": list(scenarios),
        "spawns": {"set": spawn_set, "first": seeds[0], "count": spawns},
        "seed": config.seed,
        "simulator": config.simulator,
        "versions": versions(),
        "commit": commit(),
    }
    torch.set_num_threads(config.threads)
    with exclusive(out):
        if not _is_ours(out):
            raise RapidError(f"'{out}' holds something else than a comparison of teachers. Choose another --out.")
        write_json(out / "request.json", request, sealed=True)
        rows: list[TeacherRow] = []
        identities: dict[str, Any] = {}
        cells = [(entrant, scenario) for scenario in scenarios for entrant in entrants]
        longest = [spawns * int(get_scenario(scenario).config()["duration"]) for _, scenario in cells]
        with task("teach-bench", sum(longest), "decisions") as work:
            for (entrant, scenario), decisions in zip(cells, longest, strict=True):
                part = out / "parts" / f"{_key(entrant, scenario, seeds, config)}.parquet"
                facts = part.with_suffix(".json")
                kept = _kept(part, facts)
                if kept:
                    work.skip(decisions)
                else:
                    work.note(f"{entrant.spec}, {scenario}")
                    teacher = entrant.open(scenario, config.seed)
                    found = drive_teacher(
                        teacher,
                        entrant.spec,
                        scenario,
                        seeds,
                        lockstep,
                        config.seed,
                        config.simulator,
                        commit(),
                        work.advance,
                    )
                    describe = getattr(teacher, "describe", lambda: {"backend": PLANNER})
                    write_json(facts, describe(), sealed=True)
                    save_teacher_rows(part, found)
                    # The next one may be as large: it needs the room.
                    del teacher
                    kept = load_teacher_rows(part), read_json(facts, "identity of a teacher")
                rows += kept[0]
                identities.setdefault(scenario, {})[entrant.spec] = kept[1]
        return _write(out, rows, request, identities)


def _write(out: Path, rows: list[TeacherRow], request: dict[str, Any], identities: Any) -> list[TeacherSummary]:
    summaries = summarize_teachers(rows)
    save_teacher_rows(out / "episodes.parquet", rows)
    write_text(out / "summary.txt", teachers_text(summaries) + "\n")
    write_text(out / "summary.md", teachers_markdown(summaries))
    write_json(out / "summary.json", {**request, "identities": identities, "results": teachers_json(summaries)})
    for suffix in ("png", "svg"):
        save_figure(teachers_figure(summaries), out / f"teachers.{suffix}")
    return summaries


def _check(
    config: Config, specs: Sequence[str], scenarios: Sequence[str], spawns: int, spawn_set: SpawnSet, lockstep: int
) -> tuple[list[Entrant], list[int]]:
    """Look for everything that can be seen to be wrong before any work starts."""
    if not specs:
        raise RapidError(
            "Which teachers? Name at least one, for instance: rapid teach-bench rule-forecast smollm2-135m"
        )
    if spawns < 1 or lockstep < 1:
        raise RapidError(f"--spawns is {spawns} and --lockstep {lockstep}; both must be at least 1.")
    for kind, names in (("teacher", specs), ("scenario", scenarios)):
        if twice := [name for name in names if list(names).count(name) > 1]:
            raise RapidError(f"The {kind} '{twice[0]}' is named twice. Name each once.")
    if not scenarios:
        raise RapidError("Which scenarios? Name at least one with --scenario, or leave the option out.")
    for name in scenarios:
        get_scenario(name)
    seeds = spawn_seeds(spawn_set, spawns)
    make_vec(scenarios[0], 1, simulator=config.simulator, autoreset=False).close()
    entrants = [read_spec(spec) for spec in specs]
    for entrant in entrants:
        if entrant.teacher is None and config.simulator != "compiled":
            raise RapidError("The planner searches with the compiled simulator: leave --simulator out, or the planner.")
        if entrant.teacher is not None and entrant.teacher.backend != "local":
            for name in scenarios:
                make_teacher(entrant.teacher, get_scenario(name).lanes, config.seed, name)
    for entrant in entrants:
        if entrant.teacher is not None and entrant.teacher.backend == "local":
            # Fetched, verified and unpacked, but not loaded: that would take the memory of all at once.
            models.dense_folder(entrant.teacher.model)
    return entrants, seeds


def _kept(part: Path, facts: Path) -> tuple[list[TeacherRow], Any] | None:
    """Return what an earlier call measured of a teacher, and who that was; None if it has to be driven."""
    if not (part.exists() and facts.exists()):
        return None
    try:
        return load_teacher_rows(part), read_json(facts, "identity of a teacher")
    except DamagedError as error:
        warn(f"{error} It is driven again.")
        return None


def _is_ours(out: Path) -> bool:
    path = out / "request.json"
    if not path.exists():
        return is_empty(out)
    try:
        request = read_json(path, "record of the comparison")
    except DamagedError:
        # What was measured is kept under its own hash: nothing depends on this file.
        return (out / "parts").is_dir()
    return isinstance(request, dict) and request.get("format") == _FORMAT


def _key(entrant: Entrant, scenario: str, seeds: Sequence[int], config: Config) -> str:
    """Return the name of a part: what one can read, and a hash of all that decides what is in it."""
    teacher = entrant.teacher
    read: list[Path] = []
    if teacher and teacher.backend == "replay":
        recording = Path(teacher.replay_file).expanduser()
        read.append(recording / "teacher_log.parquet" if recording.is_dir() else recording)
    if teacher and teacher.memory:
        read.append(Path(teacher.memory).expanduser())
    decides = {
        "teacher": to_dict(teacher) if teacher else PLANNER,
        "spec": entrant.spec,
        "files": [sha256(path) for path in read],
        "scenario": scenario,
        "seeds": list(seeds),
        "seed": config.seed,
        "simulator": config.simulator,
        # Thresholds of the facts, by which all are judged, and the words of the prompts.
        "prompt": prompt_version(get_scenario(scenario).lanes),
        "versions": versions()["rapid-driving"],
        "columns": SCHEMA.names,
    }
    readable = "".join(c if c.isalnum() or c in "-." else "-" for c in f"{scenario}-{Path(entrant.spec).name}")[:80]
    return f"{readable}-{hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:12]}"
