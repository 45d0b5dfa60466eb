"""Pictures and layers to and from scene-linear float32: HDR as it is, EXR from the primaries that it states, PNG, TIFF, JPEG and WebP
through a stated encoding; and previews and contact sheets for people.

WebP and HEIC are read only: WebP keeps 8 bits, mostly lossily, and HEIC needs the extra `heic`; what encodes it from Python brings x265
(GPL). Colour profiles are honoured on reading (`color_profiles`); integers are written as sRGB without one.

`write_image` states no primaries, for kernels and maps of numbers have none; layers and finished pictures (`alpha_io`) state theirs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from mrbokeh.images.color import display_rgb8
from mrbokeh.images.exr_io import STATED_REC709, ExrPart, in_rec709, read_exr, stated_primaries, write_exr
from mrbokeh.images.heif import HEIF_SUFFIXES
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import Encoding, codes_of, linear_from_codes, stored_pixels, stored_rgb, write_stored
from mrbokeh.system.errors import InputError, require_file
from mrbokeh.system.messages import warn


def require_numbers(path: Path | str, planes: Mapping[str, np.ndarray]) -> None:
    """Raise InputError if values are NaN. planes: arrays by what they hold."""
    for what, values in planes.items():
        if broken := int(np.isnan(values).sum()):
            raise InputError(f"{path}: {what} is NaN in {broken} place{'' if broken == 1 else 's'}: mend the render first")


def require_depth_ahead(path: Path | str, name: str, stored: np.ndarray) -> None:
    """Raise InputError if depth is negative and nowhere positive, as written by programs whose cameras look along -z.

    stored: depths of visible pixels. All zeros are accepted: everything is background.
    """
    if (stored < 0).any() and not (stored > 0).any():
        raise InputError(
            f"{path}: {name} is negative ({float(stored.min()):g} to {float(stored.max()):g}): expected distances ahead of the camera "
            f"as positive numbers, so turn the sign"
        )


_HARDLY_METRES = 100.0


def doubt_metres(path: Path | str, depth_m: np.ndarray, divided: str = "it") -> None:
    """Warn where nothing is nearer than 100 m: such depth is in millimetres more often than in metres. divided: what mends it then."""
    nearest_m = float(np.min(depth_m, initial=np.inf, where=depth_m > 0))
    if _HARDLY_METRES <= nearest_m < np.inf:
        warn(
            f"nothing in {path} is nearer than {nearest_m:.4g} m: is its depth in metres? If it is in millimetres, divide {divided} by 1000"
        )


WIDEST_PX = 320
LABEL_PX = 18
GAP_PX = 4
FONT_SCALE = 0.36


@dataclass(frozen=True)
class SheetRow:
    """Row of a contact sheet: scene-linear pictures (H, W, 3) by caption."""

    label: str
    pictures: Mapping[str, Float32[np.ndarray, "height width 3"]]


def write_contact_sheet(path: Path, rows: Sequence[SheetRow]) -> None:
    """Write rows of labelled pictures as an 8-bit PNG; pictures wider than 320 px are reduced."""
    write_stored(path, np.concatenate([_row(each) for each in rows], axis=0))


def _row(row: SheetRow) -> UInt8[np.ndarray, "sheet_height sheet_width 3"]:
    cells = [_cell(f"{row.label}: {caption}" if i == 0 else caption, picture) for i, (caption, picture) in enumerate(row.pictures.items())]
    return np.concatenate(cells, axis=1)


def _cell(caption: str, picture: Float32[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "sheet_height sheet_width 3"]:
    import cv2

    height, width = picture.shape[:2]
    shrink = min(1.0, WIDEST_PX / width)
    small = cv2.resize(picture, (round(width * shrink), round(height * shrink)), interpolation=cv2.INTER_AREA)
    shown = display_rgb8(np.clip(small, 0.0, 1e4).astype(np.float32))
    cell = np.full((shown.shape[0] + LABEL_PX + GAP_PX, shown.shape[1] + GAP_PX, 3), 255, np.uint8)
    cell[LABEL_PX:-GAP_PX, :-GAP_PX] = shown
    cv2.putText(
        cell, caption, (2, LABEL_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, _font_scale(caption, cell.shape[1] - 4), (0, 0, 0), 1, cv2.LINE_AA
    )
    return cell


def _font_scale(caption: str, width_px: int) -> float:
    """Return the usual font scale, or a smaller one so that the caption does not run into the next."""
    import cv2

    (length_px, _), _ = cv2.getTextSize(caption, cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, 1)
    return FONT_SCALE * min(1.0, width_px / max(length_px, 1))


INTEGER_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
"""Suffixes of integer pictures that are read and written; the others are read only."""
ENCODED_SUFFIXES = (*INTEGER_SUFFIXES, ".webp", *HEIF_SUFFIXES)
LINEAR_SUFFIXES = (".exr", ".hdr")
_DEPTH_NAMES = ("Z", "depth.Z", "Depth.Z")
_LONE_DEPTH_NAMES = (*_DEPTH_NAMES, "Y")


def read_image(path: Path | str, encoding: Encoding = "srgb") -> Float32[np.ndarray, "height width 3"]:
    """Read a picture as scene-linear Rec.709 (H, W, 3), without its alpha (see `read_layer`).

    encoding: what the numbers of an integer file (PNG, TIFF, JPEG, WebP, HEIC) mean: "srgb" or what the file's colour profile says, or
    "linear", plain numbers; EXR, HDR and float TIFF are linear already. EXR of other primaries (ACES, the camera RGB of focal stacks) is
    converted; `read_camera_rgb` gives what is stored.
    """
    return _read_rgba(Path(path), encoding)[..., :3]


def require_suffix(path: Path | str, suffixes: tuple[str, ...], what: str) -> None:
    """Refuse a file name with another suffix before the work begins. what: the output's name in the message, such as "--sheet"."""
    if Path(path).suffix.lower() not in suffixes:
        raise InputError(f"{what}: expected a name that ends in {' or '.join(suffixes)}, got {path}")


