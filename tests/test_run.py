"""The whole job, as small as it gets: what a user sees of it, killed and resumed, and redone from a step."""

import html
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rapid
from rapid.agents.saved import QAgent
from rapid.baselines import offline_baseline, online_baseline
from rapid.config import Config, PpoConfig
from rapid.config_io import apply_overrides, validate
from rapid.data.batch import TransitionBatch
from rapid.data.dataset import load_dataset
from rapid.data.replay import OfflineSampler
from rapid.errors import RapidError
from rapid.evaluation.metrics import load_rows
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.options import Run
from rapid.parsing import parse
from rapid.phases.adapt import adapt_agent
from rapid.phases.data import data_folders, mix_datasets
from rapid.phases.distill import distill_agent, distill_seeds
from rapid.phases.measure import compare
from rapid.phases.page import report_again
from rapid.presets import preset
from rapid.run import run
from rapid.runs import STEPS
from rapid.scenarios import SLOWER
from rapid.seeding import stream_seed
from rapid.training.machinery.diagnostics import FORGETTING_STATES
from rapid.training.machinery.record import load_metrics

SMALL = {
    "teacher": {"backend": "scripted", "model": "rule"},
    "collect": {"teacher_transitions": 40, "random_transitions": 60, "lockstep": 2},
    "mix": {"size": 40},
    "network": {"width": 16, "heads": 2, "feedforward": 16},
    "distill": {"iterations": 6, "evaluate_every": 3, "loss": {"robust": {"steps": 2}}},
    "adapt": {
        "steps": 40,
        "learning_starts": 20,
        "evaluate_every": 20,
        "ppo": {"steps": 60, "num_envs": 3, "rollout": 10, "batch_size": 16, "critic_steps": 30},
    },
    "evaluate": {"spawns": 2, "curve_spawns": 1, "attacks": ["none", "uniform", "pgd"]},
}


@pytest.fixture(scope="module")
def config() -> Config:
    return apply_overrides(preset("strong", "tiny"), SMALL)


@pytest.fixture(scope="module")
def finished(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run") / "run"
    run(config, directory, say=lambda line: None)
    return directory


def artefacts(directory: Path) -> dict[str, bytes]:
    """What a run computed, without what tells when and how fast."""
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.name in ("weights.safetensors", "transitions.parquet")
    }


def test_a_run_leaves_agents_rows_and_a_page(finished: Path):
    for agent in ("distill/rapid", "distill/offline-dqn", "distill/cloning", "adapt/rapid", "adapt/online-dqn"):
        assert rapid.load_agent(finished / agent / "agent").name
    rows = load_rows(finished / "evaluate" / "episodes.parquet")
    measured = {row.agent for row in rows}
    assert {"slower", "idle", "random", "rule", "planner", "behaviour cloning", "offline DQN", "RAPID"} <= measured
    assert {"immune", "blind", "online DQN", "online PPO"} <= measured
    assert {row.attack for row in rows if row.agent == "RAPID"} == {"none", "uniform", "pgd"}
    page = (finished / "report.html").read_text()
    assert "always-slower" in page
    assert "Ahead of RAPID in" in page
    assert "Ahead of RAPID in" in (finished / "evaluate/summary.txt").read_text()
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert (finished / "figures" / "results.png").stat().st_size > 10_000


@pytest.mark.parametrize("kind", ["mlp", "rapid"])
def test_several_seeds_are_what_each_is_alone(finished: Path, tmp_path: Path, kind: Any):
    config = preset("strong", "tiny")
    if kind == "mlp":
        config = offline_baseline(config, "cql")
    small = replace(config.distill, iterations=4, evaluate_every=2)
    config = replace(config, distill=small, evaluate=replace(config.evaluate, curve_spawns=1))
    homes = distill_seeds(config, finished / "mix", tmp_path / "all", (1, 2))
    assert [home.name for home in homes] == ["seed-1", "seed-2"]
    assert (tmp_path / "all" / "together" / "metrics.jsonl").exists() == (kind == "mlp")
    for seed, home in zip((1, 2), homes, strict=True):
        alone = distill_agent(replace(config, seed=seed), finished / "mix", tmp_path / f"{seed}")
        agent = rapid.load_agent(home / "agent")
        assert agent.metadata["seed"] == seed
        for name, weight in alone.network.state_dict().items():
            torch.testing.assert_close(agent.network.state_dict()[name], weight, rtol=1e-3, atol=1e-5)
    # The same command does nothing again; other ways of training do not write over it.
    before = [(home / "agent" / "weights.safetensors").read_bytes() for home in homes]
    assert distill_seeds(config, finished / "mix", tmp_path / "all", (1, 2)) == homes
    other = preset("strong", "tiny") if kind == "mlp" else offline_baseline(preset("strong", "tiny"), "cql")
    with pytest.raises(RapidError, match="Choose another --out"):
        distill_seeds(other, finished / "mix", tmp_path / "all", (1, 2))
    assert [(home / "agent" / "weights.safetensors").read_bytes() for home in homes] == before


