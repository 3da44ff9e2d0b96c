"""What each verb of the command line can be told: one dataclass for each, a docstring at each option.

Options are fields of the settings tree (:mod:`rapid.config`), or stand beside it. This module imports nothing heavy.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeVar

from tyro.conf import Positional, arg

from rapid.bounds import Bounds, Count, Positive, Seed
from rapid.config import (
    AdaptConfig,
    CollectConfig,
    Config,
    DistillConfig,
    EvaluateConfig,
    MixConfig,
    NetworkConfig,
    Plan,
    Recipe,
    Scale,
    TeacherConfig,
)
from rapid.scenarios import PAPER_SCENARIOS, Reward
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


@dataclass(frozen=True)
class Collect:
    """Let a teacher drive and keep every step as an offline dataset.

    The same command goes on after an interruption, and with a larger budget or more transitions. --workers n divides
    the work among n processes, or with --engine ray among the machines of a Ray cluster. With --teacher.backend
    scripted --teacher.model random it makes the random data of a mixture, of --random-transitions transitions.
    """

    collect: Flat[CollectConfig] = field(default_factory=CollectConfig)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    out: str = "data/teacher"
    """Directory of the dataset."""
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
    curve_spawns: Count = EvaluateConfig.curve_spawns
    """Episodes of each point of the learning curve."""
    tracking: Tracking = Config.tracking
    """Where the metrics are copied to; offline unless WANDB_MODE says otherwise."""
    seed: Seed = Config.seed
    """Decides the weights, the batches and the inner attack."""
    seeds: Positive = 1
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
    curve_spawns: Count = EvaluateConfig.curve_spawns
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
    """Compare agents over the same fixed spawns, clean and under attacks, in one table and one plot."""

    agents: Annotated[Positional[tuple[str, ...]], arg(metavar="AGENT ...")]
    """Directories of agents, ONNX files, and drivers by name, each with shield:BOX: before it if it is to drive behind
    the interval filter (shield:0.1:slower): slower, idle, faster, random, rule, rule-forecast, rule-foresight,
    uniform-safe, immune, blind, planner, planner-cars, planner-observation, teacher (the one of --config)."""
    evaluate: Flat[EvaluateConfig] = field(default_factory=EvaluateConfig)
    scenario: str = ""
    """Where they drive; by default where the saved agents were trained, else in lane-3-density-2."""
    simulator: Annotated[str, arg(metavar="{compiled,highway-env}")] = Config.simulator
    """The compiled twin, or highway-env itself."""
    out: str = ""
    """Directory of the episodes, the table and the plot; by default evaluation, or evaluation-HASH
    beside it if another command made that."""
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
    scenario: str = Config.scenario
    """Where it is attacked."""
    attack: str = "adversary"
    """The ball and the search in it, such as adversary:radius=0.05,ego=trusted (docs/attacks.md)."""
    steps: Annotated[int, arg(metavar="INT")] = EvaluateConfig.adversary_steps
    """Decisions to learn from."""
    out: str = ""
    """Directory of the adversary; by default adversary, or adversary-HASH
    beside it if another command made that."""
    force: bool = False
    """Replace what another command made in the place of the output."""
    seed: Seed = Config.seed
    """Decides traffic, exploration, weights and batches."""


@dataclass(frozen=True)
class TeachBench:
    """Compare teachers, models and prompt styles on the same spawns: what each is worth, what each costs.

    The same command goes on after an interruption; with one more teacher it drives that one only.
    """

    teachers: Annotated[Positional[tuple[str, ...]], arg(metavar="TEACHER ...")]
    """Scripted drivers (rule, rule-forecast, slower, random, ..., planner), embedded models with a style
    (smollm2-135m:digest, smollm2-135m:react, and as a control smollm2-135m:digest:shuffled), or TOML files with a
    [teacher] section, for servers and recordings. The others are compared with the first."""
    scenarios: Annotated[tuple[str, ...], arg(name="scenario")] = PAPER_SCENARIOS
    """Where they drive; by default the paper's three."""
    spawns: Positive = 32
    """Episodes of each teacher in each scenario."""
    spawn_set: Literal["tune", "test"] = "tune"
    """Where the spawn seeds come from: `tune` to choose a teacher, `test` to report one that was chosen elsewhere."""
    lockstep: Positive = 64
    """Episodes driven side by side: a `local` model answers all of them together."""
    out: str = "teach-bench"
    """Directory of the rows, the table and the plot."""
    simulator: Annotated[str, arg(metavar="{compiled,highway-env}")] = Config.simulator
    """The compiled twin, or highway-env itself."""
    seed: Seed = Config.seed
    """Decides the random drivers and the shuffled facts; the traffic is fixed by the spawn seeds."""


