"""Depth of plain photographs from their camera poses: those of `mrbokeh capture poses --images` and of match-moved clips.

Writes DIR/depth/NAME.exr (Z, `confidence`) for each placed picture, and NAME.png, the picture beside its depth.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from capture.poses.colmap_job import JOB_NAME, ColmapJob, job_from_json
from capture.poses.sparse_model import POSES_NAME, SparseView, read_sparse_model
from mrbokeh.depth.views.still_scene import PosedPicture, StillScene, cameras_digest
from mrbokeh.distortion import LensDistortion
from mrbokeh.figures.stack_pictures import nearness_codes
from mrbokeh.images.color import display_rgb8, srgb_to_linear
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.picture_codec import write_stored
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError

DEPTH_FOLDER = "depth"
_RECORD = "depth.json"


@dataclass(frozen=True)
class PicturesWithDepth:
    """The result. folder: of the files. names: of the pictures that have depth now. metric: whether it is metres."""

    folder: Path
    names: tuple[str, ...]
    metric: bool


def is_reconstruction(folder: Path) -> bool:
    """Return whether a folder holds the poses of plain pictures, and no scene of stacks."""
    return (folder / POSES_NAME).is_file()


def deepen_pictures(folder: Path, *, overwrite: bool = False, device: str | None = None) -> PicturesWithDepth:
    """Write the depth of every placed picture of a reconstruction that has none by these poses yet. device: of torch, for the sweeps."""
    model = read_sparse_model(folder)
    metric = model.metres_per_unit is not None
    model = model.scaled() if metric else model
    job = job_from_json(read_json(folder / JOB_NAME, "what COLMAP was asked to do (run `mrbokeh capture poses --overwrite`)"))
    if len(model.views) < 2:
        raise InputError(f"{folder} has {len(model.views)} placed picture, but depth needs two or more: photograph more viewpoints")
    out = folder / DEPTH_FOLDER
    record = {"poses": cameras_digest((view.name, view.camera, view.distortion) for view in model.views), "metric": metric}
    current = (out / _RECORD).exists() and read_json(out / _RECORD, "what depth was made from") == record
    wanted = [view for view in model.views if overwrite or not (current and _file(out, view).exists())]
    if wanted:
        scene = StillScene([_picture(folder, job, view).small() for view in model.views], str(folder), device)
        for path in [] if current else [_file(out, view) for view in model.views]:
            path.unlink(missing_ok=True)
        out.mkdir(parents=True, exist_ok=True)
        write_json(out / _RECORD, record)
        _write(scene, ((view, _picture(folder, job, view)) for view in wanted), out, len(wanted))
    return PicturesWithDepth(out, tuple(view.name for view in model.views), metric)


def _write(scene: StillScene, pictures: Iterable[tuple[SparseView, PosedPicture]], out: Path, count: int) -> None:
    for view, picture in track(pictures, "depth of pictures", count):
        found = scene.depth_of(picture)
        _file(out, view).parent.mkdir(parents=True, exist_ok=True)
        colours = nearness_codes((1.0 / found.depth).astype(np.float32), found.confidence)
        write_stored(_file(out, view).with_suffix(".png"), np.hstack([display_rgb8(picture.rgb), colours]))
        write_exr(_file(out, view), ExrPart({"Z": found.depth, "confidence": found.confidence.astype(np.float16)}))


def _file(out: Path, view: SparseView) -> Path:
    return out / f"{view.name}.exr"


def _picture(folder: Path, job: ColmapJob, view: SparseView) -> PosedPicture:
    bent = LensDistortion.of("opencv", k1=view.distortion[0], k2=view.distortion[1])
    return PosedPicture(_rgb(folder / job.pictures_folder / job.file_of(view.name), view), view.camera, bent)


def _rgb(path: Path, view: SparseView) -> Float32[np.ndarray, "height width 3"]:
    """Read a picture as COLMAP did, as it lies in the file."""
    stored = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if stored is None or stored.shape[:2] != (view.camera.height_px, view.camera.width_px):
        came = "nothing that can be read" if stored is None else f"{stored.shape[1]}x{stored.shape[0]} px"
        raise InputError(
            f"expected the picture of {view.camera.width_px}x{view.camera.height_px} px at {path} from which the poses come, found {came}: "
            f"put it back, or run `mrbokeh capture poses --overwrite`"
        )
    return srgb_to_linear(stored[..., ::-1].astype(np.float32) / np.float32(255.0))
