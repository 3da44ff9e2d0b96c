"""The compiled twin of HighwayEnv: same spawns, same decisions, same rewards, three orders of magnitude faster.

Importing this package also registers its ids with Gymnasium (see :mod:`rapid.registration`); nothing is compiled before
the first step.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, overload

import gymnasium

from rapid import registration
from rapid.errors import RapidError, did_you_mean
from rapid.scenarios import Scenario

if TYPE_CHECKING:
    from rapid.simulator.env import CompiledHighwayEnv as CompiledHighwayEnv
    from rapid.simulator.reference import ReferenceHighwayEnv, ReferenceVectorEnv
    from rapid.simulator.sb3 import Sb3Worlds as Sb3Worlds
    from rapid.simulator.vector_env import CompiledVectorEnv as CompiledVectorEnv

Simulator = Literal["compiled", "highway-env"]

__all__ = ["CompiledHighwayEnv", "CompiledVectorEnv", "Sb3Worlds", "make_env", "make_sb3_vec", "make_vec"]


_HOME = {
    "CompiledHighwayEnv": "rapid.simulator.env",
    "CompiledVectorEnv": "rapid.simulator.vector_env",
    "Sb3Worlds": "rapid.simulator.sb3",
}


@overload
def make_env(
    scenario: str | Scenario,
    simulator: Literal["compiled"] = "compiled",
    render_mode: str | None = None,
    config: Mapping[str, Any] | None = None,
) -> "CompiledHighwayEnv": ...


@overload
def make_env(
    scenario: str | Scenario,
    simulator: Literal["highway-env"],
    render_mode: str | None = None,
    config: Mapping[str, Any] | None = None,
) -> "ReferenceHighwayEnv": ...


@overload
def make_env(
    scenario: str | Scenario,
    simulator: Simulator,
    render_mode: str | None = None,
    config: Mapping[str, Any] | None = None,
) -> "gymnasium.Env[Any, Any]": ...


def make_env(
    scenario: str | Scenario,
    simulator: Simulator = "compiled",
    render_mode: str | None = None,
    config: Mapping[str, Any] | None = None,
) -> "gymnasium.Env[Any, Any]":
    """Return one world of a scenario as a Gymnasium environment.

    Args:
        scenario: a name such as ``lane-3-density-2``, a :class:`~rapid.scenarios.Scenario`, or HighwayEnv's own id
            ``highway-v0`` or ``highway-fast-v0``: its defaults, observation and target speeds included.
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


@overload
def make_vec(
    scenario: str | Scenario,
    num_envs: int,
    simulator: Literal["compiled"] = "compiled",
    seed: int | None = None,
    config: Mapping[str, Any] | None = None,
    autoreset: bool = True,
    processes: int = 1,
    render_mode: str | None = None,
) -> "CompiledVectorEnv": ...


@overload
def make_vec(
    scenario: str | Scenario,
    num_envs: int,
    simulator: Literal["highway-env"],
    seed: int | None = None,
    config: Mapping[str, Any] | None = None,
    autoreset: bool = True,
    processes: int = 1,
    render_mode: str | None = None,
) -> "ReferenceVectorEnv": ...


@overload
def make_vec(
    scenario: str | Scenario,
    num_envs: int,
    simulator: Simulator,
    seed: int | None = None,
    config: Mapping[str, Any] | None = None,
    autoreset: bool = True,
    processes: int = 1,
    render_mode: str | None = None,
) -> "gymnasium.vector.VectorEnv[Any, Any, Any]": ...


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
        scenario: a name such as ``lane-3-density-2``, a :class:`~rapid.scenarios.Scenario`, or HighwayEnv's own id
            ``highway-v0`` or ``highway-fast-v0``: its defaults, observation and target speeds included.
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


def make_sb3_vec(
    scenario: str | Scenario,
    num_envs: int,
    seed: int | None = None,
    config: Mapping[str, Any] | None = None,
    processes: int = 1,
    render_mode: str | None = None,
) -> "Sb3Worlds":
    """Return `num_envs` compiled worlds as a vector environment of stable-baselines3.

    The arguments are those of :func:`make_vec`; the worlds tell of their episodes as ``Monitor`` of
    stable-baselines3 does.

    Raises:
        RapidError: stable-baselines3 is not installed, or as :func:`make_vec`.
    """
    try:
        from rapid.simulator.sb3 import Sb3Worlds
    except ImportError as error:
        raise RapidError(
            f"make_sb3_vec needs stable-baselines3 ({error}). Install it: pip install stable-baselines3"
        ) from error
    from rapid.simulator.vector_env import CompiledVectorEnv

    return Sb3Worlds(CompiledVectorEnv(scenario, num_envs, seed, config, True, processes, render_mode))


def _is_compiled(simulator: str) -> bool:
    if simulator not in ("compiled", "highway-env"):
        raise RapidError(
            f"Unknown simulator {simulator!r}{did_you_mean(simulator, ('compiled', 'highway-env'))} "
            "Expected 'compiled' or 'highway-env'."
        )
    return simulator == "compiled"


def __getattr__(name: str) -> Any:
    if name in _HOME:
        from importlib import import_module

        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'rapid.simulator' has no attribute {name!r}")


registration.register()
