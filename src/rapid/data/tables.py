"""Transitions and the teacher's log as Arrow tables, and Parquet files of them that are equal byte for byte."""

import json
import os
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rapid.data.transitions import Transitions
from rapid.errors import RapidError
from rapid.files import atomic_path
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES
from rapid.teacher.decision import split_transcript

_OBS = pa.list_(pa.float32(), NUM_VEHICLES * NUM_FEATURES)

TRANSITION_SCHEMA = pa.schema(
    [
        pa.field("episode", pa.int64(), False),
        pa.field("step", pa.int64(), False),
        pa.field("spawn_seed", pa.int64(), False),
        pa.field("source", pa.int8(), False),
        pa.field("action", pa.int8(), False),
        pa.field("reward", pa.float32(), False),
        pa.field("terminated", pa.bool_(), False),
        pa.field("truncated", pa.bool_(), False),
        pa.field("probabilities", pa.list_(pa.float32(), NUM_ACTIONS)),
        pa.field("obs", _OBS),
        pa.field("next_obs", _OBS),
    ]
)
"""One row a transition. `next_obs` is null where it is the `obs` of the next row, which halves the file;
`probabilities` is null where the driver gave none."""

LOG_SCHEMA = pa.schema(
    [
        pa.field("episode", pa.int64(), False),
        pa.field("step", pa.int64(), False),
        pa.field("spawn_seed", pa.int64(), False),
        pa.field("source", pa.int8(), False),
        pa.field("action", pa.int8(), False),
        pa.field("prompt_hash", pa.string()),
        pa.field("told", pa.string()),
        pa.field("answer", pa.string()),
        pa.field("explanation", pa.string()),
        pa.field("computed", pa.string()),
        pa.field("status", pa.string()),
        pa.field("error", pa.string()),
        pa.field("retries", pa.int32()),
        pa.field("tokens_in", pa.int64()),
        pa.field("tokens_out", pa.int64()),
        pa.field("seconds", pa.float64()),
        pa.field("cost", pa.float64()),
        pa.field("turns", pa.string()),
    ]
)
"""One row a decision: what was told, answered and computed are three columns; `turns` is JSON."""

PART_SCHEMA = pa.schema(
    [*TRANSITION_SCHEMA, *(field for field in LOG_SCHEMA if field.name not in TRANSITION_SCHEMA.names)]
)
"""Transitions with their decisions, row by row: what a collection keeps while it is under way."""

_KEYS = ("episode", "step", "spawn_seed", "source", "action", "reward", "terminated", "truncated")


