"""The two prompt styles of a language model in this process, on the same spawns: `react` against `digest`.

The model that converses drives first; its decisions are collected as by `rapid collect`, so that an interrupted call
goes on where it was. The others then drive the same spawns. What the conversations took is read from their record. The
work directory keeps the collection and every other driver's rows. Writes `react.md` and `react.parquet` (raw rows).

    python benchmarks/react_against_digest.py --episodes 20 --out results
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rapid.config import TeacherConfig
from rapid.data.collection import collect
from rapid.data.dataset import DATASET_FILE, Dataset, load_dataset
from rapid.data.driving import Tally
from rapid.evaluation.summary import NOT_RUN, number
from rapid.evaluation.teacher_summary import summarize_teachers, teachers_markdown
from rapid.evaluation.teachers import TeacherRow, drive_teacher, load_teacher_rows, save_teacher_rows
from rapid.files import write_text
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.spawns import train_part
from rapid.teacher import make_teacher
from rapid.teacher.decision import Decision, from_record
from simulator import processor

SMALL = "smollm2-135m"


class Recorded:
    """A teacher that repeats the decisions of a collection, found by what was seen, with all that they took."""

    name = "recorded"

    def __init__(self, data: Dataset) -> None:
        assert data.log is not None
        names = {field.name for field in fields(Decision)} & set(data.log.column_names)
        said = [from_record(record) for record in data.log.select(sorted(names)).to_pylist()]
        self.decisions = dict(zip(map(np.ndarray.tobytes, data.transitions.obs_NVF), said, strict=True))

    def describe(self) -> dict[str, Any]:
        """Return what identifies the teacher."""
        return {"backend": self.name}

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`."""
        return [self.decisions[obs_VF.tobytes()] for obs_VF in np.asarray(obs_BVF, np.float32)]


def collected(config: TeacherConfig, chosen: argparse.Namespace) -> Dataset:
    """Return the episodes of the model that converses, driving those that are missing."""
    home: Path = chosen.work / f"{chosen.scenario}-{config.model}-react"
    seeds = train_part("teacher")[: chosen.episodes]
    if (home / DATASET_FILE).exists():
        data = load_dataset(home)
        if spawns(data) == list(seeds):
            return data
    duration = int(get_scenario(chosen.scenario).config()["duration"])
    with task("react", len(seeds) * duration, "decisions") as progress:

        def watch(tally: Tally) -> None:
            progress.note(f"{tally.rate:.3g} decisions/s, {tally.fallbacks} fallbacks")

        teacher = make_teacher(config, get_scenario(chosen.scenario).lanes)
        return collect(
            teacher,
            chosen.scenario,
            home,
            None,
            chosen.lockstep,
            seeds=seeds,
            progress=progress,
            watch=watch,
        )


def spawns(data: Dataset) -> list[int]:
    """Return the spawn seed of each episode."""
    return list(dict.fromkeys(data.transitions.spawn_seed_N.tolist()))


def spoken(data: Dataset) -> tuple[float, float]:
    """Return the turns of the model and its tool calls, a decision."""
    assert data.log is not None
    talks = [json.loads(text) for text in data.log.column("turns").to_pylist()]
    turns = sum(message["role"] == "assistant" for talk in talks for message in talk)
    calls = sum(message["content"].startswith("RESULT ") for talk in talks for message in talk)
    return turns / len(talks), calls / len(talks)


def driven(name: str, config: TeacherConfig, seeds: list[int], chosen: argparse.Namespace) -> list[TeacherRow]:
    """Return the rows of another driver on the same spawns, driving it if they are missing."""
    path = chosen.work / f"{chosen.scenario}-{name.replace(' ', '-')}-{len(seeds)}.parquet"
    if not path.exists():
        duration = int(get_scenario(chosen.scenario).config()["duration"])
        with task(name, duration * len(seeds), "decisions") as progress:
            teacher = make_teacher(config, get_scenario(chosen.scenario).lanes)
            rows = drive_teacher(
                teacher, name, chosen.scenario, seeds, chosen.lockstep, commit=commit(), progress=progress.advance
            )
        save_teacher_rows(path, rows)
    return load_teacher_rows(path)


