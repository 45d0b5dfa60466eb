"""Serving a site: listening on one address, with or without TLS, until the block ends."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from aiohttp import web

from mrbokeh.system.errors import InputError
from viewfinder.server.addresses import page_url
from viewfinder.server.site import Site
from viewfinder.server.tls import Tls

_SHUTDOWN_S = 1.0


@asynccontextmanager
async def serving_site(site: Site, host: str, port: int, tls: Tls | None = None) -> AsyncIterator[str]:
    """Serve a site inside the block; gives the address of the page, without a token. Port 0 takes a free one.

    With TLS the address has a name that the certificate covers; that it leads to this machine is the user's care.
    """
    runner = web.AppRunner(site.application(), shutdown_timeout=_SHUTDOWN_S, access_log=None)
    await runner.setup()
    try:
        await _bind(runner, host, port, tls)
        yield page_url(_spoken_name(host, tls), runner.addresses[0][1], secure=tls is not None)
    finally:
        await runner.cleanup()


def _spoken_name(host: str, tls: Tls | None) -> str:
    """The name in the URL: browsers accept a certificate only under a name that it covers."""
    return host if tls is None or not tls.names or host.lower() in tls.names else tls.names[0]


async def _bind(runner: web.AppRunner, host: str, port: int, tls: Tls | None) -> None:
    try:
        await web.TCPSite(runner, host, port, ssl_context=None if tls is None else tls.context).start()
    except (OSError, OverflowError) as error:
        raise InputError(f"cannot listen on {host} port {port} ({error}): choose another one with --port, or stop what uses it") from None
