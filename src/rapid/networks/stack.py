"""Several networks of one shape as one, so that several seeds train in one process for little more than one costs."""

from collections.abc import Sequence

from rapid.errors import RapidError
from rapid.networks.mlp import MlpHead, MlpStack
from rapid.networks.q_network import QNetwork, build_network


def stack_networks(networks: Sequence[QNetwork]) -> QNetwork:
    """Return a network that holds copies of `networks`; of a batch each reads its own part, in their order.

    Raises:
        RapidError: there are none, they differ in their settings, or are no plain multilayer perceptrons: attention
            gains nothing from it on a CPU, where a process for each seed is faster.
    """
    if not networks:
        raise RapidError("There is no network to be stacked. Give at least one.")
    first = networks[0]
    if any(each.config != first.config or each.lanes != first.lanes for each in networks):
        raise RapidError("Only networks with the same settings and lanes can be stacked. Build them from one config.")
    heads = [each.head for each in networks if isinstance(each.head, MlpHead)]
    if len(heads) < len(networks) or first.config.kind != "mlp":
        raise RapidError(
            f"Networks of kind '{first.config.kind}' cannot be stacked, only of kind 'mlp'. Train each in a process of "
            "its own."
        )
    stack = build_network(first.config, first.lanes, 0)
    stack.head = MlpStack(heads)
    return stack.to(first.scale_F.device)


def unstack_networks(stack: QNetwork) -> list[QNetwork]:
    """Return copies of the networks that a stack holds.

    Raises:
        RapidError: it is no stack.
    """
    if not isinstance(stack.head, MlpStack):
        raise RapidError("This network is no stack. Give what `stack_networks` returned.")
    found: list[QNetwork] = []
    for member in range(stack.members):
        network = build_network(stack.config, stack.lanes, 0).to(stack.scale_F.device)
        assert isinstance(network.head, MlpHead)
        stack.head.copy_to(network.head, member)
        found.append(network)
    return found
