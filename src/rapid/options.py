"""What each verb of the command line can be told: one dataclass for each, a docstring at each option.

Options are fields of the settings tree (:mod:`rapid.config`), or stand beside it. This module imports nothing heavy.
"""

from dataclasses import dataclass, field
from typing import Annotated, TypeVar

from tyro.conf import Positional, arg

from rapid.bounds import Bounds, Positive, Seed, SideOrNone
from rapid.config import CollectConfig, Config, EvaluateConfig, MixConfig, Plan, Recipe, Scale, TeacherConfig
from rapid.config_learning import AdaptConfig, DistillConfig, NetworkConfig
from rapid.scenarios import Reward
from rapid.tracking import Tracking

T = TypeVar("T")

# A section of the tree whose options stand at the top level: `--p`, not `--mix.p`.
Flat = Annotated[T, arg(name="")]
SettingsFile = Annotated[str, arg(name="config", metavar="FILE.toml")]


@dataclass(frozen=True)
class Source:
    """Where the defaults of a verb's settings come from."""

    recipe: Recipe = Config.recipe
    """Defaults of the settings."""
    scale: Scale = Config.scale
    """Defaults of the sizes."""
    plan: Plan = Config.plan
    """Defaults of phase 3."""
    file: SettingsFile = ""
    """Settings in a TOML file; options override it, it overrides recipe and scale."""


@dataclass(frozen=True)
class Run:
    """Do everything, in one directory: collect, mix, distill, adapt, evaluate, report.

    The same command goes on after an interruption.
    """

    settings: Flat[Config] = field(default_factory=Config)
    file: SettingsFile = ""
    """Settings in a TOML file; options override it, it overrides recipe and scale."""
    directory: str = ""
    """Where the run lives; by default runs/SCENARIO-RECIPE-SCALE-seedN, with a hash of other settings behind it."""
    restart: Annotated[str, arg(name="from", metavar="STEP")] = ""
    """Redo this step and all later ones: collect, mix, distill, adapt, evaluate or report."""
    force: bool = False
    """Begin anew where a run with other settings is, and remove what that made."""


@dataclass(frozen=True)
class Collect:
    """Let a teacher drive and keep every step as an offline dataset.

    The same command goes on after an interruption, and with a larger budget or more transitions. --workers n divides
    the work among n processes, or with --engine ray among the machines of a Ray cluster. With --teacher.backend
    scripted --teacher.model random it makes the random data of a mixture, of --random-transitions transitions.
    """

    collect: Flat[CollectConfig] = field(default_factory=CollectConfig)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    out: str = ""
    """Directory of the dataset; by default data/teacher, or data/random of the random driver, or a directory with a
    hash beside it if that was collected with other settings."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    scenario: str = Config.scenario
    """Where the teacher drives."""
    seed: Seed = Config.seed
    """Decides the random driver's actions; the traffic is fixed by the spawn seeds."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Relabel:
    """Give a collected dataset the scenario's other reward: its episodes are driven again, action by action."""

    dataset: Annotated[Positional[str], arg(metavar="DATASET")]
    """Directory of the dataset as it was collected, or a shipped set such as shipped:lane-3-density-2/teacher."""
    reward: Reward = "progress"
    """The reward that is wanted; `progress` counts distance and not crashing alone."""
    out: str = ""
    """Directory of the dataset with these rewards; by default data/relabelled, or data/relabelled-HASH
    beside it if another command made that."""
    force: bool = False
    """Replace what another command made in the place of the output."""