def test_online_baselines_drive_as_much_as_phase_3_and_know_nothing_at_first(config: Config, finished: Path):
    steps = config.adapt.steps + config.adapt.ppo.steps
    ours = load_metrics(finished / "adapt/rapid/ppo")[-1]["step"]
    assert ours == load_metrics(finished / "adapt/online-dqn")[-1]["step"] == steps
    # Of PPO whole rollouts.
    per_rollout = config.adapt.ppo.num_envs * config.adapt.ppo.rollout
    assert load_metrics(finished / "adapt/online-ppo/ppo")[-1]["step"] == steps // per_rollout * per_rollout
    for name in ("online-dqn", "online-ppo"):
        agent = rapid.load_agent(finished / "adapt" / name / "agent")
        assert agent.network.config.kind == "mlp"
        assert rapid.load_agent(finished / "adapt" / name / "new").metadata["phase"] == "new"
    assert "online PPO" in (finished / "report.html").read_text()


@pytest.mark.parametrize("plan", ["bold", "ppo", "robust", "guided", "squeezed", "wary"])
def test_online_baselines_of_every_plan_can_be_trained(plan: str):
    for change in ({}, {"vehicles": 31}, {"mirror": True, "memory": False}):
        config = preset("strong", "tiny", plan)
        config = replace(config, adapt=replace(config.adapt, **change))
        for algorithm in ("dqn", "ppo"):
            other = online_baseline(config, algorithm)
            validate(other)
            assert other.network.vehicles == (config.adapt.vehicles or 15)
            assert (other.adapt.steps > 0, other.adapt.ppo.steps > 0) == (algorithm == "dqn", algorithm == "ppo")


def test_distillation_leaves_the_adapter_and_adaptation_the_distilled_policy(config: Config, finished: Path):
    before = rapid.load_agent(finished / "distill/rapid/agent").network.state_dict()
    after = rapid.load_agent(finished / "adapt/rapid/agent").network.state_dict()
    new = build_network(config.network, 3, stream_seed(config.seed, "network")).state_dict()
    adapter = [name for name in new if name.startswith("head.mixture.policies.1.")]
    assert adapter
    assert all(new[name].equal(before[name]) for name in adapter)
    assert any(not new[name].equal(before[name]) for name in new)
    frozen = [name for name in before if name.startswith("head.mixture.policies.0.")]
    assert frozen
    assert all(before[name].equal(after[name]) for name in frozen)
    assert any(not before[name].equal(after[name]) for name in before)


def test_the_page_says_how_to_repeat_the_run_and_that_repeats_it(config: Config, finished: Path):
    (said,) = re.findall(r'class="command">Repeat it with <code>(.*?)</code>', (finished / "report.html").read_text())
    command, verb, *words = shlex.split(html.unescape(said))
    options, again = parse(verb, {verb: Run}, words)
    assert (command, verb, again) == ("rapid", "run", config)
    # Where the run itself lives everything is done, and nothing would be repeated.
    assert not Path(options.directory).exists()


def test_the_same_command_again_does_nothing(config: Config, finished: Path):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.name != "lock"}
    said: list[str] = []
    run(config, finished, say=said.append)
    assert before == {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.name != "lock"}
    assert sum("done before" in line for line in said) == len(STEPS)


