"""Statistics of COLMAP's matches, and the messages that explain a missing or weak model with them."""

from pathlib import Path
from typing import Any

import numpy as np

from capture.poses.sparse_model import SparseModel

FEWEST_MATCHES = 50
"""Pairs with fewer verified matches carry no reconstruction: COLMAP starts from a pair of 100, or of 50 when nothing better is there."""

LEAST_PARALLAX_DEG = 4.0
"""The least median angle under which COLMAP starts, after it has relaxed its 16 degrees twice."""

MOST_FORWARD = 0.95
"""|t_z| / |t| above which COLMAP takes a pair for forward motion and does not start from it."""

LEAST_MODEL_PARALLAX_DEG = 1.5
"""COLMAP drops points below this; a model whose median is here has no depth to speak of."""


def match_statistics(database: Path) -> dict[str, Any]:
    """Return pictures, pairs, good_pairs (FEWEST_MATCHES or more), and the fractions with low parallax and with forward motion."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        pair_ids, geometries = opened.read_two_view_geometries()
        angles_deg, forward = [], []
        good = [each for each in zip(pair_ids, geometries, strict=True) if len(each[1].inlier_matches) >= FEWEST_MATCHES]
        for pair_id, geometry in good:
            if geometry.cam2_from_cam1 is None:
                continue
            pair = [images[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id)]
            rays = [_rays(opened, image, geometry.inlier_matches[:, side]) for side, image in enumerate(pair)]
            angles_deg.append(_parallax_deg(rays[0], rays[1], geometry.cam2_from_cam1.rotation.matrix()))
            forward.append(_forward(geometry.cam2_from_cam1.translation))
    return {
        "pictures": len(images),
        "pairs": len(images) * (len(images) - 1) // 2,
        "good_pairs": len(good),
        "low_parallax": float(np.mean(np.array(angles_deg) < LEAST_PARALLAX_DEG)) if angles_deg else 0.0,
        "forward": float(np.mean(np.array(forward) > MOST_FORWARD)) if forward else 0.0,
    }


def _rays(opened: Any, image: Any, keypoints: np.ndarray) -> np.ndarray:
    """Return (K, 3) unit vectors in camera axes, by the camera before any mapping."""
    camera = opened.read_camera(image.camera_id)
    plane = camera.cam_from_img(opened.read_keypoints(image.image_id)[keypoints, :2].astype(np.float64))
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _parallax_deg(rays_1: np.ndarray, rays_2: np.ndarray, rotation_2_from_1: np.ndarray) -> float:
    """Return the median angle between the two rays of a match in one frame, which is the angle between the cameras seen from the point."""
    cosines = np.sum(rays_1 @ rotation_2_from_1.T * rays_2, axis=1)
    return float(np.degrees(np.arccos(np.clip(np.median(cosines), -1.0, 1.0))))


def _forward(translation: np.ndarray) -> float:
    length = float(np.linalg.norm(translation))
    return abs(float(translation[2])) / length if length else 0.0


def failure_message(seen: dict[str, Any]) -> str:
    """Explain why there is no model and what to do."""
    pictures, pairs, good = seen["pictures"], seen["pairs"], seen["good_pairs"]
    if good < max(1, pictures - 1):
        why = f"only {good} of {pairs} pairs of pictures share {FEWEST_MATCHES} points, too few to connect them"
        what = "photograph more texture, or from places nearer to one another"
    elif seen["forward"] + seen["low_parallax"] >= 0.5:
        why = (
            f"of {good} well matched pairs {100 * seen['forward']:.0f} % move along the line of sight and "
            f"{100 * seen['low_parallax']:.0f} % see their points under less than {LEAST_PARALLAX_DEG:g} degrees, which leaves depth open"
        )
        what = "move the camera sideways between viewpoints, by a tenth to a third of the distance to the subject"
    else:
        why = f"{good} of {pairs} pairs match, but no pair gives a start that the others agree with"
        what = "add viewpoints between the present ones, or try --mapper global"
    return f"COLMAP found no camera poses for these {pictures} pictures: {why}; {what}"


def weak_model_message(model: SparseModel) -> str | None:
    """Return None if the model is usable, else the reason: too few views, or too small an angle between the rays to its points."""
    placed, total = len(model.views), len(model.views) + len(model.left_out)
    if 2 * placed <= total or (placed < 3 <= total):
        return (
            f"COLMAP placed only {placed} of {total} pictures ({', '.join(view.name for view in model.views)}): the others do not "
            f"connect to them; add viewpoints between, with half of the picture in common"
        )
    angle_deg = median_parallax_deg(model)
    if angle_deg < LEAST_MODEL_PARALLAX_DEG:
        return (
            f"COLMAP's points are seen under a median angle of {angle_deg:.2f} degrees, less than the {LEAST_MODEL_PARALLAX_DEG:g} that "
            f"depth needs: move the camera farther sideways between viewpoints"
        )
    return None


def median_parallax_deg(model: SparseModel) -> float:
    """Return the median over the points of the largest angle between two of their rays."""
    centres = np.array([view.centre for view in model.views])
    views, points = model.observations.T
    rays = model.points[points] - centres[views]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    order = np.argsort(points, kind="stable")
    groups = np.split(rays[order], np.flatnonzero(np.diff(points[order])) + 1)
    cosines = [float(np.min(group @ group.T)) for group in groups]
    return float(np.degrees(np.arccos(np.clip(np.median(cosines), -1.0, 1.0)))) if cosines else 0.0
