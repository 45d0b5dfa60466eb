"""Depth of a photograph from any source, at the photograph's size: files, phones, or a network that looks at the photograph.

The user brings the network (.onnx), such as MiDaS (Ranftl et al. 2020) or Depth Anything. Its input tells its layout and size; what the
file cannot say stands in a JSON of its name beside it (model.onnx: model.json).
"""

import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_filters import refined_dioptres
from mrbokeh.depth.depth_map import DepthMap, DepthSettings, StereoCalibration, with_holes_filled, without_steps
from mrbokeh.depth.mended_depth import mended_aloud
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.image_io import doubt_metres, read_depth, stored_depth
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.optics.camera import have_same_shape
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError, require_file

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Shown = Float32[np.ndarray, "rows columns 3"]
Given = Float32[np.ndarray, "rows columns"]

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class NetworkInput:
    """Input that a depth network expects: sRGB codes in [0, 1], less mean, over std, in its size.

    short_side_px, multiple_px: of networks that take any size. fit: "stretch" to a fixed size, or "pad" (whole picture, mirrored beyond
    its edges). channels: "RGB" or "BGR".
    """

    mean: tuple[float, ...] = IMAGENET_MEAN
    std: tuple[float, ...] = IMAGENET_STD
    short_side_px: int = 518
    multiple_px: int = 14
    fit: str = "stretch"
    channels: str = "RGB"
    output: str | None = field(default=None)

    def __post_init__(self) -> None:
        if len(self.mean) != 3 or len(self.std) != 3 or min(self.std) <= 0 or self.fit not in ("stretch", "pad"):
            raise InputError(f"expected mean and std of three colours and fit 'stretch' or 'pad', got {self}")
        if sorted(self.channels) != ["B", "G", "R"] or min(self.short_side_px, self.multiple_px) < 1:
            raise InputError(f"expected channels 'RGB' or 'BGR' and sizes above 0, got {self}")


def read_network_input(model: Path) -> NetworkInput:
    """Read the JSON beside the network, if there is one."""
    sidecar = model.with_suffix(".json")
    if not sidecar.is_file():
        return NetworkInput()
    values: dict[str, Any] = read_json(sidecar, "what a depth network wants")
    try:
        stated: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
        return NetworkInput(**stated)
    except TypeError:
        known = ", ".join(NetworkInput.__dataclass_fields__)
        raise InputError(f"{sidecar}: expected entries out of {known}, got {', '.join(values)}") from None


def network_depth(model: Path, photo_rgb: Rgb, settings: DepthSettings) -> DepthMap:
    """Return the network's depth at its own size, without padding."""
    given = predicted(model, photo_rgb, read_network_input(model))
    everywhere = np.ones(given.shape, bool)
    if settings.model_gives == "metric":
        return DepthMap(np.where(given > 0, given, np.float32(np.inf)), everywhere, f"{model.name}, metres")
    if settings.known:
        return DepthMap.of_dioptres(_fitted(given, photo_rgb, settings), everywhere, f"{model.name}, fitted to known distances")
    if settings.near_far_m is None:
        raise InputError(
            f"{model} gives depth without a scale: state the nearest and farthest distance with --disparity NEAR:FAR, or two known ones "
            f"with --distance-at X,Y,METRES, or --depth-model-gives metric if it gives metres"
        )
    low, high = float(given.min()), float(given.max())
    levels = ((given - low) / max(high - low, 1e-12)).astype(np.float32)
    return DepthMap.of_levels(levels, settings.near_far_m, everywhere, model.name)


def _fitted(given: Given, photo_rgb: Rgb, settings: DepthSettings) -> Given:
    """Fit 1 / depth = a given + b through the known distances (least squares if there are more than two)."""
    height, width = photo_rgb.shape[:2]
    for each in settings.known:
        if not (0 <= each.x_px < width and 0 <= each.y_px < height):
            raise InputError(f"the known distance at pixel {each.x_px:g},{each.y_px:g} lies outside the photograph of {width}x{height} px")
    rows, columns = given.shape
    seen = np.array([given[int(each.y_px * rows / height), int(each.x_px * columns / width)] for each in settings.known], np.float64)
    if len(seen) < 2 or np.ptp(seen) <= 1e-6 * max(float(np.ptp(given)), 1e-12):
        raise InputError("expected two known distances at places that the network sees at different depths: give --distance-at twice")
    slope, offset = np.polyfit(seen, [1.0 / each.depth_m for each in settings.known], 1)
    if slope <= 0:
        raise InputError(
            "the known distances say that what the network takes for near is far: does it give metric depth, or are they swapped?"
        )
    return (slope * given + offset).astype(np.float32)


