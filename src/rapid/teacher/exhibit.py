"""A conversation as people read it, and one of them shown as the paper shows one (appendix "Prompt Setup").

The paper shows two figures: the prefix prompt, and one interaction in which the model asks for facts in rounds and then
gives its decision with a reason.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rapid.data.dataset import load_dataset
from rapid.errors import RapidError
from rapid.scenarios import ACTIONS, get_scenario
from rapid.teacher.answers import is_placeholder
from rapid.teacher.briefing import prefix
from rapid.teacher.decision import Turn, turns_of
from rapid.teacher.prompt import Prompt

SHOWN = "shipped:lane-3-density-2/react"
"""The conversations from which one is shown."""


@dataclass(frozen=True)
class Exhibit:
    """A prefix prompt and the interaction that followed it."""

    model: str
    """Who drove, as the dataset names it."""
    scenario: str
    spawn_seed: int
    step: int
    """Decisions before this one in the episode."""
    prefix: str
    """Task, actions, rules, tools and form of the answer: what is the same at every decision."""
    scene: str
    """The rest of the prefix prompt: the scene, and the previous decision with its reason."""
    turns: tuple[Turn, ...]
    """The interaction, up to the answer that decided."""
    action: str
    """The decision, in the paper's words."""
    reason: str
    """Its reason in the model's words."""

    def markdown(self) -> str:
        """Return the two figures as Markdown."""
        who = {"model": "The model", "tool": "A tool", "driver": "RAPID"}
        lines = [
            f"**Prefix prompt** ({self.scenario}, spawn {self.spawn_seed}, decision {self.step + 1}, to {self.model})",
            *("", _quoted(f"{self.prefix}\n\n{self.scene}"), "", "**Interaction**"),
        ]
        for turn in self.turns:
            lines += ["", f"{who[turn.role]}:", "", _quoted(turn.text)]
        return "\n".join([*lines, "", f"**Decision**: {self.action}", ""])


def prompt_exhibit(
    dataset: str | os.PathLike[str] = SHOWN, spawn_seed: int | None = None, step: int | None = None
) -> Exhibit:
    """Return a decision of a dataset that was collected in `react` style, with all that was said.

    Args:
        dataset: a directory, or a shipped set.
        spawn_seed: the episode; by default that with the decision that has the most turns and the longest reason, among
            those that the model made at once and explained in words of its own.
        step: the decision in it, from 0 on.

    Raises:
        RapidError: there is no such decision, or its prompt is not one of today's version.
    """
    data = load_dataset(dataset)
    rows: list[Mapping[str, Any]] = [] if data.log is None else data.log.to_pylist()
    rows = [row for row in rows if row["turns"]]
    if spawn_seed is None and step is None:
        rows = [row for row in rows if row["status"] == "ok" and row["step"] and not is_placeholder(row["explanation"])]
    else:
        rows = [row for row in rows if spawn_seed in (None, row["spawn_seed"]) and step in (None, row["step"])]
    if not rows:
        raise RapidError(
            f"'{dataset}' holds no such conversation. Name a dataset that was collected with --teacher.style react, "
            "and a spawn seed and step that it has."
        )
    row = max(rows, key=lambda row: (len(turns_of(row["turns"])), len(row["explanation"])))
    lanes = get_scenario(data.scenario).lanes
    systems = [prefix(lanes, style, native) for style in ("react", "digest") for native in (False, True)]
    system = next((text for text in systems if Prompt(text, row["told"]).hash == row["prompt_hash"]), None)
    if system is None:
        raise RapidError(
            f"The prompts in '{dataset}' are not those of this version of RAPID, which cannot tell what the model was "
            "told. Show a dataset that this version collected."
        )
    return Exhibit(
        model=str(data.drivers.get("teacher", {}).get("name", "unknown")),
        scenario=data.scenario,
        spawn_seed=int(row["spawn_seed"]),
        step=int(row["step"]),
        prefix=system,
        scene=str(row["told"]),
        turns=turns_of(row["turns"]),
        action=ACTIONS[row["action"]],
        reason=str(row["explanation"]),
    )


def _quoted(text: str) -> str:
    """Return a text that a model wrote as a block that Markdown leaves alone."""
    return "\n".join(f"    {line}" for line in text.splitlines())
