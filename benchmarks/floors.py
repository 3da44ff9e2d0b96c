"""Floors and ceilings: what drivers earn that learned nothing, and what planners earn that know more or less.

Drives every driver over the same test spawns, under both rewards of the paper's three scenarios, and searches the
spawns for crashes that no driver could avoid. Writes the raw episodes, the table and the searches:
`floors.parquet`, `floors.md` and `floors-unavoidable.json`. Every finished cell is kept under `--work`, so an
interrupted run goes on where it was; cells of another version of the simulator are not used.

    python benchmarks/floors.py --episodes 200 --out results
"""

import argparse
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np

from rapid.agents.open import open_agent
from rapid.evaluation.metrics import EpisodeRow, column, load_rows, save_rows
from rapid.evaluation.rollouts import run_episodes
from rapid.evaluation.statistics import Estimate, estimate
from rapid.files import read_json, write_json, write_text
from rapid.progress import task
from rapid.runs import commit as source_commit
from rapid.scenarios import ACTIONS, PAPER_SCENARIOS
from rapid.simulator import make_vec
from rapid.simulator.belief import DEPTH, DRAWS
from rapid.simulator.compile import kernel_stamp
from rapid.simulator.drawn import REACH
from rapid.simulator.search import WIDTH, unavoidable
from rapid.spawns import spawn_seeds

DRIVERS = (
    "random",
    "idle",
    "faster",
    "slower",
    "rule",
    "rule-forecast",
    "planner-observation",
    "planner-cars",
    "planner",
)
REWARDS = {"normalized": "", "progress": ":progress"}
DEPTHS = (1, 2, 3, 4, 5, 6)


def drive(driver: str, scenario: str, seeds: list[int], commit: str, title: str) -> list[EpisodeRow]:
    """Return the rows of one cell."""
    with task(title, len(seeds), "episodes") as progress:
        episodes = run_episodes(open_agent(driver, scenario), scenario, seeds, progress=progress.advance)
        rows = episodes.rows(commit=commit)
        progress.note(f"return {np.mean(column(rows, 'episode_return')):.2f}")
    return rows


def first_unavoidable(scenario: str, seeds: list[int]) -> list[int | None]:
    """Return for each spawn the fewest decisions within which every plan crashes; None if more than are searched."""
    env = make_vec(scenario, len(seeds), autoreset=False)
    env.reset(seed=seeds)
    found: list[int | None] = [None] * len(seeds)
    with task(f"{scenario}: unavoidable crashes", len(DEPTHS), "depths") as progress:
        for depth in DEPTHS:
            for world in np.flatnonzero(unavoidable(env, depth)):
                if found[world] is None:
                    found[world] = depth
            progress.advance()
    return found


def shown(number: Estimate, digits: int) -> str:
    """Return an estimate and its interval as text; a dash for what is not measured yet."""
    if number.episodes == 0:
        return "–"
    return f"{number.value:.{digits}f} [{number.low:.{digits}f}, {number.high:.{digits}f}]"


def estimated(rows: list[EpisodeRow], name: str) -> Estimate:
    """Return the mean of a column over the rows."""
    return estimate(column(rows, name), [row.seed for row in rows])


