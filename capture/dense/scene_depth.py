"""`mrbokeh capture depth`: dense metric depth of every stack from its neighbours and its focus, then the picture made with it.

Needs merged stacks, poses and their scale. The first pass's picture and depth are kept in first_pass/ and are what every run
starts from, so that a run again with other settings, or an interrupted one, gives the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from capture.dense.clues import Clues, SparseDepths
from capture.dense.deepened_stack import write_deepened
from capture.dense.dense_depth import DenseSettings, dense_depth
from capture.dense.depth_fusion import FocusVote, focus_vote_of_map, near_lights
from capture.dense.patch_match_scene import PatchMatchScene
from capture.merging.second_pass import DEPTH_SOURCE, first_pass_path, keep_first_pass
from capture.merging.slice_optics import SliceOptics
from capture.poses.colmap import RECONSTRUCTION_FOLDER
from capture.poses.first_pictures import FirstPictures
from capture.poses.neighbours import nearest_views
from capture.poses.sparse_model import SparseModel, SparseView
from capture.poses.sparse_model_file import read_sparse_model
from capture.poses.sweep_view import SweepView
from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

_FEWEST_POINTS = 20


@dataclass(frozen=True)
class SceneDepthSettings:
    """neighbours: how many views a stack is compared with. overwrite: also where the depth is there already.

    patch_match: COLMAP's PatchMatch narrows the sweep (needs pycolmap-cuda12 and an NVIDIA GPU).
    """

    neighbours: int = 6
    overwrite: bool = False
    patch_match: bool = False
    dense: DenseSettings = field(default_factory=DenseSettings)


@dataclass(frozen=True)
class SceneDepth:
    """stacks: with dense depth now. left_out: names of stacks without a pose, or with guessed metres, which keep their depth from focus."""

    stacks: tuple[FocalStack, ...]
    left_out: tuple[str, ...]


def deepen_scene(scene: Path, settings: SceneDepthSettings | None = None) -> SceneDepth:
    """Dense depth and second-pass picture for every placed stack of a scene; finished ones are kept unless to overwrite."""
    settings = settings or SceneDepthSettings()
    unscaled = read_sparse_model(scene / RECONSTRUCTION_FOLDER)
    model = unscaled.scaled()
    stacks = {stack.folder.name: stack for stack in find_focal_stacks(scene)}
    unmerged = [name for name, stack in stacks.items() if not stack.merged]
    if unmerged:
        raise InputError(f"expected merged stacks in {scene}, but {', '.join(unmerged)} are not: run `mrbokeh capture merge` first")
    placed = [view for view in model.views if view.name in stacks and stacks[view.name].metres_known]
    if len(placed) < 2:
        raise InputError(
            f"dense depth needs two placed stacks or more whose focus is known in metres (`mrbokeh capture scale`), {scene} has "
            f"{len(placed)}: photograph more viewpoints"
        )
    pictures = FirstPictures({view.name: stacks[view.name] for view in placed})
    known = SceneKnowledge(model, pictures, PatchMatchScene(scene, unscaled) if settings.patch_match else None)
    done = [deepen_stack(stacks[view.name], known, settings) for view in track(placed, "depth")]
    return SceneDepth(tuple(done), tuple(sorted(set(stacks) - {view.name for view in placed})))


@dataclass(frozen=True)
class SceneKnowledge:
    """model: in metres. pictures: of the first pass. patch_match: its depths, where it was asked for."""

    model: SparseModel
    pictures: FirstPictures
    patch_match: PatchMatchScene | None = None

    def sparse_depths(self, name: str) -> SparseDepths:
        """Raises InputError where a view sees too few points to know its range of depths."""
        sparse = SparseDepths(*self.model.depths_in(name))
        if len(sparse.depth_m) < _FEWEST_POINTS:
            raise InputError(
                f"{name} sees {len(sparse.depth_m)} points of the sparse model, but its range of depths needs {_FEWEST_POINTS}: "
                f"photograph it from nearer to the other viewpoints"
            )
        return sparse if self.patch_match is None else sparse.joined(self.patch_match.depths_in(name))


def deepen_stack(stack: FocalStack, known: SceneKnowledge, settings: SceneDepthSettings) -> FocalStack:
    """One stack; its pictures are written first and stack.json last."""
    name, pictures = stack.folder.name, known.pictures
    chosen = [view for view in nearest_views(known.model, name, settings.neighbours) if view.name in pictures.stacks]
    record = depth_record(stack, known, [view.name for view in chosen])
    if stack.metadata.get(DEPTH_SOURCE) == record and not settings.overwrite:
        return stack
    keep_first_pass(stack)
    rgb, sparse = pictures.rgb(name), known.sparse_depths(name)
    found = dense_depth(
        rgb,
        _sweep_view(known.model.view(name), pictures.view(name)),
        [_sweep_view(view, pictures.view(view.name)) for view in chosen],
        sparse.dioptre_range(),
        Clues(focus_clue(stack, rgb), sparse),
        settings.dense,
    )
    return write_deepened(stack, found, record)


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


def depth_record(stack: FocalStack, known: SceneKnowledge, neighbours: Sequence[str]) -> dict[str, object]:
    """What a dense depth was made from, as far as stack.json can tell: whether it is still the right one."""
    pose = known.model.view(stack.folder.name).camera.camera_from_world
    points_m = known.model.depths_in(stack.folder.name)[1]
    return {
        "method": "plane sweep and focus" + ("" if known.patch_match is None else ", PatchMatch"),
        "neighbours": list(neighbours),
        "camera_from_world": np.round(pose, 9).tolist(),
        "nearest_point_m": round(float(points_m.min(initial=np.inf)), 9),
        "focus_distances_m": _focus_of(stack),
    }


def is_depth_stale(stack: FocalStack) -> bool:
    """Whether the focus was calibrated anew since the stack's dense depth was found, as another scale does it."""
    record = stack.metadata.get(DEPTH_SOURCE)
    return isinstance(record, Mapping) and record["focus_distances_m"] != _focus_of(stack)


def _focus_of(stack: FocalStack) -> list[float | None]:
    return [None if each is None else round(each, 9) for each in stack.focus_distances_m]
