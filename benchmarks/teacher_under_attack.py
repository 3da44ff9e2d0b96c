"""The paper's figure of the teacher under a growing attack on its observations, against policies learned from its data.

Noise of growing size, uniform and Gaussian, falls on everything that a driver sees; it is the attack that can be made
on a language model too. The teacher is the default one; the policies are those that `benchmarks/scores.py` trained
offline, every training seed. All drive the same test spawns. Everything measured is kept under `--work`, so an
interrupted call goes on where it was. Writes `teacher-under-attack.parquet` (raw rows), `.md` and `.png`.

    python benchmarks/scores.py --seeds 0 1 2 3 4
    python benchmarks/teacher_under_attack.py --spawns 100 --out results
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rapid.agents.open import open_agent
from rapid.attacks import AttackSpec
from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, column, load_rows, save_rows
from rapid.evaluation.rollouts import run_episodes
from rapid.evaluation.statistics import Estimate, estimate, paired_difference
from rapid.files import write_text
from rapid.progress import task
from rapid.report.figures import save_figure
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.spawns import spawn_seeds
from rapid.teacher import make_teacher

KINDS: tuple[Literal["uniform", "gaussian"], ...] = ("uniform", "gaussian")
SIZES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""In normalised features; the last is the paper's."""
TEACHER, FLOORS, LEARNED = "teacher", ("rule-forecast", "slower"), ("offline DQN", "distilled")
COLORS = {TEACHER: "#a4490f", "offline DQN": "#1f6f8b", "distilled": "#6b57b8", "rule-forecast": "#3c8f4e"}


def attacks() -> dict[str, AttackSpec]:
    """Return every attack by name, none first."""
    noises = [AttackSpec(kind, radius=size, label=f"{kind}-{size:g}") for kind in KINDS for size in SIZES]
    return {"none": AttackSpec()} | {noise.label: noise for noise in noises}


def drive(agent: Any, name: str, training_seed: int | None, chosen: argparse.Namespace) -> list[EpisodeRow]:
    """Return one driver's rows, measuring those that are missing."""
    seeds = spawn_seeds("test", chosen.spawns)
    label = name if training_seed is None else f"{name}-{training_seed}"
    cells = attacks()
    rows: list[EpisodeRow] = []
    with task(label, len(cells), "cells") as progress:
        for attack, noise in cells.items():
            path = chosen.work / f"{chosen.scenario}-{chosen.spawns}-{label.replace(' ', '-')}-{attack}.parquet"
            if not path.exists():
                if callable(agent):  # opened only if it is needed
                    agent = agent()
                    agent.name = name
                found = run_episodes(agent, chosen.scenario, seeds, noise, generator_seed=training_seed or 0)
                save_rows(path, found.rows(training_seed, commit()))
                progress.note(f"{attack}: return {found.return_E.mean():.2f}")
            rows += load_rows(path)
            progress.advance()
    return rows


def drivers(chosen: argparse.Namespace) -> list[tuple[str, int | None, Callable[[], Any]]]:
    """Return who drives: name, training seed, and how to open it."""
    lanes = get_scenario(chosen.scenario).lanes
    found: list[tuple[str, int | None, Callable[[], Any]]] = [
        (TEACHER, None, lambda: make_teacher(TeacherConfig(), lanes, 0)),
        *((name, None, lambda name=name: open_agent(name, chosen.scenario)) for name in FLOORS),
    ]
    for name in LEARNED:
        homes = sorted(chosen.scores.glob(f"seed-*/{name.replace(' ', '-')}/agent"))
        if not homes:
            raise RapidError(f"There is no agent '{name}' under '{chosen.scores}'. Train some: benchmarks/scores.py")
        for home in homes:
            seed = int(home.parts[-3].removeprefix("seed-"))
            found.append((name, seed, lambda home=home: open_agent(str(home), chosen.scenario)))
    return found


def of(rows: list[EpisodeRow], name: str, attack: str) -> list[EpisodeRow]:
    """Return the rows of a driver under an attack."""
    return [row for row in rows if row.agent == name and row.attack == attack]


def estimated(rows: list[EpisodeRow], what: str) -> Estimate:
    """Return a mean over spawns and, where there are any, training seeds."""
    return estimate(column(rows, what), [row.seed for row in rows], [row.training_seed for row in rows])


def shown(number: Estimate, digits: int = 1, sign: str = "") -> str:
    """Return an estimate with its interval."""
    return f"{number.value:{sign}.{digits}f} [{number.low:{sign}.{digits}f}, {number.high:{sign}.{digits}f}]"


