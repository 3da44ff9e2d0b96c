"""Exhibits: every table and figure of the paper, and ours, as the cells that they need and how they are shown."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from rapid.config import MixConfig, TeacherConfig
from rapid.evaluation.metrics import EpisodeRow
from rapid.experiments import methods as make
from rapid.experiments import words
from rapid.experiments.cells import Adapt, Cell, Collect, Decide, Distill, Drive, Driver, Mix, Scenes, key
from rapid.experiments.figures import Curve, Lines, Router
from rapid.experiments.methods import METHODS, OFFLINE_ITERATIONS, Dataset, Method, Reading, Setting, mixture
from rapid.experiments.migrate import Legacy
from rapid.experiments.paper import paper_result
from rapid.experiments.store import Store
from rapid.experiments.tables import Entry, Facts, Table, entry
from rapid.scenarios import PAPER_SCENARIOS, get_scenario

Shown = Table | Facts | Lines | Router
ATTACKS = ("none", "uniform", "gaussian", "fgsm", "pgd")
NOISE = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Sizes of the growing attack, in normalised features: 1 m to 40 m along the road."""
RATIOS = (0.0, 0.125, 0.25, 0.5, 0.75, 1.0)
BETAS = (0.0, 0.1, 0.5, 0.8)
DATASETS: tuple[Dataset, ...] = ("random", "llm", "mixed")


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
        """Return an attack's text: the recipe `paper` lets presence be attacked (docs/deviations.md)."""
        return f"{name}:presence=free" if self.recipe == "paper" and name != "none" else name


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


def drives(request: Request, agent: Distill | Adapt | Driver, scenario: str, attacks: Sequence[str]) -> list[Drive]:
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
    """Return the episodes of some cells and why any is missing; committed rows of before there were cells stand in."""
    found: list[EpisodeRow] = []
    missing = 0
    for cell in cells:
        if store.is_done(cell):
            found += store.rows(cell)
        else:
            missing += 1
    if missing and legacy and (old := store.legacy(legacy)):
        return old, ""  # never mixed with new ones
    return found, f"{missing} of {len(cells)} parts are missing" if missing else ""


def grid(request: Request, store: Store, scenario: str, method: Method, attacks: Sequence[str]) -> tuple[Entry, ...]:
    """Return one row of a table: a method in a scenario under each attack, beside the paper's numbers."""
    entries: list[Entry] = []
    for name in attacks:
        applicable = method.trained or not method.looks or name in ("none", "uniform", "gaussian")
        driven = name if method.looks else "none"
        cells = method_drives(request, method, scenario, (driven,)) if applicable else []
        old = Legacy(request.recipe, method.id, scenario, driven) if request.scale == "full" else None
        rows, why = rows_of(store, cells, old)
        said = paper_result("attack", name, scenario=scenario, method=method.printed) if method.printed else None
        entries.append(entry(rows, said, why if applicable else "needs a network"))
    return tuple(entries)


def _applicable(request: Request, ids: Sequence[str], scenarios: Sequence[str], attacks: Sequence[str]) -> list[Cell]:
    found: list[Cell] = []
    for scenario in scenarios:
        for method in map(METHODS.__getitem__, ids):
            usable = (
                attacks if method.trained else [name for name in attacks if name in ("none", "uniform", "gaussian")]
            )
            usable = ["none"] if method.kind in ("teacher", "planner") or not method.looks else usable
            found += method_drives(request, method, scenario, usable)
    return found


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
        lambda request: _applicable(request, ids, scenarios, attacks),
        show,
        recipes,
        of_paper,
    )


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


def _beta_cells(request: Request, scenario: str, beta: float, attacks: Sequence[str]) -> list[Drive]:
    found: list[Drive] = []
    for seed in request.seeds:
        setting = request.setting(scenario, seed)
        data = mixture(setting, "mixed", "lane-3" if request.recipe == "paper" else "own")
        found += drives(request, make.rapid(setting, data, beta), scenario, attacks)
    return found


