"""The worst case over attacks: of every spawn the attack after which its episode earned least.

An attacker chooses per spawn, so the mean of the minima lies below the minimum of the means. Only attacks of the same
size that may move the same things belong together; to do nothing is one of them.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rapid.attacks.spec import MOVED, AttackSpec, Moves, parse_attack
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, column
from rapid.evaluation.statistics import RESAMPLES, Estimate, estimate, paired_difference
from rapid.evaluation.summary import CLEAN, NOT_RUN, WIDE, aligned, label_of, with_interval
from rapid.scenarios import get_scenario

UNBOUNDED = ("none", "gaussian")
"""Kinds of attacks that belong to no ball."""
ENOUGH = 3
"""Sizes from which on a table and a plot over sizes are made."""
OVER_SLOWER = "over always-slower [95 %]"
"""Heading of what an agent earns more than the driver that always brakes."""


class Threat(NamedTuple):
    """What an attacker may do: how far each feature may be moved, and which."""

    radius: float
    metres: float
    speed: float
    presence: str
    ego: str
    moves: Moves = "all"

    def words(self, lanes: int) -> str:
        """Return it in words, in metres and m/s."""
        return self._spec().units(lanes)

    def liberties(self) -> str:
        """Return in words what may be moved, whatever the size."""
        presence = "presence free" if self.presence == "free" else "presence masked"
        features = "" if self.moves == "all" else f", of cars only {', '.join(MOVED[self.moves])}"
        return f"{presence}, ego row {self.ego}{features}"

    def _spec(self) -> AttackSpec:
        box = bool(self.metres or self.speed)
        return AttackSpec(
            "lie",
            radius=0.1 if box else self.radius,
            metres=self.metres,
            speed=self.speed,
            presence="free" if self.presence == "free" else "masked",
            ego="trusted" if self.ego == "trusted" else "free",
            moves=self.moves,
        )


@dataclass(frozen=True)
class Worst:
    """The worst case of one agent in one scenario within one threat."""

    scenario: str
    agent: str
    threat: Threat
    attacks: tuple[str, ...]
    """Those that were made on it."""
    rows: tuple[EpisodeRow, ...]
    """For each training and spawn the episode that earned least; `attack` says under which."""
    episode_return: Estimate
    crashed: Estimate
    over_slower: Estimate | None = None
    """The return less that of always-slower on the same spawns; None if that was not driven, or is this agent."""

    @property
    def worst_attack(self) -> str:
        """The attack that was worst most often."""
        return Counter(row.attack for row in self.rows).most_common(1)[0][0]


def threat_of(attack: str) -> Threat | None:
    """Return what an attack may do, from its text; None for what has no bound, or is no text of an attack."""
    try:
        spec = parse_attack(attack)
    except RapidError:
        return None
    if spec.kind in UNBOUNDED:
        return None
    box = bool(spec.metres or spec.speed)
    return Threat(0.0 if box else spec.radius, spec.metres, spec.speed, spec.presence, spec.ego, spec.moves)


def worst_rows(rows: Sequence[EpisodeRow]) -> list[EpisodeRow]:
    """Return of each scenario, agent, training and spawn the row that earned least; of equal ones the first.

    Their mean return is the worst case: the mean over spawns of the minimum over attacks.
    """
    found: dict[tuple[str, str, int | None, int], EpisodeRow] = {}
    for row in rows:
        key = (row.scenario, row.agent, row.training_seed, row.seed)
        if key not in found or row.episode_return < found[key].episode_return:
            found[key] = row
    return list(found.values())


def worst_cases(rows: Sequence[EpisodeRow], resamples: int = RESAMPLES) -> list[Worst]:
    """Return the worst case of every agent within every threat of which at least two attacks were measured.

    An agent on which only some of them can be made is shown with these; spawns that one of them lacks are left out.
    """
    threats = {attack: threat_of(attack) for attack in dict.fromkeys(row.attack for row in rows)}
    members = Counter(threat for threat in threats.values() if threat is not None)
    found: list[Worst] = []
    slower = _slower(rows)
    for scenario, agent in dict.fromkeys((row.scenario, row.agent) for row in rows):
        own = [row for row in rows if (row.scenario, row.agent) == (scenario, agent)]
        for threat in (threat for threat, count in members.items() if count > 1):
            chosen = [row for row in own if threats[row.attack] == threat or row.attack == "none"]
            attacks = tuple(dict.fromkeys(row.attack for row in chosen if row.attack != "none"))
            if not attacks:
                continue
            complete = measured_under_all(chosen)
            worst = [row for row in worst_rows(chosen) if (row.training_seed, row.seed) in complete]
            if worst:
                floor = [row for row in slower if row.scenario == scenario and own[0].what != "slower"]
                found.append(_worst(scenario, agent, threat, attacks, worst, floor, resamples))
    return found


def _slower(rows: Sequence[EpisodeRow]) -> list[EpisodeRow]:
    """Return one row of always-slower for each scenario and spawn; it does not look, so no attack changes any."""
    driven = [row for row in rows if row.kind == "floor" and row.what == "slower"]
    # Those without attack come first, as there every spawn was driven.
    ordered = sorted(driven, key=lambda row: row.attack != CLEAN)
    return list({(row.scenario, row.seed): row for row in reversed(ordered)}.values())


def measured_under_all(rows: Sequence[EpisodeRow]) -> set[tuple[int | None, int]]:
    """Return the trainings and spawns of one agent that met every attack among its rows.

    Where an attack is missing, the least return is one over fewer attacks, and too good.
    """
    met: dict[tuple[int | None, int], set[str]] = {}
    for row in rows:
        met.setdefault((row.training_seed, row.seed), set()).add(row.attack)
    every = {row.attack for row in rows}
    return {key for key, attacks in met.items() if attacks == every}


def _worst(
    scenario: str,
    agent: str,
    threat: Threat,
    attacks: tuple[str, ...],
    rows: Sequence[EpisodeRow],
    slower: Sequence[EpisodeRow],
    resamples: int,
) -> Worst:
    seeds, trainings = [row.seed for row in rows], [row.training_seed for row in rows]
    returns, crashes = (
        estimate(column(rows, name), seeds, trainings, "mean", resamples) for name in ("episode_return", "crashed")
    )
    over = paired_difference(
        column(rows, "episode_return"),
        seeds,
        column(slower, "episode_return"),
        [row.seed for row in slower],
        trainings,
        resamples=resamples,
    )
    return Worst(scenario, agent, threat, attacks, tuple(rows), returns, crashes, over if over.episodes else None)


def threats_of(cases: Sequence[Worst]) -> dict[Threat, str]:
    """Return the threats of one scenario with a heading in words for each; none where no table of them is needed.

    One threat needs none, and of many that differ by their size alone there is the table over sizes.
    """
    threats = list(dict.fromkeys(case.threat for case in cases))
    sizes = {threat[:3] for threat in threats}
    if len(threats) < 2 or (len({threat[3:] for threat in threats}) == 1 and len(sizes) >= ENOUGH):
        return {}
    if len(sizes) == 1:
        return {threat: threat.liberties() for threat in threats}
    lanes = get_scenario(cases[0].scenario).lanes
    return {threat: f"{threat.words(lanes)}; {threat.liberties()}" for threat in threats}


def threats_text(cases: Sequence[Worst]) -> str:
    """Return all threats of one scenario in one table, a row an agent; empty where none is needed."""
    threats = threats_of(cases)
    if not threats:
        return ""
    found = {(case.agent, case.threat): case for case in cases}
    lines = [["worst case", *threats.values()]]
    for agent in dict.fromkeys(case.agent for case in cases):
        lines.append([label_of(agent), *(brief(found.get((agent, threat))) for threat in threats)])
    return aligned(lines if len(threats) <= WIDE else list(zip(*lines, strict=True)))


def brief(case: Worst | None) -> str:
    """Return a worst case as one cell: its return and the share of crashes."""
    return NOT_RUN if case is None else f"{with_interval(case.episode_return)}, crashed {case.crashed.value:.0%}"


def worst_text(rows: Sequence[EpisodeRow], resamples: int = RESAMPLES) -> str:
    """Return the worst cases as aligned plain text, one block for each scenario and threat; empty without any."""
    blocks: list[str] = []
    cases = worst_cases(rows, resamples)
    for scenario in dict.fromkeys(case.scenario for case in cases):
        if table := threats_text([case for case in cases if case.scenario == scenario]):
            blocks.append(f"{scenario}, within each threat\n{table}")
    for scenario, threat in dict.fromkeys((case.scenario, case.threat) for case in cases):
        here = [case for case in cases if (case.scenario, case.threat) == (scenario, threat)]
        lines = [["worst case", "return", OVER_SLOWER, "crash %", "attacks", "most often"]]
        lines += [
            [
                label_of(case.agent),
                with_interval(case.episode_return),
                NOT_RUN if case.over_slower is None else with_interval(case.over_slower),
                with_interval(case.crashed, 0, 100),
                str(len(case.attacks)),
                case.worst_attack,
            ]
            for case in here
        ]
        blocks.append(f"{scenario}, within {threat.words(get_scenario(scenario).lanes)}\n{aligned(lines)}")
    if blocks:
        blocks.append(
            "Worst case: the mean over spawns of the least return under any of the attacks, none among them. Agents "
            "without a network meet fewer attacks, so theirs is an upper bound of what the same attacker could do."
        )
    return "\n\n".join(blocks)
