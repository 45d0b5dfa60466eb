"""`mrbokeh render`: blur a picture with depth, or layers, as a lens does."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.commands._insertion_options import ANY_LENS, ANY_RENDERER, LensFacts
from mrbokeh.commands._option_groups import grouped
from mrbokeh.commands._render_inputs import FocusOptions, SharpOptions
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.choose import DEFAULT
from mrbokeh.system.channel import tell
from mrbokeh.system.errors import InputError

app = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class BlurOptions:
    """Renderer and its settings."""

    method: Annotated[str | None, typer.Option("--renderer", help=f"lrdm, {ANY_RENDERER}")] = None
    slices: Annotated[int, typer.Option(help="How many slices of depth at most.", min=1)] = 16
    threads: Annotated[int, typer.Option(help="Threads; 0 takes all cores. The result does not depend on it.", min=0, max=4096)] = 0
    device: Annotated[
        str, typer.Option(help="cuda, cuda:1 or cpu: --renderer laplacian or lrdm by torch there; without it compiled loops on the CPU.")
    ] = ""


@dataclass(frozen=True)
class ResultOptions:
    """Channels and replacement of OUT."""

    alpha_out: Annotated[bool, typer.Option("--alpha-out", help="Write A, Z and all extra channels of the layers beside R, G, B.")] = False
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")] = False


@app.command()
@grouped
def render(
    out: Annotated[Path, typer.Option(help="Where the result goes: .exr, or .png, .tif, .jpg (over black).")],
    given: SharpOptions,
    blur: BlurOptions,
    facts: LensFacts,
    focus: FocusOptions,
    result: ResultOptions,
    lens: Annotated[Path | None, typer.Option(help=f"{ANY_LENS}. Default: 50 mm f/1.8, focused at infinity.")] = None,
) -> None:
    """Blur a picture with depth, or layers, as a lens does. Layers lie in front of the picture.

    Example: mrbokeh render --rgb aif.exr --depth z.exr --lens lens.json --focus-at 640,360 --out blurred.exr

    Example: mrbokeh render --rgb aif.exr --depth z.exr --focal-length 85 --f-number 1.4 --focus 2 --out portrait.png
    """
    from mrbokeh.commands._render_inputs import focused, read_sharp, reconstructed
    from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix
    from mrbokeh.layering.layering import Layering
    from mrbokeh.renderers.choose import lens_and_renderer, spreads_light
    from mrbokeh.system.atomic_files import require_safe_outputs
    from mrbokeh.system.console import working

    require_suffix(out, (".exr", *INTEGER_SUFFIXES), "--out")
    require_safe_outputs((out,), (lens, *given.files), result.overwrite)
    if result.alpha_out and out.suffix.lower() != ".exr":
        raise InputError(f"--alpha-out needs an .exr to write to, got {out}: write .exr, or leave --alpha-out out")
    if given.samples is not None and (given.shows_pictures or focus.is_given):
        raise InputError("--samples holds all there is to see, with its focus and its motion: leave out pictures, layers, motion and focus")
    sharp = {} if given.samples is not None else read_sharp(given)
    if given.samples is not None and facts.given:
        raise InputError("--samples hold the blur of their own lens: leave --focal-length, --f-number and --sensor-width out")
    layering = Layering(slices=blur.slices)
    held, renderer = lens_and_renderer(lens, blur.method, threads=blur.threads, layering=layering, device=blur.device)
    method = blur.method or (str(lens) if spreads_light(lens) else DEFAULT)
    # A network brings its lens.
    used = focused(facts.on(getattr(renderer, "lens", None) if held is None else held), sharp, focus)
    with working("rendering"):
        if given.samples is None:
            blurred = renderer.render(list(sharp.values()), used)
        else:
            blurred = reconstructed(renderer, method, given.samples, used)
    _write(out, blurred, result.alpha_out)
    own_lens = given.samples is not None or method.endswith(".onnx")
    tell(f"wrote {out}" + ("" if own_lens else f" ({used.described})"), known={} if own_lens else used.facts, method=method)


def _write(out: Path, blurred: Layer, alpha_out: bool) -> None:
    from mrbokeh.images.image_io import write_image, write_layer

    if alpha_out:
        write_layer(out, blurred)
    else:
        write_image(out, blurred.rgb)
