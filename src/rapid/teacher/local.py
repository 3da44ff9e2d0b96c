"""A language model in this process, which scores words instead of writing: many prompts at once, on a CPU.

Speed comes from three things. The key/value cache of the constant part of the prompt is computed once. Prompts of many
worlds run through the model together. And the candidates are single tokens, so one pass over the short changing part
gives the probability of every action.
"""

import gc
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.teacher.conversation import Message, Reply

ROWS = 16
"""Prompts in one pass; more gain nothing and cost memory."""
PAD = 16
"""Prompts are padded to a multiple of this, and a lone prompt is doubled: then the same kernels run whatever the
company, and a prompt's scores are the same bits in any batch (measured on AVX-512 with float32)."""
REMEMBERED = 4096
"""Prompts whose scores are kept."""


class _Template(NamedTuple):
    """How a chat is written for a model."""

    begin: str
    end: str
    stop: str


_TEMPLATES = {"chatml": _Template("<|im_start|>{role}\n", "<|im_end|>\n", "<|im_end|>")}


class LocalModel:
    """A causal language model from a folder that transformers reads.

    Args:
        folder: ``config.json``, ``model.safetensors`` and ``tokenizer.json``.
        template: name of the chat template.
    """

    def __init__(self, folder: Path, template: str = "chatml") -> None:
        from tokenizers import Tokenizer
        from transformers import AutoModelForCausalLM
        from transformers.utils import logging

        logging.disable_progress_bar()
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._model: Any = AutoModelForCausalLM.from_pretrained(folder, dtype=torch.float32).eval()
        self._head: Tensor = self._model.get_output_embeddings().weight.detach()
        self._template = _TEMPLATES[template]
        self._prefixes: dict[str, Any] = {}
        self._talk: tuple[list[int], Any] | None = None
        self._scores: OrderedDict[tuple[str, str, tuple[str, ...]], tuple[NDArray[np.float64], int]] = OrderedDict()
        gc.collect()

    def score(
        self, system: str, users: Sequence[str], opening: str, words: Sequence[str]
    ) -> tuple[NDArray[np.float64], list[int]]:
        """Return the score of every word as the continuation of every prompt.

        Args:
            system: the constant part.
            users: the changing parts, one per prompt.
            opening: how the answer begins, e.g. ``"Action:"``.
            words: the candidates; each follows `opening` after a space.

        Returns:
            Log-probabilities up to a constant per prompt, float64 (prompts x words), and the tokens of each prompt.
        """
        keys = [(system, f"{user}\0{opening}", tuple(words)) for user in users]
        fresh = list(dict.fromkeys(key for key in keys if key not in self._scores))
        found: dict[tuple[str, str, tuple[str, ...]], tuple[NDArray[np.float64], int]] = {}
        for first in range(0, len(fresh), ROWS):
            group = fresh[first : first + ROWS]
            suffixes = [self._suffix(user.split("\0")[0], opening) for _, user, _ in group]
            scores_BW, lengths = self._score_group(system, suffixes, words)
            found |= {key: (scores_BW[row], lengths[row]) for row, key in enumerate(group)}
        found |= {key: self._scores[key] for key in keys if key not in found}
        for key in keys:
            self._scores[key] = found[key]
            self._scores.move_to_end(key)
        while len(self._scores) > REMEMBERED:
            self._scores.popitem(last=False)
        return np.stack([found[key][0] for key in keys]), [found[key][1] for key in keys]

    def forget(self) -> None:
        """Drop the scores that are remembered, for whoever measures speed."""
        self._scores.clear()

    def _suffix(self, user: str, opening: str) -> list[int]:
        return self._encode(user + self._template.end + self._begin("assistant") + opening)

    def _begin(self, role: str) -> str:
        return self._template.begin.format(role=role)

    def _encode(self, text: str) -> list[int]:
        return self._tokenizer.encode(text, add_special_tokens=False).ids

    def _score_group(
        self, system: str, suffixes: list[list[int]], words: Sequence[str]
    ) -> tuple[NDArray[np.float64], list[int]]:
        candidates = [self._encode(f" {word}") for word in words]
        prefix, cache = self._prefix(system)
        if len({ids[0] for ids in candidates}) == len(words):
            # The first token tells the words apart: the rest would follow with near certainty.
            hidden_BD = self._run(cache, prefix, suffixes)[0]
            weight_WD = self._head[[ids[0] for ids in candidates]]
            # A sum, not a matrix product, whose kernel would depend on the number of rows.
            scores_BW = (hidden_BD[:, None] * weight_WD).sum(-1).double().numpy()
        else:
            rows = [suffix + ids for suffix in suffixes for ids in candidates]
            scores_BW = self._word_scores(cache, prefix, rows, [len(ids) for ids in candidates] * len(suffixes))
            scores_BW = scores_BW.reshape(len(suffixes), len(words))
        return scores_BW, [prefix + len(suffix) for suffix in suffixes]

    def _word_scores(self, cache: Any, prefix: int, rows: list[list[int]], lengths: list[int]) -> NDArray[np.float64]:
        """Return the summed log-probability of the last `lengths` tokens of each row."""
        scores: list[float] = []
        for first in range(0, len(rows), ROWS):
            group = rows[first : first + ROWS]
            hidden_BTD = self._run(cache, prefix, group)[1]
            for row, ids in enumerate(group):
                length = lengths[first + row]
                logits = hidden_BTD[row, len(ids) - length - 1 : len(ids) - 1] @ self._head.T
                picked = logits.log_softmax(-1)[range(length), ids[-length:]]
                scores.append(float(picked.sum()))
        return np.array(scores)

    @torch.no_grad()
    def _run(self, cache: Any, prefix: int, suffixes: list[list[int]]) -> tuple[Tensor, Tensor]:
        """Return the last hidden state of each suffix (B x D) and all of them (B x T x D)."""
        from transformers import DynamicCache

        rows = suffixes * 2 if len(suffixes) == 1 else suffixes
        length = -(-max(map(len, rows)) // PAD) * PAD
        ids_BT = torch.zeros(len(rows), length, dtype=torch.long)
        seen_BT = torch.ones(len(rows), prefix + length, dtype=torch.long)
        for row, ids in enumerate(rows):
            ids_BT[row, : len(ids)] = torch.tensor(ids)
            seen_BT[row, prefix + len(ids) :] = 0
        shared = DynamicCache()
        for layer, (keys, values) in enumerate(cache):
            shared.update(keys.expand(len(rows), -1, -1, -1), values.expand(len(rows), -1, -1, -1), layer)
        hidden_BTD: Tensor = self._model.base_model(
            input_ids=ids_BT, attention_mask=seen_BT, past_key_values=shared, use_cache=True
        ).last_hidden_state
        last_B = torch.tensor([len(ids) - 1 for ids in rows])
        return hidden_BTD[torch.arange(len(rows)), last_B][: len(suffixes)], hidden_BTD

    @torch.no_grad()
    def write(self, messages: Sequence[Message], limit: int) -> tuple[str, int, int]:
        """Return the likeliest answer to a conversation, and the tokens read and written.

        The first two messages are the system's and the user's. What was computed of the constant part and of the
        conversation's earlier turns is not computed again; nothing else is kept, so that an answer does not depend on
        which conversations came before.
        """
        turns = [self._begin(_role(message)) + message["content"] + self._template.end for message in messages]
        head = turns[0] + self._begin("user")
        read = self._encode(head) + self._encode("".join(turns)[len(head) :] + self._begin("assistant"))
        cache = self._begun(messages, read)
        ids = torch.tensor([read])
        stop = self._tokenizer.token_to_id(self._template.stop)
        out = self._model.generate(
            ids,
            attention_mask=torch.ones_like(ids),
            past_key_values=cache,
            do_sample=False,
            max_new_tokens=limit,
            eos_token_id=stop,
            pad_token_id=stop,
        )
        self._talk = out[0].tolist(), cache
        written = out[0, ids.shape[1] :].tolist()
        return self._tokenizer.decode(written), ids.shape[1], len(written)

    def _begun(self, messages: Sequence[Message], read: list[int]) -> Any:
        """Return the key/value cache of how a conversation begins: its turns so far or, at first, the constant part."""
        from transformers import DynamicCache

        if len(messages) > 2 and self._talk is not None:
            said, cache = self._talk
            same = next((i for i, (a, b) in enumerate(zip(said, read, strict=False)) if a != b), len(said))
        else:
            same, layers = self._prefix(messages[0]["content"])
            cache = DynamicCache()
            for layer, (keys, values) in enumerate(layers):
                cache.update(keys, values, layer)
        surplus = cache.get_seq_length() - min(same, len(read) - 1)
        if surplus > 0:
            cache.crop(-surplus)
        return cache

    @torch.no_grad()
    def _prefix(self, system: str) -> tuple[int, list[tuple[Tensor, Tensor]]]:
        """Return the number of tokens and the key/value cache of the constant part."""
        if system not in self._prefixes:
            ids = torch.tensor(
                [self._encode(self._begin("system") + system + self._template.end + self._begin("user"))]
            )
            cache = self._model.base_model(input_ids=ids, use_cache=True).past_key_values
            self._prefixes[system] = ids.shape[1], [(layer.keys, layer.values) for layer in cache.layers]
        return self._prefixes[system]


class LocalChat:
    """A local model that converses (:class:`rapid.teacher.conversation.Chat`), with the plain-text protocol."""

    native_tools = False

    def __init__(self, model: LocalModel, limit: int) -> None:
        self._model, self._limit = model, limit

    def ask(
        self,
        messages: Sequence[Message],
        tools: list[dict[str, Any]],
        schema: dict[str, Any] | None,
        logprobs: bool = False,
    ) -> Reply:
        """Answer a conversation; tools and schema are described in the messages already, probabilities not given."""
        text, tokens_in, tokens_out = self._model.write(messages, self._limit)
        return Reply(text, (), tokens_in, tokens_out)


def _role(message: dict[str, Any]) -> str:
    return "user" if message["role"] == "tool" else str(message["role"])
