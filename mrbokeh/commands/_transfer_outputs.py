"""What `mrbokeh transfer` writes: one picture, a folder that is a focal stack, or a focus pull as a film."""

import shutil
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.optics.lens import Lens
from mrbokeh.refocus.transferring import SharpPhotograph
from mrbokeh.stacks.focal_stack import FocalStack, Slice
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]
Blurred = Callable[[float], Rgb]

FILMS = (".mov", ".mp4", ".mkv")
_MADE = "transferred_with_depth"


def check_out(out: Path, count: int) -> None:
    """Raises InputError where several pictures would go into one file."""
    if count > 1 and out.suffix and out.suffix.lower() not in FILMS:
        raise InputError(f"--focus states {count} distances: give a folder or a film ({', '.join(FILMS)}) to write to, got {out}")


def write_blurred(
    out: Path, sharp: SharpPhotograph, lens: Lens, distances_m: tuple[float, ...], blurred: Blurred, frame_rate: float
) -> None:
    if out.suffix.lower() in FILMS:
        _write_film(out, distances_m, blurred, frame_rate)
    elif out.suffix:
        from mrbokeh.images.image_io import write_image

        write_image(out, blurred(distances_m[0]))
    else:
        _write_stack(out, sharp, lens, distances_m, blurred)


def _write_film(out: Path, distances_m: Sequence[float], blurred: Blurred, frame_rate: float) -> None:
    from mrbokeh.video.clip import VideoWriter

    rate = Fraction(frame_rate).limit_denominator(1001)
    first = blurred(distances_m[0])
    with VideoWriter(out, first.shape[1], first.shape[0], rate) as writer:
        for index, distance_m in enumerate(track(distances_m, "pulling focus")):
            writer.write(first if index == 0 else blurred(distance_m), float(index / rate))


def is_transferred(folder: Path) -> bool:
    """Whether a folder is a focal stack of this command's, which --overwrite may replace."""
    from mrbokeh.stacks.focal_stack import FILE_NAME, read_focal_stack

    return (folder / FILE_NAME).is_file() and _MADE in read_focal_stack(folder).metadata


def _write_stack(out: Path, sharp: SharpPhotograph, lens: Lens, distances_m: tuple[float, ...], blurred: Blurred) -> None:
    from mrbokeh.images.image_io import write_image
    from mrbokeh.stacks.focal_stack import write_focal_stack, write_merged
    from mrbokeh.stacks.focus_places import index_between, slice_names
    from mrbokeh.stacks.guessed_metres import inherited_facts
    from mrbokeh.system.atomic_files import atomic_folder

    slices = tuple(map(Slice, slice_names(distances_m), distances_m))
    depth = sharp.depth
    index = index_between(distances_m, depth.dioptres)
    if out.is_dir() and is_transferred(out):
        shutil.rmtree(out)
    with atomic_folder(out) as folder:
        for each, distance_m in zip(slices, track(distances_m, "blurring"), strict=True):
            write_image(folder / each.path, blurred(distance_m), half=False)
        write_merged(folder, sharp.photograph.rgb, index, depth.valid.astype(np.float32), depth.depth_m)
        metadata = {_MADE: depth.note} | ({} if sharp.stack is None else inherited_facts(sharp.stack, with_lens=False))
        made = FocalStack(folder, slices, lens.focused_at(distances_m[0]), registered=True, merged=True, metadata=metadata)
        write_focal_stack(made)


def write_sheet(path: Path, distances_m: Sequence[float], blurred: Blurred, sharp_rgb: Rgb) -> None:
    from mrbokeh.images.image_io import SheetRow, write_contact_sheet

    pictures = {"all in focus": sharp_rgb} | {f"{each:.4g} m": blurred(each) for each in distances_m}
    write_contact_sheet(path, [SheetRow("focus", pictures)])
