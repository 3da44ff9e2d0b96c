"""Directed, gradient-free, transferred, constant and coupled attacks."""

import numpy as np
import pytest
import torch

from rapid.agents.saved import save_agent
from rapid.attacks import NAMED, get_attack, parse_attack
from rapid.attacks.attack import Field, Moment, offers
from rapid.attacks.directed import ORDERS, reachable
from rapid.attacks.search import Ball, Runs, own_action
from rapid.attacks.spec import KINDS, MOVED
from rapid.config import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.encoding import feature_scale
from rapid.networks.q_network import QNetwork, build_network
from rapid.scenarios import FASTER, FEATURES, SLOWER

SCALE = feature_scale(3)
FEW = {"pgd": "steps=4", "directed": "steps=4", "square": "queries=20", "transfer": "steps=4", "coupled": "steps=4"}


def undecided() -> QNetwork:
    """Return a network that prefers now this action, now that one."""
    network = build_network(NetworkConfig(width=16, heads=2, feedforward=32), 3, 2)
    obs = torch.rand(256, 15, 5, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 400, 12, 32, 2])
    with torch.no_grad():
        network.head.decoder.head.bias -= network(obs).mean(0)
    return network


NETWORK = undecided()


def sources(count):
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agents") / "other"
    save_agent(folder, build_network(NetworkConfig(kind="mlp", hidden=(16,)), 3, 1), {"name": "other"})
    return {kind: f"{kind}:{folder}" if kind == "transfer" else kind for kind in KINDS}


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("world", "adversary")])
@pytest.mark.parametrize(
    "options",
    ["", "presence=free", "ego=trusted", "radius=0.03", "metres=1,speed=0.5", "radius=0", "moves=along", "moves=speed"],
)
def test_every_kind_shows_a_point_of_its_ball_and_leaves_the_rest_true(roads, texts, kind, options):
    obs, text = roads(6), texts[kind]
    if options and kind == "none":
        pytest.skip("has no options")
    words = [word for word in (options, FEW.get(kind, "")) if word]
    attack = get_attack(f"{text}{',' if ':' in text else ':'}{','.join(words)}" if words else text)
    before, spec = obs.clone(), attack.spec
    with torch.inference_mode():
        seen = attack(NETWORK, obs, sources(6))
    assert torch.equal(obs, before)
    assert (seen.shape, seen.dtype, seen.requires_grad) == (obs.shape, torch.float32, False)
    if spec.presence == "masked":
        assert torch.equal(seen[..., 0], obs[..., 0])
    if spec.ego == "trusted":
        assert torch.equal(seen[:, 0], obs[:, 0])
    if spec.moves != "all":
        stay = [FEATURES.index(feature) for feature in FEATURES if feature not in MOVED[spec.moves]]
        assert torch.equal(seen[..., stay], obs[..., stay])
        assert not torch.equal(seen, obs)
    if kind not in ("none", "gaussian"):
        room = torch.tensor(spec.sizes(3)) + 1e-4  # float32 metres far down the road
        assert ((seen - obs).abs() <= room).all()
    if kind == "none" or options == "radius=0":
        assert torch.equal(seen, obs)


def test_a_directed_attack_gets_its_action_wherever_the_ball_reaches_it(roads):
    obs = roads(32)
    own = own_action(NETWORK, obs, "ce").action_B
    for target, order in ORDERS.items():
        taken = NETWORK(get_attack(f"directed:target={target},steps=8,restarts=1")(NETWORK, obs, sources(32))).argmax(1)
        rank = torch.tensor(np.argsort(order))
        assert (rank[taken] <= rank[own]).all()
        assert sorted(order) == [0, 1, 2, 3, 4]
        assert (rank[taken] < rank[own]).any()
    within, points = reachable(
        NETWORK, obs, Ball("linf", 0.1, SCALE.repeat(15, 1)), Runs(8, 0.0, stop=True), sources(32)
    )
    assert within[torch.arange(32), own].all()
    for action in range(5):
        rows = within[:, action]
        assert (NETWORK(points[rows, action]).argmax(1) == action).all()
    faster = NETWORK(get_attack("directed:target=faster,presence=free,steps=8")(NETWORK, obs, sources(32))).argmax(1)
    assert (faster == FASTER).sum() >= (own == FASTER).sum()


