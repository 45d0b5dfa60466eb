"""From what the command line says to the parts of a viewfinder."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.lens import Lens
from mrbokeh.lens_file import read_lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import DEFAULT, WITH_BANKS
from viewfinder.focus.base import FocusSource
from viewfinder.focus.first_known import FirstKnown
from viewfinder.focus.frame_focus import FrameFocus
from viewfinder.focus.manual_focus import ManualFocus
from viewfinder.focus.tracked_lens_focus import TrackedLensFocus
from viewfinder.lens_book import LensBook
from viewfinder.scenery import Scenery
from viewfinder.stage.stage import Stage
from viewfinder.stage.stage_setup import LIVE_LAYERING, live_renderer
from viewfinder.still_layer import StillLayer
from viewfinder.tracking.base import Tracker
from viewfinder.tracking.tracking_socket import SocketTracker, TrackingAddress

MakeRenderer = Callable[[], Renderer]


@dataclass(frozen=True)
class TrackingChoice:
    """At most one of them. opentrackio, freed: UDP ports; lens_table: of FreeD's encoders. host: the
    address at which packets are waited for. metres_per_unit: of a map without a scale."""

    board: Path | None = None
    pose: Path | None = None
    map: Path | None = None
    metres_per_unit: float | None = None
    opentrackio: int | None = None
    freed: int | None = None
    lens_table: Path | None = None
    host: str = "127.0.0.1"


def open_tracker(choice: TrackingChoice) -> Tracker | None:
    """None where nothing was asked for. Raises InputError where several were, or a file is not what it should be."""
    chosen = [name for name in ("board", "pose", "map", "opentrackio", "freed") if getattr(choice, name) is not None]
    if len(chosen) > 1:
        raise InputError(f"expected one way to track the camera, got --{' and --'.join(chosen)}: give one of them")
    if choice.lens_table is not None and chosen != ["freed"]:
        raise InputError("--lens-table is for the encoders of --freed: leave it out")
    return _TRACKERS[chosen[0]](choice) if chosen else None


def _board(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.board_file import read_board
    from viewfinder.tracking.charuco_tracker import CharucoTracker

    assert choice.board is not None, "chosen"
    return CharucoTracker(read_board(choice.board))


def _pose(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.fixed_pose import read_fixed_pose

    assert choice.pose is not None, "chosen"
    return read_fixed_pose(choice.pose)


def _map(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.map_localiser import MapLocaliser
    from viewfinder.tracking.map_tracker import MapTracker
    from viewfinder.tracking.sparse_map import read_sparse_map

    assert choice.map is not None, "chosen"
    # The tracker gives the intrinsics of each frame before it is looked at.
    nominal = Camera(640, 360, (640.0, 640.0), (320.0, 180.0))
    return MapTracker(MapLocaliser(read_sparse_map(choice.map, choice.metres_per_unit), nominal))


def _opentrackio(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.tracking_socket import opentrackio_decoder

    assert choice.opentrackio is not None, "chosen"
    return SocketTracker(TrackingAddress(choice.opentrackio, host=choice.host), opentrackio_decoder())


def _freed(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.encoder_table import read_encoder_table
    from viewfinder.tracking.freed import FreeDReading
    from viewfinder.tracking.tracking_socket import freed_decoder

    assert choice.freed is not None, "chosen"
    reading = FreeDReading() if choice.lens_table is None else FreeDReading(table=read_encoder_table(choice.lens_table))
    return SocketTracker(TrackingAddress(choice.freed, host=choice.host), freed_decoder(reading))


_TRACKERS: dict[str, Callable[[TrackingChoice], Tracker]] = {
    "board": _board,
    "pose": _pose,
    "map": _map,
    "opentrackio": _opentrackio,
    "freed": _freed,
}


def open_focus(manual: ManualFocus, tracker: Tracker | None) -> FocusSource:
    """By hand before all others, then the tracking system, then what comes with the frame."""
    tracked = [TrackedLensFocus(tracker)] if isinstance(tracker, SocketTracker) else []
    return FirstKnown([manual, *tracked, FrameFocus()])


def read_lenses(paths: Sequence[Path], of_scene: Lens | None) -> tuple[LensBook, dict[str, MakeRenderer]]:
    """(lenses by the names of their files, the networks among them as renderers). A network (.onnx) brings its lens."""
    lenses: dict[str, Lens] = {}
    networks: dict[str, MakeRenderer] = {}
    for path in paths:
        if path.suffix.lower() == ".onnx":
            from mrbokeh.renderers.onnx_network import OnnxNetwork

            network = OnnxNetwork(path)
            lenses[path.stem], networks[path.stem] = network.lens, partial(_same, network)
        else:
            lenses[path.stem] = read_lens(path)
    if not lenses and of_scene is not None:
        lenses["scene"] = of_scene
    if not lenses:
        raise InputError("expected a lens, got none: give --lens LENS.json (see `mrbokeh lens new`), or name one in the scene file")
    return LensBook(lenses), networks


def _same(renderer: Renderer) -> Renderer:
    return renderer


def renderers_of(names: Sequence[str], bank: Path | None, networks: dict[str, MakeRenderer]) -> dict[str, MakeRenderer]:
    """What the page can switch between, the first is used first; bank: of measured kernels, for the renderers that take one."""
    wanted = list(names) or ([*networks, DEFAULT] if networks else [DEFAULT, "scatter"])
    made: dict[str, MakeRenderer] = {}
    for name in wanted:
        if name in networks:
            made[name] = networks[name]
        elif bank is not None and name in WITH_BANKS:
            made[name] = _with_bank(name, bank)
        else:
            made[name] = _plain(name)
    return made


def _plain(name: str) -> MakeRenderer:
    return lambda: live_renderer(name)


def _with_bank(name: str, bank: Path) -> MakeRenderer:
    from mrbokeh.renderers.choose_bank import chosen_renderer

    return lambda: chosen_renderer(name, bank, threads=1, layering=LIVE_LAYERING)


def open_scenery(
    scene: Path | None, layer: Path | None, lens_of: Callable[[], Lens], renderers: dict[str, MakeRenderer], backend: str = "auto"
) -> Scenery:
    """Exactly one of scene and layer. The first renderer is used first. backend: what draws the scene (mrbokeh.scene.choose)."""
    name, make = next(iter(renderers.items()))
    if layer is not None:
        from mrbokeh.image_io import read_layer

        return StillLayer(read_layer(layer), lens_of(), make(), name)
    assert scene is not None, "checked by the command"
    from mrbokeh.scene.choose import scene_renderer

    stage = Stage(scene, scene_renderer(backend, threads=1))
    stage.set_renderer(name, make())
    return stage
