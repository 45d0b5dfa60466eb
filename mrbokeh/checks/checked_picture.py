"""Inputs of `mrbokeh check`: one picture, numbered pictures in a folder, the slices of a focal stack, or a film.

Each picture comes with its alpha, the layers that a layered EXR keeps, and how finely its file can store light.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import INTEROP_ID, INTEROP_IDS, REC709, ExrPart, in_rec709, read_exr, stated_primaries
from mrbokeh.images.image_io import INTEGER_SUFFIXES, LINEAR_SUFFIXES, read_image, read_layer
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack
from mrbokeh.stacks.photograph import is_raw, read_photograph
from mrbokeh.system.errors import InputError
from mrbokeh.video.image_sequence import is_pattern, numbered, numbers_of

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

VIRTUAL, SHARP, SHADOW = "virtual", "sharp", "shadow"
"""Names of layers in a layered EXR: what was put in, blurred; the same before the blur; what it takes from the photograph."""

_HALF_STEP, _CODE_STEP_16, _CODE_STEP_8 = 2.0**-10, 1.5 / 65535, 1.5 / 255
_LOSSY_STEP = 12 / 255
_STEEPEST = 12.92


@dataclass(frozen=True)
class Storage:
    """Precision of a file.

    is_linear: steps are shares of the value (EXR), else of the sRGB code (integer files, films). step: what rounding may change.
    mixes: the file has other primaries, so that rounding of its brightest channel reaches all of ours.
    """

    is_linear: bool
    step: float
    mixes: bool = False

    def dark_step(self, rgb: Rgb) -> Plane:
        """Return how far below 0 storing can bring light, for each pixel.

        Not in EXR of our primaries; of others, rounding of a bright channel can. Colours of lossy films ring over the dark beside them.
        """
        if self.is_linear and not self.mixes:
            return np.zeros(rgb.shape[:2], np.float32)
        if self.is_linear:
            return self._rounded(np.abs(np.nan_to_num(rgb, posinf=0.0, neginf=0.0))).max(axis=2)
        lossy = self.step >= _LOSSY_STEP
        return np.full(rgb.shape[:2], np.inf if lossy else self.step / _STEEPEST, np.float32)

    def _rounded(self, light: Rgb) -> Rgb:
        """Return by how much rounding in the file can change ours; a row of the matrix from AP0 has 4.05 in sum."""
        if self.mixes:
            light = np.broadcast_to(np.float32(4.1) * light.max(axis=2, keepdims=True), light.shape)
        return np.float32(self.step) * light

    def changed(self, rgb: Rgb, plate_rgb: Rgb) -> Bool[np.ndarray, "height width"]:
        """Return where two pictures differ by more than storing them explains. NaN differs from everything."""
        if self.is_linear:
            known = np.nan_to_num(rgb, posinf=0.0, neginf=0.0)
            light = np.maximum(np.abs(known), np.abs(plate_rgb))
            allowed = self._rounded(light) + (1e-7 if self.step else 0.0)
            return ~((np.abs(known - plate_rgb) <= allowed) & np.isfinite(rgb)).all(axis=2)
        # The curve is nowhere steeper than its foot: what differs less in light than that can hide need not be encoded.
        differs = ~(np.abs(rgb - plate_rgb) <= self.step / _STEEPEST).all(axis=2)
        shown, stored = (np.clip(linear_to_srgb(each[differs]), 0.0, 1.0) for each in (rgb, plate_rgb))
        differs[differs] = ~(np.abs(shown - stored) <= self.step).all(axis=1)
        return differs


LOSSLESS_FILM, LOSSY_FILM = Storage(False, 4.0 * _CODE_STEP_16), Storage(False, _LOSSY_STEP)


@dataclass(frozen=True)
class CheckedPicture:
    """Picture to check.

    rgb: linear Rec.709; alpha: None if the file has none; layers by name; time_s: of a frame of a film, else None. depth_m: of what
    is seen, inf where that is unknown, or None.
    """

    name: str
    rgb: Rgb
    storage: Storage
    alpha: Plane | None = None
    layers: Mapping[str, Layer] = field(default_factory=dict)
    time_s: float | None = None
    depth_m: Plane | None = None


def read_picture(path: Path) -> CheckedPicture:
    """Read an EXR with its layers, RAW as `composite` develops it, or any other picture. Raises InputError if it cannot be read."""
    if path.suffix.lower() not in _PICTURES:
        return CheckedPicture(path.name, read_photograph(path).rgb, Storage(True, 0.0))
    if path.suffix.lower() != ".exr":
        return CheckedPicture(path.name, read_image(path), _integer_storage(path))
    parts = read_exr(path)
    layer = read_layer(path)
    has_alpha = any("A" in part.channels for part in parts)
    is_ours = parts[0].attributes.get(INTEROP_ID) == INTEROP_IDS[REC709]
    is_half = any(part.channels.get("R", np.empty(0)).dtype == np.float16 for part in parts)
    return CheckedPicture(
        name=path.name,
        rgb=layer.rgb,
        storage=Storage(True, _HALF_STEP if is_half else 0.0, stated_primaries(parts[0], parts) is not None and not is_ours),
        alpha=layer.alpha if has_alpha else None,
        layers=_layers(parts, path),
        depth_m=layer.depth_m,
    )


def with_layers(picture: CheckedPicture, layers: Mapping[str, Layer]) -> CheckedPicture:
    """Add layers from files of their own. Raises InputError if one is of another size."""
    for name, layer in layers.items():
        if layer.alpha.shape != picture.rgb.shape[:2]:
            height, width = picture.rgb.shape[:2]
            raise InputError(f"the {name} layer is {layer.width_px}x{layer.height_px} px, {picture.name} is {width}x{height} px: resize it")
    return replace(picture, layers={**picture.layers, **layers})


def _integer_storage(path: Path) -> Storage:
    suffix = path.suffix.lower()
    if suffix not in INTEGER_SUFFIXES:
        return Storage(True, 2.0**-7)
    if suffix in (".jpg", ".jpeg"):
        return LOSSY_FILM
    pixels = stored_pixels(path)
    if pixels.dtype.kind == "f":
        return Storage(True, 0.0)
    return Storage(False, _CODE_STEP_16 if pixels.dtype == np.uint16 else _CODE_STEP_8)


def _layers(parts: list[ExrPart], path: Path) -> dict[str, Layer]:
    """Return layers NAME.R, NAME.G, NAME.B with NAME.A and NAME.Z of any part, and parts of that name with R, G, B."""
    primaries = stated_primaries(parts[0], parts)
    named = {name: part.channels for part in parts for name in (VIRTUAL, SHARP, SHADOW) if part.name == name and "R" in part.channels}
    for part in parts:
        for name in (VIRTUAL, SHARP, SHADOW):
            own = {key.removeprefix(f"{name}."): pixels for key, pixels in part.channels.items() if key.startswith(f"{name}.")}
            if own:
                named[name] = own
    return {name: _layer(channels, primaries, path) for name, channels in named.items()}


def _layer(channels: Mapping[str, np.ndarray], primaries: tuple[float, ...] | None, path: Path) -> Layer:
    shape = next(iter(channels.values())).shape
    rgb = in_rec709(np.stack([channels.get(c, np.zeros(shape)) for c in "RGB"], axis=2).astype(np.float32), primaries, path)
    depth_m = channels.get("Z", np.full(shape, np.inf)).astype(np.float32)
    return Layer(rgb, channels.get("A", np.ones(shape)).astype(np.float32), depth_m)


_PICTURES = INTEGER_SUFFIXES + LINEAR_SUFFIXES
_LOSSLESS_CODECS = ("ffv1", "png", "huffyuv", "ffvhuff", "rawvideo")
_NUMBER = re.compile(r"(\d+)(?=\D*$)")


@dataclass(frozen=True)
class Shot:
    """Pictures to check.

    numbers: of the pictures as their names state them, or None for a film, whose length is unknown before it is read.
    missing: numbers that should exist. is_sequence: pictures follow one another in time. pictures: opens a fresh pass over them; one
    that cannot be read comes as the sentence that says why.
    """

    path: Path
    numbers: tuple[int, ...] | None
    missing: tuple[int, ...]
    is_sequence: bool
    pictures: Callable[[], Iterator[CheckedPicture | str]]


def open_shot(path: Path) -> Shot:
    """Open a shot, named shot.%04d.exr too. Raises InputError if there is nothing to check."""
    if is_pattern(path) and not path.exists():
        return _sequence(path, {number: numbered(path, number) for number in numbers_of(path)})
    if not path.exists():
        raise InputError(f"expected a picture, a folder of pictures, a focal stack or a film at {path}, but there is nothing")
    if path.is_dir():
        return _stack(path) if (path / FILE_NAME).is_file() else _numbered(path)
    if path.suffix.lower() in _PICTURES or is_raw(path):
        return Shot(path=path, numbers=(0,), missing=(), is_sequence=False, pictures=lambda: iter([read_picture(path)]))
    return _film(path)


def _numbered(folder: Path) -> Shot:
    files = sorted(each for each in folder.iterdir() if each.suffix.lower() in _PICTURES and not each.name.startswith("."))
    if not files:
        raise InputError(f"{folder} holds no pictures ({', '.join(_PICTURES)}): give the folder of a sequence or of a focal stack")
    found = [_NUMBER.search(each.stem) for each in files]
    if len({each.suffix.lower() for each in files}) > 1 or any(each is None for each in found):
        raise InputError(
            f"{folder}: expected pictures of one format with numbers in their names (shot.0001.exr), got {files[0].name} and others"
        )
    by_number = dict(sorted((int(match.group()), file) for match, file in zip(found, files, strict=True) if match))
    if len(by_number) < len(files):
        raise InputError(f"{folder}: {len(files)} pictures share {len(by_number)} numbers: keep one sequence per folder")
    return _sequence(folder, by_number)


def _sequence(path: Path, by_number: dict[int, Path]) -> Shot:
    missing = tuple(sorted(set(range(min(by_number), max(by_number) + 1)) - set(by_number)))
    return Shot(path=path, numbers=tuple(by_number), missing=missing, is_sequence=True, pictures=lambda: _read(list(by_number.values())))


def _stack(folder: Path) -> Shot:
    paths = [folder / each.path for each in read_focal_stack(folder).slices]
    missing = tuple(index for index, path in enumerate(paths) if not path.is_file())
    present = [index for index in range(len(paths)) if index not in missing]
    return Shot(
        path=folder, numbers=tuple(present), missing=missing, is_sequence=False, pictures=lambda: _read([paths[index] for index in present])
    )


def _read(paths: list[Path]) -> Iterator[CheckedPicture | str]:
    for path in paths:
        try:
            yield read_picture(path)
        except InputError as error:
            yield str(error)


def _film(path: Path) -> Shot:
    from mrbokeh.video.clip import probe

    probe(path)
    return Shot(path=path, numbers=None, missing=(), is_sequence=True, pictures=lambda: _frames(path))


def _frames(path: Path) -> Iterator[CheckedPicture]:
    from mrbokeh.video.clip import read_frames

    storage = _film_storage(path)
    for number, frame in enumerate(read_frames(path)):
        yield CheckedPicture(f"frame {number}", frame.rgb, storage, time_s=frame.time_s)


def _film_storage(path: Path) -> Storage:
    import av

    with av.open(str(path)) as container:
        return LOSSLESS_FILM if container.streams.video[0].codec_context.name in _LOSSLESS_CODECS else LOSSY_FILM
