from dataclasses import replace

import numpy as np
import pytest

from fake_worlds import assert_equal, fake_transitions
from rapid.cli import main
from rapid.data.dataset import Dataset, load_dataset, mix
from rapid.data.relabel import relabel
from rapid.errors import RapidError
from rapid.simulator import make_env

SCENARIO = "lane-3-density-2"
PROGRESS = f"{SCENARIO}:progress"


def shipped(episodes: int) -> Dataset:
    """Return the first episodes of the shipped random data: short ones that crash, and some long ones."""
    dataset = load_dataset(f"shipped:{SCENARIO}/random")
    rows = dataset.transitions
    return replace(dataset, transitions=rows.select(rows.episode_N < episodes), log=None)


def test_the_same_reward_gives_the_record_again_to_the_bit():
    dataset = shipped(100)
    assert_equal(relabel(dataset, "normalized").transitions, dataset.transitions)


def test_a_crash_in_the_last_second_is_a_crash():
    dataset = load_dataset("shipped:lane-4-density-2.5/random")
    rows = dataset.transitions
    last = rows.episode_N[rows.terminated_N & (rows.step_N == 29)]
    assert len(last)
    dataset = replace(dataset, transitions=rows.select(np.isin(rows.episode_N, last)), log=None)
    assert_equal(relabel(dataset, "normalized").transitions, dataset.transitions)


def test_the_rewards_are_those_of_driving_in_the_other_scenario():
    dataset = shipped(3)
    other = relabel(dataset, "progress")
    rows = other.transitions
    assert other.scenario == PROGRESS
    assert other.collection["relabelled_from"] == SCENARIO
    assert_equal(replace(rows, reward_N=dataset.transitions.reward_N), dataset.transitions)
    expected: list[float] = []
    for episode in range(3):
        mine = rows.select(rows.episode_N == episode)
        env = make_env(PROGRESS)
        env.reset(seed=int(mine.spawn_seed_N[0]))
        expected += [env.step(action)[1] for action in mine.action_N]
    assert np.array_equal(rows.reward_N, np.array(expected, np.float32))


def test_what_cannot_be_driven_again_is_refused():
    dataset = shipped(20)
    with pytest.raises(RapidError, match="lacks steps"):
        relabel(mix(None, dataset, 0.0, 50, 0), "progress")
    with pytest.raises(RapidError, match="does not give the recorded episodes again"):
        relabel(replace(dataset, transitions=fake_transitions(3)), "progress")
    # The same observations throughout, but an end that the simulator does not know.
    rows = dataset.transitions
    changed = replace(rows, terminated_N=rows.truncated_N, truncated_N=rows.terminated_N)
    with pytest.raises(RapidError, match="does not give the recorded episodes again"):
        relabel(replace(dataset, transitions=changed), "progress")


def test_the_verb_writes_a_dataset_with_all_that_was_said(tmp_path):
    source = f"shipped:{SCENARIO}/react"
    with pytest.raises(SystemExit) as exit_:
        main(["relabel", source, "--out", str(tmp_path / "progress")])
    assert exit_.value.code == 0
    before, after = load_dataset(source), load_dataset(tmp_path / "progress")
    assert after.scenario == PROGRESS
    assert after.drivers == before.drivers
    assert after.log.equals(before.log)
    assert (after.transitions.reward_N != before.transitions.reward_N).any()
    # A collection would go on under the new reward, and under no other.
    assert after.collection["settings"]["scenario"] == PROGRESS


def test_the_verb_refuses_the_reward_that_is_there(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["relabel", f"shipped:{SCENARIO}/react", "--reward", "normalized", "--out", str(tmp_path / "out")])
    assert exit_.value.code == 2
    assert "already" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_verb_keeps_what_is_there(tmp_path, capsys):
    (tmp_path / "kept.txt").write_text("mine")
    with pytest.raises(SystemExit) as exit_:
        main(["relabel", f"shipped:{SCENARIO}/random", "--out", str(tmp_path)])
    assert exit_.value.code == 2
    assert "Nothing was changed" in capsys.readouterr().err