def report(rows: list[TeacherRow], data: Dataset, chosen: argparse.Namespace) -> str:
    """Return the tables as Markdown; `data` holds the conversations."""
    talk = spoken(data)
    arithmetic = data.drivers["teacher"].get("arithmetic", "8 bits where the processor is fast at that")
    names = list(dict.fromkeys(row.teacher for row in rows))
    lines = [
        "# `react` against `digest`",
        "",
        f"{chosen.scenario}, {sum(row.teacher == names[0] for row in rows)} spawns of the set `train`, episodes in "
        f"lockstep. {processor()}, {os.cpu_count()} cores, one thread{', *busy*' if chosen.busy else ''}. The model "
        f"that converses calculated in {arithmetic}; those that score calculate in float32 and remember the scores of "
        "prompts that they have seen.",
        "",
        f"Made with: {' '.join(['python', 'benchmarks/react_against_digest.py', *sys.argv[1:]])}, commit "
        f"{commit() or 'unknown'}.",
        "",
        teachers_markdown(summarize_teachers(rows)).rstrip(),
        "",
        "## What a decision takes",
        "",
        "| teacher | turns | tool calls | tokens read | tokens written | seconds | written/s |",
        "|---" * 7 + "|",
    ]
    for name in names:
        here = [row for row in rows if row.teacher == name]
        decisions, read, written = (
            sum(getattr(row, of) for row in here) for of in ("length", "tokens_in", "tokens_out")
        )
        seconds = sum(row.decision_seconds * row.length for row in here)
        turns, calls = talk if name == chosen.react_name else (float(written > 0), 0.0)
        cells = [name, number(turns, 2), number(calls, 2), number(read / decisions, 0), number(written / decisions, 1)]
        cells += [f"{seconds / decisions:.3g}", number(written / seconds, 1) if read else NOT_RUN]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(
        [
            *lines,
            "",
            "Tokens read count every turn's whole conversation, as a server bills it; here what was read in an earlier "
            "turn, and the constant part, is kept and not computed again. Seconds: the "
            "wall time of a step over the worlds that were decided in it.",
            "",
        ]
    )


def main() -> None:
    """Drive what is missing and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--scenario", default="lane-3-density-2")
    parser.add_argument("--model", default="qwen2.5-coder-1.5b")
    parser.add_argument("--episodes", type=int, default=20, help="spawns, the same for each driver")
    parser.add_argument("--lockstep", type=int, default=20, help="episodes side by side")
    parser.add_argument("--answer-tokens", type=int, default=60, help="tokens that one answer may have")
    parser.add_argument("--turns", type=int, default=3, help="tool calls before the model must decide")
    parser.add_argument("--busy", action="store_true", help="say that the machine had other work")
    parser.add_argument("--work", type=Path, default=Path("runs/react"), help="where episodes are kept")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where the results go")
    chosen = parser.parse_args()
    chosen.react_name = f"{chosen.model}:react"
    torch.set_num_threads(1)
    config = TeacherConfig(
        model=chosen.model, style="react", max_answer_tokens=chosen.answer_tokens, max_turns=chosen.turns
    )
    data = collected(config, chosen)
    seeds = spawns(data)
    others = {
        f"{chosen.model}:digest": TeacherConfig(model=chosen.model),
        f"{SMALL}:digest": TeacherConfig(model=SMALL),
        "slower": TeacherConfig(backend="scripted", model="slower"),
    }
    rows = [row for name, config in others.items() for row in driven(name, config, seeds, chosen)]
    assert data.log is not None
    seconds = float(np.mean(data.log.column("seconds").to_numpy()))
    react = drive_teacher(Recorded(data), chosen.react_name, chosen.scenario, seeds, chosen.lockstep, commit=commit())
    react = [replace(row, decision_seconds=seconds) for row in react]
    # The first is the one that the others are compared with.
    first = [row for row in rows if row.teacher == f"{chosen.model}:digest"]
    rows = [*first, *react, *rows[len(first) :]]
    save_teacher_rows(chosen.out / "react.parquet", rows)
    text = report(rows, data, chosen)
    write_text(chosen.out / "react.md", text)
    print(text)


if __name__ == "__main__":
    main()
