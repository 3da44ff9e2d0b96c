"""Who crashes under which attack, when, and into what: a table whose cells lead to the crashes that can be watched."""

import math
from collections.abc import Sequence

from rapid.evaluation.crashes import Crashes, crashes_by
from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.recording import Recording
from rapid.evaluation.summary import NOT_RUN, label_of
from rapid.pages.markup import Markup, tag
from rapid.report.sections import section
from rapid.report.tables import table

_LAST = 4
"""Seconds before a crash at which its playing begins."""


def crashes(rows: Sequence[EpisodeRow], shown: Sequence[Recording]) -> Markup:
    """Return the section; nothing if nobody crashed. `shown` are the episodes in the order in which the page has them.

    A row is an attack and a column an agent: there are often more attacks than a screen is wide.
    """
    found = crashes_by(rows, shown)
    if not any(cell.crashes for cell in found.values()):
        return Markup("")
    places: dict[tuple[str, str, str], int] = {}
    for place, recording in enumerate(shown):
        if recording.crashed:
            places.setdefault((recording.scenario, recording.attack, recording.agent), place)
    parts: list[Markup] = []
    for scenario in dict.fromkeys(scenario for scenario, _, _ in found):
        here = [key for key in found if key[0] == scenario]
        agents = list(dict.fromkeys(agent for _, _, agent in here))
        # Without attack comes first, whoever was driven first.
        attacks = sorted(dict.fromkeys(attack for _, attack, _ in here), key=lambda attack: attack != "none")
        heads = [("attack", "", "text"), *((label_of(agent), "crashes of episodes", "number") for agent in agents)]
        body = [
            tag(
                "tr",
                tag("th", attack, scope="row", class_="name", data_value=attack),
                *(
                    _cell(found.get((scenario, attack, agent)), shown, places.get((scenario, attack, agent)))
                    for agent in agents
                ),
            )
            for attack in attacks
        ]
        parts += [tag("h3", scenario), table(heads, body)]
    intro = (
        "Crashes of episodes under each attack, the median second of the crash, and what was hit most often: a car "
        "ahead, beside (the sides touched first) or behind. Where a crash was kept, a click plays its last seconds."
    )
    return section("crashes", "Who crashes under what", tag("p", intro), *parts)


def _cell(cell: Crashes | None, shown: Sequence[Recording], place: int | None) -> Markup:
    if cell is None:
        return tag("td", tag("span", NOT_RUN, class_="value none"), title="not measured, or not applicable")
    inside = [tag("span", f"{cell.crashes} of {cell.episodes}", class_="value" if cell.crashes else "value none")]
    if not math.isnan(cell.second):
        inside.append(tag("small", f"at {cell.second:g} s"))
    if cell.known:
        of = f"{cell.hits} of {cell.known}"
        inside.append(tag("small", f"{cell.hit}: {of}" if cell.known >= cell.crashes else f"{cell.hit}: {of} known"))
    if place is not None:
        begin = max(len(shown[place].action_T) - _LAST, 0)
        inside.append(tag("a", "watch", href=f"#moment={place},,{begin}", data_crash=place))
    return tag("td", *inside, data_value=cell.share, class_="heat crash", style=f"--share:{100 * cell.share:.0f}%")
