"""Shooting data of photographs: through pyexiv2, then exiftool and exifread for what is still open; and files cut short in copying."""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path

from capture.photos.focus_metadata import Tags, number, read_focus
from capture.photos.metadata_readers import read_tags_with_exifread, read_with_exiftool
from capture.photos.photo_metadata import PhotoMetadata, parse_time
from capture.photos.sensor_metadata import read_sensor, stated_size_px
from mrbokeh.system.errors import InputError

_NO_MESSAGES = 4
_BLOCKS = (("TileOffsets", "TileByteCounts"), ("StripOffsets", "StripByteCounts"))


def read_metadata(path: Path) -> PhotoMetadata:
    """Return the shooting data of a photograph; all None where the file has none or cannot be read."""
    return read_metadata_of([path])[0]


def read_metadata_of(paths: Sequence[Path], advance: Callable[[], None] = lambda: None) -> list[PhotoMetadata]:
    """Return the shooting data of photographs; `advance` is called after each."""
    found = []
    for path in paths:
        found.append(metadata_from_tags(read_tags(path)))
        advance()
    gaps = [index for index, metadata in enumerate(found) if _has_gaps(metadata)]
    for index, more in zip(gaps, read_with_exiftool([paths[index] for index in gaps]), strict=True):
        found[index] = found[index].filled_from(more)
        if _has_gaps(found[index]):
            found[index] = found[index].filled_from(metadata_from_tags(read_tags_with_exifread(paths[index])))
    return found


def read_tags(path: Path) -> dict[str, str]:
    """Return EXIF, maker note and XMP tags by exiv2's names, with "mime_type", "width_px" and "height_px"; empty if unreadable."""
    try:
        import pyexiv2
    except ImportError:
        return {}
    pyexiv2.set_log_level(_NO_MESSAGES)
    try:
        with pyexiv2.Image(str(path)) as image:
            exif, xmp = image.read_exif("ISO-8859-1"), image.read_xmp("ISO-8859-1")
            size = {"width_px": str(image.get_pixel_width()), "height_px": str(image.get_pixel_height())}
            texts = {key: value for key, value in (exif | xmp).items() if isinstance(value, str)}
            return texts | size | {"mime_type": image.get_mime_type()}
    except (RuntimeError, UnicodeError):
        return {}


def metadata_from_tags(tags: Tags) -> PhotoMetadata:
    """Return shooting data from exiv2's tags."""
    focal_length_mm = _focal_length_mm(tags)
    width_px, height_px = number(tags.get("width_px")), number(tags.get("height_px"))
    size_px = (int(width_px), int(height_px)) if width_px and height_px else None
    orientation = number(tags.get("Exif.Image.Orientation"))
    return PhotoMetadata(
        focal_length_mm=focal_length_mm,
        f_number=_first_positive(tags, "Exif.Photo.FNumber", "Exif.Image.FNumber") or _from_apex(tags, "Exif.Photo.ApertureValue", 0.5),
        exposure_time_s=_first_positive(tags, "Exif.Photo.ExposureTime", "Exif.Image.ExposureTime")
        or _from_apex(tags, "Exif.Photo.ShutterSpeedValue", -1.0),
        iso=_iso(tags),
        taken_at=_taken_at(tags),
        camera_model=_text(tags, "Exif.Image.Model", "Exif.Image.UniqueCameraModel"),
        lens_model=_text(tags, "Exif.Photo.LensModel", "Exif.Canon.LensModel", "Xmp.aux.Lens"),
        focus=read_focus(tags),
        sensor=read_sensor(tags, focal_length_mm, size_px),
        orientation=int(orientation) if orientation else None,
        taken_size_px=stated_size_px(tags),
    )


def require_whole_tiff(path: Path) -> None:
    """Raise InputError if a TIFF-like file (DNG and most RAW) speaks of pixels that lie behind its end.

    Decoders notice most files cut short, but lossy tiles of a DNG can go missing without a word.
    """
    if not path.is_file():
        raise InputError(f"expected a photograph at {path}, but there is no such file")
    size, tags = path.stat().st_size, read_tags(path)
    for offsets_name, counts_name in _BLOCKS:
        for key, offsets in tags.items():
            group, _, name = key.rpartition(".")
            if name == offsets_name and (end := _end(offsets, tags.get(f"{group}.{counts_name}", ""))) > size:
                raise InputError(f"{path} is cut short: it has {size} bytes, its pixels reach to {end}. Copy it again")


def _has_gaps(metadata: PhotoMetadata) -> bool:
    return None in (metadata.focal_length_mm, metadata.f_number, metadata.focus, metadata.exposure_time_s)


def _first_positive(tags: Tags, *names: str) -> float | None:
    values = (number(tags.get(name)) for name in names)
    return next((value for value in values if value is not None and value > 0), None)


def _from_apex(tags: Tags, name: str, power: float) -> float | None:
    """Convert an APEX value, which is a logarithm: f-number = 2^(Av / 2), exposure time = 2^-Tv."""
    value = number(tags.get(name))
    return None if value is None else 2.0 ** (value * power)


def _focal_length_mm(tags: Tags) -> float | None:
    """Read EXIF; else Canon's maker note, which counts in units that CanonCs.Lens (longest, shortest, units per mm) explains."""
    stated = _first_positive(tags, "Exif.Photo.FocalLength", "Exif.Image.FocalLength")
    canon, lens = tags.get("Exif.Canon.FocalLength", "").split(), tags.get("Exif.CanonCs.Lens", "").split()
    if stated or len(canon) < 2 or len(lens) != 3:
        return stated
    length, per_mm = number(canon[1]), number(lens[2])
    return length / per_mm if length and per_mm else None


def _iso(tags: Tags) -> float | None:
    """Read EXIF; else Nikon's maker note "0 400"."""
    nikon = tags.get("Exif.Nikon3.ISOSpeed", "").split() or [""]
    return _first_positive(tags, "Exif.Photo.ISOSpeedRatings", "Exif.Image.ISOSpeedRatings") or number(nikon[-1]) or None


def _taken_at(tags: Tags) -> datetime | None:
    for name in ("Exif.Photo.DateTimeOriginal", "Exif.Image.DateTimeOriginal", "Exif.Image.DateTime"):
        moment = parse_time(tags.get(name))
        if moment is not None:
            return moment.replace(microsecond=_microseconds(tags.get("Exif.Photo.SubSecTimeOriginal")))
    return None


def _microseconds(digits: str | None) -> int:
    digits = (digits or "").strip()
    return int(digits[:6].ljust(6, "0")) if digits.isdecimal() else 0


def _text(tags: Mapping[str, str], *names: str) -> str | None:
    return next((tags[name].strip() for name in names if tags.get(name, "").strip()), None)


def _end(offsets: str, counts: str) -> int:
    try:
        return max((int(offset) + int(count) for offset, count in zip(offsets.split(), counts.split(), strict=True)), default=0)
    except ValueError:
        return 0
