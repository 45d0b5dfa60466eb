"""`mrbokeh tilt-shift`: a photograph blurred away from a line, as by a tilted lens, or by a map that somebody drew; it needs no depth."""

import math
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float32

from mrbokeh.system.console import working
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, tell, warn
from mrbokeh.system.typed_numbers import pixels_in

_USUAL_SHARE, _WIDEST_SHARE = 0.03, 0.5
"""Largest circle, in widths of the picture, where none is told; and the widest that is taken for meant."""

_LINE = "--along expects two pixels X,Y with a colon between, such as 0,1500:4000,1350"

Pixel = tuple[float, float]

app = typer.Typer(add_completion=False)


@app.command("tilt-shift")
def tilt_shift_command(
    photo: Annotated[Path, typer.Argument(help="A photograph, sharp all over.")],
    out: Annotated[Path, typer.Option(help="The blurred picture: PNG, TIFF, JPEG or EXR.")],
    along: Annotated[
        str | None,
        typer.Option(metavar="X,Y:X,Y", help="Two pixels of the line that stays sharp. Default: level, through the middle."),
    ] = None,
    map_: Annotated[
        Path | None, typer.Option("--map", help="Picture of the blur instead of a line: black stays sharp, white is blurred by --diameter.")
    ] = None,
    diameter: Annotated[
        float | None,
        typer.Option(help="Largest circle of confusion in px: in the corner farthest from the line. Default: 3 % of the width."),
    ] = None,
    lens: Annotated[Path | None, typer.Option(help="LENS.json whose opening blurs. Default: round.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")] = False,
) -> None:
    """Blur a photograph away from a line, so that a street looks like a model of it.

    Example: mrbokeh tilt-shift street.jpg --along 0,1500:4000,1350 --out model.jpg

    Example: mrbokeh tilt-shift street.jpg --map drawn.png --diameter 60 --lens bladed.json --out model.png
    """
    from mrbokeh.images.alpha_io import read_alpha
    from mrbokeh.images.carried_exif import carry_exif
    from mrbokeh.images.exif import stored_orientation, upright
    from mrbokeh.images.image_io import INTEGER_SUFFIXES, read_image, require_suffix, write_image
    from mrbokeh.optics.aperture import Aperture
    from mrbokeh.optics.lens_file import read_lens
    from mrbokeh.renderers.low_rank.low_rank_filter import tilt_shift
    from mrbokeh.stacks.photograph import read_photograph
    from mrbokeh.system.atomic_files import require_safe_outputs

    require_suffix(out, (".exr", *INTEGER_SUFFIXES), "--out")
    require_safe_outputs((out,), (photo, map_, lens), overwrite)
    if along is not None and map_ is not None:
        raise InputError("--along and --map both say where the picture stays sharp: give one of them")
    opening = Aperture.disc() if lens is None else read_lens(lens).aperture.seen(+1)
    photograph = read_photograph(photo)
    rgb = photograph.rgb
    if read_alpha(photo, photograph.orientation) is not None:
        warn(f"{photo} is transparent in places, which the result is not: black shows there")
    height_px, width_px = rgb.shape[:2]
    largest_px = _USUAL_SHARE * width_px if diameter is None else diameter
    if not 0.0 < largest_px <= _WIDEST_SHARE * width_px:
        raise InputError(f"expected --diameter above 0 and up to half the width of {width_px} px, got {largest_px:g}: choose another")
    if diameter is None:
        guess(f"the largest circle of confusion is {largest_px:.0f} px (--diameter PX)")
    if map_ is not None:
        told = upright(read_image(map_, "linear")[..., 1], stored_orientation(map_))
        if told.shape != (height_px, width_px):
            raise InputError(f"the map {map_} has {told.shape[1]}x{told.shape[0]} px, but {photo} {width_px}x{height_px}: resize it")
        coc_px = np.clip(told, np.float32(0.0), np.float32(1.0)) * np.float32(largest_px)
    else:
        level = ((0.0, height_px / 2), (float(width_px), height_px / 2))
        one, other = level if along is None else pixels_in(along, _LINE, 2)
        coc_px = blur_beside((one, other), (width_px, height_px), largest_px)
    with working("blurring"):
        blurred = tilt_shift(rgb, coc_px, opening)
    write_image(out, blurred)
    carry_exif(photo, out, (width_px, height_px))
    tell(f"wrote {out} (blurred by up to {np.abs(coc_px).max():.0f} px)")


def blur_beside(line: tuple[Pixel, Pixel], size_px: tuple[int, int], largest_px: float) -> Float32[np.ndarray, "height width"]:
    """Return diameters (H, W) in px that grow evenly with the distance from a line, to the largest in the corner farthest from it.

    They are positive, as of what is far, above the line, and negative below: a tilted lens has one plane in focus, which the ground
    crosses in that line. Raises InputError for a line without a direction.
    """
    (x0, y0), (x1, y1) = sorted(line)
    length = math.dist((x0, y0), (x1, y1))
    if length < 1.0:
        raise InputError(f"expected --along through two pixels, got {x0:g},{y0:g}:{x1:g},{y1:g}: take two that lie apart")
    width_px, height_px = size_px
    y, x = np.mgrid[:height_px, :width_px].astype(np.float32) + np.float32(0.5)
    beside = ((x - x0) * (y1 - y0) - (y - y0) * (x1 - x0)) / length
    return (beside * (largest_px / np.abs(beside).max())).astype(np.float32)