@dataclass(frozen=True)
class Certify:
    """Prove what no attack within a radius can do: change a decision, make it unsafe, lower the return further.

    Sound bounds through the network as it was trained, not an attack: what is not proven need not be false. For agents
    with a network and no memory; attacks leave presence alone.
    """

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent, perhaps behind shield:BOX:."""
    radii: tuple[float, ...] = (0.0005, 0.001, 0.005)
    """Radii of the attacks (L-infinity, features scaled to +-1: 0.0005 is 0.1 m along the road and 0.04 m/s)."""
    decisions: Positive = 100
    """Decisions that are certified for each radius. A perceptron's take milliseconds, a mixture's about a second."""
    spawns: Positive = 20
    """Test spawns, on the way through which the agent decides."""
    returns: Count = 0
    """Of how many of them the return is bounded too, by the tree of all actions that an attack may bring about."""
    scenario: str = ""
    """Where it drives; by default where it was trained."""
    out: str = "certificate"
    """Directory of the table and the numbers."""


@dataclass(frozen=True)
class Export:
    """Write an agent as ONNX, compare the two on real observations, and time a decision."""

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent; with shield:BOX: before it, the interval filter becomes part of the model."""
    out: str = ""
    """The file; by default AGENT.onnx, beside the agent's directory."""
    force: bool = False
    """Replace another file in its place."""
    dataset: str = ""
    """Dataset whose observations are compared; without it, those that the agent meets on 32 test spawns."""


@dataclass(frozen=True)
class Import:
    """Make an ONNX agent of a model that stable-baselines3 saved (MlpPolicy of DQN, PPO or A2C) and compare the two."""

    model: Annotated[Positional[str], arg(metavar="MODEL.zip")]
    """The file that model.save() wrote; its weights are read as tensors, nothing in it is run."""
    trained_on: str = "highway-fast-v0"
    """The scenario, or HighwayEnv's id, whose observations the model reads."""
    out: str = ""
    """The file; by default MODEL.onnx, beside the model."""


@dataclass(frozen=True)
class Report:
    """Write the page of a run again."""

    directory: Annotated[Positional[str], arg(metavar="DIRECTORY")]
    """Directory of the run."""


@dataclass(frozen=True)
class Reproduce:
    """Compute tables and figures of the paper and ours, beside what the paper prints; without an id list them.

    The same command goes on after an interruption; what is done is never computed again.
    """

    ids: Annotated[Positional[tuple[str, ...]], arg(metavar="ID ...")] = ()
    """Such as attack, offline or ratio; `all` is every one."""
    recipe: Recipe = "paper"
    """How things are trained."""
    scale: Scale = Config.scale
    """How much is run: tiny (minutes), quick, full (five trainings, 200 spawns)."""
    engine: Annotated[str, arg(metavar="{local,ray}")] = CollectConfig.engine
    """Where parts are computed."""
    workers: Positive = 1
    """Parts under way at once."""
    store: str = "runs/store"
    """Directory of finished parts."""
    layers: tuple[str, ...] = ()
    """Directories of small results that are only read; results/cells is one wherever it is there."""
    out: str = ""
    """Directory of the page; by default runs/reproduce/RECIPE-SCALE."""
    export: str = ""
    """Also write the small results to this directory, as a layer for other checkouts."""
    dry_run: bool = False
    """Only say what is done and what is to do."""
    page_only: bool = False
    """Compute nothing: write the page of what is there."""
    readme: bool = False
    """Only fill the marked blocks of README.md and docs/ in this checkout from the committed rows."""
    check: bool = False
    """Only say whether those blocks are what the committed rows say."""


