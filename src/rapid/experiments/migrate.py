"""Committed rows of before there were cells: which method each of their labels meant.

They were measured by scripts that told agents apart by their labels. A table shows them only at the scale `full`, where
no cell has been driven.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from rapid.data.tables import read_parquet
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, rows_of_table

LABELS: dict[str, dict[str, str]] = {
    "strong": {
        "slower": "slower",
        "random": "random",
        "rule": "rule",
        "rule-forecast": "rule-forecast",
        "idle": "idle",
        "faster": "faster",
        "planner": "planner",
        "planner-cars": "planner-cars",
        "planner-observation": "planner-observation",
        "smollm2-135m": "teacher",
        "offline DQN": "offline-dqn",
        "offline DDQN": "offline-ddqn",
        "CQL": "cql",
        "behaviour cloning": "bc",
        "distilled": "distilled",
        "online DDQN, 10K": "online-ddqn-10k",
        "online Munchausen DQN, 300K + 700K PPO": "mlp-ppo",
        "RAPID, 10K": "rapid-10k",
        "RAPID, adapted under attack": "rapid-robust",
        # The same weights on wider roads.
        "RAPID, adapted under attack on lane-3": "rapid-robust",
        "RAPID, 300K + 700K PPO": "rapid-ppo",
        "RAPID, 100K, from 60K + 700K PPO": "rapid-ppo-more-data",
        "distilled, no J_robust": "distilled-without-robust",
        "distilled, no CQL": "distilled-without-cql",
        "distilled, plain DQN": "distilled-plain-dqn",
        "distilled, rule data": "distilled-rule-data",
        "RAPID, 10K, fine-tuned whole": "rapid-10k-all",
        "RAPID, 10K, from scratch": "rapid-10k-scratch",
    },
    "paper": {
        "offline DQN": "offline-dqn",
        "offline DDQN": "offline-ddqn",
        "CQL": "cql",
        "behaviour cloning": "bc",
        "distilled": "distilled",
        "distilled, no J_robust": "distilled-without-robust",
        "RAPID, 10K": "rapid",
        "online DQN, 10K": "online-dqn",
        "online DDQN, 10K": "online-ddqn",
        "smollm2-135m": "teacher",
    },
}
"""Method ids by the labels of the committed rows, by recipe."""
FILES: dict[str, tuple[str, ...]] = {
    "strong": ("floors.parquet", "scores.parquet", "scores-progress.parquet", "robust-first.parquet"),
    "paper": ("scores-paper.parquet",),
}
"""Files of ``results/`` with rows over the 200 test spawns. Rows of the recipe `paper` were driven with presence left
alone: they stand in under clean driving only."""
SPAWNS = range(900_000, 900_200)


class Legacy(NamedTuple):
    """Which rows stand in where no cell has been driven."""

    recipe: str
    method: str
    scenario: str
    attack: str


def legacy_rows(results: Path, wanted: Legacy) -> list[EpisodeRow]:
    """Return the committed rows of a method; none where there are none.

    Raises:
        RapidError: a file is damaged, or holds a label that neither :data:`LABELS` nor :data:`UNUSED` knows.
    """
    if wanted.recipe == "paper" and wanted.attack != "none":
        return []
    labels = [label for label, method in LABELS.get(wanted.recipe, {}).items() if method == wanted.method]
    if not labels:
        return []
    found: list[EpisodeRow] = []
    for name in FILES.get(wanted.recipe, ()):
        path = results / name
        if not path.is_file():
            continue
        table = _table(path, wanted.recipe)
        seed = pc.field("seed")
        keep = pc.field("agent").isin(labels) & (pc.field("scenario") == wanted.scenario)
        keep &= (pc.field("attack") == wanted.attack) & (seed >= SPAWNS[0]) & (seed <= SPAWNS[-1])
        found += rows_of_table(table.filter(keep), path)
    return found


@cache
def _table(path: Path, recipe: str) -> pa.Table:
    table = read_parquet(path, "file of episode rows")
    for label in table.column("agent").unique().to_pylist():
        if label not in LABELS[recipe] and label not in UNUSED:
            raise RapidError(f"'{path}' has the agent '{label}', which no method is known for. Restore the file.")
    return table


UNUSED = frozenset(
    {
        "CQL, 60K",
        "RAPID, 100K",
        "RAPID, 1M",
        "RAPID, 300K",
        "RAPID, 300K + 700K PPO, fine-tuned whole",
        "distilled, 60K, no J_robust",
        "online Munchausen DQN, 100K",
        "online Munchausen DQN, 300K",
        "RAPID, 100K, from 60K",
        "RAPID, 100K, from 60K + 700K PPO, mirrored",
        "RAPID, 100K, from 60K, 31 seen",
        "RAPID, 100K, from 60K, 31 seen + 900K PPO",
        "RAPID, 100K, from 60K, 31 seen + 900K PPO, mirrored",
        "RAPID, 10K, from 60K",
    }
)
"""Labels of agents that no exhibit shows; their rows stay in their files."""
