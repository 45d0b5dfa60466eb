"""`mrbokeh lens match`: the lens of one photograph from its out-of-focus lights."""

from pathlib import Path
from typing import Annotated

import typer

from mrbokeh.system.errors import InputError

_SIDES = {"behind": 1, "front": -1}


def match(
    photo: Annotated[Path, typer.Argument(help="A photograph with out-of-focus lights: JPEG, TIFF, PNG, WebP, EXR or HDR.")],
    out: Annotated[Path, typer.Option(help="The lens file to write, e.g. lens.json.")],
    evidence: Annotated[Path | None, typer.Option(help="A picture to write of what was found (.png, .pdf or .svg).")] = None,
    side: Annotated[str, typer.Option(help="Where the lights are: behind the focus, or in front.")] = "behind",
    depth_m: Annotated[float | None, typer.Option(help="Depth of the lights in metres; inf is allowed.")] = None,
    focus_distance_m: Annotated[
        float | None, typer.Option("--focus", help="Focus distance from the lens in metres (else of the metadata).")
    ] = None,
    focal_length_mm: Annotated[float | None, typer.Option("--focal-length", help="Focal length in mm (else of the metadata).")] = None,
    f_number: Annotated[float | None, typer.Option(help="Stated f-number (else of the metadata).")] = None,
    sensor_width_mm: Annotated[float | None, typer.Option("--sensor-width", help="Sensor width in mm (else of the metadata).")] = None,
    encoding: Annotated[str, typer.Option(help="What integers of the file mean: srgb or linear.")] = "srgb",
    overwrite: Annotated[bool, typer.Option(help="Replace OUT and EVIDENCE where they exist.")] = False,
) -> None:
    """Estimate a lens from the discs that out-of-focus lights make in a photograph, and from its metadata.

    Blades, their curvature and rotation, squeeze, cat-eye, bright or soft rims; and, where the depth of the lights is given, the focus
    distance, or the effective f-number where that is known too. Discs that look like no iris give a drawn outline.

    Example: mrbokeh lens match night.jpg --out lens.json --evidence lens.png
    """
    from mrbokeh.images.image_io import ENCODED_SUFFIXES, read_image
    from mrbokeh.lens_measuring.matching.lens_match import match_lens
    from mrbokeh.lens_measuring.matching.match_report import as_text, draw_match, table_of
    from mrbokeh.lens_measuring.matching.photo_facts import read_facts
    from mrbokeh.optics.lens_file import write_lens
    from mrbokeh.system.atomic_files import atomic_path, refuse_existing

    _check(side, encoding, evidence)
    for path in (out, *([evidence] if evidence else [])):
        refuse_existing(path, overwrite)
    rgb = read_image(photo, "linear" if encoding == "linear" else "srgb")
    facts = read_facts(photo, (rgb.shape[1], rgb.shape[0])).given(
        focal_length_mm=focal_length_mm, f_number=f_number, sensor_width_mm=sensor_width_mm, focus_distance_m=focus_distance_m
    )
    facts.require(photo)
    largest = 1.0 if photo.suffix.lower() in ENCODED_SUFFIXES else float("inf")
    found = match_lens(rgb, facts, side=_SIDES[side], depth_m=depth_m, largest_value=largest)
    write_lens(out, found.lens)
    typer.echo(as_text(table_of(found)))
    if evidence:
        with atomic_path(evidence) as temporary:
            draw_match(rgb, found).savefig(temporary, dpi=110)
    typer.echo(f"wrote {out}" + (f" and {evidence}" if evidence else ""))


def _check(side: str, encoding: str, evidence: Path | None) -> None:
    if side not in _SIDES:
        raise InputError(f"expected --side behind or front, got {side!r}")
    if encoding not in ("srgb", "linear"):
        raise InputError(f"expected --encoding srgb or linear, got {encoding!r}")
    if evidence and evidence.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise InputError(f"cannot draw {evidence}: expected .png, .pdf or .svg")
