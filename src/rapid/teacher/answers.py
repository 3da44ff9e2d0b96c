"""What counts as a decision: an answer in which a careful reader would find one action, and one only.

A wrong label is worse than none, since nobody sees it afterwards: whatever leaves a doubt is refused, and the model is
asked once more. What is said before or beside the answer does not count: thinking, the marks of a chat template, and
the arguments of a tool.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

from rapid.scenarios import NUM_ACTIONS
from rapid.teacher.calls import is_call, objects_in, without_objects
from rapid.teacher.facts import Facts
from rapid.teacher.prompt import WORDS
from rapid.teacher.tools import action_named

EXPLANATION_LIMIT = 300
"""Characters of an explanation that are kept and fed back."""

_PLACEHOLDERS = ("at most ten words", "one sentence", "explanation", "reason", "your reason", "lesson", "")
"""What a model copies from the form of the answer: it explains nothing."""

_THOUGHT = r"(?:think|thinking|thoughts?|reasoning|reflection|scratchpad|analysis)"
_THINKING = re.compile(rf"[<\[◁]\s*(/?)\s*{_THOUGHT}\s*[>\]▷]", re.IGNORECASE)
_FINAL_CHANNEL = re.compile(r"<\|channel\|>\s*final\s*(?:<\|constrain\|>\w*)?\s*<\|message\|>", re.IGNORECASE)
_START = re.compile(
    r"(?:\s|<s>|<bos>|<\|begin_of_text\|>|<\|im_start\|>\s*assistant|<\|start_header_id\|>\s*assistant\s*"
    r"<\|end_header_id\|>|<start_of_turn>\s*model|<\|assistant\|>|\[/INST\])*",
    re.IGNORECASE,
)
_END = re.compile(r"<[|｜][^<>|｜\s]{1,40}[|｜]>|</s>|<s>|<eos>|<bos>|<(?:start|end)_of_turn>|\[/?INST\]")

_WORD = r"(lane[ _-]?left|lane[ _-]?right|left|right|keep|faster|slower|idle)(?![^\W_])"
_NUMBER = r"([0-4])(?=[\s*_`\"')\]]*(?:$|[,;:!(\-–—]|\.(?!\d)))"
_BEFORE, _AFTER = r"[\s\"'“”‘’`´*_#>•·(\[{<|\-–—…]*", r"[\s\"'“”‘’`´*_)\]}>|.,;:!\-–—…✓✔✅👍]*"
_LONE = re.compile(rf"{_BEFORE}{_WORD}{_AFTER}", re.IGNORECASE)
_LABEL = (
    r"(?:(?:my|the|your|so|thus|therefore|hence|final|next|chosen|best),?[ _]+)*"
    r"(?:(action|answer|response|output)|decision|choice)(?:[ _](?:id|name))?"
)
_FINAL = re.compile(r"\bfinal\b", re.IGNORECASE)
_LABELLED = re.compile(
    # No quotes or braces before it: it is not looked for in what is left of a broken object.
    rf"(?:^|(?<=[.!;:]\s))[\s*_#>`•·(\[<|\-–—…]*({_LABEL})[\s*_`]*(?::|=|-+>|=>|→|\bis\b|\bwill be\b)[\s:*_\"'`“‘(\[<]*"
    rf"(?:{_WORD}|{_NUMBER})(?!-)(.*)",
    re.IGNORECASE,
)
_HEADING = re.compile(rf"{_BEFORE}{_LABEL}{_AFTER}", re.IGNORECASE)
_CHOSEN = re.compile(
    r"(?:^|(?<=[.!;:,]\s)|\b(?:so|thus|therefore|hence)\s)\W*I(?:['’]ll| will| shall)? ?(?:choose|chose|select|pick"
    rf"|take|decide on|decide|go with|opt for)(?: to)?(?: go| drive)?(?: the)?(?: action)?\W{{1,3}}{_WORD}(.*)",
    re.IGNORECASE,
)
_OPENING = re.compile(
    rf"{_BEFORE}{_WORD}[\s\"'”’`*_)\]]*(?:[.:,;!(–—-]|\bbecause\b|\bas\b|\bsince\b)(.*)", re.IGNORECASE
)
_TAGGED = re.compile(r"<(action|answer|decision|output)>\s*(.*?)\s*</\1>", re.IGNORECASE | re.DOTALL)
_BOXED = re.compile(r"\$*\\boxed\{(?:\\text(?:bf)?\{)?\s*([\w ]+?)\s*\}{1,2}\$*")

# Left and right are places too, and some words that sound like doubt are not.
_HARMLESS = re.compile(
    r"\b(?:left|right)(?:most)?(?:-hand)? (?:lane|side)\b|\b(?:on|to|from) (?:the|my) (?:left|right)\b"
    r"|\bno (?:other )?(?:cars?|vehicles?|traffic|conflicts?|risks?|dangers?|crash|collisions?|obstacles?|one)\b"
    r"|\b(?:to |and )?(?:avoid|prevent)(?:s|ing)? (?:an? |the |any )?(?:\w+ )?(?:crash|collisions?|risks?)\b",
    re.IGNORECASE,
)
_DOUBT = re.compile(
    r"n['’]t\b|\b(?:or|not|no|never|but|unless|if|would|could|might|maybe|perhaps|wait|instead|rather|actually|except"
    r"|however|although|then|unsafe|tight|crash\w*|colli\w+|risk\w*|danger\w*|avoid\w*|impossible|cannot|wrong|other)\b"
    r"|[?≠✗❌🚫~]",
    re.IGNORECASE,
)
_RETRACTED = re.compile(r"\b(?:wait|actually|instead|correction|scratch that|on second thought|no,)", re.IGNORECASE)
_POINTING = re.compile(r"\b(?:this|these|that|following|below|next)\W*$", re.IGNORECASE)
_ACTIONS = re.compile(rf"\b{_WORD}", re.IGNORECASE)


@dataclass(frozen=True)
class Choice:
    """A model's final answer: the action or, if `action` is `None`, what is wrong with it, in words for the model."""

    action: int | None
    explanation: str = ""
    """The reason in the model's own words; empty if it gave none."""
    fault: str = ""


