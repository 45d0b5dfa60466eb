"""`mrbokeh lens`: make, inspect and draw lens files."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.errors import InputError

app = typer.Typer(add_completion=False, no_args_is_help=True, help="Make, inspect and draw lens files.")


@app.command()
def new(
    out: Annotated[Path, typer.Argument(help="The lens file to write, e.g. lens.json.")],
    focal_length: Annotated[float, typer.Option(help="Focal length in mm.")],
    f_number: Annotated[float, typer.Option(help="f-number.")],
    focus: Annotated[float, typer.Option(help="Focus distance from the lens in metres; inf is allowed.")],
    sensor_width: Annotated[float, typer.Option(help="Sensor width in mm (36 for full frame, 23.5 for APS-C).")] = 36.0,
    blades: Annotated[int, typer.Option(help="Blades of the iris; 0 is a round opening.")] = 0,
    rotation: Annotated[float, typer.Option(help="Rotation of the blades in degrees.")] = 0.0,
    overwrite: Annotated[bool, typer.Option(help="Replace the file where it exists.")] = False,
) -> None:
    """Write a lens file.

    Example: mrbokeh lens new lens.json --focal-length 50 --f-number 1.8 --focus 0.8 --blades 7
    """
    import math

    from mrbokeh.aperture import Aperture
    from mrbokeh.atomic_files import refuse_existing
    from mrbokeh.lens import Lens
    from mrbokeh.lens_file import write_lens

    refuse_existing(out, overwrite)
    aperture = Aperture.blades(blades, math.radians(rotation)) if blades else Aperture.disc()
    write_lens(out, Lens(focal_length, f_number, focus, sensor_width, aperture))
    typer.echo(f"wrote {out}")


@app.command()
def coc(
    lens: Annotated[Path, typer.Argument(help="Lens file.")],
    depths: Annotated[list[float], typer.Argument(help="Depths in metres.")],
    width: Annotated[int, typer.Option(help="Image width in pixels.")] = 1920,
) -> None:
    """Print the circle of confusion (diameter, pixels; negative in front of the focus) at some depths.

    Example: mrbokeh lens coc lens.json 0.5 1 2 inf --width 1920
    """
    from mrbokeh.lens_file import read_lens

    if min(depths) <= 0:
        raise InputError(f"depths must be positive metres, got {depths}")
    read = read_lens(lens)
    for depth_m in depths:
        typer.echo(f"{depth_m:g} m: {float(read.coc_px(depth_m, width)):+.2f} px")


@app.command()
def show(
    lens: Annotated[Path, typer.Argument(help="Lens file.")],
    out: Annotated[Path, typer.Option(help="The picture to write (.png, .pdf or .svg).")],
    width: Annotated[int, typer.Option(help="Image width in pixels.")] = 1920,
    overwrite: Annotated[bool, typer.Option(help="Replace OUT where it exists.")] = False,
) -> None:
    """Draw the blur of a lens: its kernels behind and in front of the focus, and the circle of confusion over depth.

    Example: mrbokeh lens show lens.json --out lens.png
    """
    from mrbokeh.atomic_files import atomic_path, refuse_existing
    from mrbokeh.lens_drawing import draw_lens
    from mrbokeh.lens_file import read_lens

    refuse_existing(out, overwrite)
    figure = draw_lens(read_lens(lens), width)
    with atomic_path(out) as temporary:
        figure.savefig(temporary, dpi=150)
    typer.echo(f"wrote {out}")
