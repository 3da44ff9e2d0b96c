import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from fake_worlds import assert_equal, fake_transitions
from rapid.data.card import card
from rapid.data.dataset import Dataset, episode_returns, join, load_dataset, mix, save_dataset
from rapid.data.tables import LOG_SCHEMA, current_log
from rapid.data.transitions import RANDOM, TEACHER, Transitions
from rapid.errors import RapidError
from rapid.files import read_json

SCENARIO = "lane-3-density-2"


def log_of(rows: Transitions) -> pa.Table:
    texts = {name: ["ok"] * len(rows) for name in LOG_SCHEMA.names if pa.types.is_string(LOG_SCHEMA.field(name).type)}
    columns = {
        **{name: np.ones(len(rows)) for name in ("retries", "tokens_in", "tokens_out", "seconds", "cost")},
        **texts,
        "episode": rows.episode_N,
        "step": rows.step_N,
        "spawn_seed": rows.spawn_seed_N,
        "source": rows.source_N,
        "action": rows.action_N,
    }
    return pa.Table.from_pydict({name: columns[name] for name in LOG_SCHEMA.names}, LOG_SCHEMA)


def teacher(episodes: int = 20, **changes) -> Dataset:
    rows = fake_transitions(episodes)
    return replace(Dataset(SCENARIO, rows, {"teacher": {"name": "fake"}}, log_of(rows)), **changes)


def random(episodes: int = 40, **changes) -> Dataset:
    rows = fake_transitions(episodes, RANDOM, seed=1)
    return replace(Dataset(SCENARIO, rows, {"random": {"name": "random"}}, log_of(rows)), **changes)


def test_what_is_saved_is_loaded(tmp_path):
    save_dataset(teacher(), tmp_path)
    loaded = load_dataset(tmp_path)
    assert_equal(loaded.transitions, teacher().transitions)
    assert loaded.log.equals(teacher().log)
    assert loaded.drivers == {"teacher": {"name": "fake"}}
    facts = json.loads((tmp_path / "dataset.json").read_text())["summary"]
    returns, crashed = episode_returns(teacher().transitions)
    assert facts["teacher"]["return_mean"] == round(returns.mean(), 4)
    assert facts["teacher"]["crash_share"] == round(crashed.mean(), 4) == 0.35
    assert sum(facts["teacher"]["actions"].values()) == pytest.approx(1, abs=1e-3)


def test_a_damaged_dataset_is_refused(tmp_path):
    with pytest.raises(RapidError, match="There is no dataset"):
        load_dataset(tmp_path)
    save_dataset(teacher(), tmp_path)
    path = tmp_path / "transitions.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    with pytest.raises(RapidError, match="cut off"):
        load_dataset(tmp_path)
    path.write_bytes(whole[:-100] + bytes(100))
    with pytest.raises(RapidError, match="SHA-256"):
        load_dataset(tmp_path)
    path.unlink()
    with pytest.raises(RapidError, match="lacks its file"):
        load_dataset(tmp_path)
    path.write_bytes(whole)
    meta = read_json(tmp_path / "dataset.json")
    files = meta["files"]
    for change, message in (
        ({"files": {}}, "does not name the SHA-256 of 'transitions.parquet'"),
        ({"files": {"transitions.parquet": files["transitions.parquet"]}}, "SHA-256 of 'teacher_log.parquet'"),
        ({"files": files | {"transitions.parquet": {"rows": 200, "bytes": len(whole)}}}, "sha256"),
        ({"files": files | {"../elsewhere": files["transitions.parquet"]}}, "which no dataset has"),
        ({"mixture": [1]}, "'mixture' is"),
        ({"drivers": {"teacher": "me"}}, "drivers"),
        ({"schema_version": 2}, "schema version 2"),
        ({"format": "other"}, "does not describe"),
        ({"scenario": "lane-99-density-2"}, "Impossible scenario"),
        ({"files": None}, "damaged"),
    ):
        (tmp_path / "dataset.json").write_text(json.dumps(meta | change))
        with pytest.raises(RapidError, match=message):
            load_dataset(tmp_path)


def test_facts_that_were_edited_are_noticed(tmp_path):
    save_dataset(mix(teacher(), random(), 0.25, 100, 0, "batch"), tmp_path)
    path = tmp_path / "dataset.json"
    path.write_text(path.read_text().replace('"p": 0.25', '"p": 0.75'))
    with pytest.raises(RapidError, match="not what was written"):
        load_dataset(tmp_path)


def test_a_dataset_in_the_place_of_another_takes_nothing_over_from_it(tmp_path):
    save_dataset(teacher(), tmp_path)
    save_dataset(replace(teacher(), log=None), tmp_path)
    assert load_dataset(tmp_path).log is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset.json", "transitions.parquet"]


