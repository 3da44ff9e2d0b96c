"""The scores: RAPID and its baselines over several training seeds, from the shipped data, beside floors and ceiling.

For every scenario and seed: phase 2 on the mixture of the scenario's own data (RAPID; MLPs by DQN, double DQN, CQL;
behaviour cloning), then phase 3 there for each number of steps (RAPID's adapter; a double-DQN MLP from scratch that
explores as RAPID does and, from 50,000 steps on, one with RAPID's loss as well; in the recipe `paper` also a DQN as
printed), then all of them over the test spawns, clean and attacked. With `--data SCENARIO` all are trained offline on
the data of that one scenario, and adapt to the others. Everything finished is kept under `--work`: an interrupted call
goes on where it was, and calls for other seeds can run beside it. `--table` writes what is there: `scores.parquet` (raw
rows) and `scores.md`; `scores-paper` for the recipe `paper`, with the paper's numbers beside ours, `scores-progress`
for the reward `progress`, `scores-2000` over so many spawns. Of the floors and the planners it shows the rows in
`floors.parquet`, where they drove the same spawns; over others `--floors` drives them. With `--vehicles N` RAPID is
also trained to read N vehicles from phase 3 on, with `--ppo STEPS` every agent trained online goes on by PPO, as
another agent, and with `--mirror` it is also driven as the mean of itself and its mirror image. With `--more-data` the
default teacher, which needs its model, collects four times what is shipped, and RAPID and CQL learn from that for four
times as long.

    python benchmarks/scores.py --seeds 0 1 2 3 4        # or one process for each seed
    python benchmarks/scores.py --table
"""

import argparse
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from rapid.agents.open import open_agent
from rapid.agents.saved import load_agent
from rapid.config import AdaptConfig, Config, PpoConfig, TeacherConfig
from rapid.config_io import apply_overrides, to_dict
from rapid.data.dataset import load_dataset, save_dataset
from rapid.data.relabel import relabel
from rapid.data.shipped import dataset_folder, shipped_sets
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, column, load_rows, save_rows
from rapid.evaluation.rollouts import evaluate_agent
from rapid.evaluation.statistics import Estimate, paired_difference
from rapid.evaluation.summary import summary_text
from rapid.files import write_text
from rapid.networks.q_network import check_widening
from rapid.phases.adapt import adapt_agent
from rapid.phases.checks import check
from rapid.phases.data import collect_transitions, mix_datasets
from rapid.phases.distill import baseline, distill_agent
from rapid.phases.measure import TEACHER
from rapid.presets import preset
from rapid.progress import task
from rapid.report.data import paper_return
from rapid.runs import commit
from rapid.scenarios import PAPER_SCENARIOS, get_scenario
from rapid.spawns import TrainPart, spawn_seeds
from rapid.teacher import make_teacher

ATTACKS = ("none", "uniform", "gaussian", "fgsm", "pgd")
FLOORS = ("slower", "rule", "planner-observation", "planner-cars", "planner")
SETTINGS_FROM = {0: "full", 50_000: "quick", 200_000: "long"}
"""From so many online steps on phase 3 has the settings of this scale, but for the steps."""
MLP_DISCOUNT = 0.93
"""Longest discount of the MLPs from scratch: chosen of 0.9, 0.93 and 0.95 by one training each (docs/log.md)."""
PROGRESS_CRASH_PENALTY = 5.0
"""What a crash costs more in PPO under `progress`: where all speed is paid, the usual 2 leave more crashes than
always-slower has (docs/log.md)."""
WHOLE = ", fine-tuned whole"
"""What is put after an agent's name where no part of it was frozen."""
MIRRORED = ", mirrored"
"""What is put after an agent's name where its Q-values are averaged with those of the mirrored road."""
RULE_DATA = "distilled, rule data"
"""RAPID distilled from the data of a rule in place of the teacher's, where such data is shipped."""
MORE_DATA = 60_000
"""Transitions of the teacher, and as many random ones, that `--more-data` collects: four times the shipped ones."""
MORE_ITERATIONS = 16_000
"""Gradient steps on them."""
USUAL_SPAWNS = 200
"""Spawns of the tables that are named without their number."""
Source = Literal["teacher", "rule", "collected"]
"""Whose data is mixed with a random driver's: the shipped sets of the teacher or the rule, or more of the teacher."""
WAY = {3: 0.75, 4: 0.70, 5: 0.50}
"""The share of the way from always-slower to the planner that is aimed at, by lanes; on either reward."""


