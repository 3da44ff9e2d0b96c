"""Ids for ``gymnasium.make``: ``rapid/highway-v0``, ``rapid/highway-fast-v0``, and ``rapid/Highway-v0`` by scenario.

Importing RAPID imports nothing heavy, Gymnasium neither. So the ids are registered at once where Gymnasium is there
already, and else right after somebody imports it.
"""

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

ENTRY_POINT = "rapid.simulator.env:CompiledHighwayEnv"
VECTOR_ENTRY_POINT = "rapid.simulator:make_vec"
IDS: dict[str, dict[str, Any]] = {
    "rapid/highway-v0": {"scenario": "highway-v0"},
    "rapid/highway-fast-v0": {"scenario": "highway-fast-v0"},
    "rapid/Highway-v0": {"scenario": "lane-3-density-2"},
}
"""Each id and the arguments that it stands for; ``scenario`` may be overridden."""


def register() -> None:
    """Register the ids with Gymnasium; those that are there already are left alone."""
    import gymnasium

    for name, arguments in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, ENTRY_POINT, vector_entry_point=VECTOR_ENTRY_POINT, kwargs=arguments)


def register_when_imported() -> None:
    """Register the ids now if Gymnasium is imported, else as soon as it is."""
    if hasattr(sys.modules.get("gymnasium"), "register"):
        register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """Lets the usual finders find Gymnasium, and has the ids registered once it is imported; then it is gone."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _RegisteringLoader(spec.loader)
        return spec


class _RegisteringLoader(Loader):
    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        spec = module.__spec__
        if spec is not None:
            spec.loader = self._loader  # what the module says of itself is as if nobody had been here
        module.__loader__ = self._loader
        self._loader.exec_module(module)
        register()
