"""Level ground of `mrbokeh composite`, for a photograph without depth: the camera by its lines, an object's place by a pixel."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.commands._composite_options import ObjectOptions
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.color import luminance
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.solving.solved_camera import GUESSED, KNOWN, LOW, SolvedCamera, read_solved_camera
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, say, warn

HIGH_SHARE = 0.25
"""Share of the picture's height that an object takes whose size is neither told nor known."""
_EYES_M, _LOWEST_M, _HIGHEST_M, _FARTHEST_M = 1.5, 0.15, 5.0, 100.0
"""Height of a camera in the hand; heights that are believed where the focus distance is taken for that of the ground; and its farthest."""
_BELOW_DEG, _BELOW_SHARE, _BELOW_M = 10.0, 0.5, 1.2
_SAME_SHAPE = 0.01
_SKY_ROWS, _SKY_BLUE, _SKY_STEP, _SKY_LIGHT, _SKY_LEAST = 96, 1.2, 0.2, 0.03, 0.08
"""Rows of the small picture in which sky is looked for; what is sky: blue over red, the largest step of the logarithm of its light from row
to row, and the least light; and of a column the least share. In 22 of 88 photographs of all kinds it is found, and ends at the horizon or
above it in each."""
_POINTED_PX, _SURE_DEG, _LEAST_FALL, _LOWEST_SUN, _LOW_SUN_DEG = 4.0, 20.0, 1e-4, 0.01, 6.0

Pixel = tuple[float, float]


def with_camera_of_file(plate: Plate, path: Path) -> tuple[Plate, float | None]:
    """Return the plate as a camera of `mrbokeh capture solve` saw it, and the height of that camera in metres, if it is known."""
    solved = read_solved_camera(path)
    height_px, width_px = plate.rgb.shape[:2]
    if abs(math.log(solved.width_px * height_px / (solved.height_px * width_px))) > _SAME_SHAPE:
        raise InputError(
            f"the camera of {path} is of a picture of {solved.width_px}x{solved.height_px} px, but the photograph has "
            f"{width_px}x{height_px} px: solve that one"
        )
    say(f"the camera of {path} {_told(plate, solved)}")
    return _seen_by(plate, solved), solved.camera_height_m if solved.camera_height_source == KNOWN else None


def on_level_ground(plate: Plate, standing: ObjectOptions, known_height_m: float | None = None) -> tuple[Plate, ObjectOptions]:
    """Return the plate, upright and focused on the first foot where nothing tells its focus, and the options with the feet's places.

    All feet are on one level ground, whose depth below the camera the first one tells. known_height_m: of a solved camera;
    --camera-height comes before it. Raises InputError for a pixel that shows no ground.
    """
    for foot_px in standing.pixels:
        plate.require_pixel(*foot_px)
    taken = []
    if standing.pitch is None and plate.world_from_camera is None:
        plate = _by_lines(plate)
    rays = [plate.camera.unproject(np.array(foot_px), np.array(1.0)) for foot_px in standing.pixels]
    if standing.pitch is None and plate.world_from_camera is None:
        down_rad = usual_tilt_rad(plate, rays[0])
        down_rad = down_rad if abs(math.degrees(down_rad)) >= 1.0 else 0.0
        plate = replace(plate, world_from_camera=looking_down(down_rad))
        way = "down" if down_rad > 0.0 else "up"
        held = f"to look {way} by {abs(math.degrees(down_rad)):.0f} degrees" if down_rad else "to be level"
        taken.append(f"the camera {held} (--pitch DEGREES)")
    plate = held_as_told(plate, standing)
    nearest_m = [_ground_m(plate, *each) for each in zip(rays, standing.at_pixel or (), strict=True)]
    height_m, told = _camera_height_m(plate, standing.camera_height or known_height_m, nearest_m[0])
    distance_m = height_m * nearest_m[0]
    taken += [told] if told else []
    if plate.rough_focus_m is not None and plate.rough_focus_m[0] <= distance_m <= plate.rough_focus_m[1]:
        plate = replace(plate, lens=plate.lens.focused_at(distance_m))
    elif not plate.focus_known:
        taken.append(f"the focus to be on the object, {distance_m:.3g} m away (--focus METRES)")
        plate = replace(plate, lens=plate.lens.focused_at(distance_m))
    guess(f"there is no depth: mrbokeh takes {', '.join(taken)}" if taken else "")
    height = standing.height
    if not height:
        height = [f"{max(1.0, HIGH_SHARE * plate.rgb.shape[0]):.0f}px"]
        guess(f"the object is made {height[0]} high, a quarter of the picture (--height METRES or such as 300px)")
    places = [",".join(f"{each:.9g}" for each in height_m * along_m * ray) for along_m, ray in zip(nearest_m, rays, strict=True)]
    return plate, replace(standing, at=places, at_pixel=None, height=height)


