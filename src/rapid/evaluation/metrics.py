"""What is measured of an episode: one row each, kept raw, so that every table can be made again from the rows."""

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rapid.data.tables import read_parquet
from rapid.errors import RapidError
from rapid.files import atomic_path
from rapid.road import CAR_LENGTH
from rapid.scenarios import ACTIONS, PROGRESS_CRASH, PROGRESS_SPEED

Kind = Literal["floor", "teacher", "planner", "learned"]
"""What kind of agent: needs no learning, a teacher, search in the simulator, or learned."""

SAME_LANE = 2.0
"""Metres of lateral distance within which another vehicle is on the ego's own lane: half a lane's width."""


@dataclass(frozen=True, slots=True)
class EpisodeRow:
    """One episode of one agent; numbers that do not exist are NaN, never zero."""

    scenario: str
    agent: str
    seed: int
    """The spawn seed: which traffic."""
    attack: str
    """`none`, or the attack on the observations."""
    episode_return: float
    """Sum of the rewards, not discounted."""
    length: int
    """Decisions."""
    crashed: bool
    mean_speed: float
    """Of the ego, m/s, over the states that decisions led to."""
    distance: float
    """Metres along the road."""
    lane_changes: int
    """Times the ego came to be nearest to another lane."""
    min_ttc: float
    """Least time to collision with the leading vehicle on the own lane, seconds; NaN if it never came nearer."""
    shares: tuple[float, ...]
    """Share of each action, in the order of `scenarios.ACTIONS`."""
    decision_ms: float = math.nan
    """Wall time of the agent per decision, milliseconds, worlds stepped side by side."""
    training_seed: int | None = None
    """Which training made the agent; None for what was never trained."""
    commit: str = ""
    """Commit of the source that measured this."""
    kind: Kind = "learned"
    has_network: bool = False
    """Whether the agent has a network that a gradient attack can use."""
    gradient_attack: bool = False
    """Whether the attack needs the agent's gradient."""
    hit: str = ""
    """Where the car was that the ego touched: `ahead`, `beside` or `behind`; empty without a crash, and in rows of
    earlier versions."""
    origin: str = ""
    """What the agent is, whatever it is called (:func:`rapid.agents.origin.origin_of`); empty in rows of earlier
    versions."""

    @property
    def what(self) -> str:
        """`origin`, or what rows of earlier versions let tell: by their names, which a run itself gave its agents."""
        if self.origin:
            return self.origin
        if self.kind in ("floor", "planner"):
            return self.agent
        # A model of other origin has no network that this package knows.
        return _NAMED.get(self.agent, "") if self.kind == "learned" and self.has_network else ""

    @property
    def progress_return(self) -> float:
        """The return of the same driving under the reward `progress`, to a hundredth or so.

        That reward is the speed along the road over 32 m/s, and -5 for a crash; while changing lanes the mean speed has
        a little in it that is not along the road.
        """
        return self.length * self.mean_speed / PROGRESS_SPEED + PROGRESS_CRASH * self.crashed


_NAMED = {
    "RAPID": "rapid",
    "distilled": "distilled",
    "offline DQN": "offline-dqn",
    "online DQN": "online-dqn",
}
"""What `rapid run` calls the agents that it trains, and by which method."""
_SHARES = tuple(f"share_{action.lower()}" for action in ACTIONS)

SCHEMA = pa.schema(
    [
        ("scenario", pa.string()),
        ("agent", pa.string()),
        ("kind", pa.string()),
        ("training_seed", pa.int64()),
        ("seed", pa.int64()),
        ("attack", pa.string()),
        ("episode_return", pa.float64()),
        ("length", pa.int64()),
        ("crashed", pa.bool_()),
        ("mean_speed", pa.float64()),
        ("distance", pa.float64()),
        ("lane_changes", pa.int64()),
        ("min_ttc", pa.float64()),
        *((name, pa.float64()) for name in _SHARES),
        ("decision_ms", pa.float64()),
        ("has_network", pa.bool_()),
        ("gradient_attack", pa.bool_()),
        ("commit", pa.string()),
        ("hit", pa.string()),
        ("origin", pa.string()),
    ]
)
"""Columns of the Parquet file; a share of actions is one column each."""
_LATER = ("hit", "origin")
"""Columns of text that files of earlier versions lack; there they are empty."""


