"""What an exhibit is: a table or figure as the cells that it needs and how it is shown; and comparisons of methods."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from rapid.attacks.spec import NAMED
from rapid.evaluation.metrics import EpisodeRow
from rapid.experiments import learned as make
from rapid.experiments import words
from rapid.experiments.cells import Cell, Drive, Driven, Driver, key
from rapid.experiments.figures import Lines, Router
from rapid.experiments.learned import Setting
from rapid.experiments.methods import METHODS, Method
from rapid.experiments.migrate import Legacy
from rapid.experiments.paper import paper_result
from rapid.experiments.store import Store
from rapid.experiments.tables import Entry, Facts, Table, entry
from rapid.scenarios import PAPER_SCENARIOS

Shown = Table | Facts | Lines | Router


ATTACKS = ("none", "uniform", "gaussian", "fgsm", "pgd")


@dataclass(frozen=True)
class Request:
    """Which version of an exhibit is wanted."""

    recipe: str
    scale: str

    def setting(self, scenario: str, seed: int = 0) -> Setting:
        """Return where a method is trained and measured."""
        return Setting(self.recipe, self.scale, scenario, seed)

    @property
    def seeds(self) -> range:
        """Training seeds."""
        return range(make.EFFORTS[self.scale].seeds)

    def attack(self, name: str) -> str:
        """Return an attack's text: the recipe `paper` lets presence be attacked (docs/deviations.md).

        The attack stays the paper's: `pgd:presence=free` would be the kind's 50 steps from five starts.
        """
        if self.recipe != "paper" or name == "none":
            return name
        return replace(NAMED[name], presence="free").name


@dataclass(frozen=True)
class Exhibit:
    """A table or figure with an id that never changes."""

    id: str
    caption: str
    kind: Literal["table", "figure", "text"]
    cells: Callable[[Request], list[Cell]]
    """What must be computed."""
    show: Callable[[Request, Store, "Exhibit"], list[Shown]]
    recipes: tuple[str, ...] = ("paper", "strong")
    of_paper: bool = True


def drives(request: Request, agent: Driven, scenario: str, attacks: Sequence[str]) -> list[Drive]:
    """Return an agent's episodes under several attacks."""
    effort = make.EFFORTS[request.scale]
    slow = isinstance(agent, Driver) and (agent.teacher is not None or agent.name.startswith("planner"))
    spawns = effort.reference_spawns if slow else effort.spawns
    seed = 0 if isinstance(agent, Driver) else agent.seed
    return [Drive(agent, scenario, request.attack(name), spawns, seed=seed) for name in attacks]


def method_drives(request: Request, method: Method, scenario: str, attacks: Sequence[str]) -> list[Drive]:
    """Return the episodes of a method's agents, one training for each seed."""
    seeds = request.seeds if method.trained else range(1)
    return [
        drive
        for seed in seeds
        for drive in drives(request, method.agent(request.setting(scenario, seed)), scenario, attacks)
    ]


def rows_of(store: Store, cells: Sequence[Drive], legacy: Legacy | None = None) -> tuple[list[EpisodeRow], str]:
    """Return the episodes of some cells and why any is missing.

    Committed rows of before there were cells stand in where they are of as many trainings.
    """
    found: list[EpisodeRow] = []
    missing = 0
    for cell in cells:
        if store.is_done(cell):
            found += store.rows(cell)
        else:
            missing += 1
    if missing and legacy and (old := store.legacy(legacy)) and _trainings(old) >= _trainings(found):
        store.note(old)
        return old, ""  # never mixed with new ones
    store.note(found)
    return found, gap(missing, len(cells))


def gap(missing: int, count: int) -> str:
    """Return how many parts are missing, in words; empty where none is."""
    if not missing:
        return ""
    return f"{missing} of {count} parts are missing"


def gap_of(store: Store, cells: Sequence[Cell]) -> str:
    """Return what a figure lacks of its cells, in words; empty where it is whole."""
    every = {key(cell): cell for cell in cells}
    missing = sum(not store.is_done(cell) for cell in every.values())
    if missing < len(every):
        return gap(missing, len(every))
    return f"nothing has been computed yet: {missing} part{'s' if missing > 1 else ''}" if missing else ""


def _trainings(rows: Sequence[EpisodeRow]) -> int:
    return len({row.training_seed for row in rows})


def rows_under(
    request: Request, store: Store, scenario: str, method: Method, attack: str
) -> tuple[list[EpisodeRow], str]:
    """Return a method's episodes under an attack and why any is missing."""
    seen = method.under(attack)
    if not seen:
        return [], "not attacked"
    old = Legacy(request.recipe, method.id, scenario, seen) if request.scale == "full" else None
    return rows_of(store, method_drives(request, method, scenario, (seen,)), old)


def grid(request: Request, store: Store, scenario: str, method: Method, attacks: Sequence[str]) -> tuple[Entry, ...]:
    """Return one row of a table: a method in a scenario under each attack, beside the paper's numbers."""
    entries: list[Entry] = []
    for name in attacks:
        rows, why = rows_under(request, store, scenario, method, name)
        said = paper_result("attack", name, scenario=scenario, method=method.printed) if method.printed else None
        entries.append(entry(rows, said, why))
    return tuple(entries)


def applicable(request: Request, ids: Sequence[str], scenarios: Sequence[str], attacks: Sequence[str]) -> list[Cell]:
    """Return the episodes of several methods, each under the attacks that can be made on it."""
    return [
        drive
        for scenario in scenarios
        for method in map(METHODS.__getitem__, ids)
        for drive in method_drives(
            request, method, scenario, list(dict.fromkeys(filter(None, map(method.under, attacks))))
        )
    ]


def comparison(
    identity: str,
    caption: str,
    ids: tuple[str, ...],
    scenarios: tuple[str, ...] = PAPER_SCENARIOS,
    attacks: tuple[str, ...] = ATTACKS,
    recipes: tuple[str, ...] = ("paper", "strong"),
    of_paper: bool = False,
) -> Exhibit:
    """Return a table of methods under attacks, in several scenarios."""

    def show(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
        rows = tuple(
            ((scenario, METHODS[name].label), grid(request, store, scenario, METHODS[name], attacks))
            for scenario in scenarios
            for name in ids
        )
        return [Table(identity, caption, ("scenario", "method"), attacks, rows, (words.sizes(request.recipe),))]

    return Exhibit(
        identity,
        caption,
        "table",
        lambda request: applicable(request, ids, scenarios, attacks),
        show,
        recipes,
        of_paper,
    )


def driven(store: Store, cells: Sequence[Drive]) -> Entry:
    rows, why = rows_of(store, cells)
    return entry(rows, failed=why)
