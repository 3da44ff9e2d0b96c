"""Transitions and the teacher's log as Arrow tables, and Parquet files of them that are equal byte for byte."""

import json
import os
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rapid.data.transitions import Transitions
from rapid.errors import DamagedError, RapidError
from rapid.files import atomic_path
from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES, NUM_VEHICLES
from rapid.teacher.decision import split_transcript

# Lists of any size, although all have the same: most readers (pyarrow before 26, fastparquet) cannot read a null among
# lists of a fixed size.
_FLOATS = pa.list_(pa.float32())

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
        pa.field("probabilities", _FLOATS),
        pa.field("obs", _FLOATS),
        pa.field("next_obs", _FLOATS),
    ]
)
"""One row a transition; an observation is a list of 15 x 5 numbers. `next_obs` is null where it is the `obs` of the
next row, which halves the file; `probabilities` is null where the driver gave none."""

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
        pa.field("served", pa.string()),
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


def _lists(rows: NDArray[Any], null_N: NDArray[np.bool_]) -> pa.ListArray:
    """Return the rows of a 2-D array as lists, some of them null."""
    count, width = rows.shape
    kept = np.ascontiguousarray(rows[~null_N], np.float32)
    ends = np.concatenate([[0], np.cumsum(~null_N) * width]).astype(np.int32)
    # A null list is told by a null in the place where it begins.
    begins = pa.array(ends, mask=np.append(null_N, False))
    return pa.ListArray.from_arrays(begins, pa.array(kept.reshape(-1))) if count else pa.array([], _FLOATS)


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
    """Return a column of lists as an array N x `width`, and where it is null.

    Raises:
        ValueError: a list has another length, or holds something else than numbers.
    """
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    null_N = np.asarray(array.is_null())
    rows = np.full((len(array), width), np.nan, np.float32)
    # flatten() leaves the null rows out.
    values = np.asarray(array.flatten().cast(pa.float32()))
    lengths = np.asarray(pc.call_function("list_value_length", [array]).drop_null())
    if (lengths != width).any():
        raise ValueError(f"a list has {int(lengths[lengths != width][0])} numbers instead of {width}")
    rows[~null_N] = values.reshape(-1, width)
    return rows, null_N


def from_table(table: pa.Table) -> Transitions:
    """Return the transitions in a table that has the columns of `TRANSITION_SCHEMA`.

    Raises:
        RapidError: a column is missing or has another type.
    """
    try:
        table = table.select(TRANSITION_SCHEMA.names)
        keys = table.select(_KEYS).cast(pa.schema([TRANSITION_SCHEMA.field(name) for name in _KEYS]))
        columns = {name: keys.column(name).to_numpy() for name in _KEYS}
        obs, _ = _rows(table.column("obs"), NUM_VEHICLES * NUM_FEATURES)
        next_obs, repeated_N = _rows(table.column("next_obs"), NUM_VEHICLES * NUM_FEATURES)
        probabilities, _ = _rows(table.column("probabilities"), NUM_ACTIONS)
    except (KeyError, AttributeError, pa.ArrowException, TypeError, ValueError) as error:
        raise RapidError(
            f"The transitions have other columns than expected: {error}. Collect or convert them again."
        ) from error
    count = table.num_rows
    if count and repeated_N[-1]:
        raise RapidError("The last transition has no next observation: the file has lost its end. Collect it again.")
    index = np.flatnonzero(repeated_N)
    next_obs[index] = obs[index + 1]
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

    `served` was unknown there; `transcript` held what was told and the turns after it, `explanation` our words where
    the model had given no reason.

    Raises:
        RapidError: a transcript cannot be read.
    """
    if "status" in table.column_names and "served" not in table.column_names:
        place, unknown = table.schema.get_field_index("status") + 1, pa.array([""] * table.num_rows, pa.string())
        table = table.add_column(place, pa.field("served", pa.string()), unknown)
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
            # So that a reader notices what changes on the disk later.
            write_page_checksum=True,
            # Bytes of equal significance side by side compress far better than whole floats.
            use_byte_stream_split=split,  # pyright: ignore[reportArgumentType]
            use_dictionary=strings,  # pyright: ignore[reportArgumentType]
        )


def read_parquet(path: str | os.PathLike[str], what: str) -> pa.Table:
    """Read a Parquet file, and check the checksums of its pages if it has any.

    Raises:
        DamagedError: the file is damaged; `what` names it.
        RapidError: the file is missing.
    """
    try:
        return _in_lists(pq.read_table(path, page_checksum_verification=True))
    except FileNotFoundError as error:
        raise RapidError(f"There is no {what} at '{path}'. Check the path, or make it first.") from error
    except (OSError, pa.ArrowException) as error:
        raise DamagedError(
            f"The {what} '{path}' cannot be read: {error}. The file is damaged or cut off; copy or make it again."
        ) from error


def _in_lists(table: pa.Table) -> pa.Table:
    """Return a table with lists of any size where an earlier version wrote lists of a fixed size."""
    for place, field in enumerate(table.schema):
        if pa.types.is_fixed_size_list(field.type) and pa.types.is_floating(field.type.value_type):
            rows, null_N = _rows(table.column(field.name), field.type.list_size)
            table = table.set_column(place, pa.field(field.name, _FLOATS), _lists(rows, null_N))
    return table
