import json
from pathlib import Path

import pytest

from rapid import teach_bench
from rapid.config import Config
from rapid.errors import RapidError
from rapid.evaluation.teachers import load_teacher_rows
from rapid.teach_bench import compare_teachers, read_spec

SCENARIOS = ("lane-3-density-2", "lane-4-density-2.5")


def compare(out: Path, *specs: str, **options):
    options = {"scenarios": SCENARIOS, "spawns": 2, "spawn_set": "tune", "lockstep": 2, **options}
    scenarios = options.pop("scenarios")
    return compare_teachers(Config(), specs, scenarios, out, **options)


def test_specs_name_drivers_models_styles_and_files(tmp_path):
    assert read_spec("planner").teacher is None
    assert read_spec("rule").teacher.backend == "scripted"
    model = read_spec("smollm2-135m").teacher
    assert (model.backend, model.model, model.style, model.shuffle_facts) == ("local", "smollm2-135m", "digest", False)
    assert read_spec("smollm2-135m:react").teacher.style == "react"
    for spec in ("smollm2-135m:digest:shuffled", "smollm2-135m:shuffled"):
        assert read_spec(spec).teacher.shuffle_facts
    weights = tmp_path / "a:b.gguf"
    weights.write_bytes(b"")
    assert read_spec(f"{weights}:react").teacher.model == str(weights)
    file = tmp_path / "server.toml"
    file.write_text('[teacher]\nbackend = "endpoint"\nmodel = "m"\nprice_in = 2\n')
    assert read_spec(str(file)).teacher.price_in == 2.0


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("rul", "did you mean 'rule'"),
        ("smollm2-135m:digset", "did you mean 'digest'"),
        ("smollm2-135m:react:shuffled", "digest style only"),
        ("smollm2-135m:digest:shuffled:more", "Unknown style"),
        ("./no.gguf", "There is no model"),
        ("no.toml", "Cannot read the settings file"),
        ("", "There is no teacher ''"),
    ],
)
def test_wrong_specs_are_explained_before_any_work(spec, says, tmp_path):
    with pytest.raises(RapidError, match=says):
        compare(tmp_path / "out", "rule", spec)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[collect]\n", r"no \[teacher\] section"),
        ('[teacher]\nmodle = "x"\n', "did you mean 'model'"),
        ("[teacher]\nconcurrency = 0\n", "teacher.concurrency"),
        ('[teacher]\nbackend = "replay"\nreplay_file = "nowhere"\n', "There is no recording"),
    ],
)
def test_wrong_files_are_explained_before_any_work(text, says, tmp_path):
    file = tmp_path / "teacher.toml"
    file.write_text(text)
    with pytest.raises(RapidError, match=says):
        compare(tmp_path / "out", "rule", str(file))
    assert list(tmp_path.iterdir()) == [file]


def test_other_mistakes_are_explained_before_any_work(tmp_path):
    for specs, options, says in (
        ((), {}, "Which teachers"),
        (("rule", "rule"), {}, "named twice"),
        (("rule",), {"scenarios": ("lane-3",)}, "Unknown scenario"),
        (("rule",), {"spawns": 0}, "at least 1"),
        (("rule",), {"spawns": 200_000}, "has 100000 spawn seeds"),
    ):
        with pytest.raises(RapidError, match=says):
            compare(tmp_path / "out", *specs, **options)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine.txt").write_text("dear")
    with pytest.raises(RapidError, match="holds something else"):
        compare(tmp_path, "rule")


def test_the_same_command_goes_on_and_one_more_teacher_is_driven_alone(tmp_path, monkeypatch):
    driven: list[tuple[str, str]] = []
    real = teach_bench.drive_teacher

    def counted(teacher, name, scenario, *arguments):
        if len(driven) == fail_after:
            raise KeyboardInterrupt
        driven.append((name, scenario))
        return real(teacher, name, scenario, *arguments)

    monkeypatch.setattr(teach_bench, "drive_teacher", counted)
    fail_after = 2
    with pytest.raises(KeyboardInterrupt):
        compare(tmp_path, "slower", "rule")
    fail_after = 100
    summaries = compare(tmp_path, "slower", "rule")
    assert driven == [(name, scenario) for scenario in SCENARIOS for name in ("slower", "rule")]
    assert [(of.teacher, of.scenario) for of in summaries] == driven
    driven.clear()
    assert compare(tmp_path, "slower", "rule") == summaries
    assert driven == []
    assert compare(tmp_path, "slower", "rule", "idle")[:2] == summaries[:2]
    assert driven == [("idle", scenario) for scenario in SCENARIOS]
    driven.clear()
    compare(tmp_path, "slower", spawn_set="test")
    assert driven == [("slower", scenario) for scenario in SCENARIOS]

    names = {"episodes.parquet", "summary.txt", "summary.md", "summary.json", "teachers.png", "teachers.svg"}
    assert names <= {path.name for path in tmp_path.iterdir()}
    assert not list(tmp_path.rglob("*.part"))
    rows = load_teacher_rows(tmp_path / "episodes.parquet")
    assert {row.seed for row in rows} == {900_000, 900_001}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["results"][0]["teacher"] == "slower"
    assert summary["identities"][SCENARIOS[0]]["slower"] == {"backend": "scripted", "model": "slower"}


def test_the_planner_drives_too(tmp_path):
    (first, planner) = compare(tmp_path, "slower", "planner", scenarios=SCENARIOS[:1], spawns=1)
    assert planner.teacher == "planner"
    assert planner.episode_return.value > first.episode_return.value