def content_of(content: Any) -> tuple[str, str]:
    """Return the text of a message's content, and the thinking that stands in it, from a string or typed chunks.

    Whatever is neither is left out; nothing is raised.
    """
    if isinstance(content, str):
        return content, ""
    said, thought = "", ""
    for chunk in content if isinstance(content, list) else [content]:
        if isinstance(chunk, str):
            said += chunk
        elif isinstance(chunk, dict):
            fields = cast(dict[str, Any], chunk)
            kind = str(fields.get("type", "text"))
            if kind in ("text", "output_text", "refusal"):
                value = fields.get("text", fields.get("refusal"))
                said += (
                    str(value.get("value", "")) if isinstance(value, dict) else value if isinstance(value, str) else ""
                )
            elif kind in ("thinking", "reasoning", "reasoning_content"):
                thought += "".join(content_of(fields.get(kind, fields.get("text", fields.get("content")))))
    return said, thought


def spoken(text: str) -> tuple[str, bool]:
    """Return what is said in a text without thinking and template marks, and whether the thinking came to its end."""
    if "<|channel|>" in text:
        finals = list(_FINAL_CHANNEL.finditer(text))
        if not finals:
            return "", False
        text = text[finals[-1].end() :]
    kept, depth, position = "", 0, 0
    for mark in _THINKING.finditer(text):
        if depth == 0:
            kept += text[position : mark.start()]
        if not mark[1]:
            depth += 1
        elif depth:
            depth -= 1
        else:
            kept = ""  # the mark that opens it stands in the template
        position = mark.end()
    if depth:
        return "", False
    kept += text[position:]
    start = _START.match(kept)
    kept = kept[start.end() if start else 0 :]
    end = _END.search(kept)
    # What stands behind the end of a turn is another turn, made up.
    return (kept[: end.start()] if end else kept).strip(), True


