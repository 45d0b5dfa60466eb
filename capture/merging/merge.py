"""`mrbokeh capture merge`: registered slices, all-in-focus picture and depth for every stack of a scene."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from capture.merging.alignment import Registration, register_stack, warp
from capture.merging.all_in_focus import all_in_focus
from capture.merging.depth_from_focus import FocusMap, depth_from_focus
from capture.merging.light_energy import with_light_energy
from capture.merging.lights import find_lights
from mrbokeh.camera import Camera
from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack, Slice, find_focal_stacks, write_focal_stack, write_merged
from mrbokeh.image_io import read_image, write_image
from mrbokeh.lens import Lens
from mrbokeh.progress import track
from mrbokeh.stack_pictures import write_merge_sheet

REGISTERED_FOLDER = "registered"
FEWEST_SLICES = 3

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


def merge_scene(scene: Path, overwrite: bool = False) -> list[FocalStack]:
    """Merge every stack of a scene that is not merged yet (or all, to overwrite)."""
    return [stack if stack.merged and not overwrite else merge_stack(stack) for stack in find_focal_stacks(scene)]


def merge_stack(stack: FocalStack) -> FocalStack:
    """Register, find depth, merge; writes the pictures first and stack.json last, so that an interrupted run starts anew."""
    if len(stack) < FEWEST_SLICES:
        raise InputError(f"{stack.folder} has {len(stack)} slices: merging needs at least {FEWEST_SLICES}, focused at different distances")
    registration = _register(stack)
    slices = _write_registered(stack, registration)
    registered = _with_registration(stack, slices, registration)

    def passes(purpose: str) -> Iterator[Rgb]:
        return track(registered.iter_rgb(), f"{stack.folder.name}: {purpose}", len(stack))

    lights = find_lights(lambda: passes("lights"))
    focus = depth_from_focus(passes("focus"), lights)
    sharp = all_in_focus(passes("all in focus"), focus.merge_index)
    picture = with_light_energy(sharp, passes("energy of lights"), lights)
    write_merged(stack.folder, picture, focus.focus_index, focus.confidence, depth_m_of(registered, focus))
    merged = replace(registered, merged=True)
    write_focal_stack(merged)
    write_merge_sheet(merged)
    return merged


def depth_m_of(stack: FocalStack, focus: FocusMap) -> Plane | None:
    """The focus index in metres, interpolated in dioptres; None where a focus distance is unknown."""
    if not stack.is_metric:
        return None
    dioptres = np.array([1.0 / distance for distance in stack.focus_distances_m if distance is not None])
    interpolated = np.interp(focus.focus_index, np.arange(len(stack)), dioptres)
    return (1.0 / np.maximum(interpolated, 1e-6)).astype(np.float32)


def source_path(each: Slice) -> str:
    """The slice as it was ingested, also after registration has put a resampled one in its place."""
    return str(each.metadata.get("ingested", each.path))


def _register(stack: FocalStack) -> Registration:
    def read(index: int) -> Rgb:
        return read_image(stack.folder / source_path(stack.slices[index]))

    knows_lens = stack.lens is not None and stack.is_metric
    prior = [stack.lens_of(i).image_distance_mm for i in range(len(stack))] if knows_lens else None
    return register_stack(read, len(stack), prior)


def _write_registered(stack: FocalStack, registration: Registration) -> tuple[Slice, ...]:
    """Resample every slice to the reference; half float keeps 11 bits, far below the noise of a photograph."""
    written = []
    for index, each in enumerate(track(stack.slices, f"{stack.folder.name}: register")):
        path = f"{REGISTERED_FOLDER}/{index:02d}.exr"
        rgb = read_image(stack.folder / source_path(each))
        write_image(stack.folder / path, warp(rgb, registration.reference_from_slice[index]))
        metadata = each.metadata | {
            "ingested": source_path(each),
            "reference_from_slice": registration.reference_from_slice[index].tolist(),
        }
        written.append(replace(each, path=path, scale=registration.scales[index], metadata=metadata))
    return tuple(written)


def _with_registration(stack: FocalStack, slices: tuple[Slice, ...], registration: Registration) -> FocalStack:
    """The stack in the geometry of its reference: lens focused there, camera of that focus."""
    changed = replace(stack, slices=slices, registered=True, reference=registration.reference)
    if stack.lens is None or slices[registration.reference].focus_distance_m is None:
        return changed
    lens = changed.lens_of(registration.reference)
    return replace(changed, lens=lens, camera=_breathed(stack.camera, lens) if stack.camera else None)


def _breathed(camera: Camera, lens: Lens) -> Camera:
    """The camera with the focal length that the lens has at its focus."""
    focal_px = lens.focal_px(camera.width_px)
    return replace(camera, focal_px=(focal_px, focal_px))
