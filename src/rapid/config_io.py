"""Settings from outside: values by name, TOML files, and whether they make sense together."""

import dataclasses
import json
import math
import os
import tomllib
import types
import typing
from functools import reduce
from pathlib import Path
from typing import Any, Literal, TypeVar

from rapid.config import Config, PpoConfig
from rapid.errors import RapidError, did_you_mean
from rapid.scenarios import MAX_VEHICLES, MIN_VEHICLES, get_scenario

T = TypeVar("T")

PHASES = ("distill", "adapt")
"""The parts of the tree that have a loss and an optimiser."""
LEAST: dict[str, int] = {
    "threads": 1,
    "collect.teacher_transitions": 0,
    "collect.random_transitions": 0,
    "collect.lockstep": 1,
    "collect.max_decisions": 0,
    "mix.size": 1,
    "network.num_policies": 1,
    "network.width": 1,
    "network.feedforward": 1,
    "network.heads": 1,
    "network.layers": 1,
    "network.decoder_layers": 1,
    "distill.iterations": 1,
    "distill.evaluate_every": 0,
    "adapt.steps": 0,
    "adapt.num_envs": 1,
    "adapt.evaluate_every": 0,
    "adapt.buffer_size": 1,
    "adapt.learning_starts": 0,
    "adapt.exploration_hold": 1,
    "adapt.ppo.steps": 0,
    "adapt.ppo.num_envs": 1,
    "adapt.ppo.rollout": 1,
    "adapt.ppo.epochs": 1,
    # An advantage is told by what it is beside others.
    "adapt.ppo.batch_size": 2,
    "adapt.ppo.crash_penalty": 0,
    "adapt.ppo.critic_steps": 0,
    "teacher.concurrency": 1,
    "teacher.max_turns": 1,
    "teacher.few_shot": 0,
    "evaluate.spawns": 1,
    "evaluate.teacher_spawns": 0,
    "evaluate.planner_spawns": 0,
    "evaluate.curve_spawns": 0,
    **{f"{phase}.loss.n_step": 1 for phase in PHASES},
    **{f"{phase}.loss.robust.radius": 0 for phase in PHASES},
    **{f"{phase}.loss.robust.steps": 1 for phase in PHASES},
    **{f"{phase}.optimizer.batch_size": 1 for phase in PHASES},
    **{f"{phase}.optimizer.target_update": 1 for phase in PHASES},
}
"""The least value of settings, by name."""
POSITIVE = (
    "adapt.updates_per_step",
    *(
        f"adapt.ppo.{setting}"
        for setting in (
            "temperature",
            "clip",
            "learning_rate",
            "critic_rate",
            "max_grad_norm",
            "critic_max_grad_norm",
        )
    ),
    *(
        f"{phase}.{setting}"
        for phase in PHASES
        for setting in (
            "loss.munchausen_temperature",
            "loss.temperature",
            "optimizer.learning_rate",
            "optimizer.gate_rate",
        )
    ),
)
"""Settings that must be above 0."""
SHARES = (
    "mix.p",
    "adapt.exploration_start",
    "adapt.exploration_end",
    "adapt.exploration_share",
    "adapt.ppo.discount",
    "adapt.ppo.trace",
    *(f"{phase}.loss.discount" for phase in PHASES),
)
"""Settings between 0 and 1."""


def to_dict(config: Any) -> dict[str, Any]:
    """Return a dataclass as plain dictionaries and lists, ready for JSON or TOML."""
    return dataclasses.asdict(config)


def apply_overrides(config: T, overrides: dict[str, Any], where: str = "", source: str = "the settings") -> T:
    """Return `config` with nested `overrides` applied, every key and type checked.

    Raises:
        RapidError: a key that does not exist, or a value of the wrong type; the message names the key and `source`.
    """
    hints = typing.get_type_hints(type(config))
    changes: dict[str, Any] = {}
    for key, value in overrides.items():
        path = f"{where}.{key}" if where else key
        if key not in hints:
            raise RapidError(
                f"Unknown setting '{path}' in {source}{did_you_mean(key, hints)} Known here: {', '.join(hints)}."
            )
        current = getattr(config, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, dict):
                raise RapidError(f"Setting '{path}' in {source} must be a table, not {value!r}.")
            changes[key] = apply_overrides(current, value, path, source)
        else:
            changes[key] = _checked(value, hints[key], path, source)
    return dataclasses.replace(config, **changes)  # pyright: ignore[reportArgumentType, reportCallIssue, reportReturnType]


def _checked(value: Any, hint: Any, path: str, source: str) -> Any:
    """Return `value` if it has the type `hint`, with integers widened to floats and lists turned into tuples."""
    origin = typing.get_origin(hint)
    if isinstance(hint, types.GenericAlias) and origin is tuple:
        if isinstance(value, list | tuple):
            return tuple(_checked(item, typing.get_args(hint)[0], path, source) for item in value)
        expected = "a list"
    elif origin is Literal:
        choices = typing.get_args(hint)
        if value in choices:
            return value
        hint_text = did_you_mean(value, choices) if isinstance(value, str) else "."
        raise RapidError(
            f"Setting '{path}' in {source} is {value!r}{hint_text} Choose one of {', '.join(map(str, choices))}."
        )
    elif hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif type(value) is hint:
        return value
    else:
        expected = f"of type {hint.__name__}"
    raise RapidError(f"Setting '{path}' in {source} must be {expected}, not {value!r}.")