def _show_beta(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    rows: list[tuple[tuple[str, ...], tuple[Entry, ...]]] = []
    for scenario in PAPER_SCENARIOS:
        for beta in BETAS:
            entries: list[Entry] = []
            for name in ATTACKS:
                found, why = rows_of(store, _beta_cells(request, scenario, beta, (name,)))
                entries.append(entry(found, paper_result("beta", name, scenario=scenario, beta=beta), why))
            rows.append(((scenario, f"{beta:g}"), tuple(entries)))
    return [Table("beta", exhibit.caption, ("scenario", "β"), ATTACKS, tuple(rows), (words.sizes(request.recipe),))]


def _noise(request: Request, agent: Distill | Adapt | Driver, kind: str, size: float) -> list[Drive]:
    attack = f"{kind}:radius={size:g}" if size else "none"
    spawns = make.EFFORTS[request.scale].reference_spawns
    seed = 0 if isinstance(agent, Driver) else agent.seed
    presence = ",presence=free" if request.recipe == "paper" and size else ""
    return [Drive(agent, PAPER_SCENARIOS[0], attack + presence, spawns, seed=seed)]


def _attacked(request: Request) -> dict[str, list[Distill | Adapt | Driver]]:
    settings = [request.setting(PAPER_SCENARIOS[0], seed) for seed in request.seeds]
    return {
        "teacher": [make.the_teacher(request.scale)],
        "offline DQN": [METHODS["offline-dqn"].agent(setting) for setting in settings],
        "always slower": [Driver("slower")],
    }


def _teacher_attack_cells(request: Request) -> list[Cell]:
    return [
        cell
        for agents in _attacked(request).values()
        for agent in agents
        for kind in ("uniform", "gaussian")
        for size in (0.0, *NOISE)
        for cell in _noise(request, agent, kind, size)
    ]


def _show_teacher_attack(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    shown: list[Shown] = []
    for kind in ("uniform", "gaussian"):
        curves: list[Curve] = []
        for label, agents in _attacked(request).items():
            points = [
                (size, _driven(store, [cell for agent in agents for cell in _noise(request, agent, kind, size)]))
                for size in (0.0, *NOISE)
            ]
            curves.append(Curve.of_entries(label, points))
        shown.append(
            Lines(
                f"teacher-attack-{kind}",
                f"{exhibit.caption} ({kind} noise)",
                tuple(curves),
                "size of the noise (1 is 200 m along the road)",
                "return",
            )
        )
    return shown


def _driven(store: Store, cells: Sequence[Drive]) -> Entry:
    rows, why = rows_of(store, cells)
    return entry(rows, failed=why)


RATIO_SCENARIO = "lane-3-density-2-fast"


def _ratio_agents(request: Request, algorithm: Literal["ddqn", "cql"], p: float) -> list[Distill]:
    effort = make.EFFORTS[request.scale]
    teacher = TeacherConfig(backend="scripted", model="rule-forecast") if request.scale == "tiny" else TeacherConfig()
    random = TeacherConfig(backend="scripted", model="random")
    found: list[Distill] = []
    for seed in request.seeds:
        setting = request.setting(RATIO_SCENARIO, seed)
        driven, uniform = (Collect(RATIO_SCENARIO, driver, effort.transitions) for driver in (teacher, random))
        data = Mix(driven, uniform, MixConfig(p=p, size=effort.transitions), seed)
        found.append(make.mlp(setting, algorithm, data))
    return found


def _ratio_drives(request: Request, algorithm: Literal["ddqn", "cql"], p: float) -> list[Drive]:
    agents = _ratio_agents(request, algorithm, p)
    return [drive for agent in agents for drive in drives(request, agent, RATIO_SCENARIO, ("none",))]


def _show_ratio(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    curves = [
        Curve.of_entries(
            algorithm.upper(), [(100 * p, _driven(store, _ratio_drives(request, algorithm, p))) for p in RATIOS]
        )
        for algorithm in ("ddqn", "cql")
    ]
    return [Lines("ratio", exhibit.caption, tuple(curves), "share of the teacher's transitions, %", "return")]


def _online_agents(request: Request, scenario: str) -> dict[str, list[Adapt]]:
    settings = [request.setting(scenario, seed) for seed in request.seeds]
    return {
        name: [agent for setting in settings if isinstance(agent := METHODS[name].agent(setting), Adapt)]
        for name in ("rapid", "online-dqn")
    }


def _online_cells(request: Request) -> list[Cell]:
    found: list[Cell] = []
    for scenario in PAPER_SCENARIOS:
        for agents in _online_agents(request, scenario).values():
            found += agents
            found += [agent.origin for agent in agents if isinstance(agent.origin, Distill)]
        for name in ("offline-dqn", "teacher"):
            found += method_drives(request, METHODS[name], scenario, ("none",))
    return found


def _show_online(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    shown: list[Shown] = []
    for scenario in PAPER_SCENARIOS:
        agents = _online_agents(request, scenario)
        before = max(
            (agent.origin.settings.iterations for agent in agents["rapid"] if isinstance(agent.origin, Distill)),
            default=0,
        )
        curves = [
            Curve.of_metrics(
                METHODS[name].label,
                [
                    (store.metrics(agent.origin) if isinstance(agent.origin, Distill) else [], store.metrics(agent))
                    for agent in agents[name]
                ],
                before,
            )
            for name in agents
        ]
        for name in ("offline-dqn", "teacher"):
            rows, _ = rows_of(store, method_drives(request, METHODS[name], scenario, ("none",)))
            if rows:
                curves.append(Curve.level(METHODS[name].label, entry(rows)))
        shown.append(
            Lines(
                f"online-{get_scenario(scenario).lanes}",
                f"{exhibit.caption} {scenario}: {before} offline iterations, then online steps.",
                tuple(curves),
                "iterations offline, then steps online",
                "return on tuning spawns",
                mark=before,
            )
        )
    return shown


def _robust_agents(request: Request, scenario: str, reading: Reading) -> list[Distill]:
    found: list[Distill] = []
    for seed in request.seeds:
        setting = request.setting(scenario, seed)
        found.append(make.distilled(setting, mixture(setting, "mixed", reading), iterations=OFFLINE_ITERATIONS))
    return found


def _show_robust(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    curves = [
        Curve.of_term(
            f"{scenario}, data of {'lane-3-density-2' if reading == 'lane-3' else 'the scenario itself'}",
            [store.metrics(agent) for agent in _robust_agents(request, scenario, reading)],
            "robust",
        )
        for scenario, reading in _readings()
    ]
    return [Lines("j-robust", exhibit.caption, tuple(curves), "iterations", "J_robust")]


def _readings() -> list[tuple[str, Reading]]:
    return [
        (scenario, reading)
        for scenario in PAPER_SCENARIOS
        for reading in (("own",) if scenario == PAPER_SCENARIOS[0] else ("lane-3", "own"))
    ]


def _routing_cell(request: Request) -> Scenes:
    scenario = PAPER_SCENARIOS[1]
    agent = METHODS["rapid"].agent(request.setting(scenario))
    assert isinstance(agent, Adapt)
    return Scenes(agent, scenario, make.EFFORTS[request.scale].scenes)


def _show_routing(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    facts = store.facts(_routing_cell(request))
    lanes = get_scenario(PAPER_SCENARIOS[1]).lanes
    return [
        Router(f"routing-{number}", f"{exhibit.caption} Scene {number}.", scene["obs"], scene["weights"], lanes)
        for number, scene in enumerate(facts.get("scenes", ()), 1)
        if scene["weights"] is not None
    ]


def _efficiency_cells(request: Request) -> list[Decide]:
    scenario = PAPER_SCENARIOS[0]
    count = make.EFFORTS[request.scale].decisions
    agents = [make.the_teacher(request.scale), METHODS["rapid"].agent(request.setting(scenario))]
    return [Decide(agent, scenario, count) for agent in agents]


def _show_efficiency(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    return [words.efficiency(exhibit.caption, [store.facts(cell) for cell in _efficiency_cells(request)])]


def _mixing_cells(request: Request) -> list[Cell]:
    found = _applicable(request, ("rapid", "mixture-of-actions"), PAPER_SCENARIOS, ("none",))
    agents = [METHODS[name].agent(request.setting(PAPER_SCENARIOS[0])) for name in ("rapid", "mixture-of-actions")]
    found += [Decide(agent, PAPER_SCENARIOS[0], make.EFFORTS[request.scale].decisions) for agent in agents]
    found += [agent for agent in agents if isinstance(agent, Adapt)]
    return found


def _show_mixing(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
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
    shown.append(Facts("mixing-cost", "Gate and cost of the two.", ("method", "gate", "one decision"), tuple(rows)))
    return shown


def _words(build: Callable[[str, str], Sequence[Facts]]) -> Callable[[Request, Store, Exhibit], list[Shown]]:
    return lambda request, store, exhibit: list(build(request.recipe, exhibit.caption))


ALL: dict[str, Exhibit] = {
    exhibit.id: exhibit
    for exhibit in (
        Exhibit(
            "teacher-attack",
            "Return of the teacher and of offline DQN on lane-3-density-2 while noise on the observation grows.",
            "figure",
            _teacher_attack_cells,
            _show_teacher_attack,
        ),
        Exhibit(
            "ratio",
            "Return of DDQN and CQL by the share p of the teacher's transitions, with highway-fast dynamics.",
            "figure",
            lambda request: [
                drive for name in ("ddqn", "cql") for p in RATIOS for drive in _ratio_drives(request, name, p)
            ],
            _show_ratio,
        ),
        offline_table("offline", "Return after phase 2, by scenario, dataset and method.", OFFLINE_COLUMNS),
        Exhibit("online", "Return while adapting online, in", "figure", _online_cells, _show_online),
        comparison(
            "attack",
            "Return under attacks on the observation.",
            ("online-dqn", "offline-dqn", "rapid-without-robust", "rapid", "slower", "immune", "blind"),
            of_paper=True,
        ),
        Exhibit(
            "routing",
            "What policy 1 and the adapter contribute to each vehicle on lane-4-density-2.5.",
            "figure",
            lambda request: [_routing_cell(request)],
            _show_routing,
        ),
        offline_table(
            "architecture", "Return of the MLP and of RAPID's network, each by three algorithms.", ARCHITECTURE_COLUMNS
        ),
        Exhibit(
            "j-robust",
            "The robust term while distilling with D*, in three scenarios and both readings of the data.",
            "figure",
            lambda request: [agent for place in _readings() for agent in _robust_agents(request, *place)],
            _show_robust,
        ),
        Exhibit(
            "beta",
            "Return of RAPID under attack, by the weight β of the robust term.",
            "table",
            lambda request: [
                cell
                for scenario in PAPER_SCENARIOS
                for beta in BETAS
                for cell in _beta_cells(request, scenario, beta, ATTACKS)
            ],
            _show_beta,
        ),
        Exhibit(
            "mixing-actions",
            "A mixture of policies against a mixture of actions: return, gate and cost.",
            "table",
            _mixing_cells,
            _show_mixing,
        ),
        Exhibit(
            "prompt",
            "The prefix prompt and one interaction of the teacher.",
            "text",
            lambda request: [],
            _words(words.prompt),
        ),
        Exhibit(
            "efficiency",
            "Seconds for one decision on this machine: the teacher and the policy.",
            "table",
            lambda request: list(_efficiency_cells(request)),
            _show_efficiency,
        ),
        Exhibit(
            "environment",
            "The environment's configuration.",
            "table",
            lambda request: [],
            _words(words.environment),
        ),
        Exhibit(
            "hyperparameters",
            "Hyperparameters of the offline methods.",
            "table",
            lambda request: [],
            _words(words.hyperparameters),
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
                *("slower", "immune", "blind", "teacher", "offline-dqn", "offline-ddqn", "cql", "bc", "distilled"),
                *("online-ddqn-10k", "online-ppo", "mlp-ppo", "rapid-10k", "rapid-ppo", "rapid-robust"),
            ),
            recipes=("strong",),
        ),
        comparison(
            "progress",
            "RAPID and the floors under the reward `progress`.",
            ("slower", "immune", "blind", "teacher", "distilled", "online-ppo", "rapid-10k", "rapid-ppo"),
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
    )
}
"""Every exhibit by its id, in the order of the paper, then ours."""


def recipe_of(exhibit: Exhibit, wanted: str) -> str:
    """Return the recipe that an exhibit has: the one wanted, else its first."""
    return wanted if wanted in exhibit.recipes else exhibit.recipes[0]


def cells_of(exhibit: Exhibit, recipe: str, scale: str) -> list[Cell]:
    """Return the cells that an exhibit needs, each once."""
    return list({key(cell): cell for cell in exhibit.cells(Request(recipe, scale))}.values())
