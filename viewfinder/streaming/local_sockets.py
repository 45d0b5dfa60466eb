"""Sockets of WebRTC on the one address at which the page is served, and nowhere else.

aiortc would open one on every address of the machine but loopback: neighbours of all networks would reach it, and where there is no
network nobody.
"""

import logging
from functools import partial
from typing import Any

from aiohttp import web

log = logging.getLogger(__name__)

# Private in aiortc and aioice, so that each release has to be asked whether they are there.
_TRANSPORTS, _CONNECTION = "_RTCPeerConnection__iceTransports", "_connection"
_GATHERING = "get_component_candidates"


def served_address(request: web.Request) -> str | None:
    """Return the address of this machine to which a request came; None where it came another way than over IP."""
    name = None if request.transport is None else request.transport.get_extra_info("sockname")
    return str(name[0]) if isinstance(name, tuple) else None


def listen_only_at(peer: Any, host: str | None) -> None:
    """Let a peer connection open its sockets at one address; after the offer is set, and before the answer is made."""
    if host is None:
        return
    gatherers = [transport.iceGatherer for transport in getattr(peer, _TRANSPORTS, ())]
    connections = [getattr(each, _CONNECTION, None) for each in gatherers]
    if not connections or not all(hasattr(each, _GATHERING) for each in connections):
        log.warning("this aiortc is not one that is known: WebRTC listens on every address of this machine")
        return
    for connection in connections:
        setattr(connection, _GATHERING, partial(_candidates_at, getattr(connection, _GATHERING), host))


async def _candidates_at(gather: Any, host: str, component: int, addresses: list[str], timeout: int = 5) -> Any:  # noqa: ARG001
    return await gather(component=component, addresses=[host], timeout=timeout)