def predicted(model: Path, photo_rgb: Rgb, wants: NetworkInput) -> Given:
    """Return what the network gives for a photograph (linear), at the size in which it saw the picture."""
    from mrbokeh.renderers.onnx_sessions import open_session

    session = open_session(model)
    socket = session.get_inputs()[0]
    layout = _layout(socket.shape, model)
    size = _size(socket.shape, layout, photo_rgb, wants)
    seen, cut = _fitted_in(np.clip(linear_to_srgb(photo_rgb), 0.0, 1.0), size, wants)
    normalised = ((seen[..., ["RGB".index(c) for c in wants.channels]] - np.array(wants.mean)) / np.array(wants.std)).astype(np.float32)
    batch = normalised.transpose(2, 0, 1)[None] if layout == "NCHW" else normalised[None]
    dtype = np.float16 if socket.type == "tensor(float16)" else np.float32
    given = session.run(None if wants.output is None else [wants.output], {socket.name: batch.astype(dtype)})[0]
    plane = np.squeeze(np.asarray(given, np.float32))
    if plane.ndim != 2:
        raise InputError(
            f"{model}: expected one plane of depth, got an output of shape {np.shape(given)}: name it as 'output' in {model.stem}.json"
        )
    if not np.isfinite(plane).all():
        raise InputError(f"{model} gave NaN or infinity: does it want another mean and std (in {model.stem}.json)?")
    return np.ascontiguousarray(_cut(plane, cut, size))


def _layout(shape: Any, model: Path) -> str:
    if len(shape) == 4 and shape[1] == 3:
        return "NCHW"
    if len(shape) == 4 and shape[3] == 3:
        return "NHWC"
    raise InputError(f"{model}: expected a network that takes one picture (1, 3, H, W) or (1, H, W, 3), got an input of shape {shape}")


def _size(shape: Any, layout: str, photo_rgb: Rgb, wants: NetworkInput) -> tuple[int, int]:
    """Return (width, height) in which the network sees the picture: a fixed one, or the short side as wanted, in whole multiples."""
    fixed = shape[2:4] if layout == "NCHW" else shape[1:3]
    height, width = photo_rgb.shape[:2]
    shrink = wants.short_side_px / min(height, width)
    rows, columns = (max(1, round(side * shrink / wants.multiple_px)) * wants.multiple_px for side in (height, width))
    return (fixed[1] if isinstance(fixed[1], int) else columns), (fixed[0] if isinstance(fixed[0], int) else rows)


def _fitted_in(codes: Rgb, size: tuple[int, int], wants: NetworkInput) -> tuple[Shown, tuple[int, int, int, int]]:
    """Return the picture at the network's size, and the rows and columns (top, bottom, left, right) that are picture and not padding."""
    import cv2

    (height, width), (columns, rows) = codes.shape[:2], size
    if wants.fit == "stretch":
        return _resized(codes, size), (0, rows, 0, columns)
    scale = min(columns / width, rows / height)
    inner = (min(columns, max(1, round(width * scale))), min(rows, max(1, round(height * scale))))
    left, top = (columns - inner[0]) // 2, (rows - inner[1]) // 2
    beyond = (top, rows - inner[1] - top, left, columns - inner[0] - left)
    return cv2.copyMakeBorder(_resized(codes, inner), *beyond, cv2.BORDER_REFLECT), (top, top + inner[1], left, left + inner[0])


def _resized(codes: Rgb, size: tuple[int, int]) -> Shown:
    import cv2

    if codes.shape[1::-1] == size:
        return codes
    shrinks = size[0] < codes.shape[1]
    return np.clip(cv2.resize(codes, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC), 0.0, 1.0)


def _cut(plane: Plane, cut: tuple[int, int, int, int], size: tuple[int, int]) -> Given:
    """Cut padding off; networks that give a coarser map than they see are cut in proportion."""
    down, across = plane.shape[0] / size[1], plane.shape[1] / size[0]
    top, bottom, left, right = round(cut[0] * down), round(cut[1] * down), round(cut[2] * across), round(cut[3] * across)
    return plane[top:bottom, left:right]


