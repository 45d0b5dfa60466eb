"""Public bokeh sets that are on disk already, as data sets of focal stacks that `mrbokeh train fit` and `train evaluate` read.

    python -m datasets_scripts.public_datasets ebb SOURCE OUT --depth MAPS --near-m 0.5 --far-m 20 [--crop 1024x768]

Nothing is downloaded. Kinds: ebb, dpdd, aperture (pairs of photographs: give depth maps), realbokeh (gives focal length, f-number and
focus distance; give depth maps), blb (complete). Stacks that are finished are kept, so an interrupted run goes on where it stopped.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from datasets_scripts.public_sets.adapters import (
    APERTURE_LENS,
    BLB_LENS,
    DPDD_LENS,
    EBB_LENS,
    REALBOKEH_LENS,
    PublicLens,
    PublicStack,
    aperture_stacks,
    blb_stacks,
    dpdd_stacks,
    ebb_stacks,
    realbokeh_stacks,
)
from datasets_scripts.public_sets.conversion import Conversion, DepthMaps, convert
from mrbokeh.stacks.focal_stack_dataset import FILE_NAME
from mrbokeh.system.errors import InputError

_ASK = "No licence text is known to this project: ask the authors before any use beyond research, and do not pass the pictures on."


@dataclass(frozen=True)
class Kind:
    """A public set. stacks: the adapter. lens: what the set says about its lens. licence: a note for the manifest."""

    stacks: Callable[[Path], list[PublicStack]]
    lens: PublicLens
    licence: str


KINDS = {
    "ebb": Kind(ebb_stacks, EBB_LENS, f"EBB! (Ignatov, Patel, Timofte, CVPRW 2020). {_ASK}"),
    "blb": Kind(blb_stacks, BLB_LENS, f"BLB (Peng et al., BokehMe, CVPR 2022). {_ASK}"),
    "aperture": Kind(aperture_stacks, APERTURE_LENS, f"Pictures by aperture, from whoever took them. {_ASK}"),
    "dpdd": Kind(dpdd_stacks, DPDD_LENS, f"DPDD (Abuolaim and Brown, ECCV 2020). {_ASK}"),
    "realbokeh": Kind(
        realbokeh_stacks, REALBOKEH_LENS, "RealBokeh (Seizinger et al., ICCV 2025): CC BY-NC-SA 4.0, not for commercial use."
    ),
}


def main(
    kind: Annotated[str, typer.Argument(help=f"One of {', '.join(KINDS)}.")],
    source: Annotated[Path, typer.Argument(help="Folder of the set.")],
    out: Annotated[Path, typer.Argument(help="Folder for the data set.")],
    depth: Annotated[
        Path | None, typer.Option(help="Folder of depth maps, named as the sharp pictures: metres (EXR), disparity (PNG).")
    ] = None,
    near_m: Annotated[float | None, typer.Option(help="Depth of white in maps of disparity.")] = None,
    far_m: Annotated[float | None, typer.Option(help="Depth of black in maps of disparity.")] = None,
    focus_m: Annotated[
        float | None, typer.Option(help="Focus distance where the set has none; left out, it is found picture by picture.")
    ] = None,
    focal_length_mm: Annotated[float | None, typer.Option(help="Of the lens, in place of what is known about the set.")] = None,
    f_number: Annotated[float | None, typer.Option(help="The same.")] = None,
    sensor_width_mm: Annotated[float | None, typer.Option(help="The same.")] = None,
    crop: Annotated[str, typer.Option(help="WIDTHxHEIGHT of the middle, where pictures differ in size.")] = "",
    only: Annotated[int, typer.Option(help="The first so many stacks; 0: all.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a finished set.")] = False,
) -> None:
    """Convert a public set."""
    try:
        if kind not in KINDS:
            raise InputError(f"expected a kind out of {', '.join(KINDS)}, got {kind!r}")
        if (out / FILE_NAME).exists() and not overwrite:
            raise InputError(f"{out / FILE_NAME} exists already: give another folder, or --overwrite to write it again")
        chosen = KINDS[kind]
        given = {"focal_length_mm": focal_length_mm, "f_number": f_number, "sensor_width_mm": sensor_width_mm}
        lens = replace(chosen.lens, **{name: value for name, value in given.items() if value is not None})
        conversion = Conversion(
            kind=kind, lens=lens, licence=chosen.licence, depth=DepthMaps(depth, near_m, far_m), focus_m=focus_m, crop_px=crop_of(crop)
        )
        dataset = convert(chosen.stacks(source)[: only or None], out, conversion, overwrite=overwrite)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: {len(dataset.stacks)} stacks, largest circle of confusion {dataset.largest_coc_px:.1f} px. {chosen.licence}")


def crop_of(text: str) -> tuple[int, int] | None:
    """Return (width, height) of "1024x768", None of an empty text."""
    if not text:
        return None
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None:
        raise InputError(f"expected --crop as WIDTHxHEIGHT such as 1024x768, got {text!r}")
    return int(found[1]), int(found[2])


if __name__ == "__main__":
    typer.run(main)