def read_choice(
    text: str, facts: Facts, reason: str = "explanation", *, words: bool = True, cut: bool = False, tools: bool = True
) -> Choice:
    """Read a final answer.

    Args:
        text: what the model said.
        facts: those of the scene; only an action that is possible there is a decision.
        reason: the field of a JSON object that becomes the explanation.
        words: whether a word does, and an object that holds the action alone. In `react` style, before the model was
            asked to decide, they answer "which do you forecast first?".
        cut: whether the server ended the answer because it had the length allowed: then only a whole object counts.
        tools: whether the model may have called one.
    """
    said, ended = spoken(text)
    if not ended:
        return Choice(None, fault="The answer is thinking only, and holds no decision.")
    if not said:
        return Choice(None, fault="The answer was empty.")
    if is_call(said):
        return Choice(None, fault="That was a call, not a decision." if tools else "There are no tools to call.")
    objects = [found for found in objects_in(said) if _action_of(found) is not _ABSENT]
    try:
        if objects:
            return _from_objects(objects, said, facts, reason, words)
        if not words:
            return Choice(None, fault="The answer holds no JSON object.")
        if cut:
            return Choice(None, fault="The answer was cut off. Be brief.")
        actions = list(_stated(without_objects(said)))
    except _DoubtError as doubt:
        return Choice(None, fault=str(doubt))
    if not actions:
        return Choice(None, fault="The answer is neither an action nor a JSON object.")
    action, explanation = actions[-1]
    if len({other for other, _ in actions}) > 1:
        return Choice(None, fault="The answer names more than one action.")
    return _checked(action, explanation, facts)


def is_placeholder(explanation: str) -> bool:
    """Whether a reason is none, or the one that stands in the form of the answer."""
    return explanation.strip(" .…\"'").lower() in _PLACEHOLDERS


class _DoubtError(Exception):
    """An answer that may be read in more than one way."""

    def __init__(self) -> None:
        super().__init__("The answer is not one clear decision.")


@dataclass(frozen=True)
class _Statement:
    """A line that reads like a decision."""

    line: int
    action: int
    reason: str = ""
    lone: bool = False
    """Whether the action is all that the line holds."""
    apart: bool = True
    """Whether it is a sentence of its own."""
    final: bool = False
    """Whether it calls itself the decision."""


_ABSENT = object()


def _action_of(found: dict[str, Any]) -> Any:
    """Return what an object says about the action, `_ABSENT` if nothing."""
    named = {key.strip().lower(): value for key, value in found.items()}
    return next((named[key] for key in ("action", "decision", "choice", "answer") if key in named), _ABSENT)


def _from_objects(objects: list[dict[str, Any]], said: str, facts: Facts, reason: str, words: bool) -> Choice:
    values = [_action_of(found) for found in objects]
    actions = [_named(value) for value in values]
    if None in actions:
        return Choice(None, fault=f"The action {json.dumps(values[actions.index(None)])[:80]} does not exist.")
    last = said[said.rfind("}") + 1 :]
    beside = {action for action, _ in _stated(without_objects(said))}
    if len({*actions, *beside}) > 1 or _RETRACTED.search(last):
        return Choice(None, fault="The answer names more than one action.")
    if not words and not any(reason in found for found in objects):
        return Choice(None, fault=f"The answer holds no {reason}.")
    explanation = objects[-1].get(reason)
    action = actions[-1]
    assert action is not None
    return _checked(action, explanation if isinstance(explanation, str) else "", facts)


def _checked(action: int, explanation: str, facts: Facts) -> Choice:
    if action not in facts.available:
        return Choice(None, fault=f"The action {WORDS[action]} is not possible here.")
    # On one line: it is fed back, and must not look like other lines of a prompt.
    explanation = " ".join(explanation.split())
    return Choice(action, "" if is_placeholder(explanation) else explanation[:EXPLANATION_LIMIT])


