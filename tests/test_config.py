import dataclasses
import functools
import math
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rapid import config as settings
from rapid import presets
from rapid.bounds import Bounds, numbers
from rapid.config import Config, NetworkConfig
from rapid.config_io import apply_overrides, load_toml, to_dict, to_toml, validate, weights_about
from rapid.errors import RapidError
from rapid.options import Run
from rapid.parsing import base_settings, parse
from rapid.presets import as_options, preset

PRESETS = [(recipe, scale) for recipe in settings.RECIPES for scale in settings.SCALES]


def fields_without_docs(kind: type) -> list[str]:
    """The fields of a dataclass tree that have no docstring below them in the source."""
    import ast
    import inspect

    body = ast.parse(inspect.getsource(kind)).body[0]
    assert isinstance(body, ast.ClassDef)
    bare = []
    for statement, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and not (
            isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        ):
            bare.append(f"{kind.__name__}.{ast.unparse(statement.target)}")
    return bare


@pytest.mark.parametrize(("recipe", "scale"), PRESETS)
def test_every_preset_is_valid_and_survives_toml(recipe: str, scale: str, tmp_path: Path):
    config = validate(preset(recipe, scale))
    assert (config.recipe, config.scale) == (recipe, scale)
    file = tmp_path / "config.toml"
    file.write_text(to_toml(to_dict(config)))
    assert apply_overrides(preset(), load_toml(file)) == config


def test_the_paper_recipe_is_the_printed_one():
    paper = preset("paper", "full")
    assert (paper.distill.iterations, paper.adapt.steps) == (5_000, 10_000)
    assert paper.distill.optimizer.batch_size == 32
    assert paper.distill.optimizer.target_update == 50
    assert paper.distill.optimizer.target_rate == 1.0
    assert paper.distill.loss.robust_weight == 0.5
    robust = paper.distill.loss.robust
    assert (robust.norm, robust.radius, robust.steps, robust.step_size) == ("l2", 0.1, 10, 0.01)
    assert paper.adapt.loss.robust_weight == paper.adapt.loss.conservative_weight == 0
    assert (paper.mix.p, paper.mix.size) == (0.25, 15_000)
    assert (paper.adapt.exploration_start, paper.adapt.exploration_end, paper.adapt.buffer_size) == (1, 0.05, 100_000)


def test_a_scale_changes_sizes_only():
    sizes = {
        *("scale", "mix.size", "distill.iterations", "distill.evaluate_every", "adapt.steps", "adapt.ppo.steps"),
        *(
            "adapt.ppo.critic_steps",
            "adapt.ppo.num_envs",
            "adapt.buffer_size",
            "adapt.learning_starts",
            "adapt.evaluate_every",
        ),
        *("collect.teacher_transitions", "collect.random_transitions", "collect.lockstep"),
        *(f"evaluate.{name}spawns" for name in ("", "teacher_", "planner_", "curve_")),
    }
    for recipe, plans in presets.OF_RECIPE.items():
        for plan in plans:
            full = preset(recipe, "full", plan)
            for scale in settings.SCALES:
                assert set(presets.differences(full, preset(recipe, scale, plan))) <= sizes


def test_a_plan_changes_phase_3_only():
    for plan in presets.OF_RECIPE["strong"]:
        changed = presets.differences(preset("strong", "full", "careful"), preset("strong", "full", plan))
        assert all(name == "plan" or name.startswith("adapt.") for name in changed)


def test_presets_that_do_not_exist_are_named():
    with pytest.raises(RapidError, match=r"--scale full --plan ppo"):
        preset("strong", "long")
    with pytest.raises(RapidError, match=r"did you mean 'careful'"):
        preset("strong", "full", "carefull")
    with pytest.raises(RapidError, match=r"has no plan 'ppo'"):
        preset("paper", "full", "ppo")


def test_files_from_before_there_were_plans_mean_what_they_did():
    assert presets.of_file({"recipe": "strong", "scale": "long"}).plan == "ppo"
    assert presets.of_file({"recipe": "strong", "scale": "full"}).plan == "careful"
    assert presets.of_file({"recipe": "paper", "scale": "long"}).plan == "printed"
    assert presets.of_file({"recipe": "strong", "scale": "quick"}).plan == "bold"


