"""Opening what a viewfinder is made of: lenses, renderers, the scene or layer, the tracker that the options ask for, and the camera last.

LensBook keeps the lenses that the page can switch between, and the chosen one as it is set now.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from aiohttp import web

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import BY_NAME, DEFAULT, WITH_BANKS, is_bank, lens_and_renderer, read_lens, spreads_light
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard, read_board
from viewfinder.frames import LensState
from viewfinder.options import ListeningOptions, TrackingOptions, ViewfinderOptions
from viewfinder.server.access import Access
from viewfinder.server.endpoint import host_of
from viewfinder.server.site import Part
from viewfinder.sources.browser_camera import BrowserCameraSource
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import ExactSize, FrameSource, SizeLimit
from viewfinder.stage.overlay_source import OverlaySource, StaticLayer
from viewfinder.stage.stage import Stage
from viewfinder.stage.stage_setup import LIVE_LAYERING, live_renderer
from viewfinder.streaming.other_programs import VirtualWebcam
from viewfinder.tracking.charuco_tracker import CharucoTracker
from viewfinder.tracking.freed import FreeDReading, read_encoder_table
from viewfinder.tracking.phone_rig import read_phone_rig
from viewfinder.tracking.phone_tracker import PhoneFrames, PhoneTracker
from viewfinder.tracking.socket_tracker import SocketTracker, TrackingAddress, freed_decoder, opentrackio_decoder
from viewfinder.tracking.tracker import FixedPose, Tracker, read_fixed_pose

# Corners are found to a part of a pixel, so that more than this costs time and tells little.
_PHONE_WIDTH_PX = 1280
# A phone's pictures come over a network and are tracked before they count: its newest pose may be a few frames old.
_PHONE_HOLD_S = 0.25
_MS_PER_S = 1000.0


def open_tracker(options: TrackingOptions, listening: ListeningOptions) -> Tracker | None:
    """Open the tracker that the options ask for, None if they ask for none; InputError where a file is not what it should be.

    listening: tells the address at which packets of a tracking system are waited for.
    """
    if not options.ways:
        return None
    (way,) = options.ways
    if way in ("opentrackio", "freed"):
        tracker: Tracker = _by_packets(options, host_of(listening))
    else:
        tracker = {"board": _board, "pose": _pose, "map": _map, "phone": _phone}[way](options)
    if isinstance(tracker, SocketTracker | PhoneTracker):
        tracker.video_delay_s = options.delay_ms / _MS_PER_S
    return tracker


def open_phone(source: str) -> FrameSource:
    """Open the camera of the phone, in the words of --source."""
    try:
        return open_source(source, SizeLimit(_PHONE_WIDTH_PX))
    except InputError as error:
        raise InputError(str(error).replace("--source", "--phone", 1)) from None


def _board(options: TrackingOptions) -> Tracker:
    assert options.board is not None, "chosen"
    return CharucoTracker(read_board(options.board))


def _phone(options: TrackingOptions) -> Tracker:
    """Read all files, then open the phone's camera."""
    phone = options.phone
    assert phone is not None, "chosen"
    camera, rig = read_fixed_pose(phone.camera).camera, read_phone_rig(phone.rig)
    by_board = _board(options)
    try:
        return PhoneTracker(source=open_phone(phone.source), phone_tracker=by_board, phone_intrinsics=camera, rig=rig, hold_s=_PHONE_HOLD_S)
    except BaseException:
        by_board.close()
        raise


def _pose(options: TrackingOptions) -> Tracker:
    assert options.pose is not None, "chosen"
    return read_fixed_pose(options.pose)


def _map(options: TrackingOptions) -> Tracker:
    from viewfinder.tracking.map_tracker import MapLocaliser, MapTracker
    from viewfinder.tracking.sparse_map import read_sparse_map

    assert options.map is not None, "chosen"
    # The tracker gives the intrinsics of each frame before it is looked at.
    nominal = Camera(640, 360, (640.0, 640.0), (320.0, 180.0))
    return MapTracker(MapLocaliser(read_sparse_map(options.map, options.metres_per_unit), nominal))


def _by_packets(options: TrackingOptions, host: str) -> Tracker:
    if options.opentrackio is not None:
        return SocketTracker(TrackingAddress(options.opentrackio, host=host), opentrackio_decoder())
    assert options.freed is not None, "chosen"
    reading = FreeDReading() if options.lens_table is None else FreeDReading(table=read_encoder_table(options.lens_table))
    return SocketTracker(TrackingAddress(options.freed, host=host), freed_decoder(reading))


F_NUMBERS = (0.95, 1.2, 1.4, 1.8, 2.0, 2.4, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)
_CLOSEST_FOCAL_LENGTHS = 1.5
_SLIDER_FOCAL_LENGTHS = 6.0

MakeRenderer = Callable[[], Renderer]


