"""`mrbokeh capture depth`: dense metric depth of every stack from its neighbours and its focus, and the picture made with it.

Needs merged stacks, poses and their scale. The first pass's picture and depth are kept in first_pass/ as the input of every run,
so that a run with other settings, or a continued one, gives the same result.

COLMAP's PatchMatch stereo is an optional source of depth. It runs once for a whole scene, in SCENE/reconstruction/patch_match, and its
depths become priors of the dense depth. It needs the package pycolmap-cuda12 and an NVIDIA GPU. The packages pycolmap and pycolmap-cuda12
hold one module of the same name: never install both. `pycolmap.has_cuda` tells how the module was built, not whether a GPU is there, and
COLMAP ends the whole process without one: so the driver is asked first. The project's own tests do not run PatchMatch, for want of such a
machine; they cover the code around it.
"""

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.merging.merge import GHOSTS
from capture.merging.merged_pictures import write_readable_pictures
from capture.merging.preferred_side import PREFERRED
from capture.merging.retouch import RETOUCHES
from capture.merging.second_pass import SliceOptics, first_pass_path, keep_first_pass, second_pass
from capture.poses.colmap_job import JOB_NAME, MODEL_FOLDER, RECONSTRUCTION_FOLDER, job_from_json
from capture.poses.sparse_model import SparseModel, SparseView, read_sparse_model
from mrbokeh.depth.views.dense_depth import DenseDepth, DenseSettings, dense_depth
from mrbokeh.depth.views.depth_priors import DepthPriors, FocusVote, SparseDepths, focus_vote_of_map, near_highlights
from mrbokeh.depth.views.sweep_view import SweepView, neighbour_vote, structure_of
from mrbokeh.distortion.radial import Distortion, undistorted_px
from mrbokeh.figures.stack_pictures import write_merge_sheet
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.focal_stack import DEPTH_SOURCE, FocalStack, find_focal_stacks, write_focal_stack, write_merged
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]

_MAPS = Path("stereo") / "depth_maps"
WORKSPACE = "patch_match"
_FINISHED = "finished"


def patch_match_obstacle() -> str | None:
    """Return why PatchMatch cannot run here, as a sentence; None if it can."""
    try:
        import pycolmap
    except ImportError:
        return "PatchMatch needs the package pycolmap-cuda12, which is not installed: pip install pycolmap-cuda12"
    if not pycolmap.has_cuda:
        return (
            "PatchMatch needs COLMAP built for CUDA, but the package pycolmap is the one without it: "
            "pip uninstall pycolmap, then pip install pycolmap-cuda12 (never both), or leave out --patch-match"
        )
    if nvidia_gpus() == 0:
        return "PatchMatch needs an NVIDIA GPU, and its driver finds none: leave out --patch-match, the plane sweep runs on the CPU"
    return None


def nvidia_gpus() -> int:
    """Count the GPUs that the driver sees; 0 without a driver."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    found = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    return count.value if found else 0


def run_patch_match(sparse: Path, pictures: Path, workspace: Path) -> None:
    """Write depth maps of COLMAP's sparse model to the workspace, in the model's unit. Raises InputError if it cannot run."""
    obstacle = patch_match_obstacle()
    if obstacle:
        raise InputError(obstacle)
    import pycolmap

    pycolmap.undistort_images(workspace, sparse, pictures)
    pycolmap.patch_match_stereo(workspace)


def read_patch_match(workspace: Path, picture: str, camera: Camera, distortion: Distortion) -> Plane:
    """Read the depth (H, W) of a picture (its file name) on its own, distorted pixels, in the model's unit; NaN where COLMAP has none."""
    import pycolmap

    path = workspace / _MAPS / f"{picture}.geometric.bin"
    if not path.is_file():
        raise InputError(f"expected a depth map of PatchMatch at {path}, found none: run it again with --overwrite")
    depths = pycolmap.DepthMap()
    depths.read(path)
    model = pycolmap.Reconstruction(workspace / "sparse")
    pinhole = next(image.camera for image in model.images.values() if image.name == picture)
    fx, fy, cx, cy = (float(each) for each in pinhole.params)
    undistorted = Camera(pinhole.width, pinhole.height, (fx, fy), (cx, cy))
    return on_original_pixels(np.asarray(depths.to_array(), np.float32), undistorted, camera, distortion)


