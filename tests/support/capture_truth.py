"""Captured stacks against the truth they were traced from: the all-in-focus picture, also on the dark card of lights, and depth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image
from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import read_json

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

OFF_DIOPTRE = 0.05
BORDER_SHARE = 0.02
"""Registered slices have no data at the very border of a jittered stack: both sides of a comparison leave it out."""

_ON_CARD_M = 0.01
_SEEN_DIOPTRE = 0.01
_DETAIL_SIGMAS = 3.0


@dataclass(frozen=True)
class ViewTruth:
    """What is known of one viewpoint of a made RAW stack (`datasets_scripts.make_raw_stack`)."""

    camera: Camera
    rgb: Rgb
    depth_m: Plane
    card: Mask

    @property
    def inner(self) -> Mask:
        height, width = self.depth_m.shape
        border = int(np.ceil(BORDER_SHARE * width))
        inner = np.zeros((height, width), bool)
        inner[border:-border, border:-border] = True
        return inner


@dataclass(frozen=True)
class Score:
    """picture_db, card_db: PSNR of linear Rec.709 clipped to 1. depth_median: relative; off_share: pixels off by 0.05 dioptres.

    allowed_share: pixels where depth can be known (texture, or a neighbour that sees the place and texture within a window).
    """

    picture_db: float
    card_db: float
    depth_median: float
    off_share: float
    off_share_everywhere: float
    allowed_share: float


def view_truth(data: Path, view: int) -> ViewTruth:
    """The truth of a viewpoint; card: where the dark card is seen (nowhere without one)."""
    document = read_json(data / "truth.json", "the truth of a RAW stack")
    folder = data / "truth" / f"view_{view}"
    camera = camera_from_json(document["views"][view]["reference_camera"])
    depth_m = read_exr(folder / "depth.exr")[0].stacked(["Z"])[..., 0].astype(np.float32)
    return ViewTruth(camera, read_image(folder / "all_in_focus.exr"), depth_m, _card(document, camera, depth_m))


def picture_db(picture: Rgb, truth: Rgb, where: Mask) -> float:
    """PSNR in dB over the pixels asked for, linear light clipped to [0, 1]."""
    error = (np.clip(picture, 0.0, 1.0) - np.clip(truth, 0.0, 1.0))[where]
    return float(-10.0 * np.log10(np.mean(error.astype(np.float64) ** 2)))


def score(stack: FocalStack, truth: ViewTruth, others: list[ViewTruth], noise: float = 0.01) -> Score:
    """A merged stack against the truth in the geometry of its reference slice. noise: standard deviation of the slices at white."""
    picture, depth_m = stack.all_in_focus(), stack.depth_m()
    allowed = truth.inner & depth_can_be_known(truth, others, noise)
    off = np.abs(1.0 / depth_m - 1.0 / truth.depth_m) > OFF_DIOPTRE
    return Score(
        picture_db(picture, truth.rgb, truth.inner),
        picture_db(picture, truth.rgb, truth.inner & truth.card) if truth.card.any() else float("nan"),
        float(np.median(np.abs(depth_m / truth.depth_m - 1.0)[truth.inner])),
        float(off[allowed].mean()),
        float(off[truth.inner].mean()),
        float(allowed[truth.inner].mean()),
    )


def depth_can_be_known(truth: ViewTruth, others: list[ViewTruth], noise: float) -> Mask:
    """Where texture or a neighbour allows: detail stands above the noise, so that focus tells, or another view sees the place
    and there is at least faint detail to recognise it by.
    """
    luminance = truth.rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    detail = cv2.GaussianBlur((luminance - cv2.GaussianBlur(luminance, (0, 0), 2.0)) ** 2, (0, 0), 2.5)
    floor = (noise * noise) * np.maximum(cv2.GaussianBlur(luminance, (0, 0), 2.5), 1e-3)
    strong, faint = detail > _DETAIL_SIGMAS**2 * floor, detail > floor
    seen = np.zeros(strong.shape, bool)
    for other in others:
        seen |= _seen_by(truth, other)
    return np.asarray(strong | (faint & seen))


def _seen_by(truth: ViewTruth, other: ViewTruth) -> Mask:
    """Where the other camera has the same surface, not something in front of it and not the edge of its picture."""
    points_m = truth.camera.unproject(truth.camera.pixel_centres_px(), truth.depth_m)
    xy_px, depth_m = other.camera.project(points_m)
    x, y = (xy_px - 0.5).astype(np.float32).transpose(2, 0, 1)
    there_m = cv2.remap(other.depth_m, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return np.asarray(np.abs(1.0 / there_m - 1.0 / depth_m) < _SEEN_DIOPTRE)


def _card(document: dict[str, Any], camera: Camera, depth_m: Plane) -> Mask:
    """Pixels of the dark card: within its outline and at its plane, so that what stands before it is left out."""
    mask = np.zeros(depth_m.shape, np.uint8)
    if "dark_card_corners_m" not in document:
        return mask.astype(bool)
    corners_m: Float[np.ndarray, "4 3"] = np.array(document["dark_card_corners_m"])
    outline_px, _ = camera.project(corners_m)
    cv2.fillConvexPoly(mask, np.round((outline_px - 0.5) * 16).astype(np.int32), 1, shift=4)
    points_m = camera.unproject(camera.pixel_centres_px(), depth_m.astype(np.float64))
    normal = np.cross(corners_m[1] - corners_m[0], corners_m[3] - corners_m[0])
    away_m = np.abs((points_m - corners_m[0]) @ (normal / np.linalg.norm(normal)))
    return np.asarray((mask > 0) & (away_m < _ON_CARD_M))
