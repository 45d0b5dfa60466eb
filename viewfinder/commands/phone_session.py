"""The calibration of a phone on the hot shoe, from the options to the file: its cameras opened, browsers let in, and all closed again."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import typer
from aiohttp import web

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.system.atomic_files import refuse_existing
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import read_board
from viewfinder.app.tracking_choice import open_phone
from viewfinder.commands.browser_cameras import CAMERA_PAGE, browser_cameras
from viewfinder.commands.listening import Door, ListeningOptions, on_stop, open_door
from viewfinder.server.access import Access
from viewfinder.server.endpoint import serving_site
from viewfinder.server.site import Part, Site, page_routes
from viewfinder.sources.choose import open_source
from viewfinder.tracking.charuco_tracker import CharucoTracker
from viewfinder.tracking.phone_calibration import Calibration
from viewfinder.tracking.phone_rig import PhoneRig, write_phone_rig
from viewfinder.tracking.phone_tracker import PhoneTracker
from viewfinder.tracking.tracker import read_fixed_pose


@dataclass(frozen=True)
class PhoneSession:
    """As on the command line (viewfinder/commands/calibrate_phone.py)."""

    source: str
    phone: str
    phone_camera: Path
    board: Path
    camera: Path | None
    lens: Path | None
    pairs: int
    seconds: float
    width_px: int | None
    listening: ListeningOptions


class CameraSite(Site):
    """The page with which browsers lend their cameras, and nothing else."""

    def __init__(self, access: Access, cameras: dict[str, Part]) -> None:
        self.access, self.parts = access, cameras

    def application(self) -> web.Application:
        app = web.Application(middlewares=[self.access.middleware])
        app.add_routes([*page_routes(), web.post("/enter", self.access.enter)])
        for part in self.parts.values():
            app.add_routes(part.routes())
        app.on_shutdown.append(self._leave)
        return app

    async def _leave(self, _app: web.Application) -> None:
        for part in self.parts.values():
            await part.close()


def calibrate(session: PhoneSession, out: Path, overwrite: bool) -> None:
    """Runs until there are enough views; Ctrl-C ends it and writes nothing."""
    refuse_existing(out, overwrite)
    if not out.parent.is_dir():
        raise InputError(f"--out: expected a place in a folder that exists, got {out}: there is no {out.parent}")
    door = open_door(session.listening)
    try:
        with opened(session) as (calibration, cameras):
            rig = asyncio.run(_calibrated(calibration, door, cameras))
    except KeyboardInterrupt:
        rig = None
    if rig is None:
        typer.echo("calibration stopped; nothing was written")
        return
    write_phone_rig(out, rig)
    typer.echo(f"wrote {out} (for --rig): {rig.pairs} views agree within {rig.residual_deg:.2f} degrees and {rig.residual_mm:.1f} mm")


@contextmanager
def opened(session: PhoneSession) -> Iterator[tuple[Calibration, dict[str, Part]]]:
    """Reads all files, then opens both cameras; threads end with the block, or where a part fails."""
    if session.phone == session.source != "whip":
        raise InputError(f"--phone and --source are both {session.source}: expected two cameras, the phone's and the one it sits on")
    intrinsics, phone_camera, board = _intrinsics(session), read_fixed_pose(session.phone_camera).camera, read_board(session.board)
    with ExitStack() as closing:
        tracker, of_phone = CharucoTracker(board), CharucoTracker(board)
        for each in (tracker, of_phone):
            closing.callback(each.close)
        source, phone_source = open_source(session.source, session.width_px), open_phone(session.phone)
        phone = PhoneTracker(phone_source, of_phone, phone_camera, None)
        closing.callback(phone.close)
        calibration = Calibration(source, tracker, intrinsics, phone, typer.echo, session.pairs, session.seconds)
        yield calibration, browser_cameras(source, phone_source)


async def _calibrated(calibration: Calibration, door: Door, cameras: dict[str, Part]) -> PhoneRig | None:
    """None where it was stopped."""
    stopping = Event()
    on_stop(stopping.set)
    async with AsyncExitStack() as closing:
        if cameras:
            url = await closing.enter_async_context(serving_site(CameraSite(door.access, cameras), door.host, door.port, door.tls))
            door.announce_camera(url, CAMERA_PAGE)
        typer.echo("show the board to the camera and the phone, and hold still at each view (Ctrl-C stops it)")
        try:
            rig = await asyncio.to_thread(calibration.run, stopping)
        except InputError:
            if stopping.is_set():
                return None
            raise
    return None if stopping.is_set() else rig


def _intrinsics(session: PhoneSession) -> Callable[[int, int], Camera]:
    if (session.camera is None) == (session.lens is None):
        raise InputError("expected the camera's intrinsics from either --camera CAMERA.json or --lens LENS.json: give one of them")
    if session.camera is not None:
        return read_fixed_pose(session.camera).camera.resized
    assert session.lens is not None, "one of them"
    return _pinhole(read_lens(session.lens))


def _pinhole(lens: Lens) -> Callable[[int, int], Camera]:
    def camera(width_px: int, height_px: int) -> Camera:
        return Camera(width_px, height_px, (lens.focal_px(width_px),) * 2, (width_px / 2, height_px / 2))

    return camera
