"""Where verbs put what they make: nothing of anybody else's is replaced, and what differs is said."""

import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from rapid.cli import main
from rapid.errors import RapidError
from rapid.locks import exclusive
from rapid.outputs import ClashError, claimed, clear, place_for

REQUEST = {"verb": "mix", "mix": {"p": 0.5, "size": 100}, "reads": {"dataset": "abc"}}
OTHER = {**REQUEST, "mix": {"p": 0.25, "size": 100}}


def make(place: Path, request: dict, force: bool = False, **options: Any) -> None:
    with claimed(place, request, ("made*",), force=force, **options):
        (place / "made.txt").write_text(str(request))


def contents(place: Path) -> dict[str, bytes]:
    return {str(path.relative_to(place)): path.read_bytes() for path in place.rglob("*") if path.is_file()}


def test_the_same_request_goes_on_and_another_is_told_what_differs(tmp_path: Path):
    place = tmp_path / "a" / "out"
    make(place, REQUEST)
    before = contents(place)
    make(place, REQUEST)
    assert contents(place) == before
    with pytest.raises(ClashError, match=r"mix\.p: 0\.5 there, 0\.25 now\)\. Nothing was changed"):
        make(place, OTHER)
    assert contents(place) == before
    make(place, OTHER, force=True)
    assert contents(place)["made.txt"] != before["made.txt"]
    make(place, OTHER)


@pytest.mark.parametrize("force", [False, True])
def test_what_somebody_else_put_there_stays(tmp_path: Path, force: bool):
    (tmp_path / "thesis.txt").write_text("mine")
    (tmp_path / "made.txt").write_text("mine, too")
    before = contents(tmp_path)
    with pytest.raises(ClashError, match=r"thesis\.txt"):
        make(tmp_path, REQUEST, force)
    assert contents(tmp_path) == before


def test_what_is_read_is_not_removed(tmp_path: Path):
    make(tmp_path, REQUEST)
    with pytest.raises(ClashError, match="is read by this command"):
        make(tmp_path, OTHER, True, keep=[tmp_path / "made.txt"])
    assert (tmp_path / "made.txt").exists()


def test_force_removes_links_not_what_they_lead_to(tmp_path: Path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "x").write_text("mine")
    make(tmp_path / "out", REQUEST)
    (tmp_path / "out" / "made-link").symlink_to(tmp_path / "precious")
    clear(tmp_path / "out", ("made*",))
    assert not list((tmp_path / "out").iterdir())
    assert (tmp_path / "precious" / "x").read_text() == "mine"


def test_a_request_that_came_to_nothing_leaves_nothing(tmp_path: Path):
    with pytest.raises(RapidError, match="refused"), claimed(tmp_path / "out", REQUEST, ()):
        raise RapidError("refused")
    assert not list(tmp_path.iterdir())


def test_a_damaged_record_blocks_only_without_force(tmp_path: Path):
    make(tmp_path, REQUEST)
    (tmp_path / "request.json").write_bytes(bytes(100))
    with pytest.raises(ClashError, match=r"damaged request\.json"):
        make(tmp_path, REQUEST)
    make(tmp_path, REQUEST, force=True)


def test_without_a_place_the_second_request_goes_beside_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    second = Path()
    for _ in range(2):
        first, second = place_for("out", REQUEST), place_for("out", OTHER)
        if first == Path("out"):
            make(first, REQUEST)
        second = place_for("out", OTHER)
        make(second, OTHER)
        assert first == Path("out")
        assert str(second).startswith("out-")
    # It stays there, also once the usual place is free.
    for path in Path("out").iterdir():
        path.unlink()
    assert place_for("out", OTHER) == second


MIX = ("mix", "shipped:lane-3-density-2/rule", "shipped:lane-3-density-2/random", "--size", "100")
DISTILL = ("distill", "shipped:lane-3-density-2/rule", "--iterations", "2", "--evaluate-every", "0", "--network.kind")
COLLECT = ("collect", "--teacher.backend", "scripted", "--teacher.model", "slower", "--teacher-transitions", "30")
EVALUATE = ("evaluate", "slower", "--spawns", "1", "--attacks", "none", "--seed")


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        main(words)
    return int(str(stop.value.code))


