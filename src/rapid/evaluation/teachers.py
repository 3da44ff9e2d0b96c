"""What is measured of a teacher's episode beyond its score: how it chose, how it drove, what it took to decide.

Every choice is judged by what the observation tells (:mod:`rapid.teacher.facts`), after the episode, so judging costs
the teacher no time.
"""

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

import rapid
from rapid.agents.open import Driver, Said, driver_for
from rapid.data.tables import read_parquet
from rapid.errors import RapidError
from rapid.evaluation.metrics import SAME_LANE, time_to_collision
from rapid.evaluation.recording import Recording
from rapid.evaluation.worlds import Perturbation, Worlds
from rapid.files import atomic_path
from rapid.road import CAR_LENGTH
from rapid.scenarios import LANE_LEFT, LANE_RIGHT, get_scenario
from rapid.simulator import Simulator
from rapid.teacher.decision import Decision
from rapid.teacher.facts import Facts, gather
from rapid.teacher.foresight import look_ahead
from rapid.teacher.scene import read_scenes
from rapid.teacher.scripted import Scripted

FLAP_WITHIN = 3
"""Decisions within which the opposite lane change makes the one before it a flap."""
CLOSE = 2.0
"""Seconds to collision below which a step is close."""
LONGEST_HEADWAY = 10.0
"""Seconds; a longer headway counts as this, or a nearly parked car would outweigh all others."""
_SCHEMA_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


@dataclass(frozen=True, slots=True)
class TeacherRow:
    """One episode of one teacher; counts rather than shares, so that episodes can be added up. NaN is unknown."""

    teacher: str
    """As it was named on the command line."""
    scenario: str
    seed: int
    """The spawn seed: which traffic."""
    episode_return: float
    length: int
    """Decisions."""
    crashed: bool
    mean_speed: float
    """Of the ego, m/s, over the states that decisions led to."""
    distance: float
    """Metres along the road."""
    min_ttc: float
    """Least time to collision, s."""
    had_safe: int
    """Decisions for which the facts called an available action safe."""
    unsafe: int
    """Of those, choices that the facts call unsafe."""
    lane_changes: int
    """Choices of a lane change that the road allowed."""
    flaps: int
    """Of those, changes that undid the one before, at most `FLAP_WITHIN` decisions later."""
    close_steps: int
    """States that decisions led to with less than `CLOSE` seconds to collision."""
    lead_steps: int
    """States that decisions led to with a car ahead on the own lane."""
    headway: float
    """Mean time headway over those, s, bumper to bumper; each at most `LONGEST_HEADWAY`."""
    unlike_foresight: int
    """Choices that differ from what the rule with the same foresight (`rule-foresight`) takes in the same scene."""
    unlike_forecast: int
    """Choices that differ from what `rule-forecast` takes in the same scene."""
    repaired: int
    """Answers that were invalid and put right on a second try."""
    fallbacks: int
    """Answers that the rule had to replace."""
    retries: int
    tokens_in: int
    tokens_out: int
    cost: float
    """In the currency of the settings."""
    decision_seconds: float
    """Wall time of the teacher for one decision, worlds stepped side by side."""
    commit: str = ""
    """Commit of the source that measured this."""


SCHEMA = pa.schema([(item.name, _SCHEMA_TYPES[item.type]) for item in fields(TeacherRow)])  # pyright: ignore[reportArgumentType]
"""Columns of the Parquet file."""


def save_teacher_rows(path: str | os.PathLike[str], rows: Iterable[TeacherRow]) -> None:
    """Write rows as Parquet, atomically; NaN becomes null, which other readers know."""
    records = [{name: getattr(row, name) for name in SCHEMA.names} for row in rows]
    for record in records:
        record |= {name: None for name, value in record.items() if isinstance(value, float) and math.isnan(value)}
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist(records, SCHEMA), temporary, compression="zstd", write_page_checksum=True)


