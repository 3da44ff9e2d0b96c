"""Recipes, scales and plans as data: how things are trained, and how much is run.

A *recipe* says how things are trained: ``paper`` uses the numbers as printed, ``strong`` what a good practitioner
would, for every method. A *plan* names the algorithm of phase 3 within a recipe. A *scale* changes sizes only:
``tiny`` (CI), ``quick`` (a coffee), ``full`` (the paper's sizes or more).
"""

import typing
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from rapid.config import PLANS, RECIPES, SCALES, Config, MixConfig, Plan, Recipe, Scale
from rapid.config_io import flat, to_dict
from rapid.config_learning import (
    AdaptConfig,
    DistillConfig,
    LossConfig,
    NetworkConfig,
    OptimizerConfig,
    RobustConfig,
)
from rapid.errors import RapidError, did_you_mean


def differences(old: Config, new: Config) -> dict[str, tuple[Any, Any]]:
    """Return the settings in which two trees differ, by dotted names, each with its value in both."""
    before, after = flat(to_dict(old)), flat(to_dict(new))
    return {name: (before[name], value) for name, value in after.items() if before[name] != value}


def as_options(config: Config) -> list[str]:
    """Return the words after ``rapid run`` that give these settings, whatever files there are."""
    words = ["--recipe", config.recipe, "--scale", config.scale, "--plan", config.plan]
    words += ["--scenario", config.scenario, "--seed", str(config.seed)]
    changed = differences(preset(config.recipe, config.scale, config.plan), config)
    for name, (_, value) in changed.items():
        option = name.replace("_", "-")
        if name in ("scenario", "seed"):
            continue
        if isinstance(value, bool):
            section, dot, last = option.rpartition(".")
            words.append(f"--{section}{dot}{'' if value else 'no-'}{last}")
        elif isinstance(value, tuple):
            words += [f"--{option}", *map(str, typing.cast(tuple[Any, ...], value))]
        else:
            # What looks like an option itself must hang on to its own.
            words += [f"--{option}={value}"] if str(value).startswith("-") else [f"--{option}", str(value)]
    return words


class Sizes(NamedTuple):
    """How much a scale runs, whatever the recipe and the plan; None leaves what the recipe has."""

    teacher: int | None = None
    random: int | None = None
    lockstep: int = 16
    iterations: int | None = None
    evaluate_offline: int = 1_000
    evaluate_online: int = 1_000
    spawns: int = 200
    teacher_spawns: int = 16
    planner_spawns: int = 200
    curve_spawns: int = 20


SIZES: dict[Scale, Sizes] = {
    "tiny": Sizes(60, 180, 4, 40, 20, 100, 4, 2, 2, 2),
    "quick": Sizes(2_000, 6_000, 16, 1_500, 300, 2_000, 60, 12, 12, 20),
    "full": Sizes(),
}
STEPS: dict[Plan, dict[Scale, tuple[int, int]]] = {
    "printed": {"tiny": (200, 0), "quick": (8_000, 0), "full": (10_000, 0)},
    "careful": {"tiny": (200, 0), "quick": (10_000, 0), "full": (10_000, 0)},
    "bold": {"tiny": (200, 0), "quick": (30_000, 0), "full": (100_000, 0)},
    "ppo": {"tiny": (200, 7_680), "quick": (30_000, 115_200), "full": (300_000, 700_000)},
    "robust": {"tiny": (0, 7_680), "quick": (0, 153_600), "full": (0, 600_000)},
    "guided": {"tiny": (200, 15_360), "quick": (30_000, 153_600), "full": (300_000, 921_600)},
    "squeezed": {"tiny": (200, 15_360), "quick": (30_000, 153_600), "full": (300_000, 1_300_000)},
    "wary": {"tiny": (0, 30_720), "quick": (0, 307_200), "full": (0, 500_000)},
}
"""Environment steps of phase 3, by Q-learning and then by PPO."""
DEFAULT_PLAN: dict[Recipe, Plan] = {"paper": "printed", "strong": "bold"}
OF_RECIPE: dict[Recipe, tuple[Plan, ...]] = {
    "paper": ("printed",),
    "strong": ("careful", "bold", "ppo", "robust", "guided", "squeezed", "wary"),
}