def test_a_dataset_with_impossible_values_is_not_written(tmp_path):
    rows = fake_transitions()
    rows.reward_N[4] = np.nan
    with pytest.raises(RapidError, match="row 4"):
        save_dataset(teacher(transitions=rows), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_mixture_has_the_share_and_keeps_the_provenance():
    mixed = mix(teacher(), random(), 0.25, 400, 7)
    rows = mixed.transitions.validate()
    assert len(rows) == 400
    assert (rows.source_N == TEACHER).sum() == 100
    assert (
        len({(seed, step) for seed, step in zip(rows.spawn_seed_N.tolist(), rows.step_N.tolist(), strict=True)}) == 400
    )
    assert set(rows.episode_N[rows.source_N == TEACHER]) & set(rows.episode_N[rows.source_N == RANDOM]) == set()
    assert mixed.teacher_share is None
    assert mixed.drivers == {"teacher": {"name": "fake"}, "random": {"name": "random"}}
    assert_equal(rows, mix(teacher(), random(), 0.25, 400, 7).transitions)
    other = mix(teacher(), random(), 0.25, 400, 8).transitions
    assert rows.action_N.tobytes() != other.action_N.tobytes()


@pytest.mark.parametrize("p", [0.0, 1.0])
def test_a_pure_mixture_needs_one_source(p):
    mixed = mix(teacher() if p else None, None if p else random(), p, 200, 0)
    assert set(mixed.transitions.source_N) == {TEACHER if p else RANDOM}


def test_mixing_by_batch_keeps_both_sources_and_names_the_share(tmp_path):
    mixed = mix(teacher(), random(), 0.1, 300, 0, level="batch")
    assert np.bincount(mixed.transitions.source_N).tolist() == [200, 300]
    assert mixed.teacher_share == 0.1
    save_dataset(mixed, tmp_path)
    assert load_dataset(tmp_path).teacher_share == 0.1


def test_what_cannot_be_mixed():
    for arguments, message in (
        ((teacher(), random(scenario="lane-4-density-2.5"), 0.5, 10, 0), "different scenarios: lane-3.*, lane-4"),
        ((teacher(), random(), 0.5, 10_000, 0), "needs 5000 teacher transitions .* there are 200"),
        ((teacher(), None, 0.5, 10, 0), "needs 5 random transitions .* there are 0"),
        ((teacher(), random(), 1.5, 10, 0), "between|must lie"),
        ((random(), teacher(), 0.5, 10, 0), "another source"),
    ):
        with pytest.raises(RapidError, match=message):
            mix(*arguments)


def test_shards_are_joined_once():
    rows = teacher().transitions
    halves = [
        teacher(transitions=rows.select(part), log=teacher().log.filter(pa.array(part)))
        for part in (rows.episode_N < 10, rows.episode_N >= 10)
    ]
    halves[1] = replace(
        halves[1], transitions=replace(halves[1].transitions, episode_N=halves[1].transitions.episode_N - 10)
    )
    joined = join(halves)
    assert_equal(joined.transitions, rows)
    assert joined.log.equals(teacher().log)
    with pytest.raises(RapidError, match="share episodes"):
        join([halves[0], halves[0]])
    with pytest.raises(RapidError, match="different scenarios or drivers"):
        join([halves[0], random()])
    with pytest.raises(RapidError, match="nothing to join"):
        join([])


def test_the_card_says_what_a_stranger_must_know():
    text = card(teacher())
    for fact in (SCENARIO, "200 transitions", "fake", "35.0%", "Apache-2.0", "LANE_LEFT", "Status: ok 200"):
        assert fact in text
    assert "p = 0.25" in card(mix(teacher(), random(), 0.25, 100, 0))


def test_a_log_of_an_older_version_tells_what_was_told_from_what_was_computed():
    told, reason = [{"role": "user", "content": "Safe: keep."}], "a “calm” road"
    answers = ["keep", json.dumps({"explanation": reason, "action": "keep"}), "hm", ""]
    old = pa.table(
        {
            "answer": answers,
            "explanation": ["keep: safe, 9 m", reason, "no usable answer; keep leaves most room", "the road is free"],
            "status": ["ok", "repaired", "fallback", "scripted"],
            "transcript": [json.dumps([*told, {"role": "assistant", "content": answer}]) for answer in answers[:3]]
            + [""],
        }
    )
    rows = current_log(old).to_pylist()
    assert [row["told"] for row in rows] == ["Safe: keep."] * 3 + [""]
    assert [row["explanation"] for row in rows] == ["", reason, "", "the road is free"]
    assert [row["computed"] for row in rows] == ["keep: safe, 9 m", "", "no usable answer; keep leaves most room", ""]
    assert json.loads(rows[1]["turns"]) == [{"role": "assistant", "content": answers[1]}]
    assert current_log(current_log(old)) == current_log(old)
    with pytest.raises(RapidError, match="transcript"):
        current_log(old.set_column(3, "transcript", pa.array(["{", "[1]", "7", "x"])))
