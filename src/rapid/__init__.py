"""RAPID: turn slow, clever LLM drivers into fast, robust driving policies.

Importing this package imports nothing heavy; each name is loaded on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rapid.registration import register_when_imported

if TYPE_CHECKING:
    from rapid.agents.monitored import load_agent as load_agent
    from rapid.data.dataset import load_dataset as load_dataset
    from rapid.play.inline import watch as watch
    from rapid.simulator import make_env as make_env
    from rapid.simulator import make_sb3_vec as make_sb3_vec
    from rapid.simulator import make_vec as make_vec

__version__ = "0.2.0"
__all__ = ["__version__", "load_agent", "load_dataset", "make_env", "make_sb3_vec", "make_vec", "watch"]

_HOME = {
    "load_agent": "rapid.agents.monitored",
    "load_dataset": "rapid.data.dataset",
    "make_env": "rapid.simulator",
    "make_sb3_vec": "rapid.simulator",
    "make_vec": "rapid.simulator",
    "watch": "rapid.play.inline",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'rapid' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


register_when_imported()
