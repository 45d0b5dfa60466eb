"""Files cut short in copying: decoders notice most of them, but lossy tiles of a DNG can go missing without a word."""

from pathlib import Path

from capture.photos.metadata import read_tags
from mrbokeh.system.errors import InputError

_BLOCKS = (("TileOffsets", "TileByteCounts"), ("StripOffsets", "StripByteCounts"))


def require_whole_tiff(path: Path) -> None:
    """Raise InputError where a TIFF-like file (DNG and most RAW) speaks of pixels that lie behind its end."""
    if not path.is_file():
        raise InputError(f"expected a photograph at {path}, but there is no such file")
    size, tags = path.stat().st_size, read_tags(path)
    for offsets_name, counts_name in _BLOCKS:
        for key, offsets in tags.items():
            group, _, name = key.rpartition(".")
            if name == offsets_name and (end := _end(offsets, tags.get(f"{group}.{counts_name}", ""))) > size:
                raise InputError(f"{path} is cut short: it has {size} bytes, its pixels reach to {end}. Copy it again")


def _end(offsets: str, counts: str) -> int:
    try:
        return max((int(offset) + int(count) for offset, count in zip(offsets.split(), counts.split(), strict=True)), default=0)
    except ValueError:
        return 0