class Distillation(NamedTuple):
    """How an agent is trained offline."""

    settings: Config
    source: Source = "teacher"


def offline_recipes(config: Config) -> dict[str, Distillation]:
    """Return how every agent is trained offline, by name."""
    return {
        "distilled": Distillation(config),
        "offline DQN": Distillation(baseline(config, "dqn")),
        "offline DDQN": Distillation(baseline(config, "ddqn")),
        "CQL": Distillation(baseline(config, "cql")),
        "behaviour cloning": Distillation(baseline(config, "bc")),
    }


def offline_ablations(config: Config, data: str) -> dict[str, Distillation]:
    """Return how RAPID is distilled without one of its parts, by name."""
    found = {
        "distilled, no J_robust": Distillation(without(config, robust_weight=0.0)),
        "distilled, no CQL": Distillation(without(config, conservative_weight=0.0)),
        "distilled, plain DQN": Distillation(without(config, robust_weight=0.0, conservative_weight=0.0)),
    }
    if f"{get_scenario(data).name}/rule" in shipped_sets():
        found[RULE_DATA] = Distillation(config, "rule")
    return found


def offline_with_more_data(config: Config) -> dict[str, Distillation]:
    """Return how agents are trained offline on the data that is collected, by name."""
    sizes = {"teacher_transitions": MORE_DATA, "random_transitions": MORE_DATA}
    share = max(config.mix.p, 1 - config.mix.p)
    more = replace(
        config,
        collect=replace(config.collect, **sizes),
        mix=replace(config.mix, size=int(MORE_DATA / share)),
        distill=replace(config.distill, iterations=MORE_ITERATIONS),
    )
    of = short(MORE_DATA)
    return {
        f"distilled, {of}": Distillation(more, "collected"),
        more_distilled(): Distillation(without(more, robust_weight=0.0), "collected"),
        f"CQL, {of}": Distillation(baseline(more, "cql"), "collected"),
    }


def more_distilled() -> str:
    """Return the name of what is distilled best from the data that is collected."""
    return f"distilled, {short(MORE_DATA)}, no J_robust"


def without(config: Config, **terms: float) -> Config:
    """Return the settings with other weights of the terms of the offline loss."""
    return replace(config, distill=replace(config.distill, loss=replace(config.distill.loss, **terms)))


class Adaptation(NamedTuple):
    """How an agent is trained online."""

    settings: AdaptConfig
    origin: str
    """The agent that it starts from or, from scratch, whose network it has."""
    source: Source | None = None
    """Whose data goes into the online batches, if any."""


def online_recipes(
    config: Config, scenario: str, steps: int, ablations: bool = False, more_data: bool = False
) -> dict[str, Adaptation]:
    """Return how every agent is trained in a scenario for a number of online steps, by name."""
    adapt = replace(adaptation(config.recipe, steps), scenario=scenario)
    discount = adapt.loss.discount if config.recipe == "paper" else min(adapt.loss.discount, MLP_DISCOUNT)
    from_scratch = replace(
        adapt,
        train="scratch",
        exploration_start=1.0,
        exploration_end=0.05,
        offline_share=0.0,
        loss=replace(adapt.loss, conservative_weight=0.0, double=True, munchausen_weight=0.0, discount=discount),
        optimizer=replace(adapt.optimizer, learning_rate=5e-4),
    )
    found = {
        f"RAPID, {short(steps)}": Adaptation(adapt, "distilled", "teacher"),
        f"online DDQN, {short(steps)}": Adaptation(from_scratch, "offline DDQN"),
    }
    if adapt.loss.munchausen_weight:
        # The same as RAPID but for the network, where it starts, and that nothing of it is frozen.
        same = replace(from_scratch, loss=replace(adapt.loss, discount=discount))
        found[f"online Munchausen DQN, {short(steps)}"] = Adaptation(same, "offline DDQN")
    if config.recipe == "paper":
        rate = baseline(config, "dqn").distill.optimizer.learning_rate
        plain = replace(from_scratch.loss, double=False)
        dqn = replace(from_scratch, loss=plain, optimizer=replace(from_scratch.optimizer, learning_rate=rate))
        found[f"online DQN, {short(steps)}"] = Adaptation(dqn, "offline DQN")
    if ablations:
        for what, weights in ((WHOLE, "all"), (", from scratch", "scratch")):
            other = replace(adapt, train=weights)
            found[f"RAPID, {short(steps)}{what}"] = Adaptation(other, "distilled", "teacher")
    if more_data:
        # Who begins higher explores no more than the shortest budget does, whatever the steps: else it forgets.
        careful = replace(adaptation(config.recipe, 0), scenario=scenario, steps=steps)
        found[f"RAPID, {short(steps)}, from {short(MORE_DATA)}"] = Adaptation(careful, more_distilled(), "collected")
    return found


