"""Light of a virtual object from the photograph that it stands in: a panorama of what is seen, and light from above for its ground.

A photograph shows the light that its own surfaces send, and seldom the lamps and the sky that light them. What is seen is taken as it is;
beyond the frame it goes on ever more blurred and paler, as nobody knows the paint there; and what is above and out of sight is made as
bright as it must be to light a white surface where the object stands. How bright such a surface is nobody tells: brightest parts of a
picture are taken for nearly white, and a picture as a whole for grey (exposure meters do), near the foot as well as over the frame. All of
it is relative: a picture twice as bright tells of light twice as bright.

Sunshine shows in the exposure: white surfaces near the foot have more than 40 klx then. Of 88 photographs of all kinds 67 tell it; 16
had more, 15 of them sunny by eye and one under bright clouds, and none of those taken indoors, at dusk or night, in fog or with flash. Six
sunny ones had less. Where the file also tells how high the sun stood, half of a clear day's light is enough. Of 30 other photographs, 18
were taken in rooms, in shade and smoke, at dusk and under clouds with a low sun: of nine places in each one of 162 was taken for sunlit.
Of 12 in the sun 8 tell it; the sea, a meadow, dappled ground and haze do not.

A main light that is told is the sun of a clear day: the sky gives the share of the light that the daylight of clear days has (`sky_share`),
bluer than the sun. Seven cast shadows in five photographs of sunny days kept 0.02 to 0.18 of the light, where it gives 0.15 to 0.22 from 30
degrees up: cameras deepen shadows.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.compositing.plate import Plate
from mrbokeh.images.color import luminance
from mrbokeh.scene.light import Environment, Light, directions, solid_angles_sr, sun

_PANORAMA_PX = (32, 64)
_WIDTH_PX = 48
"""The photograph is looked at this small: light is even over many pixels."""
_WHITE, _GREY = 0.85, 0.25
"""What the brightest parts of a picture reflect, and a picture as a whole."""
_BRIGHTER = 1.3
"""By how much white is brighter than these tell, as little in a picture is white: in the median 1.6 times for an object in 320 views of 40
panoramas, 1.8 times in 16 traced places, and 1.3 times in 19 photographs in the sun whose height their files tell, for which a clear day
(`clear_day_klx`) was compared with the exposure that shows middle grey (ISO 12232: 54 lx s / S where white would be)."""
_BRIGHT_PERCENTILE = 97.0
_NEAR_SHARE = 0.25
"""Width of the surroundings of the foot, in widths of the picture."""
_DARKEST = 1e-3
"""Light of the darkest surroundings that are measured, in units of the brightest parts."""
_COLOURED = 0.25
"""Share of a picture's cast that is taken for light: cameras balance most of it, and the rest is as often paint."""
_LEAST_PALENESS = 0.02
_PALER_RAD = 0.5
"""Angle beyond the frame in which colours fade by a factor of e."""
_SUNLIT_LUX = 40_000.0
"""What an overcast sky seldom gives, and the sun does from 30 degrees up."""
_SUNLIT_SHARE = 0.5
"""Share of a clear day's light that an overcast sky, which gives 0.13 to 0.25 of it in the mean (RP-21), and shade seldom have."""
_USUAL_RIGHT_DEG, _USUAL_ABOVE_DEG, _SPOT_POWER = -125.0, 50.0, 24.0
"""Where the sun is taken to be if only the exposure tells of it: behind the photographer, so far to the left that the shadow is seen.
It is made 27 degrees wide (to half its brightness), so that its direction, which is a guess, tells less than that of a sharp shadow."""
_SUN_RGB, _SKY_RGB = (1.130, 0.983, 0.783), (0.824, 1.012, 1.403)
"""Colour of direct sunlight (daylight of 5300 K) and of the light in shadows (10000 K) of the same luminance, by the locus of CIE 15:2004.
In three sunny photographs blue in shadows was 1.4, 1.9 and 2.7 times as strong beside red as in the sun, where these give 2.2."""

