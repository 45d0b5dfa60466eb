"""MitsubaTracer: virtual scenes to Layers by path tracing, compiled by Mitsuba 3 (Jakob et al. 2022)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.mitsuba.path_denoising import Guides, denoised, require_denoiser
from mrbokeh.scene.mitsuba.variant import load
from mrbokeh.scene.virtual_scene import Scene
from mrbokeh.system.errors import InputError


class MitsubaTracer:
    """A SceneRenderer for pictures that may take their time: light that objects pass on to each other, soft shadows of the
    environment, emissive surfaces that light what is around them. Needs `mitsuba` and an LLVM library.

    Coverage and depth are the ray caster's, which are exact and free of noise; paths give the colour of what is covered.
    The reflection is the ray caster's too (glTF 2.0, appendix B), so under lamps alone and with most_bounces = 1 both backends
    show the same but for rough metals, whose lost light is given back here. Occlusion textures are not read: here light itself is
    occluded. Emissive surfaces are area lights; unlit ones show their base colour, also in reflections. Use it from one thread.
    """

    def __init__(
        self,
        samples: int = 64,
        most_bounces: int = 6,
        seed: int = 0,
        threads: int = 0,
        denoise: bool = False,
        shows_progress: bool = True,
    ) -> None:
        """samples: paths per pixel, rounded up to what divides into a grid. most_bounces: surfaces that light meets on its way to
        the camera; 1 is direct light only. threads: 0 leaves the compiler's number, all cores at first. denoise: pays with
        few samples, see `path_denoising`; needs `pyoidn`. shows_progress: a bar while a picture takes long; not within another bar.

        Raises MissingExtraError where Mitsuba or the denoiser is not installed and InputError where its compiler is missing.
        """
        if samples < 1 or most_bounces < 0 or threads < 0:
            raise InputError(
                f"expected at least one sample and no negative bounces or threads, got {samples}, {most_bounces} and {threads}"
            )
        load(threads)
        if denoise:
            require_denoiser()
        self.samples, self.most_bounces, self.seed = samples, most_bounces, seed
        self._threads, self._denoise, self._shows_progress = threads, denoise, shows_progress
        self.caster = EmbreeRaycaster(threads)
        self._kept: tuple[Scene, tuple[Mesh, ...], Any] | None = None

    def bar(self, description: str) -> str | None:
        """What a progress bar is to say; None for no bar."""
        return description if self._shows_progress else None

    def prepare(self) -> None:
        """Choose Mitsuba's variant, which is one for the whole process, and the number of threads."""
        load(self._threads)

    def render(self, scene: Scene, camera: Camera) -> Layer:
        """The scene as the camera sees it, without lens blur; see SceneRenderer."""
        return self.render_beside(scene, camera, ())

    def render_beside(self, scene: Scene, camera: Camera, surroundings: Sequence[Mesh]) -> Layer:
        """The scene beside real surfaces, which are not drawn but hide light from it and pass light on to it."""
        shapes = self.caster.render(scene, camera)
        pixels = np.flatnonzero(shapes.alpha > 0)
        if not len(pixels):
            return shapes
        guides = self._traced(scene, camera, surroundings, pixels)
        color = denoised(guides, pixels, (camera.height_px, camera.width_px)) if self._denoise else guides.color
        rgb = shapes.rgb.reshape(-1, 3).copy()
        # Where no path met what the ray caster's own samples did, its colour stays.
        met = guides.share > 0
        rgb[pixels[met]] = color[met] * shapes.alpha.reshape(-1)[pixels[met], None]
        return Layer(rgb.reshape(shapes.rgb.shape), shapes.alpha, shapes.depth_m)

    def render_shadow_mask(self, scene: Scene, camera: Camera, catcher: Mesh) -> Float32[np.ndarray, "height width"]:
        """(H, W) share of the lights' irradiance on the catcher that the scene lets through; the ray caster's, see SceneRenderer."""
        return self.caster.render_shadow_mask(scene, camera, catcher)

    def _traced(self, scene: Scene, camera: Camera, surroundings: Sequence[Mesh], pixels: Int64[np.ndarray, " pixels"]) -> Guides:
        """What paths find in some pixels."""
        self.prepare()
        import mitsuba as mi

        from mrbokeh.scene.mitsuba.camera import CameraRays
        from mrbokeh.scene.mitsuba.paths import Rays, followed

        world = self._world(scene, tuple(surroundings))
        lens, parts = CameraRays(camera, world.centre_m, self.samples), []
        for origin, direction, width, sampler in lens.parts(pixels, self.seed, self.bar("tracing paths")):
            rays = Rays(origin, direction, mi.Bool(True), from_camera=True, width_per_m=width)
            parts.append(lens.means(followed(world, rays, sampler, self.most_bounces)))
        share, radiance, albedo, normal = (np.concatenate(column) for column in zip(*parts, strict=True))
        met = np.maximum(share, 1e-6)[:, None]
        return Guides(color=radiance / met, share=share, albedo=albedo / met, normal=normal / met)

    def _world(self, scene: Scene, surroundings: tuple[Mesh, ...]) -> Any:
        """The scene on the device; the last one is kept, so that a film of one scene under many cameras is cheap."""
        from mrbokeh.scene.mitsuba.world import world_of

        last = self._kept
        if last is not None and last[0] is scene and last[1] == surroundings:
            return last[2]
        world = world_of(scene, surroundings, None if last is None else last[2])
        self._kept = scene, surroundings, world
        return world