def read_number_map(path: Path, settings: DepthSettings) -> DepthMap:
    """Read plain numbers of a picture or an array: depth with metres_per_unit (0: unknown), dioptres with near_far_m, the largest nearest.

    For near_far_m the whole range of an integer format counts (0 is FAR, 65535 is NEAR), of floats the range that occurs.
    """
    if path.suffix.lower() in _ARRAYS:
        numbers, name = _array_of(path)
        if name == _METRES and settings.near_far_m is None and settings.metres_per_unit is None:
            settings = replace(settings, metres_per_unit=1.0)
    elif path.suffix.lower() == ".exr":
        numbers = stored_depth(path, or_grey=True)
    else:
        pixels = stored_pixels(path)
        numbers = pixels if pixels.ndim == 2 else pixels[..., 0]
    known = np.isfinite(numbers)
    if settings.metres_per_unit is not None:
        known = numbers > 0  # inf is background
        depth_m = np.where(known, numbers * np.float32(settings.metres_per_unit), np.inf).astype(np.float32)
        doubt_metres(path, depth_m, "the metres per step")
        return DepthMap(depth_m, known, f"{path.name}, {settings.metres_per_unit:g} m per step")
    if settings.near_far_m is None:
        raise InputError(
            f"{path} does not say what its numbers mean: give --disparity NEAR:FAR in metres (largest number nearest, even steps of "
            f"1/distance), or --depth-scale METRES_PER_STEP{_OF_ARRAYS if path.suffix.lower() in _ARRAYS else ''}"
        )
    return DepthMap.of_levels(_levels(numbers), settings.near_far_m, known, f"{path.name}, linear in dioptres")


def _levels(numbers: np.ndarray) -> Plane:
    if numbers.dtype.kind in "ui":
        most = np.iinfo(numbers.dtype).max
        return without_steps((numbers / np.float32(most)).astype(np.float32), int(most) + 1)
    low, high = float(np.nanmin(numbers)), float(np.nanmax(np.where(np.isfinite(numbers), numbers, np.nan)))
    return np.clip((np.nan_to_num(numbers, posinf=high, neginf=low, nan=low) - low) / max(high - low, 1e-30), 0, 1).astype(np.float32)


def depth_of_file(path: Path, near_far_m: tuple[float, float] | None = None, *, with_holes: bool = False) -> Plane:
    """Read depth in metres as a file stores it: EXR with Z or an array (.npz, .npy), or with near_far_m numbers even in 1/distance.

    with_holes: what is unknown is NaN; else an EXR with NaN is refused, and a picture's holes take the nearest depth.
    """
    if near_far_m is None and path.suffix.lower() not in _ARRAYS:
        return read_depth(path, with_holes=with_holes)
    depth = read_number_map(path, DepthSettings(near_far_m, metres_per_unit=None if near_far_m else 1.0))
    return _holed(depth) if with_holes else with_holes_filled(depth).depth_m


def _holed(depth: DepthMap) -> Plane:
    return np.where(depth.valid, depth.depth_m, np.float32(np.nan))


_ARRAYS = (".npz", ".npy")
_METRES = "depth"
"""Name under which networks of metric depth write metres into an .npz."""
_OF_ARRAYS = " (1 where they are metres), or --stereo-cameras FOCAL_PX,BASELINE_M,OFFSET_PX where they are pixels of disparity"