Rgb = Float32[np.ndarray, "height width 3"]
Triple = Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Light around a pixel of a photograph.

    seen: panorama of what the photograph shows. white: what a white surface there sends. sun_above_deg: how high the sun stands over the
    horizon, as far as that is known, where it shines as `is_sunlit` tells; else None.
    """

    seen: Float[np.ndarray, "rows columns 3"]
    white: Triple
    sun_above_deg: float | None = None

    def light(self, sun_degrees: tuple[float, float] | None = None) -> tuple[Environment, tuple[Light, ...]]:
        """Return the panorama with light from above, and the main light where it is told; see `picture_light`."""
        seen, white = self.seen, self.white
        guessed = None if self.sun_above_deg is None else (_USUAL_RIGHT_DEG, self.sun_above_deg)
        if (taken := sun_degrees or guessed) is None:
            return Environment(_lit_from_above(seen, white)), ()
        right, above = (math.radians(each) for each in taken)
        travels = (-math.sin(right) * math.cos(above), math.sin(above), -math.cos(right) * math.cos(above))
        by_sky = sky_share(above) * np.array(_SKY_RGB)
        by_sky /= by_sky + (1.0 - sky_share(above)) * np.array(_SUN_RGB)
        lit_by_sky = _lit_from_above(seen, by_sky * white)
        if sun_degrees is None:
            return Environment(lit_by_sky + _wide_light(travels, (1.0 - by_sky) * white)), ()
        red, green, blue = (math.pi * (1.0 - by_sky) * white / max(math.sin(above), 0.1)).tolist()
        return Environment(lit_by_sky), (sun(travels, (red, green, blue)),)


def picture_light(
    plate: Plate, foot_px: tuple[float, float], world_from_camera: Float[np.ndarray, "3 3"], sun_degrees: tuple[float, float] | None = None
) -> tuple[Environment, tuple[Light, ...]]:
    """Return the light at a pixel of a photograph, in a world with x right, y down and z forward, and the main light where it is told.

    foot_px: where the object stands. world_from_camera: rotation of the camera in that world. sun_degrees: where the main light comes
    from: degrees to the right of the view, and above the horizon.
    """
    return surroundings_of(plate, foot_px, world_from_camera).light(sun_degrees)


def surroundings_of(plate: Plate, foot_px: tuple[float, float], world_from_camera: Float[np.ndarray, "3 3"]) -> Surroundings:
    """Return the light around a pixel of a photograph before a main light is told."""
    small = _small(plate)
    white = white_at(small, foot_px[0] / plate.rgb.shape[1], foot_px[1] / plate.rgb.shape[0])
    seen = _panorama_of(small, plate, world_from_camera, white / luminance(white[None])[0])
    known = _USUAL_ABOVE_DEG if plate.sun is None else plate.sun.above_deg
    return Surroundings(seen, white, known if is_sunlit(plate, foot_px) else None)


def is_sunlit(plate: Plate, foot_px: tuple[float, float]) -> bool:
    """Return whether the exposure of a photograph tells that the sun shines where an object stands.

    A low sun gives less: where the file tells its height, half of what a clear day then gives is enough.
    """
    if plate.white_lux is None or (plate.sun is not None and not plate.sun.is_up):
        return False
    height_px, width_px = plate.rgb.shape[:2]
    near = float(np.sqrt(_whites(_small(plate), foot_px[0] / width_px, foot_px[1] / height_px)[1].prod()))
    clear_lux = math.inf if plate.sun is None else 1000.0 * sum(clear_day_klx(math.radians(plate.sun.above_deg)))
    return plate.white_lux * near > min(_SUNLIT_LUX, _SUNLIT_SHARE * clear_lux)


def _wide_light(travels: tuple[float, float, float], white: Triple) -> Rgb:
    """Return the panorama of a light that travels so and comes from a wide spot of the sky, by which a white surface shows `white`."""
    towards = directions(*_PANORAMA_PX)
    spot = np.maximum(towards @ -np.array(travels), 0.0)[..., None] ** _SPOT_POWER * (towards[..., 1:2] < 0.0)
    ground = float((spot * np.maximum(-towards[..., 1:2], 0.0) * solid_angles_sr(*_PANORAMA_PX)[..., None]).sum())
    return (math.pi * white / ground * spot).astype(np.float32)


def clear_day_klx(above_rad: float) -> tuple[float, float]:
    """Return the illuminance of level ground by the sun, so high over the horizon, and by the sky, on clear days, in kilolux.

    By the Illuminating Engineering Society (RP-21, 1984; Gillette and Pierpoint 1982).
    """
    height = math.sin(max(above_rad, 0.02))
    return 127.5 * math.exp(-0.21 / height) * height, 0.8 + 15.5 * math.sqrt(height)


def sky_share(above_rad: float) -> float:
    """Return the share of the light on level ground that comes from the sky, for a sun so high over the horizon, on clear days."""
    of_sun, of_sky = clear_day_klx(above_rad)
    return of_sky / (of_sky + of_sun)


def white_at(picture: Rgb, x_share: float, y_share: float) -> Triple:
    """Return the light (3,) that a white matte surface sends where an object stands, estimated from a small linear picture.

    x_share, y_share: the place, in widths and heights of the picture.
    """
    return _BRIGHTER * float(np.exp(np.log(_whites(picture, x_share, y_share)).mean())) * _cast(picture)


def _whites(picture: Rgb, x_share: float, y_share: float) -> Float[np.ndarray, "2 2"]:
    """Return white by the brightest parts and by the mean (columns), of the whole picture and of what is near a place (rows)."""
    paint = _without_lamps(picture)
    light, strongest = luminance(paint), paint.max(axis=2)
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    apart = np.hypot(columns - x_share * light.shape[1], rows - y_share * light.shape[0]) / light.shape[1]
    near = apart <= max(_NEAR_SHARE, float(apart.min()) + 0.01)
    # No paint reflects more than white paint in any colour: a red coat tells of white by its red.
    told = [(np.percentile(strongest[part], _BRIGHT_PERCENTILE) / _WHITE, light[part].mean() / _GREY) for part in (near | True, near)]
    return np.maximum(told, max(_DARKEST * float(strongest.max()), 1e-9))


def _without_lamps(picture: Rgb) -> Rgb:
    """Return the picture with what is brighter than its brightest parts made as bright as they are, in its own colour."""
    strongest = picture.max(axis=2, keepdims=True)
    return picture * np.minimum(1.0, np.percentile(strongest, _BRIGHT_PERCENTILE) / np.maximum(strongest, 1e-9)).astype(np.float32)


def _cast(picture: Rgb) -> Triple:
    """Return the colour of the light, with a luminance of 1: that of all pixels, of which strong colours, which are paint, count little."""
    paint = _without_lamps(picture).reshape(-1, 3).astype(np.float64)
    paleness = paint.min(axis=1) / np.maximum(paint.max(axis=1), 1e-9) + _LEAST_PALENESS
    cast = np.sqrt(np.average(paint**2, axis=0, weights=paleness))
    cast = (cast / cast.max()) ** _COLOURED if cast.max() > 0.0 else np.ones(3)
    return cast / luminance(cast[None])[0]


def _small(plate: Plate) -> Rgb:
    rgb = plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb
    height_px, width_px = rgb.shape[:2]
    size = (min(width_px, _WIDTH_PX), max(1, round(height_px * min(1.0, _WIDTH_PX / width_px))))
    return np.maximum(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.float32(0.0))


def _panorama_of(
    small: Rgb, plate: Plate, world_from_camera: Float[np.ndarray, "3 3"], pale: Triple
) -> Float[np.ndarray, "rows columns 3"]:
    """Return what is seen as a panorama; beyond the frame a direction has the mean of what is nearest to it, the wider the farther.

    pale: the colour of the light, towards which colours fade there.
    """
    camera = plate.camera.resized(small.shape[1], small.shape[0])
    rays = camera.unproject(camera.pixel_centres_px(), np.ones(small.shape[:2])).reshape(-1, 3) @ world_from_camera.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    towards = directions(*_PANORAMA_PX).reshape(-1, 3)
    cosines = towards.astype(np.float32) @ rays.astype(np.float32).T
    nearest = cosines.max(axis=1, keepdims=True)
    width = np.maximum(1.0 - nearest, np.float32(1.0 - math.cos(math.pi / _PANORAMA_PX[0])))
    weights = np.exp((cosines - nearest) / width)
    mean = weights @ small.reshape(-1, 3) / weights.sum(axis=1, keepdims=True)
    grey = luminance(mean.astype(np.float32))[:, None] * pale
    colour = np.exp(-np.arccos(np.clip(nearest, -1.0, 1.0)) / _PALER_RAD)
    return (grey + (mean - grey) * colour).reshape(*_PANORAMA_PX, 3)


def _lit_from_above(panorama: Float[np.ndarray, "rows columns 3"], white: Triple) -> Rgb:
    """Return the panorama with light added above the horizon until the ground has the irradiance of `white` times pi.

    It is that of an overcast sky, three times as bright above as at the horizon (Moon and Spencer 1942; CIE S 011). One that is too bright
    above the horizon is darkened there.
    """
    upwards = np.maximum(-directions(*_PANORAMA_PX)[..., 1:2], 0.0)
    weights = upwards * solid_angles_sr(*_PANORAMA_PX)[..., None]
    wanted, there = math.pi * white, (panorama * weights).sum(axis=(0, 1))
    kept = min(1.0, float((wanted / np.maximum(there, 1e-12)).min()))
    overcast = np.where(upwards > 0.0, (1.0 + 2.0 * upwards) / 3.0, 0.0)
    missing = np.maximum(wanted - kept * there, 0.0) / float((overcast * weights).sum())
    return (np.where(upwards > 0.0, kept, 1.0) * panorama + missing * overcast).astype(np.float32)