def held_as_told(plate: Plate, standing: ObjectOptions) -> Plate:
    """Return the plate of a camera that looks down and is turned as far as --pitch and --roll say; of what they leave out, as is known."""
    if standing.pitch is None and standing.roll is None:
        return plate
    known = np.eye(3) if plate.world_from_camera is None else plate.world_from_camera
    down_deg = _down_deg(known) if standing.pitch is None else standing.pitch
    roll_deg = rolled_deg(known) if standing.roll is None else standing.roll
    return replace(plate, world_from_camera=looking_down(math.radians(down_deg), math.radians(roll_deg)))


def focused_on_foot(plate: Plate, standing: ObjectOptions) -> Plate:
    """Return a plate with depth focused on the foot of the first object, where nothing tells its focus."""
    foot_m = plate.depth_at_m(*standing.first_px)
    if plate.focus_known or not 0.0 < foot_m < math.inf:
        return plate
    guess(f"nothing tells the focus: it is taken to be on the object, {foot_m:.3g} m away (--focus METRES, --focus-at X,Y)")
    return replace(plate, lens=plate.lens.focused_at(foot_m))


def usual_tilt_rad(plate: Plate, ray: Float[np.ndarray, "3"]) -> float:
    """Return how far a camera usually looks down where nothing tells: 0 if the ground at a ray then lies deep enough below the horizon.

    That is 10 degrees, or for ground at the focus so many that it is 1.2 m, or half its distance, below the camera. Where blue sky is seen
    below the horizon that this gives, the horizon lies where the sky ends: less, and below 0 where the camera looks up.
    """
    below_rad = math.radians(_BELOW_DEG)
    if plate.focus_known and plate.lens.focus_distance_m < _FARTHEST_M:
        below_rad = math.asin(min(_BELOW_SHARE, _BELOW_M / plate.lens.focus_distance_m))
    usual_rad = max(0.0, below_rad - math.atan(float(ray[1])))
    sky_share = sky_ends_at(plate.rgb)
    if sky_share is None:
        return usual_rad
    above_px = plate.camera.principal_px[1] - sky_share * plate.rgb.shape[0]
    return min(usual_rad, math.atan(above_px / plate.camera.focal_px[1]))


def sky_ends_at(rgb: Float32[np.ndarray, "height width 3"]) -> float | None:
    """Return the row, in heights of the picture, down to which a scene-linear picture shows blue sky; None where it shows little of it.

    Sky goes down from the upper edge without an edge of its own in columns that are a third of the picture; a tenth of them may be wrong.
    """
    import cv2

    height_px, width_px = rgb.shape[:2]
    scale = _SKY_ROWS / min(height_px, width_px)
    small = cv2.resize(rgb, (max(1, round(scale * width_px)), max(1, round(scale * height_px))), interpolation=cv2.INTER_AREA)
    red, green, blue = np.moveaxis(np.maximum(small, np.float32(1e-4)), 2, 0)
    light = np.log(luminance(np.maximum(small, np.float32(1e-4))))
    even = np.abs(np.diff(light, axis=0, prepend=light[:1])) < _SKY_STEP
    sky = (blue > _SKY_BLUE * red) & (blue > green) & even & (light > math.log(_SKY_LIGHT))
    down = np.where(sky.all(axis=0), len(sky), np.argmin(sky, axis=0))
    there = down >= _SKY_LEAST * len(sky)
    return float(np.quantile(down[there], 0.9)) / len(sky) if there.mean() >= 1.0 / 3.0 else None


