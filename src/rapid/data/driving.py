"""Driving groups of episodes side by side: every decision goes to the journal before it acts."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from rapid.data.budget import Budget, SpentError, Tally
from rapid.data.dataset import Dataset
from rapid.data.fallbacks import TooManyFallbacksError, check_share, is_fallback
from rapid.data.hindsight import Hindsight
from rapid.data.journal import Journal
from rapid.data.parts import Parts
from rapid.data.spending import Spending, cost_of
from rapid.data.tables import LOG_SCHEMA, PART_SCHEMA, TRANSITION_SCHEMA, from_table, to_table
from rapid.data.transitions import SOURCES, Transitions
from rapid.data.unwritten import Cost
from rapid.errors import RapidError
from rapid.progress import Task
from rapid.scenarios import IDLE, NUM_ACTIONS, get_scenario
from rapid.seeding import stream_seed
from rapid.teacher.decision import (
    Decision,
    InterruptedDecisions,
    RefusedError,
    Teacher,
    Timed,
    UnfinishedError,
    UnreachableError,
)
from rapid.teacher.experience import MEMORY_FILE
from rapid.teacher.patience import StoppedError

MakeWorlds = Callable[[int], Any]
"""Gives a vector environment of so many worlds, in which a finished world waits for the others."""
JOURNAL_FILE = "journal.jsonl"


class Collecting:
    """One process's share of a collection: the finished parts and what they add up to."""

    def __init__(
        self,
        teacher: Teacher,
        settings: dict[str, Any],
        seeds: Sequence[int],
        work: Path,
        budget: Budget,
        progress: Task | None,
        watch: Callable[[Tally], None] | None = None,
    ) -> None:
        self.teacher, self.settings, self.work, self.budget, self.progress = teacher, settings, work, budget, progress
        self.watch, self.seeds = watch, seeds
        self.source = SOURCES.index(settings["source"])
        self.parts = Parts(work, seeds)
        self.count = sum(part.num_rows for part in self.parts.present)
        self.fresh, self.decisions = 0, self.count
        self.spending = Spending(work, teacher)
        tokens = int(sum(self._sum(name) for name in ("tokens_in", "tokens_out")))
        self.spending.add(Cost(self.count, tokens, self._sum("cost")))
        self.fallbacks = sum(part.column("status").to_pylist().count("fallback") for part in self.parts.present)
        self.last_fallback: Decision | None = None
        self.hindsight, self.looked_back = Hindsight(work / MEMORY_FILE, teacher), 0
        self.spending.add(cost_of(self.hindsight.experiences))
        self.start = time.monotonic()
        if budget.seconds and isinstance(teacher, Timed):
            teacher.end_by(self.start + budget.seconds, f"The budget of {budget.seconds:g} seconds was spent")
        if progress:
            progress.skip(self.count)

    @property
    def begun(self) -> bool:
        """Whether there is anything to go on from, or to tell of."""
        journals = (path.read_bytes().count(b"\n") for path in self.work.glob("journal*.jsonl"))
        kept = len(self.parts) or self.hindsight.experiences or max(journals, default=0) > 1
        return bool(kept) or self.spending.tells

    def collect_until(self, target: int | None, lockstep: int, make_worlds: MakeWorlds) -> str:
        """Drive groups until there are `target` transitions, or from all seeds; return the budget spent, or nothing."""
        worlds = _Worlds(make_worlds)
        try:
            # First those that were there once: what comes after is numbered, and looked back on, behind them.
            for number in self.parts.missing:
                self._collect_group(number, self.work / f"journal-{number:05d}.jsonl", worlds, self.parts.seeds(number))
            self._look_back()
            while self.parts.episodes < len(self.seeds) if target is None else self.count < target:
                self._collect_group(len(self.parts), self.work / JOURNAL_FILE, worlds, None, target, lockstep)
                self._look_back()
        except (SpentError, StoppedError) as spent:
            return str(spent)
        finally:
            worlds.close()
        return ""

    def _collect_group(
        self,
        number: int,
        path: Path,
        worlds: "_Worlds",
        seeds: list[int] | None,
        target: int | None = None,
        lockstep: int = 0,
    ) -> None:
        """Drive one group, of `seeds` or of those that come next, and keep it."""
        journal = Journal(path, number)
        try:
            group = journal.seeds or seeds or self._next_group(target, lockstep)
            if journal.seeds is None:
                journal.begin(number, group)
            part = self._drive(worlds.of(len(group)), group, journal, self.parts.first_episode(number))
            self.parts.keep(number, group, part)
            journal.finish()
        finally:
            journal.close()
        self.count += part.num_rows

    def _next_group(self, target: int | None, lockstep: int) -> list[int]:
        """Return the seeds that come next.

        The last groups are smaller, so that little more than the target is collected, and no group is begun that the
        decisions left would not finish.
        """
        duration = int(get_scenario(self.settings["scenario"]).config()["duration"])
        wanted = lockstep
        if target is not None:
            wanted = min(wanted, math.ceil((target - self.count) / duration))
        if self.budget.decisions:
            wanted = min(wanted, (self.budget.decisions - self.decisions) // duration)
            if wanted < 1:
                raise SpentError(f"The budget of {self.budget.decisions} decisions was spent")
        first = self.parts.episodes
        group = list(self.seeds[first : first + wanted])
        if not group:
            raise RapidError(
                f"All {len(self.seeds)} spawn seeds are used, and {self.count} of {target} transitions are collected. "
                "Ask for fewer transitions, or give more seeds."
            )
        return group

    def _drive(self, worlds: Any, seeds: list[int], journal: Journal, first: int) -> pa.Table:
        """Drive one group of episodes, which are numbered from `first` on, from the journal as far as it goes."""
        obs_BVF, _ = worlds.reset(seed=seeds)
        active = np.arange(len(seeds))
        previous: list[Decision | None] = [None] * len(seeds)
        steps: list[dict[str, Any]] = []
        step = 0
        while len(active):
            # A vector environment may hand out the same array at every step.
            seen = np.array(obs_BVF[active], np.float32)
            decisions = journal.recall(seen)
            if decisions is None:
                self._check_budget(len(active))
                self._get_ready(journal)
                keys = np.array([stream_seed(seeds[world], f"step/{step}") for world in active], np.int64)
                decisions = self._decide(seen, [previous[world] for world in active], keys, journal)
            self._count(decisions)
            try:
                check_share(self.fallbacks, self.decisions, self.budget.fallback_share, self.last_fallback)
            except TooManyFallbacksError:
                self.spending.forget(journal.forget_from(is_fallback))
                raise
            # The actions of finished worlds are ignored.
            actions = np.full(len(seeds), IDLE, np.int64)
            actions[active] = [decision.action for decision in decisions]
            obs_BVF, reward_B, terminated_B, truncated_B, _ = worlds.step(actions)
            for place, world in enumerate(active):
                previous[world] = decisions[place]
                steps.append(
                    {
                        "world": int(world),
                        "step": step,
                        "obs": seen[place],
                        "next_obs": np.array(obs_BVF[world], np.float32),
                        "reward": reward_B[world],
                        "terminated": terminated_B[world],
                        # A crash at the last second is a crash.
                        "truncated": truncated_B[world] and not terminated_B[world],
                        "decision": decisions[place],
                    }
                )
            active = active[~(terminated_B | truncated_B)[active]]
            step += 1
            self._show(len(decisions))
        return self._table(sorted(steps, key=lambda row: row["world"]), seeds, first)

    def _get_ready(self, journal: Journal) -> None:
        try:
            self.spending.get_ready()
        except UnreachableError:
            self._forget_end(journal)
            raise

    def _forget_end(self, journal: Journal) -> None:
        """Forget what the rule decided just before, while the server was already gone: it is asked again."""
        self.spending.forget(journal.forget_end(lambda decision: decision.unanswered))

    def _decide(
        self,
        seen: NDArray[np.float32],
        previous: list[Decision | None],
        keys: NDArray[np.int64],
        journal: Journal,
    ) -> list[Decision]:
        """Let the teacher decide for all, and write it down, also if it is broken off: answers are paid for."""
        decisions = journal.kept(len(seen))
        wanted = [place for place, decision in enumerate(decisions) if decision is None]
        made: Sequence[Decision | None] = []
        with self.spending.asked(len(wanted), known := list[Decision]()):
            try:
                made = self.teacher.decide(seen[wanted], [previous[place] for place in wanted], keys[wanted])
            except (UnfinishedError, InterruptedDecisions, RefusedError, UnreachableError) as broken_off:
                if isinstance(broken_off, UnreachableError):
                    self._forget_end(journal)
                self.spending.forget(
                    [decision for decision in broken_off.decisions if decision and decision.unanswered]
                )
                made = [None if decision and decision.unanswered else decision for decision in broken_off.decisions]
                raise
            finally:
                for place, decision in zip(wanted, made, strict=False):
                    decisions[place] = decision
                known += [decision for decision in made if decision is not None]
                if known:
                    journal.append(seen, decisions)
                    self.fresh += len(known)
        return [decision for decision in decisions if decision is not None]

    def _look_back(self) -> None:
        """Let a teacher that reflects learn from the finished episodes, once from each."""
        while self.looked_back < len(self.parts):
            part = self.parts.tables[self.looked_back]
            if part is not None and (episodes := self.hindsight.pending(part)):
                self._check_budget(0)
                left = sum(episode.crashed for episode in episodes)  # only a crash is asked about
                with self.spending.asked(left):
                    for experience in self.hindsight.look_back(episodes):
                        self.spending.add(cost_of([experience]))
                        if experience.tokens_in:
                            left -= 1
                            self.spending.ask(left)
            self.looked_back += 1

    def _table(self, steps: list[dict[str, Any]], seeds: list[int], first: int) -> pa.Table:
        """Return the steps of a group as a table of `PART_SCHEMA`."""
        said: list[Decision] = [row["decision"] for row in steps]
        world_N = np.array([row["world"] for row in steps])
        unknown = (math.nan,) * NUM_ACTIONS
        transitions = Transitions(
            obs_NVF=np.stack([row["obs"] for row in steps]),
            action_N=np.array([decision.action for decision in said], np.int64),
            reward_N=np.array([row["reward"] for row in steps], np.float32),
            next_obs_NVF=np.stack([row["next_obs"] for row in steps]),
            terminated_N=np.array([row["terminated"] for row in steps], np.bool_),
            truncated_N=np.array([row["truncated"] for row in steps], np.bool_),
            source_N=np.full(len(steps), self.source, np.int8),
            episode_N=first + world_N,
            step_N=np.array([row["step"] for row in steps], np.int64),
            spawn_seed_N=np.array(seeds, np.int64)[world_N],
            probabilities_NA=np.array([decision.probabilities or unknown for decision in said], np.float32),
        ).validate("the steps just collected")
        table = to_table(transitions)
        for field in PART_SCHEMA:
            if field.name not in TRANSITION_SCHEMA.names:
                table = table.append_column(field, pa.array([getattr(row, field.name) for row in said], field.type))
        return table

    def dataset(self, complete: bool) -> Dataset:
        """Return everything collected so far as a dataset."""
        table = pa.concat_tables([PART_SCHEMA.empty_table(), *self.parts.leading])
        return Dataset(
            scenario=self.settings["scenario"],
            transitions=from_table(table),
            drivers={self.settings["source"]: self.settings["driver"]},
            log=table.select(LOG_SCHEMA.names).combine_chunks(),
            collection={"complete": complete, "settings": self.settings, **self.spending.record()},
            memory=self.hindsight.memory,
        )

    def _sum(self, name: str) -> float:
        return float(sum(part.column(name).to_numpy().sum() for part in self.parts.present))

    def _count(self, decisions: Sequence[Decision]) -> None:
        """Add to the totals."""
        self.decisions += len(decisions)
        self.spending.add(cost_of(decisions))
        for decision in filter(is_fallback, decisions):
            self.fallbacks, self.last_fallback = self.fallbacks + 1, decision

    def _check_budget(self, coming: int) -> None:
        """Raise if the budget is spent, or does not allow for the decisions that come next."""
        seconds = time.monotonic() - self.start
        self.budget.check(self.decisions + coming, self.spending.total.tokens, self.spending.total.cost, seconds)

    def _show(self, count: int) -> None:
        rate = self.fresh / max(time.monotonic() - self.start, 1e-9)
        tally = Tally(self.decisions, self.fresh, rate, self.spending.total.cost, self.fallbacks)
        if self.watch:
            self.watch(tally)
        if self.progress:
            self.progress.note(tally.note(self.source))
            self.progress.advance(count)


class _Worlds:
    """The vector environment, made anew when a group has another size."""

    def __init__(self, make: MakeWorlds) -> None:
        self._make, self._worlds = make, None

    def of(self, count: int) -> Any:
        """Return `count` worlds."""
        if self._worlds is None or self._worlds.num_envs != count:
            self.close()
            self._worlds: Any = self._make(count)
        return self._worlds

    def close(self) -> None:
        if self._worlds is not None:
            self._worlds.close()
        self._worlds = None
