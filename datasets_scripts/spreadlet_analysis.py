"""Fig. 10 and the ablation of Leimkuehler et al. 2018 for our spreadlets, in numbers and drawn.

    python -m datasets_scripts.spreadlet_analysis OUT [--largest 128 --kernels 80 --parts codes,ablation]

OUT/parts/PART.json holds the numbers, OUT/spreadlet_analysis.png all parts that are there. Finished parts are kept, so an
interrupted run goes on where it stopped.
"""

from pathlib import Path
from typing import Annotated

import typer

from datasets_scripts.psf_corpus import Corpus
from datasets_scripts.spreadlet_drawing import draw_parts
from datasets_scripts.spreadlet_parts import PARTS
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError

_SLOW = {"ablation": 3, "sample_counts": 2}
"""Parts that take a share of the kernels: annealing tries 400 sets of points for each."""


def analyse(out: Path, parts: list[str], largest_px: float, count: int, seed: int) -> int:
    """Compute the parts that are missing and draw all that are there; returns how many were computed."""
    if unknown := [name for name in parts if name not in PARTS]:
        raise InputError(f"expected parts out of {', '.join(PARTS)}, got {', '.join(unknown)}")
    settings = {"largest_px": largest_px, "kernels": count, "seed": seed}
    waiting = [name for name in parts if not _is_there(out, name, settings)]
    for name in waiting:
        corpus = Corpus(largest_px, max(1, count // _SLOW.get(name, 1)), seed)
        write_json(_path(out, name), {"settings": settings, "found": PARTS[name](corpus)})
    there = {name: read_json(_path(out, name), "a part of the analysis")["found"] for name in PARTS if _path(out, name).is_file()}
    draw_parts(there, out / "spreadlet_analysis.png")
    return len(waiting)


def _is_there(out: Path, name: str, settings: dict) -> bool:
    if not _path(out, name).is_file():
        return False
    if read_json(_path(out, name), "a part of the analysis")["settings"] != settings:
        raise InputError(f"{_path(out, name)} was made with other settings: choose another folder, or remove it")
    return True


def _path(out: Path, name: str) -> Path:
    return out / "parts" / f"{name}.json"


def main(
    out: Annotated[Path, typer.Argument(help="Folder for numbers and the drawing.")],
    parts: Annotated[str, typer.Option(help="With commas between them; all unless given.")] = ",".join(PARTS),
    largest: Annotated[float, typer.Option(help="Largest diameter and motion in pixels; 256 in the paper.")] = 128.0,
    kernels: Annotated[int, typer.Option(help="How many kernels are drawn from the bank of 392.")] = 80,
    seed: int = 0,
) -> None:
    """Compute the missing parts and draw them."""
    try:
        made = analyse(out, parts.split(","), largest, kernels, seed)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out / 'spreadlet_analysis.png'}: {made} parts computed")


if __name__ == "__main__":
    typer.run(main)
