"""Datasets that come with the package, and a run on them, which asks no model for anything."""

import re
import shutil
from pathlib import Path

import pytest

from rapid.config import Config, TeacherConfig
from rapid.config_io import apply_overrides
from rapid.data.card import card
from rapid.data.dataset import load_dataset
from rapid.data.shipped import dataset_folder, shipped_sets
from rapid.data.transitions import RANDOM, TEACHER
from rapid.errors import RapidError
from rapid.evaluation.metrics import load_rows
from rapid.evaluation.teachers import drive_teacher
from rapid.files import read_json
from rapid.phases.measure import why_no_teacher
from rapid.phases.page import report_again
from rapid.presets import preset
from rapid.run import run
from rapid.scenarios import PAPER_SCENARIOS
from rapid.teacher import make_teacher
from rapid.verbs import prepare

SMALL = {
    "data": "shipped",
    "mix": {"p": 0.25, "size": 40},
    "network": {"width": 16, "heads": 2, "feedforward": 16},
    "distill": {"iterations": 4, "evaluate_every": 0, "loss": {"robust": {"steps": 2}}},
    "adapt": {"steps": 40, "learning_starts": 20, "evaluate_every": 0},
    "evaluate": {"spawns": 2, "planner_spawns": 0, "curve_spawns": 1, "attacks": ["none"]},
}


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    monkeypatch.setenv("RAPID_CACHE", str(tmp_path / "cache"))  # no model is there
    return apply_overrides(preset("strong", "tiny"), SMALL)


@pytest.mark.parametrize("name", shipped_sets())
def test_every_shipped_set_is_whole_and_names_no_place(name: str):
    data = load_dataset(f"shipped:{name}")
    scenario, kind = name.split("/")
    assert (data.scenario, len(data) >= (100 if kind == "react" else 15_000)) == (scenario, True)
    assert set(data.transitions.source_N.tolist()) == {RANDOM if kind == "random" else TEACHER}
    assert data.log is not None
    assert data.log.num_rows == len(data)
    if kind in ("teacher", "react"):
        assert all(data.log.column("told").to_pylist())
        assert all(data.log.column("computed").to_pylist()) == (kind == "teacher")
    facts = (dataset_folder(f"shipped:{name}") / "dataset.json").read_text()
    assert not re.search(r"/(home|root|tmp|work|Users)\b|api_key|base_url", facts)


def test_the_shipped_conversations_are_repeated_without_a_model():
    """Every prompt of theirs is still the one that the model was given."""
    path = dataset_folder(f"shipped:{PAPER_SCENARIOS[0]}/react")
    steps = load_dataset(path).transitions
    teacher = make_teacher(TeacherConfig(backend="replay", replay_file=str(path)), 3)
    seeds = list(dict.fromkeys(steps.spawn_seed_N.tolist()))
    rows = drive_teacher(teacher, "replay", PAPER_SCENARIOS[0], seeds, len(seeds))
    assert sum(row.length for row in rows) == len(steps)
    assert sum(row.episode_return for row in rows) == pytest.approx(float(steps.reward_N.sum()), abs=1e-3)


def test_all_of_them_together_are_small():
    sets = [dataset_folder(f"shipped:{name}") for name in shipped_sets()]
    assert sum(path.stat().st_size for folder in sets for path in folder.iterdir()) <= 20e6


@pytest.mark.parametrize("scenario", PAPER_SCENARIOS)
def test_every_scenario_of_the_paper_has_a_teacher_and_a_random_driver(scenario: str):
    assert {f"{scenario}/teacher", f"{scenario}/random"} <= set(shipped_sets())


def cards() -> str:
    """The cards of the shipped sets as the documentation shows them, without what is the same in all of them."""
    texts: list[str] = []
    for name in shipped_sets():
        _, _, text = card(load_dataset(f"shipped:{name}")).partition("\n")
        own = text.partition("## Reading it")[0].strip()
        texts.append(f"### shipped:{name}\n\n{own}\n".replace("\n## ", "\n#### "))
    return "\n".join(texts)


def test_the_documentation_shows_their_cards():
    page = (Path(__file__).parents[1] / "docs" / "data.md").read_text()
    # After a change: replace what follows "## Cards" by what cards() returns.
    assert page.partition("## Cards\n\n")[2] == cards()


