"""How a model that converses learns from an episode: after a crash it is asked once, and once more if need be."""

import dataclasses

from rapid.config import TeacherConfig
from rapid.errors import RapidError
from rapid.teacher.answers import Choice
from rapid.teacher.chat import ChatError, Conversation
from rapid.teacher.decision import NO_ANSWER
from rapid.teacher.experience import Experience
from rapid.teacher.facts import gather
from rapid.teacher.memory import Episode
from rapid.teacher.patience import Patience
from rapid.teacher.reflection import (
    LESSON_SCHEMA,
    experience_of,
    lesson_request,
    moment,
    read_lesson,
    reflection_prompt,
)
from rapid.teacher.scene import read_scenes
from rapid.teacher.talk import Talk, ask, opening, was_cut


def learn(
    episode: Episode, lanes: int, config: TeacherConfig, patience: Patience
) -> Conversation[tuple[Experience, str]]:
    """Return the experience, and what kept the server from answering, if something did."""
    facts_T = [gather(scene) for scene in read_scenes(episode.obs_TVF, lanes)]
    step = moment(episode, facts_T)
    facts = facts_T[step]
    experience = experience_of(episode, facts, step)
    if not episode.crashed:
        return experience, ""
    talk = Talk(opening(reflection_prompt(facts_T, episode.decisions, step)))
    choice, lost = Choice(None), ""
    try:
        reply = yield from ask(talk, [], LESSON_SCHEMA)
        choice = read_lesson(reply.text, facts, was_cut(reply))
        if choice.action is None:
            talk.messages.append({"role": "user", "content": lesson_request(choice.fault, facts)})
            reply = yield from ask(talk, [], LESSON_SCHEMA)
            choice = read_lesson(reply.text, facts, was_cut(reply))
    except ChatError as error:
        lost = f"{NO_ANSWER}: {error}"
    except RapidError as error:
        talk.break_off(error, patience)
        raise
    if choice.action is not None:
        # The reason was that of the decision that led to the crash.
        experience = dataclasses.replace(experience, action=choice.action, explanation="", lesson=choice.explanation)
    spent = {"tokens_in": talk.tokens_in, "tokens_out": talk.tokens_out, "cost": talk.cost(config)}
    return dataclasses.replace(experience, **spent), lost
