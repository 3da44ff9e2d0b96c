"""What a report is made of: the artefacts of a run, in memory. Every part may be missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.recording import Recording
from rapid.experiments.paper import PaperResult, paper_result
from rapid.scenarios import Scenario

Entries = Sequence[Mapping[str, Any]]
"""The lines of a training's metrics file. `iteration` or `step` says when; all other numbers can be drawn."""

PAPER_METHODS: dict[str, tuple[str, str]] = {
    "rapid": ("attack", "RAPID"),
    "online-dqn": ("attack", "Online DQN"),
    "offline-dqn": ("attack", "Offline DQN"),
    "rapid-without-robust": ("attack", "RAPID without robust term"),
    "distilled": ("offline", "rapid"),
    "distilled-without-robust": ("offline", "rapid_without_robust"),
    "offline-ddqn": ("offline", "ddqn"),
    "cql": ("offline", "cql"),
}
"""Where the paper has the numbers of a method, as :func:`rapid.agents.origin.origin_of` tells it: a table, and its row
or column. No name counts, and of what this package did not train there are none."""


@dataclass(frozen=True)
class RoutingSnapshot:
    """The signed weight of each policy for each vehicle of one scene."""

    label: str
    """When: `before adaptation`, `after adaptation`."""
    weights_VN: NDArray[np.float32]
    """V vehicles, the ego first; N policies, the distilled one first."""
    obs_VF: NDArray[np.float32] | None = None
    """The scene, to say where each vehicle is and which rows are empty."""


@dataclass(frozen=True)
class ReportData:
    """One run."""

    title: str
    """What to call the run."""
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """The resolved settings, as :func:`rapid.config_io.to_dict` gives them."""
    versions: Mapping[str, str] = field(default_factory=dict[str, str])
    """Versions of what computed it."""
    commit: str = ""
    command: str = ""
    """The command that repeats it."""
    started: str = ""
    """When, as text."""
    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds per step, in order."""
    rows: Sequence[EpisodeRow] = ()
    """Episodes of all agents under all attacks."""
    main_agent: str = ""
    """The agent the run is about; by default the last one that was learned."""
    distill: Mapping[str, Entries] = field(default_factory=dict[str, Entries])
    """Training records of phase 2, by agent."""
    adapt: Mapping[str, Entries] = field(default_factory=dict[str, Entries])
    """Training records of phase 3, by agent."""
    routing: Sequence[RoutingSnapshot] = ()
    recordings: Sequence[Recording] = ()
    """Episodes to watch."""
    dataset: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Numbers of the dataset card, nested as they come."""
    trained: bool = True
    """Whether anything was trained; of a mere comparison nothing is said of wall time, curves, routing and data."""
    notes: Sequence[str] = ()
    """What a reader must know about this run."""

    @property
    def lead(self) -> str:
        """The agent the run is about, or nothing."""
        if self.main_agent:
            return self.main_agent
        return next((row.agent for row in reversed(self.rows) if row.kind == "learned"), "")


def paper_return(origin: str, scenario: Scenario, attack: str = "none") -> PaperResult | None:
    """Return what the paper prints for an agent of this origin here, None where it has no such number.

    The paper's reward is the normalised one, and its offline table has no attacks.
    """
    place = PAPER_METHODS.get(origin)
    if place is None or scenario.reward != "normalized" or scenario.dynamics != "v0" or scenario.clock:
        return None
    table, key = place
    if table == "attack":
        return paper_result("attack", attack, scenario=scenario.name, method=key)
    if attack != "none":
        return None
    return paper_result("offline", key, scenario=scenario.name, dataset="mixed")
