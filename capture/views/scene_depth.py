"""`mrbokeh capture depth`: dense metric depth of every stack from its neighbours and its focus, then the picture made with it.

Needs merged stacks, poses and their scale. The first pass's picture and depth are kept in first_pass/ and are what every run
starts from, so that a run again with other settings, or an interrupted one, gives the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.merging.second_pass import DEPTH_SOURCE, first_pass_path, keep_first_pass, second_pass
from capture.merging.slice_optics import SliceOptics
from capture.views.colmap import RECONSTRUCTION_FOLDER
from capture.views.dense_clues import Clues, SparseDepths
from capture.views.dense_depth import DenseSettings, dense_depth
from capture.views.dense_finish import DenseDepth
from capture.views.depth_fusion import FocusVote, focus_vote_of_map, near_lights
from capture.views.neighbours import nearest_views
from capture.views.plane_sweep_view import SweepView, structure_of
from capture.views.sparse_model import SparseModel, SparseView
from capture.views.sparse_model_file import read_sparse_model
from mrbokeh.camera_rgb import read_camera_rgb
from mrbokeh.errors import InputError
from mrbokeh.exr_io import read_exr
from mrbokeh.focal_stack import FocalStack, find_focal_stacks, write_focal_stack, write_merged
from mrbokeh.progress import track
from mrbokeh.stack_pictures import write_merge_sheet

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

_FEWEST_POINTS = 20
# Between these confidences the second pass takes over from the first; seams are as soft as this.
_DOUBTED, _TRUSTED = 0.3, 0.6
_SEAM_PX = 1.5
_PICTURES_HELD = 8


@dataclass(frozen=True)
class SceneDepthSettings:
    """neighbours: how many views a stack is compared with. overwrite: also where the depth is there already."""

    neighbours: int = 6
    overwrite: bool = False
    dense: DenseSettings = field(default_factory=DenseSettings)


@dataclass(frozen=True)
class SceneDepth:
    """stacks: with dense depth now. left_out: names of stacks without a pose, which keep their depth from focus."""

    stacks: tuple[FocalStack, ...]
    left_out: tuple[str, ...]


def deepen_scene(scene: Path, settings: SceneDepthSettings | None = None) -> SceneDepth:
    """Dense depth and second-pass picture for every placed stack of a scene; finished ones are kept unless to overwrite."""
    settings = settings or SceneDepthSettings()
    model = read_sparse_model(scene / RECONSTRUCTION_FOLDER).scaled()
    stacks = {stack.folder.name: stack for stack in find_focal_stacks(scene)}
    unmerged = [name for name, stack in stacks.items() if not stack.merged]
    if unmerged:
        raise InputError(f"expected merged stacks in {scene}, but {', '.join(unmerged)} are not: run `mrbokeh capture merge` first")
    placed = [view for view in model.views if view.name in stacks]
    if len(placed) < 2:
        raise InputError(f"dense depth needs two placed stacks or more, {scene} has {len(placed)}: photograph more viewpoints")
    pictures = Pictures({view.name: stacks[view.name] for view in placed})
    done = [deepen_stack(stacks[view.name], model, pictures, settings) for view in track(placed, "depth")]
    return SceneDepth(tuple(done), tuple(sorted(set(stacks) - {view.name for view in placed})))


class Pictures:
    """First-pass pictures of the stacks as structures; a few are held."""

    def __init__(self, stacks: dict[str, FocalStack]) -> None:
        self.stacks = stacks
        self.view = lru_cache(_PICTURES_HELD)(self._view)

    def rgb(self, name: str) -> Rgb:
        """Linear Rec.709."""
        stack = self.stacks[name]
        return stack.to_rec709(read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path)))

    def _view(self, view_name: str) -> Plane:
        return structure_of(self.rgb(view_name))


def deepen_stack(stack: FocalStack, model: SparseModel, pictures: Pictures, settings: SceneDepthSettings) -> FocalStack:
    """One stack; its pictures are written first and stack.json last."""
    chosen = [view for view in nearest_views(model, stack.folder.name, settings.neighbours) if view.name in pictures.stacks]
    record = depth_record(stack, model, [view.name for view in chosen])
    if stack.metadata.get(DEPTH_SOURCE) == record and not settings.overwrite:
        return stack
    keep_first_pass(stack)
    rgb = pictures.rgb(stack.folder.name)
    sparse = SparseDepths(*model.depths_in(stack.folder.name))
    if len(sparse.depth_m) < _FEWEST_POINTS:
        raise InputError(
            f"{stack.folder.name} sees {len(sparse.depth_m)} points of the sparse model, but its range of depths needs "
            f"{_FEWEST_POINTS}: photograph it from nearer to the other viewpoints"
        )
    found = dense_depth(
        rgb,
        _sweep_view(model.view(stack.folder.name), pictures.view(stack.folder.name)),
        [_sweep_view(view, pictures.view(view.name)) for view in chosen],
        sparse.dioptre_range(),
        Clues(focus_clue(stack, rgb), sparse),
        settings.dense,
    )
    return _written(stack, found, record)


def _sweep_view(view: SparseView, structure: Plane) -> SweepView:
    """Sparse views know the size at which COLMAP saw them."""
    height, width = structure.shape
    camera = view.camera if (view.camera.width_px, view.camera.height_px) == (width, height) else view.camera.resized(width, height)
    return SweepView(structure, camera, view.distortion)


def focus_clue(stack: FocalStack, rgb: Rgb) -> FocusVote | None:
    """The depth from focus of the first pass, silent around lights; None where focus distances are unknown."""
    if not stack.is_metric:
        return None
    channels = read_exr(first_pass_path(stack, stack.depth_path))[0].channels
    optics = SliceOptics.of_stack(stack, rgb.shape[1])
    confidence = np.where(near_lights(rgb, _largest_coc_px(optics)), 0.0, channels["confidence"])
    return focus_vote_of_map(channels["focus_index"].astype(np.float32), confidence.astype(np.float32), np.array(optics.focus_dioptres))


def _largest_coc_px(optics: SliceOptics) -> float:
    """Of anything within the range of the stack's focus."""
    return float(max(optics.px_per_dioptre) * np.ptp(optics.focus_dioptres))