def _lists(rows: NDArray[Any], null_N: NDArray[np.bool_]) -> pa.FixedSizeListArray:
    """Return the rows of a 2-D array as fixed-size lists, some of them null."""
    flat = pa.array(np.ascontiguousarray(rows, np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, rows.shape[1], mask=pa.array(null_N))


def to_table(transitions: Transitions) -> pa.Table:
    """Return transitions as a table of `TRANSITION_SCHEMA`."""
    count = len(transitions)
    columns: dict[str, Any] = {name: getattr(transitions, f"{name}_N") for name in _KEYS}
    obs = transitions.obs_NVF.reshape(count, NUM_VEHICLES * NUM_FEATURES)
    next_obs = transitions.next_obs_NVF.reshape(count, NUM_VEHICLES * NUM_FEATURES)
    # Compared as bits: -0.0 equals 0.0 as a number, but would not come back the same.
    repeated = transitions.follows_N()
    repeated[:-1] &= (next_obs[:-1].view(np.int32) == obs[1:].view(np.int32)).all(1)
    columns["probabilities"] = _lists(
        transitions.probabilities_NA, np.asarray(np.isnan(transitions.probabilities_NA).all(1))
    )
    columns["obs"] = _lists(obs, np.zeros(count, np.bool_))
    columns["next_obs"] = _lists(next_obs, repeated)
    return pa.Table.from_pydict({name: columns[name] for name in TRANSITION_SCHEMA.names}, TRANSITION_SCHEMA)


def _rows(column: pa.ChunkedArray, width: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return a column of fixed-size lists as an array N x `width`, and where it is null."""
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    null_N = np.asarray(array.is_null())
    rows = np.full((len(array), width), np.nan, np.float32)
    # flatten() leaves the null rows out.
    rows[~null_N] = np.asarray(array.flatten()).reshape(-1, width)
    return rows, null_N


def from_table(table: pa.Table) -> Transitions:
    """Return the transitions in a table that has the columns of `TRANSITION_SCHEMA`.

    Raises:
        RapidError: a column is missing or has another type.
    """
    try:
        table = table.select(TRANSITION_SCHEMA.names).cast(TRANSITION_SCHEMA)
    except (KeyError, pa.ArrowInvalid, pa.ArrowNotImplementedError, ValueError) as error:
        raise RapidError(
            f"The transitions have other columns than expected: {error}. Collect or convert them again."
        ) from error
    count = table.num_rows
    columns = {name: table.column(name).to_numpy() for name in _KEYS}
    obs, _ = _rows(table.column("obs"), NUM_VEHICLES * NUM_FEATURES)
    next_obs, repeated_N = _rows(table.column("next_obs"), NUM_VEHICLES * NUM_FEATURES)
    if count and repeated_N[-1]:
        raise RapidError("The last transition has no next observation: the file has lost its end. Collect it again.")
    index = np.flatnonzero(repeated_N)
    next_obs[index] = obs[index + 1]
    probabilities, _ = _rows(table.column("probabilities"), NUM_ACTIONS)
    shape = (count, NUM_VEHICLES, NUM_FEATURES)
    return Transitions(
        obs_NVF=obs.reshape(shape),
        action_N=columns["action"].astype(np.int64),
        reward_N=columns["reward"].astype(np.float32),
        next_obs_NVF=next_obs.reshape(shape),
        terminated_N=columns["terminated"].astype(np.bool_),
        truncated_N=columns["truncated"].astype(np.bool_),
        source_N=columns["source"].astype(np.int8),
        episode_N=columns["episode"].astype(np.int64),
        step_N=columns["step"].astype(np.int64),
        spawn_seed_N=columns["spawn_seed"].astype(np.int64),
        probabilities_NA=probabilities,
    )


def current_log(table: pa.Table) -> pa.Table:
    """Return a table with the columns of the log as they are now, of one that may be from before version 0.2.

    There, `transcript` held what was told together with the turns after it, and `explanation` RAPID's own words where
    the model had given no reason.

    Raises:
        RapidError: a transcript cannot be read.
    """
    if "transcript" not in table.column_names:
        return table
    names = ("transcript", "answer", "explanation", "status")
    columns: dict[str, list[str]] = {"told": [], "turns": [], "explanation": [], "computed": []}
    for transcript, answer, explanation, status in zip(
        *(table.column(name).to_pylist() for name in names), strict=True
    ):
        told, turns = split_transcript(transcript)
        ours = status == "fallback" or (status != "scripted" and not _gives(answer or "", explanation or ""))
        for name, value in (
            ("told", told),
            ("turns", turns),
            ("explanation", "" if ours else explanation),
            ("computed", explanation if ours else ""),
        ):
            columns[name].append(value)
    for name, values in columns.items():
        column = pa.array(values, pa.string())
        place = table.schema.get_field_index(name)
        field = pa.field(name, pa.string())
        table = table.append_column(field, column) if place < 0 else table.set_column(place, field, column)
    order = [name for name in PART_SCHEMA.names if name in table.column_names]
    return table.select(order)


def _gives(answer: str, explanation: str) -> bool:
    """Say whether a model gave this reason; what was cut off may have held it."""
    return explanation in answer or json.dumps(explanation)[1:-1] in answer or len(answer) >= 1200


def write_parquet(table: pa.Table, path: str | os.PathLike[str]) -> None:
    """Write a table atomically; equal tables give equal bytes (with one version of pyarrow)."""
    floats = ["probabilities.list.element", "obs.list.element", "next_obs.list.element"]
    split = [name for name in floats if name.split(".")[0] in table.column_names]
    strings = [name for name in table.column_names if pa.types.is_string(table.schema.field(name).type)]
    with atomic_path(path) as temporary:
        pq.write_table(
            table.combine_chunks(),
            temporary,
            compression="zstd",
            compression_level=9,
            # Bytes of equal significance side by side compress far better than whole floats.
            use_byte_stream_split=split,  # pyright: ignore[reportArgumentType]
            use_dictionary=strings,  # pyright: ignore[reportArgumentType]
        )


def read_parquet(path: str | os.PathLike[str], what: str) -> pa.Table:
    """Read a Parquet file.

    Raises:
        RapidError: the file is missing or damaged; `what` names it.
    """
    try:
        return pq.read_table(path)
    except FileNotFoundError as error:
        raise RapidError(f"There is no {what} at '{path}'. Check the path, or make it first.") from error
    except (OSError, pa.ArrowException) as error:
        raise RapidError(
            f"The {what} '{path}' cannot be read: {error}. The file is damaged or cut off; copy or make it again."
        ) from error