@dataclass(frozen=True)
class Play:
    """Open a live page: agents, teachers, planners and you drive side by side on the same spawn, attacked or not.

    The page is for this machine only, behind a secret in its address; Ctrl-C ends it.
    """

    agents: Annotated[Positional[tuple[str, ...]], arg(metavar="AGENT ...")] = ()
    """Directories of agents, ONNX files or drivers by name; the first two are on the road when the page opens. Saved
    agents below ./runs, the scripted drivers, the planners, the teacher and `you` can be chosen there."""
    scenario: str = ""
    """Where they drive; by default where the first agent was trained."""
    spawn: Seed = 900_000
    """The spawn seed, which fixes the traffic; test spawns begin at 900000."""
    moment: str = ""
    """What a link of the page has behind its #: the same moment again, with the same drivers."""
    port: Annotated[int, Bounds(0, 65535)] = 0
    """Where the page is served; 0 takes a free port."""
    browser: bool = True
    """Whether a browser is asked to open the page; --no-browser prints its address only."""
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    """Who `teacher` is."""
    seed: Seed = Config.seed
    """Decides the noise of attacks and the drivers that draw."""
    source: Flat[Source] = field(default_factory=Source)


@dataclass(frozen=True)
class Presets:
    """Print what a recipe, a scale and a plan set; with a second one, only where the two differ."""

    first: Annotated[Positional[str], arg(metavar="RECIPE[/SCALE[/PLAN]]")] = ""
    """Such as strong, strong/full or strong/full/ppo; nothing lists what there is."""
    second: Annotated[Positional[str], arg(metavar="RECIPE[/SCALE[/PLAN]]")] = ""
    """What the first is compared with."""


@dataclass(frozen=True)
class Agents:
    """List the trained agents that come with the package, or show the card of one."""

    action: Annotated[Positional[str], arg(metavar="ACTION")] = "list"
    """list, or show."""
    name: Annotated[Positional[str], arg(metavar="NAME")] = ""
    """Such as lane-3-density-2/rapid; not needed to list."""


@dataclass(frozen=True)
class Models:
    """List the embedded language models, fetch one, verify it, or remove it."""

    action: Annotated[Positional[str], arg(metavar="ACTION")] = "list"
    """list, pull, verify or remove."""
    name: Annotated[Positional[str], arg(metavar="NAME")] = ""
    """The model; not needed to list."""


@dataclass(frozen=True)
class VerifySimulator:
    """Hold the compiled simulator against the installed highway-env, step by step, and give a verdict."""

    episodes: Positive = 12
    """Episodes in all, shared among the scenarios."""
    scenarios: Annotated[tuple[str, ...], arg(name="scenario")] = ()
    """Scenarios or HighwayEnv's ids; by default the paper's with both dynamics, HighwayEnv's own, and others that reach
    the rest of the configuration; then the time limits at many frequencies are compared too."""
    processes: Positive = 1
    """Processes that drive highway-env, which takes nearly all of the time."""
    plain_math: bool = True
    """Let NumPy use the C library's functions under highway-env, so that states can be compared to the last bit.
    Without it, on a processor with AVX-512, highway-env differs from itself elsewhere, visibly so after crashes."""
    out: str = ""
    """Also write the verdict to this file."""
    force: bool = False
    """Replace another file in its place."""


@dataclass(frozen=True)
class Doctor:
    """Check Python, torch, the simulator's speed, the cache, the model and the endpoint."""

    teacher: TeacherConfig = field(default_factory=TeacherConfig)
