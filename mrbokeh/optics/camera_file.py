"""A Camera as JSON."""

from typing import Any

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError


def camera_to_json(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "focal_px": list(camera.focal_px),
        "principal_px": list(camera.principal_px),
        "camera_from_world": camera.camera_from_world.tolist(),
    }


def camera_from_json(document: dict[str, Any], where: str = "camera") -> Camera:
    try:
        (fx, fy), (cx, cy) = document["focal_px"], document["principal_px"]
        pose = np.asarray(document["camera_from_world"], np.float64)
        return Camera(int(document["width_px"]), int(document["height_px"]), (float(fx), float(fy)), (float(cx), float(cy)), pose)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: expected width_px, height_px, focal_px, principal_px and camera_from_world ({error!r})") from None
