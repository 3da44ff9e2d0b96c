"""The trained agents that come with the package: ``shipped:SCENARIO/NAME`` is one, wherever an agent is expected.

Each is a directory as `save_agent` writes it, with ``card.json`` (what it is, how it was made, what it scores,
its limits and the hash of its weights) and, where its network can be exported, ``agent.onnx``.
"""

import os
from pathlib import Path
from typing import Any

from rapid.data.shipped import SHIPPED
from rapid.errors import RapidError, did_you_mean
from rapid.files import read_json

_FOLDER = Path(__file__).resolve().parents[1] / SHIPPED
CARD_FILE, ONNX_FILE = "card.json", "agent.onnx"


def shipped_agents() -> tuple[str, ...]:
    """Return their names, SCENARIO/NAME, sorted."""
    found = (path.parent for path in _FOLDER.glob("*/agents/*/config.json"))
    return tuple(sorted(f"{path.parent.parent.name}/{path.name}" for path in found))


def shipped_adversaries() -> tuple[str, ...]:
    """Return the names of the learned adversaries, SCENARIO/adversary-of-NAME, sorted: attacks, no drivers."""
    found = (path.parent for path in _FOLDER.glob("*/adversaries/*/config.json"))
    return tuple(sorted(f"{path.parent.parent.name}/{path.name}" for path in found))


def is_shipped(path: str | os.PathLike[str]) -> bool:
    """Whether a path is the name of something that comes with the package."""
    return os.fspath(path).startswith(f"{SHIPPED}:")


def agent_folder(path: str | os.PathLike[str]) -> Path:
    """Return the directory that `path` stands for: a shipped agent's or adversary's after ``shipped:``, else itself.

    Raises:
        RapidError: none of this name is shipped.
    """
    if not is_shipped(path):
        return Path(path)
    name = os.fspath(path).partition(":")[2]
    known = (*shipped_agents(), *shipped_adversaries())
    if name not in known:
        raise RapidError(
            f"No agent '{name}' is shipped{did_you_mean(name, known)} `rapid agents list` shows them: "
            f"{', '.join(known) or 'none'}."
        )
    scenario, _, agent = name.partition("/")
    return _FOLDER / scenario / ("adversaries" if name in shipped_adversaries() else "agents") / agent


def card(name: str) -> dict[str, Any]:
    """Return what is known of a shipped agent, by SCENARIO/NAME.

    Raises:
        RapidError: there is none of this name, or its card is damaged.
    """
    found = read_json(agent_folder(f"{SHIPPED}:{name}") / CARD_FILE, "card of an agent")
    if not isinstance(found, dict):
        raise RapidError(f"The card of the shipped agent '{name}' is damaged. Install RAPID again.")
    return found


def listing() -> str:
    """Return every shipped agent with what it is and what it scores, as a table."""
    from rapid.evaluation.summary import aligned  # with what it needs: only who asks for the table waits for it

    lines = [["agent", "return", "crash share", "worst of the paper's attacks", "what it is"]]
    for name in shipped_agents():
        about = card(name)
        scores = about.get("scores", {})
        clean, worst = scores.get("none", {}), scores.get("worst", {})
        lines.append(
            [
                f"{SHIPPED}:{name}",
                f"{clean['return']:.1f}" if clean else "–",
                f"{clean['crash_share']:.2f}" if clean else "–",
                f"{worst['return']:.1f} ({worst['attack']})" if worst else "–",
                str(about.get("summary", "")),
            ]
        )
    attacks = [f"{SHIPPED}:{name}: {card(name).get('summary', '')}" for name in shipped_adversaries()]
    return "\n".join(
        [aligned(lines), *(["", "Learned adversaries, for --attacks adversary:NAME", *attacks] if attacks else [])]
    )
