"""`mrbokeh capture merge`: registered slices, all-in-focus picture and depth for every stack of a scene.

`depth_from_focus` chooses the sharpest slice at each pixel."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.all_in_focus import NARROW_CROSSOVER, crossover_of, sharp_all_in_focus
from capture.merging.depth_edges import with_edges_of_light
from capture.merging.depth_from_focus import focus_map, vetoed
from capture.merging.focus_volume import focus_volume
from capture.merging.ghosts import Mended, without_ghosts
from capture.merging.lights import Extremes, no_lights, spread_light
from capture.merging.merged_pictures import depth_m_of, write_readable_pictures
from capture.merging.metres.relative_stack import as_stated, in_focus_order, with_solved_blur
from capture.merging.preferred_side import PREFERRED, Side, with_preferred
from capture.merging.registration.alignment import register_stack
from capture.merging.registration.registered_slices import IngestedSlices, RegisteredSlices, newer, source_path
from capture.merging.registration.registration_file import FILE_NAME as REGISTRATION_NAME
from capture.merging.registration.registration_file import Registration, read_registration, write_registration
from capture.merging.restored_lights import RestoredLight, known_opening, restored_lights, with_restored_lights
from capture.merging.retouch import RETOUCHES
from capture.merging.second_pass import FIRST_PASS_FOLDER, SliceOptics
from capture.stacks.slice_files import reporting_full_disk, stated_by_sentinel
from mrbokeh.figures.stack_pictures import depth_codes, write_merge_sheet
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import DEPTH_SOURCE, FROM_FOCUS, FocalStack, find_focal_stacks, write_focal_stack, write_merged
from mrbokeh.stacks.guessed_metres import is_near_first
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

FEWEST_SLICES = 2
_IN_COMMON = 0.2
"""Neighbours that correlate less show nothing in common: two sheets of white reach 0, hand-held slices with people walking 0.93."""
HIGHLIGHTS = "highlights"
"""Key in a stack's metadata: how many lights were drawn anew, and the largest value that their measured flux supports."""

GHOSTS = "ghosts"
"""Key in a stack's metadata: share of the picture that was unlike every slice, that is now, and that was taken from one slice each."""

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


def merge_scene(scene: Path, overwrite: bool = False, registration: Path | None = None, prefer: Side | None = None) -> list[FocalStack]:
    """Merge every stack of a scene that is not merged yet (or all, to overwrite).

    registration: a file that says how the slices of every stack fit together, instead of finding it out. prefer: of two things that are
    seen in one place.
    """
    stacks = find_focal_stacks(scene)
    return [stack if stack.merged and not overwrite else merge_stack(stack, overwrite, registration, prefer) for stack in stacks]


def merge_stack(stack: FocalStack, overwrite: bool = False, registration: Path | None = None, prefer: Side | None = None) -> FocalStack:
    """Register, find depth and merge; stack.json is written last. An interrupted run goes on, unless told to overwrite."""
    with reporting_full_disk(stack.all_in_focus_path):
        return _merged(stack, overwrite, registration, prefer)


def _merged(stack: FocalStack, overwrite: bool, registration: Path | None, prefer: Side | None) -> FocalStack:
    ingested, given = IngestedSlices(stack), stack
    stack = in_focus_order(as_stated(stack), ingested)
    _require_a_sweep(stack)
    name = stack.folder.name
    slices = RegisteredSlices(stack, _registration_of(stack, ingested, overwrite, registration), ingested)
    slices.require_size()
    if given.merged:
        # Its pictures change from here on; an interrupted run must not leave a stack that says it is merged.
        write_focal_stack(replace(given, merged=False))
    extremes = Extremes()
    made = extremes.watching(track(slices.resampled(keep=not overwrite), f"{name}: register", len(stack)))
    volume = focus_volume(made, slices.valid, len(stack))
    volume = volume.without(spread_light(volume.lights))
    merged, focus = _with_registration(stack, slices), focus_map(volume, no_lights(volume.shape), slices.saturated)
    sharp = sharp_all_in_focus(slices.stored, focus.focus_index, volume, _crossover(merged, volume.shape[1]))
    mended = without_ghosts(sharp, slices.stored, partial(_seen, merged, slices), merged.to_rec709)
    sharp = mended.picture if mended else sharp
    lights, restored = restored_lights(slices.stored, sharp, extremes, opening=known_opening(stack.lens))
    if restored:
        sharp, focus = with_restored_lights(sharp, restored), focus_map(volume, lights, slices.saturated)
    focus = mended.placed(focus) if mended else focus
    merged = _with_findings(merged, restored, mended)
    if stack.is_metric:
        placed = with_edges_of_light(focus, sharp, near_first=is_near_first(stack))
        depth_m = depth_m_of(merged, placed.focus_index)
        write_merged(stack.folder, sharp, placed.focus_index, placed.confidence, depth_m, stack.rec709_from_camera)
    else:
        write_camera_rgb(stack.all_in_focus_path, sharp, stack.rec709_from_camera, half=False)
        merged = with_solved_blur(merged, slices, sharp, focus)
    if prefer is not None:
        rims = vetoed(lights.slice_index(), slices.saturated)
        excluded = rims | mended.changed if mended else rims  # what moved and what it hid have a peak each
        merged, sharp = with_preferred(merged, sharp, slices.stored, volume, focus.focus_index, excluded, prefer)
    shutil.rmtree(stack.folder / FIRST_PASS_FOLDER, ignore_errors=True)
    codes = depth_codes(merged)
    write_readable_pictures(merged, sharp, codes)
    write_focal_stack(merged)
    write_merge_sheet(merged, sharp, codes)
    return merged


