"""Who can be chosen on the live page. The page names an entry of this list, never a path of its own."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.agents.open import PLANNERS, check_road, open_agent
from rapid.agents.saved import CONFIG_FILE, FORMAT, MONITORED_FORMAT
from rapid.agents.shipped import shipped_agents
from rapid.config import TeacherConfig
from rapid.data.shipped import SHIPPED
from rapid.errors import RapidError, did_you_mean
from rapid.evaluation.summary import label_of
from rapid.files import read_json
from rapid.scenarios import IDLE, get_scenario
from rapid.teacher import make_teacher
from rapid.teacher.models import is_present
from rapid.teacher.scripted import SCRIPTED

YOU = "you"
TEACHER = "teacher"
MOST_FOUND = 100
"""Saved agents that are listed at most."""


class You:
    """The reader of the page, who says by key or button what comes next."""

    name = YOU

    def __init__(self) -> None:
        self.next = IDLE

    def act(self, obs_BVF: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return what was chosen (B,)."""
        return np.full(len(obs_BVF), self.next, np.int64)


@dataclass(frozen=True)
class Entry:
    """One who can drive."""

    key: str
    """What :func:`~rapid.agents.open.open_agent` takes, or `you`, or `teacher`."""
    label: str
    group: str
    """Under which heading it stands."""
    scenario: str = ""
    """Where it was trained, if it was."""


class Roster:
    """All who can be chosen; whoever is chosen is opened once.

    Args:
        named: agents that were named when the program was started; they come first.
        root: below which saved agents are looked for.
        teacher: the settings of the entry `teacher`.
        seed: of drivers that draw.

    Raises:
        RapidError: a named agent that does not exist.
    """

    def __init__(
        self, named: Sequence[str] = (), root: Path | None = None, teacher: TeacherConfig | None = None, seed: int = 0
    ) -> None:
        self._teacher, self._seed = teacher or TeacherConfig(), seed
        self._opened: dict[tuple[str, str], Any] = {}
        self._lock = threading.Lock()
        entries = [Entry(YOU, "you, with the arrow keys", "you")]
        entries += [_saved(Path(key)) for key in named if Path(key).is_dir()]
        entries += [Entry(key, Path(key).name, "learned") for key in named if Path(key).suffix == ".onnx"]
        entries += [_saved(path) for path in _found(root)] if root is not None else []
        entries += [_shipped(name) for name in shipped_agents()]
        entries.append(Entry(TEACHER, f"teacher: {self._teacher.model}, {self._teacher.style}", "teacher"))
        entries += [Entry(key, label_of(key), "planner") for key in PLANNERS]
        entries += [Entry(key, label_of(key), "scripted") for key in SCRIPTED]
        self.entries = {entry.key: entry for entry in entries}
        for key in named:
            self.entry(key)

    def entry(self, key: str) -> Entry:
        """Return the entry of that name.

        Raises:
            RapidError: there is none.
        """
        if key not in self.entries:
            raise RapidError(
                f"There is no driver '{key}' here{did_you_mean(key, self.entries)} Choose one of the list, or start "
                "`rapid play` with the directory of a saved agent or an ONNX file."
            )
        return self.entries[key]

    def open(self, key: str, scenario: str) -> Any:
        """Return who drives; `you` is someone else in every episode, the others are the same.

        Raises:
            RapidError: there is no such driver, it cannot be opened, or the scenario's road is none for it.
        """
        entry = self.entry(key)
        if key == YOU:
            return You()
        with self._lock:
            if (key, scenario) not in self._opened:
                agent = self._make_teacher(scenario) if key == TEACHER else open_agent(key, scenario, self._seed)
                check_road(agent, scenario)
                if entry.group in ("learned", "shipped"):
                    agent.name = entry.label
                self._opened[key, scenario] = agent
            return self._opened[key, scenario]

    def _make_teacher(self, scenario: str) -> Any:
        config = self._teacher
        if config.backend == "local" and not is_present(config.model):
            raise RapidError(
                f"The model {config.model} is not on this machine, and a page fetches nothing. Fetch it with: rapid "
                f"models pull {config.model}"
            )
        return make_teacher(config, get_scenario(scenario).lanes, self._seed)


def _found(root: Path) -> list[Path]:
    """Return the directories of saved agents below `root`, the newest first."""
    marks = sorted(root.glob(f"**/agent/{CONFIG_FILE}"), key=lambda path: path.stat().st_mtime, reverse=True)
    return [path.parent for path in marks if _is_agent(path)][:MOST_FOUND]


def _is_agent(path: Path) -> bool:
    try:
        content = read_json(path)
    except RapidError:
        return False
    return isinstance(content, dict) and content.get("format") in (FORMAT, MONITORED_FORMAT)


def _shipped(name: str) -> Entry:
    """Return the entry of an agent that comes with the package, by SCENARIO/NAME."""
    scenario, _, agent = name.partition("/")
    return Entry(f"{SHIPPED}:{name}", agent, "shipped", scenario)


def _saved(path: Path) -> Entry:
    """Return the entry of a saved agent: its own name, and from where it comes.

    Raises:
        RapidError: there is no agent.
    """
    content = read_json(path / CONFIG_FILE, "agent")
    metadata = content.get("metadata") if isinstance(content, dict) else None
    metadata = metadata if isinstance(metadata, dict) else {}
    # Of runs/NAME/adapt/rapid/agent the name says most.
    parts = [part for part in path.resolve().parts if part not in ("adapt", "distill", "agent", "rapid")]
    name, scenario = str(metadata.get("name") or path.name), str(metadata.get("scenario") or "")
    return Entry(str(path), f"{name} ({parts[-1]})", "learned", scenario)