def sun_by_shadow(plate: Plate, top_px: Pixel, foot_px: Pixel, tip_px: Pixel) -> str:
    """Return --sun RIGHT,ABOVE by a shadow on level ground: pixels of top and foot of something upright, and of its shadow's tip.

    Printed with how far four pixels of error in any of them would turn it. Raises InputError for pixels that cannot be that.
    """
    height_px, width_px = plate.rgb.shape[:2]
    for x_px, y_px in (top_px, foot_px, tip_px):
        if not (-3 * width_px <= x_px < 4 * width_px and -3 * height_px <= y_px < 4 * height_px):
            raise InputError(f"--sun-by: pixel {x_px:g},{y_px:g} lies far outside the photograph of {width_px}x{height_px} px: check it")
    if math.dist(foot_px, tip_px) < _POINTED_PX:
        raise InputError("--sun-by: the foot and the shadow's tip are the same place: expected a shadow that has a length")
    pixels = np.array([top_px, foot_px, tip_px], np.float64)
    towards = _sunwards(plate, pixels)
    shifts = _POINTED_PX * np.eye(6).reshape(6, 3, 2)
    moved = [_sunwards(plate, pixels + sign * shift, strict=False) for shift in shifts for sign in (-1.0, 1.0)]
    off_deg = math.degrees(math.acos(min(1.0, min(float(towards @ each) for each in moved))))
    right_deg = math.degrees(math.atan2(towards[0], towards[2]))
    above_deg = math.degrees(math.asin(-towards[1]))
    side = "right" if right_deg >= 0.0 else "left"
    say(f"by the shadow the sun is {abs(right_deg):.0f} degrees to the {side} of the view and {above_deg:.0f} above the horizon")
    if above_deg < _LOW_SUN_DEG:
        warn(
            f"a sun {above_deg:.0f} degrees above the horizon is low: is the third pixel of --sun-by on the ground, where the shadow ends?"
        )
    if off_deg > _SURE_DEG:
        warn(
            f"{_POINTED_PX:g} px beside one of the three pixels would turn the sun by {off_deg:.0f} degrees: take a longer shadow, or --sun"
        )
    return f"{right_deg:.9g},{above_deg:.9g}"


def _sunwards(plate: Plate, pixels: Float[np.ndarray, "3 2"], *, strict: bool = True) -> Float[np.ndarray, "3"]:
    """Return the direction (3,) to the sun in a world with y down, for the camera 1 above the ground. strict: refuse what cannot be."""
    upright = np.eye(3) if plate.world_from_camera is None else plate.world_from_camera
    top, foot, tip = plate.camera.unproject(pixels, np.ones(3)) @ upright.T
    if strict and min(foot[1], tip[1]) <= 0.0:
        name = "foot" if foot[1] <= tip[1] else "shadow's tip"
        raise InputError(
            f"--sun-by: the {name} lies above the horizon of a camera that looks down by {_down_deg(upright):.0f} degrees: expected pixels "
            f"on level ground (--pitch DEGREES says how far the camera looks down)"
        )
    foot, tip = foot / max(foot[1], _LEAST_FALL), tip / max(tip[1], _LEAST_FALL)
    level = [0, 2]
    # The top stands over the foot: where its ray is nearest to the vertical there.
    top = top * float(top[level] @ foot[level]) / max(float(top[level] @ top[level]), _LEAST_FALL)
    towards = top - tip
    towards /= np.linalg.norm(towards)
    if strict and towards[1] >= -_LOWEST_SUN:
        raise InputError("--sun-by: the top is not above the ground by these pixels: expected TOP:FOOT:TIP, each as X,Y")
    return towards


def _ground_m(plate: Plate, ray: Float[np.ndarray, "3"], at_pixel: str) -> float:
    """Return how far the ground is along a ray of length 1 along the axis, for a camera 1 m above it."""
    assert plate.world_from_camera is not None
    falls, down_deg = float(plate.world_from_camera[1] @ ray), _down_deg(plate.world_from_camera)
    if falls <= 0.0:
        raise InputError(
            f"--at-pixel {at_pixel} lies above the horizon of a camera that looks down by {down_deg:.0f} degrees: choose a "
            f"lower pixel, say how far the camera looks down with --pitch DEGREES, or give --depth"
        )
    return 1.0 / falls


