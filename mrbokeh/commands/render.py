"""`mrbokeh render`: blur layers as a lens does."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.errors import InputError

app = typer.Typer(add_completion=False)


@app.command()
def render(
    layers: Annotated[list[Path], typer.Argument(help="EXR layers with R, G, B, A (premultiplied) and Z in metres; front first.")],
    lens: Annotated[Path, typer.Option(help="Lens file (LENS.json), see `mrbokeh lens new`.")],
    out: Annotated[Path, typer.Option(help="Where the blurred layer goes: .exr keeps alpha; .png, .tif and .jpg lie over black.")],
    renderer: Annotated[str, typer.Option(help="reference, or the path of a trained network (.onnx).")] = "reference",
    focus: Annotated[float | None, typer.Option(help="Focus distance in metres in place of the lens file's.")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace OUT where it exists.")] = False,
) -> None:
    """Blur layers as a lens does.

    Example: mrbokeh render object.exr --lens lens.json --focus 0.8 --out blurred.exr
    """
    from mrbokeh.atomic_files import refuse_existing
    from mrbokeh.image_io import read_layer, write_image, write_layer
    from mrbokeh.lens_file import read_lens
    from mrbokeh.renderers.choose import make_renderer

    refuse_existing(out, overwrite)
    sharp = [read_layer(path) for path in layers]
    if len({layer.alpha.shape for layer in sharp}) > 1:
        raise InputError(
            "the layers differ in size: " + ", ".join(f"{p} {s.width_px}x{s.height_px}" for p, s in zip(layers, sharp, strict=True))
        )
    used = read_lens(lens) if focus is None else read_lens(lens).focused_at(focus)
    blurred = make_renderer(renderer).render(sharp, used)
    if out.suffix.lower() == ".exr":
        write_layer(out, blurred)
    else:
        write_image(out, blurred.rgb)
    typer.echo(f"wrote {out}")
