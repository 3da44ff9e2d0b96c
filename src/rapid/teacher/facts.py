"""Facts about a scene, one set per action: closed-form checks, the forecast of one manoeuvre, and the best way on.

A fact tells what is or would be, never what to do. The closed-form checks are those of the tool-using drivers that
the paper builds on, with a minimum gap added: without it a faster car one metre ahead counts as safe.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from rapid.road import CAR_LENGTH
from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, SLOWER
from rapid.teacher.forecast import Forecast, forecast
from rapid.teacher.foresight import DEPTH, WayOn, look_ahead
from rapid.teacher.scene import Car, Scene

MINIMUM_GAP = 2.0
"""Metres, bumper to bumper, below which no check passes."""
TIGHT_GAP = 4.0
"""Metres of forecast gap below which a manoeuvre counts as unsafe."""
OPEN_MARGIN = 0.05
"""How much less an action's best way on may be worth than the best action's to count as good as that, in the reward of
a second. With 0.25 the teacher earns half a point less."""

T = TypeVar("T")


@dataclass(frozen=True)
class Check:
    """The closed-form verdict on one action."""

    safe: bool
    car: Car | None = None
    """The car in conflict, the lead car first."""
    room: float = float("inf")
    """Metres by which the tightest condition holds; negative if it fails."""


@dataclass(frozen=True)
class Facts:
    """Everything that is told about a scene, each computed when first asked for."""

    scene: Scene
    available: tuple[int, ...]
    told: tuple[int, ...] = tuple(range(NUM_ACTIONS))
    """Whose facts are told of each action: its own, except in the control with shuffled facts."""

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """The closed-form check of each action."""
        return self._told([check(self.scene, action) for action in range(NUM_ACTIONS)])

    @cached_property
    def forecasts(self) -> tuple[Forecast, ...]:
        """The forecast of each action, with the ego holding on or braking afterwards."""
        return self._told(forecast(self.scene))

    @cached_property
    def ways(self) -> tuple[WayOn, ...]:
        """The best way on after each action."""
        return self._told(look_ahead(self.scene))

    def survives(self, action: int) -> bool:
        """Whether a way on without a crash was found."""
        return self.ways[action].seconds >= DEPTH

    def is_open(self, action: int) -> bool:
        """Whether the action leads on about as well as the best available one."""
        ways = [self.ways[other] for other in self.available]
        longest = max(way.seconds for way in ways)
        best = max(way.value for way in ways if way.seconds == longest)
        return self.ways[action].seconds == longest and self.ways[action].value >= best - OPEN_MARGIN

    def safe(self, action: int) -> bool:
        """Whether the forecast leaves room both ways: no crash if the ego holds on, and room to brake."""
        future = self.forecasts[action]
        return future.brake_gap >= TIGHT_GAP and future.hold_crash == float("inf")

    def _told(self, own: Sequence[T]) -> tuple[T, ...]:
        return tuple(own[action] for action in self.told)


def gather(scene: Scene) -> Facts:
    """Return the facts of a scene."""
    return Facts(scene, scene.available())


def check(scene: Scene, action: int) -> Check:
    """Return the closed-form check of one manoeuvre (d: centre distance; L: car length; speeds in m/s).

    Lane change: d - L > 3 s x closing speed, for the lead and the rear car of the lane entered. Accelerate and keep
    speed: d - 2L > 5 s x closing speed (4 m/s more when accelerating). Decelerate: d - L > 3 s x closing speed at
    3 m/s less. And always d - L > `MINIMUM_GAP`.
    """
    lane = scene.lane_after(action)
    ego, lead, rear = scene.speed, scene.lead(lane), scene.rear(lane)
    margins: list[tuple[float, Car]] = []
    if lead is not None:
        closing = ego - lead.speed
        seconds, extra, lengths = {
            LANE_LEFT: (3.0, 0.0, 1.0),
            LANE_RIGHT: (3.0, 0.0, 1.0),
            FASTER: (5.0, 4.0, 2.0),
            IDLE: (5.0, 0.0, 2.0),
            SLOWER: (3.0, -3.0, 1.0),
        }[action]
        needed = max(seconds * (closing + extra), MINIMUM_GAP - (lengths - 1.0) * CAR_LENGTH)
        margins.append((lead.ahead - lengths * CAR_LENGTH - needed, lead))
    if rear is not None and action in (LANE_LEFT, LANE_RIGHT):
        needed = max(3.0 * (rear.speed - ego), MINIMUM_GAP)
        margins.append((-rear.ahead - CAR_LENGTH - needed, rear))
    if not margins:
        return Check(True)
    room, car = min(margins, key=lambda margin: margin[0])
    return Check(True, None, room) if room > 0 else Check(False, car, room)


def safest(facts: Facts) -> int:
    """Return the available action with the best way on; the answer when a model gives none."""
    return max(facts.available, key=lambda action: (facts.ways[action].seconds, facts.ways[action].value))
