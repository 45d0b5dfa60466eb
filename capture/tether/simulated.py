"""A camera without hardware: a thin lens before a small scene, on a motor with play and stops. For the demo and for tests."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np

from capture.tether.camera_driver import Ability, CameraDescription, CameraSettings, EndStop, Preview, Shot
from capture.tether.focus_plan import FocusPlan
from capture.tether.focus_steps import Stop
from capture.tether.simulated_motor import SimulatedMotor
from capture.tether.simulated_picture import CAMERA_MODEL, FocusQuantum, encoded_tiff, exif_of, exposed, nikon_code
from capture.tether.simulated_scene import Rgb, SimulatedScene
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.optics.lens import Lens

NORMAL_EXPOSURE_S = 1.0 / 60.0
NORMAL_ISO = 100.0
LARGEST_WIDTH_PX = 960
_ASPECT = 1.5
_BEFORE_NEAR = 0.25
_PREVIEW_SHARE = 0.5


@dataclass
class SimulatedCamera:
    """A CameraDriver. lens: wide open, its focus is the motor's; exposure time and ISO act on the light, f-number on the blur.

    quantum: how it states the focus distance. knows_steps: whether it tells what its steps mean (no real camera does).
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
        """The plan's lens before cards at the distances that the plan spans; its near stop is a little nearer than the plan."""
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
        """The lens as its motor has it."""
        return self.lens.focused_at(1.0 / self.motor.dioptre if self.motor.dioptre > 0.0 else float("inf"))

    def _photographed(self, width_px: int) -> Rgb:
        """What the sensor counts, with new noise each time; the light behind it is kept while nothing moves."""
        state = (self.focused_lens.focus_distance_m, self.lens.f_number, width_px)
        if self._light is None or self._light[0] != state:
            self._light = state, self.scene.photographed(self.focused_lens, width_px, round(width_px / _ASPECT))
        exposure = self.exposure_time_s * self.iso / (NORMAL_EXPOSURE_S * NORMAL_ISO)
        self.seed += 1
        return exposed(self._light[1] * np.float32(exposure), np.random.default_rng(self.seed))
