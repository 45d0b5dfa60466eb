"""A camera without hardware, for the demo and for tests: a thin lens with focus breathing before a few textured cards, on a motor with
play and stops.

Its files are 16-bit TIFF with EXIF, their focus distances as coarse as those of real cameras. A DNG would need a model of a
sensor's mosaic, and RAW adds nothing to what a bracket has to prove. 16 bits keep the light linear to 0.01 %, and the file is
read like every other photograph.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from fractions import Fraction
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.tether.camera_driver import Ability, CameraDescription, CameraError, CameraSettings, EndStop, FocusSteps, Preview, Shot, Stop
from capture.tether.focus_plan import FocusPlan
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens, film_plane_m
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from mrbokeh.system.errors import MissingExtraError

_TEXELS_PER_WIDTH = 960
_FINEST_TEXELS = 6
_OCTAVES = 6
Rgb = Float32[np.ndarray, "height width 3"]
CAMERA_MODEL = "Simulated Thin Lens"
ELECTRONS_AT_WHITE = 40000.0
_NIKON_LARGEST = 254
_FINE = 100000
_CENTIMETRES = 3
FocusQuantum = Callable[[float], float | None]
NORMAL_EXPOSURE_S = 1.0 / 60.0
NORMAL_ISO = 100.0
LARGEST_WIDTH_PX = 960
_ASPECT = 1.5
_BEFORE_NEAR = 0.25
_PREVIEW_SHARE = 0.5


@dataclass(frozen=True)
class Card:
    """A textured rectangle facing the camera.

    depth_m: from the lens. left, top, right, bottom: its place in the picture of a lens without breathing, in fractions of the width
    from the centre (-0.5 to 0.5). seed: of its texture.
    """

    depth_m: float
    left: float
    top: float
    right: float
    bottom: float
    seed: int

    @cached_property
    def texture(self) -> Rgb:
        """Return detail of all sizes, 0.05 to 0.75."""
        height, width = (round(_TEXELS_PER_WIDTH * each) for each in (self.bottom - self.top, self.right - self.left))
        return textured(height, width, self.seed)


@dataclass(frozen=True)
class SimulatedScene:
    """Cards in front of a wall; front first. The wall is the last card and fills the picture."""

    cards: tuple[Card, ...]

    @classmethod
    def between(cls, near_m: float, far_m: float) -> "SimulatedScene":
        """Place three cards from near to far, equally spaced in dioptres; the farthest is the wall."""
        near, far = 1.0 / near_m, 1.0 / far_m
        middle, back = 2.0 / (near + far), min(far_m, 1e3)
        wall = Card(depth_m=back, left=-0.75, top=-0.75, right=0.75, bottom=0.75, seed=3)
        return cls(
            (
                Card(depth_m=near_m, left=-0.44, top=-0.14, right=-0.12, bottom=0.26, seed=1),
                Card(depth_m=middle, left=0.06, top=-0.2, right=0.4, bottom=0.12, seed=2),
                wall,
            )
        )

    def photographed(self, lens: Lens, width_px: int, height_px: int) -> Rgb:
        """Render scene-linear Rec.709 through the lens, with a margin that is cropped again."""
        margin = math.ceil(max(abs(float(lens.coc_px(card.depth_m, width_px))) for card in self.cards) / 2.0) + 2
        layers = [_layer(card, lens, width_px, height_px, margin) for card in self.cards]
        # A wider picture of the same pixels: the sensor grows with it.
        wider = replace(lens, sensor_width_mm=lens.sensor_width_mm * (width_px + 2 * margin) / width_px)
        whole = PolygonDifferences(threads=1).render(layers, wider)
        return np.ascontiguousarray(whole.rgb[margin:-margin, margin:-margin])


@lru_cache(maxsize=8)
def textured(height: int, width: int, seed: int) -> Rgb:
    """Sum octaves of noise in slightly different tones, the finest _FINEST_TEXELS wide."""
    rng = np.random.default_rng(seed)
    shade = np.zeros((height, width, 3), np.float32)
    for octave in range(_OCTAVES):
        rows, columns = (max(2, each // (_FINEST_TEXELS * 2**octave)) for each in (height, width))
        grid = 0.8 * rng.uniform(-1.0, 1.0, (rows, columns, 1)) + 0.2 * rng.uniform(-1.0, 1.0, (rows, columns, 3))
        shade += cv2.resize(grid.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    texture: Rgb = np.clip(0.4 + 0.13 * shade, 0.05, 0.75).astype(np.float32)
    texture.flags.writeable = False
    return texture


def _layer(card: Card, lens: Lens, width_px: int, height_px: int, margin: int) -> Layer:
    """Draw the card as seen by a pinhole in the centre of the lens; straight edges with area coverage."""
    breathing = lens.image_distance_mm / lens.focal_length_mm
    size = width_px + 2 * margin, height_px + 2 * margin
    left, right = (each * breathing * width_px + size[0] / 2 for each in (card.left, card.right))
    top, bottom = (each * breathing * width_px + size[1] / 2 for each in (card.top, card.bottom))
    rgb = _pasted(card.texture, (left, top, right, bottom), size)
    alpha = np.outer(_covered(size[1], top, bottom), _covered(size[0], left, right)).astype(np.float32)
    depth_m = np.where(alpha > 0.0, np.float32(card.depth_m), np.float32(np.inf))
    return Layer(rgb * alpha[..., None], alpha, depth_m)


def _pasted(
    texture: Rgb, place_px: tuple[float, float, float, float], size_px: tuple[int, int]
) -> Float32[np.ndarray, "new_height new_width 3"]:
    """Resample the texture to (left, top, right, bottom): area averages down to whole pixels, then interpolation."""
    left, top, right, bottom = place_px
    whole = min(texture.shape[1], math.ceil(right - left)), min(texture.shape[0], math.ceil(bottom - top))
    reduced = cv2.resize(texture, whole, interpolation=cv2.INTER_AREA)
    scale = np.array([(right - left) / whole[0], (bottom - top) / whole[1]])
    # OpenCV's pixel centres are whole numbers.
    shift = np.array([left, top]) + 0.5 * scale - 0.5
    matrix = np.column_stack([np.diag(scale), shift])
    pasted = cv2.warpAffine(reduced, matrix, size_px, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    return np.maximum(pasted, np.float32(0.0))


def _covered(count: int, start: float, end: float) -> Float[np.ndarray, " count"]:
    """Return the fraction of each of `count` unit cells between start and end."""
    return np.diff(np.clip(np.arange(count + 1), start, end))


@dataclass
class SimulatedMotor:
    """A gear that pushes a lens; the lens lies up to `backlash_steps` behind the gear. It counts nothing, and its travel ends.

    travel_steps: of the lens, from its near stop (0) to infinity. The focus changes linearly in dioptres, from nearest_dioptre to 0.
    gear, lens: positions of both; a motor that was just switched on may stand anywhere.
    """

    nearest_dioptre: float
    travel_steps: int = 2400
    backlash_steps: int = 40
    lens: float = 900.0
    gear: float = 920.0

    @property
    def dioptre(self) -> float:
        """Return the focus in dioptres from the lens; 0 is infinity."""
        return self.nearest_dioptre * (1.0 - self.lens / self.travel_steps)

    @property
    def focus_steps(self) -> FocusSteps:
        """Return the scale as counted from the near stop: the play comes first."""
        far = self.backlash_steps + self.travel_steps
        return FocusSteps(Stop.near, ((float(self.backlash_steps), self.nearest_dioptre), (float(far), 0.0)))

    def drive(self, steps: int) -> None:
        """Move the gear, positive towards infinity. Raises EndStop if a stop was met on the way."""
        self.gear += steps
        # The gear takes the lens along forwards once the play is used up, backwards at its front face.
        self.lens = min(max(self.lens, self.gear - self.backlash_steps), self.gear)
        if not 0 <= self.lens <= self.travel_steps:
            at_near = self.lens < 0
            self.lens = 0.0 if at_near else float(self.travel_steps)
            self.gear = self.lens if at_near else self.lens + self.backlash_steps
            raise EndStop


def nikon_code(distance_m: float) -> float:
    """Round to the distance of Nikon's 8-bit code: 0.01 * 10^(v / 40) m, steps of 5.9 %."""
    code = _NIKON_LARGEST if math.isinf(distance_m) else min(round(40.0 * math.log10(distance_m / 0.01)), _NIKON_LARGEST)
    return float(0.01 * 10.0 ** (code / 40.0))


