"""Public bokeh sets that are on disk already, as data sets of focal stacks that `mrbokeh train fit` and `train evaluate` read.

    python -m datasets_scripts.public_datasets ebb SOURCE OUT --depth MAPS --near-m 0.5 --far-m 20 [--crop 1024x768]

Nothing is downloaded. Kinds: ebb, dpdd, aperture (pairs of photographs: give depth maps), realbokeh (gives focal length, f-number and
focus distance; give depth maps), blb (complete). Stacks that are finished are kept, so an interrupted run goes on where it stopped.

They become linear, with depth, blur per dioptre and masks of what is clipped. Sets without depth take the user's maps; a missing focus
distance is found from what is as sharp in both pictures.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Bool, Float32
from scipy import ndimage

from datasets_scripts.made_sets.set_files import Overwrite, focus_index, mistakes_told, slice_name, stack_record, write_dataset
from datasets_scripts.public_sets.adapters import (
    APERTURE_LENS,
    BLB_LENS,
    DPDD_LENS,
    EBB_LENS,
    REALBOKEH_LENS,
    PublicLens,
    PublicSlice,
    PublicStack,
    aperture_stacks,
    blb_stacks,
    dpdd_stacks,
    ebb_stacks,
    realbokeh_stacks,
)
from mrbokeh.images.camera_rgb import write_camera_rgb, write_masks
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_depth, read_image
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FILE_NAME as STACK_FILE
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged
from mrbokeh.stacks.focal_stack_dataset import FILE_NAME, FocalStackDataset
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

_MAPS = (".exr", ".png", ".tif", ".tiff")
_BINS = 24
_FEWEST_PX = 30
_SMOOTH_PX = 2.0
Plane = Float32[np.ndarray, "height width"]
# JPEG rounds and rings: what was full may be stored a little lower.
_CLIPPED_CODE = 250.0 / 255.0
_LINEAR = (".exr", ".hdr")
Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps in `folder`: KEY.exr in metres, or KEY.png, KEY.tif with disparity, white nearest, between near_m and far_m."""

    folder: Path | None = None
    near_m: float | None = None
    far_m: float | None = None

    def depth_m(self, stack: PublicStack) -> Plane:
        """Return metres of a stack. Raises InputError with what is missing."""
        if stack.depth is not None:
            return _metres(stack.depth)
        if self.folder is None:
            raise InputError(
                f"{stack.name} comes without depth, which the circle of confusion needs: make a depth map for each sharp picture (any "
                f"depth estimator) and give their folder with --depth"
            )
        path = next((found for suffix in _MAPS if (found := self.folder / f"{stack.key}{suffix}").is_file()), None)
        if path is None:
            raise InputError(f"expected the depth of {stack.name} as {stack.key}.exr, .png or .tif in {self.folder}, found none")
        return _metres(path) if path.suffix == ".exr" else self._from_disparity(path)

    def _from_disparity(self, path: Path) -> Plane:
        if self.near_m is None or self.far_m is None or not 0.0 < self.near_m < self.far_m:
            raise InputError(
                f"{path} holds disparity without a scale: say with --near-m and --far-m at which distances its white and its black lie "
                f"(0 < near < far), or give depth in metres as EXR"
            )
        white = read_image(path, "linear").mean(axis=2)
        return (1.0 / (1.0 / self.far_m + white * (1.0 / self.near_m - 1.0 / self.far_m))).astype(np.float32)


@dataclass(frozen=True)
class Conversion:
    """Settings of a set of that kind. lens: stated for every stack, since one network learns one lens; what differs is in px_per_dioptre.

    focus_m: for slices without a focus distance, None: found from what is sharp. crop_px: (width, height) of the middle, for sets whose
    pictures differ in size. licence: the note that goes with the pictures.
    """

    kind: str
    lens: PublicLens
    licence: str
    depth: DepthMaps
    focus_m: float | None = None
    crop_px: tuple[int, int] | None = None


def convert(stacks: Sequence[PublicStack], out: Path, conversion: Conversion, *, overwrite: bool = False) -> FocalStackDataset:
    """Write what is missing, the manifest last. Raises InputError before anything is written where depth or a lens is missing."""
    if conversion.lens.focal_length_mm is None:
        raise InputError(f"{conversion.kind} does not say which lens it was taken with: give --focal-length-mm (and --f-number)")
    for stack in stacks[:1]:
        conversion.depth.depth_m(stack)
    for stack in track(stacks, f"converting {conversion.kind}", len(stacks)):
        if overwrite or not (out / stack.name / STACK_FILE).is_file():
            _write_stack(stack, out / stack.name, conversion)
    records = tuple(stack_record(out, stack.name, stack.part) for stack in stacks)
    metadata = {
        "made_by": "datasets_scripts.public_datasets",
        "kind": conversion.kind,
        "depth": "of the set" if stacks[0].depth else "given",
        "clipped": "8-bit and 16-bit pictures are clipped at white: lights have lost light, in the sharp picture too",
    }
    return write_dataset(out, conversion.licence, records, metadata)


