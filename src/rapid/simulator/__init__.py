"""The compiled twin of HighwayEnv: same spawns, same decisions, same rewards, three orders of magnitude faster.

Importing this package also registers ``rapid/Highway-v0`` with Gymnasium (``gymnasium.make("rapid.simulator:
rapid/Highway-v0", scenario="lane-4-density-2.5")`` imports it by itself); nothing is compiled before the first step.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import gymnasium

from rapid.errors import RapidError, did_you_mean
from rapid.scenarios import Scenario

if TYPE_CHECKING:
    from rapid.simulator.env import CompiledHighwayEnv as CompiledHighwayEnv
    from rapid.simulator.vector_env import CompiledVectorEnv as CompiledVectorEnv

Simulator = Literal["compiled", "highway-env"]

__all__ = ["CompiledHighwayEnv", "CompiledVectorEnv", "make_env", "make_vec"]


_HOME = {
    "CompiledHighwayEnv": "rapid.simulator.env",
    "CompiledVectorEnv": "rapid.simulator.vector_env",
}


def make_env(
    scenario: str | Scenario,
    simulator: Simulator = "compiled",
    render_mode: str | None = None,
    config: Mapping[str, Any] | None = None,
) -> "gymnasium.Env[Any, Any]":
    """Return one world of a scenario as a Gymnasium environment.

    Args:
        scenario: a name such as ``lane-3-density-2``, or a :class:`~rapid.scenarios.Scenario`.
        simulator: "compiled", or "highway-env" for the original with the same seeds, spaces and info.
        render_mode: as Gymnasium has it.
        config: keys of highway-env's configuration to override. ``observation`` and ``action`` are merged key by key
            unless they name a ``type``.

    Raises:
        RapidError: an unknown scenario or simulator, or a configuration that it does not cover.
    """
    if _is_compiled(simulator):
        from rapid.simulator.env import CompiledHighwayEnv

        return CompiledHighwayEnv(scenario, render_mode, config)
    from rapid.simulator.reference import make_reference_env

    return make_reference_env(scenario, render_mode, config)


def make_vec(
    scenario: str | Scenario,
    num_envs: int,
    simulator: Simulator = "compiled",
    seed: int | None = None,
    config: Mapping[str, Any] | None = None,
    autoreset: bool = True,
    processes: int = 1,
    render_mode: str | None = None,
) -> "gymnasium.vector.VectorEnv[Any, Any, Any]":
    """Return `num_envs` worlds of a scenario as a Gymnasium vector environment.

    Args:
        scenario: a name such as ``lane-3-density-2``, or a :class:`~rapid.scenarios.Scenario`.
        num_envs: how many.
        simulator: "compiled", or "highway-env" for the original with the same seeds, spaces and info.
        seed: seeds the first ``reset()`` that is called without one, world i with ``seed + i``.
        config: keys of highway-env's configuration to override, merged as in :func:`make_env`.
        autoreset: whether an ended episode is followed by the next within the same step (SAME_STEP, with ``final_obs``
            and ``final_info`` in the info). If not, ended worlds stand still and earn 0.
        processes: among how many processes the compiled worlds are divided, this one included; the results are the
            same. Needs ``if __name__ == "__main__":`` around the work of a script.
        render_mode: None, or "rgb_array" for pictures of the first compiled worlds.

    Raises:
        RapidError: an unknown scenario or simulator, no worlds, a configuration that is not covered, or processes that
            cannot be started.
    """
    if _is_compiled(simulator):
        from rapid.simulator.vector_env import CompiledVectorEnv

        return CompiledVectorEnv(scenario, num_envs, seed, config, autoreset, processes, render_mode)
    if processes != 1 or render_mode is not None:
        raise RapidError("Only the compiled simulator has processes and render_mode for many worlds; leave them out.")
    from rapid.simulator.reference import make_reference_vec

    return make_reference_vec(scenario, num_envs, seed, config, autoreset)


def _is_compiled(simulator: str) -> bool:
    if simulator not in ("compiled", "highway-env"):
        raise RapidError(
            f"Unknown simulator {simulator!r}{did_you_mean(simulator, ('compiled', 'highway-env'))} "
            "Expected 'compiled' or 'highway-env'."
        )
    return simulator == "compiled"


def make_registered_vec(num_envs: int, scenario: str = "lane-3-density-2", **options: Any) -> Any:
    """Return what ``gymnasium.make_vec("rapid/Highway-v0", num_envs, scenario=...)`` makes."""
    return make_vec(scenario, num_envs, **options)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        from importlib import import_module

        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'rapid.simulator' has no attribute {name!r}")


gymnasium.register(
    id="rapid/Highway-v0",
    entry_point="rapid.simulator.env:CompiledHighwayEnv",
    vector_entry_point="rapid.simulator:make_registered_vec",
)