def _named(value: Any) -> int | None:
    """Return the action that a value in an object means: a name, or its number in highway-env."""
    if isinstance(value, str):
        lone = _LONE.fullmatch(value)
        if lone is not None:
            return _meant(lone[1])
        value = int(value) if value.strip() in map(str, range(NUM_ACTIONS)) else None
    return value if type(value) is int and 0 <= value < NUM_ACTIONS else None


def _meant(word: str) -> int:
    action = action_named(re.sub(r"[ -]", "_", word).replace("lane", "lane_").replace("__", "_"))
    assert action is not None, word
    return action


def _stated(said: str) -> Iterator[tuple[int, str]]:
    """Give every action that a text decides on, with the reason beside it.

    Raises:
        _DoubtError: something reads like a decision and is doubtful.
    """
    said = _BOXED.sub(r"\1", _TAGGED.sub(r"\nDecision: \2\n", said))
    lines = [line.strip() for line in said.split("\n")]
    lines = [line for line in lines if not re.fullmatch(r"`{3,}\w*", line)]
    found: list[_Statement] = []
    for number, line in enumerate(lines):
        if labelled := _LABELLED.search(line):
            action = int(labelled[4]) if labelled[4] else _meant(labelled[3])
            final = not labelled[2] or bool(_FINAL.search(labelled[1]))
            found.append(_Statement(number, action, _support(labelled[5], action), final=final))
        elif chosen := _CHOSEN.search(line):
            action = _meant(chosen[1])
            if _DOUBT.search(_HARMLESS.sub("", line[: chosen.start(1)].rpartition(". ")[2])):
                raise _DoubtError
            found.append(_Statement(number, action, _support(chosen[2], action)))
        elif lone := _LONE.fullmatch(line):
            found.append(_Statement(number, _meant(lone[1]), lone=True, apart=_stands_alone(lines, number)))
        elif not any(lines[:number]) and (opening := _OPENING.match(line)):
            found.append(_Statement(number, _meant(opening[1]), _support(opening[2], _meant(opening[1]))))
    if not found:
        return
    last = found[-1]
    if last.final:
        # Options that were listed before a decision are no decisions.
        found = [one for one in found if not one.lone]
    if not all(one.apart for one in found):
        raise _DoubtError
    behind = _support(" ".join(line for line in lines[last.line + 1 :] if line), last.action)
    for one in found:
        yield one.action, (one.reason or behind) if one is last else one.reason


def _support(rest: str, action: int) -> str:
    """Return what is said behind an action as its reason.

    Raises:
        _DoubtError: it speaks of another action, or against this one.
    """
    rest = rest.strip()
    left = _HARMLESS.sub("", rest)
    if _DOUBT.search(left) or any(_meant(word) != action for word in _ACTIONS.findall(left)):
        raise _DoubtError
    return re.sub(r"^[\W_]+", "", rest) if re.search(r"\w", rest) else ""


def _stands_alone(lines: list[str], number: int) -> bool:
    """Say whether an action alone in a line is a sentence of its own, not a part of one or an example."""
    before = [line for line in lines[:number] if line]
    if before and not (_LONE.fullmatch(before[-1]) or _HEADING.fullmatch(before[-1]) or _LABELLED.search(before[-1])):
        last = before[-1].rstrip("\"'`*_)]”’ ")
        apart = not lines[number - 1] and not last.endswith((":", "?", ",", ";")) and not _DOUBT.search(last)
        if not last.endswith((".", "!", "…")) and not apart:
            return False
        sentence = re.split(r"[.!?] ", last)[-1]
        if _DOUBT.search(sentence) and _POINTING.search(sentence.rstrip(".!")):
            return False
    following = lines[number + 1] if number + 1 < len(lines) else ""
    return not following[:1].islower() or _LONE.fullmatch(following) is not None