def preset(recipe: str = "strong", scale: str = "quick", plan: str = "") -> Config:
    """Return the settings of a recipe at a scale, phase 3 by a plan; without one by the recipe's usual.

    Raises:
        RapidError: the recipe, the scale or the plan does not exist, or the recipe has no such plan.
    """
    if scale == "long":
        raise RapidError("There is no scale 'long' any more. What it ran is now --scale full --plan ppo.")
    for kind, value, choices in (("recipe", recipe, RECIPES), ("scale", scale, SCALES), ("plan", plan, PLANS)):
        if value not in choices and (value or kind != "plan"):
            near = did_you_mean(value, choices)
            raise RapidError(f"Unknown {kind} '{value}'{near} Choose one of {', '.join(choices)}.")
    recipe, scale = typing.cast(Recipe, recipe), typing.cast(Scale, scale)
    chosen = typing.cast(Plan, plan) or DEFAULT_PLAN[recipe]
    if chosen not in OF_RECIPE[recipe]:
        raise RapidError(
            f"The recipe '{recipe}' has no plan '{chosen}'. It has: {', '.join(OF_RECIPE[recipe])}. Choose one of "
            "them, or another --recipe."
        )
    config = Config(recipe=recipe, scale=scale, plan=chosen)
    if recipe == "paper":
        config = _paper(config)
    return _resized(replace(config, adapt=_PLANS[chosen](config.adapt)))


def of_file(settings: Mapping[str, Any]) -> Config:
    """Return what a file of settings, such as a run's, changes: the preset of its recipe, scale and plan.

    Files that were written before there were plans name none, or the scale `long`.
    """
    recipe, scale = str(settings.get("recipe", Config.recipe)), str(settings.get("scale", Config.scale))
    plan = str(settings.get("plan", ""))
    if scale == "long":
        return replace(preset(recipe, "full", plan or ("ppo" if recipe == "strong" else "")))
    if not plan and scale == "full" and recipe == "strong":
        plan = "careful"
    return preset(recipe, scale, plan)


