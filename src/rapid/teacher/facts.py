"""Facts about a scene, one set per action: closed-form checks, the forecast, and what the action leads to.

A fact tells what is or would be, never what to do. The closed-form checks are those of the tool-using drivers that
the paper builds on, with a minimum gap added: without it a faster car one metre ahead counts as safe.
"""

from dataclasses import dataclass

from rapid.scenarios import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, NUM_ACTIONS, SLOWER
from rapid.teacher.forecast import Forecast, forecast
from rapid.teacher.scene import CAR_LENGTH, Car, Scene

MINIMUM_GAP = 2.0
"""Metres, bumper to bumper, below which no check passes."""
TIGHT_GAP = 4.0
"""Metres of forecast gap below which a manoeuvre counts as unsafe."""


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
    """Everything that is told about a scene; `checks` and `forecasts` are indexed by action."""

    scene: Scene
    available: tuple[int, ...]
    checks: tuple[Check, ...]
    forecasts: tuple[Forecast, ...]

    def safe(self, action: int) -> bool:
        """Whether the forecast leaves room both ways: no crash if the ego holds on, and room to brake."""
        future = self.forecasts[action]
        return future.brake_gap >= TIGHT_GAP and future.hold_crash == float("inf")

    def avoidable(self, action: int) -> bool:
        """Whether the forecast sees no crash if the ego brakes after the action."""
        return self.forecasts[action].brake_gap > 0

    def room(self, action: int) -> tuple[float, float, float, bool]:
        """Return how much room the forecast leaves, to compare actions: seconds to a crash, then gaps, then braking."""
        future = self.forecasts[action]
        return future.brake_crash, future.brake_gap, future.hold_gap, action == SLOWER


def gather(scene: Scene) -> Facts:
    """Compute the facts of a scene."""
    checks = tuple(check(scene, action) for action in range(NUM_ACTIONS))
    return Facts(scene, scene.available(), checks, forecast(scene))


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
    """Return the available action whose forecast leaves the most room; the rule's answer when a model gives none."""
    return max(facts.available, key=facts.room)
