"""The decision loop: scene, facts, prompt, model, decision."""

import json
import time
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rapid.config import TeacherConfig
from rapid.scenarios import NUM_ACTIONS
from rapid.teacher.decision import Decision, Teacher
from rapid.teacher.facts import gather
from rapid.teacher.prompt import ANSWER_START, WORDS, content_free, digest, outcome, prompt_version
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

    Small models lean towards some words whatever they are told, so the score that a word has under a prompt without
    content is subtracted first.
    """

    def __init__(self, model: Scorer, identity: dict[str, Any], lanes: int) -> None:
        self.name = str(identity["model"])
        self._model, self._identity, self._lanes = model, identity, lanes
        self._leaning_A: NDArray[np.float64] | None = None

    def describe(self) -> dict[str, Any]:
        """Return the teacher's identity."""
        return {**self._identity, "style": "digest", "prompt": prompt_version(self._lanes)}

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
                    explanation=f"{WORDS[action]}: {outcome(facts, action)}",
                    answer=WORDS[action],
                    probabilities=tuple(probabilities_A.tolist()),
                    prompt_hash=prompt.hash,
                    status="ok",
                    tokens_in=count,
                    tokens_out=1,
                    seconds=seconds,
                    transcript=json.dumps([{"role": "user", "content": prompt.user}]),
                )
            )
        return decisions

    def _leaning(self) -> NDArray[np.float64]:
        if self._leaning_A is not None:
            return self._leaning_A
        neutral = content_free(self._lanes)
        leaning_A = self._model.score(neutral.system, [neutral.user], ANSWER_START, _VOCABULARY)[0][0]
        self._leaning_A = leaning_A
        return leaning_A


def softmax_over(scores_A: NDArray[np.float64], available: Sequence[int]) -> NDArray[np.float64]:
    """Return the probabilities of the available actions; the others have none."""
    masked_A = np.full(NUM_ACTIONS, -np.inf)
    masked_A[list(available)] = scores_A[list(available)]
    weights_A = np.exp(masked_A - masked_A.max())
    return weights_A / weights_A.sum()


def make_model_teacher(config: TeacherConfig, lanes: int, seed: int) -> Teacher:
    """Return the teacher of a backend that needs a model; see :func:`rapid.teacher.make_teacher`."""
    from rapid.teacher.local import LocalModel
    from rapid.teacher.models import dense_folder

    folder, digest, template = dense_folder(config.model)
    identity = {"backend": "local", "model": config.model, "weights_sha256": digest}
    return ScoringTeacher(LocalModel(folder, template), identity, lanes)
