"""`mrbokeh lens fit` and `mrbokeh lens match`: lenses measured in focal stacks, in pictures of points of light, and in one photograph."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mrbokeh.commands._option_groups import grouped
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, tell
from mrbokeh.system.typed_numbers import numbers_in

if TYPE_CHECKING:
    from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair
    from mrbokeh.lens_measuring.fitting.lens_fit import FitSettings, LensFit
    from mrbokeh.lens_measuring.fitting.point_lights import PointLight
    from mrbokeh.optics.psf_bank import PsfBank
    from mrbokeh.stacks.focal_stack import FocalStack

RINGS = 4
_SIDES = {"behind": 1, "front": -1}


@dataclass(frozen=True)
class LightOptions:
    """Place of the lights, and meaning of the file's integers."""

    side: Annotated[str, typer.Option(help="Where the lights are: behind the focus, or in front.")] = "behind"
    depth_m: Annotated[float | None, typer.Option("--light-distance", help="Depth of the lights in metres; inf is allowed.")] = None
    linear: Annotated[bool, typer.Option("--linear", help="Integers of the file are linear, not encoded as sRGB.")] = False


@dataclass(frozen=True)
class StatedOptions:
    """Facts in place of the photograph's metadata."""

    focus_distance_m: Annotated[
        float | None, typer.Option("--focus", help="Focus distance from the lens in metres (else of the metadata).")
    ] = None
    focal_length_mm: Annotated[float | None, typer.Option("--focal-length", help="Focal length in mm (else of the metadata).")] = None
    f_number: Annotated[float | None, typer.Option(help="Stated f-number (else of the metadata).")] = None
    sensor_width_mm: Annotated[float | None, typer.Option("--sensor-width", help="Sensor width in mm (else of the metadata).")] = None


@dataclass(frozen=True)
class MatchResultOptions:
    """Picture beside OUT, and replacement."""

    evidence: Annotated[Path | None, typer.Option(help="A picture to write of what was found (.png, .pdf or .svg).")] = None
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT and EVIDENCE where they exist.")] = False


@grouped
def match(
    photo: Annotated[Path, typer.Argument(help="A photograph with out-of-focus lights: RAW, JPEG, TIFF, PNG, WebP, HEIC, EXR or HDR.")],
    out: Annotated[Path, typer.Option(help="The lens file to write, e.g. lens.json.")],
    result: MatchResultOptions,
    lights: LightOptions,
    stated: StatedOptions,
) -> None:
    """Estimate a lens from the discs that out-of-focus lights make in a photograph, and from its metadata.

    Blades, their curvature and rotation, squeeze, cat-eye, bright or soft rims; and, where the depth of the lights is given, the focus
    distance, or the effective f-number where that is known too. Discs that look like no iris give a drawn outline.

    Example: mrbokeh lens match night.jpg --out lens.json --evidence lens.png
    """
    from mrbokeh.images.image_io import ENCODED_SUFFIXES, read_image
    from mrbokeh.lens_measuring.matching.lens_match import match_lens
    from mrbokeh.lens_measuring.matching.match_report import as_text, draw_match, table_of
    from mrbokeh.lens_measuring.matching.photo_facts import PhotoFacts, read_facts
    from mrbokeh.optics.lens_file import write_lens
    from mrbokeh.stacks.photograph import full_value, is_raw, read_photograph
    from mrbokeh.system.atomic_files import atomic_path, refuse_existing

    _check_match(lights, result)
    for path in (out, *([result.evidence] if result.evidence else [])):
        refuse_existing(path, result.overwrite)
    if is_raw(photo):
        developed = read_photograph(photo)
        rgb, largest = developed.rgb, full_value(photo)
        facts = PhotoFacts(**{each.name: getattr(developed, each.name) for each in fields(PhotoFacts)})
    else:
        rgb = read_image(photo, "linear" if lights.linear else "srgb")
        largest = 1.0 if photo.suffix.lower() in ENCODED_SUFFIXES else float("inf")
        facts = read_facts(photo, (rgb.shape[1], rgb.shape[0]))
    facts = facts.given(**vars(stated))
    facts.require(photo)
    found = match_lens(rgb, facts, side=_SIDES[lights.side], depth_m=lights.depth_m, largest_value=largest)
    write_lens(out, found.lens)
    tell(as_text(table_of(found)))
    if result.evidence:
        with atomic_path(result.evidence) as temporary:
            draw_match(rgb, found).savefig(temporary, dpi=110)
    tell(f"wrote {out}" + (f" and {result.evidence}" if result.evidence else ""), lens=found.lens.facts)


