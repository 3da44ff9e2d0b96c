"""The worst case over attacks, and the sweep over sizes."""

import re
from dataclasses import replace

import pytest

from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.worst import measured_under_all, threat_of, threats_of, worst_cases, worst_rows, worst_text
from rapid.report.sweep import sweep_figure, sweep_text

BASE = EpisodeRow("lane-3-density-2", "a", 0, "none", 20.0, 30, False, 20.0, 600.0, 0, 3.0, (0.2,) * 5)


def rows(returns: dict[str, list[float]], agent: str = "a") -> list[EpisodeRow]:
    return [
        replace(BASE, agent=agent, attack=attack, seed=seed, episode_return=value, crashed=value < 5)
        for attack, values in returns.items()
        for seed, value in enumerate(values)
    ]


def test_an_attacker_chooses_for_every_spawn_anew():
    found = rows({"none": [20, 20, 1], "pgd:loss=margin": [3, 18, 9], "world": [15, 4, 9]})
    (case,) = worst_cases(found)
    assert [row.episode_return for row in case.rows] == [3, 4, 1]
    assert [row.attack for row in case.rows] == ["pgd:loss=margin", "world", "none"]
    assert case.episode_return.value == pytest.approx(8 / 3)
    assert case.crashed.value == 1
    assert case.attacks == ("pgd:loss=margin", "world")
    assert case.episode_return.value <= min(sum(v) / 3 for v in ([3, 18, 9], [15, 4, 9]))


def test_only_what_an_attacker_of_one_kind_could_do_belongs_together():
    sizes = ["pgd:loss=ce", "world", "world:ego=trusted", "pgd:loss=ce,ego=trusted", "uniform", "gaussian", "my label"]
    found = rows({"none": [20.0], **{name: [10.0 - i] for i, name in enumerate(sizes)}})
    cases = worst_cases(found)
    assert [case.attacks for case in cases] == [
        ("pgd:loss=ce", "world"),
        ("world:ego=trusted", "pgd:loss=ce,ego=trusted"),
    ]
    assert [case.episode_return.value for case in cases] == [9, 7]
    assert threat_of("gaussian") is None
    assert threat_of("my label") is None
    assert threat_of("pgd:metres=1,speed=0.5") == threat_of("world:metres=1,speed=0.5")
    assert threat_of("pgd:metres=1,speed=0.5").words(3) == "1 m along, 1 m across, 0.5 m/s"


def test_each_training_and_each_agent_has_its_own_worst_case():
    trained = [replace(row, training_seed=t) for t in (0, 1) for row in rows({"none": [20.0], "world": [8.0 + t]})]
    found = trained + rows({"none": [19.0], "world": [3.0]}, "b") + rows({"pgd:loss=ce": [9.0, 9.0]}, "b")
    worst = worst_rows(found)
    assert [(row.agent, row.training_seed, row.episode_return) for row in worst][:2] == [("a", 0, 8.0), ("a", 1, 9.0)]
    for case in worst_cases(found):
        if case.agent == "b":
            # The second spawn was not driven under every attack, so it tells nothing of the worst case.
            assert [(row.seed, row.episode_return) for row in case.rows] == [(0, 3.0)]


def test_who_missed_an_attack_has_no_worst_case_even_where_everybody_missed_one():
    found = [
        *rows({"none": [20.0, 20.0], "world": [8.0], "pgd:loss=ce": [9.0, 7.0]}),
        # A spawn driven twice under one attack met no more attacks for that.
        *rows({"none": [20.0, 20.0]}),
    ]
    assert measured_under_all(found) == {(None, 0)}
    apart = [replace(row, training_seed=int(row.attack == "world")) for row in rows({"world": [8.0], "none": [20.0]})]
    assert measured_under_all(apart) == set()


def test_the_text_says_what_was_worst():
    text = worst_text(rows({"none": [20, 20], "pgd:loss=ce": [12, 13], "world": [9, 9]}))
    assert "within 0.1 (20 m along, 1.2 m across, 8 m/s)" in text
    assert "9.0" in text
    assert text.splitlines()[3].split()[-1] == "world"
    assert worst_text(rows({"none": [20.0], "pgd": [3.0]})) == ""


