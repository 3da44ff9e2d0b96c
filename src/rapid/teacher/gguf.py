"""GGUF files turned, once, into a plain folder that transformers loads in seconds.

GGUF is the format in which small quantised models are published. Unpacking its blocks takes far longer than reading
dense weights, so the folder (``config.json``, ``model.safetensors`` in half precision, ``tokenizer.json``) is kept.
Families: Llama (SmolLM2 among them) and Qwen2, with their byte-level BPE tokenizers.
"""

import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from rapid.errors import DamagedError, RapidError
from rapid.files import make_directory, read_json, sha256, sync_directory, write_json
from rapid.progress import task

FORMAT = 1
"""Raised when the conversion changes, so that older folders are made again."""

CONTENT_FILE = "content.json"
_ABANDONED = 86_400
"""Seconds without a change after which nobody is at work in a temporary folder."""
_FAMILIES = {"llama": "LlamaForCausalLM", "qwen2": "Qwen2ForCausalLM"}
_LAYER_PARTS = {
    "attn_norm": "input_layernorm",
    "attn_q": "self_attn.q_proj",
    "attn_k": "self_attn.k_proj",
    "attn_v": "self_attn.v_proj",
    "attn_output": "self_attn.o_proj",
    "ffn_norm": "post_attention_layernorm",
    "ffn_gate": "mlp.gate_proj",
    "ffn_up": "mlp.up_proj",
    "ffn_down": "mlp.down_proj",
}
_OUTER_PARTS = {"token_embd": "model.embed_tokens", "output_norm": "model.norm", "output": "lm_head"}
_QWEN_SPLIT = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)
_CONTROL, _USER_DEFINED = 3, 4
"""Token types that GGUF marks as never produced by merging characters."""


