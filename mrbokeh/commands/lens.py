"""`mrbokeh lens`: make, inspect and draw lens files and banks of PSFs, and what a renderer splats of them."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mrbokeh.commands._option_groups import grouped
from mrbokeh.commands.lens_fit import fit, match
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import tell
from mrbokeh.system.typed_numbers import numbers_in

if TYPE_CHECKING:
    from mrbokeh.psf_models.build import ModelOptions


@dataclass(frozen=True)
class BankOptions:
    """Options of the models; None leaves a model's default."""

    lens: Annotated[Path | None, typer.Option(help="Lens file whose opening is used (model simple; a disc without).")] = None
    image: Annotated[Path | None, typer.Option("--psf-picture", help="The picture of a PSF (model stylized).")] = None
    diameter_px: Annotated[
        float | None, typer.Option("--diameter", max=4096.0, help="Largest circle of confusion in px (simple, combined, stylized).")
    ] = None
    motion_px: Annotated[float | None, typer.Option("--longest-motion", help="Longest motion in px per shutter (combined).")] = None
    prescription: Annotated[
        Path | None, typer.Option(help="A .dat file of lens surfaces, or a name of `lens list` (physical; else a bi-convex lens).")
    ] = None
    focus_distance_m: Annotated[
        float | None, typer.Option("--focus", help="Where the lens is focused in metres, inf is allowed (physical; else 2 m).")
    ] = None
    f_number: Annotated[float | None, typer.Option(help="Closes the iris to this f-number (physical; open without).")] = None
    sensor_width_mm: Annotated[float | None, typer.Option("--sensor-width", help="Sensor width in mm (physical; else 36).")] = None
    sensor_height_mm: Annotated[
        float | None, typer.Option("--sensor-height", help="Sensor height in mm (physical; else two thirds of the width).")
    ] = None
    image_width_px: Annotated[
        int | None, typer.Option("--image-width", min=1, help="Width in px of the pictures to blur (physical; else 1024).")
    ] = None
    nearest_m: Annotated[float | None, typer.Option("--near", help="Nearest depth of the bank in metres (physical; else 0.5).")] = None
    farthest_m: Annotated[
        float | None, typer.Option("--far", help="Farthest depth of the bank in metres (physical: else 100; volume: else 5).")
    ] = None
    vignetting: Annotated[
        bool | None, typer.Option("--no-vignetting", help="Kernels do not darken off the axis (physical; else they do).")
    ] = None
    sharpest: Annotated[
        bool | None,
        typer.Option("--sharpest", help="The sensor is where a point at --focus is smallest, not its paraxial image (physical)."),
    ] = None
    density_per_m: Annotated[float | None, typer.Option(help="Collisions per metre (volume; else 0.9).")] = None
    anisotropy: Annotated[float | None, typer.Option(help="Henyey-Greenstein's g, -1 to 1 (volume; else 0.8).")] = None
    focal_px: Annotated[float | None, typer.Option(help="Focal length of the picture in px (volume; else 1024).")] = None
    counts: Annotated[
        str | None, typer.Option(help="Steps of the grid along each coordinate, e.g. 100 or 75,75 (combined: of the paper's grid).")
    ] = None
    cells: Annotated[int | None, typer.Option(help="At most so many kernels, in proportion to their size (combined; else 400).")] = None
    device: Annotated[
        str, typer.Option(help="cuda, cuda:1 or cpu: rays are traced by torch there; without it by compiled loops on the CPU.")
    ] = ""

    def parsed(self) -> "ModelOptions":
        """Return the options as the models take them. Raises InputError if the steps are no numbers."""
        from mrbokeh.psf_models.build import ModelOptions

        counts = None if self.counts is None else _steps(self.counts)
        return ModelOptions(
            **vars(self)
            | {
                "counts": counts,
                "device": self.device or None,
                "vignetting": False if self.vignetting else None,
            }
        )


