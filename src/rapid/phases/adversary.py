"""An adversary on disk: trained against one saved agent, and saved like one."""

import os

from rapid.agents.open import open_agent
from rapid.attacks.adversary import save_adversary, train_adversary
from rapid.attacks.spec import parse_attack
from rapid.errors import RapidError
from rapid.progress import task
from rapid.scenarios import get_scenario


def train(
    agent: str, scenario: str, attack: str, steps: int, out: str | os.PathLike[str], seed: int = 0
) -> tuple[float, float]:
    """Train an adversary and save it; return the agent's mean return in the first and in the last round.

    Args:
        agent: the agent: its directory, or another spec of one with a network.
        scenario: where it is attacked.
        attack: text of an attack of kind `adversary`, without a source.
        steps: decisions to learn from.
        out: directory of the adversary.
        seed: of all chance.

    Raises:
        RapidError: no such agent or scenario, an attack of another kind, or no steps.
    """
    spec = parse_attack(attack)
    if spec.kind != "adversary" or spec.source:
        raise RapidError(
            f"--attack is '{attack}', but must describe the adversary to be trained, as in adversary:radius=0.1."
        )
    if steps < 1:
        raise RapidError(f"--steps is {steps}, but must be at least 1.")
    get_scenario(scenario)
    victim, returns = open_agent(str(agent), scenario), list[float]()
    with task(f"adversary of {victim.name}", steps, "steps") as work:

        def progress(done: float, mean: float) -> None:
            returns.append(mean)
            work.advance(done)
            work.note(f"return {mean:.2f}")

        director = train_adversary(victim, scenario, spec, steps, seed, progress)
    save_adversary(out, director, victim, scenario, spec, steps)
    return returns[0], returns[-1]
