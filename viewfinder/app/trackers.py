"""Opening the tracker that the options ask for."""

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import read_board
from viewfinder.options import ListeningOptions, TrackingOptions
from viewfinder.server.endpoint import host_of
from viewfinder.sources.choose import open_source
from viewfinder.sources.frame_source import FrameSource, SizeLimit
from viewfinder.tracking.charuco_tracker import CharucoTracker
from viewfinder.tracking.freed import FreeDReading, read_encoder_table
from viewfinder.tracking.phone_rig import read_phone_rig
from viewfinder.tracking.phone_tracker import PhoneTracker
from viewfinder.tracking.socket_tracker import SocketTracker, TrackingAddress, freed_decoder, opentrackio_decoder
from viewfinder.tracking.tracker import Tracker, read_fixed_pose

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
