"""A teacher that repeats recorded answers, found by the hash of the prompt: no model, no key, the same decisions."""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.config import TeacherConfig
from rapid.errors import RapidError, sentence
from rapid.files import read_json, sha256
from rapid.teacher.briefing import briefing
from rapid.teacher.decision import Decision, from_record
from rapid.teacher.experience import MEMORY_FILE, read_experiences
from rapid.teacher.facts import Facts, gather, safest
from rapid.teacher.memory import Memory, identify, show
from rapid.teacher.prompt import digest
from rapid.teacher.scene import read_scenes

_FIELDS = (
    *("action", "explanation", "answer", "told", "computed", "turns", "transcript"),
    *("prompt_hash", "status", "served", "error", "retries"),
)
"""What is repeated of a row of a Parquet log; tokens and cost were paid once."""


class Replay:
    """Repeats the decisions of a recording.

    Args:
        config: `replay_file` is a JSON-lines file of decisions, a teacher log in Parquet, or a dataset's directory.
        lanes: lanes of the road.
        memory: what the recorded model was reminded of, `config.few_shot` at a time; not needed for a dataset, which
            holds it.

    Raises:
        RapidError: there is no such recording, or it cannot be read, or holds no prompt's hash.
    """

    def __init__(self, config: TeacherConfig, lanes: int, memory: Memory | None = None) -> None:
        path = Path(config.replay_file).expanduser()
        if path.is_dir():
            path /= "teacher_log.parquet"
        if not config.replay_file or not path.is_file():
            raise RapidError(
                f"There is no recording at '{config.replay_file}'. Give --teacher.replay-file the path of a dataset's "
                "directory, of its teacher_log.parquet, or of a JSON-lines file of decisions."
            )
        self.name = f"replay of {path.parent.name if path.suffix == '.parquet' else path.name}"
        self._lanes, self._digest = lanes, sha256(path)
        self._memory, self._few_shot = memory or Memory(), config.few_shot
        if not self._few_shot:
            self._memory, self._few_shot = _recorded_memory(path.parent)
        self._decisions: dict[str, Decision] = {}
        for decision in _read_parquet(path) if path.suffix == ".parquet" else _read_lines(path):
            if decision.prompt_hash:
                self._decisions.setdefault(decision.prompt_hash, decision)
        if not self._decisions:
            raise RapidError(f"The recording '{path}' holds no decision of a model: none has a prompt's hash.")

    def describe(self) -> dict[str, Any]:
        """Return the teacher's identity."""
        identity: dict[str, Any] = {"backend": "replay", "model": self.name, "recording_sha256": self._digest}
        return identity | identify(self._memory, self._few_shot)

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`.

        A scene that was not recorded gets the rule's safest action, counted as a fallback.
        """
        all_facts = [gather(scene) for scene in read_scenes(obs_BVF, self._lanes)]
        return [self._find(facts, last) for facts, last in zip(all_facts, previous, strict=True)]

    def _find(self, facts: Facts, previous: Decision | None) -> Decision:
        start = time.perf_counter()
        # One recording may hold several kinds of prompt; the first that is known answers.
        prompts = [digest(facts)]
        examples = [show(experience) for experience in self._memory.recall(facts.scene, self._few_shot)]
        prompts += [
            briefing(facts, previous, style, native, examples)
            for style in ("digest", "react")
            for native in (True, False)
        ]
        found = next((self._decisions[p.hash] for p in prompts if p.hash in self._decisions), None)
        seconds = time.perf_counter() - start
        if found is None:
            missing = "no recorded answer to this prompt"
            return Decision(
                safest(facts), prompt_hash=prompts[0].hash, status="fallback", error=missing, seconds=seconds
            )
        return replace(found, seconds=seconds, tokens_in=0, tokens_out=0, cost=0.0)


def _recorded_memory(dataset: Path) -> tuple[Memory, int]:
    """Return what the driver of a dataset was reminded of, and how many situations at a time."""
    if not (dataset / MEMORY_FILE).is_file() or not (dataset / "dataset.json").is_file():
        return Memory(), 0
    try:
        told = read_json(dataset / "dataset.json", "dataset")["drivers"]["teacher"].get("memory")
        # What the collection itself taught stands behind it.
        memory = Memory(read_experiences(dataset / MEMORY_FILE)[: told["experiences"]] if told else ())
        return memory, told["few_shot"] if told else 0
    except (KeyError, TypeError, AttributeError) as error:
        raise RapidError(f"'{dataset / 'dataset.json'}' lacks {error}. It was edited or damaged.") from error


def _read_lines(path: Path) -> Iterator[Decision]:
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise RapidError(f"Line {number} of the recording '{path}' is not JSON: {error}.") from error
        if not isinstance(record, dict):
            raise RapidError(f"Line {number} of the recording '{path}' is not a JSON object.")
        yield _decision(record, f"Line {number} of the recording '{path}'")


def _decision(record: dict[str, Any], where: str) -> Decision:
    """Return a recorded decision.

    Raises:
        RapidError: it is none; the message says where.
    """
    try:
        return from_record(record)
    except (RapidError, TypeError, ValueError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise RapidError(f"{where} is no decision: {sentence(str(error))} Record it again.") from error


def _read_parquet(path: Path) -> Iterator[Decision]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
        soft: dict[tuple[int, int], Any] = {}
        steps = path.with_name("transitions.parquet")
        if steps.is_file():
            columns = pq.read_table(steps, columns=["episode", "step", "probabilities"]).to_pydict()
            soft = dict(
                zip(zip(columns["episode"], columns["step"], strict=True), columns["probabilities"], strict=True)
            )
    except (pa.ArrowException, OSError) as error:
        raise RapidError(f"The recording '{path}' cannot be read: {error}. Give a teacher's log in Parquet.") from error
    if missing := {"action", "prompt_hash"} - set(table.column_names):
        raise RapidError(f"The recording '{path}' is no teacher's log: it has no column {', '.join(sorted(missing))}.")
    for row in table.to_pylist():
        if row["prompt_hash"]:
            record = {name: row[name] for name in _FIELDS if row.get(name) is not None}
            soft_A = soft.get((row.get("episode"), row.get("step")))
            yield _decision({**record, "probabilities": soft_A}, f"A row of the recording '{path}'")
