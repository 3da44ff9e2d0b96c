"""The one tree of settings: frozen dataclasses, bounds and a docstring at each field.

A *recipe* says how things are trained: ``paper`` uses the numbers as printed, even where they handicap someone;
``strong`` uses what a good practitioner would, for every method. A *scale* says how much is run. Precedence, low to
high: recipe and scale (:mod:`rapid.presets`), ``--config FILE.toml``, options (:mod:`rapid.config_io`). What
learns has its part of the tree in :mod:`rapid.config_learning`; every class of it can be had from here too. This module
imports nothing heavy.
"""

import typing
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from rapid.bounds import (
    AboveZero,
    Amount,
    Bounds,
    Count,
    Positive,
    Rows,
    RowsOrNone,
    Seed,
    Share,
    Side,
    SideOrNone,
    Workers,
)
from rapid.config_learning import AdaptConfig, DistillConfig, NetworkConfig
from rapid.config_learning import AdversaryConfig as AdversaryConfig
from rapid.config_learning import LossConfig as LossConfig
from rapid.config_learning import OptimizerConfig as OptimizerConfig
from rapid.config_learning import PpoConfig as PpoConfig
from rapid.config_learning import RobustConfig as RobustConfig

Recipe = Literal["paper", "strong"]
Scale = Literal["tiny", "quick", "full"]
Plan = Literal["printed", "careful", "bold", "ppo", "robust", "guided", "squeezed", "wary"]
RECIPES: tuple[str, ...] = typing.get_args(Recipe)
SCALES: tuple[str, ...] = typing.get_args(Scale)
PLANS: tuple[str, ...] = typing.get_args(Plan)


@dataclass(frozen=True)
class TeacherConfig:
    """Who drives in phase 1 (paper: section 3.1)."""

    backend: Literal["local", "endpoint", "replay", "scripted"] = "local"
    """`local` runs an embedded model in this process, `endpoint` asks any OpenAI-compatible server, `replay` repeats
    recorded answers, `scripted` needs no model."""
    model: str = "smollm2-135m"
    """Name of the model (`rapid models list`), of the server's model, or of the scripted driver
    (random, idle, slower, faster, rule, rule-forecast, rule-foresight, uniform-safe)."""
    style: Literal["digest", "react"] = "digest"
    """`digest` inlines every tool result and asks for one decision; `react` lets the model call the tools in turns. A
    `local` model that converses calculates in 8 bits where the processor is fast at that (AVX-512 VNNI), so its answers
    may differ between processors."""
    base_url: str = "http://127.0.0.1:8000/v1"
    """Address of the OpenAI-compatible server (`endpoint`). ``${NAME}`` in it stands for an environment variable, which
    may hold a secret; a query, as in ``…/gpt-4o?api-version=2024-10-21``, stays at the end."""
    api_key_env: str = "OPENAI_API_KEY"
    """Environment variable that holds the key; the key itself is never written anywhere."""
    headers_env: str = ""
    """Environment variable that holds further headers, one a line as ``Name: value``; kept as secret as the key."""
    concurrency: Workers = 8
    """Requests in flight at once (`endpoint`)."""
    requests_per_minute: Amount = 0.0
    """Upper bound on requests per minute; 0 is no bound (`endpoint`)."""
    timeout_s: AboveZero = 60.0
    """Seconds that one answer may take, from the request to its last byte (`endpoint`)."""
    max_retries: Count = 4
    """Tries after the first for a failed request, with backoff (`endpoint`)."""
    tool_calling: Literal["auto", "native", "text"] = "auto"
    """How tools are called (`react`, `endpoint`): the server's own way, plain text, or the former until it refuses."""
    max_answer_tokens: Annotated[int, Bounds(1, 100_000)] = 400
    """Tokens that one answer may have."""
    shuffle_facts: bool = False
    """Control: tell the facts of one action about another (`local`, `digest`), to see whether the model uses them."""
    max_turns: Annotated[int, Bounds(1, 1000)] = 8
    """Tool calls allowed before a decision must be made (`react`)."""
    max_fallback_share: Share = 0.2
    """Share of decisions that a rule may make because the model gave no usable answer; above it, collecting stops. 1
    never stops."""
    price_in: Amount = 0.0
    """Price of a million prompt tokens, in any currency; for the cost shown and budgeted."""
    price_out: Amount = 0.0
    """Price of a million answer tokens."""
    replay_file: str = ""
    """Recorded answers (`replay`)."""
    memory: str = ""
    """File of past situations that the model is reminded of, such as the `memory.jsonl` of a dataset; it is only read.
    With this or `reflect`, a `local` model in `digest` style answers in words instead of scoring them."""
    few_shot: Annotated[int, Bounds(0, 1000)] = 0
    """How many of the most similar past situations the model is shown at each decision; 0 is none."""
    reflect: bool = False
    """Remember each episode: its tightest moment, or after a crash what went wrong, which the model is asked. Written
    to `memory.jsonl` in the dataset, after what `memory` held; name that file as `memory` for the next collection."""