def write_image(path: Path | str, rgb: Float[np.ndarray, "height width 3"], encoding: Encoding = "srgb", *, half: bool = True) -> None:
    """Write scene-linear RGB. EXR keeps it (half or float); PNG and TIFF store 16 bit, JPEG 8 bit, clipped to [0, 1]."""
    rgb, suffix = np.asarray(rgb), Path(path).suffix.lower()
    if rgb.dtype.kind != "f" or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise InputError(
            f"{path}: expected linear light as floats of shape (height, width, 3), white at 1, got {rgb.dtype} {rgb.shape}: "
            f"read_picture makes them of a file"
        )
    if suffix == ".exr":
        dtype = np.float16 if half else np.float32
        write_exr(path, ExrPart({name: rgb[..., i].astype(dtype) for i, name in enumerate("RGB")}))
    elif suffix in INTEGER_SUFFIXES:
        integers = np.uint8 if suffix in (".jpg", ".jpeg") else np.uint16
        write_stored(path, codes_of(rgb.astype(np.float32, copy=False), integers, encoding))
    else:
        raise InputError(f"cannot write {path}: expected .exr, {', '.join(INTEGER_SUFFIXES)}, not {suffix or 'a file without suffix'}")


def read_linear(path: Path | str, instead: str = "develop the RAW file to EXR first") -> Float32[np.ndarray, "height width 3"]:
    """Read a picture that is stored scene-linear (EXR, HDR, float TIFF); refuse integers, which are encoded for display.

    instead: what the error advises then.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() in ENCODED_SUFFIXES and (stored := stored_pixels(path).dtype).kind != "f":
        raise InputError(
            f"{path}: expected scene-linear values (EXR, HDR or float TIFF), but it stores {stored} made for display, without "
            f"highlights: {instead}"
        )
    rgb = read_image(path)
    if not np.isfinite(rgb).all():
        raise InputError(f"{path}: {int((~np.isfinite(rgb)).any(axis=2).sum())} pixels are NaN or infinite: mend them first")
    return rgb


def read_depth(path: Path | str, *, with_holes: bool = False) -> Float32[np.ndarray, "height width"]:
    """Read depth in metres along the optical axis from an EXR with Z, depth.Z or Y; inf and values not above 0 are background (inf).

    with_holes: NaN stays, as a hole; else it is refused.
    """
    depth_m = stored_depth(path)
    if np.isnan(depth_m).any() and not (with_holes and (depth_m > 0).any()):
        raise InputError(f"{path}: {int(np.isnan(depth_m).sum())} pixels of depth are NaN: write inf (or 0) where there is background")
    if not (depth_m > 0).any():
        raise InputError(f"{path}: expected metres above 0 in its depth, but the largest is {depth_m.max():g}: is it depth along the axis?")
    doubt_metres(path, depth_m)
    return np.where((depth_m > 0) | np.isnan(depth_m), depth_m, np.float32(np.inf))


def stored_depth(path: Path | str, *, or_grey: bool = False) -> Float32[np.ndarray, "height width"]:
    """Return the numbers of an EXR's channel of depth: Z, depth.Z or Y, or that of a renderer's only layer (ViewLayer.Depth.Z).

    or_grey: a picture whose R, G and B are alike will do. Raises InputError where there is none, or several.
    """
    channels = {name: pixels for part in reversed(read_exr(path)) for name, pixels in part.channels.items()}
    of_layers = sorted(name for name in channels if name.lower().endswith("depth.z"))
    is_colour = or_grey and set("RGB") <= channels.keys() <= set("RGBA")
    is_grey = is_colour and all(np.array_equal(channels["R"], channels[each]) for each in "GB")
    names = [*_LONE_DEPTH_NAMES, *(of_layers if len(of_layers) == 1 else ()), *("R" if is_grey else "")]
    name = next((name for name in names if name in channels), None)
    if name is None:
        one = f"one channel of depth, but it has {' and '.join(of_layers)}: write the one that is meant as Z"
        none = f"depth in a channel {', '.join(_LONE_DEPTH_NAMES)}, but it has {', '.join(sorted(channels))}: write it as Z"
        raise InputError(f"{path}: expected {one if of_layers else none}")
    return channels[name].astype(np.float32)


LARGEST_ALPHA_ERROR = 0.1
"""Filters of renderers overshoot by a few hundredths."""


def require_alpha(path: Path | str, alpha: Float32[np.ndarray, "height width"]) -> None:
    """Raise InputError if alpha is NaN, or outside of 0 to 1 by more than a filter's overshoot."""
    if not (alpha.min(initial=0.0) >= -LARGEST_ALPHA_ERROR and alpha.max(initial=0.0) <= 1.0 + LARGEST_ALPHA_ERROR):
        raise InputError(f"{path}: expected alpha from 0 to 1, but A goes from {alpha.min():g} to {alpha.max():g}")


