"""What a row of the tables is measured on: layers, samples and path-traced truth of one of the sampler's scenes, moving or at rest."""

import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from datasets_scripts.render_samples import render_samples
from datasets_scripts.samples_plan import SamplesPlan, SamplesSet
from datasets_scripts.samples_scene import MovingScene
from mrbokeh.images.image_io import read_image, write_image
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.light_field_samples_file import read_samples

_TIMED_SHARE = 16


@dataclass(frozen=True)
class BlurScene:
    """A scene in OUT/scenes; what is missing is rendered."""

    out: Path
    plan: SamplesPlan

    @cached_property
    def folder(self) -> Path:
        render_samples(self.out / "scenes", self.plan)
        return SamplesSet(self.out / "scenes", self.plan).folder

    @property
    def lens(self) -> Lens:
        return self.plan.lens

    def truth(self, *, moves: bool) -> Float32[np.ndarray, "height width 3"]:
        """The path-traced picture; moves: False with everything at rest where it is at half time."""
        if moves:
            return read_image(self.folder / "reference.exr")
        path = self.folder / "reference_at_rest.exr"
        if not path.is_file():
            write_image(path, self.plan.tracer(self._scene(moves=False)).mean(self.plan.reference_spp))
        return read_image(path)

    def truth_seconds(self, *, moves: bool) -> float:
        """How long the path tracer takes for it; measured on a sixteenth of the rays."""
        rays = max(1, self.plan.reference_spp // _TIMED_SHARE)
        started_s = time.perf_counter()
        self.plan.tracer(self._scene(moves=moves)).mean(rays)
        return (time.perf_counter() - started_s) * self.plan.reference_spp / rays

    def samples(self, per_pixel: int) -> LightFieldSamples:
        """The first samples of every pixel."""
        every = read_samples(self.folder / "samples.npz")
        kept = np.arange(every.count) % round(every.per_pixel) < per_pixel
        names = ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")
        return LightFieldSamples(every.width_px, every.height_px, *(getattr(every, name)[kept] for name in names))

    def _scene(self, *, moves: bool) -> MovingScene:
        scene = SamplesSet(self.out / "scenes", self.plan).scene
        return scene if moves else replace(scene, movers=tuple(replace(each, velocity_m=(0.0, 0.0, 0.0)) for each in scene.movers))
