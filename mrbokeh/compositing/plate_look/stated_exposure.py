"""The exposure that a picture states: Exif of JPEG, TIFF and PNG, or the standard attributes of an EXR header."""

from pathlib import Path

from mrbokeh.compositing.plate_look.exposure_match import Exposure, exposure_of_metadata, exposure_of_photo
from mrbokeh.system.errors import InputError

_OF_EXR = {"exposure_time_s": "expTime", "iso": "isoSpeed", "f_number": "aperture"}
"""Names of OpenEXR's standard attributes (OpenEXR, "Standard Optional Attributes"); times in seconds."""


def stated_exposure(path: Path) -> Exposure:
    """Raises InputError where something is missing."""
    if path.suffix.lower() != ".exr":
        return exposure_of_photo(path)
    import OpenEXR

    if not path.is_file():
        raise InputError(f"expected an EXR file at {path}, but there is none")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as EXR: {error}") from None
    return exposure_of_metadata({name: header.get(attribute) for name, attribute in _OF_EXR.items()}, str(path))
