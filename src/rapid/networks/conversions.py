"""A network made into another one that acts as it did: it sees farther, has a memory, or is for another road."""

from dataclasses import replace

import torch

from rapid.config_learning import NetworkConfig
from rapid.errors import RapidError
from rapid.networks.q_network import QNetwork, build_network, check_memory
from rapid.scenarios import MAX_VEHICLES


def check_widening(config: NetworkConfig, vehicles: int) -> None:
    """Check that a network of these settings can be `widened` to so many rows.

    Raises:
        RapidError: it reads more, it has weights for every row, or it would attend to rows that are absent.
    """
    if vehicles < config.vehicles:
        raise RapidError(
            f"adapt.vehicles is {vehicles}, but the network reads {config.vehicles} vehicles already. Set it to "
            f"{config.vehicles} to {MAX_VEHICLES}, or to 0 to leave them as they are."
        )
    why = ""
    if config.kind not in ("rapid", "attentive") or config.position == "learned":
        why = (
            f"of kind '{config.kind}' and position '{config.position}' has weights for each of its {config.vehicles} "
            "vehicles and none for more"
        )
    elif not config.mask_absent:
        why = "without mask_absent attends to rows of absent vehicles, so that more of them change what it does"
    if why and vehicles > config.vehicles:
        raise RapidError(
            f"adapt.vehicles is {vehicles}, but a network {why}. Set network.vehicles to {vehicles} when it is "
            "distilled, or adapt.vehicles to 0."
        )


def widened(network: QNetwork, vehicles: int) -> QNetwork:
    """Return the network as one that reads so many rows; where there are no more than it had, it is the same.

    The gates of the new rows, which are those farthest away, are that of the last row it had.

    Raises:
        RapidError: what :func:`check_widening` refuses.
    """
    config = network.config
    check_widening(config, vehicles)
    if vehicles == config.vehicles:
        return network
    wide = build_network(replace(config, vehicles=vehicles), network.lanes, seed=0).to(network.scale_F.device)
    weights = network.state_dict()
    gate_NV = weights["head.mixture.gate_NV"]
    more_NV = gate_NV[:, -1:].expand(-1, vehicles - config.vehicles)
    wide.load_state_dict(weights | {"head.mixture.gate_NV": torch.cat([gate_NV, more_NV], 1)})
    return wide.train(network.training)


def with_memory(network: QNetwork, squeeze: bool = False) -> QNetwork:
    """Return the network as one that has a memory; it acts as it did, bit for bit, until it has learned to use it.

    Args:
        network: the network; what it has stays.
        squeeze: read squeezed features from now on (:meth:`rapid.networks.memory.Memory.squeezed`), which changes what
            it does at once.

    Raises:
        RapidError: what :func:`check_memory` refuses.
    """
    config = replace(network.config, memory=True, squeeze=squeeze or network.config.squeeze)
    check_memory(config)
    if config == network.config:
        return network
    other = build_network(config, network.lanes, seed=0).to(network.scale_F.device)
    other.load_state_dict(other.state_dict() | network.state_dict())
    return other.train(network.training)


def for_lanes(network: QNetwork, lanes: int) -> QNetwork:
    """Return the network for a road with so many lanes, with the same weights; it reads as before but for the ranges.

    A memory knows the road: which lanes there are, and where an episode begins.
    """
    if network.lanes == lanes:
        return network
    other = build_network(network.config, lanes, seed=0).to(network.scale_F.device)
    ranges = {name: value for name, value in other.state_dict().items() if name.startswith("encoding.")}
    other.load_state_dict(network.state_dict() | ranges)
    return other.train(network.training)
