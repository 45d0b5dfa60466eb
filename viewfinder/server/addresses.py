"""Which one address the viewfinder listens on for `--lan`, and its URL as text and as a QR code for the phone."""

import io
import socket
from collections.abc import Sequence
from ipaddress import IPv4Address
from typing import NamedTuple

from mrbokeh.system.errors import InputError, MissingExtraError
from viewfinder.server.origins import is_loopback

# Routers of mobile networks and Tailscale use 100.64.0.0/10, which is neither private nor public.
_SHARED = (IPv4Address("100.64.0.0"), IPv4Address("100.127.255.255"))
_WHITE_ON_BLACK, _RESET = "\x1b[97;40m", "\x1b[0m"
# Never answers (RFC 5737); asking for the way there sends nothing.
_ELSEWHERE = ("198.51.100.1", 9)


class Interface(NamedTuple):
    """A network interface of this machine and one of its IPv4 addresses."""

    name: str
    address: str


def lan_address(wanted: str | None = None) -> str:
    """The address of ONE interface: the one wanted (a name or an address), else the private one through which the way out leads."""
    return choose(interfaces(), wanted, _way_out())


def choose(present: Sequence[Interface], wanted: str | None, way_out: str | None) -> str:
    """The choice among interfaces; InputError where nothing or several fit."""
    offered = [each for each in present if not is_loopback(each.address)]
    listed = ", ".join(f"{each.name} ({each.address})" for each in offered) or "none"
    if wanted is not None:
        fitting = [each.address for each in offered if wanted in each]
        if not fitting:
            raise InputError(f"there is no interface {wanted!r} on this machine: choose one of {listed}")
        return fitting[0]
    private = [each.address for each in offered if _is_private(each.address)]
    if way_out in private:
        return str(way_out)
    if len(private) != 1:
        raise InputError(f"expected one interface of a private network to listen on, found {len(private)}: name one of {listed}")
    return private[0]


def interfaces() -> list[Interface]:
    """Those of this machine with an IPv4 address."""
    try:
        import ifaddr
    except ImportError:
        raise MissingExtraError("ifaddr", "viewfinder") from None
    return [Interface(adapter.nice_name, str(ip.ip)) for adapter in ifaddr.get_adapters() for ip in adapter.ips if ip.is_IPv4]


def page_url(host: str, port: int, *, secure: bool, token: str | None = None, path: str = "/") -> str:
    """Of the page; the token goes into the fragment, which browsers keep to themselves."""
    name = f"[{host}]" if ":" in host else host
    return f"{'https' if secure else 'http'}://{name}:{port}{path}{f'#token={token}' if token else ''}"


def qr_text(text: str, *, colored: bool = True) -> str:
    """A QR code of half blocks for a terminal; colored: white on black also where the terminal is dark on light."""
    try:
        import segno
    except ImportError:
        raise MissingExtraError("segno", "viewfinder") from None
    out = io.StringIO()
    segno.make(text, error="l", micro=False).terminal(out, border=2, compact=True)
    lines = out.getvalue().splitlines()
    return "\n".join(f"{_WHITE_ON_BLACK}{line}{_RESET}" for line in lines) if colored else "\n".join(lines)


def _is_private(address: str) -> bool:
    ip = IPv4Address(address)
    return (ip.is_private and not ip.is_link_local) or _SHARED[0] <= ip <= _SHARED[1]


def _way_out() -> str | None:
    """The address from which this machine would send to the internet; None without a way there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)
        except OSError:
            return None
        return str(probe.getsockname()[0])
