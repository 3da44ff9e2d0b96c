"""Methods: what is compared, each as the cells that make it. A method's identity is its id; its label is only shown.

What a method's agent is depends on the recipe, the target scenario, the seed and how much is run.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from rapid.agents.shipped import shipped_agents
from rapid.config import Config, MixConfig, TeacherConfig
from rapid.experiments.cells import Adapt, Data, Distill, Driver, Fresh, Mix, Relabel, Shipped
from rapid.presets import OnlineBaseline, offline_baseline, online_baseline, preset
from rapid.scenarios import PAPER_SCENARIOS, get_scenario

Dataset = Literal["random", "llm", "mixed"]
"""The paper's D_rand, D_LLM and D*, a quarter of which is the teacher's."""
Reading = Literal["lane-3", "own"]
"""Where the data was collected: in lane-3-density-2, as the paper has D* for every scenario, or in the scenario."""


class Effort(NamedTuple):
    """How much a scale runs; None leaves what the recipe has."""

    seeds: int
    spawns: int
    """Test spawns of a policy."""
    reference_spawns: int
    """Test spawns of teachers and planners, which are slow."""
    iterations: int | None
    """Offline gradient steps, for the paper's 10,000; in proportion for its 5,000."""
    steps: int | None
    """Online steps, for the recipe's."""
    transitions: int
    """Collected from a driver where nothing is shipped."""
    curve_spawns: int
    scenes: int
    decisions: int


EFFORTS: dict[str, Effort] = {
    "tiny": Effort(1, 2, 2, 20, 60, 120, 2, 6, 5),
    "quick": Effort(1, 20, 8, 240, 480, 1_000, 8, 6, 50),
    "full": Effort(5, 200, 200, None, None, 15_000, 20, 6, 500),
}
OFFLINE_ITERATIONS = 10_000
"""Gradient steps of the offline tables (paper: section 4.3)."""
CURVE_POINTS = 10
"""Points of a learning curve."""


