"""Scripted drivers, decisions as JSON, and the making of teachers."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from rapid.agents.open import kind_of
from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.scenarios import PAPER_SCENARIOS
from rapid.teacher import Decision, from_record, make_teacher, to_record
from rapid.teacher.facts import gather
from rapid.teacher.scene import read_scenes
from rapid.teacher.scripted import SCRIPTED, Scripted, has_plan, plan_for, safe_actions

REWARDS = ("", ":progress")


def scripted(name, seed=0):
    return make_teacher(TeacherConfig(backend="scripted", model=name), 3, seed, "lane-3-density-2")


def actions(decisions):
    return [decision.action for decision in decisions]


@pytest.mark.parametrize("name", SCRIPTED)
def test_decisions_do_not_depend_on_the_batch(crowd, name):
    keys = np.arange(len(crowd)) * 1_000_003 - 5
    teacher = scripted(name)
    together = actions(teacher.decide(crowd, [None] * len(crowd), keys))
    alone = [teacher.decide(crowd[i : i + 1], [None], keys[i : i + 1])[0].action for i in reversed(range(len(crowd)))]
    assert together == alone[::-1]
    assert json.dumps(teacher.describe())


@pytest.mark.parametrize("name", [*(name for name in SCRIPTED if name != "blind"), "blind:3,1,4"])
def test_what_a_driver_does_and_is_does_not_depend_on_its_label(crowd, name):
    keys = np.arange(len(crowd))
    driver, renamed = (Scripted(name, 3, 0) for _ in range(2))
    renamed.name = "faster"
    nobody = [None] * len(crowd)
    ours, theirs = (each.decide(crowd, nobody, keys) for each in (driver, renamed))
    assert [decision.action for decision in ours] == [decision.action for decision in theirs]
    assert driver.describe() == renamed.describe()
    renamed.name = f"{name} (another)"
    assert kind_of(driver) == kind_of(renamed) == "floor"


def test_chance_follows_keys_and_seed(crowd):
    keys = np.arange(len(crowd), dtype=np.int64)
    draws = actions(scripted("random").decide(crowd, [None] * len(crowd), keys))
    assert draws == actions(scripted("random").decide(crowd, [None] * len(crowd), keys))
    assert draws != actions(scripted("random").decide(crowd, [None] * len(crowd), keys + 100))
    assert draws != actions(scripted("random", seed=1).decide(crowd, [None] * len(crowd), keys))


def test_random_is_uniform(world):
    obs_BVF = np.repeat(world(), 2000, axis=0)
    decisions = scripted("random").decide(obs_BVF, [None] * 2000, np.arange(2000))
    assert np.all(np.abs(np.bincount(actions(decisions), minlength=5) - 400) < 90)
    assert decisions[0].probabilities == (0.2,) * 5


def test_random_without_keys_is_refused(crowd):
    with pytest.raises(RapidError, match="keys_B"):
        scripted("random").decide(crowd, [None] * len(crowd))


def test_safe_chance_draws_what_is_safe(crowd):
    decisions = scripted("uniform-safe").decide(crowd, [None] * len(crowd), np.arange(len(crowd)))
    for scene, decision in zip(read_scenes(crowd, 3), decisions, strict=True):
        choices = safe_actions(gather(scene))
        assert decision.action in choices
        assert decision.probabilities == tuple(float(a in choices) / len(choices) for a in range(5))


def test_rules_speed_up_on_a_free_road_and_brake_before_a_wall(world):
    wall = world(cars=((25, 0, 0), (25, 1, 0), (25, 2, 0)))
    for name in ("rule", "rule-forecast"):
        assert actions(scripted(name).decide(world(), [None])) == [3]
        assert actions(scripted(name).decide(wall, [None])) == [4]


def test_immune_asks_only_whether_a_car_is_there(world, crowd):
    immune = scripted("immune")
    assert actions(immune.decide(world(), [None])) == [3]
    assert actions(immune.decide(world(cars=((190, 2, 30),)), [None])) == [4]
    far_BVF = world(cars=((190, 2, 30),))
    far_BVF[:, 1, 1] += 20  # said to be beyond sight, and there all the same
    assert actions(immune.decide(far_BVF, [None])) == [4]
    lied_BVF = crowd + np.random.default_rng(0).uniform(-0.1, 0.1, crowd.shape) * [1, 200, 12, 80, 80]
    assert actions(immune.decide(lied_BVF, [None] * len(crowd))) == actions(immune.decide(crowd, [None] * len(crowd)))


def test_blind_follows_its_plan_whatever_it_sees(crowd):
    blind = make_teacher(TeacherConfig(backend="scripted", model="blind:2,1,3"), 3)
    previous, taken = [None] * 2, []
    for step in range(8):
        previous = blind.decide(crowd[step : step + 2], previous)
        taken.append(actions(previous))
    assert taken == [[action] * 2 for action in (4, 4, 2, 3, 3, 3, 1, 1)]
    assert blind.describe()["plan"] == [2, 1, 3]


def test_blind_has_a_plan_for_each_scenario_of_the_paper_and_says_so_of_others():
    plans = {(scenario, reward): plan_for(scenario + reward) for scenario in PAPER_SCENARIOS for reward in REWARDS}
    assert len(set(plans.values())) > 1
    assert plan_for("lane-3-density-2:clock") == plans["lane-3-density-2", ""]
    assert has_plan("lane-4-density-2.5:progress")
    assert not has_plan("lane-6-density-2")
    with pytest.raises(RapidError, match=r"no plan for lane-6-density-2.*rapid.evaluation.blind lane-6-density-2"):
        Scripted("blind", 6, 0, "lane-6-density-2")
    for plan in ("blind:1,2", "blind:1,2,x", "blind:1,2,-3"):
        with pytest.raises(RapidError, match=r"as a driver blind:5,2,4"):
            Scripted(plan, 3, 0)
    with pytest.raises(RapidError, match="Unknown scripted driver 'idle:1,2,3'"):
        Scripted("idle:1,2,3", 3, 0)


def test_unknown_drivers_are_refused():
    with pytest.raises(RapidError, match="did you mean 'slower'"):
        scripted("slow")


def test_decisions_survive_json():
    decision = Decision(3, "free", "{}", (0.1, 0.2, 0.3, 0.4, 0.0), "ab", "repaired", "x", 1, 2, 3, 0.5, 0.25, "[]")
    assert from_record(json.loads(json.dumps(to_record(decision)))) == decision
    assert from_record(to_record(Decision(0))) == Decision(0)


@pytest.mark.parametrize(
    "change", [{"action": 5}, {"action": True}, {"status": "fine"}, {"probabilities": [1.0]}, {"mood": "good"}]
)
def test_wrong_records_are_refused(change):
    with pytest.raises(RapidError, match="recorded decision"):
        from_record({**dataclasses.asdict(Decision(1)), **change})


def test_importing_the_package_loads_no_model_code():
    heavy = "{'torch', 'transformers', 'numba', 'rapid.teacher.endpoint'}"
    code = f"import sys, rapid.teacher; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
