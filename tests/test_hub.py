"""Agents and datasets to and from the Hugging Face Hub, which here is a server on the loopback."""

import json
import sys

import numpy as np
import pytest
from markdown_it import MarkdownIt

from fake_hub import TOKEN, Hub
from rapid import files
from rapid.agents.onnx import export_onnx
from rapid.agents.saved import load_agent, save_agent
from rapid.cli import main
from rapid.config import NetworkConfig
from rapid.data.dataset import load_dataset, save_dataset
from rapid.errors import RapidError
from rapid.hub import pull, push
from rapid.networks.q_network import build_network

huggingface_hub = pytest.importorskip("huggingface_hub")
AGENT = "alice/lane-3-pupil"
HOSTILE = "<script>alert(1)</script> ](javascript:x) | `a` \n# no heading **bold** http://evil.example \u202e"


@pytest.fixture
def hub(monkeypatch, tmp_path):
    server = Hub()
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", server.url)
    template = f"{server.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    monkeypatch.setattr("huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(tmp_path / "no-token"))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.chdir(tmp_path)
    yield server
    server.close()


def network(seed=1):
    return build_network(NetworkConfig(width=16, feedforward=32, hidden=(24,)), lanes=3, seed=seed)


@pytest.fixture
def agent(tmp_path):
    folder = tmp_path / "agent"
    save_agent(folder, network(), {"name": "pupil", "scenario": "lane-3-density-2"})
    digest = files.sha256(folder / "weights.safetensors")
    scores = {"none": {"return": 21.5, "crash_share": 0.02, "episodes": 200}, HOSTILE: {"return": HOSTILE}}
    card = {"summary": HOSTILE, "scores": scores, "weights_sha256": digest, "licence": "Apache-2.0"}
    files.write_json(folder / "card.json", card)
    return folder


@pytest.fixture
def dataset(tmp_path):
    folder = tmp_path / "data"
    whole = load_dataset("shipped:lane-3-density-2/rule")
    some = whole.transitions.select(np.arange(40))
    drivers = {"teacher": {"name": HOSTILE, "note": "```\n# end of the fence"}}
    save_dataset(type(whole)(whole.scenario, some, drivers), folder)
    return folder


def test_an_agent_comes_back_bit_for_bit_and_nothing_else_travels(hub, agent, tmp_path, roads):
    for name in ("optimizer.pt", "notes.txt", ".env"):
        (agent / name).write_text("private")
    sent = push(agent, AGENT)
    assert set(hub.repos["models", AGENT]) == {"config.json", "weights.safetensors", "card.json", "README.md"}
    assert set(sent.left_out) == {"optimizer.pt", "notes.txt", ".env"}
    assert hub.created[0]["visibility" if "visibility" in hub.created[0] else "private"] in (True, "private")
    got = pull(AGENT, tmp_path / "back")
    assert got.revision == sent.revision == hub.commit("models", AGENT)
    assert set(got.files) == {path.name for path in (tmp_path / "back").iterdir()}
    for name in ("config.json", "weights.safetensors", "card.json"):
        assert (tmp_path / "back" / name).read_bytes() == (agent / name).read_bytes()
    obs = roads(5).numpy()
    assert (load_agent(tmp_path / "back").q_values(obs) == load_agent(agent).q_values(obs)).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent", "back"]


def test_a_dataset_comes_back_whole(hub, dataset, tmp_path):
    push(dataset, "alice/data", public=True)
    assert ("datasets", "alice/data") in hub.repos
    got = pull("alice/data", "back")
    assert set(got.files) == {"dataset.json", "transitions.parquet", "README.md"}
    mine, theirs = load_dataset("back"), load_dataset(dataset)
    assert mine.drivers == theirs.drivers
    assert np.array_equal(mine.transitions.obs_NVF, theirs.transitions.obs_NVF)


def test_an_agent_and_a_dataset_of_one_name_are_told_apart(hub, agent, dataset):
    push(agent, AGENT)
    push(dataset, AGENT)
    assert "weights.safetensors" in pull(AGENT, "a").files
    assert "transitions.parquet" in pull(f"datasets/{AGENT}", "b").files


