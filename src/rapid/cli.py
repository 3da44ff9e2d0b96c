"""The command line: one verb per step of the data's way.

This module answers ``rapid --help`` by itself and imports a verb's machinery only when the verb is called.
"""

import io
import os
import sys
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager

import rapid
from rapid.errors import RapidError, did_you_mean
from rapid.text import printable

SILENCE_S = 1.0
"""Seconds of loading after which a line says so."""

VERBS: dict[str, str] = {
    "run": "do everything: collect, mix, distill, adapt, evaluate, report",
    "collect": "phase 1: let a teacher drive and keep every step",
    "relabel": "phase 1: give collected data the scenario's other reward",
    "mix": "phase 1: mix teacher and random transitions into one dataset",
    "distill": "phase 2: offline RL with the robust term, into a policy",
    "adapt": "phase 3: online DQN, then PPO if asked for, in the target scenario; the distilled policy frozen",
    "adversary": "train an adversary against one agent, to be named among attacks",
    "evaluate": "drive policies and scripted drivers over fixed spawns, clean and attacked",
    "teach-bench": "compare teachers, models and prompt styles on the same spawns",
    "certify": "prove for how many decisions no attack within a radius changes anything",
    "export": "write an agent as ONNX, check it against the original, time it",
    "import": "make an agent of a model that stable-baselines3 saved; nothing is unpickled",
    "report": "write the page of a run again",
    "reproduce": "every table and figure of the paper, obtained beside printed",
    "play": "open a live page: watch agents drive side by side, attack them, drive yourself",
    "presets": "print what a recipe, a scale and a plan set, or where two differ",
    "agents": "list the trained agents that come with the package",
    "push": "put an agent or a dataset on the Hugging Face Hub, with its card",
    "pull": "fetch an agent or a dataset from the Hugging Face Hub, checked",
    "models": "list, fetch, verify and remove the embedded language models",
    "verify-simulator": "hold the compiled simulator against highway-env, step by step",
    "doctor": "check this machine and say what to do about each failure",
}


def help_text() -> str:
    """Return what ``rapid --help`` prints."""
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb:<{width}}  {text}" for verb, text in VERBS.items())
    return (
        "usage: rapid VERB [options]\n\n"
        "Turn slow, clever LLM drivers into fast, robust driving policies.\n\n"
        f"verbs, in the order of the data's way:\n{verbs}\n\n"
        "options of every verb:\n"
        "  --help     the verb's own options; of a verb with many, those that matter most\n"
        "  --help-all all of them\n"
        "  --debug    show the traceback of an error\n"
        "  --version  print the version\n\n"
        "Begin with: rapid run            (no key, no GPU; about ten minutes on two cores)"
    )


@contextmanager
def _told_if_slow(text: str) -> Generator[None, None, None]:
    """Print `text` to standard error once the block takes longer than :data:`SILENCE_S`."""
    notice = threading.Timer(SILENCE_S, print, (text,), {"file": sys.stderr, "flush": True})
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 a check failed, 2 bad input, 130 interrupted, 143 told to end."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if not words or words[0] in ("-h", "--help", "help"):
        print(help_text())
        raise SystemExit(0)
    if words[0] in ("--version", "version"):
        print(f"rapid {rapid.__version__}")
        raise SystemExit(0)
    # Before the heavy imports, which take seconds.
    from rapid import termination

    try:
        with termination.noticed():
            code = _call(words)
    except RapidError as error:
        if debug:
            raise
        _say(f"rapid: {error}")
        raise SystemExit(2) from None
    except termination.StoppedError as stopped:
        _say(f"rapid: told to end{_going_on(words, str(stopped))}.")
        raise SystemExit(termination.EXIT_CODE) from None
    except BrokenPipeError:
        # The reader of our output went away (`rapid ... | head`): not an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            raise
        if termination.interrupted() or isinstance(error, KeyboardInterrupt):
            termination.quietly()
            _say(f"\nrapid: interrupted{_going_on(words, 'what is done is kept')}.")
            raise SystemExit(130) from None
        if isinstance(error, OSError):
            _say(f"rapid: The system refused: {error}. Check the path, its permissions and the free space.")
            raise SystemExit(2) from None
        if isinstance(error, MemoryError):
            _say("rapid: There is not enough memory. Choose smaller sizes, or close other programs.")
            raise SystemExit(2) from None
        raise
    raise SystemExit(code)


_GO_ON = ("run", "collect", "distill", "adapt", "evaluate", "teach-bench", "reproduce")
"""Verbs that go on where they were ended."""


def _going_on(words: Sequence[str], kept: str) -> str:
    """Return what is `kept` of a verb that was ended, and how it goes on; nothing where nothing is."""
    verb = words[0]
    if verb not in _GO_ON or (verb == "evaluate" and not any(word.startswith("--out") for word in words)):
        return ""
    return f"; {kept}. The same command{', without --from,' if verb == 'run' else ''} goes on"


def _call(words: Sequence[str]) -> int:
    """Do what the words say and return the exit code."""
    for stream in (sys.stdout, sys.stderr):
        # Where a path is shown that is no text, or the terminal lacks a character, an escape is better than an error.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if words[0] not in VERBS:
        raise RapidError(f"Unknown verb '{words[0]}'{did_you_mean(words[0], VERBS)} Verbs: {', '.join(VERBS)}.")
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise RapidError(
                f"'{word}' is not text in UTF-8, and the records that RAPID keeps are. Give the file or directory "
                "another name, or a link to it."
            ) from None
    # Several processes scale better than several threads; see docs/architecture.md.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with _told_if_slow(f"rapid: loading what `rapid {words[0]}` needs …"):
        from rapid.verbs import prepare

        do = prepare(words[0], words[1:])
    return do()


def _say(text: str) -> None:
    print(printable(text), file=sys.stderr)


if __name__ == "__main__":
    main()