@dataclass(frozen=True)
class CollectConfig:
    """Phase 1: how much is collected (paper: section 4.2)."""

    teacher_transitions: RowsOrNone = 15_000
    """Transitions that the teacher drives; whole episodes are collected until there are at least as many."""
    random_transitions: RowsOrNone = 15_000
    """Transitions of the uniformly random driver."""
    lockstep: Side = 16
    """Episodes driven side by side, so that the model sees a batch of prompts; a `local` model that converses answers
    all of them together."""
    max_tokens: Count = 0
    """Stop collecting when the teacher has read and written so many tokens; 0 is no limit."""
    max_cost: Amount = 0.0
    """Stop when the teacher has cost so much (see `price_in`); 0 is no limit."""
    max_seconds: Amount = 0.0
    """Stop after so many seconds of collecting; 0 is no limit."""
    max_decisions: Count = 0
    """Stop before the teacher has made more decisions than this; 0 is no limit."""
    shard: str = "1/1"
    """Which part of the episodes this process collects, as `i/n`; for processes that you start yourself."""
    engine: Literal["local", "ray"] = "local"
    """Where workers run: on this machine, or on a Ray cluster (RAY_ADDRESS; every machine needs the same RAPID, and the
    API key, if any, in the environment that its `ray start` was given)."""
    workers: Workers = 1
    """Parts of the collection that are under way at once, each with a teacher of its own."""
    shards: Annotated[int, Bounds(0, 1000)] = 0
    """Into how many parts the collection is divided, which decides what is collected; 0 is one for each worker, or as
    many as the directory was begun with."""


@dataclass(frozen=True)
class MixConfig:
    """The offline dataset: teacher and random transitions mixed (paper: section 4.2)."""

    p: Share = 0.5
    """Share of teacher transitions; the paper's best is 0.25, of 15,000."""
    size: Rows = 30_000
    """Number of transitions in the mixture."""
    level: Literal["transition", "batch"] = "transition"
    """`transition` draws the mixture once; `batch` keeps up to `size` of each source and mixes in every batch."""
    drop_fallbacks: bool = False
    """Leave out the transitions of which a rule chose the action because the model gave no usable answer."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Measuring: spawns and attacks (paper: section 4.5)."""

    spawns: Side = 200
    """Episodes, one for each of the first spawn seeds of the set `test`."""
    teacher_spawns: SideOrNone = 16
    """Episodes of the teacher, which is slow; the first of the same seeds. 0 leaves the row out."""
    planner_spawns: SideOrNone = 200
    """Episodes of a planner, which takes seconds for each; the first of the same seeds. 0: a run has no such row."""
    curve_spawns: SideOrNone = 20
    """Episodes of each point of a learning curve, from the set `tune`."""
    attacks: tuple[str, ...] = ("none", "uniform", "gaussian", "fgsm", "pgd")
    """Attacks on the observations, as texts such as pgd:steps=50,radius=0.02 (docs/attacks.md), and presets of them:
    paper, suite, sensor, columns, sweep, with options such as suite:ego=trusted."""
    teacher_attacks: tuple[str, ...] = ("none",)
    """The same for the teacher: noise, lies and transfer can be made on it."""
    adversary_steps: Positive = 40_000
    """Decisions that an adversary is trained for, where the attack `adversary` names none."""
    workers: Workers = 1
    """Processes among which the attacks on an agent are divided; the results are the same."""


@dataclass(frozen=True)
class Config:
    """Every setting of a run."""

    recipe: Recipe = "strong"
    """How things are trained."""
    scale: Scale = "quick"
    """How much is run."""
    plan: Plan = "bold"
    """How phase 3 learns: `printed` as the paper does; `careful` close to the data; `bold` by much exploring; `ppo` so
    for longer, and then by PPO; `robust` by PPO under attack, with a memory; `guided` as `ppo`, and is then shown under
    attack what to do; `squeezed` as `ppo`, later under attack, by features that an attack cannot bend far; `wary` by
    PPO with such features, under attack from the first step: it is for the second policy of a monitored agent."""
    scenario: str = "lane-3-density-2"
    """Where the data is collected and policies are trained and measured."""
    simulator: Literal["compiled", "highway-env"] = "compiled"
    """The compiled twin, or highway-env itself (about a thousand times slower)."""
    data: str = ""
    """Instead of collecting: `shipped` takes the datasets that come with the package, which needs no model; anything
    else is a directory that holds the datasets `teacher` and `random`."""
    seed: Seed = 0
    """The seed from which every random stream is derived."""
    threads: Workers = 1
    """Torch threads of this process; scale by processes instead. Another number gives other weights, in their last bits
    at first. In PPO two or more let policy and critic learn beside each other, and as many processes step its
    compiled worlds; a script then needs `if __name__ == "__main__":` around its work."""
    device: str = "cpu"
    """Torch device."""
    tracking: Literal["none", "tensorboard", "wandb", "trackio"] = "none"
    """Where the metrics of both trainings are copied to; offline unless WANDB_MODE says otherwise."""
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    """Phase 1: the teacher."""
    collect: CollectConfig = field(default_factory=CollectConfig)
    """Phase 1: the data."""
    mix: MixConfig = field(default_factory=MixConfig)
    """Phase 1: the mixture."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """The network."""
    distill: DistillConfig = field(default_factory=DistillConfig)
    """Phase 2."""
    adapt: AdaptConfig = field(default_factory=AdaptConfig)
    """Phase 3."""
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    """Measuring."""


def without_place(config: Config) -> Config:
    """Return `config` with the settings at their defaults that say where and how fast it is computed, not what.

    The number of threads is none of them: sums are then added up in another order, and weights differ in the last bits.
    """
    return replace(
        config,
        tracking="none",
        collect=replace(config.collect, engine="local", workers=1),
        evaluate=replace(config.evaluate, workers=1),
    )
