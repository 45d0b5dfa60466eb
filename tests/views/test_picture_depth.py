"""Depth of plain photographs from their poses: a traced scene as `capture poses --images` leaves it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from capture.cli import app
from capture.poses.colmap_job import JOB_NAME, ColmapJob, ColmapPicture, job_to_json
from capture.poses.sparse_model import SCALE_NAME, SparseModel, SparseView, write_sparse_model
from mrbokeh.depth.views.still_scene import PosedPicture, StillScene
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.errors import InputError
from tests.support.command_line import printed_by
from tests.support.plane_sweep_scenes import TracedViews, card, traced, wall

PLACES_M = tuple((0.05 * k - 0.1, 0.02 * (-1.0) ** k, 0.0) for k in range(4))


@pytest.fixture(scope="module")
def views() -> TracedViews:
    return traced((wall(1.6), card(0.8, -0.1, 0.12)), PLACES_M)


@pytest.fixture
def reconstruction(tmp_path: Path, views: TracedViews) -> Path:
    (tmp_path / "images").mkdir()
    pictures = tuple(ColmapPicture(f"p{k}", f"p{k}.png", "", 0) for k in range(len(views.rgb)))
    for each, rgb in zip(pictures, views.rgb, strict=True):
        codes = np.round(255.0 * linear_to_srgb(np.clip(rgb, 0.0, 1.0))).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "images" / each.file), codes[..., ::-1])
    write_json(tmp_path / JOB_NAME, job_to_json(ColmapJob(pictures, (None,))))
    placed = tuple(SparseView(each.name, view.camera) for each, view in zip(pictures, views.views, strict=True))
    nothing = {"errors_px": np.zeros(0), "observations": np.zeros((0, 2), int), "observed_xy_px": np.zeros((0, 2))}
    write_sparse_model(tmp_path, SparseModel(placed, np.zeros((0, 3)), **nothing))
    return tmp_path


def depth_of(folder: Path, name: str = "p2") -> np.ndarray:
    return read_exr(folder / "depth" / f"{name}.exr")[0].channels["Z"]


def test_plain_pictures_have_depth_in_the_unit_of_their_poses(
    reconstruction: Path, views: TracedViews, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once their scale is known it is found anew, in metres; a second run, whose pictures and poses are the same, keeps what is there."""
    swept = dict[tuple[bytes, ...], StillScene]()

    def swept_once(small: list[PosedPicture], *others: Any) -> StillScene:
        same = tuple(part.tobytes() for each in small for part in (each.rgb, each.camera.camera_from_world))
        swept[same] = swept.get(same) or StillScene(small, *others)
        return swept[same]

    monkeypatch.setattr("capture.dense.picture_depth.StillScene", swept_once)
    assert "whose metres nobody knows" in printed_by(app, "depth", reconstruction)
    assert (np.abs(depth_of(reconstruction) / views.depth_m[2] - 1.0) < 0.02).mean() > 0.9
    assert (reconstruction / "depth" / "p0.png").is_file()
    write_json(reconstruction / SCALE_NAME, {"metres_per_unit": 10.0})
    assert "Z in metres" in printed_by(app, "depth", reconstruction)
    assert (np.abs(depth_of(reconstruction) / (10.0 * views.depth_m[2]) - 1.0) < 0.02).mean() > 0.9
    before = (reconstruction / "depth" / "p2.exr").stat().st_mtime_ns
    (reconstruction / "depth" / "p0.exr").unlink()
    printed_by(app, "depth", reconstruction)
    assert (reconstruction / "depth" / "p0.exr").is_file() and len(swept) == 2
    assert (reconstruction / "depth" / "p2.exr").stat().st_mtime_ns == before


def test_options_of_stacks_and_missing_pictures_are_told(reconstruction: Path) -> None:
    with pytest.raises(InputError, match="are for stacks"):
        printed_by(app, "depth", reconstruction, "--neighbours", 3)
    (reconstruction / "images" / "p1.png").unlink()
    with pytest.raises(InputError, match="put it back"):
        printed_by(app, "depth", reconstruction)
