"""Defences that need no training: an unchanged policy reads something less wrong than what is seen, or is asked often.

* ``noise-average:RADIUS``: the mean of the Q-values at 16 points around what is seen (randomised smoothing, as CROP
  uses it: Wu et al., 2022). The points are drawn once, so the agent is a function and an attack knows all of it.
* ``smooth:WINDOW``: cars are followed; each is where it was expected, moved by 1/WINDOW of the way to where it is seen.
* ``purify-pca:SIZE``, ``purify-autoencoder:SIZE``: what is seen, squeezed through so many numbers that were fitted on
  shipped data of the scenario (Mohan et al., 2025).
* ``track``: cars are followed; none is farther from where it was expected than cars can drive.
* ``average:ONE+TWO+...``: the mean of the Q-values behind several of these.

All of them are differentiable but for `track`, which passes gradients on where it clips (BPDA: Athalye et al., 2018),
so that gradient attacks see through each. Nothing here is a guarantee.

Shapes: B batch, V vehicles, F features, A actions, S entries of a state, K points asked, D numbers of an observation.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rapid.errors import RapidError
from rapid.networks.encoding import feature_scale
from rapid.purification import NUMBERS, fitted, numbers_of
from rapid.scenarios import NUM_FEATURES, NUM_VEHICLES, get_scenario
from rapid.seeding import torch_stream

POINTS = 16
"""K: points at which a noise average asks."""
MOST_WINDOW = 30
"""Decisions of an episode."""
CAR_UNITS = (10.0, 2.0, 6.0, 3.0)
"""Metres along and across the road, m/s along and across, by which cars are told from each other."""
BEHIND, BEYOND = (3.0, 6.1), (2.5, 4.5)
"""How much less and more than expected a car's place [m] and speed [m/s] along the road can be after a second: drivers
brake by up to 6 m/s² and speed up by up to 4. (A wreck stops faster, and is believed some seconds late.)"""

KINDS = ("noise-average", "smooth", "purify-pca", "purify-autoencoder", "track")
AVERAGE = "average"
_ONE = r"(?:track|(?:noise-average|smooth|purify-pca|purify-autoencoder):[^:+]*)"
_SPEC = re.compile(rf"(?:average:(?P<many>{_ONE}(?:\+{_ONE})*)|(?P<one>{_ONE})):(?P<agent>.+)")

Ask = Callable[[Tensor], Tensor]
"""Observations (K, B, V, F) to the mean over K of their Q-values (B, A)."""


class Wrapped(NamedTuple):
    """The spec of an agent behind a defence, taken apart."""

    members: tuple[str, ...]
    """The defences, such as ``smooth:3``; more than one is their average."""
    agent: str
    """The spec of the agent."""


def is_defence(spec: str) -> bool:
    """Whether a spec begins with a defence's name."""
    return spec.partition(":")[0] in (*KINDS, AVERAGE)


def unwrapped(spec: str) -> Wrapped:
    """Return the parts of a spec such as ``smooth:3:AGENT`` or ``average:smooth:3+track:AGENT``.

    Raises:
        RapidError: it does not read so.
    """
    found = _SPEC.fullmatch(spec)
    if found is None:
        raise RapidError(
            f"'{spec}' does not say what is defended, or how. Expected noise-average:RADIUS:AGENT, "
            "smooth:WINDOW:AGENT, purify-pca:SIZE:AGENT, purify-autoencoder:SIZE:AGENT, track:AGENT, or several of "
            "them as average:noise-average:0.1+smooth:3:AGENT."
        )
    return Wrapped(tuple((found["many"] or found["one"]).split("+")), found["agent"])


