"""`mrbokeh render`: blur a picture with depth, or layers, as a lens does."""

from pathlib import Path
from typing import Annotated, Any

import typer

from mrbokeh.errors import InputError
from mrbokeh.layer import Layer
from mrbokeh.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import DEFAULT, make_renderer

app = typer.Typer(add_completion=False)


@app.command()
def render(
    lens: Annotated[Path, typer.Option(help="Lens file (LENS.json), see `mrbokeh lens new`.")],
    out: Annotated[Path, typer.Option(help="Where the result goes: .exr, or .png, .tif, .jpg (over black).")],
    rgb: Annotated[Path | None, typer.Option(help="All-in-focus picture, scene-linear: .exr, .hdr or float .tif.")] = None,
    depth: Annotated[Path | None, typer.Option(help="Its depth: EXR channel Z, depth.Z or Y in metres; inf or <= 0: background.")] = None,
    layer: Annotated[list[Path] | None, typer.Option(help="EXR layer with premultiplied RGBA and Z; repeat it, front first.")] = None,
    behind: Annotated[
        list[Path] | None, typer.Option(help="EXR layer behind --rgb: what is known of what it hides (clean plate, other view).")
    ] = None,
    motion: Annotated[
        Path | None, typer.Option(help="EXR with forward.u and forward.v: how far --rgb moves right and up, in pixels of one frame.")
    ] = None,
    shutter: Annotated[
        float, typer.Option(help="Part of the frame's time for which the shutter is open: 0.5 is 180 degrees.", min=0.0)
    ] = 0.5,
    samples: Annotated[
        Path | None, typer.Option(help="Noisy light field samples (.npz, .exr) in place of pictures, for --method lrdm or laplacian.")
    ] = None,
    method: Annotated[
        str, typer.Option("--method", "--renderer", help="polygon, low-rank, laplacian, lrdm, scatter (exact, slow), or a network (.onnx).")
    ] = DEFAULT,
    psf: Annotated[Path | None, typer.Option(help="Bank of PSFs in place of the lens's opening, for --method laplacian.")] = None,
    focus_distance_m: Annotated[float | None, typer.Option(help="Focus distance in place of the lens file's; inf is allowed.")] = None,
    focus_at: Annotated[str | None, typer.Option(help="Focus on pixel X,Y, or on what lies within R pixels of it: X,Y,R.")] = None,
    srgb: Annotated[bool, typer.Option("--srgb", help="--rgb holds integers encoded as sRGB (highlights are lost).")] = False,
    alpha_out: Annotated[bool, typer.Option("--alpha-out", help="Write A, Z and all extra channels of the layers beside R, G, B.")] = False,
    slices: Annotated[int, typer.Option(help="How many slices of depth at most.", min=1)] = 16,
    threads: Annotated[int, typer.Option(help="Threads; 0 takes all cores. The result does not depend on it.", min=0)] = 0,
    overwrite: Annotated[bool, typer.Option(help="Replace OUT where it exists.")] = False,
) -> None:
    """Blur a picture with depth, or layers, as a lens does. Layers lie in front of the picture.

    Example: mrbokeh render --rgb aif.exr --depth z.exr --lens lens.json --focus-at 640,360 --out blurred.exr
    """
    from mrbokeh.atomic_files import refuse_existing
    from mrbokeh.image_io import write_image, write_layer
    from mrbokeh.layering import Layering
    from mrbokeh.lens_file import read_lens
    from mrbokeh.progress import working

    refuse_existing(out, overwrite)
    if alpha_out and out.suffix.lower() != ".exr":
        raise InputError(f"--alpha-out needs an .exr to write to, got {out}")
    given = [rgb, depth, *(layer or []), *(behind or []), motion, focus_distance_m, focus_at]
    sharp = {} if samples is not None else _moving(_read(rgb, depth, layer or [], behind or [], srgb), rgb, motion, shutter)
    used = read_lens(lens) if samples is not None else _focused(read_lens(lens), sharp, focus_distance_m, focus_at)
    if samples is not None and any(each is not None for each in given):
        raise InputError("--samples holds all there is to see, with its focus and its motion: leave out pictures, layers, motion and focus")
    with working("rendering (the first time on a machine it takes a minute to compile)"):
        renderer = _renderer(method, psf, threads=threads, layering=Layering(slices=slices))
        blurred = renderer.render(list(sharp.values()), used) if samples is None else _reconstructed(renderer, method, samples, used)
    if alpha_out:
        write_layer(out, blurred)
    else:
        write_image(out, blurred.rgb)
    typer.echo(f"wrote {out}")