def load_teacher_rows(path: str | os.PathLike[str]) -> list[TeacherRow]:
    """Read the rows that :func:`save_teacher_rows` wrote.

    Raises:
        RapidError: the file is missing, damaged, or lacks a column.
    """
    table = read_parquet(path, "file of teacher episodes")
    try:
        records: list[dict[str, Any]] = table.select(SCHEMA.names).cast(SCHEMA).to_pylist()
    except (KeyError, ValueError, pa.ArrowException) as error:
        raise RapidError(f"'{path}' is not a file of teacher episodes: {error}. Delete it to measure again.") from error
    for record in records:
        record |= {name: math.nan for name, value in record.items() if value is None}
    return [TeacherRow(**record) for record in records]


def drive_teacher(
    teacher: Any,
    name: str,
    scenario: str,
    seeds: Sequence[int],
    lockstep: int,
    generator_seed: int = 0,
    simulator: Simulator = "compiled",
    commit: str = "",
    progress: Callable[[float], None] | None = None,
) -> list[TeacherRow]:
    """Drive one episode for each spawn seed, `lockstep` of them side by side, and return what was measured.

    Args:
        teacher: anything that can drive (:func:`rapid.agents.open.driver_for`).
        name: what to call it in the rows.
        scenario: where.
        seeds: the spawn seeds.
        lockstep: episodes side by side.
        generator_seed: for drivers that draw.
        simulator: the compiled twin, or highway-env itself.
        commit: noted in the rows.
        progress: is called with decisions made; an episode counts as all of its time, also if it ends early.
    """
    lanes = get_scenario(scenario).lanes
    duration = int(get_scenario(scenario).config()["duration"])
    rows: list[TeacherRow] = []
    # Or a teacher that meets the scenes of the one before it would look fast.
    look_ahead.cache_clear()
    for first in range(0, len(seeds), lockstep):
        worlds = Worlds(np.asarray(seeds[first : first + lockstep], np.int64), record=True)
        env = rapid.make_vec(scenario, len(worlds.seed_B), simulator=simulator, autoreset=False)
        try:
            listener = _Listener(driver_for(teacher, env, generator_seed), len(worlds.seed_B), duration, progress)
            calm = Perturbation(None, teacher, scenario, worlds.seed_B, generator_seed)
            worlds.drive(env, listener, calm, lanes, listener.ended)
        finally:
            env.close()
        seconds = worlds.decision_seconds / max(int(worlds.length_B.sum()), 1)
        for world, recording in enumerate(worlds.recordings(name, scenario, "none")):
            rows.append(
                TeacherRow(
                    teacher=name,
                    scenario=scenario,
                    seed=int(worlds.seed_B[world]),
                    episode_return=float(worlds.return_B[world]),
                    length=int(worlds.length_B[world]),
                    crashed=bool(worlds.crashed_B[world]),
                    mean_speed=float(worlds.speed_B[world]) / max(int(worlds.length_B[world]), 1),
                    distance=float(worlds.distance_B[world]),
                    min_ttc=_known(float(worlds.ttc_B[world])),
                    **judge(recording, lanes),
                    **_add_up(listener.decisions[world]),
                    decision_seconds=seconds,
                    commit=commit,
                )
            )
    return rows


class _Listener:
    """A driver that keeps what another one said, and counts the steps of episodes."""

    def __init__(self, driver: Driver, worlds: int, duration: int, progress: Callable[[float], None] | None) -> None:
        self._driver, self._duration, self._progress = driver, duration, progress
        self.decisions: list[list[Decision]] = [[] for _ in range(worlds)]
        self._shown = self._finished = 0

    def choose(
        self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64], seed_B: NDArray[np.int64], step: int
    ) -> NDArray[np.int64]:
        chosen = self._driver.choose(seen_BVF, worlds, seed_B, step)
        for world, decision in getattr(self._driver, "previous", {}).items():
            if world in worlds:
                self.decisions[world].append(decision)
        self._show(self._finished * self._duration + len(worlds) * (step + 1))
        return chosen

    def commentary(self, seen_BVF: NDArray[np.float32], worlds: NDArray[np.int64]) -> Sequence[Said]:
        return [(None, None)] * len(worlds)

    def memory(self, worlds: NDArray[np.int64], count: int) -> NDArray[np.float32] | None:
        return self._driver.memory(worlds, count)

    def ended(self, count: float) -> None:
        """Count an episode that ended, perhaps early."""
        self._finished += int(count)
        if self._finished == len(self.decisions):
            self._show(self._finished * self._duration)

    def _show(self, done: int) -> None:
        if self._progress is not None and done > self._shown:
            self._progress(done - self._shown)
            self._shown = done


