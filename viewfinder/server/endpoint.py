"""Endpoint: the one address at which a viewfinder listens, its TLS certificate, whom it lets in, and what it prints for them."""

import asyncio
import contextlib
import io
import signal
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from aiohttp import web

from mrbokeh.system.errors import InputError, MissingExtraError
from mrbokeh.system.messages import tell
from viewfinder.options import ListeningOptions
from viewfinder.server.access import LOOPBACK_NAMES, Access, is_loopback
from viewfinder.server.door import PATIENCE_S, Door, quiet_log
from viewfinder.server.sessions import Role, Sessions

# Routers of mobile networks and Tailscale use 100.64.0.0/10, which is neither private nor public.
_SHARED = (IPv4Address("100.64.0.0"), IPv4Address("100.127.255.255"))
_WHITE_ON_BLACK, _RESET = "\x1b[97;40m", "\x1b[0m"
_SHUTDOWN_S = 1.0
_CAMERA_PAGE = "camera"
# Never answers (RFC 5737); asking for the way there sends nothing.
_ELSEWHERE = ("198.51.100.1", 9)


class Interface(NamedTuple):
    """Network interface of this machine with one of its IPv4 addresses."""

    name: str
    address: str


@runtime_checkable
class Served(Protocol):
    """Site whose routes are served, behind its rules of access."""

    access: Access

    def application(self) -> web.Application: ...


class Tls(NamedTuple):
    """TLS of a server. names: host names and addresses that the certificate covers, in lower case, without wildcards."""

    context: ssl.SSLContext
    names: tuple[str, ...]


@dataclass(frozen=True)
class Endpoint:
    """Address with its certificate and rules of access, before anything listens there."""

    options: ListeningOptions
    host: str
    tls: Tls | None
    access: Access

    @property
    def sessions(self) -> Sessions | None:
        """Sessions of a network; None where only this machine is let in, and everybody on it."""
        return self.access.sessions

    def announce(self, what: str, url: str, roles: Sequence[Role] = tuple(Role)) -> None:
        """Print where `what` is shown, and to whom of these roles it is offered.

        An address with a token is good for one device; the next one is printed when it was used.
        """
        if self.sessions is None:
            tell(f"{what}: {url} (Ctrl-C stops it)")
            return
        sessions = self.sessions
        tell(f"{what} (Ctrl-C stops it)")
        for role in roles:
            self._invite(url, sessions, role)
        if Role.VIEW in roles:
            tell(f"for OBS, as a browser source: {url}obs#token={sessions.standing_token(Role.VIEW)}")
        sessions.renewed = lambda role: self._invite(url, sessions, role)

    def announce_camera(self, url: str) -> None:
        """Print the page with which a browser sends its camera. Its token is never used up: a phone comes back without asking."""
        if self.sessions is None:
            tell(f"to send a camera from a browser: {url}{_CAMERA_PAGE}")
            return
        token = self.sessions.standing_token(Role.CONTROL)
        address = f"{url}{_CAMERA_PAGE}#token={token}"
        if self.options.qr:
            tell(qr_text(address))
        tell(f"to send a camera from a browser: {address}")
        tell(f"to send one from OBS (WHIP): {url}whip with the bearer token {token}")

    def _invite(self, url: str, sessions: Sessions, role: Role) -> None:
        address = f"{url}#token={sessions.invitation(role)}"
        if role is Role.CONTROL and self.options.qr:
            tell(qr_text(address))
        tell(f"to {role.word}, for one device: {address}")


def open_endpoint(options: ListeningOptions) -> Endpoint:
    """Read the certificate and find the interface; nothing listens yet."""
    options.refuse_contradictions()
    host = host_of(options)
    tls = None if options.tls is None else load_tls(options.tls, options.tls_key)
    names = LOOPBACK_NAMES | {host.lower()} | (frozenset() if tls is None else frozenset(tls.names))
    access = Access(names=names, sessions=Sessions() if options.lan else None, secure=tls is not None)
    return Endpoint(options, host, tls, access)


def host_of(options: ListeningOptions) -> str:
    """Return the one address to listen on: loopback, or that of the interface with --lan."""
    return lan_address(options.interface) if options.lan else "127.0.0.1"


def on_stop(stop: Callable[[], object]) -> None:
    """Call `stop` on Ctrl-C and SIGTERM; in a running loop. Where handlers cannot be set (Windows), Ctrl-C is a KeyboardInterrupt."""
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(number, stop)


