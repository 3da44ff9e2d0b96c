"""What stands in a text that names an agent: filters, defences and a monitor around agents, and where those belong.

Nothing is opened here but ONNX files, which tell their scenario by themselves.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

from rapid.agents.saved import CONFIG_FILE
from rapid.agents.shipped import agent_folder, is_shipped
from rapid.defences import is_defence, unwrapped
from rapid.errors import RapidError
from rapid.files import read_json, sha256

SHIELD = "shield:"
"""How the spec of an agent behind the interval filter begins."""

MONITORED = "monitored:"
"""How the spec of two agents with a monitor between them begins (:mod:`rapid.monitor`)."""


def monitored_parts(spec: str) -> tuple[str, str]:
    """Return the specs of the calm and of the wary agent of a spec such as ``monitored:CALM,WARY``.

    Raises:
        RapidError: it does not name two.
    """
    # The comma of a box such as shield:1m,0.5: stands before a number and a colon.
    found = re.fullmatch(r"(.*),(?!\s*[\d.]+:)(.*)", spec.removeprefix(MONITORED), re.S)
    calm, wary = found.groups() if found else ("", "")
    if not calm.strip() or not wary.strip():
        raise RapidError(
            f"'{spec}' does not name two agents. Expected monitored:CALM,WARY: who drives while what is seen can be "
            "true, and who drives once it cannot."
        )
    return calm.strip(), wary.strip()


def bare_agents(spec: str) -> list[str]:
    """Return the agents that `spec` names, without filters, defences and monitors around them."""
    while (shield := spec.startswith(SHIELD)) or is_defence(spec):
        spec = spec[len(SHIELD) :].partition(":")[2] if shield else unwrapped(spec).agent
    if spec.startswith(MONITORED):
        return [bare for part in monitored_parts(spec) for bare in bare_agents(part)]
    return [spec]


def agent_file(spec: str) -> Path:
    """Return the file that says what a bare agent is: of a saved one its settings, which name the hash of its weights.

    Of a driver it does not exist.
    """
    return agent_folder(spec) / CONFIG_FILE if is_shipped(spec) or Path(spec).is_dir() else Path(spec)


def own_scenario(specs: Sequence[str]) -> str:
    """Return the scenario in which the saved agents among `specs` were trained; empty if none of them is saved.

    An ONNX file knows its own too, if RAPID wrote it.

    Raises:
        RapidError: they were trained in different ones.
    """
    found: dict[str, str] = {}
    for bare in chain.from_iterable(map(bare_agents, specs)):
        if scenario := _trained_in(bare):
            found.setdefault(scenario, bare)
    if len(found) > 1:
        told = ", ".join(f"'{spec}' in {scenario}" for scenario, spec in found.items())
        raise RapidError(f"These agents were trained in different scenarios: {told}. Say where with --scenario.")
    return next(iter(found), "")


def _trained_in(spec: str) -> str:
    """Return the scenario that a bare agent was trained in; empty if that is not known."""
    path, metadata = agent_file(spec), {}
    if path.suffix == ".onnx" and path.is_file():
        from rapid.agents.onnx import OnnxAgent

        with suppress(RapidError):  # opening it says what is wrong
            metadata = OnnxAgent(path).metadata
    elif path.name == CONFIG_FILE and path.is_file():
        metadata = read_json(path, "agent").get("metadata", {})
    scenario = metadata.get("scenario") if isinstance(metadata, dict) else None
    return scenario if isinstance(scenario, str) else ""


def digest(spec: str) -> str:
    """Return what tells the agents that `spec` names from others in their place; empty for drivers without a file."""
    files = [agent_file(bare) for bare in bare_agents(spec)]
    return "+".join(sha256(file) for file in files if file.is_file())
