"""Render stochastic samples of scenes with defocus and motion, their converged reference, and the sharp layers.

    python -m datasets_scripts.render_samples OUT [--scene fence,whirl,coins,rain,gear --seed 1 --width 512 --height 320 --spp 4]

OUT/SCENE_SEED/ holds meta.json (settings, conventions), lens.json, samples.npz (LightFieldSamples: layering/light_field_samples.py),
reference.exr, all_in_focus.exr with Z and motion, layers/NN.exr where a foreground hides what is behind it, and, if asked for,
noise.json. Finished files are kept, so an interrupted run goes on where it stopped.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from datasets_scripts.made_sets.set_files import claim_folder
from datasets_scripts.scenes.moving_scenes import LENS, SCENES, make_scene
from datasets_scripts.tracers.samples import WIDEST_PX, Advance, SampleArrays, SampleTracer
from datasets_scripts.tracers.traced_scene import MovingScene
from mrbokeh.images.image_io import read_image, write_image, write_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.lens_file import lens_to_json, write_lens
from mrbokeh.stacks.light_field_samples_file import read_samples, write_samples
from mrbokeh.system.atomic_files import write_json
from mrbokeh.system.console import progress_bars
from mrbokeh.system.errors import InputError

CONVENTIONS = {
    "lens_uv": "where the ray passes the unit pupil, x right, y down; a point behind the focus is displaced by +coc/2 * uv",
    "time": "in the exposure, 0 to 1; the sharp pictures show 0.5",
    "depth": "metres along the optical axis of what the sample hit, at the time of the sample; inf is the background",
    "motion": "pixels per shutter of the point that the sample hit, as a pinhole in the middle of the lens sees it: mean velocity "
    "between the time of the sample and 0.5, so that xy - coc(depth)/2 * uv - motion * (time - 0.5) is where the point is seen at 0.5",
    "coc": "signed diameter in pixels, coc_px_per_dioptre * (1 / focus - 1 / depth)",
    "reference": "mean scene-linear radiance over each pixel's square, the pupil and the shutter",
    "layers": "pinhole pictures at (u, v, t) = (0, 0, 0.5), front first, premultiplied, each as if the other were not there; Z and "
    "forward.u (right), forward.v (up; pixels per shutter, premultiplied by A) are those of one surface per pixel",
}

_SMALLEST_PX = 16


@dataclass(frozen=True)
class SamplesPlan:
    """Settings of one scene; equal plans give equal files. sharp_spp: places per pixel of the sharp pictures."""

    scene: str
    seed: int = 1
    width_px: int = 512
    height_px: int = 320
    spp: int = 4
    reference_spp: int = 1024
    sharp_spp: int = 256
    lens: Lens = LENS

    def __post_init__(self) -> None:
        if self.scene not in SCENES:
            raise InputError(f"expected a scene out of {', '.join(SCENES)}, got {self.scene!r}")
        sizes, counts = (self.width_px, self.height_px), (self.spp, self.reference_spp, self.sharp_spp)
        if min(sizes) < _SMALLEST_PX or max(sizes) > WIDEST_PX or min(counts) < 1 or self.seed < 0:
            raise InputError(
                f"a set of samples needs pictures of {_SMALLEST_PX} to {WIDEST_PX} px a side, at least 1 sample per pixel "
                f"and a seed from 0 up, but came with {self.width_px}x{self.height_px} px, {counts} samples and seed {self.seed}"
            )

    def tracer(self, scene: MovingScene, threads: int = 0, repeat: int = 0) -> SampleTracer:
        """Return the sampler of a scene; another `repeat` draws other numbers."""
        return SampleTracer(
            scene=scene, lens=self.lens, width_px=self.width_px, height_px=self.height_px, seed=2 * self.seed + repeat, threads=threads
        )

    def document(self, scene: MovingScene) -> dict[str, Any]:
        """Return the content of meta.json."""
        return {
            "format": "mrbokeh-samples",
            "version": 1,
            "scene": self.scene,
            "seed": self.seed,
            "width_px": self.width_px,
            "height_px": self.height_px,
            "spp": self.spp,
            "reference_spp": self.reference_spp,
            "sharp_spp": self.sharp_spp,
            "bodies": len(scene.movers),
            "focal_px": self.lens.focal_px(self.width_px),
            "coc_px_per_dioptre": self.lens.coc_px_per_dioptre(self.width_px),
            "lens": lens_to_json(self.lens),
            "layers": ["layers/00.exr", "layers/01.exr"] if scene.has_layers else [],
            "conventions": CONVENTIONS,
        }


@dataclass(frozen=True)
class Job:
    """A file that is made in `steps` steps."""

    path: Path
    steps: int
    make: Callable[[Advance], None]


class SamplesSet:
    """The files of one plan in OUT/SCENE_SEED."""

    def __init__(self, out: Path, plan: SamplesPlan, threads: int = 0) -> None:
        self.folder = out / f"{plan.scene}_{plan.seed}"
        self._plan, self._threads = plan, threads

    @cached_property
    def scene(self) -> MovingScene:
        return make_scene(self._plan.scene, self._plan.seed, self._plan.lens, self._plan.height_px / self._plan.width_px)

    def claim(self, overwrite: bool) -> None:
        files = (job.path for job in self.jobs(measure=True))
        claim_folder(self.folder / "meta.json", self._plan.document(self.scene), files, overwrite)

    def jobs(self, measure: bool) -> Iterator[Job]:
        """Yield the files of the set. measure: the noise of the reference too, which is made once more for that."""
        folder, tracer = self.folder, self._plan.tracer(self.scene, self._threads)
        yield Job(folder / "lens.json", 0, lambda _: write_lens(folder / "lens.json", self._plan.lens))
        yield Job(folder / "samples.npz", tracer.steps, self._make_samples)
        yield Job(folder / "all_in_focus.exr", tracer.steps, partial(self._make_sharp, self.scene, folder / "all_in_focus.exr"))
        if self.scene.has_layers:
            for index, in_front in enumerate((True, False)):
                path = folder / "layers" / f"{index:02d}.exr"
                yield Job(path, tracer.steps, partial(self._make_sharp, self.scene.part(in_front), path))
        yield Job(folder / "reference.exr", tracer.steps, self._make_reference)
        if measure:
            yield Job(folder / "noise.json", tracer.steps, self._measure_noise)

    def _make_samples(self, advance: Advance) -> None:
        arrays = self._plan.tracer(self.scene, self._threads).samples(self._plan.spp, advance)
        write_samples(self.folder / "samples.npz", in_a_row(arrays))

    def _make_sharp(self, part: MovingScene, path: Path, advance: Advance) -> None:
        write_layer(path, self._plan.tracer(part, self._threads).sharp(self._plan.sharp_spp, advance))

    def _make_reference(self, advance: Advance) -> None:
        write_image(self.folder / "reference.exr", self._plan.tracer(self.scene, self._threads).mean(self._plan.reference_spp, advance))

    def _measure_noise(self, advance: Advance) -> None:
        """Write PSNR in clipped linear light of the reference against a second one, and of the mean of the samples against the first.

        The noise of one reference is half the power of the difference, 3 dB less than the first number says.
        """
        reference = read_image(self.folder / "reference.exr")
        again = self._plan.tracer(self.scene, self._threads, repeat=1).mean(self._plan.reference_spp, advance)
        raw = read_samples(self.folder / "samples.npz").raw_picture()
        write_json(
            self.folder / "noise.json",
            {"reference_against_another_seed_psnr_db": psnr(again, reference), "mean_of_samples_psnr_db": psnr(raw, reference)},
        )


def in_a_row(arrays: SampleArrays) -> LightFieldSamples:
    """Return samples pixel by pixel, row by row."""
    height_px, width_px, spp = arrays.time.shape
    count = height_px * width_px * spp
    fields = (arrays.xy_px, arrays.lens_uv, arrays.time, arrays.rgb, arrays.depth_m, arrays.motion_px)
    return LightFieldSamples(width_px, height_px, *(np.reshape(each, (count, *each.shape[3:])) for each in fields))


def render_samples(out: Path, plan: SamplesPlan, *, measure: bool = False, overwrite: bool = False, threads: int = 0) -> int:
    """Write all that is missing of the plan into `out` and return how many files were made.

    Raises InputError where `out` holds something else, unless `overwrite` says to replace it.
    """
    files = SamplesSet(out, plan, threads)
    files.claim(overwrite)
    waiting = [job for job in files.jobs(measure) if not job.path.is_file()]
    with progress_bars() as bars:
        for job in waiting:
            task = bars.add_task(f"{files.folder.name}/{job.path.name}", total=job.steps)
            job.make(partial(bars.advance, task))
    return len(waiting)


def main(
    out: Annotated[Path, typer.Argument(help="Folder for the sets.")],
    scene: Annotated[str, typer.Option(help=f"With commas between them: {', '.join(SCENES)}.")] = ",".join(SCENES),
    seed: Annotated[int, typer.Option(help="Chooses the scenes' contents and the sampling.")] = 1,
    width: int = 512,
    height: int = 320,
    spp: Annotated[int, typer.Option(help="Samples per pixel, best a power of two.")] = 4,
    reference_spp: Annotated[int, typer.Option(help="Rays per pixel of the reference.")] = 1024,
    measure_noise: Annotated[bool, typer.Option("--measure-noise", help="Make the reference twice and write noise.json.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace sets made with other settings.")] = False,
) -> None:
    """Render the missing files of sets of samples."""
    try:
        plans = [
            SamplesPlan(scene=name, seed=seed, width_px=width, height_px=height, spp=spp, reference_spp=reference_spp)
            for name in scene.split(",")
        ]
        made = sum(render_samples(out, plan, measure=measure_noise, overwrite=overwrite) for plan in plans)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(f"{out}: {'complete' if made else 'nothing to do, all files were there'}")


if __name__ == "__main__":
    typer.run(main)
