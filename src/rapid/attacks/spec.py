"""What an attack is, as data: a frozen spec with a name that can be written down and read back.

A text is a kind, then what differs from the kind's defaults: ``pgd:steps=50,restarts=5,radius=0.02,loss=margin``,
``adversary:DIRECTORY``. The paper's four (section 4.5) have names of their own: ``uniform``, ``gaussian``, ``fgsm`` and
``pgd`` alone mean what the paper did. This module imports nothing heavy.
"""

import dataclasses
import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args
from urllib.parse import quote, unquote

from rapid.errors import RapidError, did_you_mean
from rapid.road import RANGES
from rapid.scenarios import FEATURES

Kind = Literal[
    "none",
    "uniform",
    "gaussian",
    "fgsm",
    "pgd",
    "directed",
    "square",
    "transfer",
    "lie",
    "coupled",
    "world",
    "adversary",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
Norm = Literal["linf", "l2"]
Loss = Literal["ce", "margin", "dlr", "min-q", "mad"]
Target = Literal["faster", "idle", "sideways", "slower"]
Lie = Literal["far", "near", "left", "right", "drawn"]
Moves = Literal["all", "along", "place", "speed"]
MOVED: dict[Moves, tuple[str, ...]] = {
    "all": ("x", "y", "vx", "vy"),
    "along": ("x",),
    "place": ("x", "y"),
    "speed": ("vx", "vy"),
}
"""The features that an attack may change, beside presence."""


@dataclass(frozen=True)
class AttackSpec:
    """One attack; two are the same if everything but their label is.

    Raises:
        RapidError: a value out of range, or a field that this kind of attack does not have.
    """

    kind: Kind = "none"
    norm: Norm = "linf"
    """Norm of the ball, over all features that may move."""
    radius: float = 0.1
    """Size of the ball in features normalised by highway-env's ranges: 0.1 is 20 m along the road, 0.4 m times the
    lanes across it, 8 m/s. Of noise the half width or, if Gaussian, the standard deviation."""
    metres: float = 0.0
    """Instead of `radius`, half widths of a box in metres, along and across, and"""
    speed: float = 0.0
    """in m/s; as a sensor's data sheet has it."""
    presence: Literal["masked", "free"] = "masked"
    """Whether the presence feature may be changed too."""
    ego: Literal["free", "trusted"] = "free"
    """`trusted`: the row of the ego itself stays true (a car knows its own place and speed)."""
    moves: Moves = "all"
    """Which features of a car may be changed: all, its place `along` the road, its `place`, or its `speed`. A lie about
    one alone contradicts the others less, or more."""
    steps: int = 50
    """Gradient steps."""
    step: float = 0.0
    """Length of each step, in units of `radius`' features; 0: a tenth of the radius, smaller from the 20th step on."""
    restarts: int = 5
    """Runs for each observation: the first from the true one, the second from FGSM's point, the others from random
    points of the ball. Further ones are made only where the agent's action has not been changed yet."""
    start: Literal["clean", "random"] = "clean"
    """Where the first run begins."""
    loss: Loss = "ce"
    """What is made large: `ce` the cross-entropy of the agent's own action, `margin` how far the best other action
    surpasses it, `dlr` that margin over the spread of the values, `min-q` minus the true value of the action that is
    taken (as the agent's own critic has it), `mad` how far the policy moves from what it was (KL divergence)."""
    keep: Literal["best", "last"] = "best"
    """Which iterate is shown: the one with the largest loss, the true observation among them, or the last."""
    target: Target = "faster"
    """`directed`: the action that is wanted most; :data:`rapid.attacks.directed.ORDERS` has those that follow."""
    queries: int = 200
    """`square`: points tried for each observation."""
    to: Lie = "far"
    """`lie`: where all other cars are said to be, in every step alike: farther on and faster or less far and slower, to
    the left or to the right, each by all of the radius and the ego the other way; or every number shifted by all of it,
    up or down as is drawn once an episode."""
    coupling: float = 0.2
    """`coupled`: by what share of the ball's size the perturbation of a feature may change from step to step."""
    horizon: int = 10
    """`world`: decisions for which the true world is driven on by the agent, to see what an action leads to."""
    budget: int = 0
    """`world`: decisions of an episode that may be attacked, there where it costs most; 0: all."""
    source: str = ""
    """`transfer`: the agent that is attacked instead of the one that drives; `adversary`: directory of the adversary,
    or nothing where one is to be trained against each agent."""
    label: str = field(default="", compare=False)
    """How tables call it, if not by its text."""

    def __post_init__(self) -> None:
        _check(self)
        if self.metres or self.speed:
            # Of a box in metres the radius says nothing, so it must not tell two of them apart.
            object.__setattr__(self, "radius", defaults_of(self.kind)["radius"])

    @property
    def name(self) -> str:
        """Its text, :func:`parse_attack` reads it back."""
        for name, spec in NAMED.items():
            if spec == self:
                return name
        usual = defaults_of(self.kind)
        changed = [key for key in fields_of(self.kind) if getattr(self, key) != usual[key]]
        if not changed and self.kind in NAMED:  # the bare name is the paper's attack
            changed = [fields_of(self.kind)[0]]
        words = [quote(self.source, safe="/:~ ")] if self.source else []
        words += [f"{key}={_text(getattr(self, key))}" for key in changed if key != "source"]
        return f"{self.kind}:{','.join(words)}" if words else self.kind

    @property
    def shown(self) -> str:
        """Its label, or its text."""
        return self.label or self.name

    def sizes(self, lanes: int) -> tuple[float, ...]:
        """Return how far each feature may move, in the order of `scenarios.FEATURES`: as it is, m, m, m/s, m/s."""
        along, across, speed = RANGES
        sizes = tuple(self.radius * unit for unit in (1.0, along, across * lanes, speed, speed))
        if self.metres or self.speed:
            sizes = (1.0, self.metres, self.metres, self.speed, self.speed)
        return tuple(size * moves for size, moves in zip(sizes, self.mask(), strict=True))

    def mask(self) -> tuple[float, ...]:
        """Return 1 for each feature that `moves` lets change and for presence, as ordered in `scenarios.FEATURES`."""
        return tuple(float(feature in ("presence", *MOVED[self.moves])) for feature in FEATURES)

    def units(self, lanes: int) -> str:
        """Return the size in words: normalised, metres along and across, m/s, and what may move."""
        sizes = dict(zip(FEATURES, self.sizes(lanes), strict=True))
        told = {"x": f"{sizes['x']:.3g} m along", "y": f"{sizes['y']:.3g} m across", "vx": f"{sizes['vx']:.3g} m/s"}
        size = ", ".join(words for feature, words in told.items() if feature in MOVED[self.moves])
        words = size if self.metres or self.speed else f"{self.radius:g} ({size})"
        if self.presence == "free":
            words += ", presence too"
        return words + (", the ego's own row true" if self.ego == "trusted" else "")

    def describe(self, lanes: int) -> str:
        """Return what it does and its size in words, in metres and m/s on a road with `lanes` lanes."""
        if self.kind == "none":
            return "no perturbation"
        units = self.units(lanes)
        if self.kind == "uniform":
            return f"uniform within ±{units}"
        if self.kind == "gaussian":
            return f"Gaussian, standard deviation {units}"
        ball = f"{'L∞' if self.norm == 'linf' else 'L2'} ball of radius {units}"
        steps = f"{self.steps} steps{f' of {self.step:g}' if self.step else ''}"
        runs = f"{steps} × {self.restarts} runs" if self.restarts > 1 else steps
        loss = "" if self.loss == "ce" else f", loss {self.loss}"
        return {
            "fgsm": f"{ball}, 1 step{loss}",
            "pgd": f"{ball}, {runs}{loss}",
            "directed": f"{ball}, towards {self.target.upper()}, {runs}",
            "square": f"{ball}, without gradients, {self.queries} points{loss}",
            "transfer": f"{ball}, made on {self.source}, {runs}{loss}",
            "lie": f"the same lie in every step: {self.to}, within {units}",
            "adversary": f"{ball}, the action in reach that a learned adversary calls worst, {runs}",
            "world": f"{ball}, the action in reach that is worst in the true world within {self.horizon} decisions, "
            f"{f'{self.budget} attacked decisions an episode' if self.budget else 'every decision'}, {runs}",
            "coupled": f"{ball}, changing by {self.coupling:.0%} of it a step at most, {runs}{loss}",
        }[self.kind]


_SIZE = ("radius", "metres", "speed", "presence", "ego", "moves")
_RUNS = ("steps", "step", "restarts", "start", "norm", *_SIZE)
_FIELDS: dict[Kind, tuple[str, ...]] = {
    "none": (),
    "uniform": _SIZE,
    "gaussian": _SIZE,
    "fgsm": ("loss", "keep", "norm", *_SIZE),
    "pgd": (*_RUNS, "loss", "keep"),
    "directed": ("target", *_RUNS),
    "square": ("loss", "queries", *_SIZE),
    "transfer": ("source", *_RUNS, "loss"),
    "lie": ("to", *_SIZE),
    "world": ("horizon", "budget", *_RUNS),
    "adversary": ("source", *_RUNS),
    "coupled": ("coupling", "steps", "step", "restarts", *_SIZE, "loss"),
}

_OWN_DEFAULTS: dict[Kind, dict[str, Any]] = {
    "uniform": {"radius": 0.2},
    "gaussian": {"radius": 0.2},
    "directed": {"steps": 20, "restarts": 2},
    "square": {"loss": "margin"},
    "world": {"steps": 20, "restarts": 1},
    "adversary": {"steps": 20, "restarts": 1},
}


def fields_of(kind: Kind) -> tuple[str, ...]:
    """Return the fields that attacks of this kind have, besides kind and label."""
    return _FIELDS[kind]


def defaults_of(kind: Kind) -> dict[str, Any]:
    """Return what those fields are where a text says nothing else."""
    return {key: _OWN_DEFAULTS.get(kind, {}).get(key, _DEFAULT_VALUES[key]) for key in fields_of(kind)}


def parse_attack(text: str) -> AttackSpec:
    """Return the attack that a text names.

    Raises:
        RapidError: an unknown kind or field, a value of another type or out of range, or a source that is missing.
    """
    text = text.strip()
    if text in NAMED:
        return NAMED[text]
    kind, colon, rest = text.partition(":")
    if kind not in KINDS:
        known = tuple(dict.fromkeys((*NAMED, *KINDS)))
        raise RapidError(
            f"Unknown attack '{text}'{did_you_mean(kind, known)} Known attacks: {', '.join(known)}, with options as in "
            "pgd:steps=50,restarts=5,radius=0.02,loss=margin."
        )
    if colon and not rest.strip():
        raise RapidError(f"The attack '{text}' names no option after the colon. Leave the colon out, or add options.")
    changes = _read_options(text, kind, rest)
    return AttackSpec(kind=kind, **(defaults_of(kind) | changes))


def as_spec(attack: "str | AttackSpec") -> AttackSpec:
    """Return a spec as it is, a text as its spec.

    Raises:
        RapidError: what :func:`parse_attack` refuses.
    """
    return parse_attack(attack) if isinstance(attack, str) else attack


def with_options(spec: AttackSpec, options: str) -> AttackSpec:
    """Return `spec` with options in the form of a text, such as ``radius=0.05,ego=trusted``.

    Raises:
        RapidError: an option that attacks of this kind do not have, or a value out of range.
    """
    return replace(spec, **_read_options(options, spec.kind, options))


def _read_options(text: str, kind: Kind, rest: str) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    fields = fields_of(kind)
    for place, word in enumerate(rest.split(",") if rest.strip() else []):
        key, equals, value = (part.strip() for part in word.partition("="))
        if not equals and place == 0 and "source" in fields:
            key, value = "source", unquote(word.strip())
        elif not equals:
            raise RapidError(f"The attack '{text}' has '{word.strip()}', but options are written name=value.")
        if key not in fields:
            raise RapidError(
                f"The attack '{text}' has the option '{key}'{did_you_mean(key, fields)} "
                f"An attack of kind '{kind}' has {', '.join(fields) or 'no options'}."
            )
        if key in changes:
            raise RapidError(f"The attack '{text}' has the option '{key}' twice. Give it once.")
        changes[key] = _value(text, key, value)
    if "radius" in changes and ("metres" in changes or "speed" in changes):
        raise RapidError(f"The attack '{text}' has a radius, and metres or speed. Give one of the two.")
    return changes


def _value(text: str, key: str, value: str) -> Any:
    kind = type(_DEFAULT_VALUES[key])
    try:
        return kind(value)
    except ValueError as error:
        what = "a whole number" if kind is int else "a number"
        raise RapidError(f"The attack '{text}' has {key}={value}, but it must be {what}.") from error


def _text(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)


_CHOICES: dict[str, tuple[str, ...]] = {
    "kind": KINDS,
    "norm": get_args(Norm),
    "presence": ("masked", "free"),
    "ego": ("free", "trusted"),
    "moves": get_args(Moves),
    "start": ("clean", "random"),
    "loss": get_args(Loss),
    "keep": ("best", "last"),
    "target": get_args(Target),
    "to": get_args(Lie),
}
_BOUNDS: dict[str, tuple[float, float]] = {
    "radius": (0, 10),
    "metres": (0, 1000),
    "speed": (0, 1000),
    "steps": (1, 10_000),
    "step": (0, 10),
    "restarts": (1, 1000),
    "queries": (1, 100_000),
    "coupling": (0, 2),
    "horizon": (1, 60),
    "budget": (0, 1000),
}


def _check(spec: AttackSpec) -> None:
    for key, choices in _CHOICES.items():
        value = getattr(spec, key)
        if value not in choices:
            raise RapidError(
                f"An attack's {key} cannot be '{value}'{did_you_mean(str(value), choices)} "
                f"Choose one of {', '.join(choices)}."
            )
    for key, (low, high) in _BOUNDS.items():
        value = getattr(spec, key)
        if not (isinstance(value, int | float) and math.isfinite(value) and low <= value <= high):
            raise RapidError(
                f"An attack's {key} is {value}, but must be a finite number from {low:g} to {high:g}. Correct it."
            )
    unused = [
        key
        for key, default in _DEFAULT_VALUES.items()
        if key not in (*fields_of(spec.kind), "kind", "label") and getattr(spec, key) != default
    ]
    if unused:
        raise RapidError(
            f"An attack of kind '{spec.kind}' has no {', '.join(unused)}. "
            f"It has {', '.join(fields_of(spec.kind)) or 'no options'}."
        )
    if spec.norm == "l2" and (spec.metres or spec.speed):
        raise RapidError("metres and speed are half widths of a box: leave norm at 'linf', or give a radius instead.")
    if spec.source == "" and spec.kind == "transfer":
        raise RapidError(
            f"An attack of kind '{spec.kind}' needs a source: write {spec.kind}:DIRECTORY, with the directory of the "
            "agent that is attacked instead."
        )


_DEFAULT_VALUES: dict[str, Any] = {item.name: item.default for item in dataclasses.fields(AttackSpec)}

NAMED: dict[str, AttackSpec] = {
    "none": AttackSpec(),
    "uniform": AttackSpec("uniform", radius=0.2),
    "gaussian": AttackSpec("gaussian", radius=0.2),
    "fgsm": AttackSpec("fgsm", keep="last"),
    "pgd": AttackSpec("pgd", steps=10, step=0.01, restarts=1, keep="last"),
}
"""Attacks with a name of their own: none, and the paper's four."""
