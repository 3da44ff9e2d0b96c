"""A language model in this process, which scores words or writes: many prompts at once, on a CPU.

Speed of scoring comes from three things. The key/value cache of the constant part of the prompt is computed once.
Prompts of many worlds run through the model together. And the candidates are single tokens, so one pass over the short
changing part gives the probability of every action. To write is many times slower: each token takes a pass over all
weights, which the conversations of many worlds share.
"""

import gc
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rapid.teacher import int8
from rapid.teacher.calls import is_finished
from rapid.teacher.chat import Message, Reply, Request

ROWS = 16
"""Prompts in one pass; more gain nothing and cost memory."""
PAD = 16
"""What is read together is padded to a multiple of this, and what would be alone is doubled: then the same kernels run
and sums have the same order whatever the company (measured on AVX-512: scores are the same bits in any batch)."""
TALKS = 32
"""Conversations that are answered side by side. Each token written costs one pass over all weights, which a CPU fetches
as slowly for one conversation as for many."""
REMEMBERED = 4096
"""Prompts whose scores are kept."""


class _Template(NamedTuple):
    """How a chat is written for a model."""

    begin: str
    end: str
    stop: str


_TEMPLATES = {"chatml": _Template("<|im_start|>{role}\n", "<|im_end|>\n", "<|im_end|>")}


@dataclass
class _Talk:
    """A conversation and the answer that is being written."""

    turns: tuple[str, ...]
    read: list[int]
    layers: list[tuple[Tensor, Tensor]]
    """Keys and values of the first tokens of `read`, later of all of them and of `written` but the last."""
    written: list[int] = field(default_factory=list[int])
    text: str = ""