def test_a_file_that_contradicts_an_option_is_told(tmp_path: Path):
    file = tmp_path / "old.toml"
    file.write_text(to_toml(to_dict(preset("strong", "quick"))))
    with pytest.raises(RapidError, match=r"of the scale 'quick', and --scale says 'tiny'"):
        base_settings(["--config", str(file), "--scale", "tiny"])
    file.write_text("[mix]\nsize = 50\n")
    assert base_settings(["--config", str(file), "--scale", "tiny"]).mix.size == 50


def test_a_file_that_names_a_part_leaves_the_rest_to_the_options(tmp_path: Path):
    file = tmp_path / "some.toml"
    file.write_text('scale = "tiny"\nseed = 7\n')
    # What is written down as the recipe is the recipe that ran.
    found = base_settings(["--config", str(file), "--recipe", "paper"])
    assert found == dataclasses.replace(preset("paper", "tiny"), seed=7)
    file.write_text('recipe = "strong"\n')
    assert base_settings(["--config", str(file), "--scale", "full"]) == preset("strong", "full")
    assert base_settings(["--config", str(file), "--plan", "ppo"]) == preset("strong", "quick", "ppo")


@pytest.mark.parametrize(
    ("names", "overrides"),
    [
        (("strong", "quick", "bold"), {}),
        (("paper", "tiny", "printed"), {"seed": 3, "scenario": "lane-4-density-2.5"}),
        (
            ("strong", "full", "ppo"),
            {
                "data": "my data/of 'today'",
                "tracking": "wandb",
                "teacher": {"model": "--odd", "memory": "a file", "price_in": 0.1 + 0.2},
                "network": {"hidden": [64, 32], "mask_absent": False},
                "adapt": {"mirror": True, "freeze_decoder": True, "loss": {"robust": {"radius": 1e-9}}},
                "evaluate": {"attacks": ["none"], "spawns": 3},
            },
        ),
    ],
)
def test_the_command_that_repeats_a_run_gives_its_settings(names: tuple[str, ...], overrides: dict[str, Any]):
    config = apply_overrides(preset(*names), overrides)
    words = shlex.split(shlex.join(as_options(config)))
    assert parse("run", {"run": Run}, words)[1] == config


def test_every_field_has_a_docstring():
    kinds = [kind for kind in vars(settings).values() if dataclasses.is_dataclass(kind) and kind is not Bounds]  # pyright: ignore[reportUnnecessaryComparison]
    assert len(kinds) > 8
    assert [name for kind in kinds for name in fields_without_docs(kind)] == []  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"distil": {}}, "did you mean 'distill'"),
        ({"distill": {"loss": {"discont": 1}}}, "distill.loss.discont"),
        ({"distill": {"loss": 3}}, "must be a table"),
        ({"seed": "0"}, "of type int"),
        ({"seed": True}, "of type int"),
        ({"seed": 1.5}, "of type int"),
        ({"network": {"kind": "mpl"}}, "did you mean 'mlp'"),
        ({"network": {"hidden": [1, "2"]}}, "network.hidden"),
        ({"evaluate": {"attacks": "pgd"}}, "must be a list"),
    ],
)
def test_wrong_settings_are_named(overrides: dict[str, Any], says: str):
    with pytest.raises(RapidError) as error:
        apply_overrides(preset(), overrides, source="my.toml")
    assert says in str(error.value)
    assert "my.toml" in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "setting"),
    [
        ({"network": {"top_k": 3}}, "network.top_k"),
        ({"network": {"num_policies": 0}}, "network.num_policies"),
        ({"network": {"width": 31, "heads": 2}}, "network.width"),
        ({"mix": {"p": 1.5}}, "mix.p"),
        ({"mix": {"p": float("nan")}}, "mix.p"),
        ({"adapt": {"offline_share": 1.0}}, "adapt.offline_share"),
        ({"adapt": {"exploration_start": 1.5}}, "adapt.exploration_start"),
        ({"adapt": {"exploration_end": -0.1}}, "adapt.exploration_end"),
        ({"adapt": {"exploration_hold": 0}}, "adapt.exploration_hold"),
        ({"adapt": {"steps": 0}}, "adapt.steps"),
        ({"adapt": {"ppo": {"steps": 100}}}, "adapt.ppo.steps"),
        ({"adapt": {"ppo": {"trace": 1.1}}}, "adapt.ppo.trace"),
        ({"adapt": {"ppo": {"crash_penalty": -1.0}}}, "adapt.ppo.crash_penalty"),
        ({"adapt": {"ppo": {"temperature": 0.0}}}, "adapt.ppo.temperature"),
        ({"adapt": {"loss": {"munchausen_weight": 1.0}}}, "adapt.loss.munchausen_weight"),
        ({"distill": {"loss": {"munchausen_temperature": 0.0}}}, "distill.loss.munchausen_temperature"),
        ({"distill": {"loss": {"discount": -0.1}}}, "distill.loss.discount"),
        ({"adapt": {"optimizer": {"target_rate": 0.0}}}, "adapt.optimizer.target_rate"),
        ({"adapt": {"scenario": "lane-x"}}, "scenario"),
        ({"collect": {"max_cost": float("inf")}}, "collect.max_cost"),
        ({"network": {"width": 0}}, "network.width"),
        ({"distill": {"iterations": 0}}, "distill.iterations"),
        ({"evaluate": {"attacks": []}}, "evaluate.attacks"),
    ],
)
def test_impossible_numbers_are_refused(overrides: dict[str, Any], setting: str):
    with pytest.raises(RapidError) as error:
        validate(apply_overrides(preset(), overrides))
    assert setting in str(error.value)


