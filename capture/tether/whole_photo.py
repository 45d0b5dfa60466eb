"""Whether a photograph that is still being written is whole: as its format tells, not by hope."""

from pathlib import Path

from capture.photos.raw import RAW_SUFFIXES
from capture.photos.whole_file import require_whole_tiff
from mrbokeh.system.errors import InputError

_LAST_BYTES = 64
_ENDS = {".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9", ".png": b"IEND\xaeB`\x82"}


def is_whole(path: Path) -> bool:
    """JPEG and PNG have an end mark; TIFF and most RAW say where their pixels are. Other formats count as whole unless empty."""
    try:
        size = path.stat().st_size
        if size == 0:
            return False
        end = _ENDS.get(path.suffix.lower())
        if end is not None:
            with path.open("rb") as file:
                file.seek(max(0, size - _LAST_BYTES))
                return end in file.read()
        if path.suffix.lower() in (*RAW_SUFFIXES, ".tif", ".tiff"):
            require_whole_tiff(path)
    except (InputError, OSError):
        return False
    return True
