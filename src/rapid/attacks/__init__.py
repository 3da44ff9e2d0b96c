"""Attacks on what an agent sees: frozen specs with a text form, from the paper's four to a suite of strong ones.

Sizes are in features normalised by highway-env's ranges, so 0.1 is 20 m along the road, 0.4 m times the number of lanes
across it, and 8 m/s; or in metres and m/s. Importing this package imports nothing heavy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rapid.attacks.spec import NAMED, AttackSpec, as_spec, parse_attack

if TYPE_CHECKING:
    from rapid.attacks.attack import Attack as Attack
    from rapid.attacks.registry import get_attack as get_attack

__all__ = ["NAMED", "Attack", "AttackSpec", "as_spec", "get_attack", "parse_attack"]

_HOME = {"Attack": "rapid.attacks.attack", "get_attack": "rapid.attacks.registry"}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'rapid.attacks' has no attribute {name!r}")