def convert(source: Path, folder: Path) -> None:
    """Unpack the GGUF file `source` into `folder`, which appears whole or not at all.

    Raises:
        RapidError: the file is not GGUF, is cut short, or is of a family or tokenizer that is not supported.
    """
    from gguf import GGUFReader

    try:
        reader = GGUFReader(source)
        fields = {name: field.contents() for name, field in reader.fields.items()}
    except (OSError, ValueError, IndexError, KeyError, OverflowError, MemoryError) as error:
        # The reader trusts the file: one that is cut short or is something else fails in any of these ways.
        raise RapidError(f"'{source}' is not a whole GGUF file ({error}). Fetch it again.") from error
    make_directory(folder.parent)
    _remove_leftovers(folder)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        config = _config(fields, {tensor.name for tensor in reader.tensors}, source)
        (temporary / "config.json").write_text(json.dumps(config, indent=2))
        (temporary / "tokenizer.json").write_text(_tokenizer(fields, source))
        _write_tensors(reader.tensors, config, temporary / "model.safetensors", source)
        facts: dict[str, Any] = {}
        for path in sorted(temporary.iterdir()):
            with path.open("rb") as stream:
                os.fsync(stream.fileno())
            facts[path.name] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
        write_json(temporary / CONTENT_FILE, {"files": facts}, sealed=True)
        # mkdtemp makes folders private; give this one the mode that mkdir() would have.
        temporary.chmod(0o755)
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
        sync_directory(folder.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def fault_of(folder: Path) -> str:
    """Return what is wrong with an unpacked model, byte for byte; nothing if it is what :func:`convert` wrote."""
    if not (folder / CONTENT_FILE).is_file():
        return f"has no {CONTENT_FILE}, as folders of earlier versions"
    try:
        listed = read_json(folder / CONTENT_FILE, "list of an unpacked model")["files"]
        for name, facts in listed.items():
            path = folder / name
            if not path.is_file():
                return f"lacks {name}"
            if path.stat().st_size != facts["bytes"] or sha256(path) != facts["sha256"]:
                return f"has another {name} than was unpacked"
    except (DamagedError, KeyError, TypeError, AttributeError):
        return f"has a damaged {CONTENT_FILE}"
    return ""


def _remove_leftovers(folder: Path) -> None:
    """Remove what a process left half unpacked that was killed, but not what another may be at."""
    for path in folder.parent.glob(f".{folder.name}.*"):
        if time.time() - path.stat().st_mtime > _ABANDONED:
            shutil.rmtree(path, ignore_errors=True)


def _config(fields: dict[str, Any], tensors: set[str], source: Path) -> dict[str, Any]:
    family = fields.get("general.architecture")
    if family not in _FAMILIES:
        raise RapidError(f"'{source}' holds a model of family '{family}'. Supported: {', '.join(_FAMILIES)}.")

    def get(name: str) -> Any:
        if f"{family}.{name}" not in fields:
            raise RapidError(f"'{source}' does not say its '{name}': it is not a language model, or is damaged.")
        return fields[f"{family}.{name}"]

    return {
        "architectures": [_FAMILIES[family]],
        "model_type": family,
        "hidden_size": get("embedding_length"),
        "intermediate_size": get("feed_forward_length"),
        "num_hidden_layers": get("block_count"),
        "num_attention_heads": get("attention.head_count"),
        "num_key_value_heads": get("attention.head_count_kv"),
        "rms_norm_eps": get("attention.layer_norm_rms_epsilon"),
        "rope_theta": get("rope.freq_base"),
        "max_position_embeddings": get("context_length"),
        "vocab_size": len(fields["tokenizer.ggml.tokens"]),
        "tie_word_embeddings": "output.weight" not in tensors,
        "bos_token_id": fields.get("tokenizer.ggml.bos_token_id"),
        "eos_token_id": fields.get("tokenizer.ggml.eos_token_id"),
        "hidden_act": "silu",
        "dtype": "float16",
    }


def _write_tensors(tensors: Any, config: dict[str, Any], target: Path, source: Path) -> None:
    from gguf.quants import dequantize
    from safetensors.numpy import save_file

    weights: dict[str, np.ndarray] = {}
    with task(f"Unpacking {source.name}", len(tensors), "tensors") as progress:
        for tensor in tensors:
            name = _name(tensor.name)
            progress.advance()
            if name is None:
                continue
            weight = dequantize(tensor.data, tensor.tensor_type)
            if config["model_type"] == "llama" and (".q_proj" in name or ".k_proj" in name):
                heads = config["num_attention_heads" if ".q_proj" in name else "num_key_value_heads"]
                weight = _undo_rope_permutation(weight, heads)
            weights[name] = np.ascontiguousarray(weight, dtype=np.float16)
    save_file(weights, target, metadata={"format": "pt"})


def _name(name: str) -> str | None:
    """Return the name that transformers gives the tensor; `None` for tables that it computes itself."""
    stem, _, kind = name.rpartition(".")
    if stem in _OUTER_PARTS:
        return f"{_OUTER_PARTS[stem]}.{kind}"
    if stem.startswith("blk."):
        _, layer, part = stem.split(".", 2)
        if part in _LAYER_PARTS:
            return f"model.layers.{layer}.{_LAYER_PARTS[part]}.{kind}"
    return None


def _undo_rope_permutation(weight: np.ndarray, heads: int) -> np.ndarray:
    """GGUF stores Llama's query and key rows as pairs (i, i + half); transformers wants the two halves in turn."""
    rows = weight.reshape(heads, weight.shape[0] // heads // 2, 2, -1)
    return rows.swapaxes(1, 2).reshape(weight.shape)


def _tokenizer(fields: dict[str, Any], source: Path) -> str:
    from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers

    kind = fields.get("tokenizer.ggml.pre")
    if fields.get("tokenizer.ggml.model") != "gpt2" or kind not in ("smollm", "qwen2"):
        raise RapidError(f"'{source}' has a tokenizer of kind '{kind}'. Supported: smollm, qwen2.")
    tokens: list[str] = fields["tokenizer.ggml.tokens"]
    merges = [tuple(merge.split(" ", 1)) for merge in fields["tokenizer.ggml.merges"]]
    tokenizer = Tokenizer(models.BPE({token: i for i, token in enumerate(tokens)}, merges))  # pyright: ignore[reportArgumentType]
    byte_level = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=kind == "smollm")
    if kind == "smollm":
        first = pre_tokenizers.Digits(individual_digits=True)
    else:
        first = pre_tokenizers.Split(Regex(_QWEN_SPLIT), "isolated")
        tokenizer.normalizer = normalizers.NFC()
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([first, byte_level])
    tokenizer.decoder = decoders.ByteLevel()
    types = fields["tokenizer.ggml.token_type"]
    for special, wanted in ((True, _CONTROL), (False, _USER_DEFINED)):
        added = [
            AddedToken(token, special=special) for token, kind in zip(tokens, types, strict=True) if kind == wanted
        ]
        (tokenizer.add_special_tokens if special else tokenizer.add_tokens)(added)
    return tokenizer.to_str()
