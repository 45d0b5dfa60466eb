"""`mrbokeh lens`: make, inspect and draw lens files and banks of PSFs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from mrbokeh.commands._option_groups import grouped
from mrbokeh.commands.lens_fit import fit, match
from mrbokeh.commands.lens_psf import psf, spreadlets
from mrbokeh.system.errors import InputError

app = typer.Typer(add_completion=False, no_args_is_help=True, help="Make, inspect and draw lens files and banks of PSFs.")

SHAPES = {
    "disc": (),
    "polygon": ("blades", "curvature"),
    "ring": ("inner",),
    "star": ("blades", "inner"),
    "heart": (),
    "image": ("image", "levels"),
    "outline": ("path",),
}
"""What each shape of an aperture is made from, in the words of the lens file."""

NO_COLOUR = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class OpticsOptions:
    """Focal length, f-number, focus, sensor and field of the lens."""

    focal_length: Annotated[float, typer.Option(help="Focal length in mm.")]
    f_number: Annotated[float, typer.Option(help="f-number.")]
    focus: Annotated[float, typer.Option(help="Focus distance from the lens in metres; inf is allowed.")]
    sensor_width: Annotated[
        float,
        typer.Option(help="Width in mm of the sensor with the camera held level: 36 for full frame, 23.5 for APS-C."),
    ] = 36.0
    sensor_height: Annotated[
        float | None, typer.Option(help="Its height in mm, where the lens is described for upright pictures: 24 by 36.")
    ] = None
    tilt: Annotated[tuple[float, float], typer.Option(help="Tilt of the lens to the right and downwards in degrees.")] = (0.0, 0.0)
    petzval_radius: Annotated[float, typer.Option(help="Radius of the curved field in mm; inf is flat.")] = float("inf")


@dataclass(frozen=True)
class OpeningOptions:
    """Shape of the opening."""

    shape: Annotated[
        str, typer.Option(help=f"Shape of the opening: {', '.join(SHAPES)}. (disc where none is given, polygon where --blades is.)")
    ] = ""
    blades: Annotated[int, typer.Option(help="Blades of the iris, or points of a star; 0 is a round opening.")] = 0
    curvature: Annotated[float, typer.Option(help="Curvature of the blades: 0 straight, 1 round, negative inwards.")] = 0.0
    inner: Annotated[float | None, typer.Option(help="Inner share of the radius of a ring or star, 0 to 1.")] = None
    image: Annotated[Path | None, typer.Option(help="Picture of the opening, light where open (shape image).")] = None
    levels: Annotated[int, typer.Option(help="Steps of grey in that picture; 1 is open or closed.")] = 1
    path: Annotated[str | None, typer.Option(help="d attribute of an SVG path (shape outline).")] = None

    def described(self) -> dict[str, Any]:
        """Return the shape with its parameters, in the words of the lens file. Raises InputError if the shape has no use for an option."""
        parts = {"blades": self.blades or None, "curvature": self.curvature or None, "inner": self.inner, "path": self.path}
        parts |= {"image": None if self.image is None else str(self.image), "levels": None if self.levels == 1 else self.levels}
        given = {key: value for key, value in parts.items() if value is not None}
        shape = self.shape or ("polygon" if "blades" in given else "disc")
        if shape not in SHAPES:
            raise InputError(f"expected --shape out of {', '.join(SHAPES)}, got {shape!r}")
        if stray := [f"--{key}" for key in given if key not in SHAPES[shape]]:
            fits = ", ".join(name for name, keys in SHAPES.items() if all(key in keys for key in given)) or "no shape"
            raise InputError(f"{', '.join(stray)} does nothing for the shape {shape}: choose another --shape ({fits} takes what was given)")
        return {"shape": shape, **given}


@dataclass(frozen=True)
class AberrationOptions:
    """Rotation, squeeze and aberrations of the opening."""

    rotation: Annotated[float, typer.Option(help="Rotation of the opening in degrees.")] = 0.0
    squeeze: Annotated[float, typer.Option(help="Anamorphic squeeze, e.g. 1.33 or 2; 1 is none.")] = 1.0
    cat_eye: Annotated[float, typer.Option(help="How far the rim is off the pupil in the corner, in pupil radii.")] = 0.0
    spherical_aberration: Annotated[float, typer.Option(help="-1 to 1; positive: bright rims behind the focus.")] = 0.0
    axial_chromatic: Annotated[tuple[float, float, float], typer.Option(help="Change of blur size of R G B behind the focus.")] = NO_COLOUR
    lateral_chromatic: Annotated[tuple[float, float, float], typer.Option(help="Displacement of the blur of R G B.")] = NO_COLOUR


@app.command()
@grouped
def new(
    out: Annotated[Path, typer.Argument(help="The lens file to write, e.g. lens.json.")],
    optics: OpticsOptions,
    opening: OpeningOptions,
    aberrations: AberrationOptions,
    overwrite: Annotated[bool, typer.Option(help="Replace the file where it exists.")] = False,
) -> None:
    """Write a lens file.

    Example: mrbokeh lens new lens.json --focal-length 50 --f-number 1.8 --focus 0.8 --blades 7 --curvature 0.3
    """
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.optics.lens_file import lens_from_json, write_lens
    from mrbokeh.system.atomic_files import refuse_existing

    require_suffix(out, (".json",), "LENS")
    refuse_existing(out, overwrite)
    document = {
        "focal_length_mm": optics.focal_length,
        "f_number": optics.f_number,
        "focus_distance_m": optics.focus,
        "sensor_width_mm": optics.sensor_width,
        "sensor_height_mm": optics.sensor_height,
        "tilt_deg": list(optics.tilt),
        "petzval_radius_mm": optics.petzval_radius,
        "aperture": {
            **opening.described(),
            "rotation_deg": aberrations.rotation,
            "squeeze": aberrations.squeeze,
            "cat_eye": aberrations.cat_eye,
            "spherical_aberration": aberrations.spherical_aberration,
            "axial_chromatic": list(aberrations.axial_chromatic),
            "lateral_chromatic": list(aberrations.lateral_chromatic),
        },
    }
    write_lens(out, lens_from_json(document, "the new lens"))
    typer.echo(f"wrote {out}")


@app.command()
def coc(
    lens: Annotated[Path, typer.Argument(help="Lens file.")],
    depths: Annotated[list[float], typer.Argument(help="Depths in metres.")],
    width: Annotated[int, typer.Option("--image-width", help="Image width in pixels.")] = 1920,
) -> None:
    """Print the circle of confusion (diameter, pixels; negative in front of the focus) at some depths, on the axis.

    Example: mrbokeh lens coc lens.json 0.5 1 2 inf --image-width 1920
    """
    from mrbokeh.optics.lens_file import read_lens

    if not min(depths) > 0:
        raise InputError(f"expected depths above 0 in metres, got {depths}")
    read = read_lens(lens)
    for depth_m in depths:
        typer.echo(f"{depth_m:g} m: {float(read.coc_px(depth_m, width)):+.2f} px")


def show(
    lens: Annotated[Path, typer.Argument(help="Lens file, or the folder of a bank of PSFs.")],
    out: Annotated[Path, typer.Option(help="The picture to write (.png, .pdf or .svg).")],
    width: Annotated[int, typer.Option("--image-width", min=16, help="Image width in pixels (of a lens file).")] = 1920,
    overwrite: Annotated[bool, typer.Option(help="Replace OUT where it exists.")] = False,
) -> None:
    """Draw the blur of a lens: its kernels over diameter and field, its outlines and low-rank error, and blur over depth.

    Of a bank of PSFs: kernels over its coordinates, its cells, and their size or the light that they pass.

    Example: mrbokeh lens show lens.json --out lens.png
    """
    from mrbokeh.system.atomic_files import atomic_path, refuse_existing
    from mrbokeh.system.console import working

    if lens.suffix.lower() == ".onnx":
        raise InputError(f"expected a lens file or a bank of PSFs to draw, got the network {lens}: `mrbokeh train evaluate` shows it")
    if out.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise InputError(f"cannot draw {out}: expected .png, .pdf or .svg")
    refuse_existing(out, overwrite)
    with working("drawing (the first time on a machine it takes a minute to compile)"):
        figure = _drawn_bank(lens) if lens.is_dir() else _drawn_lens(lens, width)
    with atomic_path(out) as temporary:
        figure.savefig(temporary, dpi=150)
    typer.echo(f"wrote {out}")


def _drawn_lens(path: Path, width_px: int) -> Any:
    from mrbokeh.figures.lens_drawing import draw_lens
    from mrbokeh.optics.lens_file import read_lens

    return draw_lens(read_lens(path), width_px)


def _drawn_bank(folder: Path) -> Any:
    from mrbokeh.figures.psf_bank_drawing import draw_bank
    from mrbokeh.optics.psf_bank_file import read_bank

    return draw_bank(read_bank(folder))


def export(
    bank: Annotated[Path, typer.Argument(help="The folder of a bank of PSFs.")],
    out: Annotated[Path, typer.Option(help="The folder to write: one picture per kernel, and index.csv with their coordinates.")],
    format_: Annotated[str, typer.Option("--format", help="exr (float, as they are) or png (16 bit, linear, the peak white).")] = "exr",
    overwrite: Annotated[bool, typer.Option(help="Write into OUT where it exists.")] = False,
) -> None:
    """Write the kernels of a bank as pictures, for a convolution in Nuke, OpenDefocus or Blender.

    Example: mrbokeh lens export combined_bank --out kernels --format exr
    """
    from mrbokeh.figures.psf_bank_drawing import export_bank
    from mrbokeh.optics.psf_bank_file import read_bank

    if format_ not in ("exr", "png"):
        raise InputError(f"kernels are exported as exr or png, got --format {format_}")
    written = export_bank(read_bank(bank), out, "png" if format_ == "png" else "exr", overwrite)
    typer.echo(f"wrote {written} kernels and {out / 'index.csv'}")


app.command()(psf)
app.command()(spreadlets)
app.command()(show)
app.command()(export)
app.command()(fit)
app.command()(match)
