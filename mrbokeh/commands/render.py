"""`mrbokeh render`: blur a picture with depth and motion, or layers, as a lens does."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mrbokeh.commands._insertion_options import (
    ANY_LENS,
    ANY_RENDERER,
    DisparityOption,
    ExactDepthOption,
    FocusAtOption,
    LensFacts,
    focused_at_pixel,
    in_degrees,
    near_far_of,
    require_one_focus,
)
from mrbokeh.commands._option_groups import grouped
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.renderers.choose import DEFAULT
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import tell, warn

app = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class SharpOptions:
    """Pictures, layers or samples to blur."""

    rgb: Annotated[Path | None, typer.Option(help="All-in-focus picture, scene-linear: .exr, .hdr or float .tif.")] = None
    depth: Annotated[
        Path | None,
        typer.Option(help="Its depth in metres: EXR channel Z, depth.Z or Y (inf or <= 0: background), array (.npz, .npy), or one number."),
    ] = None
    disparity: DisparityOption = None
    exact_depth: ExactDepthOption = False
    layer: Annotated[list[Path] | None, typer.Option(help="EXR layer with premultiplied RGBA and Z; repeat it, front first.")] = None
    behind: Annotated[
        list[Path] | None, typer.Option(help="EXR layer behind --rgb: what is known of what it hides (clean plate, other view).")
    ] = None
    motion: Annotated[
        Path | None, typer.Option(help="EXR with forward.u and forward.v: how far --rgb moves right and up, in pixels of one frame.")
    ] = None
    shutter: Annotated[float, typer.Option(min=0.0, max=360.0, callback=in_degrees, help="Shutter angle: 360 is open all the time.")] = (
        180.0
    )
    samples: Annotated[
        Path | None, typer.Option(help="Noisy light field samples (.npz, .exr) in place of pictures, for --renderer lrdm or laplacian.")
    ] = None
    srgb: Annotated[bool, typer.Option("--srgb", help="--rgb holds integers encoded as sRGB (highlights are lost).")] = False

    @property
    def files(self) -> tuple[Path | None, ...]:
        """Input files of these options."""
        return (self.rgb, self.depth, self.motion, self.samples, *(self.layer or ()), *(self.behind or ()))

    @property
    def shows_pictures(self) -> bool:
        """Whether there are pictures, layers or motion to blur beside samples."""
        return any((self.rgb, self.depth, self.layer, self.behind, self.motion))


@dataclass(frozen=True)
class FocusOptions:
    """Focus in place of the lens file's."""

    focus_distance_m: Annotated[
        float | None, typer.Option("--focus", help="Focus distance in metres in place of the lens file's; inf is allowed.")
    ] = None
    focus_at: FocusAtOption = None

    @property
    def is_given(self) -> bool:
        return self.focus_distance_m is not None or self.focus_at is not None


def reconstructed(renderer: Renderer, method: str, samples: Path, lens: Lens) -> Layer:
    """A picture from noisy samples, by a renderer that takes them."""
    from mrbokeh.layering.light_field_samples import read_samples

    if not hasattr(renderer, "reconstruct"):
        raise InputError(f"--samples are for --renderer lrdm or laplacian, got --renderer {method}")
    return renderer.reconstruct(read_samples(samples), lens)


def focused(lens: Lens, sharp: dict[str, Layer], focus: FocusOptions) -> Lens:
    """Return the lens at the distance that was asked for, or focused on what is frontmost at a pixel."""
    require_one_focus(focus=focus.focus_distance_m, focus_at=focus.focus_at)
    if focus.focus_distance_m is not None:
        return lens.focused_at(focus.focus_distance_m)
    if focus.focus_at is None:
        return lens
    return focused_at_pixel(lens, flatten(list(sharp.values())).depth_m, focus.focus_at)


def read_sharp(sources: SharpOptions) -> dict[str, Layer]:
    """Layers by the file that they came from, front first, all with the same extra channels, motion among them."""
    return _with_all_extras(_moving(_read(sources), sources))