def test_a_constant_agent_cannot_be_led_anywhere(roads):
    obs = roads(5)

    def slower(x):
        return torch.eye(5)[SLOWER] + 0 * x.sum((1, 2))[:, None]

    within, _ = reachable(slower, obs, Ball("linf", 0.1, SCALE.repeat(15, 1)), Runs(3, 0.0, stop=True), sources(5))
    assert within.sum(0).tolist() == [0, 0, 0, 0, 5]
    assert torch.equal(get_attack("directed", 3)(slower, obs, sources(5)), obs)


def test_search_without_gradients_finds_what_masked_gradients_hide(roads):
    obs = roads(12)

    def rounded(x):  # staircase values: their gradient is 0 everywhere
        return NETWORK((x / 4).round() * 4).detach() + 0 * x.sum()

    own = own_action(rounded, obs, "margin")
    loss = {
        text: own(rounded(get_attack(text, 3)(rounded, obs, sources(12)))) for text in ("pgd:loss=margin", "square")
    }
    clean = own(own.true_q_BA)
    assert (loss["square"] >= clean).all()
    assert loss["square"].mean() > loss["pgd:loss=margin"].mean()
    assert (own.reached(rounded(get_attack("square", 3)(rounded, obs, sources(12))))).any()
    more = own(rounded(get_attack("square:queries=300", 3)(rounded, obs, sources(12))))
    assert more.mean() >= loss["square"].mean() - 1e-3


def test_a_transferred_attack_asks_nothing_of_the_agent(roads, texts):
    attack = get_attack(texts["transfer"] + ",steps=5")
    obs = roads(8)
    assert attack.needs == "nothing"
    seen = attack(None, obs, sources(8))
    assert not torch.equal(seen, obs)
    with pytest.raises(RapidError, match="no saved agent"):
        get_attack("transfer:nowhere")


def shown_in_episodes(text, obs_TBVF, seed=0):
    show = get_attack(text, 3).begin(
        Field(None, [torch.Generator().manual_seed(seed + i) for i in range(len(obs_TBVF[0]))])
    )
    return torch.stack([show(Moment(obs, np.arange(len(obs)), NETWORK)) for obs in obs_TBVF])


def test_a_lie_is_the_same_in_every_step(roads):
    obs = torch.stack([roads(4), roads(8)[4:], roads(12)[8:]])
    for to in ("far", "near", "left", "right", "drawn"):
        moved = (shown_in_episodes(f"lie:to={to}", obs) - obs) / SCALE
        assert torch.allclose(moved[0], moved[2], atol=1e-4), to
    far = (shown_in_episodes("lie:to=far", obs) - obs)[0, 0]
    assert far[1:, 1].tolist() == pytest.approx([20] * 14, abs=0.01)
    assert far[0, 1].item() == pytest.approx(-20, abs=0.01)  # a gap is wrong by 40 m
    assert far[:, 2].abs().max() == 0
    drawn = [shown_in_episodes("lie:to=drawn", obs, seed) for seed in (0, 0, 9)]
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert not torch.allclose(drawn[0][0, 0] - obs[0, 0], drawn[0][0, 1] - obs[0, 1], atol=1)


def test_a_coupled_attack_changes_little_from_one_step_to_the_next(roads):
    obs = torch.stack([roads(6)] * 4)
    moved = (shown_in_episodes("coupled:steps=10,restarts=2", obs) - obs) / SCALE
    change = torch.cat([moved[:1], moved.diff(dim=0)])
    assert (change.abs() <= 0.02 + 1e-5).all()
    assert moved[3].abs().max() > 0.05
    free = (shown_in_episodes("coupled:coupling=2,steps=10,restarts=2", obs) - obs) / SCALE
    assert free[0].abs().max() > 0.09


def test_what_an_agent_offers_decides_which_attacks_can_be_made(roads, texts):
    class Valued:
        def q_values(self, obs):
            return NETWORK(torch.from_numpy(obs)).detach().numpy()

    class Bound:
        network = NETWORK

        def bind(self, env): ...

    assert offers(Valued()) == ("nothing", "values")
    assert offers(object()) == ("nothing",)
    assert offers(Bound()) == ()
    needs = {kind: get_attack(text).needs for kind, text in texts.items()}
    assert {kind for kind, need in needs.items() if need == "gradient"} == {
        "fgsm", "pgd", "directed", "coupled", "adversary"
    }  # fmt: skip
    assert {kind for kind, need in needs.items() if need == "nothing"} == {
        "none", "uniform", "gaussian", "transfer", "lie"
    }  # fmt: skip
    assert list(NAMED) == ["none", "uniform", "gaussian", "fgsm", "pgd"]
    assert all(parse_attack(text).describe(3) for text in texts.values())
