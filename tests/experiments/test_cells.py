import dataclasses
from dataclasses import replace

import pytest

from rapid.config import AdaptConfig, DistillConfig, MixConfig, NetworkConfig, TeacherConfig
from rapid.experiments import cells
from rapid.experiments.cells import Adapt, Collect, Distill, Drive, Driver, Mix, Shipped, inputs, key, title
from rapid.experiments.exhibits import ALL, cells_of

TEACHER, RANDOM = Shipped("lane-3-density-2", "teacher"), Shipped("lane-3-density-2", "random")
MIX = Mix(TEACHER, RANDOM, MixConfig(), 0)
AGENT = Distill(MIX, NetworkConfig(), DistillConfig(), 0)
DRIVE = Drive(AGENT, "lane-3-density-2", "none", 200)
SLOWER_KEY = "90d4a23872649a6891c3d6e4"


def test_the_same_content_has_the_same_key_and_any_change_another():
    assert key(DRIVE) == key(Drive(replace(AGENT), "lane-3-density-2", "none", 200))
    changed = [
        replace(DRIVE, attack="pgd"),
        replace(DRIVE, spawns=100),
        replace(DRIVE, agent=replace(AGENT, seed=1)),
        replace(DRIVE, agent=replace(AGENT, network=NetworkConfig(width=64))),
        replace(DRIVE, agent=replace(AGENT, data=replace(MIX, settings=MixConfig(p=0.25)))),
        replace(DRIVE, agent=Driver("slower")),
    ]
    assert len({key(cell) for cell in [DRIVE, *changed]}) == len(changed) + 1


def test_a_setting_that_is_added_changes_no_key():
    @dataclasses.dataclass(frozen=True)
    class MixConfigOfTomorrow(MixConfig):
        another: float = 0.5

    MixConfigOfTomorrow.__name__ = "MixConfig"
    tomorrow = replace(MIX, settings=MixConfigOfTomorrow())
    assert key(tomorrow) == key(MIX)
    assert key(replace(MIX, settings=MixConfigOfTomorrow(another=0.6))) != key(MIX)


def test_a_default_that_moved_is_told_to_the_keys(monkeypatch: pytest.MonkeyPatch):
    # Were p's default introduced as 0.25, a mixture of 0.5 would have to say so in its key, and one of 0.25 would not.
    monkeypatch.setitem(cells.INTRODUCED, "MixConfig.p", 0.25)
    assert "p" in cells.describe(MIX)["settings"]
    assert "p" not in cells.describe(replace(MIX, settings=MixConfig(p=0.25)))["settings"]


def test_keys_do_not_move_by_accident():
    # What is committed lies under these names. If this fails, raise EPOCH or fill INTRODUCED, and say so in the log.
    assert key(Drive(Driver("slower"), "lane-3-density-2", "none", 200)) == SLOWER_KEY


def test_an_epoch_that_is_raised_makes_anew(monkeypatch: pytest.MonkeyPatch):
    before = key(DRIVE)
    monkeypatch.setitem(cells.EPOCH, "distill", 2)
    assert key(replace(DRIVE, agent=replace(AGENT))) != before  # in another process: there no key was made before


def test_a_key_is_made_once_a_cell_and_a_changed_cell_has_its_own(monkeypatch: pytest.MonkeyPatch):
    made, describe = [], cells.describe
    monkeypatch.setattr(cells, "describe", lambda cell: (made.append(cell), describe(cell))[1])
    agent = replace(AGENT, data=replace(MIX))
    drives = [Drive(agent, "lane-3-density-2", name, 200) for name in ("none", "pgd")]
    assert [key(drive) for drive in drives] == [key(drive) for drive in drives]
    assert sorted(map(cells.kind_of, made)) == ["distill", "drive", "drive", "mix"]
    assert key(replace(drives[0], attack="pgd")) == key(drives[1])
    assert drives[0] == replace(drives[0])


def test_inputs_are_what_must_be_there_first():
    adapted = Adapt(AGENT, MIX, "lane-3-density-2", AdaptConfig(), 0)
    assert inputs(adapted) == (AGENT, MIX)
    assert inputs(Drive(adapted, "lane-3-density-2", "none", 1)) == (adapted,)
    assert inputs(MIX) == ()  # shipped data needs no work
    assert inputs(replace(MIX, teacher=Collect("lane-3-density-2", TeacherConfig(), 5))) != ()


@pytest.mark.parametrize("name", ALL)
def test_every_exhibit_says_what_it_needs_at_every_scale(name: str):
    exhibit = ALL[name]
    for recipe in exhibit.recipes:
        counts = [len(cells_of(exhibit, recipe, scale)) for scale in ("tiny", "quick", "full")]
        assert counts == sorted(counts)
        for cell in cells_of(exhibit, recipe, "tiny"):
            assert title(cell)
    assert exhibit.caption.endswith((".", "in"))


def test_everything_that_the_paper_shows_and_that_is_ours_has_an_id():
    paper = {
        "teacher-attack",
        "ratio",
        "offline",
        "online",
        "attack",
        "routing",
        "architecture",
        "j-robust",
        "beta",
        "mixing-actions",
        "prompt",
        "efficiency",
        "environment",
        "hyperparameters",
    }
    assert set(ALL) == paper | {"floors", "teachers", "scores", "progress", "ablations", "differences", "robustness"}
    for name in paper:
        assert cells_of(ALL[name], "paper", "full") is not None
        assert cells_of(ALL[name], "strong", "full") is not None
