"""`mrbokeh lens show` and `mrbokeh lens export`: pictures of lens files and of banks of PSFs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from mrbokeh.system.errors import InputError


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
