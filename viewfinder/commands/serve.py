"""`mrbokeh viewfinder`: the running viewfinder, from its options to the address of its page."""

import asyncio
import contextlib
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import typer

from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.lens import Lens
from mrbokeh.lens_file import read_lens
from viewfinder.assembly import TrackingChoice, open_scenery, open_tracker, read_lenses, renderers_of
from viewfinder.running import Parts, Viewfinder, running
from viewfinder.server.access import Access
from viewfinder.server.addresses import lan_address, qr_text
from viewfinder.server.app import serving_site
from viewfinder.server.origins import LOOPBACK_NAMES
from viewfinder.server.sessions import Role, Sessions
from viewfinder.server.tls import Tls, load_tls
from viewfinder.sources.base import FrameSource
from viewfinder.sources.choose import open_source
from viewfinder.sources.exact_size import ExactSize
from viewfinder.still_layer import StillLayer
from viewfinder.tracking.base import Tracker
from viewfinder.tracking.fixed_pose import FixedPose, read_fixed_pose


@dataclass(frozen=True)
class ServeOptions:
    """As on the command line (viewfinder/cli.py). scene or layer; lan: None is loopback, "" the one private interface, else its name."""

    source: str
    scene: Path | None
    layer: Path | None
    lenses: tuple[Path, ...]
    renderers: tuple[str, ...]
    psf: Path | None
    tracking: TrackingChoice
    camera: Path | None
    smoothing: bool
    width_px: int | None
    fps: float | None
    captures: Path
    port: int
    lan: str | None
    tls: Path | None
    tls_key: Path | None
    backend: str = "auto"


@contextmanager
def opened(options: ServeOptions, access: Access) -> Iterator[Viewfinder]:
    """Reads all files, opens the camera, and runs everything but the server; threads end with the block."""
    if (options.scene is None) == (options.layer is None):
        raise InputError("expected either --scene SCENE.toml or --layer RGBAZ.exr: give one of them")
    lenses, networks = read_lenses(options.lenses, _lens_of(options.scene))
    renderers = renderers_of(options.renderers, options.psf, networks)
    tracker = open_tracker(options.tracking)
    source = open_source(options.source, options.width_px, None, options.fps)
    scenery = open_scenery(options.scene, options.layer, lambda: lenses.lens, renderers, options.backend)
    if isinstance(scenery, StillLayer):
        source = ExactSize(source, scenery.sharp.width_px, scenery.sharp.height_px)
    camera = _camera(options, tracker)
    parts = Parts(source, scenery, lenses, renderers, options.captures, tracker, camera, options.scene, options.smoothing, access)
    with running(parts) as viewfinder:
        yield viewfinder


def serve(options: ServeOptions) -> None:
    """Runs until Ctrl-C."""
    host = listening_address(options.lan)
    tls = None if options.tls is None else load_tls(options.tls, options.tls_key)
    sessions = None if options.lan is None else Sessions()
    names = LOOPBACK_NAMES | {host.lower()} | (frozenset() if tls is None else frozenset(tls.names))
    access = Access(names=names, sessions=sessions, secure=tls is not None)
    with opened(options, access) as viewfinder, contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_served(viewfinder, host, options.port, tls, sessions))
    typer.echo("viewfinder stopped")


def listening_address(lan: str | None) -> str:
    """The one address at which this machine listens: loopback, or that of the interface with --lan."""
    return "127.0.0.1" if lan is None else lan_address(lan or None)


async def _served(viewfinder: Viewfinder, host: str, port: int, tls: Tls | None, sessions: Sessions | None) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        # Where signal handlers cannot be set (Windows), Ctrl-C arrives as KeyboardInterrupt.
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    async with serving_site(viewfinder.site, host, port, tls) as url:
        _announce(viewfinder.pipeline.source, url, sessions)
        if sessions is not None:
            sessions.renewed = lambda role: _invite(url, sessions, role)
        await stopped.wait()


def _announce(source: FrameSource, url: str, sessions: Sessions | None) -> None:
    if sessions is None:
        typer.echo(f"viewfinder of {source.name}: {url} (Ctrl-C stops it)")
        return
    typer.echo(f"viewfinder of {source.name} (Ctrl-C stops it)")
    for role in (Role.VIEW, Role.CONTROL):
        _invite(url, sessions, role)
    typer.echo(f"for OBS, as a browser source: {url}obs#token={sessions.standing_token(Role.VIEW)}")


def _invite(url: str, sessions: Sessions, role: Role) -> None:
    """An address with a token is good for one device; the next one is printed when it was used."""
    address = f"{url}#token={sessions.invitation(role)}"
    if role is Role.CONTROL:
        typer.echo(qr_text(address))
    typer.echo(f"to {role.word}, for one device: {address}")


def _lens_of(scene: Path | None) -> Lens | None:
    if scene is None:
        return None
    from viewfinder.stage.scene_file import read_scene_file

    path = read_scene_file(scene).lens
    return None if path is None else read_lens(path)


def _camera(options: ServeOptions, tracker: Tracker | None) -> Camera | None:
    """Intrinsics: --camera, else those of --pose; None leaves them to the lens."""
    if options.camera is not None:
        return read_fixed_pose(options.camera).camera
    return tracker.camera if isinstance(tracker, FixedPose) else None