def test_an_agent_may_be_mirrored_without_training_it():
    validate(apply_overrides(preset(), {"adapt": {"steps": 0, "mirror": True}}))


def test_integers_widen_to_floats_and_lists_to_tuples():
    config = apply_overrides(preset(), {"mix": {"p": 1}, "network": {"hidden": [8, 8]}})
    assert isinstance(config.mix.p, float)
    assert config.network.hidden == (8, 8)


@pytest.mark.parametrize(("recipe", "scale"), [("papr", "quick"), ("paper", "huge")])
def test_unknown_presets(recipe: str, scale: str):
    with pytest.raises(RapidError, match="Unknown"):
        preset(recipe, scale)


def test_files_that_cannot_be_read(tmp_path: Path):
    with pytest.raises(RapidError, match="Cannot read"):
        load_toml(tmp_path / "none.toml")
    bad = tmp_path / "bad.toml"
    bad.write_text("a = = 1")
    with pytest.raises(RapidError, match="not valid TOML"):
        load_toml(bad)
    bad.write_bytes(b"\xff\xfe")
    with pytest.raises(RapidError, match="Cannot read"):
        load_toml(bad)


toml_values = st.recursive(
    st.one_of(st.booleans(), st.integers(-(2**53), 2**53), st.floats(allow_nan=False), st.text()),
    lambda inner: st.dictionaries(st.from_regex(r"[a-z_]{1,6}", fullmatch=True), inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(st.from_regex(r"[a-z_]{1,6}", fullmatch=True), toml_values, max_size=5))
def test_toml_round_trip(tree: dict[str, Any]):
    assert tomllib.loads(to_toml(tree)) == tree


def test_the_tree_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset().seed = 1  # pyright: ignore[reportAttributeAccessIssue]
    assert isinstance(preset(), Config)


def test_every_number_has_bounds_and_the_defaults_lie_within():
    from rapid.verbs import VERBS

    def bare(settings: Any) -> list[str]:
        return [name for name, number, bounds in numbers(settings) if bounds is None or not bounds.hold(number)]

    assert len(list(numbers(Config()))) > 70
    assert bare(Config()) == []
    for kind, _, _ in VERBS.values():
        given = [item.name for item in dataclasses.fields(kind) if item.default is dataclasses.MISSING]
        required = [
            name
            for name in given
            if kind.__dataclass_fields__[name].default_factory is dataclasses.MISSING  # no default at all
        ]
        assert bare(kind(**dict.fromkeys(required, ""))) == [], kind


# What takes time but no memory, or counts something that is not held.
ENDLESS = {
    *("iterations", "steps", "adversary_steps", "evaluate_every", "learning_starts", "critic_steps", "epochs"),
    *("exploration_hold", "target_update", "max_tokens", "max_decisions", "max_retries"),
}


def test_every_size_that_takes_memory_has_an_upper_bound():
    from rapid.verbs import VERBS

    trees: list[Any] = [Config()]
    for kind, _, _ in VERBS.values():
        given = {
            item.name: ""
            for item in dataclasses.fields(kind)
            if item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
        }
        trees.append(kind(**given))
    bare = {
        f"{type(tree).__name__}: {name}"
        for tree in trees
        for name, number, bounds in numbers(tree)
        if isinstance(number, int) and (bounds is None or math.isinf(bounds.high))
        if name.rpartition(".")[2] not in ENDLESS
    }
    assert bare == {"VerifySimulator: episodes"}  # driven one after another


@pytest.mark.parametrize("name", sorted({name for name, _, _ in numbers(Config())}))
def test_every_size_beyond_its_upper_bound_is_refused_by_name(name: str):
    bounds = next(bounds for each, _, bounds in numbers(Config()) if each == name)
    assert bounds is not None
    if math.isinf(bounds.high):
        return
    *path, last = name.split(".")
    kind = type(getattr(functools.reduce(getattr, path, Config()), last))
    above: Any = (int(bounds.high) + 1,) if kind is tuple else kind(bounds.high + 1)
    overrides: Any = functools.reduce(lambda found, key: {key: found}, reversed(path), {last: above})
    with pytest.raises(RapidError, match=f"'{re.escape(name)}'"):
        validate(apply_overrides(Config(), overrides))


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ({"network": {"width": 16384}}, "network.width"),
        ({"network": {"num_policies": 200, "layers": 100, "width": 512, "heads": 8}}, "network.width"),
        ({"network": {"kind": "mlp", "hidden": [16384, 16384]}}, "network.hidden"),
        ({"network": {"kind": "mlp-mixture", "hidden": [4096] * 5, "num_policies": 2}}, "network.hidden"),
        ({"adapt": {"ppo": {"rollout": 100_000, "num_envs": 1000}}}, "adapt.ppo.rollout"),
    ],
)
def test_sizes_that_multiply_are_refused_before_anything_is_allocated(overrides: dict[str, Any], name: str):
    with pytest.raises(RapidError, match=f"'{re.escape(name)}'"):
        validate(apply_overrides(Config(), overrides))


