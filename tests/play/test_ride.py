"""One episode, decision by decision: the same as when it is measured, whoever drives and whatever is shown."""

from pathlib import Path

import numpy as np
import pytest

import rapid
from rapid.agents.saved import QAgent
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.q_network import build_network
from rapid.play.ride import KINDS, Ride, attack_spec, verdict
from rapid.play.roster import Roster, You
from rapid.scenarios import FASTER, IDLE, SLOWER

SCENARIO = "lane-3-density-2"


def driven(ride: Ride, attack: str = "none") -> list[dict]:
    steps = []
    while not ride.ended:
        steps.append(ride.step(IDLE, attack))
    return steps


@pytest.mark.parametrize("key", ["saved", "slower", "rule", "random", "planner-observation"])
def test_a_ride_is_the_episode_that_is_measured(roster: Roster, saved: Path, key: str) -> None:
    agent = roster.open(str(saved) if key == "saved" else key, SCENARIO)
    steps = driven(Ride(agent, SCENARIO, 900_003))
    measured = run_episodes(agent, SCENARIO, [900_003])
    assert len(steps) == measured.length_E[0]
    assert sum(step["added"]["rewards"] for step in steps) == pytest.approx(measured.return_E[0], abs=2e-3)
    assert steps[-1]["crashed"] == measured.crashed_E[0]


@pytest.mark.parametrize("attack", ["none", "pgd"])
def test_an_agent_with_a_memory_remembers(attack: str) -> None:
    settings = NetworkConfig(kind="rapid", width=16, layers=1, decoder_layers=1, heads=2, memory=True)
    agent, spec = QAgent(build_network(settings, 3, seed=2).eval(), "remembering"), attack_spec(attack, 20)
    steps = driven(Ride(agent, SCENARIO, 900_002), spec)
    measured = run_episodes(agent, SCENARIO, [900_002], spec, record=True).recordings[0]
    assert [step["added"]["actions"] for step in steps] == measured.action_T.tolist()
    values = [step["added"]["q"] for step in steps]
    np.testing.assert_allclose(values, measured.q_TA, atol=1e-4)


@pytest.mark.parametrize("kind", ["uniform", "fgsm", "lie-far"])
def test_an_attacked_ride_is_the_attacked_episode_that_is_measured(roster: Roster, saved: Path, kind: str) -> None:
    agent, spec = roster.open(str(saved), SCENARIO), attack_spec(kind, 20)
    steps = driven(Ride(agent, SCENARIO, 900_001), spec)
    measured = run_episodes(agent, SCENARIO, [900_001], spec, record=True)
    assert [step["added"]["actions"] for step in steps] == measured.recordings[0].action_T.tolist()
    assert all(step["attack"] == spec and step["note"] == "" for step in steps)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("metres", [2.0, 20.0])
def test_nobody_is_moved_farther_than_the_slider_says(roster: Roster, saved: Path, kind: str, metres: float) -> None:
    ride = Ride(roster.open(str(saved), SCENARIO), SCENARIO, 900_000)
    cars = {row: x for _, row, x, *_ in ride.opening()["frames"][0]}
    seen = ride.step(None, attack_spec(kind, metres))["added"]["seen"]
    # A directed attack shows the truth where no point of the ball does what it wants.
    off = [abs(x - cars[row]) for row, x, *_ in seen or []] or [0.0]
    assert max(off) > 0.5 or kind.startswith("directed")
    # Gaussian noise has no bound; its deviation is what is chosen.
    assert max(off) <= (5 if kind == "gaussian" else 1) * metres + 0.02


def test_an_attack_is_switched_on_and_off_between_two_decisions(roster: Roster, saved: Path) -> None:
    ride, spec = Ride(roster.open(str(saved), SCENARIO), SCENARIO, 900_000), attack_spec("uniform", 10)
    shown = [ride.step(None, attack)["added"]["seen"] for attack in ("none", spec, spec, "none")]
    assert [seen is None for seen in shown] == [True, False, False, True]


def test_what_cannot_be_made_on_a_driver_leaves_it_undisturbed_and_says_so(roster: Roster) -> None:
    for key, kind in (("slower", "pgd"), ("planner", "uniform")):
        step = Ride(roster.open(key, SCENARIO), SCENARIO, 900_000).step(None, attack_spec(kind, 20))
        assert step["added"]["seen"] is None
        assert step["attack"] == "none"
        assert "undisturbed" in step["note"]


def test_you_drive_as_you_say_and_only_as_you_can() -> None:
    ride = Ride(You(), SCENARIO, 900_000)
    assert ride.opening()["human"]
    assert [ride.step(action)["added"]["actions"] for action in (FASTER, SLOWER)] == [FASTER, SLOWER]
    for wrong in (None, 5, -1, "3", True, 2.0):
        with pytest.raises(RapidError, match="There is no action"):
            ride.step(wrong)  # type: ignore[arg-type]


def test_what_a_network_weighs_is_told(roster: Roster, saved: Path) -> None:
    added = Ride(roster.open(str(saved), SCENARIO), SCENARIO, 900_000).step()["added"]
    assert np.shape(added["routing"]) == (15, 2)
    assert np.shape(added["attention"]) == (15,)
    assert int(np.argmax(added["q"])) == added["actions"]


def test_a_rule_says_why(roster: Roster) -> None:
    added = Ride(roster.open("rule", SCENARIO), SCENARIO, 900_000).step()["added"]
    assert added["q"] is None
    assert added["answered"] == ""  # no model was asked
    assert added["computed"]


def test_an_ended_episode_takes_no_more_decisions(roster: Roster) -> None:
    ride = Ride(roster.open("slower", SCENARIO), SCENARIO, 900_000)
    driven(ride)
    with pytest.raises(RapidError, match="has ended"):
        ride.step()


@pytest.mark.parametrize(("kind", "metres"), [("pgdd", 3.0), ("pgd", float("nan")), ("pgd", -1.0), ("pgd", 1e9)])
def test_sizes_and_kinds_that_do_not_exist_are_refused(kind: str, metres: float) -> None:
    with pytest.raises(RapidError):
        attack_spec(kind, metres)


def test_no_size_is_no_attack() -> None:
    assert attack_spec("pgd", 0) == attack_spec("none", 20) == "none"


def test_the_interval_filter_says_which_actions_are_safe():
    ride = Ride(You(), SCENARIO, 900_000)
    told = ride.step(IDLE, "none", 0.05)["added"]["verdict"]
    assert len(told["safe"]) == len(told["spare"]) == 5
    assert told["safe"][SLOWER]
    assert told["spare"][SLOWER] == 999.0  # braking is the yardstick
    assert told["safe"] == [spare >= 0 for spare in told["spare"]]
    # The more may be wrong of what is seen, the less is safe.
    seen_BVF = rapid.make_vec(SCENARIO, 1).reset(seed=900_000)[0]
    near, far = (verdict(seen_BVF, 3, radius)["spare"] for radius in (0.0, 0.1))
    assert all(wide <= narrow for narrow, wide in zip(near, far, strict=True))