def _seen(stack: FocalStack, slices: RegisteredSlices) -> Iterator[tuple[Rgb, Mask]]:
    """Yield the slices in linear Rec.709, and where each has data."""
    for index, rgb in enumerate(track(slices.stored(), f"{stack.folder.name}: what moved", len(stack))):
        yield stack.to_rec709(rgb), slices.valid(index)


def _with_findings(stack: FocalStack, restored: Sequence[RestoredLight], mended: Mended | None) -> FocalStack:
    found: dict[str, object] = {
        HIGHLIGHTS: {"drawn": len(restored), "largest_supported": max((each.supported for each in restored), default=0.0)}
    }
    if mended is not None:
        found[GHOSTS] = {"before": mended.before, "after": mended.after, "share": float((mended.chosen >= 0).mean())}
    return replace(stack, metadata=stack.metadata | found)


def ghosts_text(stack: FocalStack) -> str:
    """Say how much of a merged picture was cut anew because something moved; empty where nothing was."""
    found = stack.metadata.get(GHOSTS)
    return f"something moved between the slices: {found['share']:.1%} of the picture is taken whole from one slice each" if found else ""


def _require_a_sweep(stack: FocalStack) -> None:
    """Refuse slices of which neighbours in order are not neighbours in focus."""
    if len(stack) < FEWEST_SLICES:
        count = "1 slice" if len(stack) == 1 else f"{len(stack)} slices"
        raise InputError(f"{stack.folder} has {count}: merging needs at least {FEWEST_SLICES}, focused at different distances")
    dioptres = [1.0 / distance for distance in stack.focus_distances_m if distance is not None]
    steps = np.diff(dioptres)
    if stack.is_metric and (steps > 0).any() and (steps < 0).any():
        raise InputError(f"the slices of {stack.folder} are not in the order of their focus: ingest the photographs again")


def _crossover(stack: FocalStack, width_px: int) -> float:
    if stack.lens is None or not stack.is_metric:
        return NARROW_CROSSOVER
    optics = SliceOptics.of_stack(stack, width_px)
    return crossover_of(float(np.median(np.abs(np.diff(optics.focus_dioptres)))) * max(optics.px_per_dioptre))


def _registration_of(stack: FocalStack, ingested: IngestedSlices, overwrite: bool, given: Path | None) -> Registration:
    """Return the registration as given, as an interrupted run has left it, or computed; it is always written beside stack.json."""
    own, sources = stack.folder / REGISTRATION_NAME, [stack.folder / source_path(each) for each in stack.slices]
    if given is None and not overwrite and newer(own, *sources):
        return read_registration(own, len(stack))
    found = _registered(stack, ingested, sources) if given is None else read_registration(given, len(stack))
    write_registration(own, found)
    return found


def _registered(stack: FocalStack, ingested: IngestedSlices, sources: Sequence[Path]) -> Registration:
    knows_lens = stack.lens is not None and stack.is_metric
    prior = [stack.lens_of(i).image_distance_mm for i in range(len(stack))] if knows_lens else None
    read = lru_cache(maxsize=1)(lambda index: ingested.read(sources[index]))
    unknown = np.flatnonzero(stated_by_sentinel(stack)).tolist()
    found = register_stack(lambda index: read(index)[0], len(stack), prior, lambda index: read(index)[1] == 0, unknown)
    if prior is None and all(each is None for each in found.residuals_px) and max(found.correlations) < _IN_COMMON:
        raise InputError(
            f"{stack.folder}: expected photographs of one scene with detail to focus on, but no two neighbours of {len(stack)} show the "
            f"same (correlation at most {max(found.correlations):.2f}): leave them out, or say how they lie (`--registration FILE`)"
        )
    return found


def _with_registration(stack: FocalStack, slices: RegisteredSlices) -> FocalStack:
    """Return the merged stack in the geometry of its reference: lens focused there, camera of that focus."""
    reference = slices.registration.reference
    kept = {key: value for key, value in stack.metadata.items() if key not in (RETOUCHES, PREFERRED, GHOSTS)}
    metadata = kept | {DEPTH_SOURCE: FROM_FOCUS}
    changed = replace(stack, slices=slices.descriptions(), registered=True, merged=True, reference=reference, metadata=metadata)
    if stack.lens is None or stack.slices[reference].focus_distance_m is None:
        return changed
    lens = changed.stated_lens_of(reference)
    return replace(changed, lens=lens, camera=_breathed(stack.camera, lens) if stack.camera else None)


def _breathed(camera: Camera, lens: Lens) -> Camera:
    """Return the camera with the focal length that the lens has at its focus."""
    focal_px = lens.focal_px(camera.width_px)
    return replace(camera, focal_px=(focal_px, focal_px))
