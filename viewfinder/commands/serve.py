"""`mrbokeh viewfinder`: the running viewfinder, from its options to the address of its page."""

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import typer

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.tracking.charuco.board import CharucoBoard, read_board
from viewfinder.app.assembly import open_scenery, read_lenses, renderers_of
from viewfinder.app.running import Parts, Viewfinder, running
from viewfinder.app.tracking_choice import open_tracker
from viewfinder.commands.browser_cameras import CAMERA_PAGE, browser_cameras
from viewfinder.commands.listening import Door, on_stop, open_door
from viewfinder.commands.serve_options import ServeOptions, refuse_contradictions
from viewfinder.server.access import Access
from viewfinder.server.endpoint import serving_site
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import ExactSize
from viewfinder.stage.static_layer import StillLayer
from viewfinder.streaming.virtual_webcam import VirtualWebcam
from viewfinder.tracking.phone_tracker import PhoneTracker
from viewfinder.tracking.tracker import FixedPose, Tracker, read_fixed_pose


@contextmanager
def opened(options: ServeOptions, access: Access) -> Iterator[Viewfinder]:
    """Reads all files, opens the camera last, and runs everything but the server; threads end with the block, or where a part fails."""
    refuse_contradictions(options)
    with ExitStack() as closing:
        viewfinder = closing.enter_context(running(_parts(options, access, closing)))
        yield viewfinder


def _parts(options: ServeOptions, access: Access, closing: ExitStack) -> Parts:
    """closing: gets what has threads, until all is there; closing a part twice does nothing."""
    lenses, networks = read_lenses(options.lenses, _lens_of(options.scene))
    renderers = renderers_of(options.renderers, options.psf, networks)
    intrinsics = None if options.camera is None else read_fixed_pose(options.camera).camera
    focus_board = _focus_board(options)
    scenery = open_scenery(options.scene, options.layer, lambda: lenses.lens, renderers, options.backend)
    closing.callback(scenery.close)
    webcam = None if options.webcam is None else VirtualWebcam(options.webcam)
    if webcam is not None:
        closing.callback(webcam.close)
    tracker = open_tracker(options.tracking)
    if tracker is not None:
        closing.callback(tracker.close)
    camera = open_source(options.source, options.width_px, None, options.fps)
    cameras = browser_cameras(camera, tracker.source if isinstance(tracker, PhoneTracker) else None)
    source = ExactSize(camera, scenery.sharp.width_px, scenery.sharp.height_px) if isinstance(scenery, StillLayer) else camera
    return Parts(
        source,
        scenery,
        lenses,
        renderers,
        options.captures,
        tracker,
        intrinsics or _of_pose(tracker),
        options.scene,
        options.smoothing,
        access,
        options.focus_from,
        focus_board,
        cameras,
        webcam,
    )


def serve(options: ServeOptions) -> None:
    """Runs until Ctrl-C."""
    try:
        refuse_contradictions(options)
        door = open_door(options.listening)
        with opened(options, door.access) as viewfinder:
            asyncio.run(_served(viewfinder, door))
    except KeyboardInterrupt:
        # While it was starting; everything that was open is closed.
        pass
    typer.echo("viewfinder stopped")


async def _served(viewfinder: Viewfinder, door: Door) -> None:
    stopped = asyncio.Event()
    on_stop(stopped.set)
    async with serving_site(viewfinder.site, door.host, door.port, door.tls) as url:
        door.announce(f"viewfinder of {viewfinder.pipeline.source.name}", url)
        if viewfinder.webcam is not None:
            typer.echo(f"also a webcam for other programs: {viewfinder.webcam.name}")
        if "whip" in viewfinder.site.parts:
            door.announce_camera(url, CAMERA_PAGE)
        await stopped.wait()


def _lens_of(scene: Path | None) -> Lens | None:
    if scene is None:
        return None
    from mrbokeh.scene.staging.scene_file import read_scene_file

    path = read_scene_file(scene).lens
    return None if path is None else read_lens(path)


def _focus_board(options: ServeOptions) -> CharucoBoard | None:
    board = options.tracking.board
    return None if board is None or "board" not in options.focus_from else read_board(board)


def _of_pose(tracker: Tracker | None) -> Camera | None:
    """The intrinsics beside a fixed pose; None leaves them to the lens."""
    return tracker.camera if isinstance(tracker, FixedPose) else None