def on_original_pixels(depth: Float32[np.ndarray, "rows columns"], undistorted: Camera, camera: Camera, distortion: Distortion) -> Plane:
    """Resample an undistorted picture's depth (0: none) to the pixels of the original by nearest neighbour; NaN where there is none."""
    rays = (undistorted_px(camera, distortion, camera.pixel_centres_px()) - camera.principal_px) / np.asarray(camera.focal_px)
    samples = (rays * undistorted.focal_px + undistorted.principal_px - 0.5).astype(np.float32)
    x, y = np.moveaxis(np.nan_to_num(samples, nan=-10.0), -1, 0)
    found = cv2.remap(depth, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_NEAREST, borderValue=0.0)
    return np.where(found > 0, found, np.nan).astype(np.float32)


def patch_match_prior(depth_m: Plane) -> SparseDepths:
    """Return all known pixels as sparse depths, so that the sweep searches only near them."""
    row, column = np.nonzero(np.isfinite(depth_m))
    return SparseDepths(np.stack([column + 0.5, row + 0.5], axis=-1), depth_m[row, column].astype(np.float64))


class PatchMatchScene:
    """PatchMatch depths of a scene. model: in COLMAP's own unit, with its scale. Raises InputError if PatchMatch cannot run."""

    def __init__(self, scene: Path, model: SparseModel) -> None:
        obstacle = patch_match_obstacle()
        if obstacle:
            raise InputError(obstacle)
        folder = scene / RECONSTRUCTION_FOLDER
        job = job_from_json(read_json(folder / JOB_NAME, "what COLMAP was asked to do (run `mrbokeh capture poses --overwrite`)"))
        self._job, self._model, self._workspace = job, model, folder / WORKSPACE
        if not (self._workspace / _FINISHED).is_file():
            run_patch_match(folder / MODEL_FOLDER, folder / job.pictures_folder, self._workspace)
            (self._workspace / _FINISHED).touch()

    def depths_in(self, name: str) -> SparseDepths:
        """Return every pixel of a view that PatchMatch knows, in metres."""
        view = self._model.view(name)
        depth = read_patch_match(self._workspace, self._job.file_of(name), view.camera, view.distortion)
        return patch_match_prior((depth * np.float32(self._model.metres_per_unit)).astype(np.float32))


Rgb = Float32[np.ndarray, "height width 3"]

# Between these confidences the second pass takes over from the first; seams are as soft as this.
_DOUBTED, _TRUSTED = 0.3, 0.6
_SEAM_PX = 1.5
_FEWEST_POINTS = 20
_HELD = 8


class FirstPictures:
    """First-pass pictures of a scene's stacks, by the name of their view. A few structures are cached."""

    def __init__(self, stacks: dict[str, FocalStack]) -> None:
        self.stacks = stacks
        self.view = lru_cache(_HELD)(self._view)

    def rgb(self, name: str) -> Float32[np.ndarray, "height width 3"]:
        """Return linear Rec.709."""
        stack = self.stacks[name]
        return stack.to_rec709(read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path)))

    def _view(self, view_name: str) -> Float32[np.ndarray, "height width"]:
        return structure_of(self.rgb(view_name))


def nearest_views(model: SparseModel, name: str, count: int) -> list[SparseView]:
    """Return at most `count` other views that tell most about the depth of one, best first."""
    reference, mine = model.view(name), model.points_of(name)
    votes = []
    for view in model.views:
        common = model.points[np.intersect1d(mine, model.points_of(view))] if view.name != name else np.zeros((0, 3))
        votes.append(neighbour_vote(common, reference.centre, view.centre))
    order = sorted(range(len(votes)), key=lambda index: -votes[index])
    return [model.views[index] for index in order[:count] if votes[index] > 0.0]


@dataclass(frozen=True)
class SceneDepthSettings:
    """Settings of a scene's depth.

    neighbours: how many views a stack is compared with. overwrite: recompute existing depth.
    patch_match: COLMAP's PatchMatch narrows the sweep (needs pycolmap-cuda12 and an NVIDIA GPU).
    """

    neighbours: int = 6
    overwrite: bool = False
    patch_match: bool = False
    dense: DenseSettings = field(default_factory=DenseSettings)


@dataclass(frozen=True)
class SceneDepth:
    """The result.

    Stacks: with dense depth now. left_out: names of stacks without a pose, or with guessed metres; they keep depth from focus.
    """

    stacks: tuple[FocalStack, ...]
    left_out: tuple[str, ...]


def deepen_scene(scene: Path, settings: SceneDepthSettings | None = None) -> SceneDepth:
    """Compute dense depth and second-pass picture for every placed stack of a scene; finished ones are kept unless overwrite is set."""
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
    """Shared inputs of all stacks. model: in metres. pictures: of the first pass. patch_match: its depths, if requested."""

    model: SparseModel
    pictures: FirstPictures
    patch_match: PatchMatchScene | None = None

    def sparse_depths(self, name: str) -> SparseDepths:
        """Return the known depths of a view. Raises InputError if it sees too few points to know its range of depths."""
        sparse = SparseDepths(*self.model.depths_in(name))
        if len(sparse.depth_m) < _FEWEST_POINTS:
            raise InputError(
                f"{name} sees {len(sparse.depth_m)} points of the sparse model, but its range of depths needs {_FEWEST_POINTS}: "
                f"photograph it from nearer to the other viewpoints"
            )
        return sparse if self.patch_match is None else sparse.joined(self.patch_match.depths_in(name))