def test_steps_of_another_commit_are_named(config: Config, finished: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rapid.run.commit", lambda: "another")
    said: list[str] = []
    run(config, finished, say=said.append)
    (line,) = (line for line in said if "another commit" in line)
    assert all(step in line for step in STEPS)


def test_other_settings_and_unknown_steps_are_refused(config: Config, finished: Path):
    with pytest.raises(RapidError, match="other settings"):
        run(apply_overrides(config, {"seed": 1}), finished, say=lambda line: None)
    with pytest.raises(RapidError, match="did you mean 'mix'"):
        run(config, finished, "mxi", say=lambda line: None)


@pytest.mark.parametrize("damaged", [False, True])
def test_force_begins_anew_and_removes_only_what_a_run_makes(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damaged: bool
):
    # As far as the mixture: no step after it is of interest here.
    monkeypatch.setattr("rapid.run.distill_agent", lambda *given: (_ for _ in ()).throw(RapidError("Enough.")))
    home, other = tmp_path / "run", apply_overrides(config, {"seed": 1})

    def begin(config: Config, **options: Any) -> str:
        with pytest.raises(RapidError) as told:
            run(config, home, say=lambda line: None, **options)
        return str(told.value)

    assert begin(config) == "Enough."
    before = artefacts(home)
    if damaged:
        (home / "run.json").write_text("{")
    assert ("damaged" if damaged else "seed: 0 there, 1 now") in begin(other)
    (home / "thesis.tex").write_text("mine")
    assert "thesis.tex" in begin(other, force=True)
    assert artefacts(home) == before
    (home / "thesis.tex").unlink()
    inside = apply_overrides(other, {"data": str(home / "collect")})
    assert "is read by this command" in begin(inside, force=True)
    assert artefacts(home) == before
    assert begin(other, force=True) == "Enough."
    assert artefacts(home).keys() == before.keys()
    assert artefacts(home) != before
    assert json.loads((home / "run.json").read_text())["config"]["seed"] == 1
    # A directory that is no run's is never emptied.
    for path in (home / "run.json", home / "config.toml"):
        path.unlink()
    before = artefacts(home)
    assert "not the directory of a run" in begin(config, force=True)
    assert artefacts(home) == before


@pytest.mark.slow
def test_a_killed_run_ends_as_an_uninterrupted_one(config: Config, finished: Path, tmp_path: Path):
    words = [sys.executable, "-m", "rapid.cli", "run", "--config", str(finished / "config.toml")]
    words += ["--directory", str(tmp_path / "run")]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (tmp_path / "run/steps/mix.json").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "run/steps/report.json").exists()
    run(config, tmp_path / "run", say=lambda line: None)
    assert artefacts(tmp_path / "run") == artefacts(finished)


def test_redoing_a_step_gives_the_same_again(config: Config, finished: Path):
    before = artefacts(finished)
    run(config, finished, "evaluate", say=lambda line: None)
    assert artefacts(finished) == before


def test_the_page_can_be_written_again(finished: Path):
    (finished / "report.html").unlink()
    assert report_again(finished).exists()


def test_a_comparison_goes_on_only_with_the_same_request(config: Config, finished: Path, tmp_path: Path):
    agent = str(finished / "distill/offline-dqn/agent")
    out = tmp_path / "comparison"
    rows = compare(config, ["slower", agent], out)
    assert {row.agent for row in rows} == {"slower", "offline DQN"}
    assert (out / "results.png").exists()
    assert compare(config, ["slower", agent], out) == rows
    with pytest.raises(RapidError, match="Choose another --out"):
        compare(config, ["idle", agent], out)