def test_several_threats_stand_side_by_side_in_one_table():
    threats = {"": 9.0, "ego=trusted": 8.0, "presence=free": 4.0, "presence=free,ego=trusted": 7.0}
    attacks = {f"{kind}:radius=0.05{',' * bool(more)}{more}": [value + place, value]
               for more, value in threats.items() for place, kind in enumerate(("world", "directed"))}  # fmt: skip
    found = rows({"none": [20.0, 21.0], **attacks})
    text = worst_text([*found, *rows({"none": [5.0, 5.0], "lie:radius=0.05": [5.0, 5.0]}, "blind")])
    head, _, first, second = text.split("\n\n")[0].splitlines()[1:]
    words = ["presence masked, ego row free", "presence masked, ego row trusted",
             "presence free, ego row free", "presence free, ego row trusted"]  # fmt: skip
    assert re.split(r"  +", head) == ["worst case", *words]
    cells = [first[head.index(word) :].split("  ")[0] for word in words]
    assert [cell.split(" ")[0] for cell in cells] == ["9.0", "8.0", "4.0", "7.0"]
    assert [cell.split(", ")[-1] for cell in cells] == ["crashed 0%"] * 2 + ["crashed 100%", "crashed 0%"]
    assert [second[head.index(word) :].split("  ")[0] for word in words[1:]] == ["–"] * 3
    # One threat has its own block alone, sizes have a table of their own, and other sizes are named in the heads.
    assert "within each threat" not in worst_text(rows({"none": [20.0], "world": [9.0], "directed": [8.0]}))
    assert threats_of(worst_cases(rows(sized(0.01, 0.02, 0.05)))) == {}
    assert [words.split(" ")[0] for words in threats_of(worst_cases(rows(sized(0.01, 0.05)))).values()] == [
        "0.01",
        "0.05",
    ]


def sized(*radii: float) -> dict[str, list[float]]:
    return {"none": [20.0], **{f"{kind}:radius={r}": [9.0] for r in radii for kind in ("world", "directed")}}


def test_what_moves_one_feature_alone_is_another_threat():
    along = [f"{kind}:radius=0.05,moves=along" for kind in ("world", "directed")]
    found = rows(
        {"none": [20.0], "world:radius=0.05": [9.0], "directed:radius=0.05": [8.0], **{key: [3.0] for key in along}}
    )
    free, only = worst_cases(found)
    assert (free.episode_return.value, only.episode_return.value) == (8, 3)
    assert only.threat.words(3) == "0.05 (10 m along)"
    assert list(threats_of([free, only]).values())[1] == "presence masked, ego row free, of cars only x"


def test_the_text_says_how_much_more_than_always_slower_the_worst_case_earns():
    attacked = rows({"none": [20, 20, 20], "pgd:loss=ce": [12, 13, 15], "world": [9, 14, 12]})
    # Always-slower was driven on other spawns as well, which count for nothing here.
    slower = [replace(row, kind="floor") for row in rows({"none": [7, 8, 9, 100], "lie:to=far": [7, 8, 9]}, "slower")]
    found, floor = worst_cases([*attacked, *slower])
    assert found.over_slower is not None
    assert found.over_slower.value == pytest.approx((9 - 7 + 13 - 8 + 12 - 9) / 3)
    assert (found.over_slower.low, found.over_slower.high) == (2, 5)
    assert floor.over_slower is None
    lines = worst_text([*attacked, *slower]).splitlines()
    start = lines[1].index("over always-slower [95 %]")
    assert [line[start:].split("  ")[0] for line in lines[3:5]] == ["3.3 [2.0, 5.0]", "–"]
    # An agent that is only called so is not that driver; without the driver there is nothing to say.
    named = [replace(row, agent="slower", kind="learned") for row in attacked]
    assert {case.over_slower for case in worst_cases([*attacked, *named])} == {None}


def test_a_sweep_is_a_table_and_a_plot():
    sizes = (0.005, 0.02, 0.1)
    found = rows({"none": [20.0, 21.0]} | {
        f"{kind}:radius={size}": [20 - 100 * size - i, 20 - 50 * size]
        for size in sizes for i, kind in enumerate(("world", "directed"))
    })  # fmt: skip
    text = sweep_text(found)
    assert text.splitlines()[0].split("  ")[0] == "worst case within"
    assert "0.02 (4 m, 1.6 m/s)" in text
    figure = sweep_figure(found)
    assert figure is not None
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["return", "crashed, %"]
    drawn = figure.axes[0].lines[0]
    assert list(drawn.get_xdata()) == list(sizes)
    assert list(drawn.get_ydata()) == pytest.approx([(19.5 - 1 + 19.75) / 2, (17 + 19) / 2, (9 + 15) / 2])
    assert sweep_text(rows({"none": [20.0], "world": [9.0], "pgd:loss=ce": [8.0]})) == ""
