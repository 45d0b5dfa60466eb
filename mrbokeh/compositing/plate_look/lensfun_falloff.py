"""Vignetting of a lens from lensfun's measurements (lensfun.github.io; data CC-BY-SA 3.0, in the lensfunpy wheel of the capture extra)."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mrbokeh.compositing.plate_look.vignetting import RadialFalloff
from mrbokeh.lens_measuring.matching.photo_facts import read_facts
from mrbokeh.system.errors import InputError, MissingExtraError

if TYPE_CHECKING:
    import lensfunpy

FAR_M = 1000.0
_EXIF_IFD, _MAKER, _MODEL, _LENS_MODEL = 0x8769, 0x010F, 0x0110, 0xA434


@dataclass(frozen=True)
class CameraAndLens:
    """As Exif names them, such as Canon, Canon EOS 450D and EF100mm f/2.8 Macro USM."""

    camera_maker: str
    camera_model: str
    lens_model: str


def falloff_of_photo(path: Path | str) -> RadialFalloff:
    """Of the camera, lens, focal length, f-number and focus distance that the Exif of a photograph state.

    Raises InputError where they do not.
    """
    names, size_px = _camera_and_lens(path)
    facts = read_facts(path, size_px)
    if facts.focal_length_mm is None or facts.f_number is None:
        raise InputError(f"{path}: expected its Exif to state focal length and f-number: give the falloff as K1,K2,K3 or a flat field")
    return lensfun_falloff(names, facts.focal_length_mm, facts.f_number, facts.focus_distance_m or FAR_M)


def _camera_and_lens(path: Path | str) -> tuple[CameraAndLens, tuple[int, int]]:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            exif, size_px = picture.getexif(), picture.size
    except (UnidentifiedImageError, OSError):
        raise InputError(f"{path}: expected a photograph with Exif (JPEG, TIFF): give the falloff as K1,K2,K3 or a flat field") from None
    texts = [exif.get(_MAKER), exif.get(_MODEL), exif.get_ifd(_EXIF_IFD).get(_LENS_MODEL)]
    if not all(isinstance(each, str) for each in texts):
        raise InputError(f"{path}: expected its Exif to name camera and lens: give the falloff as K1,K2,K3 or a flat field")
    maker, model, lens_model = (str(each).strip("\0 ") for each in texts)
    return CameraAndLens(maker, model, lens_model), size_px


def lensfun_falloff(names: CameraAndLens, focal_length_mm: float, f_number: float, focus_m: float = FAR_M) -> RadialFalloff:
    """Raises MissingExtraError without lensfunpy, InputError where lensfun knows no such lens or has not measured its vignetting."""
    try:
        import lensfunpy
    except ImportError as missing:
        raise MissingExtraError("lensfunpy", "capture") from missing
    database = lensfunpy.Database()
    camera = next(iter(database.find_cameras(names.camera_maker, names.camera_model)), None)
    if camera is None:
        raise InputError(
            f"lensfun does not know the camera {names.camera_maker} {names.camera_model}: give the falloff as K1,K2,K3 or a flat field"
        )
    measured = (each for each in database.find_lenses(camera, None, names.lens_model) if each.calib_vignetting)
    lens = next(measured, None)
    terms = None if lens is None else _terms(lens, focal_length_mm, f_number, focus_m)
    if lens is None or terms is None:
        raise InputError(
            f"lensfun has no vignetting of {names.lens_model} on {names.camera_model}: give the falloff as K1,K2,K3 or a flat field"
        )
    return RadialFalloff(*terms, reach=lens.crop_factor / camera.crop_factor)


def _terms(lens: "lensfunpy.Lens", focal_length_mm: float, f_number: float, focus_m: float) -> tuple[float, float, float] | None:
    found = lens.interpolate_vignetting(focal_length_mm, f_number, min(focus_m, FAR_M))
    if found is None:
        return None
    k1, k2, k3 = (float(each) for each in found.terms[:3])
    return k1, k2, k3
