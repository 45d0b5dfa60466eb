"""One virtual scene in every slice of a focal stack, so that the result is a focal stack again: with depth and an all-in-focus picture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.compositing.open_plate import depth_error_dioptres
from mrbokeh.compositing.plate import Inserted, Insertion, Plate, plate_of
from mrbokeh.images.camera_rgb import Matrix3x3, write_camera_rgb
from mrbokeh.images.color import convert
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.stacks.focal_stack import FocalStack, write_focal_stack, write_merged
from mrbokeh.stacks.guessed_metres import POSITION, POSITION_ERROR, metres_facts
from mrbokeh.system.atomic_files import atomic_folder
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]

_SURFACE = 0.5
"""Depth has one surface per pixel: the virtual one where it covers at least this much."""


@dataclass(frozen=True)
class Unblurred:
    """A renderer of pinhole pictures: what is put into the all-in-focus picture stays sharp."""

    def render(self, layers: Sequence[Layer], lens: Lens) -> Layer:  # noqa: ARG002
        return flatten(layers)


def composite_stack(
    stack: FocalStack,
    layers: Sequence[Layer] | Callable[[Plate], Sequence[Layer]],
    insertion: Insertion,
    renderer: Renderer,
    out: Path,
    lens: Lens | None = None,
) -> FocalStack:
    """Write a merged focal stack to the new folder `out`, in which each slice holds the layers with the blur of its own focus.

    layers: sharp, front first, of the registered size; or what gives them for a plate (a scene rendered for its camera). Pixels that
    they do not touch keep the stored numbers of the stack, in its own camera RGB. lens: in place of the stack's. Raises InputError
    where `out` exists, or the stack is not merged, not registered or without focus distances.
    """
    if not stack.registered:
        raise InputError(
            f"{stack.folder} is not registered, so that one scene cannot fit all its slices: run `mrbokeh capture merge` on it"
        )
    whole = _all_in_focus_plate(stack, lens)
    with atomic_folder(out) as folder:
        for index in track(range(len(stack)), "compositing slices"):
            plate = replace(whole, rgb=stack.slice_rgb(index), lens=_lens_of(stack, index, lens))
            inserted = insertion.insert(plate, _layers(layers, plate), renderer)
            _write_slice(stack, index, inserted, folder)
        assert whole.depth_m is not None
        _write_merge(stack, insertion.insert(whole, _layers(layers, whole), Unblurred()), whole.depth_m, folder)
        write_focal_stack(replace(stack, folder=folder, metadata=stack.metadata | {"composited_from": stack.folder.name}))
    return replace(stack, folder=out, metadata=stack.metadata | {"composited_from": stack.folder.name})


def _layers(layers: Sequence[Layer] | Callable[[Plate], Sequence[Layer]], plate: Plate) -> Sequence[Layer]:
    return layers(plate) if callable(layers) else layers


def _all_in_focus_plate(stack: FocalStack, other: Lens | None) -> Plate:
    """Return the plate of the all-in-focus picture. All slices are seen by one camera."""
    sharp_rgb, (depth_m, confidence) = stack.all_in_focus(), stack.depth_planes("Z", "confidence")
    camera = stack.camera or plate_of(sharp_rgb, stack.lens_of(stack.reference)).camera
    return Plate(
        rgb=sharp_rgb,
        depth_m=depth_m,
        lens=_lens_of(stack, stack.reference, other),
        camera=replace(camera, camera_from_world=np.eye(4)),
        sharp_rgb=sharp_rgb,
        depth_confidence=confidence,
        depth_error_dioptres=depth_error_dioptres(stack),
    )


def _lens_of(stack: FocalStack, index: int, other: Lens | None) -> Lens:
    """Return the lens of a slice; another one takes the slice's focus and nothing else."""
    return stack.registered_lens_of(index) if other is None else other.focused_at(stack.lens_of(index).focus_distance_m)


def _write_slice(stack: FocalStack, index: int, inserted: Inserted, folder: Path) -> None:
    stored, masks = stack.slice_camera_rgb(index), stack.slice_masks(index)
    touched = _touched(inserted, stack.to_rec709(stored))
    camera_rgb = _in_camera_rgb(stored, inserted.rgb, touched, stack.rec709_from_camera)
    write_camera_rgb(
        folder / stack.slices[index].path,
        camera_rgb,
        stack.rec709_from_camera,
        saturated=masks.saturated & (inserted.virtual.alpha < 1.0),
        valid=masks.valid,
        half=_is_half(stored),
    )


def _write_merge(stack: FocalStack, inserted: Inserted, depth_m: Float32[np.ndarray, "height width"], folder: Path) -> None:
    stored = stack.all_in_focus_camera_rgb()
    touched = _touched(inserted, stack.to_rec709(stored))
    surface = (inserted.virtual.alpha >= _SURFACE) & np.isfinite(inserted.virtual.depth_m)
    new_depth_m = np.where(surface, inserted.virtual.depth_m, depth_m).astype(np.float32)
    dioptres = np.array([1.0 / float(each) for each in stack.focus_distances_m if each is not None])
    order = np.argsort(dioptres)
    virtual_index = np.interp(1.0 / new_depth_m, dioptres[order], order).astype(np.float32)
    write_merged(
        folder,
        _in_camera_rgb(stored, inserted.rgb, touched, stack.rec709_from_camera),
        np.where(surface, virtual_index, stack.focus_index()).astype(np.float32),
        np.where(surface, np.float32(1.0), stack.depth_confidence()).astype(np.float32),
        new_depth_m,
        stack.rec709_from_camera,
    )
    _write_positions(stack, surface, new_depth_m, folder)
    if stack.exclusion_path.is_file():
        (folder / stack.exclusion_path.name).write_bytes(stack.exclusion_path.read_bytes())


def _write_positions(stack: FocalStack, surface: Mask, depth_m: Float32[np.ndarray, "height width"], folder: Path) -> None:
    """Positions in pixels of blur, of a stack that has them, are those of the virtual surfaces where these are seen."""
    gauge = metres_facts(stack).get("gauge")
    channels = read_exr(stack.depth_path)[0].channels
    if gauge is None or not {POSITION, POSITION_ERROR} <= set(channels):
        return
    virtual_px = ((1.0 / depth_m - gauge["offset_dioptres"]) * gauge["px_per_dioptre"]).astype(np.float32)
    ours = {
        POSITION: np.where(surface, virtual_px, channels[POSITION]).astype(np.float32),
        POSITION_ERROR: np.where(surface, np.float32(0.0), channels[POSITION_ERROR]).astype(np.float32),
    }
    made = read_exr(folder / stack.depth_path.name)[0]
    write_exr(folder / stack.depth_path.name, replace(made, channels=dict(made.channels) | ours))


def _touched(inserted: Inserted, rgb: Rgb) -> Mask:
    return (inserted.rgb != rgb).any(axis=2)


def _in_camera_rgb(stored: Rgb, rgb: Rgb, touched: Mask, rec709_from_camera: Matrix3x3 | None) -> Rgb:
    """The stored numbers, and where something was put in its light in the same primaries."""
    own = rgb if rec709_from_camera is None else convert(rgb, np.linalg.inv(np.array(rec709_from_camera)))
    return np.where(touched[..., None], own, stored)


def _is_half(stored: Rgb) -> bool:
    return bool((stored.astype(np.float16).astype(np.float32) == stored).all())
