"""The options of a verb as a list: their short help, and what to say about one that the verb does not have.

A setting keeps its name in the tree (``distill.iterations``), but stands without its section at the verb that is about
that section (``rapid distill --iterations``); :attr:`Option.setting` is what the two have in common.
"""

import ast
import dataclasses
import inspect
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

from tyro.conf import Positional

from rapid.errors import RapidError, did_you_mean

MANY = 25
"""A verb with more options than this has a short help."""

SHORT: dict[str, tuple[str, ...]] = {
    "run": (
        *("scenario", "recipe", "scale", "plan", "seed", "data", "teacher.backend", "teacher.model"),
        *("teacher.base-url", "mix.p", "distill.iterations", "adapt.steps", "evaluate.spawns", "config", "directory"),
        "from",
    ),
    "collect": (
        *("out", "scenario", "teacher-transitions", "teacher.backend", "teacher.model", "teacher.style"),
        *("teacher.base-url", "teacher.api-key-env", "workers", "engine", "max-tokens", "max-cost", "max-seconds"),
        *("seed", "config"),
    ),
    "distill": (
        *("out", "iterations", "loss.discount", "loss.conservative-weight", "loss.robust-weight", "loss.robust.radius"),
        *("optimizer.algorithm", "optimizer.learning-rate", "optimizer.batch-size", "network.kind", "seed", "seeds"),
        *("recipe", "scale", "device", "config"),
    ),
    "adapt": (
        *("out", "dataset", "scenario", "steps", "ppo.steps", "train", "loss.discount", "optimizer.learning-rate"),
        *("offline-share", "adversary.gradient-share", "recipe", "scale", "plan", "seed", "device", "config"),
    ),
    "play": (
        *("scenario", "spawn", "moment", "port", "browser", "seed", "teacher.backend", "teacher.model"),
        *("teacher.style", "teacher.base-url", "teacher.api-key-env"),
    ),
}
"""Of the verbs with many options those that matter most, in the order in which they are told."""

_SAME = {"curve-spawns": "evaluate.curve-spawns", "directory": "out"}
"""Options that stand for a setting, or for another verb's option, of another name."""


@dataclass(frozen=True)
class Option:
    """One option of a verb."""

    name: str
    """As it is written, without the dashes before it."""
    setting: str
    """What it sets, by a name that is the same for all verbs."""
    kind: Any
    """Its type."""
    default: Any
    """What it is without being given."""
    text: str
    """Its docstring."""

    @property
    def words(self) -> tuple[str, ...]:
        """All ways to write it: of a truth also its contrary."""
        if self.kind is not bool:
            return (self.name,)
        section, dot, last = self.name.rpartition(".")
        return self.name, f"{section}{dot}no-{last}"

    @property
    def values(self) -> str:
        """What may follow it, for people."""
        if typing.get_origin(self.kind) is typing.Literal:
            return "{" + ",".join(map(str, typing.get_args(self.kind))) + "}"
        if typing.get_origin(self.kind) is tuple:
            return "VALUE ..."
        return {int: "N", float: "X", bool: ""}.get(self.kind, "TEXT")


def options_of(kind: type[Any], defaults: Any = None) -> list[Option]:
    """Return the options of a verb whose options are the dataclass `kind`; `defaults` is an instance of it."""
    return list(_walk(kind, defaults, "", ""))


def _walk(kind: type[Any], defaults: Any, name: str, setting: str) -> Iterator[Option]:
    hints, texts = typing.get_type_hints(kind, include_extras=True), _docstrings(kind)
    for item in dataclasses.fields(kind):
        hint, extras = hints[item.name], ()
        while hasattr(hint, "__metadata__"):
            hint, extras = typing.get_args(hint)[0], (*hint.__metadata__, *extras)
        if Positional in extras:
            continue
        plain = item.name.replace("_", "-")
        given = next((each.name for each in extras if getattr(each, "name", None) is not None), plain)
        value = getattr(defaults, item.name, item.default)
        if dataclasses.is_dataclass(hint):
            inner = "" if plain in ("settings", "source") else f"{setting}{plain}."
            yield from _walk(typing.cast(type, hint), value, f"{name}{given}." if given else name, inner)
        else:
            whole = f"{setting}{given}"
            yield Option(f"{name}{given}", _SAME.get(whole, whole), hint, value, texts.get(item.name, ""))


@cache
def _docstrings(kind: type[Any]) -> Mapping[str, str]:
    """The docstrings below the fields of a dataclass, as its source has them."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    found: dict[str, str] = {}
    statements = typing.cast(ast.ClassDef, body).body
    for statement, after in pairwise(statements):
        if (
            isinstance(statement, ast.AnnAssign)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            found[ast.unparse(statement.target)] = " ".join(str(after.value.value).split())
    return found


def short_help(verb: str, kind: type[Any], defaults: Any, width: int = 100) -> str:
    """Return the help of a verb with many options: those of :data:`SHORT`; empty for a verb with few."""
    options = {option.name: option for option in options_of(kind, defaults)}
    if len(options) <= MANY or verb not in SHORT:
        return ""
    hints = typing.get_type_hints(kind, include_extras=True)
    places = [name.upper() for name, hint in hints.items() if Positional in getattr(hint, "__metadata__", ())]
    lines = [" ".join(["usage: rapid", verb, *places, "[options]"]), "", inspect.cleandoc(kind.__doc__ or ""), ""]
    for name in SHORT[verb]:
        option = options[name]
        default = "" if option.default in ("", dataclasses.MISSING) else f" ({_shown(option.default)})"
        lines.append(f"  --{name} {option.values}{default}".rstrip())
        lines += textwrap.wrap(option.text, width, initial_indent=" " * 6, subsequent_indent=" " * 6)
    lines += ["", f"These are {len(SHORT[verb])} of {len(options)} options; all: rapid {verb} --help-all"]
    return "\n".join(lines)


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def check_options(verb: str, words: Sequence[str], kinds: Mapping[str, type[Any]]) -> None:
    """Look for words that are no options of `verb`; `kinds` are the options of all verbs.

    Raises:
        RapidError: the first one, with what the verb calls it, whose it is, or what is nearest.
    """
    own = options_of(kinds[verb])
    known = {word for option in own for word in option.words} | {"help", "help-all"}
    for word in words:
        name = word[2:].partition("=")[0].replace("_", "-")
        if not word.startswith("--") or not name or name in known:
            continue
        raise RapidError(f"`rapid {verb}` has no option '--{name}'{_instead(verb, name, own, kinds)}")


def _instead(verb: str, name: str, own: Sequence[Option], kinds: Mapping[str, type[Any]]) -> str:
    elsewhere = {
        other: option
        for other in ("run", *kinds)
        if other != verb
        for option in options_of(kinds[other])
        if name in option.words
    }
    settings = {option.setting: option for option in own}
    for other, option in elsewhere.items():
        if option.setting in settings:
            mine = settings[option.setting].words[option.words.index(name)]
            return f"; that is its name in `rapid {other}`, here it is --{mine}."
    if elsewhere:
        return f"; it is one of `rapid {next(iter(elsewhere))}`. Here there are: rapid {verb} --help-all"
    near = did_you_mean(name, [word for option in own for word in option.words]).replace("mean '", "mean '--")
    return f"{near} All of them: rapid {verb} --help-all"