def read_layer(path: Path | str, *, extra: bool = False) -> Layer:
    """Read a layer from an EXR with R, G, B and, if present, A and Z (or depth.Z), in one part or several.

    Without A the layer is opaque; without Z, and where Z is 0 or alpha is 0, the depth is inf. Of several views (stereo)
    it is the first that has colour, with its own depth. R, G, B become Rec.709 where the file states other primaries.
    extra: keep all other channels too, each under its own name and as stored.
    """
    parts = read_exr(path)
    colour = next((part for part in parts if set("RGB") <= part.channels.keys()), parts[0])
    of_one_view = [part for part in parts if part.attributes.get("view") == colour.attributes.get("view")]
    channels = {name: pixels for part in [*reversed(of_one_view), colour] for name, pixels in part.channels.items()}
    if not set("RGB") <= channels.keys():
        had = ", ".join(sorted(channels))
        raise InputError(f"{path}: expected channels R, G and B, but it has {had}: write the picture with these names")
    rgb = in_rec709(ExrPart(channels).stacked("RGB"), stated_primaries(colour, parts), path)
    alpha = channels.get("A", np.ones(rgb.shape[:2])).astype(np.float32)
    require_alpha(path, alpha)
    depth_name = next((name for name in _DEPTH_NAMES if name in channels), None)
    depth = (np.zeros(rgb.shape[:2]) if depth_name is None else channels[depth_name]).astype(np.float32)
    require_depth_ahead(path, str(depth_name), depth[alpha > 0])
    others = sorted(channels.keys() - set("RGBA") - set(_DEPTH_NAMES)) if extra else []
    depth_m = np.where((depth > 0) & (alpha > 0), depth, np.inf).astype(np.float32)
    return Layer(rgb, alpha, depth_m, {name: channels[name].astype(np.float32)[..., None] for name in others})


def write_layer(path: Path | str, layer: Layer, *, half: bool = True, objects: ExrPart | None = None) -> None:
    """Write a layer as EXR: R, G, B, A in half or float; Z (metres along the optical axis, not antialiased) and extra channels in float.

    objects: Cryptomatte with its header entries. An extra channel of one component keeps its name, others become NAME.0, NAME.1 and so on.
    """
    require_suffix(path, (".exr",), "a layer")
    colour = np.float16 if half else np.float32
    channels = {name: layer.rgb[..., i].astype(colour) for i, name in enumerate("RGB")}
    channels |= {"A": layer.alpha.astype(colour), "Z": layer.depth_m.astype(np.float32)}
    for name, values in layer.extra.items():
        channels |= {name if values.shape[2] == 1 else f"{name}.{i}": values[..., i] for i in range(values.shape[2])}
    comments = "premultiplied alpha; Z in metres along the optical axis, not antialiased"
    attributes = {"comments": comments, **STATED_REC709, **(objects.attributes if objects else {})}
    write_exr(path, ExrPart(channels | (objects.channels if objects else {}), attributes=attributes))


def _read_rgba(path: Path, encoding: Encoding) -> Float32[np.ndarray, "height width channels"]:
    require_file(path, "a picture")
    suffix = path.suffix.lower()
    if suffix == ".exr":
        layer = read_layer(path)
        return np.dstack([layer.rgb, layer.alpha])
    if suffix not in ENCODED_SUFFIXES + LINEAR_SUFFIXES:
        raise InputError(
            f"{path}: expected one of {', '.join(LINEAR_SUFFIXES + ENCODED_SUFFIXES)}, not {suffix or 'a file without suffix'}"
        )
    pixels = stored_rgb(path)
    return pixels.astype(np.float32) if pixels.dtype.kind == "f" else linear_from_codes(pixels, encoding, path)


def write_preview(path: Path | str, rgb: Float32[np.ndarray, "height width 3"], exposure_stops: float = 0.0) -> None:
    """Write an 8-bit tone-mapped sRGB picture for people to look at."""
    write_stored(path, display_rgb8(rgb, exposure_stops))
