"""Whether a Ray cluster answers at an address: Ray itself tries for minutes, and then does not name it."""

import socket

from rapid.errors import RapidError

PATIENCE = 5.0
"""Seconds that the head of a cluster has to answer."""


def check_ray_address(address: str) -> None:
    """Look whether anybody answers at ``HOST:PORT`` or ``ray://HOST:PORT``; what else there is, Ray alone can judge.

    Raises:
        RapidError: nobody does.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        return  # nothing, `auto` or `local`
    try:
        socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise RapidError(
            f"RAY_ADDRESS is '{address}', and no Ray cluster answers there: {error}. Expected HOST:PORT of a head node "
            "that runs and that this machine can reach. Look with `ray status` on that machine, start it with `ray "
            "start --head`, correct or unset RAY_ADDRESS, or use --engine local."
        ) from error