def ppo_settings(adapt: AdaptConfig, scenario: str, steps: int) -> PpoConfig:
    """Return how PPO goes on in a scenario for so many steps."""
    ppo = replace(adapt.ppo, steps=steps)
    progress = get_scenario(scenario).reward == "progress"
    return replace(ppo, crash_penalty=PROGRESS_CRASH_PENALTY) if progress else ppo


def with_vehicles(found: dict[str, Adaptation], vehicles: int) -> dict[str, Adaptation]:
    """Return how RAPID is trained to read so many vehicles online, by name."""
    return {
        f"{name}, {vehicles} seen": way._replace(settings=replace(way.settings, vehicles=vehicles))
        for name, way in found.items()
        if name.startswith("RAPID")
    }


def seen_as_usual(name: str) -> str:
    """Return an agent's name without how many vehicles it reads."""
    return re.sub(r", \d+ seen", "", name)


def with_ppo(found: dict[str, Adaptation], scenario: str, steps: int, ablations: bool = False) -> dict[str, Adaptation]:
    """Return how each of these agents goes on by PPO for so many steps, by name; `ablations` freeze nothing."""
    further: dict[str, Adaptation] = {}
    for name, (settings, _, source) in found.items():
        ppo = ppo_settings(settings, scenario, steps)
        # Nothing begins anew here, whatever it once began from.
        train = "all" if settings.train == "scratch" else settings.train
        on = Adaptation(replace(settings, steps=0, ppo=ppo, train=train), name, source)
        further[f"{name} + {short(steps)} PPO"] = on
        if ablations and train == "adapter":
            further[f"{name} + {short(steps)} PPO{WHOLE}"] = on._replace(settings=replace(on.settings, train="all"))
    return further


def with_mirror(found: dict[str, Adaptation]) -> dict[str, Adaptation]:
    """Return these agents with their Q-values averaged with those of the mirrored road, untrained further, by name."""
    alike: dict[str, Adaptation] = {}
    for name, (settings, _, _) in found.items():
        untrained = replace(settings, steps=0, ppo=replace(settings.ppo, steps=0), mirror=True)
        alike[f"{name}{MIRRORED}"] = Adaptation(untrained, name)
    return alike