def test_what_an_earlier_version_had_is_deleted_and_foreign_files_stay(hub, agent):
    push(agent, AGENT)
    hub.repos["models", AGENT][".gitattributes"] = hub.repos["models", AGENT]["paper.pdf"] = b"x"
    (agent / "card.json").unlink()
    push(agent, AGENT)
    assert set(hub.repos["models", AGENT]) == {
        "config.json",
        "weights.safetensors",
        "README.md",
        ".gitattributes",
        "paper.pdf",
    }


@pytest.mark.parametrize("foreign", ["pytorch_model.bin", "model.pt", "a.pkl", "sub/weights.safetensors", "../up.json"])
def test_pickles_and_other_files_are_never_fetched(hub, agent, capsys, foreign):
    push(agent, AGENT)
    hub.repos["models", AGENT][foreign] = b"\x80\x04cos\nsystem\n."
    with pytest.raises(SystemExit, match="0"):
        main(["pull", AGENT])
    assert foreign in capsys.readouterr().out
    assert not any(f"resolve/{hub.commit('models', AGENT)}/{foreign}" in asked for asked in hub.asked)
    assert {"config.json", "weights.safetensors"} <= {path.name for path in (agent.parent / "lane-3-pupil").iterdir()}
    assert not list(agent.parent.glob("**/*.pkl"))


def test_a_repository_of_pickles_only_is_refused(hub):
    hub.repos["models", AGENT] = {"config.json": b"{}", "pytorch_model.bin": b"\x80\x04."}
    with pytest.raises(RapidError, match="as agent it lacks weights"):
        pull(AGENT, "back")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("weights.safetensors", b"\x80\x04cos\nsystem\n."),
        ("weights.safetensors", b""),
        ("config.json", b"[]"),
        ("config.json", b'{"format": "rapid-agent"'),
        ("card.json", b'{"weights_sha256": "00"}'),
        ("card.json", b"[]"),
    ],
)
def test_what_is_damaged_is_never_put_in_its_place(hub, agent, tmp_path, name, content):
    push(agent, AGENT)
    hub.repos["models", AGENT][name] = content
    with pytest.raises(RapidError, match="was not put at") as told:
        pull(AGENT, "back")
    assert ".rapid-pull" not in str(told.value)
    assert [path.name for path in tmp_path.iterdir()] == ["agent"]


def test_a_damaged_dataset_is_never_put_in_its_place(hub, dataset, tmp_path):
    push(dataset, "alice/data")
    content = hub.repos["datasets", "alice/data"]
    content["transitions.parquet"] = content["transitions.parquet"][:-1] + b"?"
    with pytest.raises(RapidError, match="SHA-256 differs"):
        pull("alice/data", "back")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_onnx_travels_only_if_it_computes_what_the_weights_do(hub, agent, tmp_path, roads):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    export_onnx(load_agent(agent), agent / "agent.onnx", roads(6).numpy())
    push(agent, AGENT)
    assert "agent.onnx" in pull(AGENT, "back").files
    save_agent(tmp_path / "other", network(seed=2), {})
    export_onnx(load_agent(tmp_path / "other"), tmp_path / "other.onnx", roads(6).numpy())
    for content in ((tmp_path / "other.onnx").read_bytes(), b"no model"):
        hub.repos["models", AGENT]["agent.onnx"] = content
        got = pull(AGENT, f"back-{len(content)}")
        assert "agent.onnx" not in got.files
        assert not (tmp_path / f"back-{len(content)}" / "agent.onnx").exists()
        assert "agent.onnx" in got.told()


@pytest.mark.parametrize("kind", ["agent", "dataset"])
def test_cards_show_foreign_text_letter_by_letter(hub, request, kind):
    push(request.getfixturevalue(kind), AGENT)
    text = hub.repos[f"{'model' if kind == 'agent' else 'dataset'}s", AGENT]["README.md"].decode()
    head, text = text.removeprefix("---\n").split("---\n", 1)
    assert '"license": ' not in head
    assert 'license: "apache-2.0"' in head
    assert "\u202e" not in text
    tokens = MarkdownIt("commonmark", {"html": True}).enable("table").parse(text)
    inline = [child for token in tokens for child in token.children or []]
    assert not {"html_block"} & {token.type for token in tokens}
    assert not {"html_inline", "link_open", "strong_open", "image"} & {child.type for child in inline}
    shown = " ".join(child.content for child in inline)
    assert "<script>alert(1)</script> ](javascript:x) | `a` # no heading **bold** http://evil.example" in shown
    headings = [tokens[place + 1].content for place, token in enumerate(tokens) if token.type == "heading_open"]
    assert not [heading for heading in headings if "no heading" in heading or "end of the fence" in heading]
    rows = [place for place, token in enumerate(tokens) if token.type == "tr_open"]
    assert rows


