"""Files that are damaged, edited or hostile: whatever is in them, what comes is one paragraph or what they say."""

import contextlib
import json
import math
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from fake_worlds import fake_transitions
from rapid.agents.saved import load_agent, save_agent
from rapid.config import Config, NetworkConfig, TeacherConfig
from rapid.config_io import apply_overrides, load_toml, validate
from rapid.data.dataset import Dataset, load_dataset, save_dataset
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow
from rapid.evaluation.recording import load_recordings
from rapid.files import content_hash, read_json, sha256, write_json
from rapid.networks.q_network import build_network
from rapid.report import ReportData, write_figures
from rapid.runs import RunDirectory
from rapid.teacher.replay import Replay

ODD = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from([-1, 0, 2**70, 1e308]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=5,
)
"""Any JSON value, and numbers that JSON writes but has no name for."""
FUZZ = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths to everything in a JSON value."""
    found = [path] if path else []
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in inner:
        found += places(item, (*path, key))
    return found


def changed(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Return a copy of a JSON value with another one at a path; `...` removes it."""
    copy = json.loads(json.dumps(value))
    at = copy
    for key in path[:-1]:
        at = at[key]
    if new is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = new
    return copy


@contextlib.contextmanager
def explained():
    """Whatever is raised in the block is explained in one paragraph."""
    with contextlib.suppress(RapidError):
        yield


