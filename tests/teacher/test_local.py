"""The embedded model, on tiny random weights: unpacking GGUF, scoring words, batches, and the scoring teacher."""

import json
import os

import numpy as np
import pytest
import torch

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher import int8, local, make_teacher, models
from rapid.teacher.agent import ScoringTeacher, softmax_over
from rapid.teacher.gguf import convert
from rapid.teacher.int8 import Int8Linear
from rapid.teacher.local import LocalModel
from rapid.teacher.prompt import WORDS

SIZES = {"embedding_length": 32, "feed_forward_length": 48, "block_count": 2, "context_length": 512}
HEADS, KV_HEADS = 4, 2
SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>"]


def byte_tokens() -> list[str]:
    from tokenizers.pre_tokenizers import ByteLevel

    return sorted(ByteLevel.alphabet())


def write_gguf(path, family="llama"):
    """Write a random model with a byte tokenizer in which " keep" and " right" are merged, like a real one's words."""
    from gguf import GGUFWriter

    tokens, merges = [*SPECIAL, *byte_tokens()], []
    for word in ("keep", "right"):
        piece = "Ġ"
        for letter in word:
            merges.append(f"{piece} {letter}")
            piece += letter
            tokens.append(piece)
    writer = GGUFWriter(path, family)
    generator = np.random.default_rng(0)
    for key, value in SIZES.items():
        writer.add_uint32(f"{family}.{key}", value)
    writer.add_head_count(HEADS)
    writer.add_head_count_kv(KV_HEADS)
    writer.add_layer_norm_rms_eps(1e-5)
    writer.add_rope_freq_base(10_000.0)
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre("smollm" if family == "llama" else "qwen2")
    writer.add_token_list(tokens)
    writer.add_token_types([3] * len(SPECIAL) + [1] * (len(tokens) - len(SPECIAL)))
    writer.add_token_merges(merges)
    width, inner, head = SIZES["embedding_length"], SIZES["feed_forward_length"], SIZES["embedding_length"] // HEADS
    shapes = {"token_embd.weight": (len(tokens), width), "output_norm.weight": (width,)}
    for layer in range(SIZES["block_count"]):
        for name, shape in {
            "attn_norm": (width,),
            "attn_q": (width, width),
            "attn_k": (KV_HEADS * head, width),
            "attn_v": (KV_HEADS * head, width),
            "attn_output": (width, width),
            "ffn_norm": (width,),
            "ffn_gate": (inner, width),
            "ffn_up": (inner, width),
            "ffn_down": (width, inner),
        }.items():
            shapes[f"blk.{layer}.{name}.weight"] = shape
            if family == "qwen2" and name in ("attn_q", "attn_k", "attn_v"):
                shapes[f"blk.{layer}.{name}.bias"] = shape[:1]
    weights = {name: generator.normal(0, 0.3, shape).astype(np.float32) for name, shape in shapes.items()}
    for name, weight in weights.items():
        writer.add_tensor(name, weight)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return weights


@pytest.fixture(scope="module")
def gguf(tmp_path_factory):
    path = tmp_path_factory.mktemp("gguf") / "tiny.gguf"
    return path, write_gguf(path)