def depth_record(stack: FocalStack, model: SparseModel, neighbours: Sequence[str]) -> dict[str, object]:
    """What a dense depth was made from, as far as stack.json can tell: whether it is still the right one."""
    pose = model.view(stack.folder.name).camera.camera_from_world
    points_m = model.depths_in(stack.folder.name)[1]
    return {
        "method": "plane sweep and focus",
        "neighbours": list(neighbours),
        "camera_from_world": np.round(pose, 9).tolist(),
        "nearest_point_m": round(float(points_m.min(initial=np.inf)), 9),
        "focus_distances_m": [None if each is None else round(each, 9) for each in stack.focus_distances_m],
    }


def _written(stack: FocalStack, found: DenseDepth, record: dict[str, object]) -> FocalStack:
    deepened = replace(stack, metadata=stack.metadata | {DEPTH_SOURCE: record})
    write_merged(
        stack.folder,
        _picture(deepened, found),
        _focus_index(stack, found.depth_m),
        found.confidence,
        found.depth_m,
        stack.rec709_from_camera,
    )
    write_focal_stack(deepened)
    write_merge_sheet(deepened)
    return deepened


def _picture(stack: FocalStack, found: DenseDepth) -> Rgb:
    """The second pass where its depth can be trusted, else the first: a wrong depth takes pixels from slices in which they are blurred.

    On traced stacks the mixture is 0 to 2 dB above the second pass and 0.1 to 0.9 dB above the first.
    """
    first = read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path))
    if not stack.is_metric:
        return first
    trusted = np.clip((found.confidence - _DOUBTED) / (_TRUSTED - _DOUBTED), 0.0, 1.0)
    share = cv2.GaussianBlur(trusted.astype(np.float32), (0, 0), _SEAM_PX)[..., None]
    return share * second_pass(stack, found.depth_m) + (1.0 - share) * first


def _focus_index(stack: FocalStack, depth_m: Float[np.ndarray, "height width"]) -> Plane:
    """The fractional index of the slice that is focused at each depth; the first pass's where focus distances are unknown."""
    if not stack.is_metric:
        return read_exr(first_pass_path(stack, stack.depth_path))[0].channels["focus_index"].astype(np.float32)
    dioptres = np.array([1.0 / distance for distance in stack.focus_distances_m if distance is not None])
    order = np.argsort(dioptres)
    return np.interp(1.0 / depth_m, dioptres[order], np.arange(len(dioptres))[order].astype(np.float64)).astype(np.float32)