def _check_match(lights: LightOptions, result: MatchResultOptions) -> None:
    if lights.side not in _SIDES:
        raise InputError(f"expected --side behind or front, got {lights.side!r}")
    if result.evidence and result.evidence.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise InputError(f"cannot draw {result.evidence}: expected .png, .pdf or .svg")


@dataclass(frozen=True)
class EvidenceOptions:
    """Pictures of points of light."""

    lights: Annotated[list[Path] | None, typer.Option(help="Linear picture of points of light behind the focus, isolated, not full.")] = (
        None
    )
    near_lights: Annotated[list[Path] | None, typer.Option(help="The same in front of the focus.")] = None


@dataclass(frozen=True)
class FittingOptions:
    """Settings of the fit."""

    symmetric: Annotated[bool, typer.Option(help="Kernels depend on eccentricity and turn with the place.")] = False
    regions: Annotated[
        str, typer.Option(help="Columns and rows of the frame that have kernels of their own, e.g. 3x3; 1x1 is one for all.")
    ] = "3x3"
    diameters: Annotated[
        str, typer.Option(help="Diameters in px around which shapes are solved for, e.g. 8,20 (two that suit where not given).")
    ] = ""
    smoothness: Annotated[float, typer.Option(help="More trusts noisy pictures less, and rounds off shapes.")] = 1.0
    pixels: Annotated[int, typer.Option(help="How many pixels of the stacks to use, at most.")] = 120_000
    seed: Annotated[int, typer.Option(min=0, help="Seed of the choice of pixels.")] = 0

    def parsed(self) -> "FitSettings":
        """Return the settings of the fit. Raises InputError if an option is out of range or no number."""
        from mrbokeh.lens_measuring.fitting.lens_fit import FitSettings

        if not self.smoothness > 0.0 or self.pixels < 1:
            raise InputError(f"expected --smoothness above 0 and --pixels from 1 up, got {self.smoothness} and {self.pixels}")
        return FitSettings(
            diameters_px=_diameters(self.diameters),
            regions=_regions(self.regions),
            rings=RINGS if self.symmetric else 0,
            smoothness=self.smoothness,
            pixels=self.pixels,
            seed=self.seed,
        )