@pytest.fixture(scope="module")
def model(gguf, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dense") / "tiny"
    convert(gguf[0], folder)
    return LocalModel(folder)


VOCABULARY = list(WORDS.values())
USERS = [f"Safe: {'a' * n}. Unsafe: none." for n in (1, 5, 40, 2, 17)]


def test_unpacking_undoes_the_rope_permutation(gguf, model):
    """GGUF's pairs (i, i + half) and transformers' halves are the same attention; checked on one query row pair."""
    stored = gguf[1]["blk.0.attn_q.weight"]
    head = SIZES["embedding_length"] // HEADS
    unpacked = model._model.state_dict()["model.layers.0.self_attn.q_proj.weight"].numpy()
    for number in range(HEADS):
        block = stored[number * head : (number + 1) * head]
        expected = np.concatenate([block[0::2], block[1::2]])
        np.testing.assert_allclose(unpacked[number * head : (number + 1) * head], expected, rtol=1e-3, atol=1e-4)


def test_the_cached_prefix_changes_nothing(model):
    """Scores equal those of one plain pass over the whole text, up to the constant that softmax removes."""
    scores_BW, tokens = model.score("You drive.", USERS, "Action:", ["keep", "right"])
    for user, scores_W, count in zip(USERS, scores_BW, tokens, strict=True):
        text = f"<|im_start|>system\nYou drive.<|im_end|>\n<|im_start|>user\n{user}<|im_end|>\n"
        text += "<|im_start|>assistant\nAction:"
        ids = model._encode(text)
        with torch.no_grad():
            logits = model._model(torch.tensor([ids])).logits[0, -1].double().numpy()
        words = [model._encode(f" {word}")[0] for word in ("keep", "right")]
        assert len(ids) == count
        assert scores_W[0] - scores_W[1] == pytest.approx(logits[words[0]] - logits[words[1]], abs=1e-4)


def test_words_of_several_tokens_are_scored_whole(model):
    words = ["slow", "slap"]
    assert len({model._encode(f" {word}")[0] for word in words}) == 1
    scores_W = model.score("You drive.", USERS[:1], "Action:", words)[0][0]
    start = model._encode(f"<|im_start|>system\nYou drive.<|im_end|>\n<|im_start|>user\n{USERS[0]}<|im_end|>\n")
    start += model._encode("<|im_start|>assistant\nAction:")
    for word, score in zip(words, scores_W, strict=True):
        ids = model._encode(f" {word}")
        with torch.no_grad():
            logs = model._model(torch.tensor([start + ids])).logits[0].log_softmax(-1)
        expected = sum(float(logs[len(start) - 1 + i, token]) for i, token in enumerate(ids))
        assert score == pytest.approx(expected, abs=1e-3)


def test_scores_do_not_depend_on_the_batch(model):
    together = model.score("You drive.", USERS, "Action:", ["keep", "right"])[0]
    model.forget()
    alone = np.concatenate([model.score("You drive.", [user], "Action:", ["keep", "right"])[0] for user in USERS])
    np.testing.assert_allclose(together, alone, atol=1e-4)


def test_remembered_scores_are_the_same(model):
    first = model.score("You drive.", USERS, "Action:", VOCABULARY)
    again = model.score("You drive.", USERS[::-1], "Action:", VOCABULARY)
    np.testing.assert_array_equal(first[0], again[0][::-1])
    assert first[1] == again[1][::-1]


def test_qwen_models_unpack_too(tmp_path):
    write_gguf(tmp_path / "q.gguf", "qwen2")
    convert(tmp_path / "q.gguf", tmp_path / "q")
    scores, _ = LocalModel(tmp_path / "q").score("You drive.", USERS[:2], "Action:", ["keep", "right"])
    assert np.isfinite(scores).all()


def test_a_truncated_file_leaves_nothing_behind(gguf, tmp_path):
    (tmp_path / "cut.gguf").write_bytes(gguf[0].read_bytes()[:3000])
    with pytest.raises(RapidError, match="GGUF"):
        convert(tmp_path / "cut.gguf", tmp_path / "cut")
    assert [path.name for path in tmp_path.iterdir()] == ["cut.gguf"]


def test_a_path_serves_as_a_model(gguf, crowd, tmp_path, monkeypatch):
    monkeypatch.setenv("RAPID_CACHE", str(tmp_path))
    teacher = make_teacher(TeacherConfig(model=str(gguf[0])), 3)
    decisions = teacher.decide(crowd, [None] * len(crowd))
    assert {decision.status for decision in decisions} == {"ok"}
    for decision in decisions:
        assert sum(decision.probabilities) == pytest.approx(1)
        assert decision.probabilities[decision.action] == max(decision.probabilities)
    assert json.dumps(teacher.describe())
    assert make_teacher(TeacherConfig(model=str(gguf[0])), 3).decide(crowd[:1], [None])[0].action == decisions[0].action


def test_a_local_model_converses(gguf, world, tmp_path, monkeypatch):
    monkeypatch.setenv("RAPID_CACHE", str(tmp_path))
    config = TeacherConfig(model=str(gguf[0]), style="react", max_answer_tokens=4, max_turns=1)
    teacher = make_teacher(config, 3)
    decision = teacher.decide(world(), [None])[0]
    assert not teacher._chat._model._talks, "nothing is kept of conversations that are over"
    assert decision.status == "fallback"
    assert decision.tokens_out > 0
    assert make_teacher(config, 3).describe()["arithmetic"] in ("int8", "float32")


def test_a_conversation_goes_on_from_what_was_computed(model, monkeypatch):
    """Every turn is what a plain pass over the whole conversation gives, and reads only what is new."""
    passes, forward = [], model._model.base_model.forward
    monkeypatch.setattr(model._model.base_model, "forward", lambda **given: passes.append(given) or forward(**given))
    messages = [{"role": "system", "content": "You drive."}, {"role": "user", "content": "Lane 2 of 3."}]
    for turn in range(3):
        passes.clear()
        [(text, tokens_in, tokens_out)] = model.write([messages], 6)
        whole = "".join(f"<|im_start|>{m['role']}\n{m['content']}<|im_end|>\n" for m in messages)
        ids = torch.tensor([model._encode(f"{whole}<|im_start|>assistant\n")])
        plain = model._model.generate(ids, do_sample=False, max_new_tokens=6, eos_token_id=2, pad_token_id=2)
        assert model._tokenizer.decode(plain[0, ids.shape[1] :].tolist()) == text
        assert (tokens_in, tokens_out) == (ids.shape[1], plain.shape[1] - ids.shape[1])
        fresh = passes[0]["input_ids"].shape[1]
        assert fresh < tokens_in - (30 if turn else 10)
        messages += [{"role": "assistant", "content": text}, {"role": "user", "content": f"RESULT {turn}"}]


def test_only_what_is_new_is_computed_after_two_messages(model, monkeypatch):
    """As on the turn when a model must decide: the request for it comes after the last tool's result."""
    passes, forward = [], model._model.base_model.forward
    messages = talks((5,))[0]
    [(text, *before)] = model.write([messages], 6)
    messages = [*answered(messages, text), {"role": "user", "content": "Decide."}]
    monkeypatch.setattr(model._model.base_model, "forward", lambda **given: passes.append(given) or forward(**given))
    [found] = model.write([messages], 6)
    # The last token of the answer was written but not read.
    assert passes[0]["input_ids"].shape[1] == local._padded(found[1] - sum(before) + 1) < found[1]
    model.end()
    assert model.write([messages], 6) == [found]


def test_an_answer_does_not_depend_on_the_conversation_before(model):
    def opening(lane):
        return [{"role": "system", "content": "You drive."}, {"role": "user", "content": f"You are in lane {lane}."}]

    alone = model.write([opening(2)], 6)
    model.write([opening(1)], 6)
    assert model.write([opening(2)], 6) == alone


def talks(lanes=(1, 22, 333, 4)):
    return [
        [{"role": "system", "content": "You drive."}, {"role": "user", "content": f"Lane {'9' * lane}."}]
        for lane in lanes
    ]


def answered(messages, text):
    return [*messages, {"role": "assistant", "content": text}, {"role": "user", "content": "RESULT " + "x" * len(text)}]


def test_conversations_side_by_side_get_the_answers_that_each_gets_alone(model, monkeypatch):
    """Over three turns, of which the second is asked of some only, as others have decided by then."""
    monkeypatch.setattr(local, "TALKS", 3)
    together = talks()
    alone = dict(enumerate(talks()))
    for numbers in ((0, 1, 2, 3), (1, 3), (3, 1)):
        limit = 5 + len(numbers)
        found = model.write([together[number] for number in numbers], limit)
        model_talks, model._talks = model._talks, {}
        for number, (text, tokens_in, tokens_out) in zip(numbers, found, strict=True):
            # With nothing kept: each turn is computed anew.
            assert model.write([alone[number]], limit) == [(text, tokens_in, tokens_out)]
            assert 0 < tokens_out <= limit
            alone[number] = answered(alone[number], text)
            together[number] = answered(together[number], text)
            model._talks = {}
        model._talks = model_talks


def test_what_is_finished_is_not_gone_on_with(model):
    opening = talks()
    whole = model.write(opening, 8)
    cut = model.write(opening, 8, lambda text: len(text) >= 3)
    for (full, *_), (text, _, tokens) in zip(whole, cut, strict=True):
        assert full.startswith(text)
        assert 3 <= len(text) < len(full)
        assert tokens < 8


def test_a_cut_answer_is_gone_on_from_as_it_was_cut(model):
    opening = talks((5,))[0]
    text = model.write([opening], 8, lambda text: len(text) >= 3)[0][0]
    kept = model.write([answered(opening, text)], 6)
    model._talks = {}
    assert model.write([answered(opening, text)], 6) == kept


def test_rounded_layers_are_near_and_do_not_depend_on_the_batch():
    generator = torch.Generator().manual_seed(0)
    layer = torch.nn.Linear(64, 48)
    rounded = Int8Linear(layer)
    inputs_BTK = torch.randn(5, 3, 64, generator=generator) * torch.logspace(-2, 3, 5)[:, None, None]
    with torch.no_grad():
        outputs_BTN, exact_BTN = rounded(inputs_BTK), layer(inputs_BTK)
        error_BT = (outputs_BTN - exact_BTN).norm(dim=-1) / exact_BTN.norm(dim=-1)
        assert error_BT.max() < 0.03
        alone_BTN = torch.stack([torch.stack([rounded(row_K) for row_K in row_TK]) for row_TK in inputs_BTK])
    assert torch.equal(outputs_BTN, alone_BTN)
    assert torch.equal(rounded(torch.zeros(64)), layer.bias)


def test_a_processor_that_torch_cannot_tell_about_is_not_fast(monkeypatch):
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    assert not int8.is_fast()


def test_a_model_that_writes_may_be_rounded(gguf, tmp_path, monkeypatch):
    convert(gguf[0], tmp_path / "tiny")
    monkeypatch.setattr("rapid.teacher.int8.is_fast", lambda: True)
    rounded = LocalModel(tmp_path / "tiny", rounded=True)
    assert not any(isinstance(layer, torch.nn.Linear) for layer in rounded._model.modules())
    together = rounded.write(talks(), 6)
    assert together == [rounded.write([messages], 6)[0] for messages in talks()]


class Fixed:
    """A scorer that leans towards one word and follows the prompt a little."""

    def __init__(self, leaning):
        self.leaning = np.array(leaning, float)

    def score(self, system, users, opening, words):
        named = [[float(f" {word}" in user.split("Unsafe")[0]) for word in words] for user in users]
        return self.leaning + np.array(named), [10] * len(users)


def test_calibration_removes_the_leaning(crowd):
    fair, biased = (ScoringTeacher(Fixed(leaning), {"model": "f"}, 3) for leaning in ([0] * 5, [9, 0, 0, 0, 0]))
    expected = [decision.probabilities for decision in fair.decide(crowd, [None] * len(crowd))]
    found = [decision.probabilities for decision in biased.decide(crowd, [None] * len(crowd))]
    np.testing.assert_allclose(found, expected)


def test_shuffled_facts_change_decisions_but_not_with_the_batch(crowd):
    told = ScoringTeacher(Fixed([0] * 5), {"model": "f"}, 3)
    confused = ScoringTeacher(Fixed([0] * 5), {"model": "f"}, 3, shuffle_seed=1)
    keys = np.arange(len(crowd))
    right = [d.action for d in told.decide(crowd, [None] * len(crowd), keys)]
    wrong = [d.action for d in confused.decide(crowd, [None] * len(crowd), keys)]
    alone = [confused.decide(crowd[i : i + 1], [None], keys[i : i + 1])[0].action for i in range(len(crowd))]
    assert right != wrong == alone
    assert confused.describe()["facts"] == "shuffled"


def test_softmax_gives_nothing_to_what_is_not_available():
    probabilities = softmax_over(np.array([900.0, 1.0, 2.0, 3.0, 4.0]), (1, 3))
    np.testing.assert_allclose(probabilities, [0, 1 / (1 + np.e**2), 0, np.e**2 / (1 + np.e**2), 0])


@pytest.mark.skipif(not models.is_present("smollm2-135m"), reason="the default model is not in the cache")
def test_the_default_model_tells_safe_from_unsafe_and_gives_the_same_bits_in_any_batch(crowd):
    teacher = make_teacher(TeacherConfig(), 3)
    together = teacher.decide(crowd, [None] * len(crowd))
    alone = [make_teacher_again(teacher, crowd[i : i + 1]) for i in range(0, len(crowd), 6)]
    assert [d.probabilities for d in together[::6]] == [d.probabilities for d in alone]


def make_teacher_again(teacher, obs_BVF):
    """Decide with nothing remembered."""
    teacher._model.forget()
    return teacher.decide(obs_BVF, [None])[0]


@pytest.mark.parametrize("damage", ["zeros", "missing", "shorter", "list", "earlier version"])
def test_an_unpacked_model_that_changed_is_unpacked_again(gguf, tmp_path, monkeypatch, capsys, damage):
    monkeypatch.setenv("RAPID_CACHE", str(tmp_path))
    folder, digest, _ = models.dense_folder(str(gguf[0]))
    capsys.readouterr()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert models.dense_folder(str(gguf[0])) == (folder, digest, "chatml")
    assert not capsys.readouterr().err
    weights = folder / "model.safetensors"
    if damage == "zeros":
        weights.write_bytes(before[weights.name][:-4000] + bytes(4000))
    elif damage == "missing":
        (folder / "tokenizer.json").unlink()
    elif damage == "shorter":
        weights.write_bytes(before[weights.name][:-1])
    else:
        (folder / "content.json").write_text("{") if damage == "list" else (folder / "content.json").unlink()
    models.dense_folder(str(gguf[0]))
    assert "It is unpacked again" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_what_a_killed_process_left_half_unpacked_goes(gguf, tmp_path):
    old, new = tmp_path / ".tiny.old", tmp_path / ".tiny.new"
    for path in (old, new):
        path.mkdir()
        (path / "model.safetensors").write_bytes(b"half")
    os.utime(old, (0, 0))
    convert(gguf[0], tmp_path / "tiny")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".tiny.new", "tiny"]