def test_two_agents_of_one_name_stay_apart(config: Config, finished: Path, tmp_path: Path):
    agent = finished / "distill/offline-dqn/agent"
    shutil.copytree(agent, tmp_path / "other")
    rows = compare(config, [str(agent), str(tmp_path / "other")], tmp_path / "comparison")
    assert {row.agent for row in rows} == {f"offline DQN ({path})" for path in (agent, tmp_path / "other")}


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"network": {"kind": "attentive"}}, "has no adapter"),
        ({"adapt": {"mirror": True, "scenario": "lane-4-density-2.5"}}, "mirrors the road does so on 3 lanes"),
        ({"adapt": {"vehicles": 31}, "network": {"position": "learned"}}, "weights for each of its 15 vehicles"),
        ({"adapt": {"vehicles": 10}}, "reads 15 vehicles"),
        ({"collect": {"shard": "1/2"}}, "a run needs the whole collection"),
        ({"mix": {"size": 400}}, "collect.teacher_transitions"),
        ({"mix": {"p": 0.0}, "collect": {"teacher_transitions": 0}}, "collect.teacher_transitions"),
        ({"evaluate": {"attacks": ["pdg"]}}, "did you mean 'pgd'"),
        ({"device": "tpu"}, "--device cpu"),
        ({"teacher": {"backend": "replay", "replay_file": "nowhere"}}, "There is no recording at 'nowhere'"),
        ({"teacher": {"backend": "endpoint", "base_url": "nowhere"}}, "The address 'nowhere' cannot be used"),
        ({"teacher": {"backend": "local", "model": "smollm"}}, "did you mean 'smollm2-135m'"),
        ({"teacher": {"backend": "endpoint", "memory": "nowhere", "few_shot": 3}}, "There is no memory at 'nowhere'"),
        ({"teacher": {"backend": "endpoint", "few_shot": 3}}, "no memory to take examples from"),
        ({"teacher": {"few_shot": -1}}, "teacher.few_shot"),
    ],
)
def test_steps_that_cannot_follow_are_refused_before_any_work(
    config: Config, tmp_path: Path, overrides: dict[str, object], says: str
):
    with pytest.raises(RapidError, match=says):
        run(apply_overrides(config, overrides), tmp_path / "run", say=lambda line: None)
    assert not (tmp_path / "run").exists()


def test_phase_3_goes_on_by_ppo_from_any_agent(config: Config, finished: Path, tmp_path: Path):
    first, second = (load_metrics(finished / part) for part in ("adapt/rapid", "adapt/rapid/ppo"))
    assert [row["step"] for row in (*first, *second)] == [20, 40, 70, 100]
    # How much is forgotten is told of what was distilled, throughout.
    assert 0 < first[-1]["agreement"] <= 1
    page = (finished / "report.html").read_text()
    assert re.search(r"\[100(\.0)?,", page)
    # Q-learning first and PPO later is the same as both in one call, and either can be left out.
    halves = [replace(config, adapt=replace(config.adapt, ppo=PpoConfig()))]
    halves.append(replace(config, adapt=replace(config.adapt, steps=0)))
    start, agents = finished / "distill/rapid/agent", []
    for number, half in enumerate(halves):
        adapt_agent(half, start, finished / "mix", tmp_path / f"{number}")
        start = tmp_path / f"{number}" / "agent"
        agents.append(rapid.load_agent(start).network.state_dict())
    whole = rapid.load_agent(finished / "adapt/rapid/agent").network.state_dict()
    assert all(whole[name].equal(agents[1][name]) for name in whole)
    assert any(not whole[name].equal(agents[0][name]) for name in whole)
    assert not (tmp_path / "1" / "metrics.jsonl").exists()


def test_from_phase_3_on_left_and_right_may_be_made_alike(config: Config, finished: Path, tmp_path: Path):
    start, found = finished / "distill/rapid/agent", {}
    for mirror, steps in ((True, 0), (True, 40), (False, 40)):
        adapt, out = replace(config.adapt, mirror=mirror, steps=steps, ppo=PpoConfig()), tmp_path / f"{mirror}-{steps}"
        adapt_agent(replace(config, adapt=adapt), start, None, out)
        network = rapid.load_agent(out / "agent").network
        assert network.config.mirror == mirror
        found[mirror, steps] = network.state_dict()
    before = rapid.load_agent(start).network.state_dict()
    assert all(value.equal(before[name]) for name, value in found[True, 0].items())
    # It is learned with, too.
    assert any(not value.equal(found[False, 40][name]) for name, value in found[True, 40].items())
    for other, name in ((2, "lane-2-density-1"), (4, "lane-4-density-1")):
        with pytest.raises(RapidError, match=f"mirror image on 3 lanes .* but {name} has {other}"):
            run_episodes(rapid.load_agent(tmp_path / "True-0" / "agent"), name, [900_000])
        adapt = replace(config.adapt, mirror=True, scenario=name)
        with pytest.raises(RapidError, match="mirror image on 3 lanes"):
            adapt_agent(replace(config, adapt=adapt), start, None, tmp_path / name)
    elsewhere = replace(config, scenario="lane-4-density-1")
    with pytest.raises(RapidError, match="mirror image on 3 lanes"):
        compare(elsewhere, ["slower", str(tmp_path / "True-0" / "agent")], tmp_path / "comparison")
    assert not (tmp_path / "comparison").exists()
    adapt = replace(config.adapt, mirror=True, steps=0, ppo=PpoConfig())
    with pytest.raises(RapidError, match="would replace the agent itself"):
        adapt_agent(replace(config, adapt=adapt), tmp_path / "True-40/agent", None, tmp_path / "True-40")


