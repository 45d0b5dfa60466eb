"""From what the command line says to the tracker of the camera."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import FrameSource
from viewfinder.tracking.phone_tracker import PhoneTracker
from viewfinder.tracking.socket_tracker import SocketTracker, TrackingAddress
from viewfinder.tracking.tracker import Tracker

# Corners are found to a part of a pixel, so that more than this costs time and tells little.
_PHONE_WIDTH_PX = 1280
# A phone's pictures come over a network and are tracked before they count: its newest pose may be a few frames old.
_PHONE_HOLD_S = 0.25
_MS_PER_S = 1000.0


@dataclass(frozen=True)
class PhoneChoice:
    """A phone on the hot shoe. source: in the words of --source. camera: its intrinsics. rig: of `mrbokeh viewfinder calibrate-phone`."""

    source: str
    camera: Path
    rig: Path


@dataclass(frozen=True)
class TrackingChoice:
    """At most one of them, but that a phone needs the board. opentrackio, freed: UDP ports; lens_table: of FreeD's encoders. host: the
    address at which packets are waited for. metres_per_unit: of a map without a scale. delay_ms: how much later the camera's picture
    comes than a pose of the same moment, of a phone or a tracking system.
    """

    board: Path | None = None
    pose: Path | None = None
    map: Path | None = None
    metres_per_unit: float | None = None
    opentrackio: int | None = None
    freed: int | None = None
    lens_table: Path | None = None
    host: str = "127.0.0.1"
    phone: PhoneChoice | None = None
    delay_ms: float = 0.0

    @property
    def ways(self) -> list[str]:
        """Which of them were chosen; a phone's board is part of the phone."""
        return [name for name in _TRACKERS if getattr(self, name) is not None and not (name == "board" and self.phone is not None)]


def open_tracker(choice: TrackingChoice) -> Tracker | None:
    """None where nothing was asked for. Raises InputError where several were, or a file is not what it should be."""
    chosen = choice.ways
    if len(chosen) > 1:
        raise InputError(f"expected one way to track the camera, got --{' and --'.join(chosen)}: give one of them")
    if not chosen:
        return None
    tracker = _TRACKERS[chosen[0]](choice)
    if isinstance(tracker, SocketTracker | PhoneTracker):
        tracker.video_delay_s = choice.delay_ms / _MS_PER_S
    return tracker


def open_phone(source: str, max_width_px: int | None = _PHONE_WIDTH_PX) -> FrameSource:
    """The camera of the phone, in the words of --source."""
    try:
        return open_source(source, max_width_px)
    except InputError as error:
        raise InputError(str(error).replace("--source", "--phone", 1)) from None


def _board(choice: TrackingChoice) -> Tracker:
    from mrbokeh.tracking.charuco.board import read_board
    from viewfinder.tracking.charuco_tracker import CharucoTracker

    assert choice.board is not None, "chosen"
    return CharucoTracker(read_board(choice.board))


def _phone(choice: TrackingChoice) -> Tracker:
    """All files are read before the phone's camera is opened."""
    from viewfinder.tracking.phone_rig import read_phone_rig
    from viewfinder.tracking.tracker import read_fixed_pose

    phone = choice.phone
    assert phone is not None, "chosen"
    if choice.board is None:
        raise InputError("--phone needs --board BOARD.json, the board that the phone sees")
    camera, rig = read_fixed_pose(phone.camera).camera, read_phone_rig(phone.rig)
    by_board = _board(choice)
    try:
        return PhoneTracker(open_phone(phone.source), by_board, camera, rig, _PHONE_HOLD_S)
    except BaseException:
        by_board.close()
        raise


def _pose(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.tracker import read_fixed_pose

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
    from viewfinder.tracking.socket_tracker import opentrackio_decoder

    assert choice.opentrackio is not None, "chosen"
    return SocketTracker(TrackingAddress(choice.opentrackio, host=choice.host), opentrackio_decoder())


def _freed(choice: TrackingChoice) -> Tracker:
    from viewfinder.tracking.freed import FreeDReading, read_encoder_table
    from viewfinder.tracking.socket_tracker import freed_decoder

    assert choice.freed is not None, "chosen"
    reading = FreeDReading() if choice.lens_table is None else FreeDReading(table=read_encoder_table(choice.lens_table))
    return SocketTracker(TrackingAddress(choice.freed, host=choice.host), freed_decoder(reading))


_TRACKERS: dict[str, Callable[[TrackingChoice], Tracker]] = {
    "board": _board,
    "pose": _pose,
    "map": _map,
    "opentrackio": _opentrackio,
    "freed": _freed,
    "phone": _phone,
}
