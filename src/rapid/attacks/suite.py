"""Attacks that are measured together: the paper's, a strong suite, sensor errors, columns of what is trusted, a sweep.

A preset is named among attacks (``rapid evaluate --attacks suite``), with options for all of its members if wanted:
``suite:radius=0.05,ego=trusted``. This module imports nothing heavy.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product

from rapid.attacks.spec import KINDS, NAMED, AttackSpec, parse_attack, with_options
from rapid.errors import RapidError, did_you_mean

PAPER = ("none", "uniform", "gaussian", "fgsm", "pgd")
STRONG = (
    *(f"pgd:loss={loss}" for loss in ("ce", "margin", "dlr", "min-q", "mad")),
    *(f"directed:target={target}" for target in ("faster", "idle", "sideways", "slower")),
    "square",
    "lie:to=far",
    "lie:to=near",
    "lie:to=drawn",
    "coupled",
    "world",
    "world:budget=1",
    "adversary",
)
"""Each within the same ball; the worst case is taken over them."""
SWEPT = ("pgd:loss=margin", "directed:target=faster", "directed:target=idle", "world")
"""Attacks of a sweep over sizes: those that were found to do most."""
RADII = (0.005, 0.01, 0.02, 0.05, 0.1)
PLAUSIBLE = (
    "lie:to=near,moves=along,ego=trusted",
    "lie:moves=along,ego=trusted",
    "coupled:coupling=0.1,moves=along,ego=trusted",
    "pgd:loss=margin,moves=along,ego=trusted",
    "world:moves=along,ego=trusted",
)
"""Lies that contradict nothing else that is seen, or little: other cars are only farther on, or less far."""
SENSOR = "metres=1,speed=0.5"
"""What a good sensor may be wrong by."""


def suite(options: str = "") -> list[AttackSpec]:
    """Return the strong suite, none before it, and beside it uniform noise of twice its size."""
    members = [parse_attack(text) for text in STRONG]
    noise = parse_attack("uniform:radius=0.1")
    if options:
        members, noise = [with_options(spec, options) for spec in members], with_options(noise, options)
    if noise.metres or noise.speed:
        noise = replace(noise, metres=2 * noise.metres, speed=2 * noise.speed)
    else:
        noise = replace(noise, radius=2 * noise.radius)
    return [NAMED["none"], *members, noise]


def _paper(options: str) -> list[AttackSpec]:
    specs = [parse_attack(text) for text in PAPER]
    return [with_options(spec, options) if options and spec != NAMED["none"] else spec for spec in specs]


def _columns(options: str) -> list[AttackSpec]:
    given = f",{options}" if options else ""
    return [
        spec
        for presence, ego in product(("masked", "free"), ("free", "trusted"))
        for spec in suite(f"presence={presence},ego={ego}{given}")
    ]


def _sweep(options: str) -> list[AttackSpec]:
    given = f",{options}" if options else ""
    swept = [with_options(parse_attack(text), f"radius={radius}{given}") for radius in RADII for text in SWEPT]
    return [NAMED["none"], *swept]


def _plausible(options: str) -> list[AttackSpec]:
    lies = [parse_attack(text) for text in PLAUSIBLE]
    return [NAMED["none"], *(with_options(spec, options) if options else spec for spec in lies)]


PRESETS: dict[str, Callable[[str], list[AttackSpec]]] = {
    "paper": _paper,
    "suite": suite,
    "sensor": lambda options: suite(f"{SENSOR},{options}" if options else SENSOR),
    "columns": _columns,
    "sweep": _sweep,
    "plausible": _plausible,
}
"""Makers of the attacks of a preset; they take options for all of them. `columns` is the suite four times: presence
masked and free, the ego's own row trusted and not."""


def expand(texts: Iterable[str]) -> list[AttackSpec]:
    """Return the attacks that texts name, presets unfolded, each once and in order.

    Raises:
        RapidError: a text that names neither a preset nor an attack, or options that do not fit.
    """
    found: dict[AttackSpec, None] = {}
    for text in texts:
        name, colon, options = text.strip().partition(":")
        if name in PRESETS:
            if colon and not options.strip():
                raise RapidError(f"The preset '{text}' names no option after the colon. Leave it out, or add options.")
            specs: Sequence[AttackSpec] = PRESETS[name](options.strip())
        elif name in KINDS or name in NAMED:
            specs = [parse_attack(text)]
        else:
            known = (*PRESETS, *dict.fromkeys((*NAMED, *KINDS)))
            raise RapidError(
                f"Unknown attack '{text}'{did_you_mean(name, known)} Known presets: {', '.join(PRESETS)}. Known "
                f"attacks: {', '.join(dict.fromkeys((*NAMED, *KINDS)))}, with options as in pgd:steps=50,radius=0.02."
            )
        found |= dict.fromkeys(specs)
    return list(found)
