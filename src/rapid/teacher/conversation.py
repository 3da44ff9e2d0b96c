"""A teacher that converses: digest or react, tools, one repair, and a counted fallback; whatever the server does.

In `digest` style one word is asked for, so that the probabilities of the tokens at that place, where a server gives
them, are a soft label. In `react` style the decision follows from what was said before it and is certain by then.

Each conversation is a generator that yields what it asks (:func:`rapid.teacher.chat.converse`).
"""

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rapid.config import TeacherConfig
from rapid.errors import RapidError, sentence
from rapid.progress import warn
from rapid.scenarios import IDLE
from rapid.teacher.answers import EXPLANATION_LIMIT, Choice, read_choice, spoken
from rapid.teacher.briefing import DECISION_SCHEMA, briefing, repair_request, tool_result
from rapid.teacher.calls import read_call
from rapid.teacher.chat import (
    BatchChat,
    Chat,
    ChatError,
    Conversation,
    Reply,
    attend,
    converse,
    patience_of,
)
from rapid.teacher.decision import (
    NO_ANSWER,
    Decision,
    InterruptedDecisions,
    RefusedError,
    UnfinishedError,
    UnreachableError,
)
from rapid.teacher.experience import Experience
from rapid.teacher.facts import Facts, gather, safest
from rapid.teacher.lessons import learn
from rapid.teacher.logprobs import action_probabilities
from rapid.teacher.memory import Episode, Memory, identify, show
from rapid.teacher.patience import StoppedError
from rapid.teacher.prompt import outcome
from rapid.teacher.reflection import reflection_prompt
from rapid.teacher.scene import read_scenes
from rapid.teacher.talk import Talk, ask, opening, was_cut
from rapid.teacher.tools import call_tool, tool_specifications

T = TypeVar("T")

FAILURES_IN_A_ROW = 5
"""Conversations lost to the server, one after the other, after which it is taken to be down."""


def _done(greet: Callable[[], None]) -> bool:
    greet()
    return True


