"""Cells: the pieces of work that experiments are made of, each with a key made from its content.

A cell is a frozen spec: what is collected, mixed, distilled, adapted or driven, and from which other cells. Two cells
that say the same have the same key, whoever asks for them, so nothing is computed twice. Labels are no part of a cell.
"""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from typing import Any, Literal

from rapid.config import MixConfig, TeacherConfig
from rapid.config_learning import AdaptConfig, DistillConfig, NetworkConfig
from rapid.scenarios import Reward
from rapid.spawns import SpawnSet


@dataclass(frozen=True)
class Shipped:
    """A dataset that comes with the package."""

    scenario: str
    source: Literal["teacher", "random", "rule"]


@dataclass(frozen=True)
class Collect:
    """What a driver collects in a scenario (phase 1)."""

    scenario: str
    driver: TeacherConfig
    transitions: int
    seed: int = 0


@dataclass(frozen=True)
class Relabel:
    """A dataset under the scenario's other reward."""

    data: "Shipped | Collect"
    reward: Reward


@dataclass(frozen=True)
class Mix:
    """A teacher's and a random dataset, mixed at ratio p."""

    teacher: "Data"
    random: "Data"
    settings: MixConfig
    seed: int


@dataclass(frozen=True)
class Fresh:
    """An agent with new weights, for what learns online from nothing."""

    scenario: str
    network: NetworkConfig
    seed: int


@dataclass(frozen=True)
class Distill:
    """An agent trained offline (phase 2)."""

    data: Mix
    network: NetworkConfig
    settings: DistillConfig
    seed: int
    curve_spawns: int = 0


@dataclass(frozen=True)
class Adapt:
    """An agent that goes on online (phase 3); `data` goes into its batches and tells what it forgets.

    As a `Driver` its origin is a shipped agent.
    """

    origin: "Distill | Adapt | Fresh | Driver"
    data: Mix | None
    scenario: str
    settings: AdaptConfig
    seed: int
    curve_spawns: int = 0


@dataclass(frozen=True)
class Driver:
    """What drives without having been trained here: a scripted driver, a planner, a shipped agent, or a teacher."""

    name: str
    teacher: TeacherConfig | None = None


@dataclass(frozen=True)
class Monitored:
    """Two agents with a monitor between them, which drive in a scenario (:mod:`rapid.monitor`).

    The one drives while what is seen can be true: a shipped agent, as a `Driver`, or one trained here; the other once
    it cannot.
    """

    calm: "Distill | Adapt | Driver"
    wary: Adapt
    scenario: str

    @property
    def seed(self) -> int:
        """The training seed of the wary one."""
        return self.wary.seed


@dataclass(frozen=True)
class Drive:
    """Episodes of an agent over the first spawns of a set, under an attack."""

    agent: "Driven"
    scenario: str
    attack: str
    spawns: int
    spawn_set: SpawnSet = "test"
    seed: int = 0


@dataclass(frozen=True)
class Scenes:
    """What an agent's router does in a few scenes of its own driving: weights of every vehicle, and the gate."""

    agent: "Distill | Adapt"
    scenario: str
    count: int
    seed: int = 0


@dataclass(frozen=True)
class Decide:
    """Seconds per decision of an agent or a teacher on the machine where it is measured."""

    agent: "Driven"
    scenario: str
    decisions: int


Data = Shipped | Collect | Relabel
Agent = Distill | Adapt | Monitored | Fresh
Driven = Distill | Adapt | Monitored | Driver
Cell = Shipped | Collect | Relabel | Mix | Fresh | Distill | Adapt | Monitored | Drive | Scenes | Decide
Kind = Literal[
    "shipped", "collect", "relabel", "mix", "fresh", "distill", "adapt", "monitored", "drive", "scenes", "decide"
]

EPOCH: dict[str, int] = {
    "collect": 1,
    "relabel": 1,
    "mix": 1,
    "fresh": 1,
    "distill": 1,
    "adapt": 1,
    "monitored": 2,
    "drive": 1,
    "scenes": 1,
    "decide": 1,
}
"""Raised by hand where a change of the program changes results, with a line in docs/log/: older ones are then made
anew."""

INTRODUCED: dict[str, Any] = {}
"""Fields whose default is no longer the one that they were introduced with, as ``Class.field``: that one."""


def kind_of(cell: Cell) -> Kind:
    """Return what kind of work a cell is."""
    return type(cell).__name__.lower()  # pyright: ignore[reportReturnType]


def key(cell: Cell) -> str:
    """Return the cell's key: 24 hexadecimal digits of the SHA-256 of its kind, epoch and content.

    Other cells stand in it by their keys. A field at the default that it was introduced with is left out, so that a new
    setting changes no key of what was computed without it.
    """
    # Kept beside the fields, which never change: thousands of cells are asked again and again, each with its inputs.
    kept = vars(cell)
    if "_key" not in kept:
        content = json.dumps(describe(cell), sort_keys=True, allow_nan=False)
        kept["_key"] = hashlib.sha256(content.encode()).hexdigest()[:24]
    return kept["_key"]


def describe(cell: Cell) -> dict[str, Any]:
    """Return the cell as JSON, with its inputs by their keys: what is written beside its results."""
    return {"kind": kind_of(cell), "epoch": EPOCH.get(kind_of(cell), 1), **_fields(cell)}


def inputs(cell: Cell) -> tuple[Cell, ...]:
    """Return the cells that must be done before this one."""
    found = (getattr(cell, item.name) for item in dataclasses.fields(cell))
    return tuple(value for value in found if isinstance(value, Cell) and not isinstance(value, Shipped))


def title(cell: Cell) -> str:
    """Return a few words that tell a reader what is under way."""
    match cell:
        case Collect():
            return f"collect, {cell.driver.model}, {cell.scenario}"
        case Relabel():
            return f"relabel, {_data_scenario(cell.data)}, {cell.reward}"
        case Mix():
            return f"mix, {data_scenario(cell)}, p {cell.settings.p:g}"
        case Fresh():
            return f"new weights, {cell.network.kind}, seed {cell.seed}"
        case Distill():
            return f"distill, {cell.network.kind}, {data_scenario(cell.data)}, seed {cell.seed}"
        case Adapt():
            return f"adapt, {cell.scenario}, seed {cell.seed}"
        case Monitored():
            return f"monitored, {cell.scenario}, seed {cell.seed}"
        case Drive():
            who = cell.agent.name if isinstance(cell.agent, Driver) else f"seed {cell.agent.seed}"
            return f"drive, {cell.scenario}, {cell.attack}, {who}"
        case Scenes() | Decide():
            return f"{kind_of(cell)}, {cell.scenario}"
        case Shipped():
            return f"shipped, {cell.scenario}, {cell.source}"


def data_scenario(mix: Mix) -> str:
    """Return the scenario whose driving a mixture holds."""
    return _data_scenario(mix.teacher)


def _data_scenario(data: Data) -> str:
    return _data_scenario(data.data) if isinstance(data, Relabel) else data.scenario


def _fields(value: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for item in dataclasses.fields(value):
        own = getattr(value, item.name)
        name = f"{type(value).__name__}.{item.name}"
        default = INTRODUCED.get(name, _default(item))
        if default is dataclasses.MISSING or own != default:
            found[item.name] = _plain(own)
    return found


def _default(item: "dataclasses.Field[Any]") -> Any:
    if item.default_factory is not dataclasses.MISSING:
        return item.default_factory()
    return item.default


def _plain(value: Any) -> Any:
    if isinstance(value, Cell):
        return {"cell": key(value)}
    if dataclasses.is_dataclass(value):
        return _fields(value)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value
