"""Settings from outside: values by name, TOML files, and whether they make sense together."""

import dataclasses
import json
import os
import tomllib
import types
import typing
from collections.abc import Iterator
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeVar

from rapid.bounds import check_bounds
from rapid.config import Config
from rapid.config_learning import AdaptConfig, NetworkConfig
from rapid.errors import RapidError, did_you_mean
from rapid.safety import read_box
from rapid.scenarios import NUM_ACTIONS, get_scenario

T = TypeVar("T")

MOST_WEIGHTS = 10**8
"""Of one network; with gradients, Adam's two moments and the target network that is 2 GB."""
MOST_ROWS = 10**7
"""Transitions of one rollout."""


def to_dict(config: Any) -> dict[str, Any]:
    """Return a dataclass as plain dictionaries and lists, ready for JSON or TOML."""
    return dataclasses.asdict(config)


def parts_of(config: Config, *sections: str) -> dict[str, Any]:
    """Return what stands in no section, but for the given data's place, and these sections, as plain dictionaries."""
    return {
        name: value
        for name, value in to_dict(config).items()
        if name in sections or (not isinstance(value, dict) and name != "data")
    }


def flat(settings: dict[str, Any], where: str = "") -> dict[str, Any]:
    """Return nested settings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= flat(value, f"{where}{name}.") if isinstance(value, dict) else {f"{where}{name}": value}
    return found


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


def load_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file of settings.

    Raises:
        RapidError: the file is missing, unreadable or not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RapidError(f"Cannot read the settings file '{path}': {error}. Give the path of a TOML file.") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise RapidError(f"The settings file '{path}' is not valid TOML: {error}. Correct that line.") from error


def validate(config: Config) -> Config:
    """Return `config` if its numbers make sense together.

    Raises:
        RapidError: the first setting that does not, with what was expected.
    """
    from rapid.teacher.address import check_names

    # First: what looks like a key must not be repeated by any message.
    check_names(config.teacher)
    check_bounds(config)
    get_scenario(config.scenario)
    if config.adapt.scenario:
        get_scenario(config.adapt.scenario)
    collect, network, adapt = config.collect, config.network, config.adapt
    for box in filter(None, (network.shield, adapt.shield)):
        read_box(box, lanes=1)
    divided = max(collect.workers, collect.shards) > 1
    checks: list[tuple[str, bool, str]] = [
        (
            "adapt.steps",
            adapt.steps > 0 or adapt.ppo.steps > 0 or adapt.mirror,
            "above 0 where adapt.ppo.steps is 0, unless adapt.mirror",
        ),
        ("adapt.steps", adapt.steps > 0 or adapt.train != "scratch", "above 0 where adapt.train is 'scratch'"),
        (
            "adapt.ppo.steps",
            adapt.ppo.steps == 0 or adapt.ppo.steps >= least_steps(adapt),
            f"0 or at least {least_steps(adapt)}: until the policy learns, adapt.ppo.critic_steps = "
            f"{adapt.ppo.critic_steps} in whole rollouts of adapt.ppo.num_envs * adapt.ppo.rollout = "
            f"{adapt.ppo.num_envs * adapt.ppo.rollout}, and one more",
        ),
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
            network.width % network.heads == 0,
            f"a multiple of network.heads = {network.heads}",
        ),
        (
            "network.width" if network.kind in ("rapid", "attentive") else "network.hidden",
            weights_about(network) <= MOST_WEIGHTS,
            f"smaller, or the network's other sizes: it would have about {weights_about(network):.2g} weights, and "
            f"{MOST_WEIGHTS:.0e} are allowed",
        ),
        (
            "adapt.ppo.rollout",
            adapt.ppo.num_envs * adapt.ppo.rollout <= MOST_ROWS,
            f"at most {MOST_ROWS} together with adapt.ppo.num_envs = {adapt.ppo.num_envs}, as a product",
        ),
        ("network.memory", not network.memory, "false: offline data holds no memory, adapt.memory gives one"),
        ("network.squeeze", not network.squeeze, "false: it needs a memory, adapt.squeeze gives it"),
        (
            "adapt.squeeze",
            not adapt.squeeze or adapt.memory,
            "false where adapt.memory is false: the ego's place and speed are then those of the memory. Set both",
        ),
        ("adapt.memory", not adapt.memory or adapt.ppo.steps > 0, "false where adapt.ppo.steps is 0"),
        ("adapt.memory", not (adapt.memory and (adapt.mirror or network.mirror)), "false where the road is mirrored"),
        (
            "adapt.memory",
            not adapt.memory or network.kind in ("rapid", "attentive"),
            f"false for network.kind '{network.kind}', which has no tokens",
        ),
        (
            "adapt.adversary.gradient_share",
            adapt.adversary.gradient_share + adapt.adversary.noise_share <= 1,
            f"at most 1 together with adapt.adversary.noise_share = {adapt.adversary.noise_share:g}",
        ),
        (
            "adapt.adversary.gradient_share",
            adapt.adversary.gradient_share == 0 or adapt.ppo.steps > 0,
            "0 where adapt.ppo.steps is 0: Q-learning is not attacked",
        ),
        (
            "adapt.adversary.noise_share",
            adapt.adversary.noise_share == 0 or adapt.ppo.steps > 0,
            "0 where adapt.ppo.steps is 0: Q-learning is not attacked",
        ),
        (
            "adapt.adversary.guided",
            adapt.adversary.guided == 0 or adapt.memory,
            "0 where adapt.memory is false: what is shown is a plan that goes by the time",
        ),
        (
            "adapt.adversary.guided",
            adapt.adversary.guided == 0 or adapt.adversary.gradient_share + adapt.adversary.noise_share > 0,
            "0 where adapt.adversary.gradient_share and noise_share are 0: a plan is shown in attacked episodes",
        ),
        (
            "adapt.adversary.guided",
            adapt.adversary.begin + adapt.adversary.guided <= 1,
            f"at most 1 together with adapt.adversary.begin = {adapt.adversary.begin:g}",
        ),
        ("evaluate.attacks", len(config.evaluate.attacks) >= 1, "at least one name, such as none"),
    ]
    for name, good, expected in checks:
        if not good:
            raise RapidError(f"Setting '{name}' is {value(config, name)}, but must be {expected}.")
    return config


def weights_about(network: NetworkConfig) -> int:
    """Return how many weights a network has, without norms, biases and embeddings."""
    if network.kind in ("rapid", "attentive"):
        layer = 4 * network.width**2 + 2 * network.width * network.feedforward
        policies = network.num_policies if network.kind == "rapid" else 1
        return (policies * network.layers + network.decoder_layers) * layer
    sizes = (network.vehicles * 8, *network.hidden, NUM_ACTIONS)
    policies = network.num_policies if network.kind == "mlp-mixture" else 1
    return policies * sum(before * after for before, after in pairwise(sizes))


def least_steps(adapt: AdaptConfig) -> int:
    """Return the fewest steps of PPO in which the policy learns anything: one rollout after those of the critic alone.

    From a guide that shows what to do in the first of the rollouts planned it learns at once.
    """
    ppo = adapt.ppo
    per_rollout = max(ppo.num_envs * ppo.rollout, 1)
    at_once = 0 in adapt.adversary.guided_rollouts(ppo.steps // per_rollout)
    return per_rollout if at_once else (-(-ppo.critic_steps // per_rollout) + 1) * per_rollout


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


def differences(old: Any, new: Any, limit: int = 6) -> str:
    """Return which of two nested settings differ, each as ``path: old there, new now``; nothing if they are equal."""
    found = list(_differing(old, new, ""))
    more = f"; and {len(found) - limit} more" if len(found) > limit else ""
    return "; ".join(found[:limit]) + more


def _differing(old: Any, new: Any, where: str) -> Iterator[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            yield from _differing(old.get(key), new.get(key), f"{where}.{key}" if where else str(key))
        return
    old, new = (list(value) if isinstance(value, tuple) else value for value in (old, new))
    if old != new:
        yield f"{where}: {_short(old)} there, {_short(new)} now"


def _short(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