@dataclass(frozen=True)
class Setting:
    """Where a method is trained and measured."""

    recipe: str
    scale: str
    scenario: str
    seed: int = 0

    @property
    def effort(self) -> Effort:
        """How much is run."""
        return EFFORTS[self.scale]

    def config(self, iterations: int | None = None, plan: str = "") -> Config:
        """Return the recipe's settings in this scenario, with the sizes of the scale.

        `iterations` are those of the paper's experiment; the scale may have fewer.
        """
        config = preset(self.recipe, "full", plan)
        effort, distill, adapt = self.effort, config.distill, config.adapt
        wanted = iterations or distill.iterations
        if effort.iterations is not None:
            wanted = max(2, effort.iterations * wanted // OFFLINE_ITERATIONS)
        distill = replace(distill, iterations=wanted, evaluate_every=max(1, wanted // CURVE_POINTS))
        if effort.steps is not None:
            small = preset(self.recipe, "tiny", plan).adapt
            adapt = replace(
                adapt,
                steps=effort.steps if adapt.steps else 0,
                ppo=small.ppo,
                learning_starts=min(adapt.learning_starts, effort.steps // 4),
            )
        every = max(1, (adapt.steps or adapt.ppo.steps) // CURVE_POINTS)
        # As what is published was trained: compiled layers round otherwise.
        ppo = replace(adapt.ppo, attention="torch")
        adapt = replace(adapt, scenario=self.scenario, evaluate_every=every, ppo=ppo)
        return replace(config, scenario=self.scenario, seed=self.seed, distill=distill, adapt=adapt)


def shipped(scenario: str, source: Literal["teacher", "random", "rule"]) -> Data:
    """Return a shipped dataset, relabelled where the scenario pays for progress."""
    base = get_scenario(scenario)
    data = Shipped(replace(base, reward="normalized").name, source)
    return Relabel(data, base.reward) if base.reward != "normalized" else data


def mixture(setting: Setting, dataset: Dataset = "mixed", reading: Reading = "own") -> Mix:
    """Return the data that a method learns from offline."""
    recipe = preset(setting.recipe, "full").mix
    share = {"random": 0.0, "llm": 1.0, "mixed": recipe.p}[dataset]
    # One source alone has no more than its 15,000 transitions.
    size = recipe.size if dataset == "mixed" else min(recipe.size, 15_000)
    source = PAPER_SCENARIOS[0] if reading == "lane-3" else setting.scenario
    settings = MixConfig(p=share, size=size, level=recipe.level)
    return Mix(shipped(source, "teacher"), shipped(source, "random"), settings, setting.seed)


def _offline(setting: Setting, config: Config, data: Mix) -> Distill:
    return Distill(data, config.network, config.distill, setting.seed, setting.effort.curve_spawns)


def mlp(setting: Setting, algorithm: Literal["dqn", "ddqn", "cql", "bc"], data: Mix) -> Distill:
    """Return a baseline: the 2x256 network by an offline algorithm."""
    return _offline(setting, offline_baseline(setting.config(OFFLINE_ITERATIONS), algorithm), data)


def attentive(setting: Setting, algorithm: Literal["dqn", "ddqn", "cql"], data: Mix) -> Distill:
    """Return RAPID's network without adapters, by an offline algorithm without the robust term."""
    config = setting.config(OFFLINE_ITERATIONS)
    loss = replace(
        config.distill.loss,
        robust_weight=0.0,
        conservative_weight=1.0 if algorithm == "cql" else 0.0,
        double=algorithm in ("ddqn", "cql"),
    )
    network, distill = replace(config.network, kind="attentive"), replace(config.distill, loss=loss)
    return _offline(setting, replace(config, network=network, distill=distill), data)


def distilled(setting: Setting, data: Mix, beta: float | None = None, iterations: int = OFFLINE_ITERATIONS) -> Distill:
    """Return RAPID after phase 2; `beta` is the weight of the robust term, the recipe's where it is None."""
    config = setting.config(iterations)
    if beta is not None:
        loss = replace(config.distill.loss, robust_weight=beta)
        config = replace(config, distill=replace(config.distill, loss=loss))
    return _offline(setting, config, data)


def rapid(setting: Setting, data: Mix, beta: float | None = None, plan: str = "") -> Adapt:
    """Return RAPID after phase 3: the recipe's offline gradient steps (5,000 in the paper), then online."""
    base = setting.config(plan=plan)
    start = distilled(setting, data, beta, preset(setting.recipe, "full").distill.iterations)
    online = data if base.adapt.offline_share else None
    return Adapt(start, online, setting.scenario, base.adapt, setting.seed, setting.effort.curve_spawns)


def robust(setting: Setting) -> Adapt:
    """Return RAPID adapted under attack; on wider roads it is lane-3's agent, as a network for their lanes.

    Going on under attack there made it worse on tuning spawns (docs/log/robustness.md).
    """
    narrow = replace(get_scenario(PAPER_SCENARIOS[0]), reward=get_scenario(setting.scenario).reward).name
    home = replace(setting, scenario=narrow)
    agent = rapid(home, _paper_data(home), plan="robust")
    if setting.scenario == narrow:
        return agent
    settings = replace(agent.settings, scenario=setting.scenario, steps=0, ppo=replace(agent.settings.ppo, steps=0))
    return Adapt(agent, None, setting.scenario, settings, setting.seed)


GUIDED_STEPS = 153_600
"""Environment steps in which a trained agent is shown what to do under attack: 40 rollouts."""


def guided(setting: Setting) -> Adapt:
    """Return RAPID that is shown under attack what to do, after its phase 3 by the plan `ppo`.

    It goes on from the agent of that plan that is shipped for the scenario, where one is: all seeds from the same.
    """
    settings = setting.config(plan="guided").adapt
    steps = GUIDED_STEPS if setting.effort.steps is None else settings.ppo.steps // 2
    settings = replace(
        settings,
        steps=0,
        ppo=replace(settings.ppo, steps=steps, critic_steps=0, attention="compiled"),
        adversary=replace(settings.adversary, begin=0.0, guided=1.0),
        evaluate_every=max(1, steps // CURVE_POINTS),
    )
    shipped_one = f"{setting.scenario}/rapid"
    if shipped_one in shipped_agents():
        origin = Driver(f"shipped:{shipped_one}")
    else:
        origin = rapid(setting, _paper_data(setting), plan="ppo")
    return Adapt(origin, None, setting.scenario, settings, setting.seed, setting.effort.curve_spawns)


def adapted(
    setting: Setting, data: Mix, plan: str = "", train: Literal["adapter", "all", "scratch"] = "adapter"
) -> Adapt:
    """Return RAPID after phase 3 with other weights trained than the adapter's and the gate's."""
    agent = rapid(setting, data, plan=plan)
    return replace(agent, settings=replace(agent.settings, train=train))


def without(setting: Setting, data: Mix, **terms: float) -> Distill:
    """Return RAPID after phase 2 with other weights of the terms of the loss."""
    agent = distilled(setting, data)
    return replace(agent, settings=replace(agent.settings, loss=replace(agent.settings.loss, **terms)))


def mlp_by_ppo(setting: Setting) -> Adapt:
    """Return an MLP with RAPID's budget of the plan `ppo`: Q-learning from new weights, then PPO on all of them."""
    return from_scratch(setting, "munchausen", "ppo")


def mixture_of_actions(setting: Setting, data: Mix) -> Adapt:
    """Return the remark's alternative: MLPs whose actions are mixed, not their policies (paper: section 3.3)."""
    base = setting.config()
    start = distilled(setting, data, iterations=preset(setting.recipe, "full").distill.iterations)
    start = replace(start, network=replace(start.network, kind="mlp-mixture"))
    online = data if base.adapt.offline_share else None
    return Adapt(start, online, setting.scenario, base.adapt, setting.seed, setting.effort.curve_spawns)


def from_scratch(setting: Setting, algorithm: OnlineBaseline, plan: str = "") -> Adapt:
    """Return an MLP that learns online alone, with as many steps as RAPID's phase 3."""
    config = online_baseline(setting.config(plan=plan), algorithm)
    fresh = Fresh(setting.scenario, config.network, setting.seed)
    return Adapt(fresh, None, setting.scenario, config.adapt, setting.seed, setting.effort.curve_spawns)


def the_teacher(scale: str) -> Driver:
    """Return the default teacher; at the scale `tiny` a rule, which needs no model."""
    if scale == "tiny":
        return Driver("rule-forecast")
    return Driver("teacher", TeacherConfig())


@dataclass(frozen=True)
class Method:
    """Something that is compared: an id that never changes, a label that may, and how its agent is made."""

    id: str
    label: str
    kind: Literal["floor", "teacher", "planner", "learned"]
    agent: Callable[[Setting], Distill | Adapt | Driver]
    printed: str = ""
    """What the paper's tables call it."""
    looks: Literal["everything", "presence", "nothing"] = "everything"
    """At what of the observation it looks. Who looks at nothing drives the same under every attack; who reads who is
    present, rounded, the same under gradient attacks, which move presence by less than one half."""

    @property
    def trained(self) -> bool:
        """Whether it has training seeds."""
        return self.kind == "learned"

    def under(self, attack: str) -> str:
        """Return what to drive it under to know what it does under `attack`; empty if it cannot be attacked so.

        Gradient attacks need a network, and nobody attacks what a planner knows.
        """
        noise = attack in ("none", "uniform", "gaussian")
        if self.looks == "nothing" or (self.looks == "presence" and not noise):
            return "none"
        if self.kind in ("teacher", "planner") and attack != "none":
            return ""
        return attack if self.trained or noise else ""


def _driver(
    name: str,
    label: str,
    kind: Literal["floor", "teacher", "planner"] = "floor",
    looks: Literal["everything", "presence", "nothing"] = "everything",
) -> Method:
    return Method(name, label, kind, lambda setting: Driver(name), looks=looks)


FLOORS = (
    _driver("slower", "always slower", looks="nothing"),
    _driver("immune", "immune: slower while any car is seen", looks="presence"),
    _driver("blind", "blind: a fixed plan", looks="nothing"),
    _driver("random", "random", looks="nothing"),
    _driver("rule", "rule"),
)
TEACHER = Method("teacher", "teacher (LLM)", "teacher", lambda setting: the_teacher(setting.scale))
PLANNER = _driver("planner", "planner", "planner")


def _paper_data(setting: Setting) -> Mix:
    """D* as the paper has it: collected in lane-3-density-2 in the recipe `paper`, else in the scenario itself."""
    return mixture(setting, "mixed", "lane-3" if setting.recipe == "paper" else "own")


def _on_rule_data(setting: Setting) -> Distill:
    """RAPID distilled from a rule's driving in place of the teacher's, which is shipped for lane-3-density-2 alone."""
    data = _paper_data(setting)
    return distilled(setting, replace(data, teacher=shipped(PAPER_SCENARIOS[0], "rule")))


METHODS: dict[str, Method] = {
    method.id: method
    for method in (
        *FLOORS,
        TEACHER,
        PLANNER,
        Method("offline-dqn", "offline DQN", "learned", lambda s: mlp(s, "dqn", _paper_data(s)), printed="Offline DQN"),
        Method("offline-ddqn", "offline DDQN", "learned", lambda s: mlp(s, "ddqn", _paper_data(s))),
        Method("cql", "CQL", "learned", lambda s: mlp(s, "cql", _paper_data(s))),
        Method("bc", "behaviour cloning", "learned", lambda s: mlp(s, "bc", _paper_data(s))),
        Method("distilled", "RAPID after phase 2", "learned", lambda s: distilled(s, _paper_data(s))),
        Method("online-dqn", "online DQN", "learned", lambda s: from_scratch(s, "dqn"), printed="Online DQN"),
        Method("online-ddqn", "online DDQN", "learned", lambda s: from_scratch(s, "ddqn")),
        Method("online-ppo", "online PPO", "learned", lambda s: from_scratch(s, "ppo")),
        Method(
            "rapid-without-robust",
            "RAPID without J_robust",
            "learned",
            lambda s: rapid(s, _paper_data(s), beta=0.0),
            printed="RAPID without robust term",
        ),
        Method("rapid", "RAPID", "learned", lambda s: rapid(s, _paper_data(s)), printed="RAPID"),
        Method("rapid-10k", "RAPID, 10K online", "learned", lambda s: rapid(s, _paper_data(s), plan="careful")),
        Method("rapid-ppo", "RAPID, 300K + 700K PPO", "learned", lambda s: rapid(s, _paper_data(s), plan="ppo")),
        Method(
            "rapid-robust",
            "RAPID, adapted under attack",
            "learned",
            robust,
        ),
        Method("rapid-guided", "RAPID, guided under attack", "learned", guided),
        Method("mlp-ppo", "MLP, 300K + 700K PPO", "learned", mlp_by_ppo),
        Method("online-ddqn-10k", "online DDQN, 10K", "learned", lambda s: from_scratch(s, "ddqn", "careful")),
        Method(
            "distilled-without-robust",
            "phase 2 without J_robust",
            "learned",
            lambda s: without(s, _paper_data(s), robust_weight=0.0),
        ),
        Method(
            "distilled-without-cql",
            "phase 2 without CQL",
            "learned",
            lambda s: without(s, _paper_data(s), conservative_weight=0.0),
        ),
        Method(
            "distilled-plain-dqn",
            "phase 2 by plain DQN",
            "learned",
            lambda s: without(s, _paper_data(s), robust_weight=0.0, conservative_weight=0.0),
        ),
        Method("distilled-rule-data", "phase 2 on a rule's data", "learned", _on_rule_data),
        Method(
            "rapid-10k-all",
            "RAPID, 10K, all weights trained",
            "learned",
            lambda s: adapted(s, _paper_data(s), "careful", "all"),
        ),
        Method(
            "rapid-10k-scratch",
            "RAPID, 10K, from new weights",
            "learned",
            lambda s: adapted(s, _paper_data(s), "careful", "scratch"),
        ),
        Method("mixture-of-actions", "mixture of actions", "learned", lambda s: mixture_of_actions(s, _paper_data(s))),
    )
}
"""Methods by their ids."""