def exposed(light: Rgb, rng: np.random.Generator) -> Rgb:
    """Add photon noise to light whose 1.0 fills the sensor, then clip at the sensor's limit."""
    electrons = rng.poisson(np.clip(light, 0.0, 2.0) * ELECTRONS_AT_WHITE)
    return np.minimum(electrons / ELECTRONS_AT_WHITE, 1.0).astype(np.float32)


def encoded_tiff(rgb: Rgb, exif: dict[str, str]) -> bytes:
    """Encode a 16-bit sRGB TIFF in memory, with EXIF."""
    try:
        import pyexiv2
    except ImportError:
        raise MissingExtraError("pyexiv2", "capture") from None
    integers = np.round(np.clip(linear_to_srgb(rgb), 0.0, 1.0) * 65535.0).astype(np.uint16)
    done, data = cv2.imencode(".tif", np.ascontiguousarray(integers[..., ::-1]))
    if not done:
        raise CameraError(f"the simulated camera cannot encode a picture of shape {rgb.shape}")
    with pyexiv2.ImageData(data.tobytes()) as image:
        image.modify_exif(exif)
        return bytes(image.get_bytes())


def exif_of(lens: Lens, width_px: int, exposure_time_s: float, iso: float, taken_at: datetime, quantum: FocusQuantum) -> dict[str, str]:
    """Return the Exif directory as a camera writes it. quantum: maps a distance from the film plane to the stated one, or None."""
    per_cm = Fraction(width_px * 10) / Fraction(str(lens.sensor_width_mm))
    stated = quantum(film_plane_m(lens))
    exif = {
        "Exif.Image.Make": "mrbokeh",
        "Exif.Image.Model": CAMERA_MODEL,
        "Exif.Photo.ExposureTime": _rational(exposure_time_s, 1000000),
        "Exif.Photo.FNumber": _rational(lens.f_number, 100),
        "Exif.Photo.ExposureProgram": "1",
        "Exif.Photo.ISOSpeedRatings": str(round(iso)),
        "Exif.Photo.DateTimeOriginal": taken_at.strftime("%Y:%m:%d %H:%M:%S"),
        "Exif.Photo.FocalLength": _rational(lens.focal_length_mm, 100),
        "Exif.Photo.FocalPlaneXResolution": f"{per_cm.numerator}/{per_cm.denominator}",
        "Exif.Photo.FocalPlaneYResolution": f"{per_cm.numerator}/{per_cm.denominator}",
        "Exif.Photo.FocalPlaneResolutionUnit": str(_CENTIMETRES),
    }
    return exif if stated is None else exif | {"Exif.Photo.SubjectDistance": _rational(stated, _FINE if stated < 1000.0 else 1)}


