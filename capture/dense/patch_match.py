"""COLMAP's PatchMatch stereo as an optional source of depth: it needs the package pycolmap-cuda12 and an NVIDIA GPU.

The packages pycolmap and pycolmap-cuda12 hold one module of the same name: never install both. `pycolmap.has_cuda` tells how the
module was built, not whether a GPU is there, and COLMAP ends the whole process without one: so the driver is asked first.
The project's own tests do not run PatchMatch, for want of such a machine; they cover the code around it.

It runs once for a whole scene, in SCENE/reconstruction/patch_match, and its depths become priors of the dense depth.
"""

import ctypes
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from capture.dense.depth_priors import SparseDepths
from capture.poses.colmap_job import JOB_NAME, MODEL_FOLDER, RECONSTRUCTION_FOLDER, job_from_json
from capture.poses.sparse_model import Distortion, SparseModel, undistorted_px
from mrbokeh.optics.camera import Camera
from mrbokeh.system.atomic_files import read_json
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
