"""From the words of the command line to a verb's options and the settings of its work."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import tyro

from rapid.bounds import check_bounds
from rapid.config import PLANS, RECIPES, SCALES, Config
from rapid.config_io import apply_overrides, load_toml, validate
from rapid.errors import RapidError
from rapid.options import Adversary, Evaluate, Run, Source
from rapid.presets import of_file, preset, without_presets
from rapid.tool_options import Certify, Play, Reproduce
from rapid.usage import check_options, short_help

T = TypeVar("T")


def parse(verb: str, kinds: Mapping[str, type[Any]], words: Sequence[str]) -> tuple[Any, Config]:
    """Return a verb's options and the settings that they and a settings file give; `kinds` are all verbs' options.

    Raises:
        RapidError: an option that the verb does not have, or any value that cannot be used.
        SystemExit: after printing the help, or tyro's own explanation of a wrong value (2).
    """
    kind, words = kinds[verb], list(words)
    check_options(verb, words, kinds)
    base = base_settings(words)
    defaults = _defaults(kind, base)
    if {"-h", "--help"} & set(words) and (text := short_help(verb, kind, defaults)):
        print(text)
        raise SystemExit(0)
    options = tyro.cli(
        kind,
        args=["--help" if word == "--help-all" else word for word in words],
        prog=f"rapid {verb}",
        default=defaults,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )
    check_bounds(options)
    return options, _with_options(base, options)


def base_settings(words: Sequence[str]) -> Config:
    """The settings that recipe, scale, plan and a settings file give, before the options.

    Raises:
        RapidError: an option names another recipe, scale or plan than the file, whose settings would contradict it.
    """
    file = _option(words, "config")
    overrides = load_toml(file) if file else {}
    choices = {"recipe": RECIPES, "scale": SCALES, "plan": PLANS}
    asked = {name: value for name in choices if (value := _option(words, name))}
    if {"-h", "--help", "--help-all"} & set(words):
        asked = {name: value for name, value in asked.items() if value in choices[name]}
    for name, value in asked.items():
        if name in overrides and overrides[name] != value:
            raise RapidError(
                f"The settings file '{file}' is of the {name} '{overrides[name]}', and --{name} says '{value}'. Its "
                f"other settings would stay, so what ran would be neither. Leave --{name} out, or the file."
            )
    # A file that names only some of the three leaves the others to the options; a run's own names them all.
    named = {name: str(overrides[name]) for name in choices if name in overrides} | asked
    base = of_file(overrides | asked) if {"recipe", "scale"} <= overrides.keys() else preset(**named)
    return apply_overrides(base, without_presets(overrides), source=f"'{file}'")


def _option(words: Sequence[str], name: str) -> str:
    """The value of ``--name value`` or ``--name=value`` among `words`, or an empty string."""
    for i, word in enumerate(words):
        if word == f"--{name}":
            return words[i + 1] if i + 1 < len(words) else ""
        if word.startswith(f"--{name}="):
            return word.partition("=")[2]
    return ""


def _defaults(kind: type[T], base: Config) -> T:
    """An instance of a verb's options with the values of `base`; positional fields stay required."""
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):  # pyright: ignore[reportArgumentType]
        if item.name == "settings":
            values[item.name] = base
        elif item.name == "source":
            values[item.name] = Source(base.recipe, base.scale, base.plan)
        elif hasattr(base, item.name) and item.default in (dataclasses.MISSING, getattr(Config, item.name, None)):
            values[item.name] = getattr(base, item.name)
        elif item.name == "curve_spawns":
            values[item.name] = base.evaluate.curve_spawns
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            values[item.name] = tyro.MISSING
    return kind(**values)


def _with_options(base: Config, options: Any) -> Config:
    """`base` with the sections and values that a verb's options carry."""
    if isinstance(options, Run):
        return validate(options.settings)
    if isinstance(options, Evaluate) and not options.scenario:
        from rapid.agents.specs import own_scenario

        options = dataclasses.replace(options, scenario=own_scenario(options.agents) or base.scenario)
    if isinstance(options, Adversary | Certify) and not options.scenario:
        from rapid.agents.specs import own_scenario

        options = dataclasses.replace(options, scenario=own_scenario([options.agent]) or base.scenario)
    if isinstance(options, Play) and not options.scenario:
        options = dataclasses.replace(options, scenario=base.scenario)  # the page itself asks where its agents belong
    if isinstance(options, Reproduce):
        options = dataclasses.replace(options, recipe=options.recipe or base.recipe)  # without one: each id's own
    names = {item.name for item in dataclasses.fields(options)} & {item.name for item in dataclasses.fields(Config)}
    config = dataclasses.replace(base, **{name: getattr(options, name) for name in names})
    curve_spawns = getattr(options, "curve_spawns", None)
    if curve_spawns is not None:
        config = dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, curve_spawns=curve_spawns))
    return validate(config)