def report(cells: dict[tuple[str, str, str], list[EpisodeRow]], doomed: dict[str, list[int | None]]) -> str:
    """Return the tables as Markdown."""
    some = next(iter(cells.values()))
    names = ("numpy", "numba", "gymnasium", "highway-env")
    commits = ", ".join(dict.fromkeys(row.commit[:7] or "unknown" for rows in cells.values() for row in rows))
    lines = [
        "# Floors and ceilings",
        "",
        f"{len(some)} test spawns per cell (seeds {some[0].seed} to {some[-1].seed}), the compiled simulator, dynamics "
        "of `highway-v0`, 30 decisions of one second. Numbers are means with 95 % intervals over the spawns. "
        "`rule` and `rule-forecast` see the observation only and use the checks that a teacher is given; `planner` "
        f"knows the simulator's true state and searches whole episodes with a beam of {WIDTH}. `planner-cars` sees "
        f"what is from {-REACH[0]:.0f} m behind to {REACH[1]:.0f} m ahead but draws what drivers want, {DRAWS} times "
        f"a decision, and looks {DEPTH} seconds ahead; `planner-observation` has the observation alone, draws the cars "
        "that it does not show as well, and pays for driving close. All three are references and no bounds: the last "
        "two do not foresee that they will know more later. –: not measured.",
        "",
        "Made with: " + " ".join(["python", "benchmarks/floors.py", *sys.argv[1:]]),
        "",
        f"Commits {commits}, kernels {kernel_stamp().hex()[:12]}; Python "
        f"{platform.python_version()}, " + ", ".join(f"{name} {version(name)}" for name in names) + ".",
    ]
    for reward in REWARDS:
        lines += ["", f"## Return (crash share), `{reward}` reward", ""]
        lines += ["| driver | " + " | ".join(PAPER_SCENARIOS) + " |", "|---" * 4 + "|"]
        for driver in DRIVERS:
            texts: list[str] = []
            for scenario in PAPER_SCENARIOS:
                rows = cells.get((reward, scenario, driver), [])
                crashes = f" ({column(rows, 'crashed').mean():.3f})" if rows else ""
                texts.append(shown(estimated(rows, "episode_return"), 2) + crashes)
            lines.append(f"| {driver} | " + " | ".join(texts) + " |")
    lines += ["", "## Crashes that nobody can avoid", ""]
    lines += ["Share of the spawns at which every sequence of actions crashes within so many decisions.", ""]
    lines += ["| scenario | " + " | ".join(map(str, DEPTHS)) + " |", "|---" * (1 + len(DEPTHS)) + "|"]
    for scenario, depths in doomed.items():
        within = [[d is not None and d <= depth for d in depths] for depth in DEPTHS]
        texts = [f"{np.mean(hits):.3f}" for hits in within]
        texts[-1] = shown(estimate(np.array(within[-1], float), range(len(depths))), 3)
        lines.append(f"| {scenario} | " + " | ".join(texts) + " |")
    for reward in REWARDS:
        for scenario in PAPER_SCENARIOS:
            lines += ["", f"## {scenario}, `{reward}` reward", ""]
            head = ["driver", "return", "crash share", "speed [m/s]", "distance [m]", "lane changes", "length"]
            head += [action.lower() for action in ACTIONS] + ["ms per decision"]
            lines += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
            for driver in DRIVERS:
                rows = cells.get((reward, scenario, driver), [])
                if not rows:
                    continue
                texts = [shown(estimated(rows, "episode_return"), 2), shown(estimated(rows, "crashed"), 3)]
                texts += [shown(estimated(rows, "mean_speed"), 1), shown(estimated(rows, "distance"), 0)]
                texts += [f"{column(rows, name).mean():.1f}" for name in ("lane_changes", "length")]
                texts += [f"{share:.2f}" for share in np.mean([row.shares for row in rows], 0)]
                texts.append(f"{column(rows, 'decision_ms').mean():.3g}")
                lines.append("| " + " | ".join([driver, *texts]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure what is missing and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--episodes", type=int, default=200, help="spawns per cell")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the results go")
    parser.add_argument("--work", type=Path, default=Path("runs/floors"), help="where finished cells are kept")
    chosen = parser.parse_args()
    seeds = spawn_seeds("test", chosen.episodes)
    work = chosen.work / f"{kernel_stamp().hex()[:12]}-{len(seeds)}"
    commit = source_commit()
    doomed: dict[str, list[int | None]] = {}
    for scenario in PAPER_SCENARIOS:
        path = work / f"{scenario}-unavoidable.json"
        if not path.exists():
            write_json(path, first_unavoidable(scenario, seeds))
        doomed[scenario] = read_json(path)
    cells: dict[tuple[str, str, str], list[EpisodeRow]] = {}
    spawned = dict(zip(map(str, seeds), zip(*doomed.values(), strict=True), strict=True))
    write_json(chosen.out / "floors-unavoidable.json", {"scenarios": list(doomed), "depth_by_seed": spawned})
    todo = [(driver, reward, scenario) for driver in DRIVERS for reward in REWARDS for scenario in PAPER_SCENARIOS]
    for number, (driver, reward, scenario) in enumerate(todo, 1):
        path = work / f"{scenario}-{reward}-{driver}.parquet"
        fresh = not path.exists()
        if fresh:
            title = f"cell {number}/{len(todo)}: {driver}, {scenario}, {reward}"
            save_rows(path, drive(driver, scenario + REWARDS[reward], seeds, commit, title))
        cells[reward, scenario, driver] = load_rows(path)
        if fresh or number == len(todo):  # what is there can be read while the rest is measured
            save_rows(chosen.out / "floors.parquet", [row for rows in cells.values() for row in rows])
            write_text(chosen.out / "floors.md", report(cells, doomed))
    print(f"Wrote {os.fspath(chosen.out / 'floors.md')}")


if __name__ == "__main__":
    main()