@pytest.mark.parametrize("kind", ["rapid", "attentive", "mlp", "mlp-mixture"])
def test_weights_are_counted_about_right(kind: Any):
    from rapid.networks.q_network import QNetwork

    network = NetworkConfig(kind=kind, width=128, heads=4, layers=3, feedforward=256, num_policies=3)
    made = sum(weight.numel() for weight in QNetwork(network, lanes=3).parameters())
    assert 0.8 < weights_about(network) / made < 1.2


@pytest.mark.parametrize("name", sorted({name for name, _, _ in numbers(Config())}))
def test_every_number_beyond_its_bounds_is_refused_by_name(name: str):
    bounds = next(bounds for each, _, bounds in numbers(Config()) if each == name)
    assert bounds is not None
    below = bounds.low if bounds.open_low else bounds.low - 1
    *path, last = name.split(".")
    inner = functools.reduce(getattr, path, Config())
    kind = type(getattr(inner, last))
    wrong: Any = (int(below),) if kind is tuple else kind(below)
    overrides: Any = functools.reduce(lambda found, key: {key: found}, reversed(path), {last: wrong})
    with pytest.raises(RapidError, match=f"'{re.escape(name)}'"):
        validate(apply_overrides(Config(), overrides))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_are_not_finite_are_refused(bad: float):
    with pytest.raises(RapidError, match="finite"):
        validate(dataclasses.replace(Config(), mix=dataclasses.replace(Config().mix, p=bad)))