def test_a_run_whose_agent_sees_more_than_the_others_has_its_page(config: Config, tmp_path: Path):
    run(apply_overrides(config, {"adapt": {"vehicles": 31}}), tmp_path / "run", say=lambda line: None)
    assert rapid.load_agent(tmp_path / "run/adapt/rapid/agent").vehicles == 31
    assert "after adaptation" in (tmp_path / "run/report.html").read_text()


def test_from_phase_3_on_more_may_be_seen(
    config: Config, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    start = finished / "distill/rapid/agent"
    adapt = replace(config.adapt, vehicles=31)
    adapt_agent(replace(config, adapt=adapt), start, finished / "mix", tmp_path / "far")
    agent = rapid.load_agent(tmp_path / "far/agent")
    assert agent.vehicles == agent.network.config.vehicles == 31
    assert json.loads((tmp_path / "far/agent/config.json").read_text())["vehicles"] == 31
    # It is given what it reads, and what only its farther rows hold moves it.
    (row,) = run_episodes(agent, config.scenario, [900_000], record=True).recordings
    assert row.obs_TVF.shape[1:] == (31, 5)
    assert row.obs_TVF[0, 15:, 0].any()
    near = np.where(np.arange(31)[:, None] < 15, row.obs_TVF, 0)
    assert (agent.q_values(row.obs_TVF) != agent.q_values(near)).any()
    # How close it comes is told of the usual rows, whatever it reads.
    for vehicles in (5, 31):
        other = QAgent(build_network(replace(config.network, vehicles=vehicles), 3, 0))
        usual = QAgent(build_network(config.network, 3, 0))
        for one in (usual, other):
            monkeypatch.setattr(one, "act", lambda obs_BVF: np.full(len(obs_BVF), SLOWER))
            monkeypatch.setattr(one, "q_values", lambda obs_BVF: np.eye(5, dtype=np.float32)[[SLOWER] * len(obs_BVF)])
        ours, theirs = (run_episodes(one, config.scenario, range(900_000, 900_020)) for one in (other, usual))
        assert np.array_equal(ours.min_ttc_E, theirs.min_ttc_E, equal_nan=True)
    # Once it sees so far it goes on so, by itself or told the same; it cannot go back.
    for vehicles, out in ((0, "kept"), (31, "told")):
        adapt = replace(config.adapt, vehicles=vehicles, ppo=PpoConfig())
        adapt_agent(replace(config, adapt=adapt), tmp_path / "far/agent", None, tmp_path / out)
        assert rapid.load_agent(tmp_path / out / "agent").vehicles == 31
    adapt = replace(config.adapt, vehicles=20)
    with pytest.raises(RapidError, match="reads 31 vehicles"):
        adapt_agent(replace(config, adapt=adapt), tmp_path / "far/agent", None, tmp_path / "back")


def test_what_was_distilled_is_what_forgetting_is_told_of(config: Config, finished: Path, tmp_path: Path):
    adapt = replace(config.adapt, mirror=True)
    agent = finished / "distill/rapid/agent"
    adapt_agent(replace(config, adapt=adapt), agent, finished / "mix", tmp_path)
    network = rapid.load_agent(tmp_path / "agent").network
    states = torch.from_numpy(load_dataset(finished / "mix").transitions.obs_NVF)
    distilled = rapid.load_agent(agent).network
    with torch.inference_mode():
        same = (network(states).argmax(1) == distilled(states).argmax(1)).double().mean().item()
    assert len(states) <= FORGETTING_STATES
    assert load_metrics(tmp_path / "ppo")[-1]["agreement"] == pytest.approx(same)
    # Q-learning too: mirrored, and not yet trained, it does not act as what was distilled.
    untrained = replace(adapt, learning_starts=1_000, ppo=PpoConfig())
    adapt_agent(replace(config, adapt=untrained), agent, finished / "mix", tmp_path / "untrained")
    network = rapid.load_agent(tmp_path / "untrained/agent").network
    with torch.inference_mode():
        same = (network(states).argmax(1) == distilled(states).argmax(1)).double().mean().item()
    assert load_metrics(tmp_path / "untrained")[-1]["agreement"] == pytest.approx(same)
    assert same < 1


def test_adapting_needs_no_dataset(config: Config, finished: Path, tmp_path: Path):
    agent = adapt_agent(config, finished / "distill/rapid/agent", None, tmp_path / "adapted")
    assert rapid.load_agent(tmp_path / "adapted" / "agent").name == agent.name


def test_a_mixture_in_every_batch_is_one_in_phase_3_too(
    config: Config, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    mixed = replace(config, mix=replace(config.mix, level="batch", p=0.25))
    mix_datasets(mixed, *data_folders(config, finished), tmp_path / "mix")
    shares: set[float] = set()

    class Watched(OfflineSampler):
        def sample(self, size: int, *rngs: np.random.Generator) -> TransitionBatch:
            batch = super().sample(size, *rngs)
            shares.add(float(batch.teacher_B.float().mean()))
            return batch

    monkeypatch.setattr("rapid.training.online.OfflineSampler", Watched)
    adapt = replace(config.adapt, offline_share=0.5, ppo=PpoConfig())
    adapt_agent(replace(mixed, adapt=adapt), finished / "distill/rapid/agent", tmp_path / "mix", tmp_path / "adapted")
    assert shares == {0.25}


def test_an_agent_tells_what_was_used_not_what_was_asked_for(config: Config, finished: Path, tmp_path: Path):
    asked = replace(
        config,
        scenario="lane-4-density-1",
        network=replace(config.network, kind="mlp"),
        adapt=replace(config.adapt, offline_share=0.5, steps=20, learning_starts=10, ppo=PpoConfig()),
        data="somewhere",
    )
    adapt_agent(asked, finished / "distill/rapid/agent", None, tmp_path / "adapted")
    told = rapid.load_agent(tmp_path / "adapted/agent").metadata
    used = told["config"]
    assert used["scenario"] == used["adapt"]["scenario"] == told["scenario"] == config.scenario
    assert (used["network"]["kind"], used["adapt"]["offline_share"]) == ("rapid", 0.0)
    assert not {"mix", "distill", "collect", "teacher", "data"} & used.keys()
    distill_agent(asked, finished / "mix", tmp_path / "distilled")
    used = rapid.load_agent(tmp_path / "distilled/agent").metadata["config"]
    assert (used["scenario"], used["network"]["kind"]) == (config.scenario, "mlp")
    assert not {"mix", "adapt", "collect", "teacher", "data"} & used.keys()


def test_a_driver_named_twice_is_driven_once_and_as_itself(config: Config, tmp_path: Path):
    once = compare(config, ["slower"], tmp_path / "once")
    twice = compare(config, ["slower", "slower"], tmp_path / "twice")
    assert [(row.agent, row.kind, row.mean_speed) for row in twice] == [
        (row.agent, row.kind, row.mean_speed) for row in once
    ]


def test_a_damaged_artefact_stops_the_run_and_is_left_as_it_is(config: Config, finished: Path, tmp_path: Path):
    directory = tmp_path / "run"
    shutil.copytree(finished, directory)
    for step in STEPS[1:]:
        (directory / "steps" / f"{step}.json").unlink()
    damaged = directory / "collect/teacher/transitions.parquet"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    with pytest.raises(RapidError, match="cut off"):
        run(config, directory, say=lambda line: None)
    assert damaged.stat().st_size == 1000


def test_baselines_have_the_papers_printed_sizes_in_its_recipe():
    def sizes(recipe: str) -> dict[str, tuple[float, int, int]]:
        found = {}
        for name in ("dqn", "ddqn", "cql"):
            optimizer = offline_baseline(preset(recipe, "full"), name).distill.optimizer
            found[name] = (optimizer.learning_rate, optimizer.batch_size, optimizer.target_update)
        return found

    assert sizes("paper") == {"dqn": (5e-3, 32, 50), "ddqn": (5e-4, 32, 50), "cql": (5e-4, 64, 50)}
    assert len(set(sizes("strong").values())) == 1
    terms = {name: offline_baseline(preset("paper"), name).distill.loss for name in ("dqn", "ddqn", "cql", "bc")}
    assert {name for name, loss in terms.items() if loss.conservative_weight} == {"cql"}
    assert {name for name, loss in terms.items() if loss.double} == {"ddqn", "cql"}
    assert not any(loss.robust_weight for loss in terms.values())