def train(
    config: Config,
    data: str,
    work: Path,
    scenario: str,
    budgets: Iterable[int],
    ablations: bool = False,
    only: Sequence[str] = (),
    more_data: bool = False,
    ppo: int = 0,
    mirror: bool = False,
    vehicles: int = 0,
) -> list[tuple[str, Path]]:
    """Train what is missing and return the agents to be measured in a scenario, as (name, directory).

    Args:
        config: the settings.
        data: the scenario whose shipped data is learned from.
        work: where what is trained on this data with this seed is kept.
        scenario: where the agents adapt and are measured.
        budgets: online steps; each gives agents of its own.
        ablations: whether RAPID is trained without each of its parts as well.
        only: names of the agents wanted; none are all of them.
        more_data: whether agents are trained on data that is collected first as well.
        ppo: for how many steps every agent trained online goes on by PPO; 0 for none.
        mirror: whether every agent trained online is made alike to left and right as well.
        vehicles: how many RAPID also learns to read online; 0 for no more than what was distilled.

    Raises:
        RapidError: an agent of `only` does not exist, or one was trained with other settings.
    """
    offline = offline_recipes(config)
    if ablations:
        offline |= offline_ablations(config, data)
    if more_data:
        offline |= offline_with_more_data(config)
    online: dict[str, Adaptation] = {}
    for steps in budgets:
        online |= online_recipes(config, scenario, steps, ablations, more_data)
    if vehicles:
        online |= with_vehicles(online, vehicles)
    if ppo:
        online |= with_ppo(online, scenario, ppo, ablations)
    if mirror:
        online |= with_mirror(online)
    wanted = list(only) or [*offline, *online]
    for name in wanted:
        if name not in offline and name not in online:
            names = ", ".join(f"'{name}'" for name in (*offline, *online))
            raise RapidError(
                f"There is no agent '{name}' among {names}. Choose others, or other --steps; some need --ablations, "
                "--more-data, --vehicles, --ppo or --mirror."
            )
    needed = set(wanted)
    for name in wanted:
        while name in online:
            name = online[name].origin
            needed.add(name)
    agents: list[tuple[str, Path]] = []
    for name, (settings, source) in offline.items():
        home = work / file_name(name)
        if name in needed and not is_trained(home, settings, "distill"):
            distill_agent(settings, mixed(settings, data, work, source), home, name)
        if name in wanted:
            agents.append((name, home / "agent"))
    bases = dict.fromkeys(offline, config)
    for name, (settings, origin, source) in online.items():
        bases[name] = offline[origin].settings if source == "collected" and origin in offline else bases[origin]
        home, own = work / scenario / file_name(name), replace(bases[name], adapt=settings)
        if name in needed and not is_trained(home, own, "adapt"):
            start = (work / scenario if origin in online else work) / file_name(origin) / "agent"
            adapt_agent(own, start, mixed(own, data, work, source) if source else None, home, name)
        if name in wanted:
            agents.append((name, home / "agent"))
    return agents


def adaptation(recipe: str, steps: int) -> AdaptConfig:
    """Return phase 3 for a number of online steps."""
    scale = next(scale for least, scale in reversed(SETTINGS_FROM.items()) if steps >= least)
    usual = preset(recipe, "full").adapt
    sizes = {"evaluate_every": usual.evaluate_every, "learning_starts": usual.learning_starts}
    return replace(preset(recipe, scale).adapt, steps=steps, ppo=usual.ppo, **sizes)


def is_trained(home: Path, config: Config, phase: Literal["distill", "adapt"]) -> bool:
    """Return whether the agent in `home` is there.

    Raises:
        RapidError: it was trained with other settings.
    """
    if not (home / "agent" / "config.json").exists():
        return False
    # What the agent was written without had its default.
    written = load_agent(home / "agent").metadata["config"]
    saved = apply_overrides(preset(config.recipe, config.scale), written, source=f"the agent in '{home}'")
    for part in ("mix", "network", "distill", phase):
        before, now = (flatten(to_dict(getattr(each, part))) for each in (saved, config))
        without_ppo = not before.get("ppo.steps") and not now.get("ppo.steps")
        for name, value in now.items():
            if before[name] != value and not (without_ppo and name.startswith("ppo.")):
                raise RapidError(
                    f"The agent in '{home}' was trained with {part}.{name} = {before[name]}, not {value}. Name another "
                    "--work, or move that directory away."
                )
    return True


def differing(recipe: str) -> str:
    """Return what phase 3 has otherwise for more steps, as settings with their values."""
    told: list[str] = []
    before = flatten(to_dict(adaptation(recipe, 0)))
    for least in list(SETTINGS_FROM)[1:]:
        after = flatten(to_dict(adaptation(recipe, least)))
        changes = [f"`{name}` {value}" for name, value in after.items() if value != before[name] and name != "steps"]
        if changes:
            told.append(f"From {short(least)} steps on: {', '.join(changes)}. ")
        before = after
    return "".join(told)


