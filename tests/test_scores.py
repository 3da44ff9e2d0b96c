"""The scores' script: what it takes for trained, and what its table compares."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rapid.agents.open import open_agent
from rapid.agents.saved import save_agent
from rapid.config_io import to_dict
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.presets import preset
from rapid.spawns import spawn_seeds
from rapid.teacher.scripted import Scripted

SCRIPTED = Scripted("slower", 3, 0)
PATH = Path(__file__).parents[1] / "benchmarks" / "scores.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("scores", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def config():
    return preset("strong", "full")


def write_agent(home: Path, config, settings) -> None:
    save_agent(home / "agent", build_network(config.network, 3, 0), {"name": "it", "config": settings})


def test_an_agent_counts_as_trained_only_with_the_same_settings(benchmark, config, tmp_path):
    assert not benchmark.is_trained(tmp_path, config, "adapt")
    write_agent(tmp_path, config, to_dict(config))
    assert benchmark.is_trained(tmp_path, config, "adapt")
    # Where and how fast it was computed, and how it will be measured, is another matter.
    assert benchmark.is_trained(tmp_path, replace(config, threads=2), "adapt")
    other = replace(config, adapt=replace(config.adapt, loss=replace(config.adapt.loss, discount=0.8)))
    assert benchmark.is_trained(tmp_path, other, "distill")
    with pytest.raises(RapidError, match=r"adapt\.loss\.discount = 0\.9, not 0\.8"):
        benchmark.is_trained(tmp_path, other, "adapt")


def test_how_ppo_is_set_matters_only_where_there_is_some(benchmark, config, tmp_path):
    def with_ppo(**changes):
        return replace(config, adapt=replace(config.adapt, ppo=replace(config.adapt.ppo, **changes)))

    write_agent(tmp_path / "without", config, to_dict(config))
    assert benchmark.is_trained(tmp_path / "without", with_ppo(clip=0.1), "adapt")
    write_agent(tmp_path / "with", config, to_dict(with_ppo(steps=50_000)))
    with pytest.raises(RapidError, match=r"adapt\.ppo\.clip = 0\.2, not 0\.1"):
        benchmark.is_trained(tmp_path / "with", with_ppo(steps=50_000, clip=0.1), "adapt")
    with pytest.raises(RapidError, match=r"adapt\.ppo\.steps = 50000, not 0"):
        benchmark.is_trained(tmp_path / "with", config, "adapt")


def test_a_setting_that_did_not_exist_yet_had_its_default(benchmark, config, tmp_path):
    settings = to_dict(config)
    del settings["adapt"]["exploration_hold"]
    write_agent(tmp_path, config, settings)
    assert benchmark.is_trained(tmp_path, config, "adapt")


@pytest.fixture
def asked(benchmark, tmp_path, monkeypatch):
    """The trainings asked for online, instead of their being done: settings, where it starts, data, by name."""
    asked: dict[str, tuple] = {}
    monkeypatch.setattr(benchmark, "mix_datasets", lambda *_: None)
    monkeypatch.setattr(benchmark, "datasets", lambda *_: (tmp_path, tmp_path))
    monkeypatch.setattr(benchmark, "distill_agent", lambda *_: None)
    monkeypatch.setattr(
        benchmark,
        "adapt_agent",
        lambda config, agent, data, out, name: asked.update({name: (config.adapt, agent, data)}),
    )
    return asked


def test_methods_of_one_budget_have_the_same_steps_and_updates(benchmark, config, tmp_path, asked):
    benchmark.train(
        config, "lane-3-density-2", tmp_path / "work", "lane-4-density-2.5", (10_000, 100_000, 300_000), True
    )
    for steps in ("10K", "100K", "300K"):
        of_one = [adapt for name, (adapt, *_) in asked.items() if f", {steps}" in name]
        assert len({(a.steps, a.updates_per_step, a.optimizer.batch_size, a.num_envs) for a in of_one}) == 1
        assert {a.scenario for a in of_one} == {"lane-4-density-2.5"}
        # What the baseline lacks is the distilled policy: it starts anew, explores, and sees nothing offline.
        baseline, _, data = asked[f"online DDQN, {steps}"]
        assert (baseline.train, baseline.exploration_start, baseline.offline_share, data) == ("scratch", 1.0, 0.0, None)
        assert (baseline.loss.double, baseline.loss.munchausen_weight) == (True, 0.0)
    assert asked["online Munchausen DQN, 100K"][0].loss == asked["RAPID, 100K"][0].loss
    assert "online Munchausen DQN, 10K" not in asked
    # Each looks as far ahead as is best for it.
    discounts = {name: adapt.loss.discount for name, (adapt, *_) in asked.items() if ", 300K" in name}
    assert discounts["RAPID, 300K"] == 0.95
    assert discounts["online Munchausen DQN, 300K"] == discounts["online DDQN, 300K"] == benchmark.MLP_DISCOUNT


def test_only_what_is_wanted_and_what_it_starts_from_is_trained(benchmark, config, tmp_path, asked, monkeypatch):
    distilled = []
    monkeypatch.setattr(benchmark, "distill_agent", lambda *words: distilled.append(words[-1]))
    work = (tmp_path, "lane-3-density-2", (10_000, 100_000))
    agents = benchmark.train(config, "lane-3-density-2", *work, only=["online DDQN, 10K", "distilled"])
    assert [name for name, _ in agents] == ["distilled", "online DDQN, 10K"]
    assert distilled == ["distilled", "offline DDQN"]
    assert list(asked) == ["online DDQN, 10K"]
    with pytest.raises(RapidError, match="no agent 'RAPID, 1M' among 'distilled'"):
        benchmark.train(config, "lane-3-density-2", *work, only=["RAPID, 1M"])


def test_every_agent_goes_on_by_ppo_from_where_it_is(benchmark, config, tmp_path, asked):
    scenario, work = "lane-3-density-2", tmp_path / "work"
    names = ["RAPID, 300K + 700K PPO", "online Munchausen DQN, 300K + 700K PPO", "RAPID, 100K, from 60K + 700K PPO"]
    options = {"more_data": True, "only": names, "ppo": 700_000}
    agents = benchmark.train(config, scenario, work, scenario, (100_000, 300_000), **options)
    assert {name for name, _ in agents} == set(names)
    for name in names:
        before, after = asked[name.removesuffix(" + 700K PPO")], asked[name]
        assert before[0].ppo.steps == 0 < before[0].steps
        train = "all" if "MLP" in name or "Munchausen" in name else "adapter"
        assert after[0] == replace(before[0], steps=0, ppo=replace(before[0].ppo, steps=700_000), train=train)
        assert after[1] == work / scenario / benchmark.file_name(name.removesuffix(" + 700K PPO")) / "agent"
        assert after[2] == before[2]
    # A policy that began from scratch goes on as it is.
    assert asked[names[1]][0].train == "all"
    assert benchmark.is_ablation("RAPID, 300K, from scratch + 700K PPO", "RAPID, 300K + 700K PPO")
    assert not benchmark.is_ablation("RAPID, 300K, from scratch + 700K PPO", "RAPID, 300K")
    assert benchmark.is_ablation("RAPID, 300K, from scratch", "RAPID, 300K")
    assert (
        benchmark.ppo_settings(config.adapt, f"{scenario}:progress", 9).crash_penalty > config.adapt.ppo.crash_penalty
    )
    assert benchmark.name_parts(names[2]) == ("RAPID, 100K, from 60K", " + 700K PPO", "")
    assert benchmark.name_parts("RAPID, 300K, mirrored") == ("RAPID, 300K", "", ", mirrored")


def test_ppo_without_a_frozen_part_is_an_ablation(benchmark, config, tmp_path, asked):
    scenario, usual = "lane-4-density-2.5", "RAPID, 300K + 700K PPO"
    names = [usual, f"{usual}, fine-tuned whole"]
    benchmark.train(config, scenario, tmp_path, scenario, (300_000,), only=names, ppo=700_000, ablations=True)
    frozen, whole = (asked[name] for name in names)
    assert (frozen[0].train, whole[0]) == ("adapter", replace(frozen[0], train="all"))
    assert whole[1:] == frozen[1:]
    assert benchmark.name_parts(names[1]) == ("RAPID, 300K", " + 700K PPO, fine-tuned whole", "")


def test_the_mirror_is_put_before_what_is_there(benchmark, config, tmp_path, asked):
    scenario, whole = "lane-3-density-2:progress", "RAPID, 300K + 700K PPO"
    names = ["online DDQN, 100K, mirrored", f"{whole}, mirrored"]
    options = {"only": names, "ppo": 700_000, "mirror": True}
    agents = benchmark.train(config, scenario, tmp_path, scenario, (100_000, 300_000), **options)
    assert {name for name, _ in agents} == set(names)
    for name in names:
        settings, start, data = asked[name]
        assert (settings.steps, settings.ppo.steps, settings.mirror, data) == (0, 0, True, None)
        assert start == tmp_path / scenario / benchmark.file_name(name.removesuffix(", mirrored")) / "agent"
    assert not benchmark.is_ablation("RAPID, 300K, mirrored", "RAPID, 300K")
    assert benchmark.is_ablation("RAPID, 300K, from scratch, mirrored", "RAPID, 300K, mirrored")
    assert benchmark.is_ablation("RAPID, 300K, from scratch + 700K PPO, mirrored", f"{whole}, mirrored")


def test_who_sees_more_is_told_apart_from_an_ablation(benchmark, config, tmp_path, asked):
    scenario = "lane-4-density-2.5:progress"
    names = ["RAPID, 100K, from 60K", "RAPID, 100K, from 60K, 31 seen", "RAPID, 100K, from 60K, 31 seen + 900K PPO"]
    options = {"only": names, "more_data": True, "ppo": 900_000, "vehicles": 31}
    benchmark.train(config, scenario, tmp_path, scenario, (100_000,), **options)
    usual, wide, further = (asked[name] for name in names)
    assert wide == (replace(usual[0], vehicles=31), *usual[1:])
    assert (further[0].steps, further[0].ppo.steps, further[0].vehicles) == (0, 900_000, 31)
    assert benchmark.seen_as_usual(names[2]) == "RAPID, 100K, from 60K + 900K PPO"
    assert not benchmark.is_ablation(names[1], names[0])
    assert not benchmark.is_ablation("RAPID, 300K, from scratch, 31 seen", "RAPID, 300K")
    assert benchmark.is_ablation("RAPID, 300K, from scratch, 31 seen", "RAPID, 300K, 31 seen")
    assert benchmark.name_parts(names[2]) == (names[0], ", 31 seen + 900K PPO", "")
    with pytest.raises(RapidError, match="There is no agent 'online DDQN, 100K, 31 seen'"):
        benchmark.train(
            config, scenario, tmp_path, scenario, (100_000,), only=["online DDQN, 100K, 31 seen"], vehicles=31
        )


def test_who_begins_from_more_data_is_careful_for_longer(benchmark, config, tmp_path, asked):
    scenario, work = "lane-3-density-2:progress", tmp_path / "work"
    names = ["RAPID, 10K", "RAPID, 10K, from 60K", "RAPID, 100K, from 60K"]
    benchmark.train(config, scenario, work, scenario, (10_000, 100_000), only=names, more_data=True)
    usual, more, longer = (asked[name] for name in names)
    assert more[0] == usual[0]
    assert longer[0] == replace(more[0], steps=100_000)
    assert usual[1:] == (work / "distilled" / "agent", work / "mix")
    origin = work / "distilled-60K-no-J_robust" / "agent"
    assert more[1:] == longer[1:] == (origin, work / "mix-collected")


def test_the_rules_data_takes_the_teachers_place(benchmark, config, tmp_path, asked, monkeypatch):
    mixed, learned = [], {}
    monkeypatch.setattr(benchmark, "datasets", lambda config, data, work, source: (work / source, work / "random"))
    monkeypatch.setattr(benchmark, "mix_datasets", lambda _, driver, random, out: mixed.append(driver.name))
    monkeypatch.setattr(benchmark, "distill_agent", lambda _, data, out, name: learned.update({name: data}))
    names = ["distilled", benchmark.RULE_DATA]
    work = tmp_path / "work"
    benchmark.train(config, "lane-3-density-2", work, "lane-3-density-2", (), ablations=True, only=names)
    assert mixed == ["teacher", "rule"]
    assert learned == {"distilled": work / "mix", benchmark.RULE_DATA: work / "mix-rule"}
    with pytest.raises(RapidError, match="no agent"):  # no rule's data of this scenario is shipped
        benchmark.train(config, "lane-4-density-2", work, "lane-4-density-2", (), ablations=True, only=names)


def test_more_data_is_collected_first_and_learned_from_by_rapid_and_cql(benchmark, config, tmp_path, monkeypatch):
    collected, mixed, learned = [], [], {}
    monkeypatch.setattr(
        benchmark,
        "collect_transitions",
        lambda config, out, driver: collected.append((driver, out, config.collect, config.scenario)),
    )
    monkeypatch.setattr(benchmark, "mix_datasets", lambda config, *folders: mixed.append((config.mix.size, *folders)))
    monkeypatch.setattr(
        benchmark,
        "distill_agent",
        lambda config, data, out, name: learned.update({name: (config.distill, data)}),
    )
    scenario, work = "lane-4-density-2.5", tmp_path / "seed-0"
    names = ["distilled, 60K", "distilled, 60K, no J_robust", "CQL, 60K"]
    agents = benchmark.train(config, scenario, work, scenario, (), only=names, more_data=True)
    assert [name for name, _ in agents] == list(learned) == names
    teacher, random = tmp_path / "collected" / "teacher", tmp_path / "collected" / "random"
    assert {(driver, out) for driver, out, *_ in collected} == {("teacher", teacher), ("random", random)}
    assert {(c.teacher_transitions, c.random_transitions) for _, _, c, _ in collected} == {(60_000, 60_000)}
    assert {where for *_, where in collected} == {scenario}
    assert set(mixed) == {(120_000, teacher, random, work / "mix-collected")}
    assert {data for _, data in learned.values()} == {work / "mix-collected"}
    assert {settings.iterations for settings, _ in learned.values()} == {4 * config.distill.iterations}
    whole, part = (learned[name][0] for name in names[:2])
    assert whole == replace(part, loss=config.distill.loss)
    assert part.loss.robust_weight == 0
    with pytest.raises(RapidError, match="no agent 'distilled, 60K'"):
        benchmark.train(config, scenario, work, scenario, (), only=names)


def test_each_recipe_and_reward_has_a_table_of_its_own(benchmark, config, tmp_path, monkeypatch):
    for scenario in ("lane-3-density-2", "lane-3-density-2:progress"):
        rows = [
            replace(row, agent="distilled", commit="c0ffee00") for row in run_episodes(SCRIPTED, scenario, [0]).rows(0)
        ]
        path = tmp_path / scenario / "seed-0" / "rows" / f"{scenario}-1-distilled.parquet"
        benchmark.save_rows(path, rows)
        benchmark.save_rows(tmp_path / "floors.parquet", rows)
        benchmark.table(tmp_path, [scenario], "", 1, config, tmp_path)
    assert {path.stem for path in tmp_path.glob("scores*.md")} == {"scores-1", "scores-progress-1"}
    monkeypatch.setattr(benchmark, "USUAL_SPAWNS", 1)
    for scenario in ("lane-3-density-2", "lane-3-density-2:progress"):
        benchmark.table(tmp_path, [scenario], "", 1, config, tmp_path)
    assert {path.stem for path in tmp_path.glob("scores*.md")} >= {"scores", "scores-progress"}
    assert "the commits c0ffee0." in (tmp_path / "scores.md").read_text()


def test_floors_drive_where_they_have_not_and_are_in_the_table(benchmark, config, tmp_path):
    scenarios = ["lane-3-density-2", "lane-3-density-2-fast"]
    # There are rows of the first scenario alone, and of the rule's driving on fewer spawns.
    had = run_episodes(open_agent("slower", scenarios[0]), scenarios[0], spawn_seeds("test", 2)).rows()
    part = run_episodes(open_agent("rule", scenarios[0]), scenarios[0], spawn_seeds("test", 1)).rows()
    benchmark.save_rows(tmp_path / "floors.parquet", [*had, *part])
    benchmark.measure_references(tmp_path, [*had, *part], ["slower", "rule"], scenarios, 2)
    driven = {path.name for path in (tmp_path / "rows").iterdir()}
    assert driven == {f"{scenario}-2-rule.parquet" for scenario in scenarios} | {f"{scenarios[1]}-2-slower.parquet"}
    benchmark.table(tmp_path, scenarios, "", 2, config, tmp_path)
    page = (tmp_path / "scores-2.md").read_text()
    assert page.count("\nalways-slower ") == page.count("\nrule ") == 2


def test_an_agent_is_compared_with_where_it_began_and_with_its_like(benchmark, config):
    begun = "RAPID, 300K"
    names = [begun, f"{begun}, 31 seen", f"{begun} + 700K PPO", f"{begun}, 31 seen + 700K PPO"]
    names += [f"{begun} + 700K PPO, fine-tuned whole", f"{begun}, 31 seen + 700K PPO, mirrored"]
    names += ["online Munchausen DQN, 300K + 700K PPO"]
    rows = run_episodes(SCRIPTED, "lane-3-density-2", [0, 1]).rows(0)
    page = benchmark.report([replace(row, agent=n) for n in names for row in rows], config, "", 2, "command")
    pairs = re.findall(r"^- (.*) against (.*), paired", page, re.MULTILINE)
    assert len(pairs) == len(set(pairs))
    assert set(pairs) == {
        (names[1], names[0]),
        (names[2], names[0]),
        (names[2], names[6]),
        (names[2], names[4]),
        (names[3], names[1]),
        (names[3], names[2]),
        (names[3], names[6]),
        (names[4], names[0]),
        (names[5], names[3]),
    }


def test_the_recipe_paper_has_its_online_dqn_as_printed(benchmark, tmp_path, asked):
    benchmark.train(preset("paper", "full"), "lane-3-density-2", tmp_path, "lane-3-density-2", (10_000,), False)
    assert list(asked) == ["RAPID, 10K", "online DDQN, 10K", "online DQN, 10K"]
    rates = {name: (adapt.optimizer.learning_rate, adapt.loss.double) for name, (adapt, *_) in asked.items()}
    assert rates["online DQN, 10K"] == (5e-3, False)
    assert rates["online DDQN, 10K"] == (5e-4, True)
    assert {adapt.loss.discount for adapt, *_ in asked.values()} == {0.99}


def test_the_papers_numbers_stand_beside_ours(benchmark):
    rows = [
        *run_episodes(SCRIPTED, "lane-3-density-2", [0, 1]).rows(0),
        *run_episodes(SCRIPTED, "lane-3-density-2", [0, 1], "uniform").rows(0),
    ]
    ours = [replace(row, agent="RAPID, 10K") for row in rows]
    lines = benchmark.beside_paper([*ours, *(replace(row, agent="someone else") for row in rows)], "lane-3-density-2")
    told = lines[2]
    assert told.startswith("| RAPID, 10K | ")
    assert "(20.42 ± 2.59)" in told
    assert "(20.41 ± 1.58)" in told
    assert f"{np.mean([row.episode_return for row in rows if row.attack == 'none']):.2f} (" in told
    assert "someone else" not in "".join(lines)
    assert benchmark.beside_paper(ours, "lane-3-density-2:progress") == []