def without_presets(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a file's settings without the names that :func:`of_file` has used."""
    return {name: value for name, value in settings.items() if name not in ("recipe", "scale", "plan")}


def _paper(config: Config) -> Config:
    """The numbers as printed (paper: hyperparameter table, sections 4.1 and 4.5)."""
    robust = RobustConfig(norm="l2", radius=0.1, steps=10, step_size=0.01, random_start=False, attack_presence=True)
    loss = LossConfig(discount=0.99, double=False, td_error="huber", robust_weight=0.5, robust_on="all", robust=robust)
    optimizer = OptimizerConfig(linear_decay=False, batch_size=32, target_update=50, target_rate=1.0, max_grad_norm=0.0)
    return replace(
        config,
        mix=MixConfig(p=0.25, size=15_000),
        network=NetworkConfig(
            width=64,
            heads=2,
            layers=2,
            feedforward=128,
            decoder_layers=2,
            input="raw",
            position="learned",
            mask_absent=False,
        ),
        distill=DistillConfig(iterations=5_000, loss=loss, optimizer=optimizer),
        adapt=AdaptConfig(
            num_envs=1,
            updates_per_step=1.0,
            exploration_start=1.0,
            exploration_end=0.05,
            offline_share=0.0,
            learning_starts=32,
            loss=replace(loss, conservative_weight=0.0, robust_weight=0.0),
            optimizer=optimizer,
        ),
    )


def _resized(config: Config) -> Config:
    """Apply the sizes of the scale, and nothing else."""
    sizes = SIZES[config.scale]
    steps, ppo_steps = STEPS[config.plan][config.scale]
    collect, mix, distill, adapt = config.collect, config.mix, config.distill, config.adapt
    if sizes.teacher and sizes.random:
        collect = replace(
            collect, teacher_transitions=sizes.teacher, random_transitions=sizes.random, lockstep=sizes.lockstep
        )
        mix = replace(mix, size=int(min(sizes.teacher / mix.p, sizes.random / (1 - mix.p))))
    if sizes.iterations:
        distill = replace(distill, iterations=sizes.iterations)
    tiny = config.scale == "tiny"
    ppo = replace(adapt.ppo, steps=ppo_steps)
    if tiny:
        ppo = replace(ppo, critic_steps=3_840, num_envs=min(ppo.num_envs, 128))
    return replace(
        config,
        collect=collect,
        mix=mix,
        distill=replace(distill, evaluate_every=sizes.evaluate_offline),
        adapt=replace(
            adapt,
            steps=steps,
            ppo=ppo,
            buffer_size=max(adapt.buffer_size, steps),
            learning_starts=min(adapt.learning_starts, 50) if tiny else adapt.learning_starts,
            evaluate_every=sizes.evaluate_online,
        ),
        evaluate=replace(
            config.evaluate,
            spawns=sizes.spawns,
            teacher_spawns=sizes.teacher_spawns,
            planner_spawns=sizes.planner_spawns,
            curve_spawns=sizes.curve_spawns,
        ),
    )


def _boldly(adapt: AdaptConfig) -> AdaptConfig:
    """Return phase 3 for many steps: nothing holds the policy to the data any more, and it tries much."""
    return replace(
        adapt,
        num_envs=20,
        updates_per_step=0.3,
        exploration_start=1.0,
        exploration_end=0.05,
        exploration_hold=5,
        offline_share=0.0,
        loss=replace(
            adapt.loss,
            conservative_weight=0.0,
            td_error="huber",
            munchausen_weight=0.9,
            munchausen_temperature=0.02,
        ),
        optimizer=replace(adapt.optimizer, learning_rate=5e-4),
    )


def _far_sighted(adapt: AdaptConfig) -> AdaptConfig:
    """Return phase 3 for so many steps that it can look further ahead and needs fewer gradient steps for each.

    PPO then brings what it has found up to what is measured.
    """
    bold = _boldly(adapt)
    return replace(
        bold,
        updates_per_step=0.1,
        exploration_share=0.3,
        loss=replace(bold.loss, discount=0.95),
        ppo=replace(bold.ppo, attention="compiled"),
    )


def _as_it_is(adapt: AdaptConfig) -> AdaptConfig:
    return adapt


def _under_attack(adapt: AdaptConfig) -> AdaptConfig:
    """Return phase 3 by PPO alone, with a memory, first without attacks and then under a mixture of them.

    The memory lets it plan by what no attack moves, and what pays is learned before attacks drown it (docs/log.md).
    """
    return replace(
        adapt,
        train="all",
        memory=True,
        ppo=replace(adapt.ppo, learning_rate=5e-4, entropy=0.003, critic_steps=20_000, attention="compiled"),
        adversary=replace(adapt.adversary, gradient_share=0.65, noise_share=0.1, begin=0.35, ramp=0.15),
    )


def _guided(adapt: AdaptConfig) -> AdaptConfig:
    """Return the plan `ppo`, after which the policy is shown under attack what to do (docs/algorithms/adapt.md)."""
    calm = _far_sighted(adapt)
    return replace(
        calm,
        memory=True,
        adversary=replace(
            calm.adversary,
            gradient_share=0.4,
            targeted_share=0.2,
            near_share=0.8,
            spared_share=0.05,
            steps=10,
            noise_share=0.1,
            noise=0.35,
            begin=0.75,
            guided=0.25,
        ),
    )


def _squeezed(adapt: AdaptConfig) -> AdaptConfig:
    """Return the plan `ppo` with a memory and squeezed features, whose later part is under attack.

    What an attack cannot bend need not be learned to be borne (docs/log/robustness.md).
    """
    calm = _far_sighted(adapt)
    return replace(
        calm,
        train="all",
        memory=True,
        squeeze=True,
        ppo=replace(calm.ppo, learning_rate=5e-4, entropy=0.003, critic_steps=20_000, largest_kl=0.04),
        adversary=replace(calm.adversary, gradient_share=0.6, noise_share=0.15, begin=0.7, ramp=0.07),
    )


def _wary(adapt: AdaptConfig) -> AdaptConfig:
    """Return phase 3 by PPO with squeezed features, attacked from the first step: for who drives when lies are noticed.

    It begins with the plan of `blind`, which it is shown: by trying alone, it would brake for good. What is better than
    a plan is found by large rollouts; small ones lose the plan first (docs/log/robustness.md).
    """
    squeezed = _squeezed(adapt)
    return replace(
        squeezed,
        ppo=replace(squeezed.ppo, num_envs=512, learning_rate=3e-4, entropy=0.0, largest_kl=0.03, critic_steps=50_000),
        adversary=replace(squeezed.adversary, noise_share=0.25, begin=0.0, ramp=0.0, guided=0.13),
    )


_PLANS: dict[Plan, Callable[[AdaptConfig], AdaptConfig]] = {
    "printed": _as_it_is,
    "careful": _as_it_is,
    "bold": _boldly,
    "ppo": _far_sighted,
    "robust": _under_attack,
    "guided": _guided,
    "squeezed": _squeezed,
    "wary": _wary,
}
