import pytest
from hypothesis import given
from hypothesis import strategies as st

from rapid.errors import RapidError
from rapid.scenarios import PAPER_SCENARIOS, SCENARIOS, Scenario, get_scenario


def test_the_listed_scenarios_exist_under_their_own_names():
    assert set(PAPER_SCENARIOS) <= set(SCENARIOS)
    assert len(set(SCENARIOS)) == len(SCENARIOS) == 36
    for name in SCENARIOS:
        assert get_scenario(name).name == name


@given(
    st.builds(
        Scenario,
        lanes=st.integers(1, 20),
        density=st.integers(1, 2000).map(lambda hundredths: hundredths / 100),
        dynamics=st.sampled_from(["v0", "fast"]),
        reward=st.sampled_from(["normalized", "progress"]),
        clock=st.booleans(),
    )
)
def test_any_scenario_is_read_back_from_its_name(scenario: Scenario):
    assert get_scenario(scenario.name) == scenario


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("lane-3-densty-2", "did you mean 'lane-3-density-2'"),
        ("lane-3-density-2:speed", "did you mean"),
        ("lane-3-density-2:clock:progress", "in this order"),
        ("", "Unknown scenario"),
        ("lane-0-density-2", "1 to 20 lanes"),
        ("lane-3-density-0", "density"),
        ("lane-3-density-1e9", "Unknown"),
        ("lane-3-density-nan", "Unknown"),
    ],
)
def test_a_wrong_name_is_refused_with_what_exists(name: str, says: str):
    with pytest.raises(RapidError, match="scenario") as error:
        get_scenario(name)
    assert says in str(error.value)


def test_parking_earns_nothing_under_progress():
    config = get_scenario("lane-3-density-2:progress").config()
    assert config["reward_speed_range"][0] == 0
    assert not config["normalize_reward"]
    assert "normalize_reward" not in get_scenario("lane-3-density-2").config()


def test_a_clock_changes_the_observation_alone():
    timed, plain = (get_scenario(f"lane-3-density-2:progress{clock}").config() for clock in (":clock", ""))
    assert timed["observation"].pop("clock")
    assert timed == plain
