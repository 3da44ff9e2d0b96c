"""Who drives in phase 1: language models with tools, and scripted drivers (paper: section 3.1).

The way of a decision: observation → :mod:`~rapid.teacher.scene` → :mod:`~rapid.teacher.facts` (closed-form checks and
the :mod:`~rapid.teacher.forecast`) → :mod:`~rapid.teacher.prompt` → model → :class:`Decision`. Importing this package
loads no model code.
"""

from rapid.config import TeacherConfig
from rapid.teacher.decision import Decision, Teacher, from_record, to_record

__all__ = ["Decision", "Teacher", "check_teacher", "from_record", "make_teacher", "to_record"]


def check_teacher(config: TeacherConfig, lanes: int, scenario: str = "") -> None:
    """Look for everything that would keep :func:`make_teacher` from its end, short of fetching and loading a model.

    Nothing is asked of a server: whether it is there and takes the key shows at the first decision.

    Raises:
        RapidError: a name that does not exist, a file that cannot be read, an address that is none, or settings that
            do not go together.
    """
    from rapid.teacher.memory import open_memory

    open_memory(config)
    if config.backend == "local":
        from rapid.teacher.models import is_present

        is_present(config.model)
    else:
        make_teacher(config, lanes, scenario=scenario)


def make_teacher(config: TeacherConfig, lanes: int, seed: int = 0, scenario: str = "") -> Teacher:
    """Return the teacher that `config` describes, for a road with `lanes` lanes.

    `seed` matters to drivers that draw at random; the rest is deterministic. `scenario` matters to `blind` alone.

    Raises:
        RapidError: a name that does not exist, a model that cannot be had, a recording that cannot be read, no key.
    """
    if config.backend == "scripted":
        from rapid.teacher.scripted import Scripted

        return Scripted(config.model, lanes, seed, scenario)
    from rapid.teacher.agent import make_model_teacher

    return make_model_teacher(config, lanes, seed)
