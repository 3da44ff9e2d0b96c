"""The decision loop: scene, facts, prompt, model, decision."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.scenarios import NUM_ACTIONS
from rapid.seeding import stream_seed
from rapid.teacher.decision import Decision, Teacher
from rapid.teacher.facts import Facts, gather
from rapid.teacher.prompt import ANSWER_START, WORDS, calibration, digest, outcome, prompt_version
from rapid.teacher.scene import read_scenes

_VOCABULARY = [WORDS[action] for action in range(NUM_ACTIONS)]


class Scorer(Protocol):
    """A model that can say how likely each of a few words is as the continuation of a prompt."""

    def score(
        self, system: str, users: Sequence[str], opening: str, words: Sequence[str]
    ) -> tuple[NDArray[np.float64], list[int]]:
        """See :meth:`rapid.teacher.local.LocalModel.score`."""
        ...


class ScoringTeacher:
    """Digest style with a model that scores: the likeliest available word is the decision, the rest the soft label.

    Small models lean towards some words whatever they are told, so the mean score that a word has over prompts which
    name every action alike is subtracted first. With a `shuffle_seed`, the facts of the available actions change
    places: the control that shows whether the model uses what it is told.
    """

    def __init__(self, model: Scorer, identity: dict[str, Any], lanes: int, shuffle_seed: int | None = None) -> None:
        self.name = str(identity["model"]) + (" (facts shuffled)" if shuffle_seed is not None else "")
        self._model, self._identity, self._lanes, self._shuffle_seed = model, identity, lanes, shuffle_seed
        self._leaning_A: NDArray[np.float64] | None = None

    def describe(self) -> dict[str, Any]:
        """Return the teacher's identity."""
        return {**self._identity, "style": "digest", "prompt": prompt_version(self._lanes)} | (
            {} if self._shuffle_seed is None else {"facts": "shuffled"}
        )

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`."""
        start = time.perf_counter()
        all_facts = [gather(scene) for scene in read_scenes(obs_BVF, self._lanes)]
        if not all_facts:
            return []
        if self._shuffle_seed is not None:
            if keys_B is None:
                raise RapidError("Shuffled facts are drawn at random: pass `keys_B`, one number per decision.")
            all_facts = [
                _shuffled(facts, (self._shuffle_seed, int(key))) for facts, key in zip(all_facts, keys_B, strict=True)
            ]
        prompts = [digest(facts) for facts in all_facts]
        scores_BA, tokens = self._model.score(
            prompts[0].system, [prompt.user for prompt in prompts], ANSWER_START, _VOCABULARY
        )
        scores_BA = scores_BA - self._leaning()
        seconds = (time.perf_counter() - start) / len(prompts)
        decisions: list[Decision] = []
        for facts, prompt, scores_A, count in zip(all_facts, prompts, scores_BA, tokens, strict=True):
            probabilities_A = softmax_over(scores_A, facts.available)
            action = int(probabilities_A.argmax())
            decisions.append(
                Decision(
                    action,
                    answer=WORDS[action],
                    probabilities=tuple(probabilities_A.tolist()),
                    told=prompt.user,
                    computed=outcome(facts, action),
                    prompt_hash=prompt.hash,
                    status="ok",
                    tokens_in=count,
                    tokens_out=1,
                    seconds=seconds,
                )
            )
        return decisions

    def _leaning(self) -> NDArray[np.float64]:
        if self._leaning_A is not None:
            return self._leaning_A
        prompts = calibration(self._lanes)
        users = [prompt.user for prompt in prompts]
        leaning_A = self._model.score(prompts[0].system, users, ANSWER_START, _VOCABULARY)[0].mean(0)
        self._leaning_A = leaning_A
        return leaning_A


def _shuffled(facts: Facts, key: tuple[int, int]) -> Facts:
    """Return the facts with those of the available actions dealt out anew."""
    dealt = np.arange(NUM_ACTIONS)
    available = list(facts.available)
    dealt[available] = np.random.default_rng((key[0], key[1] & (2**64 - 1))).permutation(available)
    return dataclasses.replace(facts, told=tuple(dealt.tolist()))


def softmax_over(scores_A: NDArray[np.float64], available: Sequence[int]) -> NDArray[np.float64]:
    """Return the probabilities of the available actions; the others have none."""
    masked_A = np.full(NUM_ACTIONS, -np.inf)
    masked_A[list(available)] = scores_A[list(available)]
    weights_A = np.exp(masked_A - masked_A.max())
    return weights_A / weights_A.sum()


def make_model_teacher(config: TeacherConfig, lanes: int, seed: int) -> Teacher:
    """Return the teacher of a backend that needs a model; see :func:`rapid.teacher.make_teacher`."""
    from rapid.teacher.conversation import ConversingTeacher
    from rapid.teacher.memory import open_memory

    memory = open_memory(config)
    identity = {"backend": config.backend, "model": config.model}
    if config.backend == "replay":
        from rapid.teacher.replay import Replay

        return Replay(config, lanes, memory)
    if config.backend == "endpoint":
        from rapid.teacher.endpoint import Endpoint

        endpoint = Endpoint(config)
        identity = {**identity, "base_url": config.base_url}
        return ConversingTeacher(endpoint, config, identity, lanes, memory, endpoint.greet)
    from rapid.teacher.local import LocalChat, LocalModel
    from rapid.teacher.models import dense_folder

    folder, digest_sha256, template = dense_folder(config.model)
    writes = config.style == "react" or len(memory) > 0 or config.reflect
    model = LocalModel(folder, template, rounded=writes)
    identity = {**identity, "weights_sha256": digest_sha256}
    if writes:
        identity["arithmetic"] = "int8" if model.rounded else "float32"
        return ConversingTeacher(LocalChat(model, config.max_answer_tokens), config, identity, lanes, memory)
    return ScoringTeacher(
        model, identity, lanes, stream_seed(seed, "teacher/shuffle") if config.shuffle_facts else None
    )