class LensBook:
    """Lenses by name, in the order in which the page shows them. One thread chooses, another asks."""

    def __init__(self, lenses: Mapping[str, Lens]) -> None:
        self._lenses = dict(lenses)
        self.chosen = next(iter(self._lenses))

    @property
    def names(self) -> list[str]:
        return list(self._lenses)

    @property
    def lens(self) -> Lens:
        """Chosen lens as its file has it."""
        return self._lenses[self.chosen]

    def choose(self, name: str) -> None:
        if name not in self._lenses:
            raise InputError(f"expected one of the lenses {', '.join(self._lenses)}, got {name!r}")
        self.chosen = name

    @property
    def closest_m(self) -> float:
        """Closest focus: nearer, a thin lens of that focal length would need more than three times its extension."""
        return _CLOSEST_FOCAL_LENGTHS * self.lens.focal_length_mm / MM_PER_M

    @property
    def slider_dioptres(self) -> tuple[float, float]:
        """Ends of the focus slider: infinity, and 1/5 of life size, where lenses that are not for macro end; a tap may go nearer."""
        return 0.0, MM_PER_M / (_SLIDER_FOCAL_LENGTHS * self.lens.focal_length_mm)

    @property
    def f_numbers(self) -> list[float]:
        """F-numbers that the page offers: the lens's own and the full stops that are smaller openings."""
        return sorted({self.lens.f_number, *(each for each in F_NUMBERS if each > self.lens.f_number)})

    def as_set(self, state: LensState) -> Lens:
        """Return the chosen lens with what is known of it now; a focus that it cannot reach becomes its closest."""
        lens = self.lens
        focus_m = lens.focus_distance_m if state.focus_distance_m is None else max(state.focus_distance_m, self.closest_m)
        told = {"f_number": state.f_number, "focal_length_mm": state.focal_length_mm}
        facts = {name: value for name, value in told.items() if value}
        if lens.widest_f_number is not None and "f_number" in facts:
            facts["f_number"] = max(facts["f_number"], lens.widest_f_number, lens.f_number)
        return lens.stating({"focus_distance_m": float(focus_m), **facts})


def read_lenses(paths: Sequence[Path], scene: Path | None) -> tuple[LensBook, dict[str, MakeRenderer]]:
    """Read lenses by the names of their files, or that of the scene file; (lenses, the renderers of networks and banks among them)."""
    lenses: dict[str, Lens] = {}
    brought: dict[str, MakeRenderer] = {}
    lens_of_scene = None if scene is None else _lens_of_scene(scene)
    for path in paths:
        name = path.name if is_bank(path) else path.stem
        lenses[name] = read_lens(path)
        if spreads_light(path):
            brought[name] = partial(_same, lens_and_renderer(path, None, threads=1, layering=LIVE_LAYERING)[1])
    if not lenses and lens_of_scene is not None:
        lenses["scene"] = lens_of_scene
    if not lenses:
        raise InputError("expected a lens, got none: give --lens LENS.json (see `mrbokeh lens new`), or name one in the scene file")
    return LensBook(lenses), brought


def _lens_of_scene(scene: Path) -> Lens | None:
    from mrbokeh.scene.staging.scene_file import read_scene_file

    path = read_scene_file(scene).lens
    return None if path is None else read_lens(path)


def _same(renderer: Renderer) -> Renderer:
    return renderer


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
    lenses, brought = read_lenses(options.lenses, options.scene)
    renderers = renderers_of(options.renderers, options.lenses, brought)
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


def renderers_of(names: Sequence[str], lenses: Sequence[Path], brought: Mapping[str, MakeRenderer]) -> dict[str, MakeRenderer]:
    """Return what the page can switch between, the first of which is used first. brought: the renderers of networks and banks.

    Where the only lens is a bank, a name that takes one spreads its kernels. Unknown names, and a bank that none of them takes, raise
    InputError now and not when the page switches.
    """
    wanted = list(names) or ([*brought, DEFAULT] if brought else [DEFAULT, "scatter"])
    _refuse_unknown(wanted, brought)
    bank = lenses[0] if names and len(lenses) == 1 and is_bank(lenses[0]) else None
    if bank is not None and not set(wanted) & {*WITH_BANKS, *brought}:
        raise InputError(f"the bank {bank} is for --renderer {', '.join(WITH_BANKS)}, got {', '.join(wanted)}: name one of them")
    return {name: brought.get(name) or _live(name, bank if name in WITH_BANKS else None) for name in wanted}


def _refuse_unknown(names: Sequence[str], brought: Mapping[str, MakeRenderer]) -> None:
    for name in names:
        is_file = name.lower().endswith(".onnx")
        if is_file and not Path(name).is_file():
            raise InputError(f"--renderer: expected a network in an .onnx file, got {name}, where there is no such file")
        if not is_file and name not in brought and name not in BY_NAME and not is_bank(name):
            raise InputError(f"--renderer: expected one of {', '.join([*brought, *BY_NAME])}, or a network (.onnx), got {name!r}")


def _live(name: str, bank: Path | None) -> MakeRenderer:
    return lambda: live_renderer(name) if bank is None else lens_and_renderer(bank, name, threads=1, layering=LIVE_LAYERING)[1]


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