@dataclass(frozen=True)
class Mix:
    """Mix a teacher's and a random dataset into one, transition by transition."""

    teacher_data: Annotated[Positional[str], arg(metavar="TEACHER_DATA")]
    """Directory of the teacher's dataset."""
    random_data: Annotated[Positional[str], arg(metavar="RANDOM_DATA")]
    """Directory of the random dataset."""
    mix: Flat[MixConfig] = field(default_factory=MixConfig)
    out: str = ""
    """Directory of the mixture; by default data/mixed, or data/mixed-HASH
    beside it if another command made that."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    seed: Seed = Config.seed
    """Decides which transitions are drawn."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Distill:
    """Phase 2: train a policy offline on a dataset, with the robust term."""

    dataset: Annotated[Positional[str], arg(metavar="DATASET")]
    """Directory of the dataset."""
    distill: Flat[DistillConfig] = field(default_factory=DistillConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    out: str = ""
    """Directory of the agent and its training record; by default distilled, or distilled-HASH
    beside it if another command made that."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    curve_spawns: SideOrNone = EvaluateConfig.curve_spawns
    """Episodes of each point of the learning curve."""
    tracking: Tracking = Config.tracking
    """Where the metrics are copied to; offline unless WANDB_MODE says otherwise."""
    seed: Seed = Config.seed
    """Decides the weights, the batches and the inner attack."""
    seeds: Annotated[int, Bounds(1, 1000)] = 1
    """Train this many agents, of the seeds from --seed on, into OUT/seed-N. Baselines (kind mlp, neither robust nor
    Munchausen term) train together as one stack in less than half the time, with one record for all in OUT/together;
    others one after another, where a process for each seed is faster."""
    device: str = Config.device
    """Torch device; on a CUDA device a gradient step is recorded once and replayed."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Adapt:
    """Phase 3: let an agent learn online in the target scenario, its distilled policy frozen."""

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent."""
    adapt: Flat[AdaptConfig] = field(default_factory=AdaptConfig)
    dataset: str = ""
    """Offline dataset: for --offline-share, which is 0 without it, and to measure what is forgotten."""
    out: str = ""
    """Directory of the adapted agent and its training record; by default adapted, or adapted-HASH
    beside it if another command made that."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    curve_spawns: SideOrNone = EvaluateConfig.curve_spawns
    """Episodes of each point of the learning curve."""
    tracking: Tracking = Config.tracking
    """Where the metrics are copied to; offline unless WANDB_MODE says otherwise."""
    seed: Seed = Config.seed
    """Decides the traffic, the exploration and the batches."""
    device: str = Config.device
    """Torch device; on a CUDA device a gradient step of Q-learning is recorded once and replayed."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Evaluate:
    """Compare agents over the same fixed spawns, clean and under attacks, in one table, one plot and one page."""

    agents: Annotated[Positional[tuple[str, ...]], arg(metavar="AGENT ...")]
    """Directories of agents, ONNX files, and drivers by name, each with shield:BOX: before it if it is to drive behind
    the interval filter (shield:0.1:slower): slower, idle, faster, random, rule, rule-forecast, rule-foresight,
    uniform-safe, immune, blind, planner, planner-cars, planner-observation, teacher (the one of --config). A defence
    without training goes before those with Q-values (smooth:3:AGENT; docs/defences.md)."""
    evaluate: Flat[EvaluateConfig] = field(default_factory=EvaluateConfig)
    scenario: str = ""
    """Where they drive; by default where the saved agents were trained, else in lane-3-density-2."""
    simulator: Annotated[str, arg(metavar="{compiled,highway-env}")] = Config.simulator
    """The compiled twin, or highway-env itself."""
    out: str = ""
    """Directory of the episodes, the table, the plot and the page, where the same command goes on after an
    interruption; without it the table is printed and nothing is kept."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    seed: Seed = Config.seed
    """Decides the noise of attacks and the random driver; the traffic is fixed by the spawn seeds."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Adversary:
    """Train an adversary against one agent: it learns which of the actions in reach costs that agent most.

    It is saved like an agent and named among attacks: rapid evaluate AGENT --attacks adversary:OUT.
    """

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent, which stays as it is."""
    scenario: str = ""
    """Where it is attacked; by default where the agent was trained."""
    attack: str = "adversary"
    """The ball and the search in it, such as adversary:radius=0.05,ego=trusted (docs/attacks.md)."""
    steps: Positive = EvaluateConfig.adversary_steps
    """Decisions to learn from."""
    out: str = ""
    """Directory of the adversary; by default adversary, or adversary-HASH
    beside it if another command made that."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    seed: Seed = Config.seed
    """Decides traffic, exploration, weights and batches."""
