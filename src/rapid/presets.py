"""Recipes and scales as data: how things are trained, and how much is run."""

import typing
from dataclasses import replace

from rapid.config import (
    RECIPES,
    SCALES,
    AdaptConfig,
    Config,
    DistillConfig,
    LossConfig,
    MixConfig,
    NetworkConfig,
    OptimizerConfig,
    Recipe,
    RobustConfig,
    Scale,
)
from rapid.errors import RapidError, did_you_mean

LONG_STEPS = 300_000
"""Online steps of Q-learning of the scale `long`."""
LONG_PPO_STEPS = 700_000
"""The steps by PPO after them, in the recipe `strong`."""


def preset(recipe: str = "strong", scale: str = "quick") -> Config:
    """Return the settings of a recipe at a scale.

    Raises:
        RapidError: the recipe or the scale does not exist.
    """
    for kind, value, choices in (("recipe", recipe, RECIPES), ("scale", scale, SCALES)):
        if value not in choices:
            near = did_you_mean(value, choices)
            raise RapidError(f"Unknown {kind} '{value}'{near} Choose one of {', '.join(choices)}.")
    config = Config(recipe=typing.cast(Recipe, recipe), scale=typing.cast(Scale, scale))
    if recipe == "paper":
        config = _paper(config)
    return _resize(config)


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


def _resize(config: Config) -> Config:
    """Apply the sizes of a scale; `full` keeps those of the recipe."""
    if config.scale == "full":
        return config
    tiny, strong = config.scale == "tiny", config.recipe == "strong"
    adapt = _boldly(config.adapt) if strong and not tiny else config.adapt
    if config.scale == "long":
        return replace(config, adapt=_at_length(adapt) if strong else replace(adapt, steps=LONG_STEPS))
    teacher, random = (60, 180) if tiny else (2_000, 6_000)
    return replace(
        config,
        collect=replace(
            config.collect,
            teacher_transitions=teacher,
            random_transitions=random,
            lockstep=4 if tiny else 16,
        ),
        mix=replace(config.mix, size=int(min(teacher / config.mix.p, random / (1 - config.mix.p)))),
        distill=replace(config.distill, iterations=40 if tiny else 1_500, evaluate_every=20 if tiny else 300),
        adapt=replace(
            adapt,
            # More than `full` has: driving is cheap here, and the paper's 10,000 add nothing to what was distilled.
            steps=200 if tiny else 30_000 if strong else 8_000,
            learning_starts=min(adapt.learning_starts, 50 if tiny else 500),
            evaluate_every=100 if tiny else 2_000,
        ),
        evaluate=replace(
            config.evaluate,
            spawns=4 if tiny else 60,
            teacher_spawns=2 if tiny else 12,
            planner_spawns=2 if tiny else 12,
            curve_spawns=2 if tiny else 20,
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


def _at_length(adapt: AdaptConfig) -> AdaptConfig:
    """Return phase 3 for so many steps that it can look further ahead and needs fewer gradient steps for each.

    PPO then brings what it has found up to what is measured.
    """
    return replace(
        adapt,
        steps=LONG_STEPS,
        buffer_size=LONG_STEPS,
        updates_per_step=0.1,
        exploration_share=0.3,
        loss=replace(adapt.loss, discount=0.95),
        ppo=replace(adapt.ppo, steps=LONG_PPO_STEPS),
    )
