"""Comparing agents: each is opened once."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rapid.config import TeacherConfig
from rapid.phases import measure
from rapid.presets import preset
from rapid.teacher.decision import Teacher


def test_a_teacher_is_opened_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A language model takes long to load."""
    made: list[TeacherConfig] = []
    make = measure.make_teacher

    def counted(config: TeacherConfig, *road: Any) -> Teacher:
        made.append(config)
        return make(config, *road)

    monkeypatch.setattr(measure, "make_teacher", counted)
    config = preset("strong", "tiny")
    few = replace(config.evaluate, spawns=1, teacher_spawns=1, attacks=("none",))
    config = replace(config, teacher=TeacherConfig(backend="scripted", model="rule"), evaluate=few)
    rows = measure.compare(config, ["teacher", "slower"], tmp_path / "out")
    assert len(rows) == 2
    assert len(made) == 1
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "2 drivers on lane-3-density-2" in page
    assert "No training was recorded" not in page
    # And again, where nothing is driven.
    assert measure.compare(config, ["teacher", "slower"], tmp_path / "out") == rows
    assert len(made) == 2
