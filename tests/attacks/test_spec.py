"""Specs of attacks: a text for each, read back as the same; mistakes are explained before anything is driven."""

import dataclasses
import math
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rapid.attacks.spec import KINDS, NAMED, AttackSpec, defaults_of, fields_of, parse_attack, with_options
from rapid.errors import RapidError

FLOATS = st.floats(0, 10, allow_nan=False)
VALUES = {
    "norm": st.sampled_from(["linf", "l2"]),
    "radius": FLOATS,
    "metres": FLOATS,
    "speed": FLOATS,
    "presence": st.sampled_from(["masked", "free"]),
    "ego": st.sampled_from(["free", "trusted"]),
    "steps": st.integers(1, 10_000),
    "step": FLOATS,
    "restarts": st.integers(1, 1000),
    "start": st.sampled_from(["clean", "random"]),
    "loss": st.sampled_from(["ce", "margin", "dlr", "min-q", "mad"]),
    "keep": st.sampled_from(["best", "last"]),
    "target": st.sampled_from(["faster", "idle", "sideways", "slower"]),
    "to": st.sampled_from(["far", "near", "left", "right", "drawn"]),
    "queries": st.integers(1, 1000),
    "coupling": st.floats(0, 2),
}


@st.composite
def specs(draw):
    kind = draw(st.sampled_from(KINDS))
    fields = [key for key in fields_of(kind) if key in VALUES]
    some = draw(st.lists(st.sampled_from(fields), unique=True)) if fields else []
    changes = {key: draw(VALUES[key]) for key in some}
    if changes.get("norm") == "l2" or "radius" in changes:
        changes = {key: value for key, value in changes.items() if key not in ("metres", "speed")}
    if "source" in fields_of(kind):
        changes["source"] = draw(st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), min_size=1))
    return AttackSpec(kind, **(defaults_of(kind) | changes))


@given(specs())
def test_every_spec_has_a_text_that_is_read_back_as_the_same(spec):
    assert parse_attack(spec.name) == spec
    assert parse_attack(f" {spec.name} ").name == spec.name


def test_the_papers_four_keep_their_names_and_what_they_were():
    assert list(NAMED) == ["none", "uniform", "gaussian", "fgsm", "pgd"]
    for name, spec in NAMED.items():
        assert parse_attack(name) == spec
        assert spec.name == name
        assert (spec.presence, spec.ego, spec.norm) == ("masked", "free", "linf")
    pgd = parse_attack("pgd")
    assert (pgd.steps, pgd.step, pgd.radius, pgd.restarts, pgd.start, pgd.keep) == (10, 0.01, 0.1, 1, "clean", "last")
    assert parse_attack("uniform").radius == parse_attack("gaussian").radius == 0.2


def test_options_change_what_they_name_and_nothing_else():
    spec = parse_attack("pgd:steps=50, restarts=5, radius=0.02, loss=margin")
    assert spec == AttackSpec("pgd", steps=50, restarts=5, radius=0.02, loss="margin")
    assert spec.keep == "best"
    assert parse_attack("pgd:steps=50").name == "pgd:steps=50"  # not the paper's
    assert parse_attack("transfer:runs/a b,ego=trusted").source == "runs/a b"
    assert with_options(spec, "ego=trusted") == dataclasses.replace(spec, ego="trusted")


def test_a_label_is_no_part_of_the_identity():
    spec = AttackSpec("uniform", radius=0.05, label="a little")
    assert spec == AttackSpec("uniform", radius=0.05)
    assert hash(spec) == hash(AttackSpec("uniform", radius=0.05))
    assert (spec.shown, spec.name) == ("a little", "uniform:radius=0.05")


def test_sizes_are_told_in_metres():
    assert NAMED["pgd"].describe(5) == "L∞ ball of radius 0.1 (20 m along, 2 m across, 8 m/s), 10 steps of 0.01"
    assert parse_attack("uniform:presence=free").describe(3) == (
        "uniform within ±0.2 (40 m along, 2.4 m across, 16 m/s), presence too"
    )
    sensor = parse_attack("pgd:metres=1,speed=0.5,ego=trusted")
    assert sensor.units(3) == "1 m along, 1 m across, 0.5 m/s, the ego's own row true"
    assert sensor.sizes(5) == (1, 1, 1, 0.5, 0.5)
    shifted = parse_attack("lie:to=near,moves=along,ego=trusted")
    assert shifted.units(4) == "0.1 (20 m along), the ego's own row true"
    assert shifted.sizes(4) == pytest.approx((0.1, 20, 0, 0, 0))
    assert parse_attack("pgd:moves=speed").units(4) == "0.1 (8 m/s)"
    assert NAMED["fgsm"].sizes(4) == pytest.approx((0.1, 20, 1.6, 8, 8))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("fsgm", "did you mean 'fgsm'"),
        ("pgd:lss=ce", "did you mean 'loss'"),
        ("pgd:loss=marge", "did you mean 'margin'"),
        ("pgd:moves=allong", "did you mean 'along'"),
        ("pgd:radius=-0.1", r"radius is -0\.1.*from 0 to 10"),
        ("pgd:radius=nan", "radius is nan.*finite"),
        ("uniform:radius=inf", "radius is inf.*finite"),
        ("pgd:steps=0", "steps is 0"),
        ("pgd:steps=1.5", "a whole number"),
        ("pgd:radius=x", "must be a number"),
        ("pgd:steps", "name=value"),
        ("pgd:", "no option after the colon"),
        ("pgd:steps=5,steps=6", "twice"),
        ("pgd:radius=0.1,metres=1", "one of the two"),
        ("pgd:norm=l2,metres=1", "half widths of a box"),
        ("uniform:steps=3", "attack of kind 'uniform' has radius"),
        ("none:radius=1", "has no options"),
        ("transfer", "needs a source: write transfer:DIRECTORY"),
        ("lie:to=nea", "did you mean 'near'"),
        ("square:norm=l2", "attack of kind 'square' has loss, queries"),
    ],
)
def test_mistakes_are_explained(text, match):
    with pytest.raises(RapidError, match=match):
        parse_attack(text)


def test_a_spec_made_in_code_is_checked_as_well():
    with pytest.raises(RapidError, match="radius is nan"):
        AttackSpec("pgd", radius=math.nan)
    with pytest.raises(RapidError, match=r"kind 'uniform' has no steps"):
        AttackSpec("uniform", steps=3)
    with pytest.raises(RapidError, match="kind cannot be 'pdg'; did you mean 'pgd'"):
        AttackSpec("pdg")


def test_naming_an_attack_imports_nothing_heavy():
    heavy = "{'torch', 'numpy', 'numba'} & set(sys.modules)"
    code = f"import sys, rapid.attacks as attacks; attacks.parse_attack('pgd'); assert not {heavy}"
    subprocess.run([sys.executable, "-c", code], check=True)
