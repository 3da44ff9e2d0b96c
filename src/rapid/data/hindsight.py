"""What a teacher learns from the episodes of a collection, on disk as soon as it is known: nothing is asked twice."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from rapid.data.tables import from_table
from rapid.errors import RapidError
from rapid.files import AppendedFile, truncate
from rapid.teacher.decision import Decision, Teacher
from rapid.teacher.experience import Experience, read_experience, to_lines
from rapid.teacher.memory import Episode, Reflective


class Hindsight:
    """The experiences of a collection in progress, one for each episode that was looked back on.

    A last line that was cut off is dropped. A teacher that does not reflect leaves no file.

    Raises:
        RapidError: another line cannot be read.
    """

    def __init__(self, path: Path, teacher: Teacher) -> None:
        self._path = path
        self._teacher = teacher if isinstance(teacher, Reflective) else None
        content = path.read_bytes() if path.exists() else b""
        good = content[: content.rfind(b"\n") + 1]
        if len(good) < len(content):
            truncate(path, len(good))
        try:
            lines = good.decode().split("\n")[:-1]
        except UnicodeDecodeError as error:
            raise RapidError(
                f"'{path}' cannot be read: {error}. The file is damaged; delete it to look back on all episodes anew."
            ) from error
        self.experiences = [read_experience(line, f"line {number} of '{path}'") for number, line in enumerate(lines, 1)]

    @property
    def memory(self) -> tuple[Experience, ...] | None:
        """What the teacher knew and has learned; None if it has no memory."""
        if self._teacher is None or not (self._teacher.reflects or len(self._teacher.memory)):
            return None
        return (*self._teacher.memory.experiences, *self.experiences)

    def pending(self, part: pa.Table) -> list[Episode]:
        """Return the episodes of a part of a collection that are still to be looked back on."""
        if self._teacher is None or not self._teacher.reflects:
            return []
        done = {experience.spawn_seed for experience in self.experiences}
        rows = from_table(part)
        said = zip(*(part.column(name).to_pylist() for name in ("action", "explanation", "status")), strict=True)
        decisions = [Decision(action, explanation, status=status) for action, explanation, status in said]
        firsts = np.flatnonzero(rows.step_N == 0).tolist()
        return [
            Episode(
                rows.obs_NVF[first:end],
                decisions[first:end],
                bool(rows.terminated_N[end - 1]),
                int(rows.spawn_seed_N[first]),
            )
            for first, end in zip(firsts, [*firsts[1:], len(rows)], strict=True)
            if int(rows.spawn_seed_N[first]) not in done
        ]

    def look_back(self, episodes: list[Episode]) -> Iterator[Experience]:
        """Let the teacher look back, and give each experience once it is on the disk."""
        if self._teacher is None or not episodes:
            return
        with AppendedFile(self._path) as stream:
            for experience in self._teacher.look_back(episodes):
                # As in the journal: sync what took long to get.
                stream.append(to_lines([experience]).encode(), sync=experience.tokens_in > 0)
                self.experiences.append(experience)
                yield experience