def deepen_stack(stack: FocalStack, known: SceneKnowledge, settings: SceneDepthSettings) -> FocalStack:
    """Compute and write the depth of one stack; its pictures are written first and stack.json last."""
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
        DepthPriors(focus_prior(stack, rgb), sparse),
        settings.dense,
    )
    return write_deepened(stack, found, record)


def _sweep_view(view: SparseView, structure: Plane) -> SweepView:
    """Resize a sparse view's camera from the size COLMAP saw to that of the structure."""
    height, width = structure.shape
    camera = view.camera if (view.camera.width_px, view.camera.height_px) == (width, height) else view.camera.resized(width, height)
    return SweepView(structure, camera, view.distortion)


def focus_prior(stack: FocalStack, rgb: Rgb) -> FocusVote | None:
    """Return the vote of the first pass's depth from focus, without trust near highlights; None if focus distances are unknown."""
    if not stack.is_metric:
        return None
    channels = read_exr(first_pass_path(stack, stack.depth_path))[0].channels
    optics = SliceOptics.of_stack(stack, rgb.shape[1])
    largest_coc_px = float(max(optics.px_per_dioptre) * np.ptp(optics.focus_dioptres))
    confidence = np.where(near_highlights(rgb, largest_coc_px), 0.0, channels["confidence"])
    return focus_vote_of_map(channels["focus_index"].astype(np.float32), confidence.astype(np.float32), np.array(optics.focus_dioptres))


def depth_record(stack: FocalStack, known: SceneKnowledge, neighbours: Sequence[str]) -> dict[str, object]:
    """Return what a dense depth was made from, as far as stack.json can tell, to decide whether it is still valid."""
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
    """Tell whether the focus was recalibrated, for example by another scale, since the stack's dense depth was found."""
    record = stack.metadata.get(DEPTH_SOURCE)
    return isinstance(record, Mapping) and record["focus_distances_m"] != _focus_of(stack)


def _focus_of(stack: FocalStack) -> list[float | None]:
    return [None if each is None else round(each, 9) for each in stack.focus_distances_m]


def write_deepened(stack: FocalStack, found: DenseDepth, record: dict[str, object]) -> FocalStack:
    """Write the pictures first, stack.json last, without retouches and the preferred side, which belong to the first picture.

    record: what the depth was made from.
    """
    kept = {key: value for key, value in stack.metadata.items() if key not in (RETOUCHES, PREFERRED, GHOSTS)}
    deepened = replace(stack, metadata=kept | {DEPTH_SOURCE: record})
    write_merged(
        stack.folder,
        _picture(deepened, found),
        _focus_index(stack, found.depth_m),
        found.confidence,
        found.depth_m,
        stack.rec709_from_camera,
    )
    write_readable_pictures(deepened)
    write_focal_stack(deepened)
    write_merge_sheet(deepened)
    return deepened


def _picture(stack: FocalStack, found: DenseDepth) -> Rgb:
    """Return the second pass where its depth is trusted, else the first: a wrong depth selects slices in which a pixel is blurred.

    On traced stacks the mixture is 0 to 2 dB above the second pass and 0.1 to 0.9 dB above the first.
    """
    first = read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path))
    if not stack.is_metric:
        return first
    trusted = np.clip((found.confidence - _DOUBTED) / (_TRUSTED - _DOUBTED), 0.0, 1.0)
    share = cv2.GaussianBlur(trusted.astype(np.float32), (0, 0), _SEAM_PX)[..., None]
    return share * second_pass(stack, found.depth_m) + (1.0 - share) * first


def _focus_index(stack: FocalStack, depth_m: Float[np.ndarray, "height width"]) -> Plane:
    """Return the fractional index of the slice focused at each depth; the first pass's if focus distances are unknown."""
    if not stack.is_metric:
        return read_exr(first_pass_path(stack, stack.depth_path))[0].channels["focus_index"].astype(np.float32)
    dioptres = np.array([1.0 / distance for distance in stack.focus_distances_m if distance is not None])
    order = np.argsort(dioptres)
    return np.interp(1.0 / depth_m, dioptres[order], np.arange(len(dioptres))[order].astype(np.float64)).astype(np.float32)