def judge(recording: Recording, lanes: int) -> dict[str, Any]:
    """Return the fields of a row that follow from the observations and the actions of an episode."""
    before_TVF, after_TVF, actions = recording.obs_TVF[:-1], recording.obs_TVF[1:], recording.action_T.tolist()
    all_facts = [gather(scene) for scene in read_scenes(before_TVF, lanes)]

    def unlike(rule: str) -> int:
        decisions = Scripted(rule, lanes, 0).decide(before_TVF, [None] * len(actions))
        return sum(decision.action != action for decision, action in zip(decisions, actions, strict=True))

    had_safe = [any(map(facts.survives, facts.available)) for facts in all_facts]
    headways = time_headway(after_TVF)
    seen = headways[~np.isnan(headways)]
    changes = _lane_changes(all_facts, actions)
    return {
        "had_safe": sum(had_safe),
        "unsafe": sum(
            had and not facts.survives(action) for had, facts, action in zip(had_safe, all_facts, actions, strict=True)
        ),
        "lane_changes": len(changes),
        "flaps": count_flaps(changes),
        "close_steps": int((time_to_collision(after_TVF) < CLOSE).sum()),
        "lead_steps": len(seen),
        "headway": float(seen.mean()) if len(seen) else math.nan,
        "unlike_foresight": unlike("rule-foresight"),
        "unlike_forecast": unlike("rule-forecast"),
    }


def _lane_changes(all_facts: Sequence[Facts], actions: Sequence[int]) -> list[tuple[int, int]]:
    """Return (step, action) of each lane change that the road allowed."""
    return [
        (step, action)
        for step, (facts, action) in enumerate(zip(all_facts, actions, strict=True))
        if action in (LANE_LEFT, LANE_RIGHT) and action in facts.available
    ]


def count_flaps(changes: Sequence[tuple[int, int]]) -> int:
    """Return how many lane changes, given as (step, action), undo the one before within `FLAP_WITHIN` decisions."""
    return sum(
        action != earlier and step - before <= FLAP_WITHIN for (before, earlier), (step, action) in pairwise(changes)
    )


def time_headway(obs_BVF: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return each world's time headway in seconds, at most `LONGEST_HEADWAY`; NaN where nobody leads on the own lane.

    It is the gap to the leading car, bumper to bumper, over the ego's speed.
    """
    obs = np.asarray(obs_BVF, np.float64)
    ego, others = obs[:, 0], obs[:, 1:]
    ahead = others[..., 1] - ego[:, None, 1]
    leads = (others[..., 0] > 0.5) & (np.abs(others[..., 2] - ego[:, None, 2]) <= SAME_LANE) & (ahead > 0)
    distance = np.where(leads, ahead, np.inf).min(1, initial=np.inf)
    gap = np.maximum(distance - CAR_LENGTH, 0.0)
    headway = np.minimum(gap / np.maximum(ego[:, 3], 1e-6), LONGEST_HEADWAY)
    return np.where(np.isfinite(distance), headway, np.nan)


def _add_up(decisions: Sequence[Decision]) -> dict[str, Any]:
    """Return the fields of a row that the decisions of an episode add up to."""
    return {
        "repaired": sum(decision.status == "repaired" for decision in decisions),
        "fallbacks": sum(decision.status == "fallback" for decision in decisions),
        "retries": sum(decision.retries for decision in decisions),
        "tokens_in": sum(decision.tokens_in for decision in decisions),
        "tokens_out": sum(decision.tokens_out for decision in decisions),
        "cost": float(sum(decision.cost for decision in decisions)),
    }


def _known(value: float) -> float:
    return value if math.isfinite(value) else math.nan