def _nullable(value: Any) -> Any:
    # Other readers of the file know null, and many would average a NaN.
    return None if isinstance(value, float) and math.isnan(value) else value


def save_rows(path: str | os.PathLike[str], rows: Iterable[EpisodeRow]) -> None:
    """Write rows as Parquet, atomically; NaN becomes null."""
    plain = [name for name in SCHEMA.names if name not in _SHARES]
    records = [
        {name: _nullable(getattr(row, name)) for name in plain}
        | {name: _nullable(share) for name, share in zip(_SHARES, row.shares, strict=True)}
        for row in rows
    ]
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist(records, SCHEMA), temporary, compression="zstd", write_page_checksum=True)


def load_rows(path: str | os.PathLike[str]) -> list[EpisodeRow]:
    """Read the rows that :func:`save_rows` wrote.

    Raises:
        RapidError: the file is missing, damaged, or lacks a column.
    """
    return rows_of_table(read_parquet(path, "file of episode rows"), path)


def rows_of_table(table: pa.Table, path: str | os.PathLike[str]) -> list[EpisodeRow]:
    """Return the rows of a table that was read from `path`; columns besides those of :data:`SCHEMA` are left out.

    Raises:
        RapidError: it lacks a column.
    """
    for name in _LATER:
        if name not in table.column_names:
            table = table.append_column(name, pa.array([""] * len(table), pa.string()))
    try:
        table = table.select(SCHEMA.names).cast(SCHEMA)
    except (KeyError, ValueError, pa.ArrowException) as error:
        raise RapidError(
            f"'{path}' is not a file of episode rows: {error}. Give the file that `rapid evaluate` wrote."
        ) from error
    rows: list[EpisodeRow] = []
    for record in table.to_pylist():
        shares = tuple(math.nan if (share := record.pop(name)) is None else float(share) for name in _SHARES)
        for name in ("episode_return", "mean_speed", "distance", "min_ttc", "decision_ms"):
            record[name] = math.nan if record[name] is None else record[name]
        rows.append(EpisodeRow(**record, shares=shares))
    return rows


def column(rows: Sequence[EpisodeRow], name: str) -> NDArray[np.float64]:
    """Return one number per row; ``share_idle`` and the like name the shares of actions."""
    if name in _SHARES:
        index = _SHARES.index(name)
        return np.array([row.shares[index] for row in rows], np.float64)
    return np.array([getattr(row, name) for row in rows], np.float64)


def time_to_collision(obs_BVF: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return each world's time, in seconds, until the ego would touch the leading vehicle on its own lane.

    Both keep their speed along the road. Infinity where nobody leads or the gap does not shrink; 0 where they touch.
    """
    obs = np.asarray(obs_BVF, np.float64)
    ego, others = obs[:, :1], obs[:, 1:]
    ahead = others[..., 1] - ego[..., 1]
    leads = (others[..., 0] > 0.5) & (np.abs(others[..., 2] - ego[..., 2]) <= SAME_LANE) & (ahead > 0)
    distance = np.where(leads, ahead, np.inf)
    lead = distance.argmin(1)
    world = np.arange(len(obs))
    gap = np.maximum(distance[world, lead] - CAR_LENGTH, 0.0)
    closing = ego[:, 0, 3] - others[world, lead, 3]
    ttc = np.full(len(obs), np.inf)
    meets = np.isfinite(gap) & ((closing > 0) | (gap == 0))
    ttc[meets] = np.where(gap[meets] == 0, 0.0, gap[meets] / np.where(closing[meets] > 0, closing[meets], 1.0))
    return ttc
