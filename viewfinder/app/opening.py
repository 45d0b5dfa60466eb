"""Opening what a viewfinder is made of: lenses, renderers, the scene or layer, the tracker, and the camera last."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from aiohttp import web

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.choose import BY_NAME, DEFAULT, WITH_BANKS
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard, read_board
from viewfinder.app.lenses import LensBook, MakeRenderer, read_lenses
from viewfinder.app.trackers import open_tracker
from viewfinder.options import ViewfinderOptions
from viewfinder.server.access import Access
from viewfinder.server.site import Part
from viewfinder.sources.browser_camera import BrowserCameraSource
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import ExactSize, FrameSource, SizeLimit
from viewfinder.stage.overlay_source import OverlaySource
from viewfinder.stage.stage import Stage
from viewfinder.stage.stage_setup import LIVE_LAYERING, live_renderer
from viewfinder.stage.static_layer import StaticLayer
from viewfinder.streaming.virtual_webcam import VirtualWebcam
from viewfinder.tracking.phone_tracker import PhoneFrames, PhoneTracker
from viewfinder.tracking.tracker import FixedPose, Tracker, read_fixed_pose


@dataclass(frozen=True)
class Parts:
    """Everything that a viewfinder is made of, opened. options: as the command line gave them.

    overlays: what lies over the camera's picture; it begins with the first of the renderers. intrinsics: of the camera, None takes the
    pinhole of the lens. focus_board: the board whose blur tells the focus. cameras: what else browsers send to, by path. webcam: where
    the pictures go, too.
    """

    options: ViewfinderOptions
    source: FrameSource
    overlays: OverlaySource
    lenses: LensBook
    renderers: Mapping[str, MakeRenderer]
    tracker: Tracker | None = None
    intrinsics: Camera | None = None
    focus_board: CharucoBoard | None = None
    access: Access = field(default_factory=Access)
    cameras: Mapping[str, Part] = field(default_factory=dict)
    webcam: VirtualWebcam | None = None


def open_parts(options: ViewfinderOptions, access: Access, closing: ExitStack) -> Parts:
    """Read all files, then open the camera. closing: gets what has threads; closing a part twice does nothing."""
    lenses, networks = read_lenses(options.lenses, options.scene)
    renderers = renderers_of(options.renderers, options.psf, networks)
    intrinsics = None if options.camera is None else read_fixed_pose(options.camera).camera
    board = options.tracking.board
    focus_board = None if board is None or "board" not in options.focus_from else read_board(board)
    overlays = open_overlays(options, lenses.lens, renderers)
    closing.callback(overlays.close)
    webcam = None if options.webcam is None else VirtualWebcam(options.webcam)
    if webcam is not None:
        closing.callback(webcam.close)
    tracker = open_tracker(options.tracking, options.listening)
    if tracker is not None:
        closing.callback(tracker.close)
    camera = open_source(options.source, SizeLimit(options.width_px), options.fps)
    return Parts(
        options=options,
        source=ExactSize(camera, overlays.sharp.width_px, overlays.sharp.height_px) if isinstance(overlays, StaticLayer) else camera,
        overlays=overlays,
        lenses=lenses,
        renderers=renderers,
        tracker=tracker,
        intrinsics=tracker.camera if intrinsics is None and isinstance(tracker, FixedPose) else intrinsics,
        focus_board=focus_board,
        access=access,
        cameras=browser_cameras(camera, tracker.source if isinstance(tracker, PhoneTracker) else None),
        webcam=webcam,
    )


def open_overlays(options: ViewfinderOptions, lens: Lens, renderers: Mapping[str, MakeRenderer]) -> OverlaySource:
    """Open the scene or the layer of the options with the first renderer."""
    name, make = next(iter(renderers.items()))
    if options.layer is not None:
        from mrbokeh.images.image_io import read_layer

        return StaticLayer(read_layer(options.layer), lens, make(), name)
    assert options.scene is not None, "checked by the command"
    from mrbokeh.scene.choose import scene_renderer

    stage = Stage(options.scene, scene_renderer(options.backend, threads=1))
    stage.set_renderer(name, make())
    return stage


def renderers_of(names: Sequence[str], bank: Path | None, networks: Mapping[str, MakeRenderer]) -> dict[str, MakeRenderer]:
    """Return what the page can switch between, the first of which is used first; bank: measured kernels for those that take them.

    Unknown names, and a bank that none of them takes, raise InputError now and not when the page switches.
    """
    wanted = list(names) or ([*networks, DEFAULT] if networks else [DEFAULT, "scatter"])
    _refuse_unknown(wanted, networks)
    if bank is not None and not set(wanted) & set(WITH_BANKS):
        raise InputError(f"--psf is for --renderer {', '.join(WITH_BANKS)}, got {', '.join(wanted)}: leave --psf out, or name one of them")
    made: dict[str, MakeRenderer] = {}
    for name in wanted:
        if name in networks:
            made[name] = networks[name]
        elif bank is not None and name in WITH_BANKS:
            made[name] = _with_bank(name, bank)
        else:
            made[name] = _plain(name)
    return made


def _refuse_unknown(names: Sequence[str], networks: Mapping[str, MakeRenderer]) -> None:
    for name in names:
        is_file = name.lower().endswith(".onnx")
        if is_file and not Path(name).is_file():
            raise InputError(f"--renderer: expected a network in an .onnx file, got {name}, where there is no such file")
        if not is_file and name not in networks and name not in BY_NAME:
            raise InputError(f"--renderer: expected one of {', '.join([*networks, *BY_NAME])}, or a network (.onnx), got {name!r}")


def _plain(name: str) -> MakeRenderer:
    return lambda: live_renderer(name)


def _with_bank(name: str, bank: Path) -> MakeRenderer:
    from mrbokeh.renderers.choose import chosen_renderer

    return lambda: chosen_renderer(name, bank, threads=1, layering=LIVE_LAYERING)


class SentTo:
    """Part of a site: a browser camera under another path than /whip."""

    def __init__(self, camera: BrowserCameraSource, path: str) -> None:
        self._camera, self._path = camera, path

    def routes(self) -> Sequence[web.AbstractRouteDef]:
        return self._camera.routes(self._path)

    async def close(self) -> None:
        await self._camera.close()


def browser_cameras(source: FrameSource, phone: PhoneFrames | None) -> dict[str, Part]:
    """Return the cameras that browsers send, by their paths: the camera page sends to /whip, a phone beside it to /phone-whip."""
    cameras: dict[str, Part] = {"whip": source} if isinstance(source, BrowserCameraSource) else {}
    if isinstance(phone, BrowserCameraSource):
        if cameras:
            cameras["phone-whip"] = SentTo(phone, "/phone-whip")
        else:
            cameras["whip"] = phone
    return cameras