def _renderer(method: str, psf: Path | None, **settings: Any) -> Renderer:
    if psf is None:
        return make_renderer(method, **settings)
    if method != "laplacian":
        raise InputError(f"--psf is for --method laplacian, got --method {method}: other methods take the opening of the lens file")
    from mrbokeh.psf_bank_file import read_bank
    from mrbokeh.renderers.laplacian_spreadlets import LaplacianSpreadlets

    return LaplacianSpreadlets(bank=read_bank(psf), **settings)


def _reconstructed(renderer: Renderer, method: str, samples: Path, lens: Lens) -> Layer:
    from mrbokeh.light_field_samples_file import read_samples

    if not hasattr(renderer, "reconstruct"):
        raise InputError(f"--samples are for --method lrdm or laplacian, got --method {method}")
    return renderer.reconstruct(read_samples(samples), lens)


def _read(rgb: Path | None, depth: Path | None, layers: list[Path], behind: list[Path], srgb: bool) -> dict[str, Layer]:
    """What to blur by where it came from, front first."""
    from mrbokeh.image_io import read_layer

    sharp = {str(path): read_layer(path, extra=True) for path in layers}
    if (rgb is None) != (depth is None):
        raise InputError("--rgb and --depth belong together: give both, or only --layer")
    if rgb is not None and depth is not None:
        sharp[str(rgb)] = _picture(rgb, depth, srgb)
    if behind and rgb is None:
        raise InputError("--behind is for what lies behind --rgb: without a picture list all layers with --layer, front first")
    sharp |= {str(path): read_layer(path, extra=True) for path in behind}
    if not sharp:
        raise InputError("nothing to blur: give --rgb AIF.exr with --depth Z.exr, or --layer RGBAZ.exr, or both")
    if len({each.alpha.shape for each in sharp.values()}) > 1:
        raise InputError("what is to be blurred differs in size: " + ", ".join(f"{p} {s.width_px}x{s.height_px}" for p, s in sharp.items()))
    return sharp


def _picture(rgb: Path, depth: Path, srgb: bool) -> Layer:
    from mrbokeh.image_io import read_depth, read_image, read_linear
    from mrbokeh.layer import opaque

    colour, depth_m = read_image(rgb) if srgb else read_linear(rgb), read_depth(depth)
    if colour.shape[:2] != depth_m.shape:
        sizes = f"{rgb} is {colour.shape[1]}x{colour.shape[0]} px, {depth} {depth_m.shape[1]}x{depth_m.shape[0]} px"
        raise InputError(f"picture and depth must be of one size, but {sizes}: resize the depth with its nearest pixels, not between them")
    return opaque(colour, depth_m)


def _with_all_extras(sharp: dict[str, Layer]) -> dict[str, Layer]:
    """Every layer with the extra channels of all, 0 where a layer has none of that name."""
    from dataclasses import replace

    import numpy as np

    shapes = {name: values.shape for each in sharp.values() for name, values in each.extra.items()}
    return {
        path: replace(each, extra={name: each.extra.get(name, np.zeros(shapes[name], np.float32)) for name in sorted(shapes)})
        for path, each in sharp.items()
    }


def _moving(sharp: dict[str, Layer], rgb: Path | None, motion: Path | None, shutter: float) -> dict[str, Layer]:
    """With motion: of the picture from its own file, of layers from their channels forward.u and forward.v."""
    from mrbokeh.motion import with_motion
    from mrbokeh.motion_file import read_motion, taken_from_channels

    if motion is not None and rgb is None:
        raise InputError("--motion belongs to --rgb: layers have their motion in their own channels forward.u and forward.v")
    moving = {path: taken_from_channels(each, shutter) for path, each in sharp.items()}
    if motion is not None:
        moving[str(rgb)] = with_motion(moving[str(rgb)], read_motion(motion), shutter)
    return _with_all_extras(moving)


def _focused(lens: Lens, sharp: dict[str, Layer], focus_distance_m: float | None, focus_at: str | None) -> Lens:
    """The lens at the distance that was asked for, or focused on what is frontmost at a pixel."""
    if focus_distance_m is not None and focus_at is not None:
        raise InputError("give either --focus-distance-m or --focus-at, not both")
    if focus_distance_m is not None:
        return lens.focused_at(focus_distance_m)
    if focus_at is None:
        return lens
    from mrbokeh.layer import flatten

    try:
        x_px, y_px, radius_px = (*map(int, focus_at.split(",")), 0)[:3]
    except ValueError:
        raise InputError(f"--focus-at: expected X,Y or X,Y,RADIUS in whole pixels, got {focus_at!r}") from None
    return lens.focused_on(flatten(list(sharp.values())).depth_m, x_px + 0.5, y_px + 0.5, float(radius_px))
