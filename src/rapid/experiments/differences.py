"""What carries the scores: each part of RAPID against the same without it, over the same spawns."""

from typing import NamedTuple

from rapid.evaluation.metrics import EpisodeRow, column
from rapid.evaluation.statistics import Estimate, paired_difference
from rapid.experiments.cells import Cell
from rapid.experiments.exhibit import ATTACKS, Exhibit, Request, Shown, applicable, rows_under
from rapid.experiments.methods import METHODS
from rapid.experiments.store import Store
from rapid.experiments.tables import Facts
from rapid.scenarios import PAPER_SCENARIOS

RESAMPLES = 2_000
"""Of the bootstrap behind each interval."""


class Pair(NamedTuple):
    """One method less another."""

    question: str
    ours: str
    theirs: str
    scenarios: tuple[str, ...] = PAPER_SCENARIOS


HOME = PAPER_SCENARIOS[:1]
"""Where methods with a part left out are trained."""
PAIRS: dict[str, tuple[Pair, ...]] = {
    "paper": (
        Pair("the robust term", "rapid", "rapid-without-robust"),
        Pair("all of RAPID", "rapid", "online-dqn"),
        Pair("all of RAPID", "rapid", "offline-dqn"),
    ),
    "strong": (
        Pair("the robust term", "distilled", "distilled-without-robust", HOME),
        Pair("the language model's data", "distilled", "distilled-rule-data", HOME),
        Pair("the frozen policy 1", "rapid-10k", "rapid-10k-all", HOME),
        Pair("the distilled policy at all", "rapid-10k", "rapid-10k-scratch", HOME),
        Pair("RAPID's network and data", "rapid-10k", "online-ddqn-10k"),
        Pair("RAPID's network and data", "rapid-ppo", "mlp-ppo"),
        Pair("training under attack", "rapid-robust", "rapid-ppo"),
        Pair("and squeezed features", "rapid-squeezed", "rapid-ppo"),
        Pair("and a monitor", "rapid-monitored", "rapid-ppo"),
        Pair("a monitor over them", "rapid-monitored", "rapid-squeezed"),
        *(Pair("the best of RAPID", "rapid-monitored", floor) for floor in ("slower", "immune", "blind")),
    ),
}
"""What is compared in a recipe, and which part of RAPID each comparison is about."""


def cells(request: Request) -> list[Cell]:
    """Return the episodes of every method that is compared."""
    return [
        cell
        for pair in PAIRS[request.recipe]
        for cell in applicable(request, (pair.ours, pair.theirs), pair.scenarios, ATTACKS)
    ]


def show(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    """Return the differences as one table; a pair of which one side was not driven has dashes."""
    rows: list[tuple[str, ...]] = []
    whole: dict[tuple[str, str, str], bool] = {}
    for pair in PAIRS[request.recipe]:
        ours, theirs = METHODS[pair.ours], METHODS[pair.theirs]
        for scenario in pair.scenarios:
            found: list[Estimate | None] = []
            for attack in ATTACKS:
                sides = [rows_under(request, store, scenario, method, attack) for method in (ours, theirs)]
                found.append(difference(*(episodes for episodes, _ in sides)))
                for method, (_, why) in zip((ours, theirs), sides, strict=True):
                    whole[scenario, method.id, attack] = not why
            rows.append((pair.question, f"{ours.label} − {theirs.label}", scenario, *map(told, found)))
    note = (
        "Return of the first less that of the second, in the mean over the spawns that both drove. 95 % intervals are "
        "bootstrapped over trainings and spawns. One that holds no 0 is a difference beyond the chance of both."
    )
    heads = ("about", "difference", "scenario", *ATTACKS)
    missing = list(whole.values()).count(False)
    gaps = (f"{missing} of {len(whole)} drives of a method under an attack are missing in whole or in part.",)
    return [Facts(exhibit.id, exhibit.caption, heads, tuple(rows), (note, *(gaps if missing else ())))]


def difference(ours: list[EpisodeRow], theirs: list[EpisodeRow]) -> Estimate | None:
    """Return the paired difference in return, None where one side is missing."""
    if not ours or not theirs:
        return None
    sides = [
        (column(rows, "episode_return"), [row.seed for row in rows], [row.training_seed for row in rows])
        for rows in (ours, theirs)
    ]
    (our_returns, our_spawns, our_seeds), (their_returns, their_spawns, their_seeds) = sides
    return paired_difference(
        our_returns, our_spawns, their_returns, their_spawns, our_seeds, their_seeds, resamples=RESAMPLES
    )


def told(found: Estimate | None) -> str:
    """Return a difference with its sign and interval."""
    if found is None:
        return "–"
    return f"{found.value:+.1f} [{found.low:+.1f}, {found.high:+.1f}]".replace("-", "−")