def _array_of(path: Path, preferred: str = _METRES) -> tuple[Plane, str]:
    """Return the array of that name, or else the first, of an .npz, or that of an .npy, and its name."""
    try:
        loaded = np.load(path)
        name = "" if isinstance(loaded, np.ndarray) else preferred if preferred in loaded else loaded.files[0]
        numbers = np.squeeze(np.asarray(loaded[name] if name else loaded, np.float32))
    except (OSError, ValueError, TypeError, IndexError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: expected an array of numbers as numpy.save writes it, but it is damaged or something else") from error
    if numbers.ndim != 2:
        raise InputError(f"{path}: expected depth or disparity (H, W), got an array of shape {numbers.shape}")
    return numbers, name


def _of_stereo(path: Path, calibration: StereoCalibration) -> DepthMap:
    """Read disparity in pixels, as in the Middlebury data sets; what is not finite is unknown."""
    disparity, _ = _array_of(path, "disparity")
    known = np.isfinite(disparity)
    dioptres = (np.where(known, disparity, 0.0) + calibration.offset_px) / (calibration.focal_px * calibration.baseline_m)
    return DepthMap.of_dioptres(dioptres.astype(np.float32), known, f"{path.name}, stereo of {calibration.baseline_m:g} m")


_SAME_ASPECT, _SMALLER = 0.02, 0.75


def open_depth(source: Path, photo_rgb: Rgb, settings: DepthSettings | None = None) -> DepthMap:
    """Read depth from any source and bring it to the photograph's size along its edges.

    source: one distance for all (a number in place of a file), EXR with Z in metres, PNG, TIFF or EXR of numbers whose meaning the
    settings say, an array (.npz, .npy; one named depth holds metres), a phone's photograph with depth inside, or a depth network (.onnx).
    photo_rgb: (H, W, 3) linear.
    Raises InputError if the source cannot be read, does not say what it means, or is of another shape than the photograph.
    """
    settings = settings or DepthSettings()
    if distance_m := one_distance_m(source):
        if settings.near_far_m or settings.metres_per_unit or settings.stereo:
            raise InputError(f"--depth {source} is one distance in metres: leave out what says how a file's numbers count")
        shape = photo_rgb.shape[:2]
        return DepthMap(np.full(shape, distance_m, np.float32), np.ones(shape, bool), f"{distance_m:g} m everywhere")
    require_file(source, "depth")
    if settings.stereo is not None and source.suffix.lower() not in _ARRAYS:
        raise InputError(f"--stereo-cameras is for a file of disparity ({', '.join(_ARRAYS)}), got {source}: leave it out")
    depth, is_soft = _read(source, photo_rgb, settings)
    _require_same_aspect(source, depth, photo_rgb)
    smaller = depth.depth_m.shape[1] < _SMALLER * photo_rgb.shape[1]
    refine = is_soft and smaller and not settings.exact if settings.refined is None else settings.refined
    if settings.exact:
        return at_size_of(with_holes_filled(depth), photo_rgb, refine)
    if refine and smaller:
        return at_size_of(_mended(depth, photo_rgb), photo_rgb, refine)
    return _mended(at_size_of(depth, photo_rgb, False), photo_rgb)


def one_distance_m(depth: Path) -> float | None:
    """Return the distance of all that is seen where --depth is a number such as 4, and no file. Raises InputError if it is not above 0."""
    try:
        distance_m = float(str(depth))
    except ValueError:
        return None
    if depth.exists():
        return None
    if not distance_m > 0.0:
        raise InputError(f"--depth: expected a file, or metres above 0 such as 4, got {depth}")
    return distance_m


def _mended(depth: DepthMap, photo_rgb: Rgb) -> DepthMap:
    """Return the map mended by the photograph, which is made as small for it."""
    import cv2

    size = depth.depth_m.shape[::-1]
    seen_rgb = photo_rgb if photo_rgb.shape[1::-1] == size else cv2.resize(photo_rgb, size, interpolation=cv2.INTER_AREA)
    return replace(depth, depth_m=mended_aloud(_holed(depth), seen_rgb))


def _read(source: Path, photo_rgb: Rgb, settings: DepthSettings) -> tuple[DepthMap, bool]:
    """Return the map at its own size, and whether such maps have soft edges."""
    suffix = source.suffix.lower()
    if suffix == ".onnx":
        return network_depth(source, photo_rgb, settings), True
    if suffix == ".exr" and settings.near_far_m is None and settings.metres_per_unit is None:
        depth_m = read_depth(source, with_holes=not settings.exact)
        known = ~np.isnan(depth_m)
        return DepthMap(np.where(known, depth_m, np.float32(np.inf)), known, source.name), False
    if suffix in (".exr", *_ARRAYS):
        return (_of_stereo(source, settings.stereo) if settings.stereo else read_number_map(source, settings)), False
    phone = read_phone_photo(source, settings.near_far_m)
    return (read_number_map(source, settings), settings.metres_per_unit is None) if phone is None else (phone.depth, True)


def _require_same_aspect(source: Path, depth: DepthMap, photo_rgb: Rgb) -> None:
    (rows, columns), (height, width) = depth.depth_m.shape, photo_rgb.shape[:2]
    if not have_same_shape((columns, rows), (width, height), _SAME_ASPECT):
        raise InputError(
            f"{source} is {columns}x{rows} px, the photograph {width}x{height} px: expected one view, cut the same way (is one turned?)"
        )


def at_size_of(depth: DepthMap, photo_rgb: Rgb, refine: bool) -> DepthMap:
    """Return the map at the size of its photograph. refine: along its edges, for a map whose own are soft or misplaced."""
    import cv2

    height, width = photo_rgb.shape[:2]
    size = (width, height)
    valid = cv2.resize(depth.valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if refine:
        return DepthMap.of_dioptres(np.maximum(refined_dioptres(depth.dioptres, photo_rgb), 0.0), valid, f"{depth.note}, edges refined")
    if depth.depth_m.shape == (height, width):
        return depth
    return DepthMap(cv2.resize(depth.depth_m, size, interpolation=cv2.INTER_NEAREST), valid, f"{depth.note}, resized")
