"""Presets of attacks."""

import pytest

from rapid.attacks.spec import NAMED, parse_attack
from rapid.attacks.suite import PRESETS, RADII, STRONG, expand
from rapid.errors import RapidError


def test_the_papers_preset_is_the_papers():
    assert [spec.name for spec in expand(["paper"])] == ["none", "uniform", "gaussian", "fgsm", "pgd"]


def test_the_suite_holds_every_strong_attack_within_one_ball_and_noise_of_twice_its_size():
    clean, *members, noise = expand(["suite:radius=0.05,ego=trusted"])
    assert clean == NAMED["none"]
    assert len(members) == len(STRONG)
    assert {(spec.radius, spec.ego, spec.presence) for spec in members} == {(0.05, "trusted", "masked")}
    assert {spec.loss for spec in members if spec.kind == "pgd"} == {"ce", "margin", "dlr", "min-q", "mad"}
    assert all(spec.steps == 50 and spec.restarts == 5 for spec in members if spec.kind == "pgd")
    assert {spec.target for spec in members if spec.kind == "directed"} == {"faster", "idle", "sideways", "slower"}
    assert {spec.kind for spec in members} == {"pgd", "directed", "square", "lie", "coupled", "world", "adversary"}
    assert (noise.kind, noise.radius) == ("uniform", 0.1)


def test_sensor_errors_are_told_in_metres():
    _, *members, noise = expand(["sensor"])
    assert {(spec.metres, spec.speed) for spec in members} == {(1.0, 0.5)}
    assert (noise.metres, noise.speed) == (2.0, 1.0)


def test_four_columns_and_a_sweep():
    columns = expand(["columns"])
    kinds = {(spec.presence, spec.ego) for spec in columns if spec.kind == "world"}
    assert kinds == {(presence, ego) for presence in ("masked", "free") for ego in ("free", "trusted")}
    assert sorted({spec.radius for spec in expand(["sweep:ego=trusted"])[1:]}) == list(RADII)


def test_texts_and_presets_mix_and_nothing_is_made_twice():
    specs = expand(["none", "suite", "pgd", "pgd:loss=margin", "suite"])
    assert len(specs) == len(set(specs))
    assert specs[-1] == NAMED["pgd"]
    assert all(parse_attack(spec.name) == spec for name in PRESETS for spec in expand([name]))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("suit", "did you mean 'suite'"),
        ("fsgm", "did you mean 'fgsm'"),
        ("suite:steps=3", "has the option 'steps'"),
        ("suite:radius=-1", "radius is -1"),
        ("suite:", "no option after the colon"),
        ("sensor:radius=1", "one of the two"),
    ],
)
def test_mistakes_are_explained(text, match):
    with pytest.raises(RapidError, match=match):
        expand([text])