def _read(sources: SharpOptions) -> dict[str, Layer]:
    from mrbokeh.depth.open_depth import one_distance_m

    rgb, depth = sources.rgb, sources.depth
    near_far_m = near_far_of(sources.disparity, None if rgb is None or depth is None or one_distance_m(depth) else depth)
    sharp = {str(path): _whole_layer(path) for path in sources.layer or ()}
    if (rgb is None) != (depth is None):
        raise InputError("--rgb and --depth belong together: give both, or only --layer")
    if rgb is not None and depth is not None:
        sharp[str(rgb)] = _picture(rgb, depth, near_far_m, sources)
    if sources.behind and rgb is None:
        raise InputError("--behind is for what lies behind --rgb: without a picture list all layers with --layer, front first")
    sharp |= {str(path): _whole_layer(path) for path in sources.behind or ()}
    if not sharp:
        raise InputError("nothing to blur: give --rgb AIF.exr with --depth Z.exr, or --layer RGBAZ.exr, or both")
    if len({each.alpha.shape for each in sharp.values()}) > 1:
        raise InputError("what is to be blurred differs in size: " + ", ".join(f"{p} {s.width_px}x{s.height_px}" for p, s in sharp.items()))
    return sharp


def _whole_layer(path: Path) -> Layer:
    """Read a layer as `composite` does, which refuses one without depth, with all other channels but those of Cryptomatte."""
    from mrbokeh.stacks.exr_layers.cryptomatte import carried_cryptomatte
    from mrbokeh.stacks.exr_layers.render_channels import RenderChannels, joined, layer_of

    render, objects = RenderChannels.read(path), carried_cryptomatte(path)
    layer, name = layer_of(render), render.colour_layer()
    taken = {*(joined(name, each) for each in "RGBA"), render.depth_name(name), *(objects.channels if objects else ())}
    others = sorted((render.channels.keys() & set(render.stored)) - taken)
    return replace(layer, extra={each: render.plane(each).astype(np.float32)[..., None] for each in others})


def _picture(rgb: Path, depth: Path, near_far_m: tuple[float, float] | None, sources: SharpOptions) -> Layer:
    from mrbokeh.depth.mended_depth import mended_aloud
    from mrbokeh.depth.open_depth import depth_of_file, one_distance_m
    from mrbokeh.images.alpha_io import read_alpha
    from mrbokeh.images.image_io import read_image, read_linear
    from mrbokeh.images.layer import opaque

    linear_or = "develop the RAW file to EXR first, or say with --srgb that it is sRGB if that is all there is"
    colour = read_image(rgb) if sources.srgb else read_linear(rgb, linear_or)
    if read_alpha(rgb) is not None:
        warn(f"{rgb} has holes (alpha below 1), which --rgb fills with black: give what has holes by --layer")
    if distance_m := one_distance_m(depth):
        return opaque(colour, np.full(colour.shape[:2], distance_m, np.float32))
    depth_m = depth_of_file(depth, near_far_m, with_holes=not sources.exact_depth)
    if colour.shape[:2] != depth_m.shape:
        sizes = f"{rgb} is {colour.shape[1]}x{colour.shape[0]} px, {depth} {depth_m.shape[1]}x{depth_m.shape[0]} px"
        raise InputError(f"picture and depth must be of one size, but {sizes}: resize the depth with its nearest pixels, not between them")
    return opaque(colour, depth_m if sources.exact_depth else mended_aloud(depth_m, colour))


def _moving(sharp: dict[str, Layer], sources: SharpOptions) -> dict[str, Layer]:
    """Add motion: of the picture from its own file, of layers from their channels forward.u and forward.v."""
    from mrbokeh.layering.motion import with_motion
    from mrbokeh.stacks.exr_layers.render_channels import read_motion, taken_from_channels

    if sources.motion is not None and sources.rgb is None:
        raise InputError("--motion belongs to --rgb: layers have their motion in their own channels forward.u and forward.v")
    moving = {path: taken_from_channels(each, sources.shutter / 360.0) for path, each in sharp.items()}
    if sources.motion is not None:
        moving[str(sources.rgb)] = with_motion(moving[str(sources.rgb)], read_motion(sources.motion), sources.shutter / 360.0)
    return moving


def _with_all_extras(sharp: dict[str, Layer]) -> dict[str, Layer]:
    """Every layer with the extra channels of all, 0 where a layer has none of that name."""
    shapes = {name: values.shape for each in sharp.values() for name, values in each.extra.items()}
    return {
        path: replace(each, extra={name: each.extra.get(name, np.zeros(shapes[name], np.float32)) for name in sorted(shapes)})
        for path, each in sharp.items()
    }


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
