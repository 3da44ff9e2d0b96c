import json
from dataclasses import replace
from pathlib import Path

import pytest

from rapid.config import PpoConfig
from rapid.config_io import apply_overrides, load_toml
from rapid.errors import RapidError
from rapid.files import read_json
from rapid.presets import preset
from rapid.runs import RunDirectory

STEPS = ("collect", "mix", "distill")


def test_a_run_directory_says_how_it_was_made(tmp_path: Path):
    config = preset("paper", "tiny")
    RunDirectory(tmp_path / "run", config, STEPS)
    manifest = read_json(tmp_path / "run" / "run.json")
    assert manifest["config"]["scale"] == "tiny"
    assert manifest["versions"]["torch"]
    assert apply_overrides(preset(), load_toml(tmp_path / "run" / "config.toml")) == config


def test_the_same_settings_go_on_and_others_are_refused(tmp_path: Path):
    config = preset("strong", "tiny")
    run = RunDirectory(tmp_path, config, STEPS)
    run.finish("collect", 1.5, transitions=7)
    again = RunDirectory(tmp_path, replace(config, tracking="tensorboard"), STEPS)
    assert again.is_done("collect")
    assert not again.is_done("mix")
    assert again.facts("collect")["transitions"] == 7
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(RapidError, match=r"seed: 0 there, 1 now") as error:
        RunDirectory(tmp_path, replace(config, seed=1), STEPS)
    assert "--directory" in str(error.value)
    # Sums of floats depend on how many threads add them up.
    with pytest.raises(RapidError, match=r"threads: 1 there, 2 now"):
        RunDirectory(tmp_path, replace(config, threads=2), STEPS)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_where_it_runs_may_change_and_settings_may_be_added(tmp_path: Path):
    config = preset("strong", "tiny")
    RunDirectory(tmp_path, config, STEPS)
    RunDirectory(tmp_path, replace(config, collect=replace(config.collect, workers=4)), STEPS)
    manifest = read_json(tmp_path / "run.json")
    for name in ("shards", "max_decisions"):
        del manifest["config"]["collect"][name]
    (tmp_path / "run.json").write_text(json.dumps(manifest))
    RunDirectory(tmp_path, config, STEPS)
    with pytest.raises(RapidError, match=r"collect\.shards: 0 there, 2 now"):
        RunDirectory(tmp_path, replace(config, collect=replace(config.collect, shards=2)), STEPS)


def test_a_long_run_from_before_there_was_ppo_had_none(tmp_path: Path):
    config = preset("strong", "full", "ppo")
    without = replace(config, adapt=replace(config.adapt, ppo=PpoConfig()))
    RunDirectory(tmp_path, without, STEPS)
    manifest = read_json(tmp_path / "run.json")
    del manifest["config"]["adapt"]["ppo"]
    (tmp_path / "run.json").write_text(json.dumps(manifest))
    RunDirectory(tmp_path, without, STEPS)
    with pytest.raises(RapidError, match=rf"adapt\.ppo\.steps: 0 there, {config.adapt.ppo.steps} now"):
        RunDirectory(tmp_path, config, STEPS)


def test_redoing_from_a_step_keeps_the_earlier_ones(tmp_path: Path):
    run = RunDirectory(tmp_path, preset(), STEPS)
    for step in STEPS:
        (tmp_path / step).mkdir()
        (tmp_path / step / "x").write_text(step)
        run.finish(step, 1)
    run.restart_from("mix")
    assert [run.is_done(step) for step in STEPS] == [True, False, False]
    assert (tmp_path / "collect" / "x").exists()
    assert not (tmp_path / "mix").exists()
    with pytest.raises(RapidError, match="did you mean 'distill'"):
        run.restart_from("distil")


def test_foreign_and_damaged_directories_are_left_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(RapidError, match="not the directory of a run"):
        RunDirectory(tmp_path, preset(), STEPS)
    other = tmp_path / "run"
    RunDirectory(other, preset(), STEPS)
    (other / "run.json").write_text("{")
    with pytest.raises(RapidError, match="damaged"):
        RunDirectory(other, preset(), STEPS)
    (other / "run.json").write_text('{"format": 99}')
    with pytest.raises(RapidError, match="another version"):
        RunDirectory(other, preset(), STEPS)


def test_a_step_counts_only_with_all_before_it(tmp_path: Path):
    run = RunDirectory(tmp_path, preset(), STEPS)
    run.finish("distill", 1)
    assert not run.is_done("distill")
    run.finish("collect", 1)
    run.finish("mix", 1)
    assert run.is_done("distill")


@pytest.mark.parametrize("damage", ["{", "", "\0" * 80, '{"step": "mix", "seconds": 1'])
def test_a_damaged_step_record_is_named_and_the_step_done_again(tmp_path: Path, capsys, damage: str):
    run = RunDirectory(tmp_path, preset(), STEPS)
    for step in STEPS:
        run.finish(step, 1)
    (tmp_path / "steps" / "mix.json").write_text(damage)
    assert [run.is_done(step) for step in STEPS] == [True, False, False]
    assert "mix.json' is damaged" in capsys.readouterr().err
    run.finish("mix", 2)
    assert all(run.is_done(step) for step in STEPS)
