"""Defences without training: what they leave alone, what they do, what an attack sees of them, and clear errors."""

import numpy as np
import pytest
import torch

from rapid.agents.open import check_road, network_agent, open_agent
from rapid.agents.saved import moved_on
from rapid.agents.specs import own_scenario
from rapid.attacks import get_attack
from rapid.attacks.attack import offers, values_of
from rapid.defences import Smoothing, TrackFilter, fitted, make_defence, matched, unwrapped
from rapid.errors import RapidError
from rapid.evaluation.rollouts import run_episodes
from rapid.networks.encoding import feature_scale
from rapid.scenarios import IDLE
from rapid.simulator import make_vec
from rapid.spawns import spawn_seeds

SCENARIO, AGENT, ROBUST = "lane-3-density-2", "shipped:lane-3-density-2/distilled", "shipped:lane-3-density-2/robust"
ALL = (
    "noise-average:0.1",
    "smooth:3",
    "purify-pca:8",
    "purify-autoencoder:8",
    "track",
    "average:smooth:3+purify-pca:8",
)


@pytest.fixture(scope="module")
def driven() -> np.ndarray:
    """Observations of the same eight worlds, one after the other (T, B, V, F)."""
    env = make_vec(SCENARIO, 8, autoreset=False)
    met = [env.reset(seed=spawn_seeds("tune", 8))[0].copy()]
    for _ in range(8):
        met.append(env.step(np.full(8, IDLE))[0].copy())
    return np.stack(met)


@pytest.mark.parametrize("spec", ["noise-average:0", "smooth:1", "purify-pca:60"])
def test_what_changes_nothing_leaves_the_decisions_and_values_alone(driven: np.ndarray, spec: str):
    plain, agent = open_agent(AGENT, SCENARIO), open_agent(f"{spec}:{AGENT}", SCENARIO)
    state = agent.start(8)
    for obs in driven:
        given = (state,) if agent.has_memory else ()
        np.testing.assert_allclose(agent.q_values(obs, *given), plain.q_values(obs), atol=2e-4)
        state = moved_on(agent, obs, state, agent.act(obs, *given))


