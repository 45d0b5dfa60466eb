"""`mrbokeh render`: blur a picture with depth, or layers, as a lens does."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.commands._insertion_options import ANY_LENS, ANY_RENDERER, LensFacts
from mrbokeh.commands._option_groups import grouped
from mrbokeh.commands._render_inputs import FocusOptions, SharpOptions
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.choose import DEFAULT
from mrbokeh.system.channel import tell
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from mrbokeh.optics.lens import Lens
    from mrbokeh.renderers.base import Renderer

app = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class BlurOptions:
    """Renderer and its settings."""

    method: Annotated[str | None, typer.Option("--renderer", help=f"lrdm, {ANY_RENDERER}")] = None
    slices: Annotated[int | None, typer.Option(help="How many slices of depth at most, where depth is sliced. Default: 16.", min=1)] = None
    rank: Annotated[
        int | None,
        typer.Option(
            help="With low-rank: at most so many separable terms a kernel, where it has 11 px or more. Default: as 10 % of error ask.",
            min=1,
            max=512,
        ),
    ] = None
    two_passes: Annotated[
        bool, typer.Option("--two-passes", help="With low-rank: McGraw's own two passes, whose width changes from pixel to pixel.")
    ] = False
    threads: Annotated[int, typer.Option(help="Threads; 0 takes all cores. The result does not depend on it.", min=0, max=4096)] = 0
    device: Annotated[
        str,
        typer.Option(help="cuda, cuda:1 or cpu: polygon, laplacian or lrdm by torch there; without it compiled loops on the CPU."),
    ] = ""

    def renderer_of(self, lens: Path | None) -> "tuple[Lens | None, Renderer]":
        """Return lens and renderer of --lens and these options. Raises InputError for an option that the renderer does not have."""
        from mrbokeh.layering.layering import Layering
        from mrbokeh.renderers.choose import lens_and_renderer

        layering = Layering() if self.slices is None else Layering(slices=self.slices)
        held, renderer = lens_and_renderer(lens, self.method, threads=self.threads, layering=layering, device=self.device)
        if self.slices is not None and not hasattr(renderer, "layering"):
            raise InputError("--slices is for renderers that cut depth into slices, and this one does not: leave it out")
        if self.rank is None and not self.two_passes:
            return held, renderer
        from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter

        if not isinstance(renderer, LowRankFilter):
            raise InputError("--rank and --two-passes are of --renderer low-rank: give that too, or leave them out")
        if renderer.bank is not None and self.rank is not None:
            raise InputError("--rank is of an opening; the terms of a bank are kept beside it: leave --rank out, or give LENS.json")
        told = renderer if self.rank is None else replace(renderer, relative_error=0.0, max_rank=self.rank)
        return held, replace(told, per_pixel=self.two_passes)


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
    from mrbokeh.renderers.choose import spreads_light
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
    held, renderer = blur.renderer_of(lens)
    method = blur.method or (str(lens) if spreads_light(lens) else DEFAULT)
    # A network brings its lens.
    used = focused(facts.on(getattr(renderer, "lens", None) if held is None else held), sharp, focus)
    with working("rendering"):
        if given.samples is None:
            blurred = renderer.render(list(sharp.values()), used)
        else:
            blurred = reconstructed(renderer, method, given.samples, used)
    _write(out, blurred, (given.layer or ()) if result.alpha_out else None)
    own_lens = given.samples is not None or method.endswith(".onnx")
    tell(f"wrote {out}" + ("" if own_lens else f" ({used.described})"), known={} if own_lens else used.facts, method=method)


def _write(out: Path, blurred: Layer, layers: Sequence[Path] | None) -> None:
    """Write the picture alone, or, with the files of the layers that it was made of, all channels."""
    from mrbokeh.images.alpha_io import write_finished
    from mrbokeh.images.image_io import write_layer
    from mrbokeh.stacks.exr_layers.cryptomatte import cryptomatte_among

    if layers is not None:
        write_layer(out, blurred, objects=cryptomatte_among(layers))
    else:
        write_finished(out, blurred.rgb)
