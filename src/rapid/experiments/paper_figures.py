"""The paper's figures: teacher under attack, ratio of data, online adaptation, the robust term, routing."""

from collections.abc import Sequence
from typing import Literal

from rapid.config import MixConfig, TeacherConfig
from rapid.experiments import learned as make
from rapid.experiments.cells import Adapt, Cell, Collect, Distill, Drive, Driven, Driver, Mix, Scenes
from rapid.experiments.exhibit import Exhibit, Request, Shown, driven, drives, gap_of, method_drives, rows_of
from rapid.experiments.figures import Curve, Lines, Router, said
from rapid.experiments.learned import OFFLINE_ITERATIONS, Reading, mixture
from rapid.experiments.methods import METHODS
from rapid.experiments.store import Store
from rapid.experiments.tables import Facts, entry
from rapid.scenarios import PAPER_SCENARIOS, get_scenario

NOISE = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Sizes of the growing attack, in normalised features: 1 m to 40 m along the road."""


RATIOS = (0.0, 0.125, 0.25, 0.5, 0.75, 1.0)


def _noise(request: Request, agent: Driven, kind: str, size: float) -> list[Drive]:
    attack = f"{kind}:radius={size:g}" if size else "none"
    spawns = make.EFFORTS[request.scale].reference_spawns
    seed = 0 if isinstance(agent, Driver) else agent.seed
    presence = ",presence=free" if request.recipe == "paper" and size else ""
    return [Drive(agent, PAPER_SCENARIOS[0], attack + presence, spawns, seed=seed)]


def _attacked(request: Request) -> dict[str, list[Driven]]:
    settings = [request.setting(PAPER_SCENARIOS[0], seed) for seed in request.seeds]
    return {
        "teacher": [make.the_teacher(request.scale)],
        "offline DQN": [METHODS["offline-dqn"].agent(setting) for setting in settings],
        "always slower": [Driver("slower")],
    }


def teacher_attack_cells(request: Request, kinds: Sequence[str] = ("uniform", "gaussian")) -> list[Cell]:
    return [
        cell
        for agents in _attacked(request).values()
        for agent in agents
        for kind in kinds
        for size in (0.0, *NOISE)
        for cell in _noise(request, agent, kind, size)
    ]


def show_teacher_attack(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    shown: list[Shown] = []
    for kind in ("uniform", "gaussian"):
        curves: list[Curve] = []
        for label, agents in _attacked(request).items():
            points = [
                (size, driven(store, [cell for agent in agents for cell in _noise(request, agent, kind, size)]))
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
                gap=gap_of(store, teacher_attack_cells(request, (kind,))),
            )
        )
    return shown


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


def ratio_drives(request: Request, algorithm: Literal["ddqn", "cql"], p: float) -> list[Drive]:
    agents = _ratio_agents(request, algorithm, p)
    return [drive for agent in agents for drive in drives(request, agent, RATIO_SCENARIO, ("none",))]


def show_ratio(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    curves = [
        Curve.of_entries(
            algorithm.upper(), [(100 * p, driven(store, ratio_drives(request, algorithm, p))) for p in RATIOS]
        )
        for algorithm in ("ddqn", "cql")
    ]
    gap = gap_of(store, exhibit.cells(request))
    return [Lines("ratio", exhibit.caption, tuple(curves), "share of the teacher's transitions, %", "return", gap=gap)]


def _online_agents(request: Request, scenario: str) -> dict[str, list[Adapt]]:
    settings = [request.setting(scenario, seed) for seed in request.seeds]
    return {
        name: [agent for setting in settings if isinstance(agent := METHODS[name].agent(setting), Adapt)]
        for name in ("rapid", "online-dqn")
    }


def online_cells(request: Request, scenarios: Sequence[str] = PAPER_SCENARIOS) -> list[Cell]:
    found: list[Cell] = []
    for scenario in scenarios:
        for agents in _online_agents(request, scenario).values():
            found += agents
            found += [agent.origin for agent in agents if isinstance(agent.origin, Distill)]
        for name in ("offline-dqn", "teacher"):
            found += method_drives(request, METHODS[name], scenario, ("none",))
    return found


def show_online(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
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
                gap=gap_of(store, online_cells(request, (scenario,))),
            )
        )
    return shown


def robust_agents(request: Request, scenario: str, reading: Reading) -> list[Distill]:
    found: list[Distill] = []
    for seed in request.seeds:
        setting = request.setting(scenario, seed)
        found.append(make.distilled(setting, mixture(setting, "mixed", reading), iterations=OFFLINE_ITERATIONS))
    return found


def show_robust(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    curves = [
        Curve.of_term(
            f"{scenario}, data of {'lane-3-density-2' if reading == 'lane-3' else 'the scenario itself'}",
            [store.metrics(agent) for agent in robust_agents(request, scenario, reading)],
            "robust",
        )
        for scenario, reading in readings()
    ]
    gap = gap_of(store, exhibit.cells(request))
    return [Lines("j-robust", exhibit.caption, tuple(curves), "iterations", "J_robust", gap=gap)]


def readings() -> list[tuple[str, Reading]]:
    return [
        (scenario, reading)
        for scenario in PAPER_SCENARIOS
        for reading in (("own",) if scenario == PAPER_SCENARIOS[0] else ("lane-3", "own"))
    ]


def routing_cell(request: Request) -> Scenes:
    scenario = PAPER_SCENARIOS[1]
    agent = METHODS["rapid"].agent(request.setting(scenario))
    assert isinstance(agent, Adapt)
    return Scenes(agent, scenario, make.EFFORTS[request.scale].scenes)


def show_routing(request: Request, store: Store, exhibit: Exhibit) -> list[Shown]:
    cell = routing_cell(request)
    scenes = store.facts(cell).get("scenes", ())
    whole = [(number, scene) for number, scene in enumerate(scenes, 1) if scene["weights"] is not None]
    gap = gap_of(store, [cell])
    if len(whole) < len(scenes):
        gap = f"{len(scenes) - len(whole)} of {len(scenes)} scenes have no weights"
    if not whole:
        return [Facts("routing", exhibit.caption, ("vehicle", "policy 1", "policy 2"), (), (said(gap),))]
    lanes = get_scenario(PAPER_SCENARIOS[1]).lanes
    return [
        Router(f"routing-{number}", f"{exhibit.caption} Scene {number}.", scene["obs"], scene["weights"], lanes, gap)
        for number, scene in whole
    ]
