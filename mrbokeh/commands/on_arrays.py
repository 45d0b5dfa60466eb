"""The public verbs on arrays: `mrbokeh.read_picture`, `mrbokeh.render`, `mrbokeh.composite`, with the defaults of the commands.

What may be an array may be the path of a file too. Every error a caller can mend is an `InputError`.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer, opaque
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError, require_file

if TYPE_CHECKING:
    from mrbokeh.commands._composite_options import ObjectOptions

File = str | Path
Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

_NO_FILE = Path(os.devnull)
"""A photograph that is an array."""


def read_picture(path: File) -> Rgb:
    """Read a photograph (RAW, JPEG, TIFF, PNG, WebP, HEIC, EXR, HDR), upright, as linear Rec.709 (H, W, 3) of float32; white is 1."""
    from mrbokeh.stacks.photograph import read_photograph

    require_file(path, "a photograph")
    return read_photograph(path).rgb


def render(
    picture: np.ndarray | File,
    depth_m: np.ndarray | File,
    lens: Lens | File,
    *,
    focus: float | tuple[float, float] | None = None,
    renderer: File | Renderer | None = None,
    exact_depth: bool = False,
) -> Rgb:
    """Blur an all-in-focus picture with depth as a lens does; return linear Rec.709 (H, W, 3) of float32.

    picture: (H, W, 3) linear, or a file. depth_m: (H, W) metres along the optical axis (inf or <= 0: background), or an EXR with Z.
    lens: a Lens, a lens file, the folder of a bank of PSFs or a network (.onnx). focus: metres, or the pixel (x, y) to focus on; None
    keeps the lens's own.
    renderer: polygon, low-rank, laplacian, lrdm, scatter (exact, slow), the path of a network (.onnx) or bank, or a Renderer; None takes
    the lens's own.
    exact_depth: depth is taken as it is; else NaN is unknown, and holes, soft and misplaced edges are mended by the picture.
    Raises InputError if sizes differ or a value is no number.

    >>> blurred = mrbokeh.render(picture, depth_m, mrbokeh.Lens(focal_length_mm=50, f_number=1.8), focus=1.2)
    """
    from mrbokeh.depth.mended_depth import mended_aloud

    rgb, surface_m = _rgb(picture, "picture"), _depth_of(depth_m, with_holes=not exact_depth)
    if rgb.shape[:2] != surface_m.shape:
        raise InputError(f"picture and depth must be of one size, got {rgb.shape[:2]} and {surface_m.shape} (height, width)")
    surface_m = surface_m if exact_depth else mended_aloud(surface_m, rgb)
    held, spreads = _optics(lens, renderer)
    return spreads.render([opaque(rgb, surface_m)], _focused(held or Lens.default(), focus, surface_m)).rgb


def composite(
    photo: np.ndarray | File,
    inserted: Layer | File | Sequence[Layer | File],
    lens: Lens | File | None = None,
    *,
    depth_m: np.ndarray | File | None = None,
    all_in_focus: np.ndarray | File | None = None,
    slice_index: int | None = None,
    focus: float | tuple[float, float] | None = None,
    at_pixel: tuple[float, float] | Sequence[tuple[float, float]] | None = None,
    height: float | str | Sequence[float | str] | None = None,
    mode: str | None = None,
    renderer: File | Renderer | None = None,
    exact_depth: bool = False,
) -> Rgb:
    """Put virtual objects into a photograph, blurred by its lens, before and behind what it shows; return linear Rec.709 (H, W, 3).

    Where a GLB stands on a pixel, what the photograph does not tell (its lens, its ground, the object's light) is guessed, and said, as
    by the command; options that its words name are the command's. What only a screen shows (grain, compression) is not put on.

    photo: (H, W, 3) linear, a photograph's file, or the folder of a merged focal stack with the slice_index to put it into.
    inserted: GLB files, or sharp layers (Layer or EXR with R, G, B, A and Z in metres) of the photograph's size, front first.
    lens, renderer, exact_depth: as in `render`; None takes what the file or the stack tells. focus: metres, or a pixel (x, y); needs depth.
    depth_m: (H, W) metres, or any file that `mrbokeh composite --depth` takes. all_in_focus: the photograph without its blur, if known.
    at_pixel: (x, y) on which a GLB stands, one for each, or to which the depth of layers is scaled. height: of a GLB in metres, or such as
    "120px"; one for each, or one for all.
    mode: front, over, matte, between or rerender; None takes the best that what is known allows.
    Raises InputError if something needed is unknown or of the wrong size.

    >>> picture = mrbokeh.composite("scene/desk", "cake.glb", slice_index=2, at_pixel=(600, 420), height="120px")
    """
    from mrbokeh.commands._composite_layers import standing_on_pixel
    from mrbokeh.commands._composite_options import CompositeOptions, PlateOptions
    from mrbokeh.commands._composited import composited, insertion_by, placed
    from mrbokeh.commands._insertion_options import VirtualOptions
    from mrbokeh.compositing.ground import with_ground_behind, without_specks
    from mrbokeh.compositing.open_plate import open_plate, with_depth
    from mrbokeh.compositing.plate import plate_of
    from mrbokeh.compositing.plate_look.finishing import Finishing
    from mrbokeh.depth.depth_map import DepthSettings
    from mrbokeh.depth.mended_depth import mended_aloud
    from mrbokeh.images.image_io import read_layer

    glbs, given = _glbs_or_layers(inserted)
    standing = _standing(glbs, at_pixel, height)
    file, taken = Path(photo) if isinstance(photo, (str, Path)) else _NO_FILE, PlateOptions(exact_depth=exact_depth)
    options = CompositeOptions(file, taken, VirtualOptions(mode=mode), standing)
    known_lens, spreads = _optics(lens, renderer)
    focus_m = None if focus is None or isinstance(focus, tuple) else focus_in_numbers(focus)[0]
    if file is not _NO_FILE:
        plate = open_plate(file, slice_index, known_lens, focus_m, guessing=options.guesses_ground, exact_depth=exact_depth)
    elif slice_index is not None:
        raise InputError(f"slice_index: expected the folder of a focal stack as photo, got an array and slice {slice_index}: leave it out")
    elif known_lens is None:
        raise InputError("a photograph as an array does not tell its lens: give lens, such as mrbokeh.Lens(focal_length_mm=50, f_number=2)")
    else:
        plate = plate_of(_rgb(photo, "photo"), known_lens if focus_m is None else known_lens.focused_at(focus_m))
    if all_in_focus is not None:
        plate = replace(plate, sharp_rgb=_rgb(all_in_focus, "all_in_focus"))
    if isinstance(depth_m, (str, Path)):
        plate = with_depth(plate, Path(depth_m), DepthSettings(exact=exact_depth))
    elif depth_m is not None:
        surface_m, seen_rgb = _depth_of(depth_m, with_holes=not exact_depth), plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb
        mends = not exact_depth and surface_m.shape == seen_rgb.shape[:2]
        plate = replace(plate, depth_m=mended_aloud(surface_m, seen_rgb) if mends else surface_m)
        plate = replace(plate, depth_confidence=None, depth_error_dioptres=0.0)
    if depth_m is not None:  # in place of a phone's own
        plate = replace(plate, depth_note="", metres_guessed=plate.metres_guessed and file.is_dir())
    if plate.depth_m is None and (isinstance(focus, tuple) or (at_pixel is not None and not glbs)):
        asked = "to focus on a pixel" if isinstance(focus, tuple) else "to put layers onto a pixel"
        raise InputError(f"{asked} the photograph needs depth: give depth_m{', or focus in metres' if isinstance(focus, tuple) else ''}")
    if isinstance(focus, tuple) and plate.depth_m is not None:
        focused = _focused(plate.lens, focus, plate.depth_m)
        camera = plate.camera if file.is_dir() else plate_of(plate.rgb, focused).camera
        plate = replace(plate, lens=focused, camera=camera, focus_known=True, rough_focus_m=None)
    if glbs:
        plate, options = placed(plate, options)
        return composited(plate, options, spreads, Finishing(), asked=standing).inserted.rgb
    layers = [each if isinstance(each, Layer) else read_layer(each) for each in given]
    if standing.at_pixel:
        layers = standing_on_pixel(layers, plate, *standing.first_px)
        plate = without_specks(with_ground_behind(plate, standing.pixels, layers), layers)
    return insertion_by(options, plate)[1].insert(plate, layers, spreads).rgb


def _glbs_or_layers(inserted: Layer | File | Sequence[Layer | File]) -> tuple[list[Path], list[Layer | File]]:
    """Return (GLB files, layers), one of which is empty. Raises InputError for anything else, or some of both."""
    from mrbokeh.images.image_io import require_alpha, require_numbers

    given = [inserted] if isinstance(inserted, (Layer, str, Path)) else list(inserted) if np.iterable(inserted) else []
    if not given or not all(isinstance(each, (Layer, str, Path)) for each in given):
        raise InputError(
            "inserted: expected a GLB file, a layer or several of them; an array becomes one by mrbokeh.Layer(rgb, alpha, depth_m)"
        )
    for each in given:
        if isinstance(each, Layer):
            require_numbers("inserted", {"rgb of a layer": each.rgb, "depth_m of a layer": each.depth_m})
            require_alpha("inserted", each.alpha)
    glbs = [Path(each) for each in given if not isinstance(each, Layer) and Path(each).suffix.lower() == ".glb"]
    if glbs and len(glbs) < len(given):
        raise InputError("inserted: expected GLB files or layers, got some of both: put one into the picture of the other")
    return glbs, [] if glbs else given


def _standing(
    glbs: list[Path],
    at_pixel: tuple[float, float] | Sequence[tuple[float, float]] | None,
    height: float | str | Sequence[float | str] | None,
) -> "ObjectOptions":
    """Return where objects stand as the command takes it. Raises InputError unless each GLB has a place."""
    from mrbokeh.commands._composite_options import ObjectOptions

    pixels = np.zeros((0, 2)) if at_pixel is None else np.atleast_2d(at_pixel)
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise InputError(f"at_pixel: expected (x, y), or one for each GLB, got {at_pixel!r}")
    heights = [] if height is None else np.atleast_1d(height).tolist()
    if glbs and not len(pixels):
        raise InputError("at_pixel: on which pixel (x, y) does the object stand? Give one for each GLB")
    if len(pixels) != len(glbs) and (glbs or len(pixels) > 1):
        raise InputError(f"at_pixel: expected {f'{len(glbs)}, one for each GLB' if glbs else 'one for all layers'}, got {len(pixels)}")
    if len(heights) not in (0, 1, len(glbs)):
        raise InputError(f"height: expected one for all GLB files, or one for each of {len(glbs)}, got {len(heights)}")
    if heights and not glbs:
        raise InputError("height: layers have theirs in their pixels, only a GLB takes one: leave it out")
    at_pixels = [f"{x_px},{y_px}" for x_px, y_px in pixels.tolist()]
    return ObjectOptions(object_=glbs, at_pixel=at_pixels, height=[str(each) for each in heights])


def _rgb(given: np.ndarray | File, name: str) -> Rgb:
    rgb = read_picture(given) if isinstance(given, (str, Path)) else np.asarray(given)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype.kind != "f" or not rgb.size:
        raise InputError(
            f"{name}: expected linear light as floats of shape (height, width, 3), got {rgb.dtype} {rgb.shape}: read files with "
            f"mrbokeh.read_picture"
        )
    if not np.isfinite(rgb).all():
        raise InputError(f"{name}: expected numbers, but {int((~np.isfinite(rgb)).any(axis=2).sum())} pixels are NaN or infinite")
    return np.ascontiguousarray(rgb, np.float32)


def _depth_of(given: np.ndarray | File, *, with_holes: bool) -> Plane:
    from mrbokeh.images.image_io import doubt_metres, read_depth

    if isinstance(given, (str, Path)):
        return read_depth(given, with_holes=with_holes)
    depth_m = np.asarray(given)
    depth_m = depth_m.astype(np.float32) if depth_m.dtype.kind in "fiu" else np.zeros(0, np.float32)
    if depth_m.ndim != 2 or (np.isnan(depth_m).any() and not with_holes):
        raise InputError(f"depth_m: expected metres of shape (height, width), inf where nothing is, got shape {depth_m.shape} or NaN in it")
    if not (depth_m > 0).any():
        raise InputError("depth_m: expected metres above 0 somewhere, but no pixel has any")
    doubt_metres("depth_m", depth_m)
    return np.where((depth_m > 0) | np.isnan(depth_m), depth_m, np.float32(np.inf))


def _optics(lens: Lens | File | None, renderer: File | Renderer | None) -> tuple[Lens | None, Renderer]:
    """Return lens and renderer as `lens_and_renderer` does; a Lens that was read brings its renderer too."""
    from mrbokeh.renderers.choose import lens_and_renderer, read_lens

    if not isinstance(lens, (Lens, str, Path, NoneType)):
        raise InputError(f"lens: expected a mrbokeh.Lens or the path of a lens file or bank, got {type(lens).__name__}")
    if not isinstance(renderer, (Renderer, str, Path, NoneType)):
        raise InputError(
            f"renderer: expected its name, a mrbokeh renderer, or the path of a network or bank, got {type(renderer).__name__}"
        )
    path = lens.spread_by if isinstance(lens, Lens) else None if lens is None else Path(lens)
    if isinstance(renderer, Renderer):
        read, spreads = None if path is None or isinstance(lens, Lens) else read_lens(path), renderer
    else:
        read, spreads = lens_and_renderer(path, None if renderer is None else str(renderer))
    return lens if isinstance(lens, Lens) else read, spreads


def _focused(lens: Lens, focus: float | tuple[float, float] | None, depth_m: Plane) -> Lens:
    if focus is None:
        return lens
    numbers = focus_in_numbers(focus)
    return lens.focused_at(*numbers) if len(numbers) == 1 else lens.focused_on(depth_m, numbers[0] + 0.5, numbers[1] + 0.5)


def focus_in_numbers(focus: object) -> list[float]:
    """Return a distance as one number, a pixel as two; InputError for what is neither."""
    given = focus if isinstance(focus, tuple) else (focus,)
    try:
        numbers = [float(each) for each in given]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != 1 + isinstance(focus, tuple):
        raise InputError(f"focus: expected metres, or the pixel to focus on as a tuple (x, y), got {focus!r}")
    return numbers
