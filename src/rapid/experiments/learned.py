"""How what is compared comes about, as cells: from which data, by which algorithm, going on from what.

It depends on the recipe, the target scenario, the seed and how much is run (:class:`Setting`).
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from rapid.agents.shipped import shipped_agents
from rapid.baselines import OnlineBaseline, offline_baseline, online_baseline
from rapid.config import AdaptConfig, Config, MixConfig, TeacherConfig
from rapid.experiments.cells import Adapt, Data, Distill, Driver, Fresh, Mix, Monitored, Relabel, Shipped
from rapid.presets import preset
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
    agent = rapid(home, paper_data(home), plan="robust")
    if setting.scenario == narrow:
        return agent
    settings = replace(agent.settings, scenario=setting.scenario, steps=0, ppo=replace(agent.settings.ppo, steps=0))
    return Adapt(agent, None, setting.scenario, settings, setting.seed)


GUIDED_STEPS = 153_600
"""Environment steps in which a trained agent is shown what to do under attack: 40 rollouts."""
SQUEEZED_STEPS = 600_000
"""Environment steps in which a trained agent learns by squeezed features, two thirds of them under attack."""


def guided(setting: Setting) -> Adapt:
    """Return RAPID that is shown under attack what to do, after its phase 3 by the plan `ppo`."""
    settings = setting.config(plan="guided").adapt
    settings = replace(settings, adversary=replace(settings.adversary, begin=0.0, guided=1.0))
    return _from_trained(setting, settings, GUIDED_STEPS, critic_steps=0)


def squeezed(setting: Setting) -> Adapt:
    """Return RAPID that learns under attack by squeezed features, after its phase 3 by the plan `ppo`."""
    settings = setting.config(plan="squeezed").adapt
    settings = replace(settings, adversary=replace(settings.adversary, begin=0.35, ramp=0.15))
    return _from_trained(setting, settings, SQUEEZED_STEPS, settings.ppo.critic_steps)


def wary(setting: Setting) -> Adapt:
    """Return the policy that drives once something is wrong, which goes on from that of the plan `ppo`."""
    settings = setting.config(plan="wary").adapt
    return _from_trained(setting, settings, settings.ppo.steps, settings.ppo.critic_steps)


def monitored(setting: Setting) -> Monitored:
    """Return RAPID after its phase 3 by the plan `ppo`, which gives way to the wary one once something is wrong."""
    second = wary(setting)
    assert isinstance(second.origin, Driver | Adapt)
    return Monitored(second.origin, second, setting.scenario)


def _from_trained(setting: Setting, settings: AdaptConfig, steps: int, critic_steps: int) -> Adapt:
    """Return what goes on by PPO from the agent of the plan `ppo`.

    It is the same for all seeds: the one that is shipped for the scenario, or the training with seed 0.
    """
    if setting.effort.steps is not None:
        steps = settings.ppo.steps // 2
    settings = replace(
        settings,
        steps=0,
        ppo=replace(settings.ppo, steps=steps, critic_steps=critic_steps, attention="compiled"),
        evaluate_every=max(1, steps // CURVE_POINTS),
    )
    shipped_one = f"{setting.scenario}/rapid"
    if shipped_one in shipped_agents():
        origin = Driver(f"shipped:{shipped_one}")
    else:
        first = replace(setting, seed=0)
        origin = rapid(first, paper_data(first), plan="ppo")
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


def paper_data(setting: Setting) -> Mix:
    """D* as the paper has it: collected in lane-3-density-2 in the recipe `paper`, else in the scenario itself."""
    return mixture(setting, "mixed", "lane-3" if setting.recipe == "paper" else "own")


def on_rule_data(setting: Setting) -> Distill:
    """RAPID distilled from a rule's driving in place of the teacher's, which is shipped for lane-3-density-2 alone."""
    data = paper_data(setting)
    return distilled(setting, replace(data, teacher=shipped(PAPER_SCENARIOS[0], "rule")))