def report(rows: list[EpisodeRow], chosen: argparse.Namespace) -> str:
    """Return the tables as Markdown."""
    lanes, names = get_scenario(chosen.scenario).lanes, list(dict.fromkeys(row.agent for row in rows))
    trainings = {row.training_seed for row in rows} - {None}
    lines = [
        "# The teacher under a growing attack",
        "",
        f"{chosen.scenario}, {chosen.spawns} test spawns, {len(trainings)} trainings of each policy; return (crash "
        "share), means with 95 % intervals over spawns, and trainings where there are several. Noise on every feature "
        "but presence, drawn anew each second; a size is in features normalised by highway-env's ranges. The paper's "
        "is 0.2. `rule-forecast` needs no model; `slower` always brakes, whatever it sees.",
        "",
        f"Made with: {' '.join(['python', 'benchmarks/teacher_under_attack.py', *sys.argv[1:]])}, commit "
        f"{rows[-1].commit or 'unknown'}.",
        "",
        "![Return and crash share over the size of the noise](teacher-under-attack.png)",
    ]
    for kind in KINDS:
        lines += ["", f"## {kind}", "", f"| size | {' | '.join(names)} | teacher less offline DQN |"]
        lines += ["|---" * (2 + len(names)) + "|"]
        for size in (0.0, *SIZES):
            attack = f"{kind}-{size:g}" if size else "none"
            cells = [AttackSpec("uniform", radius=size).units(lanes) if size else "0"]
            for name in names:
                here = of(rows, name, attack)
                cells.append(f"{shown(estimated(here, 'episode_return'))} ({column(here, 'crashed').mean():.2f})")
            ours, theirs = of(rows, TEACHER, attack), of(rows, LEARNED[0], attack)
            gain = paired_difference(
                column(ours, "episode_return"),
                [row.seed for row in ours],
                column(theirs, "episode_return"),
                [row.seed for row in theirs],
                None,
                [row.training_seed for row in theirs],
            )
            lines.append(f"| {' | '.join([*cells, shown(gain, sign='+')])} |")
    return "\n".join(lines) + "\n"


def draw(rows: list[EpisodeRow], scenario: str) -> Figure:
    """Return the figure: return and crash share over the size of the noise, a column for each kind."""
    figure = Figure(figsize=(9.5, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, len(KINDS), sharex=True, sharey="row")
    places = range(1 + len(SIZES))
    for place, kind in enumerate(KINDS):
        names = ["none", *(f"{kind}-{size:g}" for size in SIZES)]
        for axes, what in zip(grid[:, place], ("episode_return", "crashed"), strict=True):
            for name in dict.fromkeys(row.agent for row in rows):
                found = [estimated(of(rows, name, attack), what) for attack in names]
                color = COLORS.get(name, "#8a939b")
                axes.plot(places, [one.value for one in found], "o-", color=color, markersize=3.5, label=name)
                low, high = [one.low for one in found], [one.high for one in found]
                axes.fill_between(places, low, high, color=color, alpha=0.15, linewidth=0)
            axes.set_ylim(bottom=0)
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(True, axis="y", color="#eceeef")
        grid[0, place].set_title(f"{kind} noise", fontsize=10, loc="left")
        grid[1, place].set_xticks(places, [f"{size:g}\n{200 * size:g} m" for size in (0.0, *SIZES)])
        grid[1, place].set_xlabel("size, normalised; what it is along the road", fontsize=8)
    grid[0, 0].set_ylabel("return")
    grid[1, 0].set_ylabel("crash share")
    grid[0, 1].legend(fontsize=8, frameon=False)
    figure.suptitle(f"{scenario}, means with 95 % intervals", fontsize=11, x=0.01, ha="left")
    return figure


def main() -> None:
    """Measure what is missing and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--scenario", default="lane-3-density-2")
    parser.add_argument("--spawns", type=int, default=100, help="test spawns of each driver under each attack")
    parser.add_argument(
        "--scores", type=Path, help="where the trained agents are; runs/scores/strong/SCENARIO if unsaid"
    )
    parser.add_argument("--work", type=Path, default=Path("runs/teacher-under-attack"), help="where cells are kept")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the results go")
    chosen = parser.parse_args()
    chosen.scores = chosen.scores or Path("runs/scores/strong") / chosen.scenario
    torch.set_num_threads(1)
    rows = [row for name, seed, agent in drivers(chosen) for row in drive(agent, name, seed, chosen)]
    save_rows(chosen.out / "teacher-under-attack.parquet", rows)
    write_text(chosen.out / "teacher-under-attack.md", report(rows, chosen))
    save_figure(draw(rows, chosen.scenario), chosen.out / "teacher-under-attack.png")
    print(f"Wrote {chosen.out / 'teacher-under-attack.md'}")


if __name__ == "__main__":
    main()