@pytest.mark.parametrize(
    ("prepare", "expected"),
    [
        (lambda hub: None, "there is none, or it is private"),
        (lambda hub: setattr(hub, "failing", (503, "down")), "cannot be reached or is out of order"),
        (lambda hub: setattr(hub, "failing", (429, "slow")), "too many requests"),
        (lambda hub: setattr(hub, "failing", (401, f"bad token {TOKEN}")), "does not let you"),
        (lambda hub: hub.close(), "cannot be reached or is out of order"),
    ],
)
def test_refusals_are_told_in_one_paragraph_without_the_token(hub, monkeypatch, capsys, tmp_path, prepare, expected):
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    prepare(hub)
    with pytest.raises(SystemExit, match="2"):
        main(["pull", AGENT])
    said = capsys.readouterr()
    assert expected in said.err
    assert TOKEN not in said.err + said.out
    assert not list(tmp_path.iterdir())


def test_a_private_repository_wants_a_login(hub, agent, monkeypatch):
    push(agent, AGENT)
    hub.private.add(AGENT)
    pull(AGENT, "seen")
    monkeypatch.delenv("HF_TOKEN")
    with pytest.raises(RapidError, match=r"it is private.*hf auth login"):
        pull(AGENT, "unseen")
    before = len(hub.asked)
    with pytest.raises(RapidError, match=r"hf auth login.*HF_TOKEN"):
        push(agent, AGENT)
    assert len(hub.asked) == before


def test_a_token_without_write_access_is_told_and_not_repeated(hub, agent, monkeypatch):
    wrong = "hf_readOnlyReadOnlyReadOnly99"
    monkeypatch.setenv("HF_TOKEN", wrong)
    with pytest.raises(RapidError, match="write access") as told:
        push(agent, AGENT)
    assert wrong not in str(told.value)
    assert not hub.repos


def test_an_unknown_revision_and_offline_mode_are_told(hub, agent, monkeypatch):
    push(agent, AGENT)
    with pytest.raises(RapidError, match="no revision 'v9'"):
        pull(AGENT, "back", "v9")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    huggingface_hub.utils.close_session()
    try:
        with pytest.raises(RapidError, match="HF_HUB_OFFLINE"):
            pull(AGENT, "back")
    finally:
        monkeypatch.undo()
        huggingface_hub.utils.close_session()


def test_without_the_client_the_command_that_installs_it_is_printed(hub, agent, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for act in (lambda: pull(AGENT), lambda: push(agent, AGENT)):
        with pytest.raises(RapidError) as told:
            act()
        assert "pip install -c constraints.txt -e '.[hub]'" in str(told.value)


def test_nothing_is_overwritten_and_no_request_made(hub, tmp_path):
    (tmp_path / "back").mkdir()
    (tmp_path / "back" / "mine").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for out in ("back", "back/mine", "link"):
        with pytest.raises(RapidError, match="Choose another --out"):
            pull(AGENT, out)
    assert not hub.asked


@pytest.mark.parametrize("name", ["", "pupil", "a/b/c", "../x", "a/..", "a/b c", "https://hub/a", "a/-b", "a--b/c"])
def test_names_that_are_none_are_refused_before_any_request(hub, agent, name):
    for act in (lambda: pull(name), lambda: push(agent, name)):
        with pytest.raises(RapidError, match="OWNER/NAME"):
            act()
    assert not hub.asked


def test_what_is_no_agent_or_damaged_is_never_sent(hub, agent, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RapidError, match="neither an agent nor a dataset"):
        push(tmp_path / "empty", AGENT)
    config = json.loads((agent / "config.json").read_text())
    (agent / "config.json").write_text(json.dumps(config | {"weights_sha256": "0" * 64}))
    with pytest.raises(RapidError, match="not those"):
        push(agent, AGENT)
    assert not hub.asked


def test_shipped_ones_are_pushed_by_name(hub):
    push("shipped:lane-3-density-2/rule", "alice/rule")
    assert "teacher_log.parquet" in hub.repos["datasets", "alice/rule"]