class LocalModel:
    """A causal language model from a folder that transformers reads.

    Args:
        folder: ``config.json``, ``model.safetensors`` and ``tokenizer.json``.
        template: name of the chat template.
        rounded: whether linear layers calculate in 8 bits, where the processor is fast at that
            (:mod:`rapid.teacher.int8`): for a model that writes.
    """

    def __init__(self, folder: Path, template: str = "chatml", rounded: bool = False) -> None:
        from tokenizers import Tokenizer
        from transformers import AutoModelForCausalLM
        from transformers.utils import logging

        logging.disable_progress_bar()
        self._tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
        self._model: Any = AutoModelForCausalLM.from_pretrained(folder, dtype=torch.float32).eval()
        # Words are scored with the head in float32, so it stays in memory even where layers are rounded.
        self._head: Tensor = self._model.get_output_embeddings().weight.detach()
        self.rounded = rounded and int8.is_fast()
        """Whether it is so."""
        if self.rounded:
            int8.to_int8(self._model)
        self._template = _TEMPLATES[template]
        self._prefixes: dict[str, Any] = {}
        self._talks: dict[tuple[str, ...], _Talk] = {}
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
        length = _padded(max(map(len, rows)))
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

    def write(
        self,
        conversations: Sequence[Sequence[Message]],
        limit: int,
        finished: Callable[[str], bool] = lambda text: False,
    ) -> list[tuple[str, int, int]]:
        """Return the likeliest answer to every conversation, and the tokens read and written.

        The first two messages of each are the system's and the user's. What was computed of the constant part is not
        computed again, nor a conversation's earlier turns, if the call before this one answered the last of them and
        :meth:`end` was not called since. Nothing else is kept, so that an answer does not depend on which conversations
        came before; nor on those beside it, as far as was measured: SmolLM2 wrote the same texts alone and in batches
        of 5 and 8, rounded or not, thanks to `PAD`, without which rounding to 8 bits blew up last bits to other words.

        Args:
            conversations: each a list of messages that ends with a user's.
            limit: tokens that one answer may have.
            finished: says of a text that nothing more is wanted; what a model would add is not written.
        """
        talks = [self._begin_talk(messages) for messages in conversations]
        self._talks = {}
        for first in range(0, len(talks), TALKS):
            self._answer(talks[first : first + TALKS], limit, finished)
        self._talks = {(*talk.turns, talk.text): talk for talk in talks}
        return [(talk.text, len(talk.read), len(talk.written)) for talk in talks]

    def end(self) -> None:
        """Drop what was computed of conversations, which are over."""
        self._talks = {}

    def _begin_talk(self, messages: Sequence[Message]) -> "_Talk":
        """Return a conversation with the cache of how it begins: its turns so far or, at first, the constant part."""
        turns = tuple(str(message["content"]) for message in messages)
        said = [self._begin(_role(message)) + str(message["content"]) + self._template.end for message in messages]
        head = said[0] + self._begin("user")
        read = self._encode(head) + self._encode("".join(said)[len(head) :] + self._begin("assistant"))
        # More than one message may follow the last answer.
        known_turns = (turns[:end] for end in range(len(turns) - 1, 0, -1))
        if earlier := next((self._talks[known] for known in known_turns if known in self._talks), None):
            known, layers = earlier.read + earlier.written, earlier.layers
            # What is read again may fall into other tokens than it was written in.
            same = next((i for i, (a, b) in enumerate(zip(known, read, strict=False)) if a != b), len(known))
            same = min(same, layers[0][0].shape[2])
            layers = [(keys[:, :, :same], values[:, :, :same]) for keys, values in layers]
        else:
            layers = self._prefix(turns[0])[1]
        return _Talk(turns, read, layers)

    @torch.no_grad()
    def _answer(self, talks: Sequence["_Talk"], limit: int, finished: Callable[[str], bool]) -> None:
        """Write the answers of conversations, one token of each at a time; who is done leaves the batch."""
        stop = self._tokenizer.token_to_id(self._template.stop)
        talks = _not_alone(talks)
        cache, seen_BT = _side_by_side([talk.layers for talk in talks])
        unread = [talk.read[talk.layers[0][0].shape[2] :] for talk in talks]
        while talks:
            lengths_B = torch.tensor([len(ids) for ids in unread])
            longest = max(map(len, unread))
            steps_T = torch.arange(longest if longest == 1 else _padded(longest))
            ids_BT = torch.tensor([ids + [0] * (len(steps_T) - len(ids)) for ids in unread])
            positions_BT = seen_BT.sum(1, keepdim=True) + steps_T
            seen_BT = torch.cat([seen_BT, steps_T < lengths_B[:, None]], 1)
            hidden_BTD: Tensor = self._model.base_model(
                input_ids=ids_BT,
                attention_mask=seen_BT.long(),
                position_ids=positions_BT,
                past_key_values=cache,
                use_cache=True,
            ).last_hidden_state
            chosen_B = (
                self._model.get_output_embeddings()(hidden_BTD[range(len(talks)), lengths_B - 1]).argmax(-1).tolist()
            )
            for talk, token in zip(talks, chosen_B, strict=True):
                talk.written.append(token)
                talk.text = self._tokenizer.decode(talk.written)
            on = [
                row
                for row, talk in enumerate(talks)
                if talk.written[-1] != stop and len(talk.written) < limit and not finished(talk.text)
            ]
            if len(on) < len(talks):
                for row in set(range(len(talks))) - set(on):
                    seen_T = seen_BT[row]
                    talks[row].layers = [
                        (layer.keys[row : row + 1, :, seen_T], layer.values[row : row + 1, :, seen_T])
                        for layer in cache.layers
                    ]
                talks, on = _not_alone([talks[row] for row in on]), on * 2 if len(on) == 1 else on
                seen_BT = seen_BT[on]
                cache.batch_select_indices(torch.tensor(on, dtype=torch.long))
            unread = [talk.written[-1:] for talk in talks]

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
    """A local model that converses, with the plain-text protocol (:class:`rapid.teacher.chat.BatchChat`)."""

    native_tools = False

    def __init__(self, model: LocalModel, limit: int) -> None:
        self._model, self._limit = model, limit

    def ask_together(self, requests: Sequence[Request]) -> list[Reply]:
        """Answer conversations; tools and schema are described in the messages already, probabilities not given."""
        answers = self._model.write([request.messages for request in requests], self._limit, is_finished)
        return [Reply(text, (), tokens_in, tokens_out) for text, tokens_in, tokens_out in answers]

    def end(self) -> None:
        """Free the memory that the conversations took."""
        self._model.end()


def _padded(length: int) -> int:
    return -(-length // PAD) * PAD


def _not_alone(talks: Sequence[_Talk]) -> list[_Talk]:
    """Return the conversations; a lone one with a twin: see `PAD`."""
    return [*talks, replace(talks[0], written=[*talks[0].written])] if len(talks) == 1 else list(talks)


def _side_by_side(rows: Sequence[list[tuple[Tensor, Tensor]]]) -> tuple[Any, Tensor]:
    """Return the caches of several conversations as one, and which of its places are taken (B x T)."""
    from transformers import DynamicCache

    lengths = [layers[0][0].shape[2] for layers in rows]
    longest = _padded(max(lengths))

    def stacked(parts: Iterable[Tensor]) -> Tensor:
        return torch.cat([torch.nn.functional.pad(part, (0, 0, 0, longest - part.shape[2])) for part in parts])

    cache = DynamicCache()
    for layer in range(len(rows[0])):
        keys, values = (stacked(layers[layer][which] for layers in rows) for which in (0, 1))
        cache.update(keys, values, layer)
    return cache, torch.arange(longest) < torch.tensor(lengths)[:, None]


def _role(message: dict[str, Any]) -> str:
    return "user" if message["role"] == "tool" else str(message["role"])
