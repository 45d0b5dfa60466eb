"""libgphoto2's errors as those of a camera driver."""

from collections.abc import Iterator
from contextlib import contextmanager

from capture.tether.camera_driver import CameraError
from mrbokeh.system.gphoto2_library import explanation, library


@contextmanager
def explained(doing: str) -> Iterator[None]:
    """A block in which libgphoto2's errors become CameraError; `doing` says in words what was tried."""
    gp = library()
    try:
        yield
    except gp.GPhoto2Error as error:
        raise CameraError(f"{doing} failed: {explanation(error)}") from None
