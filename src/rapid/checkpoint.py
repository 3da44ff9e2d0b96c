"""Resumable state on disk: one safetensors file, whose header holds the structure as JSON. Nothing that runs code.

The file is written beside its place and renamed over the previous one, which therefore stays good until the new one is
complete. It carries the SHA-256 of everything in it, which is checked when it is read.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from rapid import files
from rapid.errors import DamagedError, RapidError

FORMAT = "rapid-state"
VERSION = 3

State = dict[Any, Any]


def save_state(path: str | os.PathLike[str], state: State) -> None:
    """Write a nested state atomically; :func:`load_state` gives it back equal, bit for bit.

    Args:
        path: the file.
        state: dictionaries (keys: text or integers), lists and tuples of tensors, NumPy arrays, numbers, text, booleans
            and None. A tensor that appears at several places is stored once and is one tensor again when read.

    Raises:
        RapidError: a value of another kind, or the file cannot be written.
    """
    tensors: dict[str, Tensor] = {}
    tree = _pack(state, tensors, {}, "state")
    text = json.dumps(tree)
    header = {"format": FORMAT, "version": str(VERSION), "tree": text, "sha256": _digest(text, tensors)}
    with files.atomic_path(path) as temporary:
        try:
            save_file(tensors, temporary, header)
        except (OSError, SafetensorError) as error:
            raise RapidError(
                f"Cannot write the checkpoint '{path}': {error}. Make room, or choose another place."
            ) from error


def load_state(path: str | os.PathLike[str]) -> State:
    """Read a state that :func:`save_state` wrote; tensors come on the CPU.

    Raises:
        DamagedError: the file is not what was written.
        RapidError: the file is missing, or of another version.
    """
    if not Path(path).is_file():
        raise RapidError(f"There is no checkpoint at '{path}'. Check the path, or start from the beginning.")
    try:
        with safe_open(path, "pt") as stream:
            header: dict[str, str] = stream.metadata() or {}
            tensors = {key: stream.get_tensor(key) for key in stream.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise _damaged(path, error) from error
    if header.get("format") != FORMAT:
        raise RapidError(f"'{path}' is not a checkpoint of a training. Give a file that a training wrote.")
    # Version 2 is the same without a checksum.
    if header.get("version") not in ("2", str(VERSION)):
        raise RapidError(
            f"The checkpoint '{path}' has version {header.get('version')}, but this program reads version {VERSION}. "
            "Resume with the program's version that wrote it, or start from the beginning."
        )
    if header["version"] != "2" and header.get("sha256") != _digest(header.get("tree", ""), tensors):
        raise _damaged(path, "it does not have the SHA-256 that it names")
    try:
        return _unpack(json.loads(header["tree"]), tensors)
    except (KeyError, ValueError, TypeError, IndexError, RecursionError, AttributeError) as error:
        raise _damaged(path, error) from error


def _digest(tree: str, tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of a structure and of its tensors."""
    digest = hashlib.sha256(tree.encode())
    for key in sorted(tensors):
        tensor = tensors[key]
        digest.update(f"{key} {tensor.dtype} {list(tensor.shape)}".encode())
        if tensor.numel():
            digest.update(tensor.contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _damaged(path: str | os.PathLike[str], why: Exception | str) -> DamagedError:
    return DamagedError(f"The checkpoint '{path}' is damaged: {why}. Use an earlier one, or start from the beginning.")


def _pack(value: Any, tensors: dict[str, Tensor], seen: dict[Any, str], where: str) -> Any:
    """Return `value` as JSON, with every tensor put into `tensors` and replaced by its key."""
    if isinstance(value, dict):
        for key in value:
            if type(key) not in (str, int):
                raise RapidError(f"Cannot save {where}: the key {key!r} is neither text nor an integer.")
        return {"dict": [[key, _pack(item, tensors, seen, f"{where}.{key}")] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [_pack(item, tensors, seen, f"{where}[{index}]") for index, item in enumerate(value)]}
    if isinstance(value, Tensor):
        identity = (value.data_ptr(), value.shape, value.stride(), value.dtype, value.device)
        # Tensors without elements have no address of their own.
        if value.numel() == 0 or identity not in seen:
            seen[identity] = str(len(tensors))
            tensors[seen[identity]] = value.detach().cpu().contiguous().clone()
        return {"tensor": seen[identity]}
    if isinstance(value, np.ndarray):
        key = str(len(tensors))
        try:
            tensors[key] = torch.from_numpy(np.ascontiguousarray(value).copy())
        except TypeError as error:
            raise RapidError(f"Cannot save {where}: {error}") from error
        return {"array": key, "shape": list(value.shape)}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise RapidError(
        f"Cannot save {where}: a value of type {type(value).__name__}. A state holds dictionaries, lists, tuples, "
        "tensors, NumPy arrays, numbers, text, booleans and None."
    )


def _unpack(node: Any, tensors: dict[str, Tensor]) -> Any:
    if not isinstance(node, dict):
        return node
    if "dict" in node:
        return {key: _unpack(item, tensors) for key, item in node["dict"]}
    if "list" in node:
        return [_unpack(item, tensors) for item in node["list"]]
    if "tuple" in node:
        return tuple(_unpack(item, tensors) for item in node["tuple"])
    if "array" in node:
        return tensors[node["array"]].numpy().reshape(node["shape"])
    return tensors[node["tensor"]]
