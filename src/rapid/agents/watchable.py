"""What all agents can do in a notebook."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rapid.play.inline import Watched


class Watchable:
    """An agent with :meth:`watch`."""

    def watch(self, scenario: str = "", seed: int = 900_000, attack: str = "none", beside: Any = None) -> "Watched":
        """Drive an episode and return a player of it, which a notebook shows; see :func:`rapid.play.inline.watch`.

        Args:
            scenario: where; empty for where the agent was trained, or, if it does not tell, the first of the paper's.
            seed: the spawn seed, which fixes the traffic.
            attack: the text of an attack, such as ``fgsm`` or ``pgd:radius=0.05,steps=10``.
            beside: another driver, who meets the same traffic, and the same attack if it can be made on it.

        Raises:
            RapidError: an unknown scenario or attack, or an attack that cannot be made on the agent.
        """
        from rapid.play.inline import watch  # imports what drives, which imports agents

        return watch(self, scenario, seed, attack, beside)