def flatten(settings: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= flatten(value, f"{path}{name}.") if isinstance(value, dict) else {f"{path}{name}": value}
    return found


def mixed(config: Config, scenario: str, work: Path, source: Source = "teacher") -> Path:
    """Return where the data of a scenario lies mixed with random data; it is mixed if it is not there."""
    mixture = work / ("mix" if source == "teacher" else f"mix-{source}")
    if not (mixture / "dataset.json").exists():
        work.mkdir(parents=True, exist_ok=True)
        mix_datasets(config, *datasets(config, scenario, work.parent, source), mixture)
    return mixture


def datasets(config: Config, scenario: str, work: Path, source: Source) -> tuple[Path, Path]:
    """Return where a driver's data and the random one lie; under `work` if it is collected, or of another reward."""
    driven = replace(get_scenario(scenario), reward="normalized").name
    drivers: tuple[TrainPart, TrainPart] = ("teacher", "random")
    folders: list[Path] = []
    for driver in drivers:
        if source == "collected":
            folder = work / "collected" / driver
            # Once it is there, calls for several seeds may read it side by side.
            if not (folder / "dataset.json").exists() or len(load_dataset(folder)) < MORE_DATA:
                collect_transitions(replace(config, scenario=driven), folder, driver)
        else:
            folder = dataset_folder(f"shipped:{driven}/{source if driver == 'teacher' else driver}")
        if driven != scenario:
            dataset, folder = load_dataset(folder), work / "relabelled" / source / driver
            if not (folder / "dataset.json").exists():
                save_dataset(relabel(dataset, get_scenario(scenario).reward), folder)
        folders.append(folder)
    return folders[0], folders[1]


def is_ablation(name: str, whole: str) -> bool:
    """Return whether an agent is another without one of its parts; both may have gone on by PPO, or be mirrored."""
    (own, *later), (origin, *further) = name_parts(name), name_parts(whole)
    return later == further and own.startswith(f"{origin}, ")


def name_parts(name: str) -> tuple[str, str, str]:
    """Return an agent's name without its additions, what :func:`with_vehicles` and :func:`with_ppo` have put after it,
    and what :func:`with_mirror` has.
    """
    trained = name.removesuffix(MIRRORED)
    origin = seen_as_usual(trained.partition(" + ")[0])
    return origin, trained[len(origin) :], name[len(trained) :]


def short(steps: int) -> str:
    """Return a number of steps as it stands in an agent's name: 10K, 1M."""
    return f"{steps // 1000}K" if steps < 1_000_000 else f"{steps / 1_000_000:g}M"


def file_name(name: str) -> str:
    """Return an agent's name as that of a file."""
    return name.replace(" ", "-").replace(",", "")


def measure(
    config: Config, agents: Iterable[tuple[str, Path]], work: Path, scenario: str, spawns: int, attacks: Sequence[str]
) -> None:
    """Drive every agent that has not been driven."""
    for name, directory in agents:
        path = work / "rows" / f"{scenario}-{spawns}-{file_name(name)}.parquet"
        if path.exists() and path.stat().st_mtime > (directory / "config.json").stat().st_mtime:
            continue
        agent = open_agent(str(directory), scenario, config.seed)
        agent.name = name
        with task(f"evaluate, {name}, {scenario}, seed {config.seed}", spawns * len(attacks), "episodes") as shown_:
            rows = evaluate_agent(
                agent,
                scenario,
                spawn_seeds("test", spawns),
                attacks,
                generator_seed=config.seed,
                training_seed=config.seed,
                commit=commit(),
                progress=shown_.advance,
            )
        save_rows(path, rows)


def measure_references(
    work: Path, floors: list[EpisodeRow], names: Iterable[str], scenarios: Sequence[str], spawns: int
) -> None:
    """Drive what learns nothing here where it has not: floors and planners by their names, and the default teacher."""
    for name in names:
        for scenario in scenarios:
            path = reference_rows(work, scenario, spawns, name)
            if path.exists() or floor_rows(floors, scenario, spawns, name):
                continue
            if name == TEACHER:
                driver = make_teacher(TeacherConfig(), get_scenario(scenario).lanes, 0)
            else:
                driver = open_agent(name, scenario)
            with task(f"evaluate, {driver.name}, {scenario}", spawns, "episodes") as shown:
                rows = evaluate_agent(
                    driver, scenario, spawn_seeds("test", spawns), ("none",), commit=commit(), progress=shown.advance
                )
            save_rows(path, rows)


def floor_rows(floors: list[EpisodeRow], scenario: str, spawns: int, name: str) -> list[EpisodeRow]:
    """Return one floor's rows among `floors`; none if it has not driven all of these spawns there."""
    driven = {row.seed: row for row in floors if (row.agent, row.scenario) == (name, scenario)}
    seeds = spawn_seeds("test", spawns)
    return [driven[seed] for seed in seeds] if set(seeds) <= driven.keys() else []


def reference_rows(work: Path, scenario: str, spawns: int, name: str) -> Path:
    """Return where the rows of a floor, a planner or the teacher are kept."""
    return work / "rows" / f"{scenario}-{spawns}-{name}.parquet"


def difference(ours: list[EpisodeRow], theirs: list[EpisodeRow], name: str = "episode_return") -> Estimate:
    """Return the paired difference of two agents' clean driving."""
    return paired_difference(
        column(ours, name),
        [row.seed for row in ours],
        column(theirs, name),
        [row.seed for row in theirs],
        [row.training_seed for row in ours],
        [row.training_seed for row in theirs],
    )


def shown(number: Estimate, digits: int = 2) -> str:
    """Return an estimate with its interval."""
    return f"{number.value:.{digits}f} [{number.low:.{digits}f}, {number.high:.{digits}f}]"


def report(rows: list[EpisodeRow], config: Config, data: str, spawns: int, command: str) -> str:
    """Return the tables as Markdown."""
    mlps = f"Online DDQN has no Munchausen term, and no MLP a discount above {MLP_DISCOUNT}. "
    if config.recipe == "paper":
        mlps = "Step, batch and target updates of the baselines as the paper prints them. "
    of = f", {short(MORE_DATA)}"
    ppo = ppo_settings(config.adapt, rows[0].scenario, 0)
    ppo_told = ", ".join(f"`{name}` {value}" for name, value in to_dict(ppo).items() if name != "steps")
    ppo_note = (
        f"`+ … PPO`: so many steps more by PPO, {ppo_told}. "
        if any(" PPO" in name_parts(row.agent)[1] for row in rows)
        else ""
    )
    more = (
        f"After the name of an offline method, `{of[2:]}` says that it learned from {MORE_DATA} transitions of the "
        f"teacher and as many random ones in {MORE_ITERATIONS} gradient steps. After RAPID's, `from {of[2:]}` says "
        "that it began from what was so distilled without J_robust, with that data in its batches, and explored no "
        "more than the shortest budget does, whatever the steps. "
        if any(of[2:] in row.agent for row in rows)
        else ""
    )
    mirror_note = (
        f"`{MIRRORED[2:]}`: the Q-values averaged with those of the mirrored road, without further training. "
        if any(row.agent.endswith(MIRRORED) for row in rows)
        else ""
    )
    seen_note = (
        "`… seen`: so many vehicles are read from phase 3 on. "
        if any(seen_as_usual(row.agent) != row.agent for row in rows)
        else ""
    )
    commits = ", ".join(dict.fromkeys(row.commit[:7] or "unknown" for row in rows))
    lines = [
        "# Scores",
        "",
        f"Recipe `{config.recipe}`; shipped data of {data or 'each scenario itself'}, mixed at p = {config.mix.p:g}, "
        f"{config.mix.size} transitions; {config.distill.iterations} gradient steps offline for every method; an "
        f"online method's name tells its environment steps, {config.adapt.updates_per_step:g} gradient steps for each. "
        f"{differing(config.recipe)}{mlps}{more}{seen_note}{ppo_note}{mirror_note}"
        f"Last checkpoint, {spawns} test spawns, means with 95 % intervals (hierarchical bootstrap over seeds and "
        "spawns).",
        "",
        f"Made with `{command}`; the rows are of the commits {commits}.",
    ]
    for scenario in dict.fromkeys(row.scenario for row in rows):
        here = [row for row in rows if row.scenario == scenario]
        clean = {
            name: [row for row in here if row.agent == name and row.attack == "none"]
            for name in dict.fromkeys(row.agent for row in here)
        }
        lines += ["", f"## {scenario}", "", "```", summary_text(here), "```", ""]
        if config.recipe == "paper":
            lines += beside_paper(here, scenario)
        teacher = next((name for name, of in clean.items() if of and of[0].kind == "teacher"), None)
        adapted = [name for name in clean if name.startswith("RAPID")]
        distilled = [name for name in clean if name == "distilled" or name.startswith(f"distilled{of}")]
        pairs = [(name, other) for name in distilled for other in ("slower", teacher)]
        for name in adapted:
            pairs += [
                (name, "slower"),
                (name, teacher),
                (name, "planner-observation"),
                (name, "distilled"),
                *(
                    (name, seen_as_usual(name).replace("RAPID", f"online {other}"))
                    for other in ("DDQN", "Munchausen DQN")
                ),
            ]
            origin, further, mirrored = name_parts(name)
            trained = origin + further
            if origin.endswith(f"from {short(MORE_DATA)}"):
                pairs.append((name, more_distilled()))
            if further:
                # Where it began, and as it would have been with as many rows as the data has, or partly frozen.
                pairs += [(name, trained.partition(" + ")[0] + mirrored), (name, seen_as_usual(name))]
                if further.endswith(WHOLE):
                    pairs.append((trained.removesuffix(WHOLE) + mirrored, name))
            if mirrored:
                pairs.append((name, trained))
        # An ablation is called after what it ablates.
        pairs += [(whole, name) for whole in clean for name in clean if is_ablation(name, whole)]
        for name, other in dict.fromkeys(pairs):
            if name != other and other in clean and name in clean:
                gain = difference(clean[name], clean[other])
                crash = difference(clean[name], clean[other], "crashed")
                lines.append(f"- {name} against {other}, paired: return {shown(gain)}, crash share {shown(crash, 3)}.")
        if {"slower", "planner"} <= clean.keys():
            low, high = (float(np.mean(column(clean[name], "episode_return"))) for name in ("slower", "planner"))
            for name in [*distilled, *adapted]:
                if name in clean:
                    reached = (float(np.mean(column(clean[name], "episode_return"))) - low) / (high - low)
                    aim = f"; aimed at: {WAY.get(get_scenario(scenario).lanes, 0):.0%} within a million online steps"
                    told = aim if config.recipe == "strong" else ""
                    lines.append(f"- {name} has gone {reached:.0%} of the way from always-slower to the planner{told}.")
    return "\n".join(lines) + "\n"


def beside_paper(rows: list[EpisodeRow], scenario: str) -> list[str]:
    """Return the lines of a table with the paper's numbers beside ours; nothing if it has none here."""
    lines = ["| ours (the paper's) | " + " | ".join(ATTACKS) + " |", "|---" * (len(ATTACKS) + 1) + "|"]
    for agent in dict.fromkeys(row.agent for row in rows):
        cells: list[str] = []
        for attack in ATTACKS:
            returns = [row.episode_return for row in rows if row.agent == agent and row.attack == attack]
            # The paper's online methods have 10,000 steps.
            printed = paper_return(agent.removesuffix(", 10K"), get_scenario(scenario), attack)
            told = f" ({printed.mean:.2f} ± {printed.spread:.2f})" if printed else ""
            cells.append(f"{np.mean(returns):.2f}{told}" if returns else "–")
        if any("(" in cell for cell in cells):
            lines.append(f"| {agent} | {' | '.join(cells)} |")
    return [*lines, ""] if len(lines) > 2 else []


def table(work: Path, scenarios: list[str], data: str, spawns: int, config: Config, out: Path) -> None:
    """Write what has been measured so far."""
    floors = load_rows(out / "floors.parquet")
    rows: list[EpisodeRow] = []
    own: list[EpisodeRow] = []
    for scenario in scenarios:
        pattern = f"{data or scenario}/seed-*/rows/{scenario}-{spawns}-*.parquet"
        driven = {name: floor_rows(floors, scenario, spawns, name) for name in FLOORS}
        missing = [name for name in (*FLOORS, TEACHER) if not driven.get(name)]
        paths = [*(reference_rows(work, scenario, spawns, name) for name in missing), *sorted(work.glob(pattern))]
        here = [row for path in paths if path.exists() for row in load_rows(path)]
        own += here
        rows += [row for of in driven.values() for row in of] + here
    if not own:
        raise SystemExit(f"Nothing has been measured over {spawns} spawns under '{work}'. Train first: see --help.")
    marks = {
        "paper": config.recipe == "paper",
        "progress": all(get_scenario(s).reward == "progress" for s in scenarios),
        f"{spawns}": spawns != USUAL_SPAWNS,
    }
    name = "-".join(["scores", *(mark for mark, it_is in marks.items() if it_is), *(["from", data] if data else [])])
    save_rows(out / f"{name}.parquet", own)
    command = shlex.join(["python", "benchmarks/scores.py", *sys.argv[1:]])
    write_text(out / f"{name}.md", report(rows, config, data, spawns, command))
    print(f"Wrote {out / name}.md")


def main() -> None:
    """Train, measure, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4], help="training seeds")
    parser.add_argument("--spawns", type=int, default=USUAL_SPAWNS, help="test spawns per agent")
    parser.add_argument("--attacks", nargs="+", default=list(ATTACKS), choices=ATTACKS, help="attacks to drive under")
    parser.add_argument("--scenarios", nargs="+", default=list(PAPER_SCENARIOS), help="target scenarios")
    parser.add_argument("--recipe", default="strong", choices=("strong", "paper"), help="how things are trained")
    parser.add_argument(
        "--steps", type=int, nargs="*", default=[10_000, 100_000, 300_000], help="online steps; may be none"
    )
    parser.add_argument(
        "--ablations",
        action="store_true",
        help="train RAPID without each of its parts, and from a rule's data, as well",
    )
    parser.add_argument(
        "--more-data",
        action="store_true",
        help=f"collect {MORE_DATA} transitions of the teacher, and train RAPID and CQL on them as well",
    )
    parser.add_argument(
        "--vehicles",
        type=int,
        default=0,
        metavar="N",
        help="train RAPID to see so many vehicles from phase 3 on, as agents of their own",
    )
    parser.add_argument(
        "--ppo",
        type=int,
        default=0,
        metavar="STEPS",
        help="let every agent trained online go on by PPO for so many steps, as agents of their own",
    )
    parser.add_argument(
        "--mirror",
        action="store_true",
        help="average the Q-values of every agent trained online with those of the mirrored road, as agents of their "
        "own; for the reward progress",
    )
    parser.add_argument("--device", default="cpu", help="where agents are trained; they drive on the CPU")
    parser.add_argument("--only", nargs="+", default=[], help="agents to train and drive, by their names in the table")
    parser.add_argument("--data", default="", choices=PAPER_SCENARIOS, help="learn offline from this scenario for all")
    parser.add_argument("--work", type=Path, default=Path("runs/scores"), help="where finished parts are kept")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the table goes")
    parser.add_argument("--teacher", action="store_true", help="drive the default teacher as well; it needs its model")
    parser.add_argument(
        "--floors",
        nargs="+",
        default=[],
        choices=FLOORS,
        metavar="NAME",
        help=f"drive these as well, for spawns other than those of floors.parquet: {', '.join(FLOORS)}",
    )
    parser.add_argument("--table", action="store_true", help="only write the table of what is there")
    chosen = parser.parse_args()
    config = preset(chosen.recipe, "full")
    config = replace(config, device=chosen.device, evaluate=replace(config.evaluate, curve_spawns=0))
    work = chosen.work / chosen.recipe
    if not chosen.table:
        check(config)
        if chosen.ppo or chosen.vehicles:
            ppo = replace(config.adapt.ppo, steps=chosen.ppo)
            check(replace(config, adapt=replace(config.adapt, ppo=ppo, vehicles=chosen.vehicles)))
        if chosen.vehicles:
            check_widening(config.network, chosen.vehicles)
        references = [*chosen.floors, *([TEACHER] if chosen.teacher else [])]
        measure_references(work, load_rows(chosen.out / "floors.parquet"), references, chosen.scenarios, chosen.spawns)
        for seed in chosen.seeds:
            for scenario in chosen.scenarios:
                data = chosen.data or scenario
                own, home = replace(config, seed=seed, scenario=data), work / data / f"seed-{seed}"
                options = (chosen.ablations, chosen.only, chosen.more_data, chosen.ppo, chosen.mirror, chosen.vehicles)
                agents = train(own, data, home, scenario, chosen.steps, *options)
                measure(own, agents, home, scenario, chosen.spawns, chosen.attacks)
    table(work, chosen.scenarios, chosen.data, chosen.spawns, config, chosen.out)


if __name__ == "__main__":
    try:
        main()
    except RapidError as error:
        raise SystemExit(f"error: {error}") from None