def _refuse_non_finite(values: dict[str, Any], where: str = "") -> None:
    for key, value in values.items():
        if isinstance(value, dict):
            _refuse_non_finite(value, f"{where}{key}.")
        elif isinstance(value, float) and not math.isfinite(value):
            raise RapidError(f"Setting '{where}{key}' is {value}, but must be a finite number.")


def load_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file of settings.

    Raises:
        RapidError: the file is missing, unreadable or not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RapidError(f"Cannot read the settings file '{path}': {error}. Give the path of a TOML file.") from error
    except tomllib.TOMLDecodeError as error:
        raise RapidError(f"The settings file '{path}' is not valid TOML: {error}. Correct that line.") from error


def validate(config: Config) -> Config:
    """Return `config` if its numbers make sense together.

    Raises:
        RapidError: the first setting that does not, with what was expected.
    """
    _refuse_non_finite(to_dict(config))
    get_scenario(config.scenario)
    if config.adapt.scenario:
        get_scenario(config.adapt.scenario)
    collect, network, adapt = config.collect, config.network, config.adapt
    divided = max(collect.workers, collect.shards) > 1
    # Simple bounds first: what follows may divide by them.
    checks: list[tuple[str, bool, str]] = [
        *((name, value(config, name) >= least, f"at least {least}") for name, least in LEAST.items()),
        *((name, value(config, name) > 0, "above 0") for name in POSITIVE),
        *((name, 0 <= value(config, name) <= 1, "between 0 and 1") for name in SHARES),
        ("adapt.offline_share", 0 <= config.adapt.offline_share < 1, "in [0, 1)"),
        (
            "adapt.steps",
            adapt.steps > 0 or adapt.ppo.steps > 0 or adapt.mirror,
            "above 0 where adapt.ppo.steps is 0, unless adapt.mirror",
        ),
        ("adapt.steps", adapt.steps > 0 or adapt.train != "scratch", "above 0 where adapt.train is 'scratch'"),
        (
            "adapt.ppo.steps",
            adapt.ppo.steps == 0 or adapt.ppo.steps >= least_steps(adapt.ppo),
            f"0 or at least {least_steps(adapt.ppo)}: until the policy learns, adapt.ppo.critic_steps = "
            f"{adapt.ppo.critic_steps} in whole rollouts of adapt.ppo.num_envs * adapt.ppo.rollout = "
            f"{adapt.ppo.num_envs * adapt.ppo.rollout}, and one more",
        ),
        ("seed", 0 <= config.seed < 2**32, "between 0 and 2^32 - 1"),
        ("collect.workers", 1 <= collect.workers <= 1000, "between 1 and 1000"),
        ("collect.shards", 0 <= collect.shards <= 1000, "between 0 and 1000"),
        (
            "collect.shard",
            collect.shard == "1/1" or not divided,
            "1/1 where collect.workers or collect.shards divide the collection",
        ),
        ("collect.workers", collect.engine == "local" or divided, f"at least 2 for the engine '{collect.engine}'"),
        (
            "network.top_k",
            1 <= network.top_k <= network.num_policies,
            f"between 1 and network.num_policies = {network.num_policies}",
        ),
        (
            "network.width",
            network.heads < 1 or network.width % network.heads == 0,
            f"a multiple of network.heads = {network.heads}",
        ),
        (
            "network.vehicles",
            MIN_VEHICLES <= network.vehicles <= MAX_VEHICLES,
            f"between {MIN_VEHICLES} and {MAX_VEHICLES}",
        ),
        ("adapt.vehicles", 0 <= adapt.vehicles <= MAX_VEHICLES, f"between 0 and {MAX_VEHICLES}"),
        ("evaluate.attacks", len(config.evaluate.attacks) >= 1, "at least one name, such as none"),
    ]
    for phase in PHASES:
        weight, rate = f"{phase}.loss.munchausen_weight", f"{phase}.optimizer.target_rate"
        checks.append((weight, 0 <= value(config, weight) < 1, "in [0, 1)"))
        checks.append((rate, 0 < value(config, rate) <= 1, "in (0, 1]"))
    for name, good, expected in checks:
        if not good:
            raise RapidError(f"Setting '{name}' is {value(config, name)}, but must be {expected}.")
    return config


def least_steps(ppo: PpoConfig) -> int:
    """Return the fewest steps of PPO in which the policy learns anything."""
    per_rollout = max(ppo.num_envs * ppo.rollout, 1)
    return (-(-ppo.critic_steps // per_rollout) + 1) * per_rollout


def value(config: Any, name: str) -> Any:
    """Return the setting with a dotted name."""
    return reduce(getattr, name.split("."), config)


def to_toml(settings: dict[str, Any]) -> str:
    """Return nested settings as TOML; :func:`load_toml` reads the same values back."""
    lines: list[str] = []

    def table(values: dict[str, Any], path: str) -> None:
        if path:
            lines.extend(("", f"[{path}]"))
        lines.extend(f"{key} = {_toml_value(value)}" for key, value in values.items() if not isinstance(value, dict))
        for key, value in values.items():
            if isinstance(value, dict):
                table(value, f"{path}.{key}" if path else key)

    table(settings, "")
    return "\n".join(lines).lstrip("\n") + "\n"


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # TOML's basic strings escape as JSON's do, except for DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return f"[{', '.join(map(_toml_value, value))}]"