@grouped
def fit(
    out: Annotated[Path, typer.Option(help="The folder to write: a bank of PSFs, kernels.png and evidence.png.")],
    evidence: EvidenceOptions,
    fitting: FittingOptions,
    stacks: Annotated[
        list[Path] | None,
        typer.Argument(help="Merged focal stacks, or blur pairs (sharp.exr with coc.px, blurred.exr), or folders of them."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the bank where it exists.")] = False,
) -> None:
    """Measure the kernels of a lens over signed blur, field and colour.

    From merged focal stacks (every blurred pixel tells a little; kernels go by blur in pixels, so that metres need not be known), from
    pairs of an all-in-focus picture with its diameters of blur (sharp.exr: R, G, B and coc.px, signed, NaN unknown) and the blurred
    picture (blurred.exr), from pictures of isolated points of light out of focus (each is its kernel), or from all. Use the bank as
    `--lens LENS`.

    Example: mrbokeh lens fit scene --out my_lens --regions 3x3
    """
    from mrbokeh.lens_measuring.fitting.fit_results import bank_of
    from mrbokeh.lens_measuring.fitting.lens_fit import fit_lens
    from mrbokeh.optics.psf_bank_file import refuse_existing_bank, write_bank
    from mrbokeh.stacks.guessed_metres import is_lens_guessed, metres_notes

    refuse_existing_bank(out, overwrite)
    settings = fitting.parsed()
    found, frame = _lights(evidence)
    given, pairs = _evidence_in(stacks or [])
    if note := metres_notes(given):
        guess(f"{note} (kernels are measured over blur in pixels, which needs no metres)")
    fitted = fit_lens([*given, *pairs], found, settings, frame)
    told = next((stack for stack in given if stack.lens and stack.metres_known and not is_lens_guessed(stack)), None)
    bank = bank_of(fitted, None if told is None else told.lens_of(told.reference))
    write_bank(out, bank, overwrite)
    _draw(out, fitted, bank)
    tell(f"wrote {out}: {len(bank.kernels)} kernels of up to {2 * bank.radius_px + 1} px, {_proof(fitted)}", kernels=len(bank.kernels))


def _evidence_in(folders: list[Path]) -> "tuple[list[FocalStack], list[BlurPair]]":
    """Return the stacks and the pairs in these folders. Raises InputError for a folder that holds neither."""
    from mrbokeh.lens_measuring.fitting.blur_pairs import find_blur_pairs
    from mrbokeh.stacks.focal_stack import FILE_NAME, find_focal_stacks

    pairs = {folder: find_blur_pairs(folder) for folder in folders}
    with_stacks = [folder for folder in folders if not pairs[folder] or any(folder.rglob(FILE_NAME))]
    return [stack for folder in with_stacks for stack in find_focal_stacks(folder)], [pair for found in pairs.values() for pair in found]


def _lights(evidence: EvidenceOptions) -> "tuple[list[PointLight], tuple[int, int] | None]":
    """Return the points of light of all frames, and the size of the frames."""
    from mrbokeh.images.image_io import read_linear
    from mrbokeh.lens_measuring.fitting.point_lights import find_lights

    found, size = [], None
    behind, in_front = evidence.lights or [], evidence.near_lights or []
    for path, near in [*((path, False) for path in behind), *((path, True) for path in in_front)]:
        frame = read_linear(path)
        size = (frame.shape[1], frame.shape[0])
        mine = find_lights(frame, near)
        if not mine:
            raise InputError(
                f"expected isolated points of light out of focus, below 1 and clear of the border, in {path}, found none: expose less"
            )
        found += mine
    return found, size


def _diameters(text: str) -> tuple[float, ...]:
    return numbers_in(text, "expected --diameters as numbers with commas between them, such as 8,20") if text else ()


def _regions(text: str) -> tuple[int, int]:
    columns, _, rows = text.partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise InputError(f"expected --regions as columns x rows, such as 3x3, got {text!r}")
    return int(columns), int(rows)


def _draw(out: Path, fitted: "LensFit", bank: "PsfBank") -> None:
    from mrbokeh.figures.psf_bank_drawing import draw_bank
    from mrbokeh.lens_measuring.fitting.fit_results import draw_evidence
    from mrbokeh.system.atomic_files import atomic_path

    for name, figure in (("kernels.png", draw_bank(bank)), ("evidence.png", draw_evidence(fitted))):
        with atomic_path(out / name) as temporary:
            figure.savefig(temporary, dpi=110)


def _proof(fitted: "LensFit") -> str:
    import numpy as np

    if not fitted.scores:
        return f"from {int(fitted.lights.sum())} lights"
    disc, stated, ours = (float(np.mean([getattr(score, name) for score in fitted.scores])) for name in ("disc", "stated", "fitted"))
    kind = "held-out slices" if fitted.scores[0].held_out else "slices"
    return f"error on {kind} {ours:.4f} (a disc {disc:.4f}, the stated aperture {stated:.4f})"
