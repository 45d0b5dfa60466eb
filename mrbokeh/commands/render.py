"""`mrbokeh render`: blur a picture with depth, or layers, as a lens does."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.commands._former_names import formerly
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.choose import DEFAULT
from mrbokeh.system.errors import InputError

app = typer.Typer(add_completion=False)


@app.command(cls=formerly("focus_distance_m"))
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
    psf: Annotated[
        Path | None, typer.Option(help="Bank of PSFs in place of the opening, for polygon, low-rank, laplacian, scatter.")
    ] = None,
    focus_distance_m: Annotated[
        float | None, typer.Option("--focus", help="Focus distance in metres in place of the lens file's; inf is allowed.")
    ] = None,
    focus_at: Annotated[str | None, typer.Option(help="Focus on pixel X,Y, or on what lies within R pixels of it: X,Y,R.")] = None,
    srgb: Annotated[bool, typer.Option("--srgb", help="--rgb holds integers encoded as sRGB (highlights are lost).")] = False,
    alpha_out: Annotated[bool, typer.Option("--alpha-out", help="Write A, Z and all extra channels of the layers beside R, G, B.")] = False,
    slices: Annotated[int, typer.Option(help="How many slices of depth at most.", min=1)] = 16,
    threads: Annotated[int, typer.Option(help="Threads; 0 takes all cores. The result does not depend on it.", min=0)] = 0,
    device: Annotated[
        str, typer.Option(help="cuda, cuda:1 or cpu: --method laplacian or lrdm by torch there; without it compiled loops on the CPU.")
    ] = "",
    overwrite: Annotated[bool, typer.Option(help="Replace OUT where it exists.")] = False,
) -> None:
    """Blur a picture with depth, or layers, as a lens does. Layers lie in front of the picture.

    Example: mrbokeh render --rgb aif.exr --depth z.exr --lens lens.json --focus-at 640,360 --out blurred.exr
    """
    from mrbokeh.commands._render_inputs import Sources, focused, read_sharp, reconstructed
    from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix
    from mrbokeh.layering.layering import Layering
    from mrbokeh.optics.lens_file import read_lens
    from mrbokeh.renderers.choose import chosen_renderer
    from mrbokeh.system.atomic_files import require_safe_outputs
    from mrbokeh.system.console import working

    require_suffix(out, (".exr", *INTEGER_SUFFIXES), "--out")
    require_safe_outputs((out,), (lens, rgb, depth, motion, samples, *(layer or ()), *(behind or ())), overwrite)
    if alpha_out and out.suffix.lower() != ".exr":
        raise InputError(f"--alpha-out needs an .exr to write to, got {out}")
    sources = Sources(rgb, depth, tuple(layer or ()), tuple(behind or ()), motion, shutter, srgb)
    sharp = {} if samples is not None else read_sharp(sources)
    used = read_lens(lens) if samples is not None else focused(read_lens(lens), sharp, focus_distance_m, focus_at)
    if samples is not None and (sources.are_given or focus_distance_m is not None or focus_at is not None):
        raise InputError("--samples holds all there is to see, with its focus and its motion: leave out pictures, layers, motion and focus")
    with working("rendering (the first time on a machine it takes a minute to compile)"):
        renderer = chosen_renderer(method, psf, threads=threads, layering=Layering(slices=slices), device=device)
        blurred = renderer.render(list(sharp.values()), used) if samples is None else reconstructed(renderer, method, samples, used)
    _write(out, blurred, alpha_out)
    typer.echo(f"wrote {out}")


def _write(out: Path, blurred: Layer, alpha_out: bool) -> None:
    from mrbokeh.images.image_io import write_image, write_layer

    if alpha_out:
        write_layer(out, blurred)
    else:
        write_image(out, blurred.rgb)
