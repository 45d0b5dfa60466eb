"""The addresses that browsers hide behind names: candidates such as 0500-30d8.local (draft-ietf-mmusic-mdns-ice-candidates).

Whoever may not use the camera gets a made-up name for the own address, which only multicast DNS resolves. Many networks and all
containers swallow that, and aioice waits a second for it before it answers. But the offer came from that address.
"""

import ipaddress
import re

_NAMED = re.compile(r"^(a=candidate:(?:\S+ ){4})\S+\.local(?= \d+ typ )", re.MULTILINE | re.IGNORECASE)


def with_address(sdp: str, remote: str | None) -> str:
    """The description with `remote`, the address that it came from, in place of all .local names of its candidates.

    It stays as it is where `remote` is no literal IP (as on a socket of the file system) or means something only here (a zone).
    Behind a proxy the address is wrong, as a name that does not resolve is; the viewer then finds us, as ICE allows.
    """
    address = _literal(remote)
    return sdp if address is None else _NAMED.sub(lambda found: found[1] + address, sdp)


def _literal(remote: str | None) -> str | None:
    try:
        address = ipaddress.ip_address(remote or "")
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        if address.scope_id is not None:
            return None
    return str(address)