def _write_stack(stack: PublicStack, folder: Path, conversion: Conversion) -> None:
    sharp, clipped = _linear(stack.sharp, stack.power)
    depth_m, whole_width_px = conversion.depth.depth_m(stack), sharp.shape[1]
    if depth_m.shape != sharp.shape[:2]:
        raise InputError(f"{stack.name}: its depth is {_size(depth_m)} px, the sharp picture {_size(sharp)} px; scale the depth to it")
    window = _window(sharp, conversion.crop_px, stack.name)
    sharp, clipped, depth_m = sharp[window], clipped[window], depth_m[window]
    slices = tuple(_write_slice(stack, index, folder, conversion, (sharp, depth_m, whole_width_px)) for index in range(len(stack.slices)))
    confidence = np.ones_like(depth_m)
    distances_m = [each.focus_distance_m for each in slices if each.focus_distance_m is not None]
    write_merged(folder, sharp, focus_index(depth_m, distances_m), confidence, depth_m)
    write_masks(folder / "exclusion.exr", {"saturated": clipped})
    lens = _stated(conversion.lens, distances_m[0])
    metadata = {"public": conversion.kind, "clipped": stack.sharp.suffix.lower() not in _LINEAR, **stack.facts}
    write_focal_stack(FocalStack(folder, slices, lens, None, registered=True, merged=True, metadata=metadata))


def _write_slice(
    stack: PublicStack, index: int, folder: Path, conversion: Conversion, of_stack: tuple[Rgb, Float32[np.ndarray, "height width"], int]
) -> Slice:
    (sharp, depth_m, whole_width_px), source = of_stack, stack.slices[index]
    whole, clipped = _linear(source.path, None if source.path.suffix.lower() in _LINEAR else stack.power)
    if whole.shape[1] != whole_width_px:
        raise InputError(f"{source.path} is {_size(whole)} px, but its sharp picture {stack.sharp} is {whole_width_px} px wide")
    window = _window(whole, conversion.crop_px, stack.name)
    rgb, name = whole[window], slice_name(index)
    distance_m = source.focus_distance_m or conversion.focus_m or sharpest_depth_m(sharp, rgb, depth_m)
    write_camera_rgb(folder / name, rgb, None, saturated=clipped[window])
    facts = {
        "source": source.path.name,
        "focus_found": source.focus_distance_m is None and conversion.focus_m is None,
        "f_number": source.f_number,
        "px_per_dioptre": source.px_per_dioptre or _px_per_dioptre(source, conversion.lens, distance_m, whole_width_px),
        "px_per_dioptre_width_px": rgb.shape[1],
    }
    return Slice(name, distance_m, metadata=facts)


def _px_per_dioptre(source: PublicSlice, lens: PublicLens, distance_m: float, width_px: int) -> float:
    """Return the blur per dioptre of the lens that this slice was taken with."""
    focal_length_mm = source.focal_length_mm or lens.focal_length_mm
    assert focal_length_mm is not None
    return Lens(focal_length_mm, source.f_number or lens.f_number, distance_m, lens.sensor_width_mm).coc_px_per_dioptre(width_px)


def _stated(lens: PublicLens, distance_m: float) -> Lens:
    assert lens.focal_length_mm is not None
    return Lens(lens.focal_length_mm, lens.f_number, distance_m, lens.sensor_width_mm)


def _linear(path: Path, power: float | None) -> tuple[Rgb, Mask]:
    """Return (scene-linear radiance, where a colour was clipped)."""
    if path.suffix.lower() in _LINEAR:
        rgb = read_image(path)
        return rgb, np.zeros(rgb.shape[:2], bool)
    stored = read_image(path, "linear")
    clipped: Mask = np.any(stored >= _CLIPPED_CODE, axis=2)
    return (read_image(path) if power is None else (stored**power).astype(np.float32)), clipped


def _window(rgb: Rgb, crop_px: tuple[int, int] | None, name: str) -> tuple[slice, slice]:
    """Return the middle of the picture, so that field positions stay symmetric."""
    height, width = rgb.shape[:2]
    if crop_px is None:
        return slice(0, height), slice(0, width)
    if crop_px[0] > width or crop_px[1] > height:
        raise InputError(f"{name} is {_size(rgb)} px, too small for --crop {crop_px[0]}x{crop_px[1]}")
    left, top = (width - crop_px[0]) // 2, (height - crop_px[1]) // 2
    return slice(top, top + crop_px[1]), slice(left, left + crop_px[0])


def _size(picture: np.ndarray) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"


def _metres(path: Path) -> Plane:
    """Read a depth pass written as Z, as Y, or as a picture of three equal channels."""
    channels = read_exr(path)[0].channels
    if "R" in channels and "Z" not in channels:
        red = channels["R"].astype(np.float32)
        return np.where(red > 0, red, np.float32(np.inf))
    return read_depth(path)


def sharpest_depth_m(sharp: Float32[np.ndarray, "height width 3"], blurred: Float32[np.ndarray, "height width 3"], depth_m: Plane) -> float:
    """Return the depth at which the blurred picture keeps most of the sharp one's detail: its focus distance.

    Detail is the energy of gradients, pixels are sorted into 24 bins of equal count by dioptre. Raises InputError where all is flat.
    """
    dioptres = 1.0 / depth_m
    detail, kept = (ndimage.gaussian_gradient_magnitude(rgb.mean(axis=2), _SMOOTH_PX / 2.0) ** 2 for rgb in (sharp, blurred))
    edges = np.unique(np.quantile(dioptres, np.linspace(0.0, 1.0, _BINS + 1)))
    number = np.clip(np.searchsorted(edges, dioptres, side="right") - 1, 0, max(len(edges) - 2, 0)).ravel()
    count, total, left = (np.bincount(number, weights) for weights in (None, detail.ravel(), kept.ravel()))
    enough = (count >= _FEWEST_PX) & (total > 1e-3 * total.max(initial=0.0))
    if not enough.any():
        raise InputError("the focus distance cannot be found: the sharp picture has no detail; state it with --focus-m")
    best = int(np.argmax(np.where(enough, left / np.maximum(total, 1e-30), -1.0)))
    return float(1.0 / np.median(dioptres.ravel()[number == best]))


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
    overwrite: Overwrite = False,
) -> None:
    """Convert a public set."""
    with mistakes_told():
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
