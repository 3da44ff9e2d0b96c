"""The paper's tables: offline methods, architectures, beta, mixing actions, efficiency, and settings in words."""

from collections.abc import Callable, Sequence

from rapid.experiments import learned as make
from rapid.experiments import words
from rapid.experiments.cells import Adapt, Cell, Decide, Distill, Drive, Mix
from rapid.experiments.exhibit import ATTACKS, Exhibit, Request, Shown, applicable, comparison, drives, gap_of, rows_of
from rapid.experiments.figures import said
from rapid.experiments.learned import Dataset, Reading, Setting, mixture
from rapid.experiments.methods import METHODS
from rapid.experiments.paper import paper_result
from rapid.experiments.store import Store
from rapid.experiments.tables import Entry, Facts, Table, entry
from rapid.scenarios import PAPER_SCENARIOS

BETAS = (0.0, 0.1, 0.5, 0.8)


DATASETS: tuple[Dataset, ...] = ("random", "llm", "mixed")


Column = tuple[str, str, Callable[[Setting, Mix], Distill]]
"""Name in the paper's table, label, how the agent is made."""


OFFLINE_COLUMNS: tuple[Column, ...] = (
    ("cql", "CQL", lambda s, data: make.mlp(s, "cql", data)),
    ("dqn", "DQN", lambda s, data: make.mlp(s, "dqn", data)),
    ("ddqn", "DDQN", lambda s, data: make.mlp(s, "ddqn", data)),
    ("rapid_without_robust", "RAPID w/o J_robust", lambda s, data: make.distilled(s, data, beta=0.0)),
    ("rapid", "RAPID", make.distilled),
)


ARCHITECTURE_COLUMNS: tuple[Column, ...] = (
    ("mlp_cql", "MLP, CQL", lambda s, data: make.mlp(s, "cql", data)),
    ("mlp_dqn", "MLP, DQN", lambda s, data: make.mlp(s, "dqn", data)),
    ("mlp_ddqn", "MLP, DDQN", lambda s, data: make.mlp(s, "ddqn", data)),
    ("attentive_cql", "attentive, CQL", lambda s, data: make.attentive(s, "cql", data)),
    ("attentive_dqn", "attentive, DQN", lambda s, data: make.attentive(s, "dqn", data)),
    ("attentive_ddqn", "attentive, DDQN", lambda s, data: make.attentive(s, "ddqn", data)),
)


def offline_table(identity: str, caption: str, columns: tuple[Column, ...]) -> Exhibit:
    """Return a table of offline methods by scenario and dataset."""

    def data(setting: Setting, dataset: Dataset) -> Mix:
        reading: Reading = "lane-3" if dataset == "mixed" else "own"
        return mixture(setting, dataset, reading)

    def of(request: Request, scenario: str, dataset: Dataset, column: Column) -> list[Drive]:
        settings = [request.setting(scenario, seed) for seed in request.seeds]
        agents = [column[2](setting, data(setting, dataset)) for setting in settings]
        return [drive for agent in agents for drive in drives(request, agent, scenario, ("none",))]

    def places() -> list[tuple[str, Dataset]]:
        return [(scenario, dataset) for scenario in PAPER_SCENARIOS for dataset in DATASETS]

    def show(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
        rows: list[tuple[tuple[str, ...], tuple[Entry, ...]]] = []
        for scenario, dataset in places():
            entries: list[Entry] = []
            for column in columns:
                found, why = rows_of(store, of(request, scenario, dataset, column))
                printed = paper_result(identity, column[0], scenario=scenario, dataset=dataset)
                entries.append(entry(found, printed, why))
            rows.append(((scenario, words.DATASETS[dataset]), tuple(entries)))
        names = tuple(label for _, label, _ in columns)
        return [Table(identity, caption, ("scenario", "data"), names, tuple(rows), (words.READING,))]

    return Exhibit(
        identity,
        caption,
        "table",
        lambda request: [cell for place in places() for column in columns for cell in of(request, *place, column)],
        show,
    )


def beta_cells(request: Request, scenario: str, beta: float, attacks: Sequence[str]) -> list[Drive]:
    found: list[Drive] = []
    for seed in request.seeds:
        setting = request.setting(scenario, seed)
        data = mixture(setting, "mixed", "lane-3" if request.recipe == "paper" else "own")
        found += drives(request, make.rapid(setting, data, beta), scenario, attacks)
    return found


def show_beta(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    rows: list[tuple[tuple[str, ...], tuple[Entry, ...]]] = []
    for scenario in PAPER_SCENARIOS:
        for beta in BETAS:
            entries: list[Entry] = []
            for name in ATTACKS:
                found, why = rows_of(store, beta_cells(request, scenario, beta, (name,)))
                entries.append(entry(found, paper_result("beta", name, scenario=scenario, beta=beta), why))
            rows.append(((scenario, f"{beta:g}"), tuple(entries)))
    return [Table("beta", exhibit.caption, ("scenario", "β"), ATTACKS, tuple(rows), (words.sizes(request.recipe),))]


def efficiency_cells(request: Request) -> list[Decide]:
    scenario = PAPER_SCENARIOS[0]
    count = make.EFFORTS[request.scale].decisions
    agents = [make.the_teacher(request.scale), METHODS["rapid"].agent(request.setting(scenario))]
    return [Decide(agent, scenario, count) for agent in agents]


def show_efficiency(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    cells = efficiency_cells(request)
    return [words.efficiency(exhibit.caption, [store.facts(cell) for cell in cells], said(gap_of(store, cells)))]


def mixing_cells(request: Request) -> list[Cell]:
    found = applicable(request, ("rapid", "mixture-of-actions"), PAPER_SCENARIOS, ("none",))
    agents = [METHODS[name].agent(request.setting(PAPER_SCENARIOS[0])) for name in ("rapid", "mixture-of-actions")]
    found += [Decide(agent, PAPER_SCENARIOS[0], make.EFFORTS[request.scale].decisions) for agent in agents]
    found += [agent for agent in agents if isinstance(agent, Adapt)]
    return found


def show_mixing(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    table = comparison("mixing-actions", exhibit.caption, ("rapid", "mixture-of-actions"), attacks=("none",))
    shown = table.show(request, store, exhibit)
    rows: list[tuple[str, ...]] = []
    for name in ("rapid", "mixture-of-actions"):
        agent = METHODS[name].agent(request.setting(PAPER_SCENARIOS[0]))
        gates = [row["gate"] for row in store.metrics(agent) if "gate" in row] if isinstance(agent, Adapt) else []
        seconds = store.facts(Decide(agent, PAPER_SCENARIOS[0], make.EFFORTS[request.scale].decisions))
        rows.append(
            (
                METHODS[name].label,
                words.number(gates[-1]) if gates else "–",
                f"{1e3 * seconds['median_seconds']:.2f} ms" if seconds else "–",
            )
        )
    gap = gap_of(store, [cell for cell in mixing_cells(request) if not isinstance(cell, Drive)])
    heads, notes = ("method", "gate", "one decision"), (said(gap),) if gap else ()
    shown.append(Facts("mixing-cost", "Gate and cost of the two.", heads, tuple(rows), notes))
    return shown


def in_words(build: Callable[[str, str], Sequence[Facts]]) -> Callable[[Request, Store, Exhibit], list[Shown]]:
    return lambda request, store, exhibit: list(build(request.recipe, exhibit.caption))
