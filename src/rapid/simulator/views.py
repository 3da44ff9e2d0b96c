"""What scripts written for highway-env read of an environment: its vehicles, its road, its actions.

These are views: they show the world as it is when they are read, and nothing can be set through them.
"""

from typing import Any, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.road import CAR_LENGTH, CAR_WIDTH, LANE_WIDTH
from rapid.scenarios import ACTIONS, FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from rapid.simulator.behavior import ROAD_LENGTH, reachable
from rapid.simulator.settings import USE_REFERENCE, Settings
from rapid.simulator.state import (
    COS,
    CRASHED,
    HEADING,
    LANE,
    SIN,
    SPEED,
    SPEED_INDEX,
    TARGET_LANE,
    TARGET_SPEED,
    TIME,
    VX,
    VY,
    State,
    X,
    Y,
)

LaneIndex = tuple[str, str, int]


class HasWorld(Protocol):
    """Whoever owns the world that is looked at, in the first place of its state."""

    state: State
    settings: Settings


class VehicleView:
    """One vehicle as highway-env's scripts read it; the ego is the first."""

    LENGTH, WIDTH, MAX_SPEED = CAR_LENGTH, CAR_WIDTH, 40.0
    """m, m, m/s."""

    __slots__ = ("_index", "_owner")
    _index: int
    _owner: HasWorld

    def __init__(self, owner: HasWorld, index: int) -> None:
        object.__setattr__(self, "_owner", owner)
        object.__setattr__(self, "_index", index)

    @property
    def position(self) -> NDArray[np.float64]:
        """x, along the road, and y, to the right [m]: a copy, (2,)."""
        return self._cars[[X, Y], self._index]

    @property
    def speed(self) -> float:
        """In m/s."""
        return float(self._cars[SPEED, self._index])

    @property
    def heading(self) -> float:
        """The angle from the direction of the road, in rad."""
        return float(self._cars[HEADING, self._index])

    @property
    def direction(self) -> NDArray[np.float64]:
        """The unit vector of the heading, (2,)."""
        return self._cars[[COS, SIN], self._index]

    @property
    def velocity(self) -> NDArray[np.float64]:
        """In m/s, (2,)."""
        return self._cars[[VX, VY], self._index]

    @property
    def crashed(self) -> bool:
        """Whether it has touched another vehicle."""
        return bool(self._tags[CRASHED, self._index])

    @property
    def lane_index(self) -> LaneIndex:
        """The lane that it is on, counted from the left, as highway-env names it: ``("0", "1", lane)``."""
        return ("0", "1", int(self._tags[LANE, self._index]))

    @property
    def target_lane_index(self) -> LaneIndex:
        """The lane that it steers to."""
        return ("0", "1", int(self._tags[TARGET_LANE, self._index]))

    @property
    def target_speed(self) -> float:
        """The speed that it wants, in m/s."""
        return float(self._cars[TARGET_SPEED, self._index])

    @property
    def target_speeds(self) -> NDArray[np.float64]:
        """The speeds that the ego can choose from, in m/s."""
        self._only_the_ego("target_speeds")
        return self._owner.settings.target_speeds.copy()

    @property
    def speed_index(self) -> int:
        """Which of its target speeds the ego has chosen."""
        self._only_the_ego("speed_index")
        return int(self._owner.state.world[0, SPEED_INDEX])

    @property
    def on_road(self) -> bool:
        """Whether its centre is on its lane."""
        x, y = self.position
        aside = abs(y - LANE_WIDTH * self._tags[LANE, self._index])
        return bool(aside <= LANE_WIDTH / 2 and -CAR_LENGTH <= x < ROAD_LENGTH + CAR_LENGTH)

    @property
    def _cars(self) -> NDArray[np.float64]:
        return self._owner.state.cars[0]

    @property
    def _tags(self) -> NDArray[np.int64]:
        return self._owner.state.tags[0]

    def _only_the_ego(self, name: str) -> None:
        if self._index != 0:
            raise AttributeError(name)

    def __getattr__(self, name: str) -> NoReturn:
        if hasattr(type(self), name):
            raise AttributeError(f"Only the ego, road.vehicles[0], has {name!r}.")
        shown = sorted(key for key in dir(type(self)) if not key.startswith("_"))
        raise AttributeError(
            f"A vehicle of the compiled simulator has no {name!r}; it shows {', '.join(shown)}. {USE_REFERENCE}"
        )

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise RapidError(
            f"vehicle.{name} cannot be set: the vehicles of the compiled simulator can only be read. {USE_REFERENCE}"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return VehicleView, (self._owner, self._index)

    def __repr__(self) -> str:
        x, y = self.position
        who = "the ego" if self._index == 0 else f"vehicle {self._index}"
        return (
            f"<{who}: x {x:.1f} m, y {y:.1f} m, {self.speed:.1f} m/s, lane {self.lane_index[2]}"
            f"{', crashed' if self.crashed else ''}>"
        )


class RoadView:
    """The road as highway-env's scripts read it: its vehicles, in the order in which highway-env lists them."""

    __slots__ = ("vehicles",)

    def __init__(self, owner: HasWorld) -> None:
        self.vehicles: list[VehicleView] = [VehicleView(owner, i) for i in range(owner.state.cars.shape[2])]

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(
            f"The road of the compiled simulator shows its vehicles only, no {name!r}. {USE_REFERENCE}"
        )

    def __repr__(self) -> str:
        return f"<road with {len(self.vehicles)} vehicles>"


class ActionTypeView:
    """The meta-actions as highway-env's scripts read them."""

    def __init__(self, settings: Settings) -> None:
        self.actions: dict[int, str] = {i: ACTIONS[meta] for i, meta in enumerate(settings.actions)}
        """The name of each action."""
        self.actions_indexes: dict[str, int] = {name: i for i, name in self.actions.items()}
        """The action of each name."""
        self.target_speeds = settings.target_speeds.copy()

    def __repr__(self) -> str:
        return f"<{', '.join(f'{i} {name}' for i, name in self.actions.items())}>"


def available_actions(state: State, index: int, settings: Settings) -> list[int]:
    """Return the actions that change something, in highway-env's order.

    A lane change off the road, a speed beyond the last target speed, and what the ego's action type leaves out are not
    among them; they may be taken all the same, and do nothing.
    """
    cars, tags = state.cars[index], state.tags[index]
    lane, chosen = int(tags[LANE, 0]), int(state.world[index, SPEED_INDEX])
    possible = {
        IDLE: True,
        LANE_LEFT: lane > 0 and bool(reachable(cars, 0, lane - 1)),
        LANE_RIGHT: lane < settings.lanes - 1 and bool(reachable(cars, 0, lane + 1)),
        FASTER: chosen < len(settings.target_speeds) - 1,
        SLOWER: chosen > 0,
    }
    places = {int(meta): i for i, meta in enumerate(settings.actions)}
    return [places[meta] for meta, can in possible.items() if can and meta in places]


class HighwayViews:
    """The part of highway-env's ``AbstractEnv`` that scripts read, over the one world of an environment."""

    state: State
    settings: Settings
    _road: RoadView | None
    _ready: bool

    @property
    def vehicle(self) -> VehicleView:
        """The ego, as highway-env's scripts read it.

        Raises:
            RapidError: no episode has begun.
        """
        return self.road.vehicles[0]

    @property
    def controlled_vehicles(self) -> list[VehicleView]:
        """The ego, in a list."""
        return [self.vehicle]

    @property
    def road(self) -> RoadView:
        """All vehicles, the ego first, as highway-env's scripts read them.

        Raises:
            RapidError: no episode has begun.
        """
        self._require_reset()
        if self._road is None:
            self._road = RoadView(self)
        return self._road

    @property
    def time(self) -> float:
        """Seconds since the reset."""
        return float(self.state.world[0, TIME])

    @property
    def action_type(self) -> ActionTypeView:
        """The names of the actions, as highway-env's scripts read them."""
        return ActionTypeView(self.settings)

    def get_available_actions(self) -> list[int]:
        """Return the actions that change something now, as highway-env lists them.

        Raises:
            RapidError: no episode has begun.
        """
        self._require_reset()
        return available_actions(self.state, 0, self.settings)

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions change something now, (A,), as sb3-contrib's ``MaskablePPO`` asks for them.

        Raises:
            RapidError: no episode has begun.
        """
        masks = np.zeros(len(self.settings.actions), np.bool_)
        masks[self.get_available_actions()] = True
        return masks

    def _require_reset(self) -> None:
        if not self._ready:
            raise RapidError("No episode has begun. Call reset() first.")