@dataclass(frozen=True)
class BuildOptions:
    """Rays and replacement of the bank."""

    rays: Annotated[
        int | None, typer.Option(max=100_000_000, help="Rays per kernel; 0 takes the closed form. (What suits the model where not given.)")
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Seed of the rays.")] = 0
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the bank where it exists.")] = False


@grouped
def psf(
    model: Annotated[str, typer.Argument(help="simple, combined (defocus and motion), physical, volume or stylized.")],
    out: Annotated[Path, typer.Option(help="The folder of the bank; a half-built one is completed.")],
    made: BankOptions,
    work: BuildOptions,
) -> None:
    """Build a bank of point spread functions. An interrupted build goes on when the same command is given again.

    Example: mrbokeh lens psf combined --out combined_bank --diameter 128 --longest-motion 128

    Example: mrbokeh lens psf physical --prescription dgauss.50mm.dat --focus 1.5 --f-number 2.8 --sensor-width 23.5
    --image-width 1920 --counts 40,40 --out double_gauss
    """
    from mrbokeh.psf_models.build import build_bank, choose_model
    from mrbokeh.system.console import kept_when_interrupted

    with kept_when_interrupted(f"finished kernels are kept in {out}", work.overwrite):
        bank = build_bank(choose_model(model, made.parsed()), out, work.rays, work.seed, overwrite=work.overwrite)
    tell(f"wrote {out}: {len(bank.kernels)} kernels of up to {2 * bank.radius_px + 1} px", kernels=len(bank.kernels))


_MOST_STEPS = 1000


def _steps(text: str) -> tuple[int, ...]:
    expected = f"expected --counts as whole numbers from 1 to {_MOST_STEPS} with commas between them, such as 75,75"
    steps = numbers_in(text, expected, number=int)
    if not 1 <= min(steps) <= max(steps) <= _MOST_STEPS:
        raise InputError(f"{expected}, got {text!r}")
    return steps


def spreadlets(
    bank: Annotated[Path, typer.Argument(help="The folder of a bank of PSFs.")],
    points_per_px: Annotated[float, typer.Option(help="Points per pixel of a kernel's outline: more are nearer and slower.")] = 1.0,
    lloyd_steps: Annotated[int, typer.Option(help="Steps of Lloyd's relaxation, as in the paper; 10 % nearer than none.")] = 50,
    annealing_steps: Annotated[int, typer.Option(help="Steps of annealing (the paper: 400; fitted values gain nothing by it).")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of darts and annealing.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Compute them again where they are.")] = False,
) -> None:
    """Compute what `--lens BANK --renderer laplacian` splats (sparse points of the kernels' Laplacians) and keep it in BANK/spreadlets.npz.

    An interrupted run goes on when the same command is given again. When the bank changes, give it once more.

    Example: mrbokeh lens spreadlets combined_bank
    """
    import numpy as np

    from mrbokeh.optics.psf_bank_file import SPREADLETS
    from mrbokeh.renderers.bank.kernel_files import build_spreadlets
    from mrbokeh.renderers.kernels.spreadlets import Sparsification
    from mrbokeh.system.console import kept_when_interrupted

    settings = Sparsification(points_per_px=points_per_px, lloyd_steps=lloyd_steps, annealing_steps=annealing_steps, seed=seed)
    with kept_when_interrupted(f"finished kernels are kept in {bank}", overwrite):
        made = build_spreadlets(bank, settings, overwrite)
    most = int(np.diff(made.starts).max())
    tell(f"wrote {bank / SPREADLETS}: {len(made.points)} points of {len(made)} kernels, up to {most} each", points=len(made.points))


app = typer.Typer(add_completion=False, no_args_is_help=True, help="Make, inspect and draw lens files and banks of PSFs.")


@app.command(name="list")
def list_lenses() -> None:
    """List the lenses of the library, which every --lens takes by name: focal length, widest f-number, what for, patent.

    Example: mrbokeh lens list
    """
    from mrbokeh.optics.lens_library import facts as facts_of
    from mrbokeh.optics.lens_library import names

    lenses = [facts_of(name) for name in names()]
    rows = [(each["name"], f"{each['focal_length_mm']:.0f} mm", f"f/{each['widest_f_number']:.2g}", each["about"]) for each in lenses]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row, facts in zip(rows, lenses, strict=True):
        aligned = "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True))
        tell(f"{aligned}  {facts['inventors']} {facts['year']}, {facts['patent']}")
    tell("Use one as --lens NAME; its traced kernels: mrbokeh lens psf physical --prescription NAME --sharpest --out BANK", lenses=lenses)


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
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file where it exists.")] = False,
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
    tell(f"wrote {out}")


_LEAST_SENSOR_MM, _LARGEST_SENSOR_MM = 2.0, 400.0


@app.command()
def describe(
    prescription: Annotated[Path, typer.Argument(help="A .dat file of lens surfaces, or a name of `lens list`.")],
    out: Annotated[Path, typer.Option(help="The lens file to write, e.g. lens.json.")],
    f_number: Annotated[float | None, typer.Option(help="Widest f-number, where that is not the one of the table's stop.")] = None,
    sensor_width: Annotated[float, typer.Option(help="Width in mm of the sensor with the camera held level.")] = 36.0,
    sensor_height: Annotated[float, typer.Option(help="Its height in mm.")] = 24.0,
    blades: Annotated[int, typer.Option(help="Blades of the iris, which show once it closes; 0 is a round one.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file where it exists.")] = False,
) -> None:
    """Describe a lens by its prescription: rims, bright and soft blur, colours and curved field of traced rays become a lens file.

    Example: mrbokeh lens describe dgauss.50mm.dat --blades 8 --out double_gauss.json
    """
    from mrbokeh.images.image_io import require_suffix
    from mrbokeh.optics.aperture import Aperture
    from mrbokeh.optics.lens_file import write_lens
    from mrbokeh.psf_models.lens_description import describe as described
    from mrbokeh.psf_models.lens_description import held_out_error
    from mrbokeh.psf_models.physical_lens import read_prescription
    from mrbokeh.system.atomic_files import require_safe_outputs
    from mrbokeh.system.console import working

    require_suffix(out, (".json",), "LENS")
    require_safe_outputs((out,), (prescription,), overwrite)
    replace(Aperture.disc(), iris_blades=blades)  # refused here rather than after the work
    for name, size_mm in (("--sensor-width", sensor_width), ("--sensor-height", sensor_height)):
        if not _LEAST_SENSOR_MM <= size_mm <= _LARGEST_SENSOR_MM:
            raise InputError(f"expected {name} from {_LEAST_SENSOR_MM:g} to {_LARGEST_SENSOR_MM:g} mm, got {size_mm:g}: give the sensor's")
    traced = read_prescription(prescription)
    traced = traced if f_number is None else traced.stopped_down(f_number)
    with working("tracing"):
        lens = described(traced, (sensor_width, sensor_height), blades)
        misplaced, by_a_disc = held_out_error(traced, lens)
    write_lens(out, lens)
    tell(
        f"wrote {out}: {lens.focal_length_mm:.4g} mm f/{lens.f_number:.3g}; it misplaces {misplaced:.0%} of a point's light, a round "
        f"opening {by_a_disc:.0%}",
        misplaced=misplaced,
        misplaced_by_a_disc=by_a_disc,
    )


@app.command()
def coc(
    lens: Annotated[Path, typer.Argument(help="Lens file, or a name of `lens list`.")],
    depths: Annotated[list[float], typer.Argument(help="Depths in metres.")],
    width: Annotated[int, typer.Option("--image-width", min=1, help="Image width in pixels.")] = 1920,
) -> None:
    """Print the circle of confusion (diameter, pixels; negative in front of the focus) at some depths, on the axis.

    Example: mrbokeh lens coc lens.json 0.5 1 2 inf --image-width 1920
    """
    from mrbokeh.optics.lens_file import read_lens

    if not min(depths) > 0:
        raise InputError(f"expected depths above 0 in metres, got {depths}")
    read = read_lens(lens)
    coc_px = [float(read.coc_px(depth_m, width)) for depth_m in depths]
    for depth_m, each_px in zip(depths, coc_px, strict=True):
        tell(f"{depth_m:g} m: {each_px:+.2f} px", coc_px=coc_px)


def show(
    lens: Annotated[Path, typer.Argument(help="Lens file, a name of `lens list`, or the folder of a bank of PSFs.")],
    out: Annotated[Path, typer.Option(help="The picture to write (.png, .pdf or .svg).")],
    width: Annotated[int, typer.Option("--image-width", min=16, help="Image width in pixels (of a lens file).")] = 1920,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")] = False,
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
    with working("drawing"):
        figure = _drawn_bank(lens) if lens.is_dir() else _drawn_lens(lens, width)
    with atomic_path(out) as temporary:
        figure.savefig(temporary, dpi=150)
    tell(f"wrote {out}")


def _drawn_lens(path: Path, width_px: int) -> Any:
    from mrbokeh.figures.psf_bank_drawing import draw_lens
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
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write into OUT where it exists.")] = False,
) -> None:
    """Write the kernels of a bank as pictures, for a convolution in Nuke, OpenDefocus or Blender.

    Example: mrbokeh lens export combined_bank --out kernels --format exr
    """
    from mrbokeh.figures.psf_bank_drawing import export_bank
    from mrbokeh.optics.psf_bank_file import read_bank

    if format_ not in ("exr", "png"):
        raise InputError(f"kernels are exported as exr or png, got --format {format_}")
    written = export_bank(read_bank(bank), out, "png" if format_ == "png" else "exr", overwrite)
    tell(f"wrote {written} kernels and {out / 'index.csv'}", kernels=written)


app.command()(psf)
app.command()(spreadlets)
app.command()(show)
app.command()(export)
app.command()(fit)
app.command()(match)