def _rational(value: float, denominator: int) -> str:
    return f"{round(value * denominator)}/{denominator}"


@dataclass
class SimulatedCamera:
    """A simulated CameraDriver.

    lens: wide open, its focus is the motor's; exposure time and ISO act on the light, the f-number on the blur.
    quantum: rounds the stated focus distance. knows_steps: whether it reports the scale of its motor (no real camera does).
    """

    lens: Lens
    scene: SimulatedScene
    motor: SimulatedMotor
    width_px: int = 480
    quantum: FocusQuantum = nikon_code
    knows_steps: bool = True
    seed: int = 0
    now: Callable[[], datetime] = datetime.now
    exposure_time_s: float = NORMAL_EXPOSURE_S
    iso: float = NORMAL_ISO
    counter: int = 0
    shots: int = 0
    _light: tuple[object, Rgb] | None = field(default=None, repr=False)

    @classmethod
    def for_plan(cls, plan: FocusPlan) -> "SimulatedCamera":
        """Put the plan's lens before cards that span the planned distances; its near stop is a little nearer than the plan."""
        width_px = min(plan.image_width_px, LARGEST_WIDTH_PX)
        nearest = plan.dioptres[0] + _BEFORE_NEAR * max(plan.dioptres[0] - plan.dioptres[-1], 0.1)
        return cls(plan.lens, SimulatedScene.between(plan.range.near_m, plan.range.far_m), SimulatedMotor(nearest), width_px)

    def describe(self) -> CameraDescription:
        steps = self.motor.focus_steps if self.knows_steps else None
        return CameraDescription(CAMERA_MODEL, "simulated", frozenset(Ability) - {Ability.raw}, steps)

    def configure(self, settings: CameraSettings) -> dict[str, str]:
        self.exposure_time_s = settings.exposure_time_s or self.exposure_time_s
        self.iso = settings.iso or self.iso
        if settings.f_number:
            self.lens = replace(self.lens, f_number=settings.f_number)
        return {
            "exposure mode": "manual",
            "exposure time": f"{self.exposure_time_s:g} s",
            "ISO": f"{self.iso:g}",
            "f-number": f"{self.lens.f_number:g}",
            "white balance": "fixed",
            "autofocus": "off",
            "file format": "16-bit TIFF",
        }

    def preview(self) -> Preview:
        width_px = round(self.width_px * _PREVIEW_SHARE)
        rgb = self._photographed(width_px)
        return np.round(np.clip(linear_to_srgb(rgb), 0.0, 1.0) * 255.0).astype(np.uint8)

    def focus_step(self, steps: int) -> None:
        self.motor.drive(steps)
        self.counter += steps

    def home(self, stop: Stop) -> None:
        try:
            while True:
                self.motor.drive(-stop.away * self.motor.travel_steps)
        except EndStop:
            self.counter = 0

    def capture(self) -> Shot:
        self.shots += 1
        exif = exif_of(self.focused_lens, self.width_px, self.exposure_time_s, self.iso, self.now(), self.quantum)
        return Shot(encoded_tiff(self._photographed(self.width_px), exif), f"SIM_{self.shots:04d}.TIF", self.counter)

    def close(self) -> None:
        pass

    @property
    def focused_lens(self) -> Lens:
        """Return the lens as the motor has focused it."""
        return self.lens.focused_at(1.0 / self.motor.dioptre if self.motor.dioptre > 0.0 else float("inf"))

    def _photographed(self, width_px: int) -> Rgb:
        """Return the exposed picture with new noise each time; the light behind it is cached while nothing moves."""
        state = (self.focused_lens.focus_distance_m, self.lens.f_number, width_px)
        if self._light is None or self._light[0] != state:
            self._light = state, self.scene.photographed(self.focused_lens, width_px, round(width_px / _ASPECT))
        exposure = self.exposure_time_s * self.iso / (NORMAL_EXPOSURE_S * NORMAL_ISO)
        self.seed += 1
        return exposed(self._light[1] * np.float32(exposure), np.random.default_rng(self.seed))
