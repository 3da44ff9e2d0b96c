"""Every exhibit by its id: the tables and figures of the paper, in its order, then ours."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from rapid.attacks.suite import suite
from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.worst import measured_under_all, worst_rows
from rapid.experiments import differences, words
from rapid.experiments.cells import Cell, Drive, key
from rapid.experiments.exhibit import ATTACKS, Exhibit, Request, Shown, comparison, method_drives, rows_of
from rapid.experiments.methods import METHODS, Method
from rapid.experiments.migrate import Legacy
from rapid.experiments.paper_figures import (
    RATIOS,
    online_cells,
    ratio_drives,
    readings,
    robust_agents,
    routing_cell,
    show_online,
    show_ratio,
    show_robust,
    show_routing,
    show_teacher_attack,
    teacher_attack_cells,
)
from rapid.experiments.paper_tables import (
    ARCHITECTURE_COLUMNS,
    BETAS,
    OFFLINE_COLUMNS,
    beta_cells,
    efficiency_cells,
    in_words,
    mixing_cells,
    offline_table,
    show_beta,
    show_efficiency,
    show_mixing,
)
from rapid.experiments.store import Store
from rapid.experiments.tables import Entry, Table, entry
from rapid.scenarios import PAPER_SCENARIOS

ROBUST_METHODS = (
    "slower",
    "immune",
    "blind",
    "online-ppo",
    "rapid-ppo",
    "rapid-robust",
    "rapid-guided",
    "rapid-squeezed",
    "rapid-monitored",
)


STRONGEST = ("pgd:loss=margin", "directed:target=faster", "lie:to=near", "world")
"""Attacks of the suite that scales below `full` make do with."""


def _suite(request: Request) -> list[str]:
    """The strong suite but for adversaries, which are trained against one agent each (``rapid evaluate``)."""
    every = [spec.name for spec in suite() if spec.kind not in ("none", "adversary") and spec.radius <= BALL]
    return every if request.scale == "full" else list(STRONGEST)


BALL = 0.1
"""Size of the ball in which the suite attacks: 20 m along the road."""


def _robust_drives(request: Request, method: Method, scenario: str, attack: str) -> list[Drive]:
    """Episodes under an attack that leaves presence alone, as the suite has it; who does not look drives clean."""
    seen = attack if method.looks == "everything" else "none"
    return [replace(drive, attack=seen) for drive in method_drives(request, method, scenario, ("none",))]


def _robust_cells(request: Request) -> list[Cell]:
    return [
        drive
        for scenario in PAPER_SCENARIOS
        for name in ROBUST_METHODS
        for attack in ("none", *ATTACKS[1:], *_suite(request))
        for drive in _robust_drives(request, METHODS[name], scenario, attack)
    ]


def _show_robustness(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    rows: list[tuple[tuple[str, ...], tuple[Entry, ...]]] = []
    for scenario in PAPER_SCENARIOS:
        for method in map(METHODS.__getitem__, ROBUST_METHODS):

            def of(attacks: Sequence[str], method: Method = method, scenario: str = scenario) -> Entry:
                found: dict[str, tuple[list[EpisodeRow], str]] = {}
                for attack in attacks:
                    old = Legacy(request.recipe, method.id, scenario, attack) if request.scale == "full" else None
                    found[attack] = rows_of(store, _robust_drives(request, method, scenario, attack), old)
                return worst_entry(found)

            groups = (("none",), ATTACKS, *((attack,) for attack in STRONGEST), ("none", *_suite(request)))
            rows.append(((scenario, method.label), tuple(of(group) for group in groups)))
    columns = ("clean", "worst of the paper's", *STRONGEST, "worst of the suite")
    notes = (
        "Worst: mean over spawns of the least return over attacks, of the trainings that met all of them. "
        f"The suite: {', '.join(_suite(request))}.",
        "The learned adversary is not among them, for it is trained against one agent each: "
        "`rapid evaluate --attacks suite` has it.",
    )
    return [Table("robustness", exhibit.caption, ("scenario", "method"), columns, tuple(rows), notes)]


def worst_entry(found: Mapping[str, tuple[Sequence[EpisodeRow], str]]) -> Entry:
    """Return the worst case of one method over attacks, given its rows under each and why any of them is missing.

    Only trainings and spawns that met every attack count: of the others the least return is one over fewer attacks.
    """
    gaps = [why if len(found) == 1 else f"{attack}: {why}" for attack, (_, why) in found.items() if why]
    more = f"; gaps under {len(gaps) - 1} more attacks" if len(gaps) > 1 else ""
    reason = gaps[0] + more if gaps else ""
    if not all(rows for rows, _ in found.values()):
        return entry([], failed=reason)
    # Rows of before there were cells call the same method otherwise, and who does not look drives clean throughout.
    every = [replace(row, agent="", attack=attack) for attack, (rows, _) in found.items() for row in rows]
    whole = measured_under_all(every)
    worst = [row for row in worst_rows(every) if (row.training_seed, row.seed) in whole]
    return entry(worst, failed=reason or ("" if worst else "no training met every attack"))


ALL: dict[str, Exhibit] = {
    exhibit.id: exhibit
    for exhibit in (
        Exhibit(
            "teacher-attack",
            "Return of the teacher and of offline DQN on lane-3-density-2 while noise on the observation grows.",
            "figure",
            teacher_attack_cells,
            show_teacher_attack,
        ),
        Exhibit(
            "ratio",
            "Return of DDQN and CQL by the share p of the teacher's transitions, with highway-fast dynamics.",
            "figure",
            lambda request: [
                drive for name in ("ddqn", "cql") for p in RATIOS for drive in ratio_drives(request, name, p)
            ],
            show_ratio,
        ),
        offline_table("offline", "Return after phase 2, by scenario, dataset and method.", OFFLINE_COLUMNS),
        Exhibit("online", "Return while adapting online.", "figure", online_cells, show_online),
        comparison(
            "attack",
            "Return under attacks on the observation.",
            (
                "online-dqn",
                "offline-dqn",
                "rapid-without-robust",
                "rapid",
                "slower",
                "immune",
                "blind",
                "random",
                "rule",
            ),
            of_paper=True,
        ),
        Exhibit(
            "routing",
            "What policy 1 and the adapter contribute to each vehicle on lane-4-density-2.5.",
            "figure",
            lambda request: [routing_cell(request)],
            show_routing,
        ),
        offline_table(
            "architecture", "Return of the MLP and of RAPID's network, each by three algorithms.", ARCHITECTURE_COLUMNS
        ),
        Exhibit(
            "j-robust",
            "The robust term while distilling with D*, in three scenarios and both readings of the data.",
            "figure",
            lambda request: [agent for place in readings() for agent in robust_agents(request, *place)],
            show_robust,
        ),
        Exhibit(
            "beta",
            "Return of RAPID under attack, by the weight β of the robust term.",
            "table",
            lambda request: [
                cell
                for scenario in PAPER_SCENARIOS
                for beta in BETAS
                for cell in beta_cells(request, scenario, beta, ATTACKS)
            ],
            show_beta,
        ),
        Exhibit(
            "mixing-actions",
            "A mixture of policies against a mixture of actions: return, gate and cost.",
            "table",
            mixing_cells,
            show_mixing,
        ),
        Exhibit(
            "prompt",
            "The prefix prompt and one interaction of the teacher.",
            "text",
            lambda request: [],
            in_words(words.prompt),
        ),
        Exhibit(
            "efficiency",
            "Seconds for one decision on this machine: the teacher and the policy.",
            "table",
            lambda request: list(efficiency_cells(request)),
            show_efficiency,
        ),
        Exhibit(
            "environment",
            "The environment's configuration.",
            "table",
            lambda request: [],
            in_words(words.environment),
        ),
        Exhibit(
            "hyperparameters",
            "Hyperparameters of the offline methods.",
            "table",
            lambda request: [],
            in_words(words.hyperparameters),
        ),
        comparison(
            "floors",
            "Drivers that learn nothing, and a search with a perfect model.",
            ("slower", "immune", "blind", "random", "rule", "planner"),
            (*PAPER_SCENARIOS, *(f"{scenario}:progress" for scenario in PAPER_SCENARIOS)),
            ("none",),
            ("strong",),
        ),
        comparison(
            "teachers",
            "The default teacher beside the rule.",
            ("teacher", "rule"),
            attacks=("none",),
            recipes=("strong",),
        ),
        comparison(
            "scores",
            "RAPID, its baselines and the floors under the paper's reward.",
            (
                *("slower", "immune", "blind", "random", "rule", "teacher", "planner"),
                *("offline-dqn", "offline-ddqn", "cql", "bc", "distilled"),
                *(
                    "online-ddqn-10k",
                    "online-ppo",
                    "mlp-ppo",
                    "rapid-10k",
                    "rapid-ppo",
                    "rapid-robust",
                    "rapid-guided",
                    "rapid-squeezed",
                    "rapid-monitored",
                ),
            ),
            recipes=("strong",),
        ),
        comparison(
            "progress",
            "RAPID and the floors under the reward `progress`.",
            (
                *("slower", "immune", "blind", "teacher", "distilled", "online-ppo", "rapid-10k", "rapid-ppo"),
                "rapid-monitored",
            ),
            tuple(f"{scenario}:progress" for scenario in PAPER_SCENARIOS),
            recipes=("strong",),
        ),
        comparison(
            "ablations",
            "RAPID without each of its parts, on lane-3-density-2.",
            (
                *("distilled", "distilled-without-robust", "distilled-without-cql", "distilled-plain-dqn"),
                *("distilled-rule-data", "rapid-10k", "rapid-10k-all", "rapid-10k-scratch"),
            ),
            PAPER_SCENARIOS[:1],
            recipes=("strong",),
        ),
        Exhibit(
            "differences",
            "What each part of RAPID adds, and how certain that is.",
            "table",
            differences.cells,
            differences.show,
            of_paper=False,
        ),
        Exhibit(
            "robustness",
            "Return under strong attacks of 0.1 (20 m along the road), presence left alone.",
            "table",
            _robust_cells,
            _show_robustness,
            ("strong",),
            of_paper=False,
        ),
    )
}
"""Every exhibit by its id, in the order of the paper, then ours."""


def recipe_of(exhibit: Exhibit, wanted: str) -> str:
    """Return the recipe that an exhibit has: the one wanted, else its first."""
    return wanted if wanted in exhibit.recipes else exhibit.recipes[0]


def cells_of(exhibit: Exhibit, recipe: str, scale: str) -> list[Cell]:
    """Return the cells that an exhibit needs, each once."""
    return list({key(cell): cell for cell in exhibit.cells(Request(recipe, scale))}.values())