@pytest.mark.parametrize(
    ("first", "second", "differs"),
    [
        ((*MIX, "--p", "0.5"), (*MIX, "--p", "0.25"), "mix.p: 0.5 there, 0.25 now"),
        ((*DISTILL, "mlp"), (*DISTILL, "mlp", "--seed", "1"), "seed: 0 there, 1 now"),
        (COLLECT, (*COLLECT[:4], "idle", *COLLECT[5:]), "driver.name: 'slower' there, 'idle' now"),
        ((*EVALUATE, "0"), (*EVALUATE, "1"), "seed: 0 there, 1 now"),
    ],
)
def test_every_verb_leaves_what_another_made_and_says_what_differs(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    first: tuple[str, ...],
    second: tuple[str, ...],
    differs: str,
):
    monkeypatch.chdir(tmp_path)
    assert run(*first, "--out", "out") == 0
    before = contents(tmp_path)
    assert run(*second, "--out", "out") == 2
    said = capsys.readouterr().err
    assert differs in said
    assert "--force" in said
    assert contents(tmp_path) == before
    with exclusive(tmp_path / "out"), ThreadPoolExecutor() as pool:  # a lock is a thread's
        assert pool.submit(run, *first, "--out", "out").result() == 2
    assert "Another process is at work" in capsys.readouterr().err
    assert contents(tmp_path) == before
    assert run(*second, "--out", "out", "--force") == 0
    assert contents(tmp_path) != before


def test_collect_without_a_place_goes_beside_what_was_collected_with_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    driver = COLLECT.index("slower")
    assert run(*COLLECT) == 0
    first = contents(tmp_path)
    assert run(*COLLECT[:driver], "random", *COLLECT[driver + 1 :], "--random-transitions", "30") == 0
    assert {path.name for path in Path("data").iterdir()} == {"teacher", "random"}
    for _ in range(2):  # the same command goes on at the same place
        assert run(*COLLECT[:driver], "idle", *COLLECT[driver + 1 :]) == 0
        (beside,) = {path.name for path in Path("data").iterdir()} - {"teacher", "random"}
        assert beside.startswith("teacher-")
        assert f"30 transitions in data/{beside}" in capsys.readouterr().out
    other = Path("data") / beside
    assert not list(Path("data").glob("*/collecting")), "nothing is left in what is another's"
    # It stays there, also with workers and once the usual place is free.
    assert run(*COLLECT[:driver], "idle", *COLLECT[driver + 1 :], "--workers", "2") == 2
    assert f"The collection in '{other}' was begun in one part" in capsys.readouterr().err
    Path("data/teacher").rename("away")
    assert run(*COLLECT[:driver], "idle", *COLLECT[driver + 1 :]) == 0
    assert f"30 transitions in {other}" in capsys.readouterr().out
    Path("away").rename("data/teacher")
    assert run(*COLLECT[:driver], "faster", *COLLECT[driver + 1 :], "--workers", "2") == 0
    said = capsys.readouterr()
    assert "'data/teacher' is of another request (driver.name: 'slower' there, 'faster' now" in said.err
    assert len(list(Path("data").iterdir())) == 4
    # A place that is named is the user's choice: nothing goes elsewhere.
    assert run(*COLLECT[:driver], "faster", *COLLECT[driver + 1 :], "--out", "data/teacher") == 2
    assert len(list(Path("data").iterdir())) == 4
    assert {name: held for name, held in contents(tmp_path).items() if name.startswith("data/teacher/")} == first


def test_a_file_of_the_users_is_not_collected_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "transitions.parquet").write_text("mine")
    for _ in range(2):
        assert run(*COLLECT, "--out", "out") == 2
        assert "nothing says that it was collected there" in capsys.readouterr().err
        assert contents(tmp_path) == {"out/transitions.parquet": b"mine"}


def test_evaluate_without_agents_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert run("evaluate") == 2
    assert not list(tmp_path.iterdir())


def test_evaluate_without_a_place_prints_its_table_and_keeps_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    for seed in "01":
        assert run(*EVALUATE, seed) == 0
        said = capsys.readouterr().out
        assert "slower" in said
        assert "Nothing was kept; --out DIRECTORY keeps" in said
        assert not list(tmp_path.iterdir())


def test_an_exported_file_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    assert run(*DISTILL, "mlp", "--out", "out") == 0
    (tmp_path / "a.onnx").write_text("mine")
    words = ("export", "out/agent", "--dataset", "shipped:lane-3-density-2/rule", "--out", "a.onnx")
    assert run(*words) == 2
    assert (tmp_path / "a.onnx").read_text() == "mine"
    assert run(*words, "--force") == 0
    assert (tmp_path / "a.onnx").stat().st_size > 1000
