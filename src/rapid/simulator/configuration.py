"""The configuration dict of an environment, and how it changes between episodes."""

import copy
from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from rapid.errors import RapidError
from rapid.scenarios import Scenario, get_task
from rapid.simulator.render import View, read_view
from rapid.simulator.settings import DEFAULTS, Settings, read_settings


def merge_config(base: Mapping[str, Any], overrides: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return `base` with `overrides` on top.

    ``observation`` and ``action`` are merged key by key unless the override names a ``type``; then it stands alone, as
    it would in highway-env.
    """
    merged = dict(base)
    for key, value in (overrides or {}).items():
        partial = key in ("observation", "action") and isinstance(value, Mapping) and "type" not in value
        merged[key] = {**base.get(key, {}), **value} if partial else value
    return merged


class Configuration:
    """What an environment was asked to be (`values`, which anyone may change) and what it is (`settings`, `view`).

    A change holds from the next reset on: :meth:`refresh` reads what was changed, and leaves everything as it was where
    that is not possible.
    """

    def __init__(
        self, task: str | Scenario, overrides: Mapping[str, Any] | None = None, render_mode: str | None = None
    ) -> None:
        """Read the configuration of a task with keys on top.

        Raises:
            RapidError: an unknown task, or a configuration that the compiled simulator does not cover.
        """
        self.task = get_task(task) if isinstance(task, str) else task
        self._draws = render_mode is not None
        full = DEFAULTS[self.task.dynamics] | self.task.config()
        self.values: dict[str, Any] = copy.deepcopy(merge_config(full, overrides))
        if "offscreen_rendering" in self.values and self.values["offscreen_rendering"] is None:
            self.values["offscreen_rendering"] = render_mode != "human"
        self.settings: Settings
        self.view: View | None
        self._read(self.values)

    def configure(self, changes: Mapping[str, Any] | None) -> None:
        """Change some keys; they hold from the next reset on.

        Raises:
            RapidError: a key or a value that the compiled simulator does not cover; then nothing has changed.
        """
        if changes is None:
            return
        if not isinstance(cast(Any, changes), Mapping):
            raise RapidError(f"A configuration must be a dict of highway-env's keys; got {changes!r}.")
        merged = copy.deepcopy(merge_config(self.values, changes))
        self._settings_of(merged)
        self.values.update(merged)

    @property
    def changed(self) -> bool:
        """Whether the values are others than the settings were read from."""
        try:
            return bool(self.values != self._as_read)
        except ValueError:  # somewhere in it are arrays, which have no truth
            return not _equal(self.values, self._as_read)

    def refresh(self) -> bool:
        """Read the values again if they were changed, and return whether they were.

        Raises:
            RapidError: they hold a key or a value that the compiled simulator does not cover.
        """
        if not self.changed:
            return False
        self._read(self.values)
        return True

    def _settings_of(self, values: Mapping[str, Any]) -> tuple[Settings, View | None]:
        settings = read_settings(values, self.task.dynamics)
        return settings, read_view(values, settings) if self._draws else None

    def _read(self, values: Mapping[str, Any]) -> None:
        self.settings, self.view = self._settings_of(values)
        self._as_read = copy.deepcopy(dict(values))


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return bool(np.array_equal(cast(Any, one), cast(Any, other)))
    return bool(one == other)


def split_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset.

    Raises:
        RapidError: an option is none of `known`.
    """
    given = dict(options or {})
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise RapidError(
            f"reset() of the compiled simulator takes the options {', '.join(known)}; got {unknown}. Keys of the "
            'configuration go into options={"config": {...}}.'
        )
    return given