def test_a_purifier_squeezes_more_the_fewer_numbers_it_has(driven: np.ndarray):
    obs = torch.from_numpy(driven[3])

    def error(text: str) -> float:
        seen = make_defence((text,), SCENARIO, 15).seen(obs, torch.zeros(8, 0))[0]
        assert torch.equal(seen[..., 0], obs[..., 0])
        assert torch.equal(seen[:, 0, 1], obs[:, 0, 1])
        return float(((seen - obs) / feature_scale(3)).square().mean())

    errors = [error(f"purify-pca:{size}") for size in (1, 20, 60)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-10
    assert error("purify-autoencoder:8") < errors[0]
    once = error("purify-autoencoder:8")
    fitted.cache_clear()
    assert error("purify-autoencoder:8") == once


def test_the_track_filter_lets_what_cars_can_do_pass_and_clips_the_rest():
    env, agent = make_vec(SCENARIO, 16, autoreset=False), open_agent(AGENT, SCENARIO)
    seen, _ = env.reset(seed=spawn_seeds("tune", 16))
    track, state, alive = TrackFilter(15), torch.zeros(16, 75), torch.ones(16, dtype=torch.bool)
    changed, rows = 0, 0
    for _ in range(20):
        obs = torch.from_numpy(seen.copy())
        believed = track.seen(obs, state)[0]
        changed += int((believed[alive] != obs[alive]).any(-1).sum())
        rows += int((obs[alive][..., 0] > 0.5).sum())
        state = track.notice(obs, state)
        seen, _, terminated, truncated, _ = env.step(agent.act(seen))
        alive &= ~torch.from_numpy(terminated | truncated)
    assert rows > 4000
    assert changed <= 0.002 * rows  # wrecks alone stop faster than drivers brake
    car = torch.tensor([[[1.0, 0, 0, 20, 0], [1, 50, 4, 20, 0], [1, 90, 0, 25, 0]]])
    moved = car.clone()
    moved[..., 1] += car[..., 3]
    assert torch.equal(TrackFilter(3).seen(moved, car.flatten(1))[0], moved)
    moved[0, 1, 1:4] += torch.tensor([20.0, 1.2, -8.0])
    believed = TrackFilter(3).seen(moved, car.flatten(1))[0]
    assert torch.allclose(believed[0, 1], torch.tensor([1, 72.5, 5.2, 13.9, 0]))
    assert torch.equal(believed[0, [0, 2]], moved[0, [0, 2]])


def test_cars_are_followed_when_their_rows_change_places_and_new_ones_are_believed():
    before = torch.tensor([[[1.0, 0, 0, 20, 0], [1, 30, 4, 20, 0], [1, 36, 8, 28, 0], [0, 0, 0, 0, 0]]])
    seen = torch.tensor([[[1.0, 20, 0, 20, 0], [1, 52, 8, 28, 0], [1, 54, 4, 20, 0], [1, 120, 0, 20, 0]]])
    believed = Smoothing(2, 4).seen(seen, before.flatten(1))[0]
    assert believed[0, :, 1].tolist() == [20, 58, 52, 120]
    row, known = matched(seen, before)
    assert known[0].tolist() == [True, True, True, False]
    assert row[0, :3].tolist() == [0, 2, 1]


@pytest.mark.parametrize("spec", ALL)
def test_gradient_attacks_see_through_the_defence_and_its_memory(driven: np.ndarray, spec: str):
    agent = open_agent(f"{spec}:{AGENT}", SCENARIO)
    state = agent.start(8)
    if agent.has_memory:
        state = moved_on(agent, driven[2], state, agent.act(driven[2], state))
    values = values_of(agent, state if agent.has_memory else None)
    assert values is not None
    obs = torch.from_numpy(driven[3])
    q = values(obs)
    np.testing.assert_allclose(
        q.detach().numpy(), agent.q_values(driven[3], *([state] if agent.has_memory else [])), atol=1e-5
    )
    shown = get_attack("pgd:steps=10", 3)(values, obs, [torch.Generator() for _ in range(8)])
    taken = q.argmax(1)

    def surplus(q_BA: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.cross_entropy(q_BA, taken, reduction="none")

    assert (surplus(values(shown)) >= surplus(q)).all()
    assert (surplus(values(shown)) > surplus(q) + 0.05).float().mean() > 0.8


@pytest.mark.parametrize("spec", ALL)
def test_it_drives_alone_and_in_company_alike_under_every_kind_of_attack(spec: str):
    seeds = spawn_seeds("tune", 3)
    agent = open_agent(f"{spec}:{AGENT}", SCENARIO)
    assert agent.name == f"{spec}:shipped:lane-3-density-2/distilled" or agent.name.startswith(spec)
    for attack in ("none", "uniform", "pgd:steps=2,restarts=1", "world:steps=2,restarts=1,horizon=2"):
        together = run_episodes(agent, SCENARIO, seeds, attack)
        alone = run_episodes(open_agent(f"{spec}:{AGENT}", SCENARIO), SCENARIO, seeds[1:2], attack)
        assert together.return_E[1] == pytest.approx(alone.return_E[0], abs=1e-6)
        assert together.has_network
        assert together.kind == "learned"


def test_defences_go_around_memories_filters_each_other_and_onnx(driven: np.ndarray):
    seeds = spawn_seeds("tune", 2)
    for spec in (f"smooth:2:{ROBUST}", f"track:shield:0.1:{AGENT}", f"shield:0.1:smooth:2:purify-pca:8:{AGENT}"):
        assert len(run_episodes(open_agent(spec, SCENARIO), SCENARIO, seeds, "uniform")) == 2
    nested, plain = open_agent(f"smooth:1:track:{ROBUST}", SCENARIO), open_agent(f"track:{ROBUST}", SCENARIO)
    assert (
        run_episodes(nested, SCENARIO, seeds, "uniform").return_E
        == run_episodes(plain, SCENARIO, seeds, "uniform").return_E
    ).all()
    from rapid.agents.shipped import agent_folder

    told = open_agent(f"purify-pca:8:{agent_folder(AGENT) / 'agent.onnx'}", SCENARIO)
    assert offers(told) == ("nothing", "values")
    np.testing.assert_allclose(
        told.q_values(driven[1]), open_agent(f"purify-pca:8:{AGENT}", SCENARIO).q_values(driven[1]), atol=1e-4
    )


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("smooth:0:" + AGENT, "window is 1 to 30"),
        ("smooth:x:" + AGENT, "window is 1 to 30"),
        ("noise-average:nan:" + AGENT, "below 0.5"),
        ("noise-average:-1:" + AGENT, "below 0.5"),
        ("purify-pca:61:" + AGENT, "1 to 60 numbers"),
        ("purify-autoencoder:0:" + AGENT, "1 to 60 numbers"),
        ("average:smooth:3", "does not say what is defended"),
        ("smooth:3", "does not say what is defended"),
        ("average:nothing:3:" + AGENT, "does not say what is defended"),
        ("track:slower", "tells no Q-values"),
        ("track:planner", "tells no Q-values"),
    ],
)
def test_bad_specs_are_refused(spec: str, said: str):
    with pytest.raises(RapidError, match=said):
        open_agent(spec, SCENARIO)


def test_what_does_not_fit_is_refused():
    with pytest.raises(RapidError, match="there is none called lane-3-density-2-fast/random"):
        open_agent(f"purify-pca:8:{AGENT}", "lane-3-density-2-fast")
    with pytest.raises(RapidError, match="neither exported nor certified"):
        network_agent(f"track:{AGENT}")
    with pytest.raises(RapidError, match="reads 5"):
        make_defence(("purify-pca:8",), SCENARIO, 5)
    with pytest.raises(RapidError, match="memory that knows a road of 3 lanes"):
        check_road(open_agent(f"track:{ROBUST}", "lane-4-density-2.5"), "lane-4-density-2.5")
    assert own_scenario([f"shield:0.1:average:smooth:3+track:{AGENT}"]) == SCENARIO
    assert unwrapped("average:smooth:3+track:shield:1m,0.5:x") == (("smooth:3", "track"), "shield:1m,0.5:x")
