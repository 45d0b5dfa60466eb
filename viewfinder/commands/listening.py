"""Where a command of the viewfinder listens, whom it lets in, and what it prints for them."""

import asyncio
import contextlib
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import typer

from mrbokeh.system.errors import InputError
from viewfinder.server.access import LOOPBACK_NAMES, Access
from viewfinder.server.endpoint import Tls, lan_address, load_tls, qr_text
from viewfinder.server.sessions import Role, Sessions


@dataclass(frozen=True)
class ListeningOptions:
    """As on the command line. interface: None takes the one private one. qr: whether a QR code is printed for a network."""

    port: int = 8080
    lan: bool = False
    interface: str | None = None
    tls: Path | None = None
    tls_key: Path | None = None
    qr: bool = True

    @property
    def host(self) -> str:
        """The one address at which this machine listens: loopback, or that of the interface with --lan."""
        return lan_address(self.interface) if self.lan else "127.0.0.1"

    def refuse_contradictions(self) -> None:
        """InputError where an option has no effect without another one that is missing."""
        if self.interface is not None and not self.lan:
            raise InputError(f"--interface {self.interface} is for --lan: give --lan too, or leave it out")
        if self.tls_key is not None and self.tls is None:
            raise InputError("--tls-key is for --tls CERTIFICATE: give the certificate too, or leave it out")


@dataclass(frozen=True)
class Door:
    """sessions: None where only this machine is let in, and everybody on it."""

    host: str
    port: int
    tls: Tls | None
    sessions: Sessions | None
    access: Access
    qr: bool = True

    def announce(self, what: str, url: str) -> None:
        """what: is shown there. An address with a token is good for one device; the next one is printed when it was used."""
        if self.sessions is None:
            typer.echo(f"{what}: {url} (Ctrl-C stops it)")
            return
        sessions = self.sessions
        typer.echo(f"{what} (Ctrl-C stops it)")
        for role in (Role.VIEW, Role.CONTROL):
            self._invite(url, sessions, role)
        typer.echo(f"for OBS, as a browser source: {url}obs#token={sessions.standing_token(Role.VIEW)}")
        sessions.renewed = lambda role: self._invite(url, sessions, role)

    def announce_camera(self, url: str, page: str) -> None:
        """page: with which a browser sends its camera. Its token is never used up: a phone on a camera comes back without asking."""
        if self.sessions is None:
            typer.echo(f"to send a camera from a browser: {url}{page}")
            return
        token = self.sessions.standing_token(Role.CONTROL)
        address = f"{url}{page}#token={token}"
        if self.qr:
            typer.echo(qr_text(address))
        typer.echo(f"to send a camera from a browser: {address}")
        typer.echo(f"to send one from OBS (WHIP): {url}whip with the bearer token {token}")

    def _invite(self, url: str, sessions: Sessions, role: Role) -> None:
        address = f"{url}#token={sessions.invitation(role)}"
        if role is Role.CONTROL and self.qr:
            typer.echo(qr_text(address))
        typer.echo(f"to {role.word}, for one device: {address}")


def open_door(options: ListeningOptions) -> Door:
    """Reads the certificate and finds the interface; nothing listens yet."""
    options.refuse_contradictions()
    host = options.host
    tls = None if options.tls is None else load_tls(options.tls, options.tls_key)
    sessions = Sessions() if options.lan else None
    names = LOOPBACK_NAMES | {host.lower()} | (frozenset() if tls is None else frozenset(tls.names))
    return Door(host, options.port, tls, sessions, Access(names=names, sessions=sessions, secure=tls is not None), options.qr)


def on_stop(stop: Callable[[], object]) -> None:
    """In a running loop: Ctrl-C and SIGTERM call it. Where signal handlers cannot be set (Windows), Ctrl-C arrives as KeyboardInterrupt."""
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(number, stop)