class ConversingTeacher:
    """Asks a chat model about many worlds at once; reminds it of similar situations, if there is a memory.

    `memory` is only read. `greet` looks whether the model's server is there; then one decision is asked for before any
    that counts. It implements :class:`rapid.teacher.memory.Reflective` too.
    """

    def __init__(
        self,
        chat: Chat | BatchChat,
        config: TeacherConfig,
        identity: dict[str, Any],
        lanes: int,
        memory: Memory | None = None,
        greet: Callable[[], None] | None = None,
    ) -> None:
        shots = f", {config.few_shot}-shot" if config.few_shot else ""
        self.name = f"{config.model} ({config.style}{shots})"
        self.memory, self.reflects = memory or Memory(), config.reflect
        self._chat, self._config, self._identity, self._lanes = chat, config, identity, lanes
        self._failures = 0
        self._greet, self._patience = greet, patience_of(chat)
        self._greetings: list[Decision] = []

    def describe(self) -> dict[str, Any]:
        """Return the teacher's identity."""
        facts = gather(read_scenes(np.zeros((1, 1, 5), np.float32), self._lanes)[0])
        prompt = briefing(facts, None, self._config.style, False, [""] if self._config.few_shot else [])
        identity = {**self._identity, "style": self._config.style, "prompt": prompt.hash[:16]}
        identity |= identify(self.memory, self._config.few_shot)
        if self.reflects:
            identity["reflection"] = reflection_prompt([facts], [Decision(IDLE)], 0).hash[:16]
        return identity

    def decide(
        self,
        obs_BVF: NDArray[np.float32],
        previous: Sequence[Decision | None],
        keys_B: NDArray[np.int64] | None = None,
    ) -> list[Decision]:
        """Decide for each world; see :meth:`rapid.teacher.decision.Teacher.decide`.

        Raises:
            RapidError: also if the server refuses the key or the model.
            UnreachableError: the server seems to be down.
            UnfinishedError: the time set by :meth:`end_by` was over before.
            InterruptedDecisions: the user interrupted.
        """
        all_facts = [gather(scene) for scene in read_scenes(obs_BVF, self._lanes)]
        self.get_ready()
        start = time.perf_counter()
        decisions = self._all_of([self._decide(*given) for given in zip(all_facts, previous, strict=True)])
        if isinstance(self._chat, BatchChat):
            seconds = (time.perf_counter() - start) / max(len(decisions), 1)
            decisions = [dataclasses.replace(decision, seconds=seconds) for decision in decisions]
        try:
            for decision in decisions:
                self._watch(decision.error if decision.unanswered else "")
        except UnreachableError as error:
            error.decisions = decisions
            raise
        return decisions

    def look_back(self, episodes: Sequence[Episode]) -> Iterator[Experience]:
        """Give one experience for each episode; see :class:`rapid.teacher.memory.Reflective`."""
        broken_off, given_up = False, None
        lessons = [learn(episode, self._lanes, self._config, self._patience) for episode in episodes]
        # To its end, where it raises what broke it off.
        for result in self._lead(lessons):
            if result is None:
                broken_off = True
                continue
            experience, fault = result
            if not (broken_off or given_up):
                try:
                    self._watch(fault)
                except UnreachableError as error:
                    given_up = error
                    # The others are let go, which counts those under way.
                    self._patience.drop()
                else:
                    yield experience
                    continue
            # A memory is in the order of its episodes: what comes after a gap is asked again.
            if experience.tokens_in:
                self._patience.lose()
        if given_up:
            raise given_up
        if broken_off:
            raise StoppedError(self._patience.reason)

    @property
    def lost(self) -> int:
        """Decisions and lessons that were broken off although something may have been paid for them."""
        return self._patience.lost

    def end_by(self, moment: float, reason: str) -> None:
        """Wait for nothing beyond `moment`; see :class:`rapid.teacher.decision.Timed`."""
        self._patience.end_by(moment, reason)

    @property
    def greetings(self) -> Sequence[Decision]:
        """Decisions that were paid for before anything was driven."""
        return self._greetings

    def get_ready(self) -> None:
        """Look whether the server is there and answers a question; see :class:`rapid.teacher.decision.Timed`.

        Raises:
            RapidError: also if the server refuses the key or the model.
            UnreachableError: it gives no answer.
            StoppedError: the time set by :meth:`end_by` was over before.
        """
        if self._greet is None:
            return
        # To its end, where it raises what broke it off.
        if list(attend([partial(_done, self._greet)], self._patience)) == [None]:
            raise StoppedError(self._patience.reason)
        facts = gather(read_scenes(np.zeros((1, 1, 5), np.float32), self._lanes)[0])
        decision: Decision | None = None
        for decision in self._lead([self._decide(facts, None)]):
            if decision is not None and decision.tokens_in:
                self._greetings.append(decision)
        if decision is None:
            raise StoppedError(self._patience.reason)
        if decision.unanswered:
            raise UnreachableError(
                f"{self._patience.name} was asked for one decision: {sentence(decision.error)} Nothing was driven. Are "
                "address, model and key right?"
            )
        self._greet = None
        if decision.status == "fallback":
            warn(
                f"{self._patience.name} was asked for one decision before driving, and its answer was none. "
                f"{sentence(decision.error)} It said: {decision.answer[:200]!r}"
            )

    def _all_of(self, conversations: Sequence[Conversation[Decision]]) -> list[Decision]:
        """Return what came of all conversations; whoever breaks them off is handed what came until then."""
        made: list[Decision | None] = []
        try:
            made.extend(self._lead(conversations))
        except KeyboardInterrupt:
            all_of = [*made, *[None] * (len(conversations) - len(made))]
            raise InterruptedDecisions(all_of) from None
        except StoppedError:
            raise
        except RapidError as error:
            raise RefusedError(str(error), made) from error
        decisions = [decision for decision in made if decision is not None]
        if len(decisions) < len(made):
            raise UnfinishedError(self._patience.reason, made)
        return decisions

    def _lead(self, conversations: Sequence[Conversation[T]]) -> Iterator[T | None]:
        return converse(conversations, self._chat, self._config.concurrency)

    def _watch(self, fault: str) -> None:
        """Count what was lost to the server, and stop if it seems to be down."""
        self._failures = self._failures + 1 if fault else 0
        if self._failures >= FAILURES_IN_A_ROW:
            raise UnreachableError(
                f"The model's server failed {self._failures} decisions in a row; the last time: {sentence(fault)} "
                "Is it running and reachable? What was decided with it is kept: run the same command again."
            )

    def _decide(self, facts: Facts, previous: Decision | None) -> Conversation[Decision]:
        start = time.perf_counter()
        examples = [show(experience) for experience in self.memory.recall(facts.scene, self._config.few_shot)]
        prompt = briefing(facts, previous, self._config.style, self._chat.native_tools, examples)
        talk = Talk(opening(prompt))
        choice = Choice(None)
        try:
            choice = yield from self._reason(talk, facts)
            if choice.action is None:
                choice = yield from self._correct(talk, facts, choice.fault)
        except ChatError as error:
            talk.retries += error.retries
            talk.faults.append(f"{NO_ANSWER}: {error}")
        except RapidError as error:
            talk.break_off(error, self._patience)
            raise
        status, action, computed, probabilities = "repaired" if talk.faults else "ok", choice.action, "", None
        if action is None:
            action, status = safest(facts), "fallback"
            computed = "the rule's choice, since no answer could be used: "
        else:
            probabilities = action_probabilities(talk.tokens, action, facts.available)
        return Decision(
            action,
            # Our own words, repeated, are no reason of the model's.
            explanation="" if choice.explanation == outcome(facts, action) else choice.explanation,
            answer=talk.answer[: 4 * EXPLANATION_LIMIT],
            probabilities=probabilities,
            told=prompt.user,
            computed=computed + outcome(facts, action),
            turns=json.dumps(talk.messages[2:]),
            prompt_hash=prompt.hash,
            status=status,
            served=talk.served,
            # The transport's error goes first: it says why there was no answer at all.
            error=" ".join(map(sentence, reversed(talk.faults))),
            retries=talk.retries,
            tokens_in=talk.tokens_in,
            tokens_out=talk.tokens_out,
            seconds=time.perf_counter() - start,
            cost=talk.cost(self._config),
        )

    def _reason(self, talk: Talk, facts: Facts) -> Conversation[Choice]:
        """Let the model call tools until it answers without a call, or its turns are used up."""
        if self._config.style == "digest":
            return (yield from self._conclude(talk, facts))
        tools = tool_specifications()
        for _ in range(self._config.max_turns):
            reply = yield from ask(talk, tools, None)
            called = read_call(spoken(reply.text)[0]) if not reply.calls else None
            if reply.calls:
                for call in reply.calls:
                    result = call_tool(facts, call.name, call.arguments)
                    talk.messages.append({"role": "tool", "tool_call_id": call.id, "content": result})
            elif called:
                talk.messages.append({"role": "user", "content": tool_result(call_tool(facts, *called))})
            else:
                return self._read(talk, reply, facts, words=False)
        return (yield from self._correct(talk, facts, "No more tool calls."))

    def _correct(self, talk: Talk, facts: Facts, fault: str) -> Conversation[Choice]:
        talk.messages.append({"role": "user", "content": repair_request(fault, facts, self._config.style)})
        return (yield from self._conclude(talk, facts))

    def _conclude(self, talk: Talk, facts: Facts) -> Conversation[Choice]:
        """Let the model decide without any more tools: with one word, or by the schema."""
        one_word = self._config.style == "digest"
        reply = yield from ask(talk, [], None if one_word else DECISION_SCHEMA, one_word)
        return self._read(talk, reply, facts, words=True)

    def _read(self, talk: Talk, reply: Reply, facts: Facts, words: bool) -> Choice:
        """Read a reply as a decision, and note why it is none, with what the user could do about it."""
        tools = self._config.style == "react"
        if reply.calls:
            choice = Choice(None, fault="That was a call, not a decision." if tools else "There are no tools to call.")
        elif reply.reasoning and not reply.text.strip():
            choice = Choice(None, fault="The answer is thinking only, and holds no decision.")
        else:
            choice = read_choice(reply.text, facts, words=words, cut=was_cut(reply), tools=tools)
        if choice.action is None:
            limit = f" It was cut off at --teacher.max-answer-tokens {self._config.max_answer_tokens}."
            talk.faults.append(choice.fault + (limit if was_cut(reply) else ""))
        return choice