def test_a_run_on_shipped_data_goes_from_the_mixture_to_the_page_without_a_model(config: Config, tmp_path: Path):
    said: list[str] = []
    page = run(config, tmp_path / "run", say=said.append).read_text()
    assert not (tmp_path / "run" / "collect").exists()
    assert not (tmp_path / "cache" / "models").exists()
    assert load_dataset(tmp_path / "run" / "mix").drivers["teacher"]["name"] == "smollm2-135m"
    measured = {row.agent for row in load_rows(tmp_path / "run/evaluate/episodes.parquet")}
    assert "RAPID" in measured
    assert "smollm2-135m" not in measured
    assert any("rapid models pull smollm2-135m" in line for line in said)
    assert "its data: shipped" in page
    assert "rapid models pull smollm2-135m" in page
    assert "rapid models pull" in report_again(tmp_path / "run").read_text()


def test_a_folder_with_both_sets_serves_too_and_its_driver_is_measured(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shutil.copytree(dataset_folder("shipped:lane-3-density-2/rule"), tmp_path / "mine" / "teacher")
    shutil.copytree(dataset_folder("shipped:lane-3-density-2/random"), tmp_path / "mine" / "random")
    monkeypatch.chdir(tmp_path)
    driver = {"teacher": {"backend": "scripted", "model": "rule-forecast"}}
    monkeypatch.setattr("rapid.run._report", lambda config, home: {})
    run(apply_overrides(config, {"data": "mine", **driver}), tmp_path / "run", say=lambda line: None)
    assert "rule-forecast" in {row.agent for row in load_rows(tmp_path / "run/evaluate/episodes.parquet")}
    # Kept whole, so that the page can be written again from anywhere.
    assert read_json(tmp_path / "run" / "run.json")["config"]["data"] == str(tmp_path / "mine")


def test_a_driver_other_than_the_datas_is_not_measured_as_the_teacher(config: Config):
    other = {"teacher": {"backend": "scripted", "model": "rule-forecast"}}
    assert "smollm2-135m drove in the data" in why_no_teacher(apply_overrides(config, other))


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"scenario": "lane-2-density-1"}, "No data is shipped .* lane-3-density-2, .*, lane-5-density-3"),
        ({"scenario": "lane-3-density-2:progress"}, "No data is shipped"),
        ({"data": "nowhere"}, "There is no dataset at '.*nowhere/teacher/dataset.json'"),
        ({"mix": {"size": 90_000}}, "The mixture needs 22500 teacher transitions .*, but there are 15028"),
    ],
)
def test_data_that_cannot_serve_is_refused_before_any_work(
    config: Config, tmp_path: Path, overrides: dict[str, object], says: str
):
    with pytest.raises(RapidError, match=says):
        run(apply_overrides(config, overrides), tmp_path / "run", say=lambda line: None)
    assert not (tmp_path / "run").exists()


def test_data_of_another_scenario_is_refused(config: Config, tmp_path: Path):
    given = {"data": str(dataset_folder("shipped:lane-3-density-2/teacher").parent), "scenario": "lane-4-density-2.5"}
    with pytest.raises(RapidError, match="is of the scenario 'lane-3-density-2', not"):
        run(apply_overrides(config, given), tmp_path / "run", say=lambda line: None)


def test_a_shipped_set_stands_where_a_path_is_expected(tmp_path: Path):
    sets = [f"shipped:lane-3-density-2/{name}" for name in ("rule", "random")]
    assert prepare("mix", [*sets, "--size", "40", "--out", str(tmp_path / "mixed")])() == 0
    assert load_dataset(tmp_path / "mixed").drivers["teacher"]["name"] == "rule-forecast"
    with pytest.raises(RapidError, match="did you mean 'lane-3-density-2/rule'"):
        load_dataset("shipped:lane-3-density-2/rules")


def test_what_a_notebook_shows_of_a_dataset_is_a_line() -> None:
    data = load_dataset(f"shipped:{PAPER_SCENARIOS[0]}/rule")
    assert repr(data) == f"<Dataset of {len(data):,} transitions of lane-3-density-2, driven by teacher>"
