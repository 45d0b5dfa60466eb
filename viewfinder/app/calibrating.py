"""`mrbokeh viewfinder calibrate-phone`: a phone on the hot shoe calibrated, from the options to the file."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from functools import partial
from threading import Event

from aiohttp import web

from mrbokeh.optics.camera import Camera, camera_of_lens
from mrbokeh.renderers.choose import read_lens
from mrbokeh.system.atomic_files import refuse_existing
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say, tell
from mrbokeh.tracking.charuco.board import read_board
from viewfinder.app.opening import browser_cameras, open_phone
from viewfinder.options import CalibrationOptions
from viewfinder.server.access import Access
from viewfinder.server.endpoint import Endpoint, on_stop, open_endpoint, serving_site
from viewfinder.server.site import Part, Site, page_routes
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import SizeLimit
from viewfinder.tracking.charuco_tracker import CharucoTracker
from viewfinder.tracking.phone_rig import PhoneRig, write_phone_rig
from viewfinder.tracking.phone_tracker import Calibration, PhoneTracker
from viewfinder.tracking.tracker import read_fixed_pose


def calibrate(options: CalibrationOptions) -> None:
    """Run until there are enough views, and write the rig; Ctrl-C ends it and writes nothing."""
    out = options.out
    refuse_existing(out, options.overwrite)
    if not out.parent.is_dir():
        raise InputError(f"--out: expected a place in a folder that exists, got {out}: there is no {out.parent}")
    endpoint = open_endpoint(options.listening)
    try:
        with opened(options) as (calibration, cameras):
            rig = asyncio.run(_calibrated(calibration, endpoint, cameras))
    except KeyboardInterrupt:
        rig = None
    if rig is None:
        say("calibration stopped; nothing was written")
        return
    write_phone_rig(out, rig)
    tell(
        f"wrote {out} (for --rig): {rig.pairs} views agree within {rig.residual_deg:.2f} degrees and {rig.residual_mm:.1f} mm",
        pairs=rig.pairs,
    )


@contextmanager
def opened(options: CalibrationOptions) -> Iterator[tuple[Calibration, dict[str, Part]]]:
    """Read all files, then open both cameras; threads end with the block, or where a part fails."""
    if options.phone == options.source != "whip":
        raise InputError(f"--phone and --source are both {options.source}: expected two cameras, the phone's and the one it sits on")
    intrinsics, phone_camera, board = _intrinsics(options), read_fixed_pose(options.phone_camera).camera, read_board(options.board)
    with ExitStack() as closing:
        tracker, of_phone = CharucoTracker(board), CharucoTracker(board)
        for each in (tracker, of_phone):
            closing.callback(each.close)
        source, phone_source = open_source(options.source, SizeLimit(options.width_px)), open_phone(options.phone)
        phone = PhoneTracker(phone_source, of_phone, phone_camera, None)
        closing.callback(phone.close)
        calibration = Calibration(
            source=source,
            tracker=tracker,
            intrinsics=intrinsics,
            phone=phone,
            say=say,
            pairs=options.pairs,
            longest_s=options.seconds,
        )
        yield calibration, browser_cameras(source, phone_source)


class CameraSite(Site):
    """Site of the page with which browsers lend their cameras, and nothing else."""

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


async def _calibrated(calibration: Calibration, endpoint: Endpoint, cameras: dict[str, Part]) -> PhoneRig | None:
    """Return the rig, None if it was stopped."""
    stopping = Event()
    on_stop(stopping.set)
    async with AsyncExitStack() as closing:
        if cameras:
            url = await closing.enter_async_context(
                serving_site(CameraSite(endpoint.access, cameras), endpoint.host, endpoint.options.port, endpoint.tls)
            )
            endpoint.announce_camera(url)
        say("show the board to the camera and the phone, and hold still at each view (Ctrl-C stops it)")
        try:
            rig = await asyncio.to_thread(calibration.run, stopping)
        except InputError:
            if stopping.is_set():
                return None
            raise
    return None if stopping.is_set() else rig


def _intrinsics(options: CalibrationOptions) -> Callable[[int, int], Camera]:
    if (options.camera is None) == (options.lens is None):
        raise InputError("expected the camera's intrinsics from either --camera CAMERA.json or --lens LENS: give one of them")
    if options.camera is not None:
        return read_fixed_pose(options.camera).camera.resized
    assert options.lens is not None, "one of them"
    return partial(camera_of_lens, read_lens(options.lens))