def _camera_height_m(plate: Plate, told_m: float | None, nearest_m: float) -> tuple[float, str]:
    """Return the camera's height above the ground, and what is taken for granted of it. nearest_m: of `_ground_m`."""
    if told_m is not None:
        return told_m, ""
    focus_m = plate.lens.focus_distance_m
    if not plate.focus_known or focus_m >= _FARTHEST_M:
        return _EYES_M, f"the camera to be {_EYES_M:g} m above the ground (--camera-height METRES)"
    height_m = focus_m / nearest_m
    if plate.rough_focus_m is not None and plate.rough_focus_m[0] <= _EYES_M * nearest_m <= plate.rough_focus_m[1]:
        near_m, far_m = plate.rough_focus_m
        focus = f"beyond {near_m:.2g} m" if math.isinf(far_m) else f"between {near_m:.2g} and {far_m:.2g} m"
        told = f"the camera to be {_EYES_M:g} m above the ground (--camera-height METRES)"
        return _EYES_M, f"{told} and focused on the object: the photograph tells a focus {focus} (--focus METRES)"
    if _LOWEST_M <= height_m <= _HIGHEST_M:
        told = f"the object to stand where the lens is focused, {focus_m:.3g} m away and {height_m:.2g} m below the camera"
        return height_m, f"{told} (--camera-height METRES, --focus METRES)"
    warn(
        f"the lens is focused at {focus_m:.3g} m, but ground that far away at this pixel would be {height_m:.2g} m below the camera: "
        f"another place is in focus, or the file is wrong (--focus METRES)"
    )
    return _EYES_M, f"the camera to be {_EYES_M:g} m above the ground (--camera-height METRES)"


def _by_lines(plate: Plate) -> Plate:
    """Return the plate as its straight lines say that the camera stood, or as it is where they do not tell."""
    from mrbokeh.solving.solve_camera import solve_camera

    try:
        solved = solve_camera(plate.rgb, plate.camera.focal_px[0] if plate.view_known else None)
    except InputError:
        return plate
    if solved.confidence == LOW:
        return plate
    guess(f"by the straight lines of the picture the camera {_told(plate, solved)} (--pitch DEGREES; `mrbokeh capture solve` shows it)")
    return _seen_by(plate, solved)


def _told(plate: Plate, solved: SolvedCamera) -> str:
    view = (
        "" if plate.view_known or solved.focal_length_source == GUESSED else f" and sees as {solved.focal_length_35mm:.0f} mm on 35-mm film"
    )
    return f"{held_told(looking_down(-math.radians(solved.pitch_deg), math.radians(solved.roll_deg)))}{view}"


def held_told(world_from_camera: Float[np.ndarray, "3 3"]) -> str:
    """Return in words how far a camera looks down or up, and is turned."""
    down_deg, roll_deg = _down_deg(world_from_camera), rolled_deg(world_from_camera)
    turned = f", turned {'anti' * (roll_deg < 0.0)}clockwise by {abs(roll_deg):.1f} degrees" if abs(roll_deg) >= 0.5 else ""
    return f"looks {'up' if down_deg < 0.0 else 'down'} by {abs(down_deg):.0f} degrees{turned}"


def _seen_by(plate: Plate, solved: SolvedCamera) -> Plate:
    """Return the plate held as that camera, and with its field of view where its file tells none."""
    turn = looking_down(-math.radians(solved.pitch_deg), math.radians(solved.roll_deg))
    plate = replace(plate, world_from_camera=turn, phone_level=False)
    if plate.view_known or solved.focal_length_source == GUESSED:
        return plate
    factor = solved.focal_length_px / solved.width_px * plate.camera.width_px / plate.camera.focal_px[0]
    focal_px = (factor * plate.camera.focal_px[0], factor * plate.camera.focal_px[1])
    lens = plate.lens.stating({"focal_length_mm": factor * plate.lens.focal_length_mm})
    return replace(plate, lens=lens, camera=replace(plate.camera, focal_px=focal_px), view_known=True)


def rolled_deg(world_from_camera: Float[np.ndarray, "3 3"]) -> float:
    """Return how far a camera is turned clockwise about its view."""
    return math.degrees(math.atan2(world_from_camera[1, 0], world_from_camera[1, 1]))


def _down_deg(world_from_camera: Float[np.ndarray, "3 3"]) -> float:
    return math.degrees(math.asin(float(np.clip(world_from_camera[1, 2], -1.0, 1.0)))) + 0.0