class Defence(nn.Module):
    """What stands between what is seen and the policy; this one changes nothing. Without weights that learn."""

    size = 0
    """S: entries of what it remembers of an episode, zeros when that begins."""

    def seen(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what the policy is asked about (K, B, V, F)."""
        return obs_BVF[None]

    def forward(self, ask: Ask, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return the Q-values (B, A)."""
        return ask(self.seen(obs_BVF, state_BS))

    def passed(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what a defence behind this one takes for what is seen (B, V, F)."""
        return self.seen(obs_BVF, state_BS)[0]

    def notice(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what it remembers (B, S) after this was seen."""
        return state_BS


class NoiseAverage(Defence):
    """Asks at points around what is seen: normal noise on every feature but presence."""

    noise_KVF: Tensor

    def __init__(self, radius: float, vehicles: int, lanes: int, seed: int) -> None:
        super().__init__()
        scale_F = feature_scale(lanes) * radius
        scale_F[0] = 0
        drawn = torch.randn(POINTS, vehicles, NUM_FEATURES, generator=torch_stream(seed, "noise-average"))
        self.register_buffer("noise_KVF", drawn * scale_F)

    def seen(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return the points."""
        return obs_BVF + self.noise_KVF[:, None]

    def passed(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what is seen."""
        return obs_BVF


class Following(Defence, ABC):
    """Follows cars: each is expected a second on from where it was believed to be, and believed near where it is seen.

    Of what is seen and what is expected, two belong together if each is the other's nearest. A car that was not
    expected is believed as it is seen.
    """

    def __init__(self, vehicles: int) -> None:
        super().__init__()
        self.size = vehicles * NUM_FEATURES

    def seen(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what is believed."""
        before_BVF = state_BS.view(obs_BVF.shape)
        # Places move by the speeds.
        moved_BV2 = before_BVF[..., 1:3] + before_BVF[..., 3:5]
        expected_BVF = torch.cat([before_BVF[..., :1], moved_BV2, before_BVF[..., 3:]], -1)
        row_BV, known_BV = matched(obs_BVF.detach(), expected_BVF)
        expected_BVF = expected_BVF.gather(1, row_BV[..., None].expand_as(expected_BVF))
        believed_BV4 = self.believed(obs_BVF[..., 1:], expected_BVF[..., 1:])
        return torch.cat([obs_BVF[..., :1], torch.where(known_BV[..., None], believed_BV4, obs_BVF[..., 1:])], -1)[None]

    @abstractmethod
    def believed(self, seen_BV4: Tensor, expected_BV4: Tensor) -> Tensor:
        """Return places and speeds between what is seen and what was expected."""

    def notice(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what is believed."""
        return self.seen(obs_BVF, state_BS)[0].flatten(1)


class Smoothing(Following):
    """Believes what was expected, moved by one `window`-th of the way to what is seen."""

    def __init__(self, window: int, vehicles: int) -> None:
        super().__init__(vehicles)
        self.window = window

    def believed(self, seen_BV4: Tensor, expected_BV4: Tensor) -> Tensor:
        """Return places and speeds; with a window of 1 those seen."""
        share = 1 / self.window
        return seen_BV4 * share + expected_BV4 * (1 - share)


class TrackFilter(Following):
    """Believes what is seen as far as a car could have got there in a second; across the road it could anywhere."""

    def believed(self, seen_BV4: Tensor, expected_BV4: Tensor) -> Tensor:
        """Return places and speeds: those seen, clipped."""
        least, most = torch.full_like(seen_BV4, -torch.inf), torch.full_like(seen_BV4, torch.inf)
        for feature, down, up in ((0, BEHIND[0], BEYOND[0]), (2, BEHIND[1], BEYOND[1])):
            least[..., feature] = expected_BV4[..., feature] - down
            most[..., feature] = expected_BV4[..., feature] + up
        # For a gradient nothing is clipped, lest an attack lose its way where it is.
        return seen_BV4 + (torch.minimum(torch.maximum(seen_BV4, least), most) - seen_BV4).detach()


def matched(seen_BVF: Tensor, expected_BVF: Tensor) -> tuple[Tensor, Tensor]:
    """Return for each row seen the nearest row that was expected (B, V), and whether the two are each other's nearest.

    The ego's row is its own; rows of absent cars have none.
    """
    units_4 = torch.tensor(CAR_UNITS, device=seen_BVF.device)
    away_BVV4 = (seen_BVF[:, :, None, 1:] - expected_BVF[:, None, :, 1:]) / units_4
    present_BVV = (seen_BVF[:, :, None, 0] > 0.5) & (expected_BVF[:, None, :, 0] > 0.5)
    ego_V = torch.arange(seen_BVF.shape[1], device=seen_BVF.device) == 0
    away_BVV = away_BVV4.abs().sum(-1).masked_fill(~present_BVV | (ego_V[:, None] != ego_V), torch.inf)
    distance_BV, row_BV = away_BVV.min(2)
    back_BV = away_BVV.argmin(1).gather(1, row_BV)
    mutual_BV = back_BV == torch.arange(seen_BVF.shape[1], device=seen_BVF.device)
    return row_BV, mutual_BV & distance_BV.isfinite()


class Purifier(Defence):
    """Squeezes places relative to the ego, and speeds, of all cars through `size` numbers; presence stays.

    Args:
        squeeze: (B, D) to (B, D), in highway-env's ranges; absent cars are zeros.
        lanes: lanes of the road, for the ranges.
    """

    scale_F: Tensor

    def __init__(self, squeeze: nn.Module, lanes: int) -> None:
        super().__init__()
        self.squeeze = squeeze
        self.register_buffer("scale_F", feature_scale(lanes)[1:])

    def seen(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what comes out."""
        numbers_BD = numbers_of(obs_BVF, self.scale_F)
        clean_BV4 = self.squeeze(numbers_BD).view(len(obs_BVF), -1, NUM_FEATURES - 1) * self.scale_F
        clean_BV4 = torch.cat([clean_BV4[..., :1] + obs_BVF[:, :1, 1:2], clean_BV4[..., 1:]], -1)
        # The ego's place along the road means nothing but to the others, and is theirs to be relative to.
        clean_BV4 = torch.cat([torch.cat([obs_BVF[:, :1, 1:2], clean_BV4[:, :1, 1:]], -1), clean_BV4[:, 1:]], 1)
        present_BV1 = obs_BVF[..., :1] > 0.5
        return torch.cat([obs_BVF[..., :1], torch.where(present_BV1, clean_BV4, obs_BVF[..., 1:])], -1)[None]


class Average(Defence):
    """The mean of the Q-values behind several defences."""

    def __init__(self, members: list[Defence]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)
        self.sizes = [member.size for member in members]
        self.size = sum(self.sizes)

    def forward(self, ask: Ask, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return the Q-values (B, A)."""
        parts = zip(self.members, state_BS.split(self.sizes, 1), strict=True)
        return torch.stack([member(ask, obs_BVF, part_BS) for member, part_BS in parts]).mean(0)

    def passed(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what is seen."""
        return obs_BVF

    def notice(self, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
        """Return what the members remember, side by side."""
        parts = zip(self.members, state_BS.split(self.sizes, 1), strict=True)
        return torch.cat([_notice(member, obs_BVF, part_BS) for member, part_BS in parts], 1)


def _notice(member: nn.Module, obs_BVF: Tensor, state_BS: Tensor) -> Tensor:
    assert isinstance(member, Defence)
    return member.notice(obs_BVF, state_BS)


class DefendedNetwork(nn.Module):
    """A network, perhaps with a memory, behind a defence: what a gradient attack differentiates.

    Its state is what the defence remembers, and then what the network does.
    """

    def __init__(self, network: nn.Module, defence: Defence, lanes: int) -> None:
        super().__init__()
        self.network, self.defence, self.lanes = network, defence, lanes

    def forward(self, obs_BVF: Tensor, state_BS: Tensor | None = None) -> Tensor:
        """Return the Q-values (B, A)."""
        size = self.defence.size
        state_BS = obs_BVF.new_zeros(len(obs_BVF), 0) if state_BS is None else state_BS
        inner_BS = state_BS[:, size:]

        def ask(seen_KBVF: Tensor) -> Tensor:
            count = len(seen_KBVF)
            given = (inner_BS.repeat(count, 1),) if inner_BS.shape[1] else ()
            return self.network(seen_KBVF.flatten(0, 1), *given).unflatten(0, (count, -1)).mean(0)

        return self.defence(ask, obs_BVF, state_BS[:, :size])


def make_defence(members: tuple[str, ...], scenario: str, vehicles: int, seed: int = 0) -> Defence:
    """Return the defence that texts such as ``smooth:3`` name; of more than one their average.

    Args:
        members: each a kind, with its number if it has one.
        scenario: for the road's ranges, and whose shipped data a purifier is fitted on.
        vehicles: rows of what is seen.
        seed: of the points of a noise average.

    Raises:
        RapidError: a number that makes no sense, or no data to fit a purifier on.
    """
    found = [_one(member, scenario, vehicles, seed) for member in members]
    return found[0] if len(found) == 1 else Average(found)


def _one(text: str, scenario: str, vehicles: int, seed: int) -> Defence:
    kind, _, number = text.partition(":")
    lanes = get_scenario(scenario).lanes
    if kind == "track":
        return TrackFilter(vehicles)
    if kind == "noise-average":
        radius = _number(number)
        if not 0 <= radius < 0.5:
            raise RapidError(
                f"'{text}' cannot average noise: its radius is the deviation of normal noise in features scaled to +-1 "
                "and must be from 0 to below 0.5, such as noise-average:0.1."
            )
        return NoiseAverage(radius, vehicles, lanes, seed)
    size = int(number) if number.isdecimal() else 0
    if kind == "smooth":
        if not 1 <= size <= MOST_WINDOW:
            raise RapidError(f"'{text}' cannot smooth: its window is 1 to {MOST_WINDOW} decisions, such as smooth:3.")
        return Smoothing(size, vehicles)
    if not 1 <= size <= NUMBERS:
        raise RapidError(
            f"'{text}' cannot purify: its size is 1 to {NUMBERS} numbers, as many as an observation of {NUM_VEHICLES} "
            f"vehicles has without presence, such as {kind}:8."
        )
    if vehicles != NUM_VEHICLES:
        raise RapidError(
            f"'{text}' purifies observations of {NUM_VEHICLES} vehicles, as shipped data has them, but the agent reads "
            f"{vehicles}. Choose another defence, or an agent that reads {NUM_VEHICLES}."
        )
    return Purifier(fitted(kind, size, scenario.partition(":")[0]), lanes)


def _number(text: str) -> float:
    """Return the number, or one that no comparison accepts."""
    try:
        return float(text)
    except ValueError:
        return math.nan
