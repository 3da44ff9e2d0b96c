"""Pictures of a world from above, around the ego, drawn with Pillow; a window only where one is asked for."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rapid.errors import RapidError
from rapid.road import CAR_LENGTH, CAR_WIDTH, LANE_WIDTH
from rapid.simulator.settings import Settings, read_integer
from rapid.simulator.state import (
    COS,
    CRASHED,
    LANE,
    SIN,
    SPEED,
    TARGET_LANE,
    TARGET_SPEED,
    TIME,
    Snapshot,
    X,
    Y,
)

if TYPE_CHECKING:
    from PIL import ImageDraw

RENDER_MODES = ("human", "rgb_array")
Frame = NDArray[np.uint8]
Color = tuple[int, int, int]

GRASS: Color = (146, 168, 124)
ASPHALT: Color = (66, 70, 79)
PAINT: Color = (226, 228, 230)
TRAFFIC: Color = (104, 168, 222)
EGO: Color = (255, 196, 61)
CRASH: Color = (220, 53, 46)
GLASS: Color = (38, 42, 50)
SIGNAL: Color = (255, 140, 26)
HEADER: Color = (30, 33, 39)

LENGTH, WIDTH = CAR_LENGTH, CAR_WIDTH
VERGE = 2.5
"""Metres of grass beside the road."""
HEADER_HEIGHT = 28
SMOOTH = 2
"""How many times finer the picture is drawn than it is shown."""


class View(NamedTuple):
    """What part of the road a picture shows."""

    width: int
    height: int
    scale: float
    """Pixels per metre."""
    ego_place: float
    """Where the ego stands, from 0 (left edge) to 1."""


def read_view(config: Mapping[str, Any], settings: Settings) -> View:
    """Return the view of a configuration: highway-env's keys where they are given, else one that fits the road.

    Raises:
        RapidError: a size or scale that makes no sense.
    """
    scale = config.get("scaling", 6.0)
    place = config.get("centering_position", [0.3, 0.5])[0]
    if not isinstance(scale, (int, float)) or not 0.1 <= scale <= 100:
        raise RapidError(f"scaling must be a number of pixels per metre from 0.1 to 100; got {scale!r}.")
    if not isinstance(place, (int, float)) or not 0 <= place <= 1:
        raise RapidError(f"centering_position must hold numbers from 0 to 1; got {place!r}.")
    fitting = int((settings.lanes * LANE_WIDTH + 2 * VERGE) * scale) + HEADER_HEIGHT
    sizes = {"screen_width": 960, "screen_height": min(fitting, 4000)} | {
        key: config[key] for key in ("screen_width", "screen_height") if key in config
    }
    width, height = (read_integer(sizes, key, 16, 8192) for key in ("screen_width", "screen_height"))
    return View(width + width % 2, height + height % 2, float(scale), float(place))  # video codecs want even sizes


def draw(world: Snapshot, settings: Settings, view: View) -> Frame:
    """Return a picture of one world, uint8 of shape (height, width, 3)."""
    from PIL import Image, ImageDraw  # not above: worlds that nobody looks at need not wait for it

    cars, tags = world.cars, world.tags
    image = Image.new("RGB", (view.width * SMOOTH, view.height * SMOOTH), GRASS)
    pen = ImageDraw.Draw(image)
    scale = view.scale * SMOOTH
    middle = (settings.lanes - 1) * LANE_WIDTH / 2
    left = float(cars[X, 0]) - view.ego_place * view.width / view.scale
    top = (view.height + HEADER_HEIGHT) / 2 * SMOOTH - middle * scale

    def place(x: float, y: float) -> tuple[float, float]:
        return (x - left) * scale, top + y * scale

    _draw_road(pen, settings.lanes, left, view, place)
    visible = np.abs(cars[X] - left - view.width / view.scale / 2) < view.width / view.scale / 2 + LENGTH
    for i in np.flatnonzero(visible)[::-1].tolist():  # the ego last, above the others
        color = CRASH if tags[CRASHED, i] else EGO if i == 0 else TRAFFIC
        corners = _corners(cars[:, i], LENGTH, WIDTH)
        outline = EGO if i == 0 else HEADER
        pen.polygon([place(*corner) for corner in corners], fill=color, outline=outline, width=SMOOTH)
        pen.polygon([place(*corner) for corner in _corners(cars[:, i], 0.9, 1.6, ahead=0.8)], fill=GLASS)
        pen.polygon([place(*corner) for corner in _corners(cars[:, i], 0.5, 1.6, ahead=-1.7)], fill=GLASS)
        side = int(np.sign(tags[TARGET_LANE, i] - tags[LANE, i]))
        if side and not tags[CRASHED, i]:
            for ahead in (-2.2, 2.2):
                light = _corners(cars[:, i], 0.6, 0.6, ahead=ahead, aside=0.8 * side)
                pen.polygon([place(*corner) for corner in light], fill=SIGNAL)
    image = image.reduce(SMOOTH)
    _draw_header(ImageDraw.Draw(image), world, settings.lanes, view)
    return np.array(image)


def _draw_road(pen: "ImageDraw.ImageDraw", lanes: int, left: float, view: View, place: Any) -> None:
    right = left + view.width / view.scale
    pen.rectangle([place(left, -LANE_WIDTH / 2), place(right, (lanes - 0.5) * LANE_WIDTH)], fill=ASPHALT)
    width = max(round(0.2 * view.scale * SMOOTH), 1)
    for border in range(lanes + 1):
        y = (border - 0.5) * LANE_WIDTH
        if border in (0, lanes):
            pen.line([place(left, y), place(right, y)], fill=PAINT, width=width)
            continue
        for start in np.arange(np.floor(left / 10) * 10, right, 10.0):
            pen.line([place(start, y), place(start + 4, y)], fill=PAINT, width=width)


def _draw_header(pen: "ImageDraw.ImageDraw", world: Snapshot, lanes: int, view: View) -> None:
    from PIL import ImageFont

    cars, tags = world.cars, world.tags
    pen.rectangle([0, 0, view.width, HEADER_HEIGHT - 1], fill=HEADER)
    font: Any = ImageFont.load_default(15)
    parts = [
        (f"{cars[SPEED, 0]:.1f} m/s", EGO),
        (f"target {cars[TARGET_SPEED, 0]:.0f} m/s", PAINT),
        (f"lane {tags[LANE, 0] + 1} of {lanes}", PAINT),
        (f"{world.world[TIME]:.0f} s", PAINT),
    ]
    if tags[CRASHED, 0]:
        parts.append(("crashed", CRASH))
    for k, (text, color) in enumerate(parts):
        pen.text((10 + 110 * k, 5), text, fill=color, font=font)


def _corners(
    car: NDArray[np.float64], length: float, width: float, ahead: float = 0.0, aside: float = 0.0
) -> list[tuple[float, float]]:
    """Return the corners of a rectangle that is fixed to a vehicle."""
    x, y, cos, sin = (float(car[row]) for row in (X, Y, COS, SIN))
    ends = [(ahead + sx * length / 2, aside + sy * width / 2) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [(x + cos * along - sin * across, y + sin * along + cos * across) for along, across in ends]


class Window:
    """A window that shows pictures at the pace at which they were filmed. Closed by the user, it stays closed.

    Raises:
        RapidError: pygame is missing, or there is no screen.
    """

    def __init__(self, view: View, frames_per_second: float) -> None:
        try:
            import pygame
        except ImportError as error:
            raise RapidError('render_mode="human" needs pygame. Run: pip install pygame-ce') from error
        self._pygame: Any = pygame
        self._rate = frames_per_second
        try:
            pygame.display.init()
            self._surface: Any = pygame.display.set_mode((view.width, view.height))
        except pygame.error as error:
            raise RapidError(
                f'No window can be opened: {error}. Without a screen use render_mode="rgb_array".'
            ) from error
        pygame.display.set_caption("RAPID")
        self._clock: Any = pygame.time.Clock()

    def show(self, frame: Frame) -> None:
        """Show one picture and wait until the next one is due."""
        pygame = self._pygame
        if self._surface is None:
            return
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return
        size = frame.shape[1], frame.shape[0]
        self._surface.blit(pygame.image.frombuffer(frame.tobytes(), size, "RGB"), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._rate)

    def close(self) -> None:
        """Close the window."""
        if self._surface is not None:
            self._surface = None
            self._pygame.display.quit()
