"""What the verbs can be told that look, compare, convert and show; see :mod:`rapid.options`."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from rapid.bounds import AboveZero, Bounds, Positive, Seed, Side, SideOrNone, Workers
from rapid.config import CollectConfig, Config, Scale, TeacherConfig
from rapid.options import Flat, Source
from rapid.scenarios import PAPER_SCENARIOS


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
    spawns: Side = 32
    """Episodes of each teacher in each scenario."""
    spawn_set: Literal["tune", "test"] = "tune"
    """Where the spawn seeds come from: `tune` to choose a teacher, `test` to report one that was chosen elsewhere."""
    lockstep: Side = 64
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
    with a network; attacks leave presence alone.
    """

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent, perhaps behind shield:BOX:."""
    radii: tuple[AboveZero, ...] = (0.0005, 0.001, 0.005)
    """Radii of the attacks (L-infinity, features scaled to +-1: 0.0005 is 0.1 m along the road and 0.04 m/s)."""
    decisions: Side = 100
    """Decisions that are certified for each radius. A perceptron's take milliseconds, a mixture's about a second."""
    spawns: Side = 20
    """Test spawns, on the way through which the agent decides."""
    returns: SideOrNone = 0
    """Of how many of them the return is bounded too, by the tree of all actions that an attack may bring about."""
    width: Side = 256
    """Worlds of a tree that are followed side by side; where more differ, what is left counts as nothing."""
    scenario: str = ""
    """Where it drives; by default where it was trained."""
    out: str = ""
    """Directory of the table and the numbers; without it the table is printed and nothing is kept."""
    force: bool = False
    """Replace a certificate that is there."""


@dataclass(frozen=True)
class Export:
    """Write an agent as ONNX, compare the two on real observations, and time a decision."""

    agent: Annotated[Positional[str], arg(metavar="AGENT")]
    """Directory of the agent; with shield:BOX: before it, the interval filter becomes part of the model. Or
    monitored:CALM,WARY, two agents with a monitor between them."""
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
    force: bool = False
    """Replace another file in its place."""


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
    """Such as attack, offline or ratio; `all` is every one, with --recipe every one that has it."""
    recipe: Annotated[str, arg(metavar="{paper,strong}")] = ""
    """How things are trained; by default as the paper does, and by `strong` what only that has."""
    scale: Scale = Config.scale
    """How much is run: tiny (minutes), quick, full (five trainings, 200 spawns)."""
    engine: Annotated[str, arg(metavar="{local,ray}")] = CollectConfig.engine
    """Where parts are computed."""
    workers: Workers = 1
    """Parts under way at once."""
    store: str = "runs/store"
    """Directory of finished parts."""
    layers: tuple[str, ...] = ()
    """Directories of small results that are only read; results/cells is one wherever it is there."""
    out: str = ""
    """Directory of the page; by default runs/reproduce/RECIPES-SCALE."""
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
class Push:
    """Put an agent or a dataset, with its card, on the Hugging Face Hub.

    Only weights as safetensors, ONNX, JSON, Parquet and the card are sent. The token is that of `hf auth login` or of
    HF_TOKEN.
    """

    path: Annotated[Positional[str], arg(metavar="AGENT_OR_DATASET")]
    """Directory of the agent or dataset, or a shipped one."""
    repository: Annotated[Positional[str], arg(metavar="OWNER/NAME")]
    """Where to on the hub; made if it is not there."""
    public: bool = False
    """Let everyone see a repository that is made; without it only its owner does. One that exists stays as it is."""


@dataclass(frozen=True)
class Pull:
    """Fetch an agent or a dataset from the Hugging Face Hub and check it whole, before it is put in its place.

    Only weights as safetensors, ONNX, JSON, Parquet and the card are fetched; pickles and whatever else is there is
    left out.
    """

    repository: Annotated[Positional[str], arg(metavar="OWNER/NAME")]
    """Where from; datasets/OWNER/NAME is the dataset if there is an agent of this name too."""
    out: str = ""
    """Directory for it; by default NAME."""
    revision: str = ""
    """Branch, tag or commit; by default the newest of the main branch."""


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
    processes: Workers = 1
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
