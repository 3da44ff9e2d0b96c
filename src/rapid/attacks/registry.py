"""From a spec to an attack that can be made on observations."""

from collections.abc import Callable

from rapid.attacks import kinds
from rapid.attacks.adversary import AdversaryAttack
from rapid.attacks.attack import Attack
from rapid.attacks.spec import AttackSpec, Kind, as_spec
from rapid.attacks.world import WorldAttack

_MAKERS: dict[Kind, Callable[[AttackSpec, int | None], Attack]] = {
    "none": kinds.NoAttack,
    "uniform": kinds.NoiseAttack,
    "gaussian": kinds.NoiseAttack,
    "fgsm": kinds.GradientAttack,
    "pgd": kinds.GradientAttack,
    "directed": kinds.DirectedAttack,
    "square": kinds.SquareAttack,
    "transfer": kinds.TransferAttack,
    "lie": kinds.LieAttack,
    "coupled": kinds.CoupledAttack,
    "world": WorldAttack,
    "adversary": AdversaryAttack,
}


def get_attack(attack: str | AttackSpec, lanes: int | None = None) -> Attack:
    """Return an attack by its text or spec.

    Args:
        attack: such as ``pgd``, ``pgd:steps=50,restarts=5,radius=0.02`` or a spec; see :mod:`rapid.attacks.spec`.
        lanes: lanes of the road whose ranges give the sizes their metres, so that every agent meets the same attack;
            None takes those of the agent's network.

    Raises:
        RapidError: there is no such attack.
    """
    spec = as_spec(attack)
    return _MAKERS[spec.kind](spec, lanes)