@contextlib.asynccontextmanager
async def serving_site(site: Served, host: str, port: int, tls: Tls | None = None) -> AsyncIterator[str]:
    """Serve a site inside the block; gives the address of the page, without a token. Port 0 takes a free one.

    With TLS the address has a name that the certificate covers; that it leads to this machine is the user's care.
    """
    runner = web.AppRunner(
        site.application(), shutdown_timeout=_SHUTDOWN_S, access_log=None, keepalive_timeout=PATIENCE_S, lingering_time=PATIENCE_S
    )
    with quiet_log():
        await runner.setup()
        assert runner.server is not None, "set up"
        door = Door(runner.server, None if tls is None else tls.context, PATIENCE_S)
        site.access.came = door.came
        try:
            yield page_url(_spoken_name(host, tls), _opened(door, host, port), secure=tls is not None)
        finally:
            await door.close()
            await runner.cleanup()
            await door.leave()


def _spoken_name(host: str, tls: Tls | None) -> str:
    """Return the name in the URL: browsers accept a certificate only under a name that it covers."""
    return host if tls is None or not tls.names or host.lower() in tls.names else tls.names[0]


def _opened(door: Door, host: str, port: int) -> int:
    try:
        return door.open(host, port)
    except (OSError, OverflowError) as error:
        raise InputError(f"cannot listen on {host} port {port} ({error}): choose another one with --port, or stop what uses it") from None


def lan_address(wanted: str | None = None) -> str:
    """Return the address of ONE interface: the one wanted (a name or an address), else the private one through which the way out leads."""
    return choose(interfaces(), wanted, _way_out())


def choose(present: Sequence[Interface], wanted: str | None, way_out: str | None) -> str:
    """Choose among interfaces; InputError where nothing or several fit."""
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
    """Return the interfaces of this machine with an IPv4 address."""
    try:
        import ifaddr
    except ImportError:
        raise MissingExtraError("ifaddr", "viewfinder") from None
    return [Interface(adapter.nice_name, str(ip.ip)) for adapter in ifaddr.get_adapters() for ip in adapter.ips if ip.is_IPv4]


def page_url(host: str, port: int, *, secure: bool, token: str | None = None, path: str = "/") -> str:
    """Return the URL of the page; the token goes into the fragment, which browsers keep to themselves."""
    name = f"[{host}]" if ":" in host else host
    return f"{'https' if secure else 'http'}://{name}:{port}{path}{f'#token={token}' if token else ''}"


def qr_text(text: str, *, colored: bool = True) -> str:
    """Draw a QR code of half blocks for a terminal; colored: white on black also where the terminal is dark on light."""
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
    """Return the address from which this machine would send to the internet; None without a way there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)
        except OSError:
            return None
        return str(probe.getsockname()[0])


def load_tls(certificate: Path, key: Path | None = None) -> Tls:
    """Load a certificate chain in PEM and its key, which may be in the same file; InputError says what is wrong with them."""
    key = key or certificate
    for path, what in ((certificate, "certificate"), (key, "key")):
        if not path.is_file():
            raise InputError(f"there is no {what} file {path}: make one with `mkcert`, or give the {what} you have")
    names = _names(certificate)
    if b"ENCRYPTED" in key.read_bytes():
        # A pass phrase would be asked for in the middle of a shoot.
        raise InputError(f"the key {key} has a pass phrase: remove it with `openssl pkey -in {key} -out PLAIN.pem`")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        raise InputError(_refused(certificate, key, error)) from None
    except OSError as error:
        raise InputError(f"the certificate {certificate} or its key {key} cannot be read ({error.strerror})") from None
    return Tls(context, names)


def _names(certificate: Path) -> tuple[str, ...]:
    try:
        from cryptography import x509
    except ImportError:
        raise MissingExtraError("cryptography", "viewfinder") from None
    try:
        loaded = x509.load_pem_x509_certificates(certificate.read_bytes())[0]
    except (ValueError, OSError):
        raise InputError(f"{certificate} holds no certificate in PEM (-----BEGIN CERTIFICATE-----): convert it with openssl") from None
    if loaded.not_valid_after_utc < datetime.now(UTC):
        raise InputError(f"the certificate {certificate} expired on {loaded.not_valid_after_utc:%Y-%m-%d}: make a new one")
    try:
        alternative = loaded.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        raise InputError(
            f"the certificate {certificate} names no host (no subjectAltName), so no browser accepts it: make it anew"
        ) from None
    names: list[Any] = [*alternative.get_values_for_type(x509.DNSName), *alternative.get_values_for_type(x509.IPAddress)]
    return tuple(str(name).lower() for name in names if "*" not in str(name))


def _refused(certificate: Path, key: Path, error: ssl.SSLError) -> str:
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"the key {key} does not belong to the certificate {certificate}: give the key that was made with it"
    return f"the certificate {certificate} and the key {key} cannot be used ({error.reason or error}): expected a key in PEM"
