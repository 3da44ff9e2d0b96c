"""What a collection may use, how far it is, and the error that ends it when all is used."""

from dataclasses import dataclass
from typing import NamedTuple

from rapid.data.transitions import TEACHER
from rapid.errors import RapidError


@dataclass(frozen=True)
class Budget:
    """When to stop early; 0 is no limit. All but seconds count over all runs of a collection, seconds over this one."""

    tokens: int = 0
    """Tokens read and written."""
    cost: float = 0.0
    """Price, in the currency of the settings."""
    seconds: float = 0.0
    """Wall-clock seconds of this process."""
    decisions: int = 0
    """Decisions; never exceeded, while the others are noticed once they are."""
    fallback_share: float = 1.0
    """Share of decisions that a rule may make in the model's place; above it, collecting fails."""

    def check(self, decisions: int, tokens: int, cost: float, seconds: float) -> None:
        """Raise SpentError if it is spent, or does not allow for so many decisions, those that come next included."""
        if self.decisions and decisions > self.decisions:
            raise SpentError(f"The budget of {self.decisions} decisions was spent")
        for name, used, limit in (
            ("tokens", tokens, self.tokens),
            ("cost", cost, self.cost),
            ("seconds", seconds, self.seconds),
        ):
            if limit and used >= limit:
                raise SpentError(f"The budget of {limit:g} {name} was spent")


class Tally(NamedTuple):
    """How far a collection is, sent after every step."""

    decisions: int = 0
    """Decisions so far, those of earlier runs included."""
    fresh: int = 0
    """Decisions that the teacher was asked for in this run."""
    rate: float = 0.0
    """Fresh decisions per second."""
    cost: float = 0.0
    fallbacks: int = 0

    def note(self, source: int) -> str:
        """Return what is shown beside the count; chance gives no invalid answers."""
        cost = f", cost {self.cost:.4g}" if self.cost else ""
        invalid = f", {self.fallbacks / max(self.decisions, 1):.1%} fallbacks" if source == TEACHER else ""
        return f"{self.rate:.3g} decisions/s{cost}{invalid}"


class SpentError(RapidError):
    """The budget is spent; the message says which."""
