from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fake_worlds import assert_equal, fake_transitions
from rapid.data.tables import from_table, read_parquet, to_table, write_parquet
from rapid.data.transitions import RANDOM, concatenate, empty
from rapid.errors import DamagedError, RapidError
from rapid.spawns import spawn_seeds, train_part


@pytest.mark.parametrize("order", ["whole", "shuffled", "thinned", "none"])
def test_parquet_gives_back_every_bit(tmp_path, order):
    rows = fake_transitions()
    index = {
        "whole": slice(None),
        "shuffled": np.random.default_rng(0).permutation(len(rows)),
        "thinned": np.arange(0, len(rows), 3),
        "none": slice(0),
    }[order]
    rows = rows.select(index)
    write_parquet(to_table(rows), tmp_path / "rows.parquet")
    assert_equal(from_table(read_parquet(tmp_path / "rows.parquet", "rows")), rows)


def test_negative_zero_survives_the_omission_of_repeated_observations():
    rows = fake_transitions(1)
    rows.obs_NVF[1, 2, 3], rows.next_obs_NVF[0, 2, 3] = 0.0, -0.0
    assert np.signbit(from_table(to_table(rows)).next_obs_NVF[0, 2, 3])


def test_repeated_observations_are_stored_once():
    table = to_table(fake_transitions(episodes=4, length=10))
    assert table.column("next_obs").null_count == 4 * 9


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("obs_NVF", np.nan, "non-finite observation"),
        ("next_obs_NVF", np.inf, "non-finite next observation"),
        ("reward_N", np.nan, "non-finite reward"),
        ("action_N", 5, "action outside 0..4"),
        ("action_N", -1, "action outside 0..4"),
        ("source_N", 7, "source outside"),
        ("probabilities_NA", 0.7, "no distribution"),
    ],
)
def test_a_wrong_value_is_named_with_its_row(name, value, message):
    rows = fake_transitions()
    array = getattr(rows, name).copy()
    array[3] = value
    with pytest.raises(RapidError, match=f"row 3 has .*{message}"):
        replace(rows, **{name: array}).validate()


def test_other_spaces_and_impossible_ends_are_refused():
    rows = fake_transitions()
    with pytest.raises(RapidError, match="'obs_NVF' has shape"):
        replace(rows, obs_NVF=rows.obs_NVF[:, :10]).validate()
    with pytest.raises(RapidError, match="both terminated and truncated"):
        replace(rows, terminated_N=rows.done_N, truncated_N=rows.done_N).validate()
    with pytest.raises(RapidError, match="lost its end"):
        from_table(to_table(rows)[:5])
    with pytest.raises(RapidError, match="other columns"):
        from_table(to_table(rows).drop_columns(["obs"]))


def test_with_the_time_told_every_end_is_an_end():
    rows = fake_transitions()
    assert rows.truncated_N.any()
    assert not rows.terminated_N[rows.truncated_N].any()
    assert (rows.timed().terminated_N == rows.done_N).all()


def test_concatenation_keeps_episodes_apart():
    both = concatenate([fake_transitions(3), fake_transitions(2, RANDOM), empty()]).validate()
    assert sorted(set(both.episode_N.tolist())) == [0, 1, 2, 3, 4]
    assert both.follows_N().sum() == 5 * 9


def test_spawn_sets_are_disjoint_and_end():
    sets = [set(spawn_seeds(name, count)) for name, count in (("train", 800_000), ("tune", 100_000), ("test", 100_000))]
    assert len(set().union(*sets)) == 1_000_000
    assert max(max(part) for part in sets) < 1_000_000
    parts = [set(train_part(name)) for name in ("teacher", "random", "online")]
    assert set().union(*parts) == sets[0]
    assert sum(map(len, parts)) == 800_000
    assert spawn_seeds("tune", 2, start=5) == [800_005, 800_006]
    with pytest.raises(RapidError, match="has 100000 spawn seeds"):
        spawn_seeds("test", 2, start=99_999)
    with pytest.raises(RapidError, match="did you mean 'test'"):
        spawn_seeds("tests", 1)


def test_files_are_for_every_reader_and_those_of_earlier_versions_still_load(tmp_path):
    """Lists of a fixed size with nulls among them can be read by hardly any program; earlier versions wrote them."""
    rows = fake_transitions(6)
    table = to_table(rows)
    assert all(pa.types.is_list(table.schema.field(name).type) for name in ("probabilities", "obs", "next_obs"))
    assert table.column("next_obs").null_count == len(rows) - 6
    old = table
    for place, (name, size) in enumerate((("probabilities", 5), ("obs", 75), ("next_obs", 75)), 8):
        assert table.schema.names[place] == name
        kind = pa.list_(pa.float32(), size)
        old = old.set_column(place, name, pa.array(table.column(name).to_pylist(), kind))
    pq.write_table(old, tmp_path / "old.parquet")
    read = read_parquet(tmp_path / "old.parquet", "transitions")
    assert read.schema.types == table.schema.types
    assert_equal(from_table(read), rows)
    assert_equal(from_table(old), rows)


@pytest.mark.parametrize("where", [0.3, 0.5, 0.7])
def test_one_bit_that_changed_on_the_disk_is_noticed(tmp_path, where):
    path = tmp_path / "rows.parquet"
    write_parquet(to_table(fake_transitions(6)), path)
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 16
    path.write_bytes(content)
    with pytest.raises(DamagedError, match="cannot be read"):
        read_parquet(path, "transitions")


@pytest.mark.parametrize(
    ("name", "value"), [("obs", [[1.0] * 74]), ("next_obs", [["a"] * 75]), ("probabilities", [3.0])]
)
def test_lists_of_another_kind_are_refused(name, value):
    table = to_table(fake_transitions(1, length=1))
    wrong = table.set_column(table.schema.get_field_index(name), name, pa.array(value))
    with pytest.raises(RapidError, match="other columns than expected"):
        from_table(wrong)
