"""`mrbokeh lens psf` and `mrbokeh lens spreadlets`: banks of point spread functions, and what a renderer splats of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from mrbokeh.psf_models.build import ModelOptions


@dataclass(frozen=True)
class BankOptions:
    """Options of the models; None leaves a model's default."""

    lens: Annotated[Path | None, typer.Option(help="Lens file whose opening is used (model simple; a disc without).")] = None
    image: Annotated[Path | None, typer.Option(help="The picture of a PSF (model stylized).")] = None
    diameter_px: Annotated[
        float | None, typer.Option("--diameter", help="Largest circle of confusion in px (simple, combined, stylized).")
    ] = None
    motion_px: Annotated[float | None, typer.Option("--motion", help="Longest motion in px per shutter (combined).")] = None
    prescription: Annotated[Path | None, typer.Option(help="A .dat file of lens surfaces (model physical; a bi-convex lens without).")] = (
        None
    )
    focus_distance_m: Annotated[
        float | None, typer.Option("--focus", help="Where the lens is focused in metres, inf is allowed (physical; else 2 m).")
    ] = None
    f_number: Annotated[float | None, typer.Option(help="Closes the iris to this f-number (physical; open without).")] = None
    sensor_width_mm: Annotated[float | None, typer.Option("--sensor-width", help="Sensor width in mm (physical; else 36).")] = None
    sensor_height_mm: Annotated[
        float | None, typer.Option("--sensor-height", help="Sensor height in mm (physical; else two thirds of the width).")
    ] = None
    image_width_px: Annotated[
        int | None, typer.Option("--image-width", help="Width in px of the pictures to blur (physical; else 1024).")
    ] = None
    nearest_m: Annotated[float | None, typer.Option("--near", help="Nearest depth of the bank in metres (physical; else 0.5).")] = None
    farthest_m: Annotated[
        float | None, typer.Option("--far", help="Farthest depth of the bank in metres (physical: else 100; volume: else 5).")
    ] = None
    vignetting: Annotated[
        bool | None,
        typer.Option("--vignetting/--no-vignetting", help="Whether kernels darken off the axis (physical; else they do)."),
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
        return ModelOptions(**vars(self) | {"counts": counts, "device": self.device or None})


@dataclass(frozen=True)
class BuildOptions:
    """Rays and replacement of the bank."""

    rays: Annotated[int | None, typer.Option(help="Rays per kernel; 0 takes the closed form. (What suits the model where not given.)")] = (
        None
    )
    seed: Annotated[int, typer.Option(help="Seed of the rays.")] = 0
    overwrite: Annotated[bool, typer.Option(help="Replace the bank where it exists.")] = False


@grouped
def psf(
    model: Annotated[str, typer.Argument(help="simple, combined (defocus and motion), physical, volume or stylized.")],
    out: Annotated[Path, typer.Option(help="The folder of the bank; a half-built one is completed.")],
    made: BankOptions,
    work: BuildOptions,
) -> None:
    """Build a bank of point spread functions. An interrupted build goes on when the same command is given again.

    Example: mrbokeh lens psf combined --out combined_bank --diameter 128 --motion 128

    Example: mrbokeh lens psf physical --prescription dgauss.50mm.dat --focus 1.5 --f-number 2.8 --sensor-width 23.5
    --image-width 1920 --counts 40,40 --out double_gauss
    """
    from mrbokeh.psf_models.build import build_bank, choose_model
    from mrbokeh.system.console import kept_when_interrupted

    with kept_when_interrupted(f"finished kernels are kept in {out}", work.overwrite):
        bank = build_bank(choose_model(model, made.parsed()), out, work.rays, work.seed, overwrite=work.overwrite)
    typer.echo(f"wrote {out}: {len(bank.kernels)} kernels of up to {2 * bank.radius_px + 1} px")


def _steps(text: str) -> tuple[int, ...]:
    try:
        steps = tuple(int(part) for part in text.split(","))
    except ValueError:
        steps = (0,)
    if min(steps) < 1:
        raise InputError(f"expected --counts as whole numbers from 1 up with commas between them, such as 75,75, got {text!r}")
    return steps


def spreadlets(
    bank: Annotated[Path, typer.Argument(help="The folder of a bank of PSFs.")],
    points_per_px: Annotated[float, typer.Option(help="Points per pixel of a kernel's outline: more are nearer and slower.")] = 1.0,
    lloyd_steps: Annotated[int, typer.Option(help="Steps of Lloyd's relaxation, as in the paper; 10 % nearer than none.")] = 50,
    annealing_steps: Annotated[int, typer.Option(help="Steps of annealing (the paper: 400; fitted values gain nothing by it).")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of darts and annealing.")] = 0,
    overwrite: Annotated[bool, typer.Option(help="Compute them again where they are.")] = False,
) -> None:
    """Compute what `render --psf BANK` splats (sparse points of the kernels' Laplacians) and keep it in BANK/spreadlets.npz.

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
    typer.echo(f"wrote {bank / SPREADLETS}: {len(made.points)} points of {len(made)} kernels, up to {most} each")
