"""Who a request says it is for and from: against pages of other sites, and against names that turn into our address (DNS rebinding)."""

import re
from collections.abc import Mapping
from ipaddress import ip_address
from urllib.parse import urlsplit

# A name or an address and a port, without the rest that URLs allow there.
_HOST = re.compile(r"[\w.-]+(:\d{1,5})?|\[[0-9A-Fa-f:.]+\](:\d{1,5})?", re.ASCII)
LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def host_name(host_header: str | None) -> str | None:
    """The name in a Host header, without port, in lower case; None if there is none or it is malformed."""
    if host_header is None or not _HOST.fullmatch(host_header):
        return None
    try:
        return urlsplit(f"//{host_header}").hostname
    except ValueError:
        return None


def objection(headers: Mapping[str, str], names: frozenset[str], *, opens_page: bool) -> str | None:
    """Why a request is refused, as a sentence; None if it is for us (`names`) and from our own page, or from no page at all.

    opens_page: the request only loads the page, which a link of another site may do.
    """
    host = headers.get("Host")
    if host_name(host) not in names:
        return f"this viewfinder does not answer to the name {host!r}: open the address that it printed"
    origin = headers.get("Origin")
    if origin is not None and _netloc(origin) != str(host).lower():
        return "this viewfinder answers only to its own page"
    if not opens_page and headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
        return "this viewfinder answers only to its own page"
    return None


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None
