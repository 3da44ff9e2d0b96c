"""An episode in a notebook: driven to its end, then played where the cell is, by the player that all pages share."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rapid.agents.open import check_road, open_agent
from rapid.agents.specs import own_scenario
from rapid.attacks.spec import parse_attack
from rapid.errors import RapidError
from rapid.evaluation.rollouts import is_applicable
from rapid.files import write_text
from rapid.pages import PLAYER, fill_page
from rapid.pages.episodes import ACTION_WORDS
from rapid.pages.markup import tag
from rapid.play.ride import Ride
from rapid.scenarios import PAPER_SCENARIOS, get_scenario

HEIGHT, PER_PANE = 190, 310
"""Pixels of the frame: of the controls, and of each episode. It can be pulled larger, and scrolls inside."""


@dataclass(frozen=True, repr=False)
class Watched:
    """Episodes that a notebook shows as a player: the last line of a cell, or ``display(watched)``."""

    episodes: tuple[dict[str, Any], ...]
    """As the player reads them; see :mod:`rapid.pages.episodes`."""

    def __repr__(self) -> str:
        return f"<Watched: {'; '.join(episode['label'] for episode in self.episodes)}>"

    def page(self) -> str:
        """Return the player as an HTML page that asks the network for nothing."""
        return fill_page(
            "RAPID",
            tag("div", id="inline"),
            {"actions": ACTION_WORDS, "episodes": self.episodes},
            scripts=(*PLAYER, "inline.js"),
            styles=("base.css", "player.css", "inline.css"),
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, to be opened or given away, and return its path.

        Raises:
            RapidError: the file cannot be written.
        """
        write_text(path, self.page())
        return Path(path)

    def _repr_html_(self) -> str:
        # A frame of its own: its script cannot reach the notebook, nor the notebook's styles the player.
        return tag(
            "iframe",
            srcdoc=self.page(),
            title=f"player: {'; '.join(episode['label'] for episode in self.episodes)}",
            sandbox="allow-scripts allow-downloads",
            style=f"width:100%;height:{HEIGHT + PER_PANE * len(self.episodes)}px;border:0;resize:vertical",
        )


def watch(agent: Any, scenario: str = "", seed: int = 900_000, attack: str = "none", beside: Any = None) -> Watched:
    """Drive an episode and return a player of it, which a notebook shows.

    Args:
        agent: anything that drives: it has ``act``, ``decide`` or ``bind``; or the name of a driver, as
            :func:`~rapid.agents.open.open_agent` takes it.
        scenario: where; empty for where the agent was trained, or, if it does not tell, the first of the paper's.
        seed: the spawn seed, which fixes the traffic.
        attack: the text of an attack, such as ``fgsm`` or ``pgd:radius=0.05,steps=10``.
        beside: another driver, who meets the same traffic, and the same attack if it can be made on it.

    Raises:
        RapidError: an unknown scenario or attack, an attack that cannot be made on the agent, or nothing that drives.
    """
    named = (
        own_scenario([agent]) if isinstance(agent, str) else (getattr(agent, "metadata", None) or {}).get("scenario")
    )
    place = get_scenario(scenario or named or PAPER_SCENARIOS[0]).name
    drivers = [agent] if beside is None else [agent, beside]
    opened = [open_agent(driver, place) if isinstance(driver, str) else driver for driver in drivers]
    if not is_applicable(opened[0], attack):
        raise RapidError(
            f"The attack '{attack}' cannot be made on '{getattr(opened[0], 'name', agent)}', which has no network, no "
            "values of the actions, or does not observe. Choose uniform, gaussian, lie or transfer, or another driver."
        )
    made = [attack if is_applicable(driver, attack) else "none" for driver in opened]
    return Watched(tuple(_episode(driver, place, seed, own) for driver, own in zip(opened, made, strict=True)))


def _episode(agent: Any, scenario: str, seed: int, attack: str) -> dict[str, Any]:
    """Drive an episode and return it as the player reads it."""
    check_road(agent, scenario)
    radius = 0.0 if attack == "none" else min(parse_attack(attack).radius, 0.49)
    ride = Ride(agent, scenario, seed)
    episode: dict[str, Any] = ride.opening() | {"attack": attack}
    while not ride.ended:
        for name, value in ride.step(attack=attack, radius=radius)["added"].items():
            episode[name].append(value)
    words = "" if attack == "none" else f" under {attack}"
    ending = "crash" if ride.crashed else "no crash"
    return episode | {
        "ended": True,
        "crashed": ride.crashed,
        "label": f"{episode['agent']}{words}, {scenario}, spawn {seed}: return {sum(episode['rewards']):.1f}, {ending}",
    }
