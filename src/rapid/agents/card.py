"""The card of an agent as Markdown, for the Hugging Face Hub: what it is, what it scores, how to use it."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from rapid.agents.q_agent import QAgent
from rapid.text import in_markdown


def front_matter(tags: list[str], licence: Any, **more: Any) -> str:
    """Return the YAML head by which the hub sorts a card; `licence` is left out unless it reads as an identifier.

    Its values are JSON, which is YAML in which no text can end the head.
    """
    entries: dict[str, Any] = {"library_name": "rapid", "tags": ["autonomous-driving", "highway-env", *tags], **more}
    if isinstance(licence, str) and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9.-]*", licence):
        entries["license"] = licence.lower()
    return "".join(["---\n", *(f"{key}: {json.dumps(value)}\n" for key, value in entries.items()), "---\n"])


def markdown(agent: QAgent, about: Mapping[str, Any], repository: str) -> str:
    """Return the card.

    Args:
        agent: the agent.
        about: its ``card.json``, empty if it has none; any of its entries may be missing or of any kind.
        repository: OWNER/NAME, from which the card says it is fetched.
    """
    facts = {**agent.metadata, **about}
    name = repository.partition("/")[2]
    lines = [f"# {in_markdown(name)}", ""]
    lines += [in_markdown(str(facts["summary"])), ""] if facts.get("summary") else []
    network = agent.network
    weights = sum(weight.numel() for weight in network.parameters())
    lines.append(
        f"A driving policy of RAPID: a Q-network of kind `{network.config.kind}` with {weights:,} weights, which reads "
        f"{agent.vehicles} vehicles × 5 features and chooses one of five actions, made for {network.lanes} lanes."
    )
    for key in ("scenario", "phase", "seed", "commit"):
        if facts.get(key) not in (None, ""):
            lines += ["", f"{key.capitalize()}: {in_markdown(str(facts[key]))}"]
    lines += _scores(facts.get("scores"))
    for key in ("scores_are", "limits"):
        lines += ["", in_markdown(str(facts[key]))] if facts.get(key) else []
    lines += [
        "",
        "## Using it",
        "",
        "```text",
        f"rapid pull {repository} --out {name}",
        f"rapid evaluate {name} rule --attacks none uniform fgsm",
        "```",
        "",
        f'From Python, `rapid.load_agent("{name}").act(observations)` gives the actions. The weights are safetensors, '
        "the rest is JSON; nothing in this repository runs code.",
    ]
    return front_matter(["reinforcement-learning"], about.get("licence"), pipeline_tag="reinforcement-learning") + (
        "\n".join(lines) + "\n"
    )


def _scores(scores: Any) -> list[str]:
    """Return the table of returns and crashes, nothing if there are none."""
    rows = scores.items() if isinstance(scores, dict) else ()
    found = [
        f"| {in_markdown(_title(attack, row))} | {_number(row, 'return', 2)} | {_number(row, 'crash_share', 3)} "
        f"| {_number(row, 'episodes', 0)} |"
        for attack, row in rows
        if isinstance(row, dict)
    ]
    return ["", "| attack | return | crash share | episodes |", "|---|---|---|---|", *found] if found else []


def _title(attack: Any, row: dict[str, Any]) -> str:
    return f"worst ({row['attack']})" if attack == "worst" and "attack" in row else str(attack)


def _number(row: dict[str, Any], key: str, digits: int) -> str:
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}f}"