@pytest.fixture(scope="module")
def agent(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("agents") / "agent"
    config = NetworkConfig(width=8, heads=2, layers=1, feedforward=8, hidden=(16,))
    save_agent(folder, build_network(config, 3, 0), {"name": "ours", "scenario": "lane-3-density-2"})
    return folder


def damaged_json(path: Path, data: st.DataObject) -> None:
    """Change one value in a record, and let it vouch for itself, as somebody would who edits it with care."""
    record = read_json(path)
    where = data.draw(st.sampled_from(places(record)))
    new = data.draw(ODD | st.just(...))
    path.write_text(json.dumps(changed(record, where, new)))


@FUZZ
@given(data=st.data())
def test_any_value_in_an_agents_record(agent, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("copy") / "agent"
    shutil.copytree(agent, folder)
    damaged_json(folder / "config.json", data)
    with explained():
        loaded = load_agent(folder)
        assert loaded.act(np.zeros((1, loaded.vehicles, 5), np.float32)).shape == (1,)
        assert loaded.name.isprintable()


@pytest.mark.parametrize(
    ("section", "changes"),
    [
        ("network", {"width": 2**40, "heads": 1}),
        ("network", {"layers": 10**9}),
        ("network", {"hidden": [2**40], "kind": "mlp"}),
        ("network", {"feedforward": -3}),
        ("network", {"num_policies": 10**9}),
    ],
)
def test_a_network_too_large_for_its_weights_is_refused_before_anything_is_allocated(agent, tmp_path, section, changes):
    folder = tmp_path / "agent"
    shutil.copytree(agent, folder)
    record = read_json(folder / "config.json")
    record[section] |= changes
    write_json(folder / "config.json", record, sealed=True)
    with pytest.raises(RapidError, match=r"do not fit|no network can be made|must be"):
        load_agent(folder)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_weights_that_are_not_finite_are_refused(agent, tmp_path, number):
    folder = tmp_path / "agent"
    shutil.copytree(agent, folder)
    weights = load_file(folder / "weights.safetensors")
    key = next(key for key, value in weights.items() if value.numel() > 5)
    weights[key].view(-1)[3] = number
    _reseal(folder, weights)
    with pytest.raises(RapidError, match="not all finite"):
        load_agent(folder)


def test_weights_of_another_type_or_shape_are_refused(agent, tmp_path):
    folder = tmp_path / "agent"
    shutil.copytree(agent, folder)
    weights = load_file(folder / "weights.safetensors")
    first = next(key for key, value in weights.items() if value.ndim == 2)
    for wrong in (weights[first].double(), weights[first][:1], torch.zeros(1)):
        _reseal(folder, weights | {first: wrong.contiguous()})
        with pytest.raises(RapidError, match="do not fit the network"):
            load_agent(folder)


def _reseal(folder: Path, weights: dict[str, torch.Tensor]) -> None:
    save_file(weights, folder / "weights.safetensors")
    record = read_json(folder / "config.json")
    write_json(folder / "config.json", record | {"weights_sha256": sha256(folder / "weights.safetensors")}, sealed=True)


@FUZZ
@given(data=st.data())
def test_any_bytes_in_weights(agent, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("copy") / "agent"
    shutil.copytree(agent, folder)
    path = folder / "weights.safetensors"
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(len(content) - 1, 3000)))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    write_json(
        folder / "config.json", read_json(folder / "config.json") | {"weights_sha256": sha256(path)}, sealed=True
    )
    with explained():
        load_agent(folder)


@FUZZ
@given(data=st.data())
def test_any_value_in_a_datasets_record(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("dataset")
    save_dataset(Dataset("lane-3-density-2", fake_transitions(3), {"teacher": {"name": "fake"}}), folder)
    damaged_json(folder / "dataset.json", data)
    with explained():
        loaded = load_dataset(folder)
        assert loaded.teacher_share is None or 0 <= loaded.teacher_share <= 1
        assert isinstance(loaded.known, int)


@FUZZ
@given(data=st.data())
def test_any_value_in_a_runs_manifest(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("run")
    RunDirectory(folder, Config(), ("collect",))
    damaged_json(folder / "run.json", data)
    with explained():
        RunDirectory(folder, Config(), ("collect",))


@FUZZ
@given(
    text=st.text(max_size=60)
    | st.binary(max_size=40)
    | st.sampled_from(
        ["seed = 1979-05-27", "seed = [1, 'a']", "[collect]\n[collect]", "threads = 1e400", "x = " + "[" * 5000]
    )
    | st.tuples(
        st.sampled_from(["seed", "threads", "scenario", "network.width", "mix.p", "evaluate.attacks"]), ODD
    ).map(lambda pair: f"{pair[0]} = {json.dumps(pair[1])}")
)
def test_any_settings_file(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("toml") / "my.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    with explained():
        validate(apply_overrides(Config(), load_toml(path)))


DECISION = {"action": 1, "explanation": "", "answer": "idle", "prompt_hash": "ab", "status": "ok", "retries": 0}


@FUZZ
@given(data=st.data())
def test_any_value_in_a_recording(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("replay") / "said.jsonl"
    line = json.dumps(changed(DECISION, data.draw(st.sampled_from(places(DECISION))), data.draw(ODD | st.just(...))))
    line = data.draw(st.sampled_from([line, line[:-3], "[]", "[" * 5000, "\x00", json.dumps(DECISION) + line]))
    path.write_text(line, errors="surrogatepass")
    with explained():
        Replay(TeacherConfig(backend="replay", replay_file=str(path)), 3)
    with explained():
        load_recordings(path)


@pytest.mark.parametrize("seed", range(30))
def test_any_bytes_in_parquet(tmp_path, seed):
    save_dataset(Dataset("lane-3-density-2", fake_transitions(3), {"teacher": {"name": "fake"}}), tmp_path)
    path, rng = tmp_path / "transitions.parquet", random.Random(seed)
    content = bytearray(path.read_bytes())
    for _ in range(rng.randint(1, 5)):
        content[rng.randrange(len(content))] = rng.randrange(256)
    path.write_bytes(content)
    record = read_json(tmp_path / "dataset.json")
    record["files"]["transitions.parquet"] |= {"bytes": len(content), "sha256": sha256(path)}
    write_json(tmp_path / "dataset.json", record, sealed=True)
    with explained():
        load_dataset(tmp_path)


def test_parquet_with_other_columns(tmp_path):
    save_dataset(Dataset("lane-3-density-2", fake_transitions(3), {"teacher": {"name": "fake"}}), tmp_path)
    path = tmp_path / "transitions.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["reward"]), path)
    record = read_json(tmp_path / "dataset.json")
    record["files"]["transitions.parquet"] |= {"bytes": path.stat().st_size, "sha256": sha256(path)}
    write_json(tmp_path / "dataset.json", record, sealed=True)
    with pytest.raises(RapidError, match="other columns"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("name", ["$x", "$\\frac{", "a$b$c_{", "\\", "{%^_&#}", "漢字", "x" * 300])
def test_names_are_no_formulas(tmp_path, name):
    row = EpisodeRow("lane-3-density-2", name, 1, "none", 20.0, 30, False, 25.0, 700.0, 1, 3.0, (0.2,) * 5)
    paths = write_figures(ReportData(title=name, rows=[row, row]), tmp_path)
    assert paths
    assert all(path.stat().st_size > 1000 for path in paths)


def test_a_name_with_control_characters_is_shown_without(agent, tmp_path):
    folder = tmp_path / "agent"
    shutil.copytree(agent, folder)
    record = read_json(folder / "config.json")
    record["metadata"]["name"] = "\x1b]0;pwned\x07good\x9b31m" + "x" * 500
    write_json(folder / "config.json", record, sealed=True)
    name = load_agent(folder).name
    assert "\x1b" not in name
    assert "\x9b" not in name
    assert len(name) <= 100


def onnx_model(path: Path, last: str = "Identity", metadata: str | None = None, kind: int = 1) -> None:
    """Write a model that reads observations and returns their first five numbers, after one more operation."""
    onnx = pytest.importorskip("onnx")
    helper = onnx.helper
    flat = helper.make_tensor_value_info("obs", 1, ["batch", 75])
    q = helper.make_tensor_value_info("q", kind, ["batch", 5])
    bounds = [helper.make_tensor(name, 7, [1], [value]) for name, value in (("a", 0), ("b", 5), ("c", 1))]
    nodes = [helper.make_node("Slice", ["obs", "a", "b", "c"], ["five"])]
    nodes.append(helper.make_node(last, ["five"], ["q"], **({"to": kind} if last == "Cast" else {})))
    graph = helper.make_graph(nodes, "g", [flat], [q], bounds)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if metadata is not None:
        helper.set_model_props(model, {"rapid": metadata})
    onnx.save(model, str(path))


@pytest.mark.parametrize(
    ("last", "kind", "says"), [("Log", 1, "not all finite"), ("Cast", 11, "float64"), ("Cast", 7, "int64")]
)
def test_what_an_onnx_model_returns_is_checked(tmp_path, last, kind, says):
    onnx_agents = pytest.importorskip("rapid.agents.onnx")
    pytest.importorskip("onnxruntime")
    onnx_model(tmp_path / "a.onnx", last, kind=kind)
    agent = onnx_agents.OnnxAgent(tmp_path / "a.onnx")
    with pytest.raises(RapidError, match=says):
        agent.act(-np.ones((2, 15, 5), np.float32))


@pytest.mark.parametrize("metadata", ["{", "[]", "3", '{"memory": true}', '{"mirrored_lanes": "x"}', "[" * 9999])
def test_metadata_of_an_onnx_model_that_is_not_ours(tmp_path, metadata):
    onnx_agents = pytest.importorskip("rapid.agents.onnx")
    pytest.importorskip("onnxruntime")
    onnx_model(tmp_path / "a.onnx", metadata=metadata)
    with pytest.raises(RapidError, match="metadata that RAPID did not write"):
        onnx_agents.OnnxAgent(tmp_path / "a.onnx")


def test_a_hash_of_json_does_not_depend_on_its_order():
    assert content_hash({"a": 1, "b": [1.5, None]}) == content_hash({"b": [1.5, None], "a": 1})
